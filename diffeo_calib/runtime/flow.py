"""The time-1 map of a recorded geodesic: fixed steps make the controls at every stage constants of the flow.

A passive point moves by x' = v_s(x), v_s(x) = sum_j K(x, q_sj) a_sj, its Jacobian by M' = Dv_s(x) M, with the stages s
of the Runge-Kutta run that moved the controls (flows/geodesic.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from diffeo_calib.runtime.arrays import FORMULAS, NUMPY, Array, combined
from diffeo_calib.runtime.tables import JointTables, tabulated

BLOCK = 1 << 16  # largest number of kernel values that are held at once: they stay in the cache of the processor
SMALLEST_SQUARE = 1e-30
"""Floor under squared distances: the root of 0 has no derivative. Kernels are 1 there to the last digit."""


@dataclass(frozen=True, eq=False)
class RadialTerm:
    """kappa(|F(x) - F(q_j)|^2) w_j summed over the controls, for every stage.

    F is the feature map of kernels/spaces.py: x / l on lines, (cos x, sin x) / l on circles.
    """

    profile: str  # name of kappa
    # lines, circles: columns of x that it depends on, as indices
    lines: slice | list[int]
    circles: slice | list[int]
    scales: Array  # (lines + circles,) inverse length scales, lines first
    centre: Array  # (lines,) of the controls on the lines: differences of far points would lose digits
    right: Array  # (S, D + 1, C): (F, 1) times it, plus |F|^2 of the lines, is the squared distance from the controls
    weights: Array  # (S, C, n) their momenta times the kernel's output matrix

    @property
    def size(self) -> int:
        """Number C of controls."""
        return self.weights.shape[1]

    @property
    def features(self) -> Array:
        """(S, C, D) F of the controls."""
        return -0.5 * self.right[:, :-1].swapaxes(1, 2)

    def velocity_and_jacobian(self, stage: int, x: Array) -> tuple[Array, Array]:
        """(N, n) -> v (N, n), Dv (N, n, n).

        Dv = 2 sum_j kappa'_j w_j (F - F_j)^T DF.
        """
        F, r2 = squared_distances(self, stage, x, NUMPY)
        (N, n), D = x.shape, F.shape[1]
        kappa, derivative = FORMULAS[self.profile](r2, range(2))
        both = derivative @ self._products[stage]
        slope = 2.0 * (both[:, :n, None] * F[:, None, :] - both[:, n:].reshape(N, n, D))
        out, L = np.zeros((N, n, n)), len(self.centre)
        C = len(self.scales) - L
        out[..., self.lines] = slope[..., :L] * self.scales[:L]
        cosine, sine = F[:, None, L : L + C], F[:, None, L + C :]
        out[..., self.circles] += slope[..., L + C :] * cosine - slope[..., L : L + C] * sine
        return kappa @ self.weights[stage], out

    @cached_property
    def _products(self) -> Array:
        """w_j, then w_j F_j^T: (S, C, n + n D)."""
        outer = self.weights[..., :, None] * self.features[..., None, :]
        return np.concatenate([self.weights, outer.reshape(*outer.shape[:2], -1)], axis=-1)


@dataclass(frozen=True, eq=False)
class RecordedFlow:
    """A flow on R^n (angles unwrapped) with the Runge-Kutta stages of its controls."""

    size: int  # n
    steps: int  # number of equal steps
    coefficients: Array  # (s, s), and below (s,): those of the method, times the length of a step
    weights: Array
    terms: tuple[RadialTerm, ...]  # sums over the controls
    tables: JointTables | None = None  # functions of single joints, added to their own components; None without any

    @property
    def vanishes(self) -> bool:
        """Whether the flow is the identity."""
        return not self.terms and self.tables is None

    def __call__(self, x: Array) -> Array:
        """The flow of points (N, n)."""
        return np.concatenate([advanced(self, some, NUMPY) for some in self._blocks(x)])

    def with_jacobian(self, x: Array) -> tuple[Array, Array]:
        """The flow (N, n) and its Jacobian (N, n, n)."""
        points, slopes = zip(*map(self._with_jacobian, self._blocks(x)), strict=True)
        return np.concatenate(points), np.concatenate(slopes)

    def _with_jacobian(self, x: Array) -> tuple[Array, Array]:
        M = np.broadcast_to(np.eye(self.size), (len(x), self.size, self.size))
        for step in range(self.steps):
            slopes: list[Array] = []
            turns: list[Array] = []
            for stage, row in enumerate(self.coefficients, step * len(self.weights)):
                v, dv = self.velocity_and_jacobian(stage, combined(x, row, slopes))
                slopes.append(v)
                turns.append(dv @ combined(M, row, turns))
            x, M = combined(x, self.weights, slopes), combined(M, self.weights, turns)
        return x, M

    def velocity_and_jacobian(self, stage: int, x: Array) -> tuple[Array, Array]:
        """v_s (N, n) and Dv_s (N, n, n)."""
        v, dv = np.zeros_like(x), np.zeros((*x.shape, self.size))
        for part in self.terms if self.tables is None else (*self.terms, self.tables):
            value, slope = part.velocity_and_jacobian(stage, x)
            v += value
            dv += slope
        return v, dv

    def _blocks(self, x: Array) -> Iterator[Array]:
        size = max(BLOCK // max([64, *(term.size for term in self.terms)]), 1)
        return (x[first : first + size] for first in range(0, max(len(x), 1), size))


def advanced(flow: Any, x: Any, use: Any) -> Any:
    """The end of the flow of points (N, n), by the constants of a :class:`RecordedFlow` as arrays of a library."""
    for step in range(flow.steps):
        slopes: list[Any] = []
        for row in flow.coefficients:
            at, stage = use.combined(x, row, slopes), step * len(flow.weights) + len(slopes)
            distances = ((term, squared_distances(term, stage, at, use)[1]) for term in flow.terms)
            parts = [next(FORMULAS[term.profile](r2, (0,), use)) @ term.weights[stage] for term, r2 in distances]
            if flow.tables is not None:
                parts.append(tabulated(flow.tables, stage, at, use)[0] @ flow.tables.selection)
            slopes.append(sum(parts[1:], parts[0]))
        x = use.combined(x, flow.weights, slopes)
    return x


def squared_distances(term: Any, stage: int, x: Any, use: Any) -> tuple[Any, Any]:
    """Features F of points: lines about the controls' centre, cosines, sines (N, D); |F - F_j|^2 (N, C)."""
    L, parts = len(term.centre), []
    if L:
        parts.append((x[..., term.lines] - term.centre) * term.scales[:L])
    if len(term.scales) > L:
        angles = x[..., term.circles]
        parts += [use.cos(angles) * term.scales[L:], use.sin(angles) * term.scales[L:]]
    F = use.concatenate([*parts, use.ones_like(x[..., :1])], -1)
    r2 = F @ term.right[stage]
    if L:
        r2 = r2 + (parts[0] * parts[0]).sum(-1)[..., None]
    return F[..., :-1], use.at_least(r2, SMALLEST_SQUARE)
