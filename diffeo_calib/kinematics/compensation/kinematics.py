"""The two kinematics that the search works with, as functions of NumPy arrays: the calibrated tool, and a rough one.

This is the only place of the search that knows where poses and Jacobians come from.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.compensation.targets import Array
from diffeo_calib.kinematics.tool import ToolKinematics
from diffeo_calib.robots.tree import Tree
from diffeo_calib.runtime.build import calibrated_chain

SOME_LENGTH = 0.5
"""m that a radian counts as where directions of a robot without a finite reach are compared."""
MOST_TOOLS = 16
"""Tools of one model that are kept ready."""


@dataclass(frozen=True)
class ToolFunctions:
    """Kinematics of T tool centre points.

    Args:
        poses: (N, n) joint values -> (N, T, 4, 4) m.
        jacobian: (N, n) -> (N, T, 6, n), linear then angular velocity about the axes of the frame.
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
    model: CalibratedKinematics, tools: Mapping[str, Tensor], frame: str
) -> tuple[ToolFunctions, ToolFunctions]:
    """Calibrated and rough kinematics of tools (4, 4) on these tips in a frame, "base" or "measuring".

    They are kept for later calls.
    """
    known = _ready.setdefault(model, {})
    key = frame, *((tip, tool.numpy().tobytes()) for tip, tool in tools.items())
    if key not in known:
        if len(known) >= MOST_TOOLS:
            known.clear()
        known[key] = _calibrated(model, tools, frame), _rough(model, tools, frame)
    return known[key]


def _shape(robot: Tree) -> tuple[bool, float]:
    return robot.moving == robot.n, 0.25 * robot.reach if isfinite(robot.reach) else SOME_LENGTH


def _calibrated(model: CalibratedKinematics, tools: Mapping[str, Tensor], frame: str) -> ToolFunctions:
    device = model.configurations.device
    each = [ToolKinematics(model.map, model.nominal, tool, frame, tip) for tip, tool in tools.items()]

    def by_tool(of: Callable[[ToolKinematics, Tensor], Tensor], q: Array) -> Array:
        at = torch.from_numpy(q).to(device)
        return torch.stack([of(tool, at) for tool in each], 1).detach().cpu().numpy()

    poses, jacobian = (partial(by_tool, of) for of in (ToolKinematics.poses, ToolKinematics.jacobian))
    return ToolFunctions(poses, jacobian, *_shape(model.robot))


def _rough(model: CalibratedKinematics, tools: Mapping[str, Tensor], frame: str) -> ToolFunctions:
    """Those of the geometric part of the calibrated kinematics: off by about 1 mm, and a hundred times faster."""
    geometry, robot = model.geometry, model.robot
    start = geometry.base.numpy() if frame == "measuring" else np.eye(4)
    errors = geometry.joint_errors.numpy()
    chain = calibrated_chain(robot.arrays, start, errors, np.zeros(6 + 6 * robot.moving), None)
    numbers, ends = [robot.tips.index(tip) for tip in tools], chain.tips.copy()
    ends[numbers] = ends[numbers] @ np.stack([tool.numpy() for tool in tools.values()])
    chain = replace(chain, tips=ends)
    return ToolFunctions(
        lambda q: chain.poses(q)[:, numbers], lambda q: chain.poses_and_jacobian(q)[1][:, numbers], *_shape(robot)
    )
