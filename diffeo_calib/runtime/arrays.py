"""NumPy arrays: their type, products, transforms, and what files name: Runge-Kutta methods, profiles of kernels.

Radial profiles kappa(r2) and their derivatives in r2 = |F - F'|^2 are here once for every library: their formulas use
arithmetic, exp, sqrt and relu (max(x, 0)). Those of what records or compiles operations are in kernels/profiles.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    exp=lambda a: np.exp(a, out=a),  # both in place: formulas pass values that nothing else reads
    sqrt=lambda a: np.sqrt(a, out=a),
    relu=lambda a: np.maximum(a, 0.0),
    clip=np.clip,
    within_turn=lambda x: np.mod(x, 2 * np.pi),  # angles in [0, 2 pi)
    stack=np.stack,
    concatenate=np.concatenate,
    ones_like=np.ones_like,
    broadcast_to=np.broadcast_to,
    at_least=lambda values, floor: np.maximum(values, floor, out=values),
    # the columns of cells (7, K) that begin at the last starts before t: seven arrays
    cells_around=lambda starts, cells, t: cells[:, np.searchsorted(starts, t, side="right") - 1],
    combined=combined,
    transforms=transforms,
    inverse=np.linalg.inv,  # of rigid transforms
)
"""Functions of an array library for flows and poses: NumPy's here, torch's in interop/torch_program.py."""

Tableau = tuple[Array, Array]  # coefficients (s, s), strictly lower triangular, and weights (s,)


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


MOST_STEPS = 1024  # largest number of steps on [0, 1]: errors are pure rounding long before

TABLEAUS: dict[str, Callable[[], Tableau]] = {"rk4": rk4, "rk8": rk8}


LEAST_R2 = 1e-14  # added to r^2 where a formula divides by r


def gaussian(r2: Any, orders: Sequence[int], use: Any = NUMPY) -> Iterator[Any]:
    """exp(-r2 / 2); on circles the von Mises kernel."""
    kappa = use.exp(r2 * -0.5)
    yield from (kappa * (-0.5) ** k if k else kappa for k in orders)


def cauchy(r2: Any, orders: Sequence[int], use: Any = NUMPY) -> Iterator[Any]:
    """1 / (1 + r2), with the derivatives (-1)^k k! (1 + r2)^-(k + 1)."""
    inverse = 1.0 / (1.0 + r2)
    for order in orders:
        power = inverse
        for k in range(order):
            power = power * inverse * -(k + 1.0)
        yield power


def constant(r2: Any, orders: Sequence[int], use: Any = NUMPY) -> Iterator[Any]:
    """1: the same motion everywhere."""
    yield from (r2 * 0.0 + (0.0 if k else 1.0) for k in orders)


def matern(r2: Any, orders: Sequence[int], use: Any = NUMPY, *, p: int) -> Iterator[Any]:
    """kappa_p(r) = P_p(r) exp(-r) with r = sqrt(2 nu r2), nu = p + 1/2, for p = 1, 2, 3.

    d kappa_p / d r2 = -nu / (2 p - 1) kappa_(p - 1) at fixed nu, down to kappa_0 = exp(-r); below it the polynomials
    are continued with the factor -nu.
    """
    nu = p + 0.5
    r = use.sqrt(use.relu(r2) * (2.0 * nu))  # rounding leaves r2 = -1e-16 at coinciding points
    decay = use.exp(-r)
    for order in orders:
        factor = 1.0
        for k in range(p, p - order, -1):
            factor *= -nu / max(2 * k - 1, 1)
        yield POLYNOMIALS[p - order](r, use) * decay * factor


def _safe(r: Any, use: Any) -> Any:
    """r where it is divided by.

    Below p = 0 the derivative is infinite at r = 0, but every formula multiplies it by |F - F'|^2 or a higher power, so
    that the product vanishes. The floor keeps rounding of coinciding points (r2 = 1e-16, not 0) from blowing up.
    """
    return use.sqrt(r * r + LEAST_R2)


POLYNOMIALS: dict[int, Callable[[Any, Any], Any]] = {
    3: lambda r, _: 1.0 + r * (1.0 + r * (0.4 + r / 15.0)),
    2: lambda r, _: 1.0 + r * (1.0 + r / 3.0),
    1: lambda r, _: 1.0 + r,
    0: lambda r, _: 1.0,
    -1: lambda r, use: 1.0 / _safe(r, use),
    -2: lambda r, use: (1.0 + (safe := _safe(r, use))) / (safe * safe * safe),
}
"""P_p of r."""

FORMULAS: dict[str, Callable[..., Iterator[Any]]] = {
    "gaussian": gaussian,
    "cauchy": cauchy,
    "constant": constant,
    "matern32": partial(matern, p=1),
    "matern52": partial(matern, p=2),
    "matern72": partial(matern, p=3),
}
"""All profiles by their names in model files: ``formula(r2, orders, use)`` gives the derivatives of these orders."""
