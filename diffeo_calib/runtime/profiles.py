"""Radial profiles kappa(r2) and their derivatives in NumPy; kernels/profiles.py has the formulas for torch.

Matern profiles use r = sqrt(2 nu r2). Their second derivative in r2 may be infinite at r = 0, where every formula
multiplies it by a higher power of r: a floor under r keeps the product finite.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from diffeo_calib.runtime.arrays import Array

SMALLEST_RADIUS = 1e-7
"""Floor under r where a formula divides by it."""

Profile = Callable[..., tuple[Array, ...]]
"""``profile(r2)`` is (kappa,); ``profile(r2, slopes=True)`` is kappa with its first two derivatives in r2."""


def gaussian(r2: Array, *, slopes: bool = False) -> tuple[Array, ...]:
    """exp(-r2 / 2)."""
    kappa = np.exp(-0.5 * r2)
    return (kappa, -0.5 * kappa, 0.25 * kappa) if slopes else (kappa,)


def cauchy(r2: Array, *, slopes: bool = False) -> tuple[Array, ...]:
    """1 / (1 + r2)."""
    kappa = 1.0 / (1.0 + r2)
    return (kappa, -(kappa**2), 2.0 * kappa**3) if slopes else (kappa,)


def constant(r2: Array, *, slopes: bool = False) -> tuple[Array, ...]:
    """1: the same motion everywhere."""
    return (np.ones_like(r2), np.zeros_like(r2), np.zeros_like(r2)) if slopes else (np.ones_like(r2),)


def matern(r2: Array, *, order: int, slopes: bool = False) -> tuple[Array, ...]:
    """p_k(r) exp(-r) with r = sqrt(2 nu r2), nu = k + 1/2, for the orders k = 1, 2, 3.

    d kappa_k / d r2 = -c / (2 (2 k - 1)) kappa_(k-1) at fixed c = 2 nu, with kappa_0 = exp(-r) and
    d kappa_0 / d r2 = -c / (2 r) exp(-r).
    """
    c = 2.0 * order + 1.0
    r = np.sqrt(np.maximum(r2, 0.0) * c)
    decay = np.exp(-r)
    kappa = _polynomial(r, order) * decay
    if not slopes:
        return (kappa,)
    first = -0.5 * c / (2 * order - 1)
    second = first * -0.5 * c / max(2 * order - 3, 1)
    return kappa, first * _polynomial(r, order - 1) * decay, second * _polynomial(r, order - 2) * decay


def _polynomial(r: Array, order: int) -> Array:
    """kappa_order exp(r)."""
    if order == 3:
        return 1.0 + r * (1.0 + r * (0.4 + r / 15.0))
    if order == 2:
        return 1.0 + r * (1.0 + r / 3.0)
    if order == 1:
        return 1.0 + r
    return np.ones_like(r) if order == 0 else 1.0 / np.maximum(r, SMALLEST_RADIUS)


PROFILES: dict[str, Profile] = {
    "gaussian": gaussian,
    "cauchy": cauchy,
    "constant": constant,
    "matern32": partial(matern, order=1),
    "matern52": partial(matern, order=2),
    "matern72": partial(matern, order=3),
}
"""All profiles by their names in model files."""
