"""The time-1 map of a recorded geodesic: fixed steps make the controls at every stage constants of the flow.

A passive point moves by x' = v_s(x), v_s(x) = sum_j K(x, q_sj) a_sj, its Jacobian by M' = Dv_s(x) M, with the stages s
of the Runge-Kutta run that moved the controls (flows/geodesic.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from diffeo_calib.runtime.arrays import Array, as_index
from diffeo_calib.runtime.tables import PROFILES, JointTables

BLOCK = 1 << 16
"""Largest number of kernel values that are held at once: they stay in the cache of the processor."""


@dataclass(frozen=True, eq=False)
class RadialTerm:
    """kappa(|F(x) - F(q_j)|^2) w_j summed over the controls, for every stage.

    F is the feature map of kernels/spaces.py: x / l on lines, (cos x, sin x) / l on circles.

    Args:
        profile: name of kappa.
        lines, circles: columns of x that it depends on.
        scales: (lines + circles,) inverse length scales, lines first.
        controls: (S, C, n) the controls q.
        weights: (S, C, n) their momenta times the kernel's output matrix.
    """

    profile: str
    lines: tuple[int, ...]
    circles: tuple[int, ...]
    scales: Array
    controls: Array
    weights: Array

    @property
    def size(self) -> int:
        """Number C of controls."""
        return self.controls.shape[1]

    def acts_alone_on(self, joint: int) -> bool:
        """Whether the term moves one circle by a function of its own angle."""
        return self.circles == (joint,) and not self.lines and not np.delete(self.weights, joint, axis=-1).any()

    def lift(self, x: Array) -> Array:
        """Features (..., D): lines about the controls' centre, cosines, sines."""
        lines, circles = self._columns
        parts = []
        if self.lines:
            parts.append((x[..., lines] - self.centre) * self._line_scales)
        if self.circles:
            angles = x[..., circles]
            parts += [np.cos(angles) * self._circle_scales, np.sin(angles) * self._circle_scales]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)

    def velocity(self, stage: int, x: Array) -> Array:
        """(N, n) -> (N, n)."""
        return self._profile(stage, self.lift(x)) @ self.weights[stage]

    def velocity_and_jacobian(self, stage: int, x: Array) -> tuple[Array, Array]:
        """(N, n) -> v (N, n), Dv (N, n, n).

        Dv = 2 sum_j kappa'_j w_j (F - F_j)^T DF.
        """
        F, (N, n) = self.lift(x), x.shape
        if self.profile == "gaussian":
            kappa = self._profile(stage, F)
            both = kappa @ self._products[stage]
            v, slope = both[:, :n], both[:, n:].reshape(N, n, F.shape[1]) - both[:, :n, None] * F[:, None, :]
        else:
            r2 = self._squares(stage, F)
            kappa, derivative, _ = PROFILES[self.profile](r2, slopes=True)
            v, both = kappa @ self.weights[stage], derivative @ self._products[stage]
            slope = 2.0 * (both[:, :n, None] * F[:, None, :] - both[:, n:].reshape(N, n, F.shape[1]))
        return v, self._pull(F, slope, n)

    def _profile(self, stage: int, F: Array) -> Array:
        """kappa at all controls: features (N, D) -> (N, C)."""
        if self.profile != "gaussian":
            return PROFILES[self.profile](self._squares(stage, F))[0]
        exponents = self._with_one(F) @ self._exponents[stage]
        if self.lines:
            exponents -= 0.5 * (F * F).sum(1, keepdims=True)
            np.minimum(exponents, 0.0, out=exponents)  # points that are absurdly far away lose all digits
        return np.exp(exponents, out=exponents)

    def _squares(self, stage: int, F: Array) -> Array:
        exponents = self._with_one(F) @ self._exponents[stage]
        squares = (F * F).sum(1, keepdims=True) if self.lines else 0.0
        return np.maximum(squares - 2.0 * exponents, 0.0)

    def _pull(self, F: Array, slope: Array, n: int) -> Array:
        """slope (N, n, D) times DF: (N, n, n)."""
        lines, circles = self._columns
        L, C = len(self.lines), len(self.circles)
        out = np.zeros((len(F), n, n))
        if L:
            out[..., lines] = slope[..., :L] * self._line_scales
        if C:
            cosine, sine = F[:, None, L : L + C], F[:, None, L + C :]
            out[..., circles] = slope[..., L + C :] * cosine - slope[..., L : L + C] * sine
        return out

    @staticmethod
    def _with_one(F: Array) -> Array:
        out = np.empty((len(F), F.shape[1] + 1))
        out[:, :-1], out[:, -1] = F, 1.0
        return out

    @cached_property
    def _columns(self) -> tuple[slice | list[int], slice | list[int]]:
        return as_index(self.lines), as_index(self.circles)

    @cached_property
    def centre(self) -> Array:
        """Centre of the controls on the lines: differences of far points would lose digits."""
        return self.controls[..., list(self.lines)].mean(axis=(0, 1))

    @cached_property
    def _line_scales(self) -> Array:
        return self.scales[: len(self.lines)]

    @cached_property
    def _circle_scales(self) -> Array:
        return self.scales[len(self.lines) :]

    @cached_property
    def features(self) -> Array:
        """(S, C, D) those of the controls."""
        return self.lift(self.controls)

    @cached_property
    def _exponents(self) -> Array:
        """(S, D + 1, C): (F, 1) times it is F . F_j - |F_j|^2 / 2, less |F|^2 / 2 where that is constant (circles)."""
        squares = 0.5 * (self.features**2).sum(-1)
        if not self.lines:
            squares = squares + 0.5 * (self._circle_scales**2).sum()
        return np.ascontiguousarray(np.concatenate([self.features.swapaxes(1, 2), -squares[:, None]], axis=1))

    @cached_property
    def _products(self) -> Array:
        """w_j, then w_j F_j^T: (S, C, n + n D)."""
        outer = self.weights[..., :, None] * self.features[..., None, :]
        return np.concatenate([self.weights, outer.reshape(*outer.shape[:2], -1)], axis=-1)


@dataclass(frozen=True, eq=False)
class RecordedFlow:
    """A flow on R^n (angles unwrapped) with the Runge-Kutta stages of its controls.

    Args:
        size: n.
        steps: number of equal steps.
        coefficients: (s, s), weights: (s,) of the method, for a step of length 1.
        terms: sums over the controls.
        tables: functions of single joints, added to their own components; None without any.
    """

    size: int
    steps: int
    coefficients: Array
    weights: Array
    terms: tuple[RadialTerm, ...]
    tables: JointTables | None = None

    @property
    def vanishes(self) -> bool:
        """Whether the flow is the identity."""
        return not self.terms and self.tables is None

    def __call__(self, x: Array) -> Array:
        """The flow of points (N, n)."""
        if self.vanishes:
            return x
        return np.concatenate([self._advance(x[rows], None)[0] for rows in self._blocks(len(x))])

    def with_jacobian(self, x: Array) -> tuple[Array, Array]:
        """The flow (N, n) and its Jacobian (N, n, n)."""
        M = np.broadcast_to(np.eye(self.size), (len(x), self.size, self.size))
        if self.vanishes:
            return x, M
        parts = [self._advance(x[rows], M[rows]) for rows in self._blocks(len(x))]
        return np.concatenate([p for p, _ in parts]), np.concatenate([m for _, m in parts])

    def velocity(self, stage: int, x: Array) -> Array:
        """v_s at points (N, n)."""
        total = np.zeros_like(x)
        for term in self.terms:
            total += term.velocity(stage, x)
        if self.tables is not None:
            total[:, self._tabulated] += self.tables.values(stage, x)
        return total

    def velocity_and_jacobian(self, stage: int, x: Array) -> tuple[Array, Array]:
        """v_s (N, n) and Dv_s (N, n, n)."""
        v, dv = np.zeros_like(x), np.zeros((*x.shape, self.size))
        for term in self.terms:
            value, slope = term.velocity_and_jacobian(stage, x)
            v += value
            dv += slope
        if self.tables is not None:
            value, slope = self.tables.derivatives(stage, x)
            v[:, self._tabulated] += value
            dv[:, self._diagonal, self._diagonal] += slope
        return v, dv

    def _advance(self, x: Array, M: Any) -> tuple[Array, Any]:
        """The end of the flow of x, and that of M' = Dv M; None for none."""
        coefficients, weights = self._scaled
        for step in range(self.steps):
            slopes: list[Array] = []
            turns: list[Array] = []
            for stage, row in enumerate(coefficients, step * len(weights)):
                at = combined(x, row, slopes)
                if M is None:
                    slopes.append(self.velocity(stage, at))
                    continue
                v, dv = self.velocity_and_jacobian(stage, at)
                slopes.append(v)
                turns.append(dv @ combined(M, row, turns))
            x, M = combined(x, weights, slopes), M if M is None else combined(M, weights, turns)
        return x, M

    def _blocks(self, rows: int) -> Iterator[slice]:
        largest = max((term.size for term in self.terms), default=64)
        size = max(BLOCK // max(largest, 64), 1)
        return (slice(first, first + size) for first in range(0, max(rows, 1), size))

    @cached_property
    def _scaled(self) -> tuple[list[list[float]], list[float]]:
        """Coefficients and weights of the steps as Python numbers."""
        return (self.coefficients / self.steps).tolist(), (self.weights / self.steps).tolist()

    @cached_property
    def _tabulated(self) -> slice | list[int]:
        return as_index(() if self.tables is None else self.tables.joints)

    @cached_property
    def _diagonal(self) -> list[int]:
        return [] if self.tables is None else list(self.tables.joints)


def combined(x: Array, coefficients: Iterable[float], slopes: Sequence[Array]) -> Array:
    """x + sum_k c_k slope_k."""
    for c, slope in zip(coefficients, slopes, strict=False):
        if c:
            x = x + c * slope
    return x
