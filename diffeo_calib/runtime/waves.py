"""Periodic errors of single joints at one frequency (kernels/harmonic.py): two numbers per wave and stage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from diffeo_calib.runtime.arrays import Array

PROFILE = "cosine"
"""Name of these kernels in model files, where radial kernels have that of their profile."""


@dataclass(frozen=True, eq=False)
class Waves:
    """v_l(x) = C cos(w x_l) + S sin(w x_l) of K waves at every stage; the joint's value lies on a line.

    Args:
        size: n, number of joints.
        joints: (K,) numbers l.
        frequencies: (K,) w, periods per turn.
        coefficients: (S, K, 2) C and S, rad or m.
    """

    size: int
    joints: tuple[int, ...]
    frequencies: Array
    coefficients: Array

    def velocity(self, stage: int, x: Array) -> Array:
        """(N, n) -> (N, n)."""
        angles, (cosine, sine) = self._angles(x), self.coefficients[stage].T
        return (np.cos(angles) * cosine + np.sin(angles) * sine) @ self._selection

    def velocity_and_slope(self, stage: int, x: Array) -> tuple[Array, Array]:
        """(N, n) -> v (N, n), and the diagonal (N, n) of Dv, which has no other entries."""
        angles, (cosine, sine) = self._angles(x), self.coefficients[stage].T
        along, across = np.cos(angles), np.sin(angles)
        slope = self.frequencies * (along * sine - across * cosine)
        return (along * cosine + across * sine) @ self._selection, slope @ self._selection

    def _angles(self, x: Array) -> Array:
        return x[:, list(self.joints)] * self.frequencies

    @cached_property
    def _selection(self) -> Array:
        """(K, n): several waves of one joint add up."""
        return np.eye(self.size)[list(self.joints)]


def waves_of(kernel: Sequence[Mapping[str, Any]], stages: Array) -> Waves | None:
    """The waves among the terms of a kernel.

    Args:
        kernel: terms as in model files.
        stages: (S, 2, C, n) controls and momenta at every stage.

    Returns:
        None without any.
    """
    found = [config for config in kernel if config["profile"] == PROFILE and config["variance"] > 0]
    if not found:
        return None
    joints = tuple(int(config["joint"]) for config in found)
    frequencies = np.array([config["frequency"] for config in found], dtype=np.float64)
    variances = np.array([config["variance"] for config in found], dtype=np.float64)
    q, a = stages[:, 0][..., list(joints)], stages[:, 1][..., list(joints)]  # (S, C, K)
    sums = [(wave(q * frequencies) * a).sum(1) * variances for wave in (np.cos, np.sin)]
    return Waves(stages.shape[-1], joints, frequencies, np.stack(sums, axis=-1))
