"""The choice between the ways to condition on the data, by problem size, and a check of the memory it needs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

from torch import Tensor

from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.conditional import Process
from diffeo_calib.regression.conjugate_gradients import CG_TOLERANCE, MAX_RANK, ConjugateGradientRegression
from diffeo_calib.regression.control_points import BLOCK_ENTRIES, ControlPointRegression

LinearSolver = Literal["auto", "cholesky", "cg"]

MAX_DENSE = 8_000
"""Largest N m for which `auto` factorises the matrix (0.5 GiB in float64, at the peak four times as much)."""
COPIES_OF_BLOCK = 5  # matrices of the size of one block of control point equations that exist at a time
BYTES_PER_FLOAT = 8
BYTES_PER_GIB = 2.0**30


def condition(
    linearisation: Linearisation, noise: Noise, linear: LinearSolver = "auto", tolerance: float = CG_TOLERANCE
) -> Process | ConjugateGradientRegression:
    """Condition on data that are all control points; ``tolerance`` is that of conjugate gradients.

    Raises:
        InputError: the method needs more memory than is free.
        NumericalError: F + R is not positive definite in float64.
    """
    n, m, _ = noise.covariance.shape
    method = choose(linear, n * m)
    check_memory(predicted_memory(method, n * m), f"{n * m} measured coordinates with linear={method!r}")
    if method == "cholesky":
        return Process.of_rows(linearisation, noise)
    return ConjugateGradientRegression(linearisation, noise, tolerance=tolerance)


def condition_controls(
    deformation: GeodesicDeformation,
    x: Tensor,
    noise: Noise,
    slopes: Tensor | None = None,
    residual: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> ControlPointRegression:
    """Condition in the momenta of the control points; arguments as of :class:`ControlPointRegression`.

    Raises:
        InputError: the method needs more memory than is free.
    """
    size = deformation.momenta.flatten().numel()
    needed = BYTES_PER_FLOAT * (3 * size**2 + COPIES_OF_BLOCK * BLOCK_ENTRIES)
    check_memory(needed, f"normal equations of {size} momenta")
    return ControlPointRegression(deformation, x, noise, slopes, residual)


def choose(linear: LinearSolver, size: int) -> LinearSolver:
    """The method for ``size`` measured coordinates: ``linear`` itself, or the choice of `auto`.

    Raises:
        InputError: an unknown method.
    """
    if linear not in get_args(LinearSolver):
        raise InputError.of("`linear`", expected=", ".join(get_args(LinearSolver)), got=as_written(linear))
    return linear if linear != "auto" else "cholesky" if size <= MAX_DENSE else "cg"


def predicted_memory(linear: LinearSolver, size: int) -> int:
    """Bytes at the peak of one step: four matrices, or four factors of the preconditioner."""
    return 4 * BYTES_PER_FLOAT * size * (size if linear == "cholesky" else min(MAX_RANK, size))


def check_memory(needed: int, what: str) -> None:
    """Raise InputError if less memory than ``needed`` (bytes) is free; check nothing if the system does not report it.

    Args:
        needed: bytes. what: subject of the message, plural.
    """
    free = free_memory()
    if free is not None and needed > free:
        raise InputError.of(
            f"{what} need more memory than is free",
            expected=f"{needed / BYTES_PER_GIB:.1f} GiB",
            got=f"{free / BYTES_PER_GIB:.1f} GiB free",
            fix="fit with fewer control points (`controls=500`), or a subset of the rows",
        )


def free_memory() -> int | None:
    """Bytes of memory that are available, or None where unknown."""
    try:
        with open("/proc/meminfo", encoding="utf-8") as file:
            entries = dict(line.split(":", 1) for line in file)
        return int(entries["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        return None
