"""Periodic errors of joints at one frequency each; robots/gear_waves.py is the torch version."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diffeo_calib.runtime.arrays import Array


@dataclass(frozen=True, eq=False)
class Waves:
    """x_l + C cos(w x_l) + S sin(w x_l) in place of x_l.

    Args:
        size: n, number of joints.
        joints: (K,) numbers l.
        frequencies: (K,) w, periods per turn.
        coefficients: (K, 2) C and S, rad or m.
    """

    size: int
    joints: tuple[int, ...]
    frequencies: Array
    coefficients: Array

    def turned(self, x: Array) -> Array:
        """(N, n) -> (N, n)."""
        angles, (cosine, sine) = self._angles(x), self.coefficients.T
        return x + (np.cos(angles) * cosine + np.sin(angles) * sine) @ self._selection

    def slopes(self, x: Array) -> Array:
        """Derivative of :meth:`turned`, which is diagonal: (N, n) -> (N, n)."""
        angles, (cosine, sine) = self._angles(x), self.coefficients.T
        return 1.0 + (self.frequencies * (np.cos(angles) * sine - np.sin(angles) * cosine)) @ self._selection

    def _angles(self, x: Array) -> Array:
        return x[:, list(self.joints)] * self.frequencies

    @cached_property
    def _selection(self) -> Array:
        """(K, n): several waves of one joint add up."""
        return np.eye(self.size)[list(self.joints)]


def waves_of(config: Sequence[Sequence[float]], size: int, coefficients: Array) -> Waves | None:
    """The waves that a model file describes; None without any.

    Args:
        config: joint and frequency of each. size: number of joints. coefficients: (2 K,).
    """
    if not config:
        return None
    frequencies = np.array([frequency for _, frequency in config], dtype=np.float64)
    return Waves(size, tuple(int(joint) for joint, _ in config), frequencies, coefficients.reshape(-1, 2))
