"""What a tool shall reach: poses, positions, or positions with the direction of one of its axes.

With the tool at (p, R) and the target at (p*, R*), the miss that is made small is

    f = 1/2 |p* - p|^2 + L^2 (1 - cos angle),

the angle being the one between R and R*, or between an axis a of the tool and its target a*. For small angles it is
1/2 |p* - p|^2 + 1/2 (L angle)^2: the lever L weighs orientation against position. f is smooth at every angle. With the
Jacobian columns (v_j, w_j) of the tool, its gradient and Hessian need no further derivative of the kinematics, for in
a chain of rigid bodies dv_j/dq_i = w_min(i,j) x v_max(i,j).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, real_tensor
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.measurements.poses import rigid_poses
from diffeo_calib.robots.tree import Tree

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


def finite_rows(value: object, name: str, shape: tuple[int | str, ...], fix: str) -> Array:
    """A float64 array of finite numbers; see :func:`as_tensor`."""
    return as_tensor(value, name, shape, fix=fix, empty=True).detach().cpu().numpy()


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


AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Pointing:
    """Directions in which one axis of the tool shall point, as given, and how orientation weighs against position.

    Args:
        axis: for every target a direction (3,), or None. tool_axis: "x", "y" or "z". lever: m.
    """

    axis: object
    tool_axis: str
    lever: float


def for_each_tip(targets: Tensor, robot: Tree) -> bool:
    """Whether the targets (N, T, 4, 4) or (N, T, 3) are those of all tips, rather than (N, 4, 4) or (N, 3) of one.

    Raises:
        InputError: another number of tips than the robot has.
    """
    if targets.ndim != 4 and not (targets.ndim == 3 and targets.shape[2] == 3):
        return False
    if targets.shape[1] != len(robot.tips):
        fix = "pass one for every tip, NaN where a tip may be anywhere; or (N, 4, 4) or (N, 3) for the tip of the tool"
        what = f"`targets` of robot '{robot.name}'"
        raise InputError.of(what, expected=f"{len(robot.tips)} tips", got=targets.shape[1], fix=fix)
    return True


def targets_of_tip(targets: Tensor, rows: int, pointing: Pointing) -> Targets:
    """Targets of one tool, (N, 4, 4) or (N, 3).

    Raises:
        InputError: wrong shapes, values that are not finite, no rigid transforms, no directions.
    """
    fix = "pass one pose (4, 4) or one position (3,) for every row of `start`"
    if targets.ndim == 3:
        finite_rows(targets, "targets", (rows, 4, 4), fix)
    else:
        finite_rows(targets, "targets", (rows, 3), fix)
    return Targets(**_parts(targets, pointing, "row {}".format))


def targets_of_tips(targets: Tensor, rows: int, pointing: Pointing) -> TargetsOfTips:
    """Targets of T tools, (N, T, 4, 4) or (N, T, 3), NaN where a tool may be anywhere.

    Raises:
        InputError: as for one tool, or a row in which all tools are free.
    """
    tips, one = targets.shape[1], targets.shape[2:]
    free = targets[..., :3, :].isnan().flatten(2).all(2) if len(one) == 2 else targets.isnan().all(2)
    idle = free.all(1).nonzero()[:, 0].tolist()
    if idle:
        raise InputError.of(f"`targets`, row {idle[0]}: no tip has a target", fix="leave this row out")
    anywhere = torch.eye(4, dtype=targets.dtype, device=targets.device) if len(one) == 2 else targets.new_zeros(3)
    filled = torch.where(free.reshape(*free.shape, *[1] * len(one)), anywhere, targets)
    fix = "pass one pose (4, 4) or one position (3,) for every row of `start` and every tip, NaN for a free tip"
    finite_rows(filled, "targets", (rows, tips, *one), fix)
    if pointing.axis is not None:
        given = real_tensor(pointing.axis, "axis")
        if given.shape != (rows, tips, 3):
            got, fix = tuple(given.shape), "pass one direction (3,) for every target"
            raise InputError.of("`axis` has the wrong shape", expected=(rows, tips, 3), got=got, fix=fix)
        upright = torch.tensor(AXES["z"], dtype=given.dtype, device=given.device)
        given = torch.where(free[..., None].to(given.device), upright, given).flatten(0, 1)
        pointing = replace(pointing, axis=given)
    parts = _parts(filled.flatten(0, 1), pointing, lambda k: f"row {k // tips}, tip {k % tips}")
    return TargetsOfTips(**parts, free=free.cpu().numpy())


def _parts(targets: Tensor, pointing: Pointing, place: Any) -> dict[str, Any]:
    """What :class:`Targets` is made of, from finite poses (R, 4, 4) or positions (R, 3)."""
    axis, tool_axis, lever = pointing.axis, pointing.tool_axis, pointing.lever
    if targets.ndim == 3:
        if axis is not None:
            raise InputError.of("`axis` beside target poses, which say how all axes point", fix="leave it out")
        found = rigid_poses(targets, lambda k: f"`targets`, {place(k)}") if len(targets) else targets
        poses = found.detach().cpu().numpy().astype(np.float64)
        return {"position": poses[:, :3, 3], "rotation": poses[:, :3, :3], "lever": lever}
    if not isinstance(tool_axis, str) or tool_axis not in AXES:
        raise InputError.of("`tool_axis`", expected="'x', 'y' or 'z'", got=as_written(tool_axis))
    position = targets.detach().cpu().numpy().astype(np.float64)
    if axis is None:
        return {"position": position, "lever": lever}
    directions = _unit(real_tensor(axis, "axis"), len(position), place)
    return {"position": position, "axis": directions, "tool_axis": np.array(AXES[tool_axis]), "lever": lever}


def _unit(given: Tensor, count: int, place: Any) -> Array:
    """Directions of any length, (R, 3), as unit vectors."""
    if given.ndim == 2 and given.numel():  # even one whose square overflows
        given = given / given.detach().abs().amax(1, keepdim=True).clamp(min=1.0)
    directions = finite_rows(given, "axis", (count, 3), "pass one direction (3,) for every target")
    largest = np.abs(directions).max(axis=1, initial=0.0)
    if (largest == 0).any():
        row = place(int(np.flatnonzero(largest == 0)[0]))
        raise InputError.of(f"`axis`, {row}", expected="a direction", got="(0, 0, 0)", fix="repair this row")
    directions = directions / largest[:, None]  # squares of huge or tiny numbers would overflow
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)
