"""Robots from Denavit-Hartenberg tables, in the standard and in Craig's (modified) convention."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import cos, isfinite, sin

import torch
from torch import Tensor

from diffeo_calib.errors import RobotError, sentence
from diffeo_calib.robots.chain import Chain, Joint

CONVENTIONS = ("standard", "craig")
DH_KINDS = ("revolute", "prismatic")


@dataclass(frozen=True)
class DHRow:
    """One row of a table: one joint. Its value adds to ``theta`` (revolute) or to ``d`` (prismatic).

    Args:
        a: length along x [m].
        alpha: twist about x [rad].
        d: offset along z [m].
        theta: angle about z [rad].
        kind: ``"revolute"`` or ``"prismatic"``.
    """

    a: float
    alpha: float
    d: float
    theta: float = 0.0
    kind: str = "revolute"


def from_dh(
    rows: Sequence[DHRow | Sequence[float | str]],
    convention: str = "standard",
    names: Sequence[str] | None = None,
    name: str = "robot",
) -> Chain:
    """Build a chain from a Denavit-Hartenberg table.

    With Rz, Rx rotations and Tz, Tx translations, link l of the table moves by

        standard:  Rz(theta + q) Tz(d) Tx(a) Rx(alpha)
        craig:     Rx(alpha) Tx(a) Rz(theta + q) Tz(d)

    Args:
        rows: :class:`DHRow`, or sequences (a, alpha, d[, theta[, kind]]) [m, rad].
        convention: ``"standard"`` or ``"craig"`` (also called modified).
        names: one name per joint; ``joint_1`` ... without.
        name: the robot's name.

    Returns:
        The chain from ``"base"`` to ``"tip"``.

    Raises:
        RobotError: no row, a row of the wrong length, numbers that are not finite, unknown convention or kind,
            or another number of names than rows.
    """
    if convention not in CONVENTIONS:
        raise RobotError(sentence("`convention`", expected="'standard' or 'craig'", got=repr(convention)))
    table = [_row(row, index) for index, row in enumerate(rows)]
    if not table:
        raise RobotError(sentence("the DH table is empty", fix="pass one row (a, alpha, d) for each joint"))
    names = [f"joint_{index + 1}" for index in range(len(table))] if names is None else list(names)
    if len(names) != len(table):
        raise RobotError(sentence("`names`", expected=f"{len(table)} names, one for each row", got=str(len(names))))
    joints = []
    for row, joint_name in zip(table, names, strict=True):
        joints += _standard(row, joint_name) if convention == "standard" else _craig(row, joint_name)
    return Chain(name, "base", "tip", joints)


def _row(row: DHRow | Sequence[float | str], index: int) -> DHRow:
    """Check one row of the table and make it a DHRow of floats."""
    what = f"row {index} of the DH table"
    values = [getattr(row, field.name) for field in fields(row)] if isinstance(row, DHRow) else list(row)
    if not 3 <= len(values) <= 5:
        raise RobotError(sentence(what, expected="(a, alpha, d[, theta[, kind]])", got=f"{len(values)} entries"))
    kind = values[4] if len(values) == 5 else "revolute"
    if kind not in DH_KINDS:
        raise RobotError(sentence(f"the kind in {what}", expected="'revolute' or 'prismatic'", got=repr(kind)))
    try:
        numbers = [float(value) for value in values[:4]]
    except (TypeError, ValueError) as error:
        raise RobotError(sentence(what, expected="numbers [m, rad]", got=repr(values[:4]))) from error
    if not all(isfinite(number) for number in numbers):
        raise RobotError(sentence(what, expected="finite numbers", got=numbers, fix="correct this row"))
    return DHRow(*numbers, kind=str(kind))


def _standard(row: DHRow, name: str) -> list[Joint]:
    # The joint moves first: its frame is the one before the row, the rest of the row is fixed to what it moves.
    return [_moving(row, name, torch.eye(4, dtype=torch.float64)), _fixed(name, _about_z(row) @ _about_x(row))]


def _craig(row: DHRow, name: str) -> list[Joint]:
    return [_moving(row, name, _about_x(row)), _fixed(name, _about_z(row))]


def _moving(row: DHRow, name: str, origin: Tensor) -> Joint:
    return Joint(name, row.kind, origin, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def _fixed(name: str, origin: Tensor) -> Joint:
    return Joint(f"{name} (link)", "fixed", origin)


def _about_z(row: DHRow) -> Tensor:
    c, s = cos(row.theta), sin(row.theta)
    return torch.tensor([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, row.d], [0, 0, 0, 1]], dtype=torch.float64)


def _about_x(row: DHRow) -> Tensor:
    c, s = cos(row.alpha), sin(row.alpha)
    return torch.tensor([[1, 0, 0, row.a], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]], dtype=torch.float64)
