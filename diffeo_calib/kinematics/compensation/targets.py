"""Targets of a tool: poses, positions, or positions with the direction of one of its axes.

With the tool at (p, R) and the target at (p*, R*), the miss that is made small is

    f = 1/2 |p* - p|^2 + L^2 (1 - cos angle),

the angle being the one between R and R*, or between an axis a of the tool and its target a*: 1 - cos angle is the sum
of 1 - a . a* over the axes, those of a pose by half. For small angles f is 1/2 |p* - p|^2 + 1/2 (L angle)^2: the lever
L weighs orientation against position. f is smooth at every angle. With the
Jacobian columns (v_j, w_j) of the tool, its gradient and Hessian need no further derivative of the kinematics, for in
a chain of rigid bodies dv_j/dq_i = w_min(i,j) x v_max(i,j).

And the two kinematics that the searches work with, as functions of NumPy arrays: the calibrated tool, and a rough one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import isfinite
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, real_tensor
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.tool import ToolKinematics
from diffeo_calib.robots.se3 import rigid_poses
from diffeo_calib.robots.tree import Tree
from diffeo_calib.runtime.build import calibrated_chain

Array = np.ndarray


def cross(a: Array, b: Array) -> Array:
    """Cross products along the third dimension, (N, T, 3, ...) each; many times faster than NumPy's for few rows."""
    x, y, z = a[:, :, 0], a[:, :, 1], a[:, :, 2]
    u, v, w = b[:, :, 0], b[:, :, 1], b[:, :, 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=2)


@dataclass(frozen=True, eq=False)
class Targets:
    """N rows with a target for each of T tools: their costs add up, and their errors stand side by side.

    An orientation says where A axes of a tool point: three for a pose, one for a direction, none for a position.
    """

    position: Array  # (N, T, 3) m
    axes: Array  # (N, T, 3, A) orthonormal columns, the directions of these axes
    tool_axes: Array  # (3, A) the axes in the frame of the tool
    lever: float  # L in m
    free: Array  # (N, T) True where a tool may be anywhere
    of_tips: bool = True  # whether they are those of all tips of a robot, else of the tool of a model
    along: Array | None = None  # (T, 3, 3) projectors on the directions in which shifts count; None for all

    def __len__(self) -> int:
        return len(self.position)

    @property
    def tools(self) -> int:
        """T."""
        return self.position.shape[1]

    def take(self, rows: Array) -> Targets:
        """The targets of some rows."""
        return replace(self, position=self.position[rows], axes=self.axes[rows], free=self.free[rows])

    @property
    def weight(self) -> float:
        """Weight of each axis: a turn by an angle moves two of three axes, but the single one of a direction."""
        return 0.5 if self.axes.shape[3] == 3 else 1.0

    @cached_property
    def across(self) -> Array:
        """(..., r, 3) unit vectors about which turns count: 3 of poses, 2 beside a single axis, 0 of positions."""
        count = self.axes.shape[3]
        if count != 1:
            return np.eye(3)[:count]
        axis = self.axes[..., 0]
        across = cross(axis, np.eye(3)[np.abs(axis).argmin(2)])
        across /= np.linalg.norm(across, axis=2, keepdims=True)
        return np.stack([across, cross(axis, across)], axis=2)

    def to_metres(self, length: float) -> Array:
        """(T k,) factors that make errors comparable, a turn of one radian counting as ``length`` m."""
        return np.array(([1.0] * 3 + [length / self.lever] * self.across.shape[-2]) * self.tools)

    def errors(self, poses: Array) -> Array:
        """Errors of poses (N, T, 4, 4), (N, T k) with k = 3 + r: p* - p in m, and L times the turn that remains.

        -slopes^T errors = grad f; zero where a tool is free.
        """
        turn = self.weight * cross(self._pointing(poses), self.axes).sum(3, keepdims=True)  # sin(angle) times its axis
        return self._joined(self._shift(poses)[..., None], turn)[..., 0]

    def slopes(self, jacobian: Array) -> Array:
        """Slopes by Jacobians (N, T, 6, n), (N, T k, n): the decrease of the errors, to first order near the target."""
        v = jacobian[:, :, :3]
        return self._joined(v if self.along is None else self.along @ v, jacobian[:, :, 3:])

    def cost(self, poses: Array) -> Array:
        """(N,) f in m^2, without cancellation near zero."""
        shift = self._shift(poses)
        return self._counted(0.5 * np.einsum("nti,nti->nt", shift, shift) + self.lever**2 * self._versine(poses)).sum(1)

    def misses(self, poses: Array) -> tuple[Array, Array | None]:
        """(N, T) distances in m, and angles in rad, None where only the position counts; zero where a tool is free."""
        distance = self._counted(np.linalg.norm(self._shift(poses), axis=2))
        angle = self._counted(2.0 * np.arcsin(np.sqrt(np.minimum(0.5 * self._versine(poses), 1.0))))
        return distance, angle if self.axes.shape[3] else None

    def curvature(self, jacobian: Array, poses: Array) -> Array:
        """(N, n, n) what the Hessian of f has beyond slopes^T slopes, for joints in a row from base to tip."""
        v, w = jacobian[:, :, :3], jacobian[:, :, 3:]  # (N, T, 3, n)
        shift, pointing, counted = self._shift(poses), self._pointing(poses), self.across @ w
        upper = -cross(shift[..., None], w).swapaxes(2, 3) @ v  # -(shift x w_i) . v_j
        cosine = (pointing * self.axes).sum((2, 3))[..., None, None]
        turns = w.swapaxes(2, 3)
        bent = cosine * (turns @ w) - (turns @ pointing) @ (turns @ self.axes).swapaxes(2, 3)
        upper += self.lever**2 * (self.weight * bent - counted.swapaxes(2, 3) @ counted)
        upper = self._counted(upper).sum(1)
        return np.triu(upper) + np.triu(upper, 1).swapaxes(1, 2)

    def _shift(self, poses: Array) -> Array:
        """(N, T, 3) p* - p as far as it counts, m."""
        shift = self.position - poses[..., :3, 3]
        return shift if self.along is None else (self.along @ shift[..., None])[..., 0]

    def _pointing(self, poses: Array) -> Array:
        """(N, T, 3, A) where the axes of each tool point."""
        return poses[..., :3, :3] @ self.tool_axes

    def _versine(self, poses: Array) -> Array:
        """(N, T) 1 - cos angle."""
        return 0.5 * self.weight * np.square(self._pointing(poses) - self.axes).sum((2, 3))

    def _counted(self, values: Array) -> Array:
        """Values (N, T, ...) of tools, zero where one is free."""
        values[self.free] = 0.0
        return values

    def _joined(self, shifts: Array, turns: Array) -> Array:
        """Shifts and turns (N, T, 3, n) -> (N, T k, n), zero where a tool is free."""
        parts = self._counted(np.concatenate([shifts, self.lever * (self.across @ turns)], axis=2))
        return parts.reshape(len(parts), parts.shape[1] * parts.shape[2], parts.shape[3])


def finite_rows(value: object, name: str, shape: tuple[int | str, ...], fix: str) -> Array:
    """A float64 array of finite numbers; see :func:`as_tensor`."""
    return as_tensor(value, name, shape, fix=fix, empty=True).detach().cpu().numpy()


AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def checked_targets(targets: Tensor, robot: Tree, rows: int, *, axis: object, tool_axis: str, lever: float) -> Targets:
    """Targets (N, 4, 4) or (N, 3) of one tool, or (N, T, 4, 4) or (N, T, 3) of all, NaN where a tool may be anywhere.

    Args:
        targets: as given. robot: with the T tips. rows: N.
        axis: for every target the direction (3,) in which one axis of the tool shall point, or None.
        tool_axis: that axis, "x", "y" or "z". lever: how orientation weighs against position, m.

    Raises:
        InputError: wrong shapes, another number of tips than the robot's, values that are not finite, no rigid
            transforms, no directions, or a row in which all tools are free.
    """
    fix = "pass one pose (4, 4) or one position (3,) for every row of `start`"
    if targets.ndim != 4 and not (targets.ndim == 3 and targets.shape[2] == 3):
        finite_rows(targets, "targets", (rows, 4, 4) if targets.ndim == 3 else (rows, 3), fix)
        parts = _parts(targets[:, None], axis, tool_axis, "row {}".format)
        return Targets(**parts, lever=lever, free=np.zeros((rows, 1), dtype=bool), of_tips=False)
    tips, shape = targets.shape[1], targets.shape[2:]
    if tips != len(robot.tips):
        fix = "pass one for every tip, NaN where a tip may be anywhere; or (N, 4, 4) or (N, 3) for the tip of the tool"
        raise InputError.of(f"`targets` of robot '{robot.name}'", expected=f"{len(robot.tips)} tips", got=tips, fix=fix)
    free = targets[..., :3, :].isnan().flatten(2).all(2) if len(shape) == 2 else targets.isnan().all(2)
    idle = free.all(1).nonzero()[:, 0].tolist()
    if idle:
        raise InputError.of(f"`targets`, row {idle[0]}: no tip has a target", fix="leave this row out")
    anywhere = torch.eye(4, dtype=targets.dtype, device=targets.device) if len(shape) == 2 else targets.new_zeros(3)
    filled = torch.where(free.reshape(*free.shape, *[1] * len(shape)), anywhere, targets)
    finite_rows(filled, "targets", (rows, tips, *shape), f"{fix} and every tip, NaN for a free tip")
    if axis is not None:
        given = real_tensor(axis, "axis")
        if given.shape != (rows, tips, 3):
            got, fix = tuple(given.shape), "pass one direction (3,) for every target"
            raise InputError.of("`axis` has the wrong shape", expected=(rows, tips, 3), got=got, fix=fix)
        upright = torch.tensor(AXES["z"], dtype=given.dtype, device=given.device)
        axis = torch.where(free[..., None].to(given.device), upright, given).flatten(0, 1)
    parts = _parts(filled, axis, tool_axis, lambda k: f"row {k // tips}, tip {k % tips}")
    return Targets(**parts, lever=lever, free=free.cpu().numpy())


def _parts(targets: Tensor, axis: object, tool_axis: str, place: Any) -> dict[str, Any]:
    """The arguments of :class:`Targets`, from finite poses (N, T, 4, 4) or positions (N, T, 3)."""
    shape, flat = targets.shape[:2], targets.flatten(0, 1)
    if targets.ndim == 4:
        if axis is not None:
            raise InputError.of("`axis` beside target poses, which say how all axes point", fix="leave it out")
        rigid = rigid_poses(flat, lambda k: f"`targets`, {place(k)}") if len(flat) else flat
        poses = rigid.detach().cpu().numpy().astype(np.float64).reshape(*shape, 4, 4)
        return {"position": poses[..., :3, 3], "axes": poses[..., :3, :3], "tool_axes": np.eye(3)}
    if not isinstance(tool_axis, str) or tool_axis not in AXES:
        raise InputError.of("`tool_axis`", expected="'x', 'y' or 'z'", got=as_written(tool_axis))
    position = targets.detach().cpu().numpy().astype(np.float64)
    if axis is None:
        return {"position": position, "axes": np.zeros((*shape, 3, 0)), "tool_axes": np.zeros((3, 0))}
    directions = _unit(real_tensor(axis, "axis"), len(flat), place).reshape(*shape, 3, 1)
    return {"position": position, "axes": directions, "tool_axes": np.array(AXES[tool_axis])[:, None]}


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


SOME_LENGTH = 0.5  # m that a radian counts as where directions of a robot without a finite reach are compared
MOST_TOOLS = 16  # tools of one model that are kept ready


@dataclass(frozen=True)
class ToolFunctions:
    """Kinematics of T tool centre points."""

    poses: Callable[[Array], Array]  # (N, n) joint values -> (N, T, 4, 4) m
    # (N, n) -> (N, T, 6, n), linear then angular velocity about the axes of the frame
    jacobian: Callable[[Array], Array]
    rough: Callable[[Array], Array]  # the same of the geometric part alone: off by about 1 mm, and much faster
    serial: bool  # whether every column belongs to one joint, in the order of the chain (no mimic joints)
    length: float  # m that a turn of one radian counts as where directions are compared: a quarter of the robot's reach


# the functions know the model's map but not the model, which would otherwise never be forgotten
_ready: WeakKeyDictionary[CalibratedKinematics, dict[object, ToolFunctions]] = WeakKeyDictionary()


def tool_functions(model: CalibratedKinematics, tools: Mapping[str, Tensor], frame: str) -> ToolFunctions:
    """Kinematics of tools (4, 4) on these tips in a frame, "base" or "measuring"; kept for later calls."""
    cache = _ready.setdefault(model, {})
    key = frame, *((tip, tool.numpy().tobytes()) for tip, tool in tools.items())
    if key in cache:
        return cache[key]
    if len(cache) >= MOST_TOOLS:
        cache.clear()
    robot, geometry, device = model.robot, model.geometry, model.configurations.device
    each = [ToolKinematics(model.map, model.nominal, tool, frame, tip) for tip, tool in tools.items()]

    def by_tool(of: Callable[[ToolKinematics, Tensor], Tensor], q: Array) -> Array:
        at = torch.from_numpy(q).to(device)
        return torch.stack([of(tool, at) for tool in each], 1).detach().cpu().numpy()

    start = geometry.base.numpy() if frame == "measuring" else np.eye(4)
    chain = calibrated_chain(robot.arrays, start, geometry.joint_errors.numpy(), np.zeros(6 + 6 * robot.moving))
    numbers, ends = [robot.tips.index(tip) for tip in tools], chain.tips.copy()
    ends[numbers] = ends[numbers] @ np.stack([tool.numpy() for tool in tools.values()])
    chain = replace(chain, tips=ends)
    poses, jacobian = (partial(by_tool, of) for of in (ToolKinematics.poses, ToolKinematics.jacobian))
    serial, length = robot.moving == robot.n, 0.25 * robot.reach if isfinite(robot.reach) else SOME_LENGTH
    return cache.setdefault(
        key, ToolFunctions(poses, jacobian, lambda q: chain.poses_and_jacobian(q)[1][:, numbers], serial, length)
    )
