"""Checks of arrays that come from outside: shape, finiteness, sign.

Public functions check their arguments with these functions; inside the package tensors are trusted.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from math import isfinite, nan

import numpy as np
import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.autograd import forward_ad

from diffeo_calib.common.data_frames import ARRAY_KINDS, real_array
from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.errors import InputError, as_written

MOST_SHOWN = 12  # values that a message lists
LARGEST_SEED = 2**63 - 1  # of torch; NumPy's generators take any
LARGEST = 1e75  # its fourth power is finite
Shape = Sequence[int | str]  # a pattern such as ``("N", 6)``: an integer must match, a letter stands for any size


def as_tensor(
    value: object, name: str, shape: Shape, *, also: Sequence[Shape] = (), fix: str = "", empty: bool = False
) -> Tensor:
    """Convert ``value`` to a finite float64 tensor of the given shape.

    A tensor keeps its device and its place in an autograd graph.

    Args:
        value: tensor, array or nested sequence of numbers.
        name: the argument's name, for messages.
        shape: pattern such as ``("N", 6)``; letters stand for any size.
        also: other shapes that are accepted.
        fix: what the user should do if the shape is wrong.
        empty: whether a size of zero is allowed.

    Raises:
        InputError: no real numbers, wrong shape, empty, or NaN or infinite values (first place named).
    """
    tensor = real_tensor(value, name)
    shapes = [shape, *also]
    expected = " or ".join(_words(pattern) for pattern in shapes)
    if not any(
        tensor.ndim == len(pattern)
        and all(isinstance(want, str) or want == size for want, size in zip(pattern, tensor.shape, strict=True))
        for pattern in shapes
    ):
        raise InputError.of(f"`{name}` has the wrong shape", expected=expected, got=_words(tensor.shape), fix=fix)
    if not empty and tensor.numel() == 0:
        got = _words(tensor.shape)
        raise InputError.of(f"`{name}` is empty", expected=expected, got=got, fix="pass at least one row")
    check_finite(tensor, name)
    return tensor


def real_tensor(value: object, name: str) -> Tensor:
    """Convert to float64; a tensor keeps its device and its place in an autograd graph.

    Args:
        value: tensor, array or nested sequence of real numbers. Numbers written as texts are read.
        name: the argument's name, for messages.

    Raises:
        InputError: anything else, or a masked array in which values are missing.
    """
    if isinstance(value, Tensor):
        return _of_tensor(value, name)
    try:
        array = real_array(value)
    except (TypeError, ValueError, OverflowError, RecursionError, RuntimeError) as error:
        raise _unreadable(name, str(error)) from error
    return outside_inference_mode(torch.from_numpy)(array)


def check_finite(tensor: Tensor, name: str) -> None:
    """Raise InputError naming the first entry that is NaN, infinite or too large to compute with.

    See :func:`wrapped` for the exception.
    """
    if wrapped(tensor):
        return
    bad = ~(tensor.detach().abs() <= LARGEST)
    if bad.any():
        where = [int(i) for i in bad.nonzero()[0]]
        value = float(tensor.detach()[tuple(where)])
        large = isfinite(value)
        raise InputError.of(
            f"`{name}` has {int(bad.sum())} value(s) that are {'too large' if large else 'not finite'}, "
            f"the first at index {where}",
            expected=f"numbers below {LARGEST:g}" if large else "finite numbers",
            got=value,
            fix="remove or repair these rows",
        )


def positive(value: object, name: str, shape: Shape = ()) -> Tensor:
    """Convert to a float64 tensor of positive finite numbers.

    Raises:
        InputError: not numeric, wrong shape, not finite, zero or negative.
    """
    tensor = as_tensor(value, name, shape)
    bad = tensor.detach() <= 0
    if bool(bad.any()):
        got: object = tensor.detach().tolist()
        if tensor.numel() > MOST_SHOWN:
            where = [int(i) for i in bad.nonzero()[0]]
            got = f"{int(bad.sum())} others, the first at index {where}: {float(tensor[tuple(where)])}"
        raise InputError.of(f"`{name}`", expected="positive numbers", got=got, fix="pass values above zero")
    return tensor


def check_covariance(matrix: Tensor, what: str) -> None:
    """Raise InputError unless a matrix (m, m) is a covariance, m^2."""
    skewed = bool(((matrix - matrix.mT).abs() > 1e-9 * matrix.abs().max()).any())
    if skewed or int(torch.linalg.cholesky_ex(matrix).info):
        raise InputError.of(what, expected="a symmetric positive definite matrix in m^2")


def check_count(value: object, what: str, *, most: int | None = None) -> None:
    """Raise InputError unless ``value`` is an integer from 1 on."""
    good = isinstance(value, int) and not isinstance(value, bool) and value >= 1
    if not good or (most is not None and isinstance(value, int) and value > most):
        limit = "an integer of at least 1" + ("" if most is None else f" and at most {most}")
        raise InputError.of(what, expected=limit, got=as_written(value))


def check_number(value: object, what: str, *, above: float, below: float = float("inf")) -> None:
    """Raise InputError unless ``value`` is a number strictly between two bounds."""
    number = nan
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        with suppress(OverflowError):  # integers may be larger than any float
            number = float(value)
    if not above < number < below:
        limit = f"a number above {above:g}" + ("" if below == float("inf") else f" and below {below:g}")
        raise InputError.of(what, expected=limit, got=as_written(value))


def number_of(value: object) -> float | None:
    """A real number of Python, NumPy or torch (one entry) as a float; None for anything else, and for NaN."""
    if isinstance(value, (bool, np.bool_, str, bytes)) or value is None:
        return None
    try:
        array = value.detach().cpu().numpy() if isinstance(value, Tensor) else np.asarray(value)
        if array.shape != () or array.dtype.kind not in "iuf":
            return None
        return None if np.isnan(array) else float(array)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return None


def index_of(value: object) -> int | None:
    """An integer of Python or NumPy as an int; None for anything else."""
    return int(value) if isinstance(value, (int, np.integer)) and not isinstance(value, bool) else None


def check_seed(seed: object) -> int:
    """A seed of random numbers.

    Raises:
        InputError: not an integer from 0 to 2^63 - 1.
    """
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed <= LARGEST_SEED:
        raise InputError.of("`seed`", expected=f"an integer from 0 to {LARGEST_SEED}", got=as_written(seed))
    return int(seed)


def wrapped(*tensors: Tensor) -> bool:
    """Whether code must not branch on the values of ``tensors``.

    This is so inside a ``torch.func`` transform, where tensors have forward-mode tangents, and while ``torch.compile``,
    ``torch.export`` or ``torch.jit.trace`` record a program. Checks of values are left out there: a recorded program
    does not check its input.
    """
    recorded = torch.compiler.is_compiling() or torch.jit.is_tracing()  # pyright: ignore[reportPrivateImportUsage]
    if recorded or any(map(is_functorch_wrapped_tensor, tensors)):
        return True
    level = forward_ad._current_level  # pyright: ignore[reportPrivateUsage]  # looking for tangents takes a microsecond
    return level >= 0 and any(forward_ad.unpack_dual(t).tangent is not None for t in tensors)


def _words(shape: Sequence[int | str]) -> str:
    return "(" + ", ".join(str(s) for s in shape) + ("," if len(shape) == 1 else "") + ")"


def _of_tensor(tensor: Tensor, name: str) -> Tensor:
    if tensor.layout is not torch.strided or tensor.is_nested:
        raise _unreadable(name, "a sparse or nested tensor", "pass a dense one, such as `tensor.to_dense()`")
    if tensor.is_quantized:
        raise _unreadable(name, "a quantized tensor", "pass `tensor.dequantize()`")
    if tensor.is_meta:
        raise _unreadable(name, "a tensor on the meta device, which holds no numbers", "pass one with values")
    if tensor.dtype == torch.bool:
        raise _unreadable(name, ARRAY_KINDS["b"])
    if tensor.is_complex():
        raise _unreadable(name, ARRAY_KINDS["c"], "pass their real part")
    tensor = tensor.to(torch.float64)
    if torch.compiler.is_compiling():  # what follows cannot be traced
        return tensor
    tensor = tensor.resolve_neg() if tensor.is_neg() else tensor  # NumPy knows no such views
    # Tensors made in torch.inference_mode cannot take part in derivatives; a copy made outside can.
    return outside_inference_mode(tensor.clone)() if tensor.is_inference() else tensor


def _unreadable(name: str, why: str, fix: str = "pass a numeric array, rows of equal length") -> InputError:
    return InputError.of(f"`{name}` cannot be read as numbers ({why})", fix=fix)


BYTES_PER_GIB = 2.0**30


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
