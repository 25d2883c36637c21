"""The kinematics file of Universal Robots' ROS packages, a YAML file with six transforms.

``ur_description`` builds its robot from it (urdf/ur_macro.xacro; the file of a robot's factory calibration is written
by the driver's package ``ur_calibration``): with the joints shoulder_pan, shoulder_lift, elbow, wrist_1, wrist_2,
wrist_3, all about the z axes of their frames,

    T_tool0(q) = Rz(pi) prod_l [ T(x_l, y_l, z_l, roll_l, pitch_l, yaw_l) Rz(q_l) ]       in base_link,

T(...) = translation times Rz(yaw) Ry(pitch) Rx(roll), as in a URDF's <origin>. The frames lie where those of an ideal
robot lie, each on its own calibrated axis, so that meshes fit; tool0 keeps its place on the last link.
"""

from __future__ import annotations

import hashlib
import re
from itertools import pairwise
from math import pi
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, RobotError, as_written
from diffeo_calib.common.files import write_whole
from diffeo_calib.interop.dh import links, on_axis, zero_frames
from diffeo_calib.interop.rigid import geometry_of
from diffeo_calib.interop.tables import origin_numbers
from diffeo_calib.interop.urdf import urdf_of
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.robots.dh import DHRow, row_transform
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import read_urdf

JOINTS = tuple(f"{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
BASE, TOOL = "base_link", "tool0"
ENTRIES = ("x", "y", "z", "roll", "pitch", "yaw")
HALF_TURN = row_transform(DHRow(0.0, 0.0, 0.0, pi))
OTHERS = "this format is for Universal Robots arms only: write a URDF (--urdf) instead"
TOOL_TOLERANCE = 1e-4
"""Largest distance, m, and angle, rad, between tool0 and the axis of the last joint: on these robots it lies on it."""


def write_ur_kinematics(
    kinematics: CalibratedKinematics | Geometry,
    path: str | PathLike[str],
    robot: str | PathLike[str] | None = None,
    *,
    hash: str | None = None,
) -> None:
    """Write the best rigid kinematics of a Universal Robots arm for its ROS packages.

    The file describes the robot in ROS (``kinematics_params`` of the launch files). The robot's controller keeps its
    own factory calibration: Cartesian commands that it solves itself do not change.

    Args:
        kinematics: a calibrated model, see :func:`rigid_kinematics`, or a geometry; its chain starts at base_link.
        path: the file to write.
        robot: the URDF, which tells where tool0 is, by default the one that the model was fitted with.
        hash: entry "hash", by which the driver compares the file with the controller's calibration: take that of the
            robot's own calibration file. Without it the driver reports that the file is not the controller's.

    Raises RobotError: not one of these robots, or a URDF without tool0. InputError: the model does not hold its URDF
    and ``robot`` is missing, a hash that is not one word, or the file cannot be written.
    """
    if hash is not None and not re.fullmatch(r"[A-Za-z]\w*", hash, re.ASCII):
        expected, fix = "letters, digits and _", "copy the entry hash of the robot's own calibration file: calib_..."
        raise InputError.of("`hash`", expected=expected, got=as_written(hash), fix=fix)
    geometry = geometry_of(kinematics)
    write_whole(path, ur_text(ur_transforms(geometry, urdf_of(geometry.chain, robot)), hash).encode())


def ur_transforms(geometry: Geometry, urdf: bytes) -> Tensor:
    """The six transforms of the file, (6, 4, 4) [m]; arguments as :func:`write_ur_kinematics`."""
    chain = geometry.chain
    prefix = _prefix(chain)
    try:
        robot = read_urdf(urdf, chain.base, prefix + TOOL, Path(f"the URDF of {chain.name}"))
    except RobotError as error:
        what = f"the URDF has no link '{prefix}{TOOL}' below '{chain.base}', with which the file's frames end"
        raise RobotError.of(what, got=str(error), fix="pass a URDF with it: `robot`, or --robot URDF") from error
    _, ideal, tool = zero_frames(Geometry.nominal(robot))
    frames, places = zero_frames(geometry)[1], _ideal_places(robot, ideal, tool)
    moved = (own @ torch.linalg.inv(was) @ place for own, was, place in zip(frames, ideal, places, strict=True))
    return torch.stack([torch.linalg.inv(before) @ after for before, after in pairwise([HALF_TURN, *moved])])


def ur_text(links: Tensor, hash: str | None) -> str:
    """The file's text for six transforms (6, 4, 4)."""
    lines = ["kinematics:"]
    for name, transform in zip(LINKS, links, strict=True):
        lines.append(f"  {name}:")
        xyz, rpy = origin_numbers(transform)
        for entry, value in zip(ENTRIES, [*xyz, *rpy], strict=True):
            text = repr(value)  # to YAML an exponent needs a decimal point before it
            lines.append(f"    {entry}: {text if '.' in text else text.replace('e', '.0e')}")
    own = hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]
    return "\n".join([*lines, f"  hash: {hash or f'diffeo_calib_{own}'}", ""])


def _prefix(chain: Tree) -> str:
    """Prefix of the names of a Universal Robots arm's joints and links; often empty."""
    names = chain.moving_names
    prefix = names[0].removesuffix(JOINTS[0])
    if names != tuple(prefix + name for name in JOINTS) or not bool(chain.revolute.all()) or chain.n != len(JOINTS):
        what = f"the joints of robot '{chain.name}'"
        raise RobotError.of(what, expected=", ".join(JOINTS), got=", ".join(names), fix=OTHERS)
    if chain.base != prefix + BASE:
        fix = f"calibrate with --base {prefix}{BASE}, where the file's transforms begin"
        raise RobotError.of(f"the base of robot '{chain.name}'", expected=prefix + BASE, got=chain.base, fix=fix)
    return prefix


def _ideal_places(robot: Tree, frames: list[Tensor], tool: Tensor) -> list[Tensor]:
    """The file's frames of the nominal robot in its base, all joints at zero: Craig's frames, tool0 the last."""
    rows, before, after = links(frames, robot.axes, tool, HALF_TURN)
    starts = zip([before, *after[:-1]], rows, strict=True)
    places = [frame @ row_transform(DHRow(0.0, 0.0, row.d, row.theta)) for frame, row in starts]
    places[-1] = on_axis(tool, frames[-1][:3, :3] @ robot.axes[-1], frames[-1][:3, 3])
    if (away := float((places[-1] - tool).abs().max())) > TOOL_TOLERANCE:
        what, expected = f"'{robot.tip}' of robot '{robot.name}'", "a frame on the axis of the last joint"
        raise RobotError.of(what, expected=expected, got=f"{away:.1e} beside it", fix=OTHERS)
    return places
