"""Radial profiles kappa(r2) and their derivatives in NumPy; kernels/profiles.py has the formulas for torch.

Matern profiles use r = sqrt(2 nu r2). Their second derivative in r2 may be infinite at r = 0, where every formula
multiplies it by a higher power of r: a floor under r keeps the product finite.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from diffeo_calib.runtime.arrays import Array

SMALLEST_RADIUS = 1e-7
"""Floor under r where a formula divides by it."""


class RadialProfile(ABC):
    """kappa with kappa(0) = 1, and its first two derivatives in r2, elementwise."""

    @abstractmethod
    def value(self, r2: Array) -> Array:
        """kappa(r2)."""

    @abstractmethod
    def derivatives(self, r2: Array) -> tuple[Array, Array, Array]:
        """kappa, kappa', kappa''."""


class Gaussian(RadialProfile):
    """exp(-r2 / 2)."""

    def value(self, r2: Array) -> Array:
        """One exponential."""
        return np.exp(-0.5 * r2)

    def derivatives(self, r2: Array) -> tuple[Array, Array, Array]:
        """kappa, -kappa / 2, kappa / 4."""
        kappa = np.exp(-0.5 * r2)
        return kappa, -0.5 * kappa, 0.25 * kappa


class Cauchy(RadialProfile):
    """1 / (1 + r2)."""

    def value(self, r2: Array) -> Array:
        """One division."""
        return 1.0 / (1.0 + r2)

    def derivatives(self, r2: Array) -> tuple[Array, Array, Array]:
        """Powers of 1 / (1 + r2)."""
        kappa = 1.0 / (1.0 + r2)
        return kappa, -(kappa**2), 2.0 * kappa**3


class Constant(RadialProfile):
    """1: the same motion everywhere."""

    def value(self, r2: Array) -> Array:
        """Ones."""
        return np.ones_like(r2)

    def derivatives(self, r2: Array) -> tuple[Array, Array, Array]:
        """1, 0, 0."""
        return np.ones_like(r2), np.zeros_like(r2), np.zeros_like(r2)


@dataclass(frozen=True)
class Matern(RadialProfile):
    """p_k(r) exp(-r) with r = sqrt(2 nu r2), nu = k + 1/2.

    d kappa_k / d r2 = -c / (2 (2 k - 1)) kappa_(k-1) at fixed c = 2 nu, with kappa_0 = exp(-r) and
    d kappa_0 / d r2 = -c / (2 r) exp(-r).

    Args:
        order: k = 1, 2, 3 for nu = 3/2, 5/2, 7/2.
    """

    order: int

    def value(self, r2: Array) -> Array:
        """kappa_k."""
        r = np.sqrt(np.maximum(r2, 0.0) * (2 * self.order + 1))
        return _polynomial(r, self.order) * np.exp(-r)

    def derivatives(self, r2: Array) -> tuple[Array, Array, Array]:
        """By the recursion of the class."""
        c, k = 2.0 * self.order + 1.0, self.order
        r = np.sqrt(np.maximum(r2, 0.0) * c)
        decay, first = np.exp(-r), -0.5 * c / (2 * k - 1)
        second = first * -0.5 * c / max(2 * k - 3, 1)
        return _polynomial(r, k) * decay, first * _polynomial(r, k - 1) * decay, second * _polynomial(r, k - 2) * decay


def _polynomial(r: Array, order: int) -> Array:
    """kappa_order exp(r)."""
    if order == 3:
        return 1.0 + r * (1.0 + r * (0.4 + r / 15.0))
    if order == 2:
        return 1.0 + r * (1.0 + r / 3.0)
    if order == 1:
        return 1.0 + r
    return np.ones_like(r) if order == 0 else 1.0 / np.maximum(r, SMALLEST_RADIUS)


PROFILES: dict[str, RadialProfile] = {
    "gaussian": Gaussian(),
    "cauchy": Cauchy(),
    "constant": Constant(),
    "matern32": Matern(1),
    "matern52": Matern(2),
    "matern72": Matern(3),
}
"""All profiles by their names in model files."""
