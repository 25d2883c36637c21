"""Landmark geodesics in NumPy: the run of the controls that flow.py replays.

    q' = v(q),    a' = -Dv(q)^T a,    v = sum_j K(., q_j) a_j

flows/geodesic.py is the torch version. Sums are plain matrices here: they run once per model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diffeo_calib.runtime.arrays import Array
from diffeo_calib.runtime.build import radial_term
from diffeo_calib.runtime.runge_kutta import Tableau


def recorded_stages(
    kernel: Sequence[Mapping[str, Any]], q: Array, a: Array, tableau: Tableau, steps: int
) -> tuple[Array, Array]:
    """Integrate the controls over t in [0, 1].

    Args:
        kernel: terms as in model files. q, a: (C, n) controls and momenta at time 0.
        tableau: coefficients and weights. steps: number of equal steps.

    Returns:
        the states at every stage (S, 2, C, n), and at the end (2, C, n).
    """
    coefficients, weights = (t / steps for t in tableau)
    state, stages = np.stack([q, a]), []
    for _ in range(steps):
        slopes: list[Array] = []
        for row in coefficients:
            stages.append(_combined(state, row, slopes))
            slopes.append(_slope(kernel, stages[-1]))
        state = _combined(state, weights, slopes)
    return np.stack(stages), state


def _slope(kernel: Sequence[Mapping[str, Any]], state: Array) -> Array:
    """(v(q), -Dv(q)^T a)."""
    q, a = state
    total = np.zeros_like(state)
    for config in kernel:
        term = radial_term(config, state[None])
        if term.weights.any():
            v, dv = term.velocity_and_jacobian(0, q)
            total += np.stack([v, -(dv.swapaxes(1, 2) @ a[..., None])[..., 0]])
    return total


def _combined(state: Array, coefficients: Array, slopes: Sequence[Array]) -> Array:
    for c, slope in zip(coefficients, slopes, strict=False):
        state = state + c * slope
    return state
