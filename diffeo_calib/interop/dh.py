"""Denavit-Hartenberg tables of rigid kinematics, standard or Craig's, with Hayati's parameter for parallel axes.

The poses of the tip in the robot's base are, for the rows of the table as :func:`from_dh` reads them,

    T(q) = base . from_dh(rows)(q) . tool.

Four numbers per joint describe how each joint axis lies to the one before. Where two axes are nearly parallel their
common normal is far away or undetermined (hundreds of metres for a milliradian): the row then keeps d = 0 and has a
second twist beta. What four numbers cannot hold of the first and of the last link is in ``base`` and ``tool``.

And the kinematics file of Universal Robots' ROS packages, whose frames follow from the same links.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import atan2, cos, hypot, pi, sin
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, RobotError, as_written
from diffeo_calib.common.files import write_whole
from diffeo_calib.interop.rigid import geometry_of
from diffeo_calib.interop.tables import check_units, in_unit, origin_numbers
from diffeo_calib.interop.urdf import urdf_of
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.tool import checked_tip
from diffeo_calib.measurements.csv.cells import csv_text
from diffeo_calib.robots.dh import CONVENTIONS, DHRow, from_dh, row_transform
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import transforms
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import read_urdf

PARALLEL_SINE = 0.05  # sine of the angle between two axes below which they are treated as nearly parallel (3 degrees)
COINCIDENT_AXES_M = 1e-14  # distance, m, below which two parallel axes are one
SHORT_PROJECTION = 0.01  # length of a projected direction, per length, below which another one is projected


@dataclass(frozen=True, eq=False)
class DHTable:
    """A Denavit-Hartenberg table with what it cannot hold."""

    names: Sequence[str]  # names of the moving joints, one per row
    rows: Sequence[DHRow]  # see :class:`DHRow` [m, rad]
    convention: str  # "standard" or "craig"
    base: Tensor  # (4, 4) from the robot's base to the frame before the first row [m]
    tool: Tensor  # (4, 4) from the frame after the last row to the tip [m]

    def chain(self) -> Tree:
        """The chain of the rows, without base and tool."""
        return from_dh(self.rows, self.convention, list(self.names))

    def poses(self, q: Tensor) -> Tensor:
        """Poses of the tip in the robot's base: q (N, n) [rad or m] -> (N, 4, 4) [m]."""
        return self.base @ self.chain()(q) @ self.tool


def dh_table(
    kinematics: CalibratedKinematics | Geometry, convention: str = "standard", tip: str | None = None
) -> DHTable:
    """Denavit-Hartenberg parameters of a calibrated model's best rigid kinematics, or of a geometry.

    Args:
        kinematics: a calibrated model, see :func:`rigid_kinematics`, or any geometry. Neither its base in the
            measuring frame nor its markers are part of the table.
        convention: "standard" or "craig" (also called modified).
        tip: at the end of the table, for a robot with several: its joints are those of the path to this tip.

    Raises InputError: another convention, several tips of which none is named, or mimic joints on the path that joints
    of another branch drive.
    """
    if convention not in CONVENTIONS:
        raise InputError.of("`convention`", expected="'standard' or 'craig'", got=as_written(convention))
    geometry = geometry_of(kinematics)
    chain = geometry.chain
    path, frames, end = zero_frames(geometry, tip)
    numbers, start, after = links(frames, chain.axes[path], end, torch.eye(4, dtype=torch.float64, device=HOST))
    moving = [joint for joint in chain.joints if joint.kind != "fixed"]
    joints, names = [moving[number] for number in path], [moving[number].name for number in path]
    if elsewhere := [joint.name for joint in joints if not set(joint.mimic or ()) <= set(names)]:
        what = f"{', '.join(elsewhere)}: driven by joints that are not on the path to the tip"
        raise InputError.of(what, expected="joints that follow one another", fix="export a URDF, C, torch or ONNX")
    rows = [
        replace(row, kind="revolute" if turns else "prismatic", mimic=joint.mimic, mimic_offset=joint.mimic_offset)
        for row, turns, joint in zip(numbers, chain.revolute[path].tolist(), joints, strict=True)
    ]
    tool = torch.linalg.inv(after[-1]) @ end
    if convention == "craig":
        tool = row_transform(replace(rows[-1], d=0.0, theta=0.0)) @ tool
        leading = [DHRow(0.0, 0.0, 0.0), *rows[:-1]]  # a joint's theta and d after the a, alpha, beta to its axis
        pairs = zip(leading, rows, strict=True)
        rows = [replace(row, a=before.a, alpha=before.alpha, beta=before.beta) for before, row in pairs]
    return DHTable(tuple(names), rows, convention, start, tool)


def write_dh(
    kinematics: CalibratedKinematics | Geometry,
    path: str | PathLike[str],
    convention: str = "standard",
    *,
    length: str = "m",
    angle: str = "rad",
    tip: str | None = None,
) -> None:
    """Write a Denavit-Hartenberg table as CSV; units are part of the columns' names.

    The rows ``base`` and ``tool`` hold the transforms before and after the table as a translation and roll, pitch, yaw
    (R = Rz(yaw) Ry(pitch) Rx(roll)); all other rows are joints.

    Args:
        kinematics, convention, tip: as :func:`dh_table`. path: the file to write.
        length: "m" or "mm". angle: "rad" or "deg".

    Raises InputError: another convention or unit, or a file that cannot be written.
    """
    check_units(length, angle)
    write_whole(path, dh_text(dh_table(kinematics, convention, tip), length, angle).encode())


def dh_text(table: DHTable, length: str, angle: str) -> str:
    """A table as CSV; see :func:`write_dh`."""
    mimics = any(row.mimic for row in table.rows)
    header = ["frame", "kind", f"a_{length}", f"alpha_{angle}", f"d_{length}", f"theta_{angle}", f"beta_{angle}"]
    header += [*(f"{name}_{length}" for name in "xyz"), *(f"{name}_{angle}" for name in ("roll", "pitch", "yaw"))]
    header += ["mimic", "mimic_offset (rad or m)"] if mimics else []

    def fixed(name: str, transform: Tensor) -> list[object]:
        xyz, rpy = origin_numbers(transform)
        return [name, "fixed", *[""] * 5, *in_unit(xyz, length), *in_unit(rpy, angle), *[""] * (2 * mimics)]

    rows = [fixed("base", table.base)]
    for name, row in zip(table.names, table.rows, strict=True):
        (a, d), (alpha, theta, beta) = in_unit((row.a, row.d), length), in_unit((row.alpha, row.theta, row.beta), angle)
        driven = " + ".join(f"{slope!r} {by}" for by, slope in (row.mimic or {}).items())
        follows = [driven, row.mimic_offset if driven else ""] if mimics else []
        rows.append([name, row.kind, a, alpha, d, theta, beta, *[""] * 6, *follows])
    return csv_text([header, *rows, fixed("tool", table.tool)])


def zero_frames(geometry: Geometry, tip: str | None = None) -> tuple[list[int], list[Tensor], Tensor]:
    """The moving joints on the path to a tip, their frames, errors included, and that of the tip, all joints at zero.

    Frames are in the robot's base. ``tip`` is named for a robot with several. Raises InputError: no such tip, or none.
    """
    chain = geometry.chain
    name = checked_tip(chain, tip)
    path = chain.path_to(name).tolist()
    frames = [torch.eye(4, dtype=torch.float64, device=HOST)]
    for joint in path:
        frames.append(frames[-1] @ chain.offsets[joint] @ geometry.joint_errors[joint])
    return path, frames[1:], frames[-1] @ chain.tip_offsets[chain.tips.index(name)]


def links(
    frames: Sequence[Tensor], axes: Tensor, tip: Tensor, start: Tensor
) -> tuple[list[DHRow], Tensor, list[Tensor]]:
    """Standard parameters of each joint, all at zero: n rows; the frame before the first; the frames after each.

    Args:
        frames: n frames of the joints (4, 4) [m]. axes: (n, 3) their axes. tip: (4, 4) frame of the tip.
        start: (4, 4); the first frame is on the first axis, next to it, with its x axis turned as little as possible.
    """
    lines = [(frame[:3, :3] @ axis, frame[:3, 3]) for frame, axis in zip(frames, axes, strict=True)]
    before = at = on_axis(start, *lines[0])
    rows, after = [], []
    for line in [*lines[1:], (tip[:3, 2], tip[:3, 3])]:
        row = _link(at, *line)
        if len(rows) == len(lines) - 1 and float(torch.linalg.cross(at[:3, 2], line[0]).norm()) <= PARALLEL_SINE:
            row = DHRow(0.0, 0.0, float(at[:3, 2] @ (line[1] - at[:3, 3])))  # the tool takes the rest
        at = at @ row_transform(row)
        rows.append(row)
        after.append(at)
    return rows, before, after


def _link(at: Tensor, direction: Tensor, point: Tensor) -> DHRow:
    """The row from a frame, whose z axis is one joint's axis, to the next axis."""
    R = at[:3, :3]
    u, v, w = (R.mT @ direction).tolist()
    x, y, z = (R.mT @ (point - at[:3, 3])).tolist()
    if hypot(u, v) > PARALLEL_SINE:
        theta = _forward(-v, u)  # along the common normal
        (_, v), (a, y) = _turned(u, v, -theta), _turned(x, y, -theta)
        return DHRow(a, atan2(-v, w), z - y * w / v, theta)
    foot_x, foot_y = x - z / w * u, y - z / w * v  # the next axis in the plane z = 0
    theta = _forward(foot_x, foot_y) if hypot(foot_x, foot_y) > COINCIDENT_AXES_M else 0.0
    (a, _), (u, v) = _turned(foot_x, foot_y, -theta), _turned(u, v, -theta)
    return DHRow(a, atan2(-v, w), 0.0, theta, beta=atan2(u, hypot(v, w)))


def on_axis(start: Tensor, direction: Tensor, point: Tensor) -> Tensor:
    """The frame on an axis, its z axis, that is next to another frame."""
    origin = point + direction * (direction @ (start[:3, 3] - point))
    x, y = (a - direction * (direction @ a) for a in (start[:3, 0], start[:3, 1]))
    x = x if float(x.norm()) > SHORT_PROJECTION else torch.linalg.cross(y, direction)
    x = x / x.norm()
    return transforms(torch.stack([x, torch.linalg.cross(direction, x), direction], 1), origin)


def _forward(x: float, y: float) -> float:
    """Angle of the line along (x, y) within 90 degrees of the x axis [rad]."""
    angle = atan2(y, x)
    return angle - pi if angle > pi / 2 else angle + pi if angle <= -pi / 2 else angle


def _turned(x: float, y: float, angle: float) -> tuple[float, float]:
    c, s = cos(angle), sin(angle)
    return c * x - s * y, s * x + c * y


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
    """Write the best rigid kinematics of a Universal Robots arm for its ROS packages: a YAML file of six transforms.

    ``ur_description`` builds its robot from it (urdf/ur_macro.xacro; the file of a robot's factory calibration is
    written by the driver's package ``ur_calibration``): with the joints shoulder_pan, shoulder_lift, elbow, wrist_1,
    wrist_2, wrist_3, all about the z axes of their frames,

        T_tool0(q) = Rz(pi) prod_l [ T(x_l, y_l, z_l, roll_l, pitch_l, yaw_l) Rz(q_l) ]       in base_link,

    T(...) = translation times Rz(yaw) Ry(pitch) Rx(roll), as in a URDF's <origin>. The frames lie where those of an
    ideal robot lie, each on its own calibrated axis, so that meshes fit; tool0 keeps its place on the last link.

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
    rows, before, after = links(ideal, robot.axes, tool, HALF_TURN)
    starts = zip(
        [before, *after[:-1]], rows, strict=True
    )  # the file's frames of an ideal robot: Craig's, tool0 the last
    places = [frame @ row_transform(DHRow(0.0, 0.0, row.d, row.theta)) for frame, row in starts]
    places[-1] = on_axis(tool, ideal[-1][:3, :3] @ robot.axes[-1], ideal[-1][:3, 3])
    if (away := float((places[-1] - tool).abs().max())) > TOOL_TOLERANCE:
        what, expected = f"'{robot.tip}' of robot '{robot.name}'", "a frame on the axis of the last joint"
        raise RobotError.of(what, expected=expected, got=f"{away:.1e} beside it", fix=OTHERS)
    frames = zip(zero_frames(geometry)[1], ideal, places, strict=True)
    moved = (now @ torch.linalg.inv(was) @ place for now, was, place in frames)
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
    checksum = hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]
    return "\n".join([*lines, f"  hash: {hash or f'diffeo_calib_{checksum}'}", ""])


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
