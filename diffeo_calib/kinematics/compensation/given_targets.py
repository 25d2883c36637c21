"""Targets as users give them, checked."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import real_tensor
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.kinematics.compensation.bounds import finite_rows
from diffeo_calib.kinematics.compensation.several_tips import TargetsOfTips
from diffeo_calib.kinematics.compensation.targets import Array, Targets
from diffeo_calib.measurements.poses import rigid_poses
from diffeo_calib.robots.tree import Tree

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
