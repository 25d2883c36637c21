"""Robots from Denavit-Hartenberg tables, in the standard and in Craig's (modified) convention; with branches, too."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite, pi
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import index_of
from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.errors import RobotError, as_written, sentence, warn_user
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.se3 import roll_pitch_yaw, transforms
from diffeo_calib.robots.tree import Chain, Ends, Tree

CONVENTIONS = ("standard", "craig")
DH_KINDS = ("revolute", "prismatic")
LARGEST_ANGLE_RAD = 4 * pi  # larger ones are probably in degrees
LONGEST_LINK_M = 20.0  # longer ones are probably in millimetres
ENTRIES, MOST_ENTRIES = "(a, alpha, d[, theta[, kind[, mimic[, mimic_offset]]]])", 7


@dataclass(frozen=True)
class DHRow:
    """One row of a table: one joint. Its value adds to ``theta`` (revolute) or to ``d`` (prismatic).

    Args:
        a: length along x [m].
        alpha: twist about x [rad].
        d: offset along z [m].
        theta: angle about z [rad].
        kind: ``"revolute"`` or ``"prismatic"``.
        mimic: for a mimic joint, names and multipliers of the joints that drive it; None for an active joint. See
            :class:`~diffeo_calib.robots.Joint`. A torso that stays upright has ``{"joint_2": -1.0, "joint_3": -1.0}``.
        mimic_offset: constant part of a mimic joint's value [rad or m].
        beta: Hayati's twist about y, after alpha, for axes that are nearly parallel to the next one [rad]; d is then 0
            by convention. (S. Hayati, M. Mirmirani, "Improving the absolute positioning accuracy of robot
            manipulators", 1985.)
        parent: number of the row that this one follows, -1 for the base; by default the row before it.
        lower, upper: limits of the joint [rad or m].
    """

    a: float
    alpha: float
    d: float
    theta: float = 0.0
    kind: str = "revolute"
    mimic: Mapping[str, float] | None = None
    mimic_offset: float = 0.0
    beta: float = field(default=0.0, kw_only=True)
    parent: int | None = field(default=None, kw_only=True)
    lower: float = field(default=-inf, kw_only=True)
    upper: float = field(default=inf, kw_only=True)


@outside_inference_mode
def from_dh(
    rows: Sequence[DHRow | Sequence[Any]],
    convention: str = "standard",
    names: Sequence[str] | None = None,
    name: str = "robot",
    tips: Mapping[str, int] | None = None,
) -> Tree:
    """Build a robot from a Denavit-Hartenberg table.

    With Rx, Ry, Rz rotations and Tz, Tx translations, link l of the table moves by

        standard:  Rz(theta + q) Tz(d) Tx(a) Rx(alpha) Ry(beta)
        craig:     Rx(alpha) Tx(a) Ry(beta) Rz(theta + q) Tz(d)

    Where the common normal of two nearly parallel axes is far away, makers' tables have d of hundreds of metres, which
    the next row takes back. The frame of a joint is then moved along its axis, next to the joint before it.

    Args:
        rows: :class:`DHRow`, or sequences (a, alpha, d[, theta[, kind[, mimic[, mimic_offset]]]]) [m, rad].
        convention: ``"standard"`` or ``"craig"`` (also called modified).
        names: one name per joint; by default ``joint_1``, ``joint_2``, ...
        name: the robot's name.
        tips: for a robot with branches, name of every tip -> number of its row. Other branches carry no markers
            but bend the robot by their weight, and their ends have the names of their joints. By default all ends are
            tips: ``"tip_1"``, ``"tip_2"``, ...

    Returns:
        The chain from ``"base"`` to ``"tip"``; a :class:`Tree` if rows branch or ``tips`` are named.

    Raises:
        RobotError: no row, a row of the wrong length, numbers that are not finite, unknown convention or kind, not one
            name per row, a row that follows itself or a later one, a tip that is no row, or a mimic that :class:`Joint`
            or :class:`Tree` refuses.

    Warns:
        DiffeoCalibWarning: links above 20 m, angles above 4 pi.
    """
    if convention not in CONVENTIONS:
        raise RobotError.of("`convention`", expected="'standard' or 'craig'", got=as_written(convention))
    if isinstance(rows, str) or not isinstance(rows, Iterable):
        raise RobotError.of("the DH table", expected=f"rows {ENTRIES}", got=as_written(rows))
    table = [_row(row, index) for index, row in enumerate(rows)]
    if not table:
        raise RobotError.of("the DH table is empty", fix="pass one row (a, alpha, d) for each joint")
    names = _names(names, len(table))
    parents = [index - 1 if row.parent is None else row.parent for index, row in enumerate(table)]
    joints, links = [], {-1: torch.eye(4, dtype=torch.float64, device="cpu")}
    for index, (row, joint_name) in enumerate(zip(table, names, strict=True)):
        about_z, about_x = _parts(row)
        before, after = (links[-1], about_z @ about_x) if convention == "standard" else (about_x, about_z)
        axis, place = (links[parents[index]] @ before)[:3, 2:].unbind(1)
        along = -axis @ place
        if float(along.abs()) > LONGEST_LINK_M:
            slide = torch.eye(4, dtype=torch.float64, device="cpu")
            slide[2, 3] = along
            before, after, place = before @ slide, torch.linalg.inv(slide) @ after, place + along * axis
        links[index] = after
        length = max(float(place.norm()), float(after[:3, 3].norm()) * (index not in parents))
        if length > LONGEST_LINK_M:
            what = f"row {index} of the DH table is {length:g} m long"
            warn_user(sentence(what, fix="divide lengths by 1000 if they are in mm"))
        driven = {"mimic": row.mimic, "mimic_offset": row.mimic_offset}
        joints += [
            Joint(joint_name, row.kind, before, lower=row.lower, upper=row.upper, **driven),  # the axis is z
            Joint(f"{joint_name} (link)", "fixed", after),
        ]
    ends = [index for index in range(len(table)) if index not in parents]
    if tips is None and len(ends) == 1:
        return Chain(name, "base", "tip", joints)
    named = {f"tip_{k + 1}": end for k, end in enumerate(ends)} if tips is None else _tips(tips, len(table))
    loads = {names[end]: end for end in ends if end not in named.values()}
    if taken := [tip for tip in named if tip in loads or tip in ("", "base")]:
        got = f"'{taken[0]}', which {'is another end' if taken[0] in loads else 'is no name'}"
        what, fix = "the name of a tip of the DH table", "choose other names"
        raise RobotError.of(what, expected="one of its own", got=got, fix=fix)
    # every row is two joints: a moving one after its parent's second, and a fixed one
    after = [number for index, parent in enumerate(parents) for number in (2 * parent + 1, 2 * index)]
    ends_of_rows, weighing = ({end: 2 * row + 1 for end, row in part.items()} for part in (named, loads))
    return Tree(name, "base", joints, after, Ends(ends_of_rows, weighing))


def _tips(tips: Mapping[str, int], rows: int) -> dict[str, int]:
    """Check names and rows of tips."""
    given = dict(tips) if isinstance(tips, Mapping) else {}
    numbers = {str(tip): row for tip, row in ((tip, index_of(row)) for tip, row in given.items()) if row is not None}
    if not given or len(numbers) < len(given) or not all(0 <= row < rows for row in numbers.values()):
        expected = f"names with numbers of rows, 0 to {rows - 1}"
        raise RobotError.of("`tips` of the DH table", expected=expected, got=as_written(tips))
    return numbers


def _names(names: Sequence[str] | None, rows: int) -> list[str]:
    """Check the names of joints."""
    if names is None:
        return [f"joint_{index + 1}" for index in range(rows)]
    given = list(names) if isinstance(names, Iterable) and not isinstance(names, str) else None
    if given is None or len(given) != rows:
        got = as_written(names) if given is None else str(len(given))
        raise RobotError.of("`names`", expected=f"{rows} names, one for each row", got=got)
    return given


def row_transform(row: DHRow) -> Tensor:
    """The transform (4, 4) of a row of the standard convention, its joint at zero [m]."""
    about_z, about_x = _parts(row)
    return about_z @ about_x


def _row(row: DHRow | Sequence[Any], index: int) -> DHRow:
    """Check one row of the table and make it a DHRow of floats."""
    what = f"row {index} of the DH table"
    if not isinstance(row, DHRow):
        values = list(row) if isinstance(row, Iterable) else [row]
        if not 3 <= len(values) <= MOST_ENTRIES:
            raise RobotError.of(what, expected=ENTRIES, got=f"{len(values)} entries")
        row = DHRow(*values)
    if row.kind not in DH_KINDS:
        raise RobotError.of(f"the kind in {what}", expected="'revolute' or 'prismatic'", got=as_written(row.kind))
    given = [row.a, row.alpha, row.d, row.theta, row.beta]
    try:
        a, alpha, d, theta, beta = numbers = [float(value) for value in given]
    except (TypeError, ValueError) as error:
        raise RobotError.of(what, expected="numbers [m, rad]", got=as_written(given)) from error
    if not all(isfinite(number) for number in numbers):
        raise RobotError.of(what, expected="finite numbers", got=numbers, fix="correct this row")
    angle = max(alpha, theta, beta, key=abs)
    if abs(angle) > LARGEST_ANGLE_RAD:
        warn_user(sentence(f"an angle in {what} is {angle:g} rad", fix="convert degrees: math.radians(90)"))
    parent = index_of(row.parent)
    if row.parent is not None and (parent is None or not -1 <= parent < index):
        expected = "the number of an earlier row, or -1 for the base"
        raise RobotError.of(f"the parent in {what}", expected=expected, got=as_written(row.parent))
    return replace(row, a=a, alpha=alpha, d=d, theta=theta, beta=beta, parent=parent)


def _parts(row: DHRow) -> tuple[Tensor, Tensor]:
    """Rz(theta) Tz(d) and Tx(a) Rx(alpha) Ry(beta)."""
    z, x = (torch.tensor(shift, dtype=torch.float64, device="cpu") for shift in ([0, 0, row.d], [row.a, 0, 0]))
    turn = roll_pitch_yaw(row.alpha, 0.0, 0.0) @ roll_pitch_yaw(0.0, row.beta, 0.0)
    return transforms(roll_pitch_yaw(0.0, 0.0, row.theta), z), transforms(turn, x)
