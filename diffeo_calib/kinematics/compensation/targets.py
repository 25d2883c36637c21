"""What a tool shall reach: poses, positions, or positions with the direction of one of its axes.

With the tool at (p, R) and the target at (p*, R*), the miss that is made small is

    f = 1/2 |p* - p|^2 + L^2 (1 - cos angle),

the angle being the one between R and R*, or between an axis a of the tool and its target a*. For small angles it is
1/2 |p* - p|^2 + 1/2 (L angle)^2: the lever L weighs orientation against position. f is smooth at every angle. With the
Jacobian columns (v_j, w_j) of the tool, its gradient and Hessian need no further derivative of the kinematics, for in
a chain of rigid bodies dv_j/dq_i = w_min(i,j) x v_max(i,j).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

Array = np.ndarray


def cross(a: Array, b: Array) -> Array:
    """Cross products along the second dimension, (N, 3, ...) each; many times faster than NumPy's for few rows."""
    x, y, z = a[:, 0], a[:, 1], a[:, 2]
    u, v, w = b[:, 0], b[:, 1], b[:, 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


@dataclass(frozen=True, eq=False)
class Targets:
    """Targets of N configurations.

    Args:
        position: (N, 3) m.
        rotation: (N, 3, 3) for poses, else None.
        axis: (N, 3) unit vectors for one axis of the tool, else None.
        tool_axis: (3,) that axis in the frame of the tool, a unit vector.
        lever: L in m.
    """

    position: Array
    rotation: Array | None = None
    axis: Array | None = None
    tool_axis: Array | None = None
    lever: float = 0.1

    def __len__(self) -> int:
        return len(self.position)

    def take(self, rows: Array) -> Targets:
        """The targets of some rows."""
        rotation, axis = (None if part is None else part[rows] for part in (self.rotation, self.axis))
        return replace(self, position=self.position[rows], rotation=rotation, axis=axis)

    @property
    def pose_shape(self) -> tuple[int, ...]:
        """Shape of what the targets are compared with in a row: the pose of one tool."""
        return (4, 4)

    @property
    def oriented(self) -> bool:
        """Whether the orientation counts."""
        return self.rotation is not None or self.axis is not None

    def to_metres(self, length: float) -> Array:
        """(k,) factors that make errors comparable, a turn of one radian counting as ``length`` m."""
        return np.array([1.0] * 3 + [length / self.lever] * 3 * self.oriented)

    def errors(self, poses: Array) -> Array:
        """(N, k) with k = 3 or 6: p* - p in m, and L times the turn that remains, such that -J^T errors = grad f."""
        shift = self.position - poses[:, :3, 3]
        if self.rotation is not None:
            turn = 0.5 * cross(poses[:, :3, :3], self.rotation).sum(2)  # sin(angle) times its axis
        elif self.axis is not None:
            turn = self.axis - self._pointing(poses)
        else:
            return shift
        return np.concatenate([shift, self.lever * turn], axis=1)

    def slopes(self, jacobian: Array, poses: Array) -> Array:
        """(N, k, n) the decrease of the errors with the joints, to first order near the target."""
        if not self.oriented:
            return jacobian[:, :3]
        turning = jacobian[:, 3:]
        if self.axis is not None:
            turning = cross(turning, self._pointing(poses)[:, :, None])
        return np.concatenate([jacobian[:, :3], self.lever * turning], axis=1)

    def independent(self, parts: Array) -> Array:
        """Errors (N, 6) or slopes (N, 6, n) of a direction in five coordinates; others are returned as they are."""
        if self.axis is None:
            return parts
        first = np.eye(3)[np.abs(self.axis).argmin(1)]
        across = cross(self.axis, first)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        basis = np.stack([across, cross(self.axis, across)], axis=1)  # (N, 2, 3), both perpendicular to the target
        stacked = parts[:, 3:] if parts.ndim == 3 else parts[:, 3:, None]
        turned = basis @ stacked
        return np.concatenate([parts[:, :3], turned if parts.ndim == 3 else turned[:, :, 0]], axis=1)

    def cost(self, poses: Array) -> Array:
        """(N,) f in m^2, without cancellation near zero."""
        shift = self.position - poses[:, :3, 3]
        cost = 0.5 * np.einsum("ni,ni->n", shift, shift)
        return cost + self.lever**2 * self._versine(poses) if self.oriented else cost

    def misses(self, poses: Array) -> tuple[Array, Array | None]:
        """(N,) distance in m, and (N,) angle in rad, None where only the position counts."""
        distance = np.linalg.norm(self.position - poses[:, :3, 3], axis=1)
        if not self.oriented:
            return distance, None
        return distance, 2.0 * np.arcsin(np.sqrt(np.minimum(0.5 * self._versine(poses), 1.0)))

    def curvature(self, jacobian: Array, poses: Array) -> Array:
        """(N, n, n) what the Hessian of f has beyond slopes^T slopes, for joints in a row from base to tip."""
        v, w = jacobian[:, :3], jacobian[:, 3:]  # (N, 3, n)
        shift = self.position - poses[:, :3, 3]
        upper = -cross(shift[:, :, None], w).swapaxes(1, 2) @ v  # -(shift x w_i) . v_j
        if self.rotation is not None:
            away = poses[:, :3, :3] @ self.rotation.swapaxes(1, 2)
            trace = np.trace(away, axis1=1, axis2=2)[:, None, None]
            turns = w.swapaxes(1, 2) @ w
            upper += self.lever**2 * (0.5 * (trace * turns - w.swapaxes(1, 2) @ away @ w) - turns)
        if self.axis is not None:
            z = self._pointing(poses)
            cosine = np.einsum("ni,ni->n", z, self.axis)[:, None, None]
            along, aimed = np.einsum("nij,ni->nj", w, z), np.einsum("nij,ni->nj", w, self.axis)
            turns = w.swapaxes(1, 2) @ w
            whole = cosine * turns - along[:, :, None] * aimed[:, None, :]
            upper += self.lever**2 * (whole - (turns - along[:, :, None] * along[:, None, :]))
        return np.triu(upper) + np.triu(upper, 1).swapaxes(1, 2)

    def _pointing(self, poses: Array) -> Array:
        """(N, 3) the axis of the tool."""
        return poses[:, :3, :3] @ self.tool_axis

    def _versine(self, poses: Array) -> Array:
        """(N,) 1 - cos angle."""
        if self.rotation is not None:
            return 0.25 * np.square(poses[:, :3, :3] - self.rotation).sum((1, 2))
        return 0.5 * np.square(self._pointing(poses) - self.axis).sum(1)
