"""Radial profiles kappa(r2) and their derivatives in r2 = |F - F'|^2, once for every library of arrays.

Formulas use arithmetic and three functions of a library, exp, sqrt and relu (max(x, 0)): NumPy's here, those of
tensors and of what records or compiles operations in kernels/profiles.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

LEAST_R2 = 1e-14
"""Added to r^2 where a formula divides by r."""
NUMPY = SimpleNamespace(
    exp=lambda a: np.exp(a, out=a), sqrt=lambda a: np.sqrt(a, out=a), relu=lambda a: np.maximum(a, 0.0)
)
"""In place: formulas pass values that nothing else reads."""


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
