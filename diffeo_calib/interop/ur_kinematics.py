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
from diffeo_calib.interop.files import origin_numbers
from diffeo_calib.interop.rigid import rigid_kinematics
from diffeo_calib.interop.urdf import urdf_of
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.robots.dh import DHRow, row_transform
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import read_urdf

JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
BASE, TOOL = "base_link", "tool0"
ENTRIES = ("x", "y", "z", "roll", "pitch", "yaw")
HALF_TURN = row_transform(DHRow(0.0, 0.0, 0.0, pi))
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
    geometry = kinematics if isinstance(kinematics, Geometry) else rigid_kinematics(kinematics).geometry
    write_whole(path, ur_text(ur_transforms(geometry, urdf_of(geometry.chain, robot)), hash).encode())


def ur_transforms(geometry: Geometry, urdf: bytes) -> Tensor:
    """The six transforms of the file, (6, 4, 4) [m]; arguments as :func:`write_ur_kinematics`."""
    chain = geometry.chain
    prefix = _prefix(chain)
    ideal = Geometry.nominal(_to_tool(chain, urdf, prefix))
    _, ideal_frames, tool = zero_frames(ideal)
    places = _ideal_places(ideal, ideal_frames, tool)
    _, frames, _ = zero_frames(geometry)
    at = [
        HALF_TURN,
        *(own @ torch.linalg.inv(was) @ place for own, was, place in zip(frames, ideal_frames, places, strict=True)),
    ]
    return torch.stack([torch.linalg.inv(before) @ after for before, after in pairwise(at)])


def ur_text(links: Tensor, hash: str | None) -> str:
    """The file's text for six transforms (6, 4, 4)."""
    lines = ["kinematics:"]
    for name, transform in zip(LINKS, links, strict=True):
        xyz, rpy = origin_numbers(transform)
        values = zip(ENTRIES, [*xyz, *rpy], strict=True)
        lines += [f"  {name}:", *(f"    {entry}: {_number(value)}" for entry, value in values)]
    own = hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]
    return "\n".join([*lines, f"  hash: {hash or f'diffeo_calib_{own}'}", ""])


def _number(value: float) -> str:
    """A number as YAML reads it: an exponent needs a decimal point before it."""
    text = repr(value)
    return text if "e" not in text or "." in text else text.replace("e", ".0e")


def _prefix(chain: Tree) -> str:
    """Prefix of the names of a Universal Robots arm's joints and links; often empty."""
    fix = "this format is for Universal Robots arms only: write a URDF (--urdf) instead"
    names = chain.moving_names
    prefix = names[0].removesuffix(JOINTS[0])
    if names != tuple(prefix + name for name in JOINTS) or not bool(chain.revolute.all()) or chain.n != len(JOINTS):
        what = f"the joints of robot '{chain.name}'"
        raise RobotError.of(what, expected=", ".join(JOINTS), got=", ".join(names), fix=fix)
    if chain.base != prefix + BASE:
        fix = f"calibrate with --base {prefix}{BASE}, where the file's transforms begin"
        raise RobotError.of(f"the base of robot '{chain.name}'", expected=prefix + BASE, got=chain.base, fix=fix)
    return prefix


def _to_tool(chain: Tree, urdf: bytes, prefix: str) -> Tree:
    """The nominal robot up to tool0."""
    try:
        return read_urdf(urdf, chain.base, prefix + TOOL, Path(f"the URDF of {chain.name}"))
    except RobotError as error:
        what = f"the URDF has no link '{prefix}{TOOL}' below '{chain.base}', with which the file's frames end"
        raise RobotError.of(what, got=str(error), fix="pass a URDF with it: `robot`, or --robot URDF") from error


def _ideal_places(ideal: Geometry, frames: list[Tensor], tool: Tensor) -> list[Tensor]:
    """The file's frames of the nominal robot in its base, all joints at zero: Craig's frames, tool0 the last."""
    rows, before, after = links(frames, ideal.chain.axes, tool, HALF_TURN)
    places = [
        frame @ row_transform(DHRow(0.0, 0.0, row.d, row.theta))
        for frame, row in zip([before, *after[:-1]], rows, strict=True)
    ]
    axis = frames[-1][:3, :3] @ ideal.chain.axes[-1]
    places[-1] = on_axis(tool, axis, frames[-1][:3, 3])
    away = float((places[-1] - tool).abs().max())
    if away > TOOL_TOLERANCE:
        what = f"'{ideal.chain.tip}' of robot '{ideal.chain.name}'"
        fix = "this is no Universal Robots arm: write a URDF (--urdf) instead"
        raise RobotError.of(
            what, expected="a frame on the axis of the last joint", got=f"{away:.1e} beside it", fix=fix
        )
    return places
