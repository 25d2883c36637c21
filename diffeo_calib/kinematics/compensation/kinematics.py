"""The two kinematics that the search works with, as functions of NumPy arrays: the calibrated tool, and a rough one.

This is the only place of the search that knows where poses and Jacobians come from.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.compensation.targets import Array, cross
from diffeo_calib.kinematics.program import program_of
from diffeo_calib.kinematics.tool import ToolKinematics
from diffeo_calib.robots.tree import Tree

SOME_LENGTH = 0.5
"""m that a radian counts as where directions of a robot without a finite reach are compared."""
MOST_TOOLS = 16
"""Tools of one model that are kept ready."""


@dataclass(frozen=True)
class ToolFunctions:
    """Kinematics of a tool centre point.

    Args:
        poses: (N, n) joint values -> (N, 4, 4) m.
        jacobian: (N, n) -> (N, 6, n), linear then angular velocity about the axes of the frame.
        serial: whether every column belongs to one joint, in the order of the chain (no mimic joints).
        length: m that a turn of one radian counts as where directions are compared: a quarter of the robot's reach.
    """

    poses: Callable[[Array], Array]
    jacobian: Callable[[Array], Array]
    serial: bool
    length: float


# the functions know the model's map but not the model, which would otherwise never be forgotten
_ready: WeakKeyDictionary[CalibratedKinematics, dict[object, tuple[ToolFunctions, ToolFunctions]]] = WeakKeyDictionary()


def tool_functions(
    model: CalibratedKinematics, tool: Tensor, frame: str, tip: str
) -> tuple[ToolFunctions, ToolFunctions]:
    """Calibrated and rough kinematics of a tool (4, 4) in a frame, "base" or "measuring", kept for later calls."""
    known = _ready.setdefault(model, {})
    key = (tool.numpy().tobytes(), frame, tip)
    if key not in known:
        if len(known) >= MOST_TOOLS:
            known.clear()
        known[key] = calibrated_tool(model, tool, frame, tip), rough_tool(model, tool, frame, tip)
    return known[key]


def functions_of_tips(model: CalibratedKinematics, tools: Tensor, frame: str) -> tuple[ToolFunctions, ToolFunctions]:
    """The same for one tool (T, 4, 4) on each of the robot's tips: poses (N, T, 4, 4), Jacobians (N, T, 6, n)."""
    pairs = [tool_functions(model, tool, frame, tip) for tip, tool in zip(model.robot.tips, tools, strict=True)]
    exact, rough = zip(*pairs, strict=True)
    return _together(exact), _together(rough)


def _together(tools: Sequence[ToolFunctions]) -> ToolFunctions:
    def poses(q: Array) -> Array:
        return np.stack([tool.poses(q) for tool in tools], axis=1)

    def jacobian(q: Array) -> Array:
        return np.stack([tool.jacobian(q) for tool in tools], axis=1)

    return ToolFunctions(poses, jacobian, all(tool.serial for tool in tools), tools[0].length)


def calibrated_tool(model: CalibratedKinematics, tool: Tensor, frame: str, tip: str) -> ToolFunctions:
    """The calibrated kinematics of a tool, by constants for NumPy where the model has them."""
    kinematics = ToolKinematics(model.map, model.nominal, tool, frame, tip)  # checks the frame
    found, place, device = program_of(model.map.deformation), tool.numpy(), model.configurations.device
    program = None if found is None else found.at(tip)

    def poses(q: Array) -> Array:
        if program is not None:
            return program.poses(q, place, frame)
        return kinematics.poses(torch.from_numpy(q).to(device)).cpu().numpy()

    def jacobian(q: Array) -> Array:
        if program is not None:
            return program.poses_and_jacobian(q, place, frame)[1]
        return kinematics.jacobian(torch.from_numpy(q).to(device)).detach().cpu().numpy()

    return ToolFunctions(poses, jacobian, model.robot.moving == model.robot.n, _typical_length(model.robot))


def rough_tool(model: CalibratedKinematics, tool: Tensor, frame: str, tip: str) -> ToolFunctions:
    """The geometric part of the calibrated kinematics: off by about 1 mm, and a hundred times faster."""
    geometry, chain = model.geometry, model.robot
    start = geometry.base.numpy() if frame == "measuring" else np.eye(4)
    path, end = chain.path_to(tip), chain.tip_offsets[chain.tips.index(tip)] @ tool
    offsets = (chain.offsets @ geometry.joint_errors)[path].numpy()
    walk = RigidChain(start, offsets, chain.axes[path].numpy(), chain.revolute[path].numpy(), end.numpy())
    coupling, constant = chain.coupling[path].numpy(), chain.coupling_offset[path].numpy()

    def poses(q: Array) -> Array:
        return walk(q @ coupling.T + constant)[1]

    def jacobian(q: Array) -> Array:
        return walk.jacobian(q @ coupling.T + constant) @ coupling

    return ToolFunctions(poses, jacobian, chain.moving == chain.n, _typical_length(chain))


def _typical_length(chain: Tree) -> float:
    return 0.25 * chain.reach if isfinite(chain.reach) else SOME_LENGTH


class RigidChain:
    """A chain of rigid bodies in NumPy, its axes turned to z beforehand.

    Args:
        start: (4, 4) base. offsets: (L, 4, 4) constant transforms before every joint. axes: (L, 3) unit vectors.
        revolute: (L,) False for slides. tip: (4, 4) constant transform after the last joint.
    """

    def __init__(self, start: Array, offsets: Array, axes: Array, revolute: Array, tip: Array) -> None:
        self.revolute = revolute
        constants, before = [], start
        for offset, axis in zip(offsets, axes, strict=True):
            turn = _turn_to(axis)
            constants.append(before @ offset @ turn)
            before = turn.T
        self.constants, self.tip = constants, before @ tip

    def __call__(self, q: Array) -> tuple[Array, Array]:
        """q (N, L) -> joint frames (N, L, 4, 4) whose z is the axis, poses of the tip (N, 4, 4)."""
        frames = np.empty((*q.shape, 4, 4))
        pose = np.broadcast_to(np.eye(4), (len(q), 4, 4))
        sine, cosine = np.sin(q)[:, :, None], np.cos(q)[:, :, None]
        for joint, constant in enumerate(self.constants):
            frames[:, joint] = pose = (pose.reshape(-1, 4) @ constant).reshape(-1, 4, 4)
            pose = pose.copy()
            if self.revolute[joint]:
                x, y, s, c = frames[:, joint, :, 0], frames[:, joint, :, 1], sine[:, joint], cosine[:, joint]
                pose[:, :, 0], pose[:, :, 1] = c * x + s * y, c * y - s * x
            else:
                pose[:, :, 3] += q[:, joint, None] * pose[:, :, 2]
        return frames, (pose.reshape(-1, 4) @ self.tip).reshape(-1, 4, 4)

    def jacobian(self, q: Array) -> Array:
        """q (N, L) -> (N, 6, L)."""
        frames, tip = self(q)
        places = frames[:, :, :3].swapaxes(1, 2)  # (N, 3, L, 4)
        axes = places[..., 2]
        linear = np.where(self.revolute, cross(axes, tip[:, :3, 3, None] - places[..., 3]), axes)
        return np.concatenate([linear, axes * self.revolute], axis=1)


def _turn_to(axis: Array) -> Array:
    """(4, 4) a rotation that turns z to a unit vector."""
    turn = np.eye(4)
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    turn[:3, 0] = side / np.linalg.norm(side)
    turn[:3, 1] = np.cross(axis, turn[:3, 0])
    turn[:3, 2] = axis
    return turn
