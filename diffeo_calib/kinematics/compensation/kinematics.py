"""The two kinematics that the search works with, as functions of NumPy arrays: the calibrated tool, and a rough one.

This is the only place of the search that knows where poses and Jacobians come from.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.compensation.targets import Array
from diffeo_calib.kinematics.program import program_of
from diffeo_calib.kinematics.tool import ToolKinematics
from diffeo_calib.robots.tree import Tree
from diffeo_calib.runtime.build import calibrated_chain, nominal_chain

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
    geometry, robot, number = model.geometry, model.robot, model.robot.tips.index(tip)
    start = geometry.base.numpy() if frame == "measuring" else np.eye(4)
    nominal, errors = nominal_chain(robot.to_config()), geometry.joint_errors.numpy()
    chain = calibrated_chain(nominal, start, errors, np.zeros(6 + 6 * robot.moving), None)
    chain = replace(chain, tips=chain.tips @ tool.numpy())

    def poses(q: Array) -> Array:
        return chain.poses(q)[:, number]

    def jacobian(q: Array) -> Array:
        return chain.poses_and_jacobian(q)[1][:, number]

    return ToolFunctions(poses, jacobian, robot.moving == robot.n, _typical_length(robot))


def _typical_length(chain: Tree) -> float:
    return 0.25 * chain.reach if isfinite(chain.reach) else SOME_LENGTH
