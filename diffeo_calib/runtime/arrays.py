"""NumPy arrays: their type, products, transforms, and the tableaus of Runge-Kutta methods by their names in files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffeo_calib.runtime.profiles import FORMULAS

Array = NDArray[np.float64]


def as_index(columns: Sequence[int]) -> slice | list[int]:
    """Columns as an index; consecutive ones as a slice, which makes no copy."""
    columns = list(columns)
    first = columns[0] if columns else 0
    consecutive = columns == list(range(first, first + len(columns)))
    return slice(first, first + len(columns)) if consecutive else columns


def cross(a: Any, b: Any) -> Any:
    """a x b along the last axis, of arrays or tensors; several times faster than np.cross on few rows."""
    return a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]


_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


ONE = np.eye(3)
SKEW = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]], float)
"""w @ SKEW is [w]x, row by row."""


def skew(w: Array) -> Array:
    """[w]x: (..., 3) -> (..., 3, 3)."""
    return (w @ SKEW).reshape(*w.shape, 3)


def transforms(twists: Array) -> Array:
    """T(t, w) = [[exp([w]x), t], [0, 1]]: (..., 6) -> (..., 4, 4)."""
    w = twists[..., 3:]
    x, W = (w * w).sum(-1)[..., None, None], skew(w)
    a = np.sqrt(x)
    out = np.zeros((*twists.shape[:-1], 4, 4))
    out[..., :3, :3] = ONE + np.sinc(a / np.pi) * W + 0.5 * np.sinc(a / (2 * np.pi)) ** 2 * (W @ W)
    out[..., :3, 3], out[..., 3, 3] = twists[..., :3], 1.0
    return out


def combined(x: Array, coefficients: Iterable[float], slopes: Sequence[Array]) -> Array:
    """x + sum_k c_k slope_k."""
    for c, slope in zip(np.asarray(coefficients).tolist(), slopes, strict=False):
        if c:
            x = x + c * slope
    return x


NUMPY = SimpleNamespace(
    sin=np.sin,
    cos=np.cos,
    clip=np.clip,
    within_turn=lambda x: np.mod(x, 2 * np.pi),  # angles in [0, 2 pi)
    stack=np.stack,
    concatenate=np.concatenate,
    ones_like=np.ones_like,
    broadcast_to=np.broadcast_to,
    at_least=lambda values, floor: np.maximum(values, floor, out=values),
    profile=lambda name, r2: next(FORMULAS[name](r2, (0,))),
    # the columns of cells (7, K) that begin at the last starts before t: seven arrays
    cells_around=lambda starts, cells, t: cells[:, np.searchsorted(starts, t, side="right") - 1],
    combined=combined,
    transforms=transforms,
    inverse=np.linalg.inv,  # of rigid transforms
)
"""Functions of an array library for flows and poses: NumPy's here, torch's in interop/torch_program.py."""

Tableau = tuple[Array, Array]
"""Coefficients (s, s), strictly lower triangular, and weights (s,)."""


@cache
def rk4() -> Tableau:
    """The classical method of order 4."""
    coefficients = [[0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    return np.array(coefficients), np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])


@cache
def rk8() -> Tableau:
    """The method of order 8 by Dormand and Prince; coefficients from SciPy."""
    from scipy.integrate import DOP853  # noqa: PLC0415  # slow to import, and not the default

    return DOP853.A.copy(), DOP853.B.copy()


MOST_STEPS = 1024
"""Largest number of steps on [0, 1]: errors are pure rounding long before."""

TABLEAUS: dict[str, Callable[[], Tableau]] = {"rk4": rk4, "rk8": rk8}
