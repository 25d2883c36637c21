"""Targets of several tools at once, one on each tip of a robot: both hands of a torso, for instance."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from diffeo_calib.kinematics.compensation.targets import Array, Targets


@dataclass(frozen=True, eq=False)
class TargetsOfTips(Targets):
    """N rows with a target for each of T tools: their costs add up, and their errors stand side by side.

    Args:
        position, rotation, axis, tool_axis, lever: of the N T targets, those of a row adjacent; see :class:`Targets`.
        free: (N, T) True where a tool may be anywhere.
    """

    free: Array = field(kw_only=True)

    def __len__(self) -> int:
        return len(self.free)

    def take(self, rows: Array) -> TargetsOfTips:
        """The targets of some rows."""
        each = super().take(np.arange(self.free.size).reshape(self.free.shape)[rows].ravel())
        return replace(each, free=self.free[rows])  # pyright: ignore[reportReturnType]

    @property
    def pose_shape(self) -> tuple[int, ...]:
        """Shape of what the targets are compared with in a row: the poses of T tools."""
        return (self.free.shape[1], 4, 4)

    def to_metres(self, length: float) -> Array:
        """(T k,) factors that make errors comparable."""
        return np.tile(super().to_metres(length), self.free.shape[1])

    def errors(self, poses: Array) -> Array:
        """(N, T, 4, 4) -> (N, T k), zero where a tool is free."""
        return self._joined(super().errors(_each(poses)))

    def slopes(self, jacobian: Array, poses: Array) -> Array:
        """Of Jacobians (N, T, 6, n): (N, T k, n), zero where a tool is free."""
        return self._joined(super().slopes(_each(jacobian), _each(poses)))

    def independent(self, parts: Array) -> Array:
        """As for one tool, for each."""
        rows, tips = self.free.shape
        apart = parts.reshape(rows * tips, parts.shape[1] // tips, *parts.shape[2:])
        found = super().independent(apart)
        return found.reshape(rows, tips * found.shape[1], *parts.shape[2:])

    def cost(self, poses: Array) -> Array:
        """(N,) m^2."""
        return self._by_row(super().cost(_each(poses))).sum(1)

    def misses(self, poses: Array) -> tuple[Array, Array | None]:
        """(N, T) distances in m and angles in rad, zero where a tool is free."""
        distance, angle = super().misses(_each(poses))
        return self._by_row(distance), None if angle is None else self._by_row(angle)

    def curvature(self, jacobian: Array, poses: Array) -> Array:
        """(N, n, n)."""
        return self._by_row(super().curvature(_each(jacobian), _each(poses))).sum(1)

    def _by_row(self, values: Array) -> Array:
        """(N T, ...) -> (N, T, ...), zero where a tool is free."""
        values = values.reshape(*self.free.shape, *values.shape[1:])
        values[self.free] = 0.0
        return values

    def _joined(self, parts: Array) -> Array:
        """(N T, k, ...) -> (N, T k, ...)."""
        rows, tips = self.free.shape
        return self._by_row(parts).reshape(rows, tips * parts.shape[1], *parts.shape[2:])


def _each(values: Array) -> Array:
    """(N, T, ...) -> (N T, ...)."""
    return values.reshape(-1, *values.shape[2:])
