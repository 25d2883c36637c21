"""The columns of a table: which are wanted, their order, and their conversion between the file's units and SI."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, as_written, listed
from diffeo_calib.measurements.checks import unlikely_units
from diffeo_calib.measurements.csv.cells import repeated
from diffeo_calib.measurements.csv.joints import JointExpressions, PoseColumns
from diffeo_calib.measurements.table_format import (
    SPHERICAL_UNITS,
    UNITS_PER_METRE,
    TableFormat,
    check_choice,
    column_names,
)
from diffeo_calib.robots.joint import KINDS

PER_SI = {**UNITS_PER_METRE, **SPHERICAL_UNITS, None: 1.0}  # units per rad or m; numbers without a unit are as they are
POSITIONS, ROTATIONS, STD, ROTATION_STD = "positions", "rotations", "std", "rotation_std"
"""Roles of the columns of a marker or frame."""


class Check(NamedTuple):
    """What numbers are expected to be; whether they may be zero; what to do about others."""

    expected: str
    zero: bool = False
    fix: str = "repair these lines, or leave this column out"


MASS = Check("a mass of 0 or more", zero=True)
DEVIATION = Check("a positive standard deviation")


class Column(NamedTuple):
    """A column of numbers."""

    name: str
    unit: str | float | None = None  # in the file: m, mm, rad, deg, or how many of it are one in SI; None without
    check: Check | None = None  # what the numbers are expected to be
    role: str = ""  # what they say of a marker or frame

    @property
    def per_si(self) -> float:
        """Units per rad or m."""
        return self.unit if isinstance(self.unit, (int, float)) else PER_SI[self.unit]


class Body(NamedTuple):
    """The columns of a marker, frame or reading, and what lines do that fill them, such as "holds a distance".

    Lines may leave them empty together; not those of all bodies, without such words.
    """

    columns: Sequence[Column]
    word: str

    @property
    def values(self) -> list[Column]:
        """Those that hold no deviations; deviations where there are no others."""
        return [column for column in self.columns if column.check != DEVIATION] or [*self.columns]

    def of(self, role: str) -> list[Column]:
        """Those that have a role."""
        return [column for column in self.columns if column.role == role]


@dataclass(frozen=True)
class Columns:
    """The wanted columns of a table."""

    table: TableFormat  # what it holds, and the units
    joints: JointExpressions | PoseColumns  # names or expressions of n joints, or the columns of a pose
    prismatic: Tensor  # (n,) which of them are prismatic
    kinds_known: bool  # whether the kinds of the joints were given; otherwise all are taken as revolute
    numbers: tuple[Column, ...]  # of what was measured, then those beside
    sensors: Sequence[Any] = ()  # the columns of each kind of rows, see sensors.py

    @classmethod
    def of(cls, table: TableFormat, sensors: Sequence[Any] = ()) -> Columns:
        """Check names and kinds of columns; ``sensors``: the columns of what was measured.

        Raises:
            MeasurementError: not names, another number of kinds than names or unknown ones, a unit of prismatic joints
                without kinds, or a column named twice.
        """
        names, prismatic, kinds_known = _joint_columns(table.joints, table.kinds)
        if table.joint_length is not None and not kinds_known:
            what, fix = "`joint_length` without the kinds of the joints", "pass the robot, or `kinds`"
            raise MeasurementError.of(what, got="joints that are all taken as revolute", fix=fix)
        numbers = list[Column]()
        for sensor in sensors:
            new = [column for body in sensor.bodies(table) for column in body.columns]
            numbers += [column for column in new if column not in numbers or column.check != DEVIATION]  # may be shared
        for name, column in table.beside.items():
            column_names(name, [column], "the name of a column", (1,))
            numbers.append(Column(column.strip(), check=MASS if name == "payload" else None))
        given = table.joints
        read = replace(given, angle=table.angle) if isinstance(given, PoseColumns) else JointExpressions.of(names)
        columns = cls(table, read, prismatic, kinds_known, tuple(numbers), sensors)
        if twice := repeated(columns.names) or repeated(names):
            got, fix = f"{listed(twice)} twice", "name every column once, one of the deviations of all axes too"
            raise MeasurementError.of("the named columns", expected="distinct columns", got=got, fix=fix)
        return columns

    @property
    def names(self) -> list[str]:
        """All columns, joints first."""
        return [*self.joints.columns, *(column.name for column in self.numbers)]

    @property
    def texts(self) -> dict[str, bool]:
        """The columns of texts, and whether a table must have them."""
        pairs = sorted((pair for sensor in self.sensors for pair in sensor.texts.items()), key=lambda pair: pair[1])
        return dict(pairs)

    @property
    def all_hidden(self) -> bool:
        """Whether rows may show no marker, because they hold something else."""
        return len(self.sensors) > 1

    @property
    def hideable(self) -> list[Body]:
        """The columns of every body that lines may leave empty, markers and frames first."""
        some = [body for kind in self.sensors if self.all_hidden or kind.hidden for body in kind.bodies(self.table)]
        read = (body._replace(columns=self.read(body.columns)) for body in some)
        return [body for body in read if body.columns and body.word]

    def read(self, some: Sequence[Column]) -> list[Column]:
        """Those that the file has: a coordinate may be 0 in all rows."""
        return [column for column in some if column in self.numbers]

    def places(self, some: Sequence[Column]) -> list[int]:
        """Their places among all columns."""
        return [len(self.joints.columns) + self.numbers.index(column) for column in some]

    def cells(self, q: Tensor, numbers: Mapping[str, Tensor]) -> dict[str, list[float]]:
        """The cells of columns by name, of joint values (N, n) and of numbers (N,) by their columns, in SI."""
        joints = zip(self.joints.columns, self.joints_from_si(q).T.tolist(), strict=True)
        there = (column for column in self.numbers if column.name in numbers)
        cells = {column.name: (numbers[column.name].cpu() * column.per_si).tolist() for column in there}
        return dict(joints) | cells

    def joints_from_si(self, q: Tensor) -> Tensor:
        """Joint values (N, n) in rad and m as the cells (N, c) of their columns, in the file's units."""
        return self.joints.cells(q.cpu() * self.per_joint)

    @property
    def per_joint(self) -> Tensor:
        """(n,) units per rad or m."""
        units = [self.table.joints_per_metre if slides else PER_SI[self.table.angle] for slides in self.prismatic]
        return torch.tensor(units, dtype=torch.float64, device=HOST)

    def unlikely_units(self, raw: Tensor) -> list[str]:
        """Sentences about values (N, c), in the file's units, that look as if they were in another unit."""
        table, plain = self.table, self.joints.plain
        q = self.joints.values(raw[:, : len(self.joints.columns)])[:, plain] if bool(plain.any()) else raw[:, :0]
        slide, given = self.prismatic[plain], self.kinds_known
        sentences = unlikely_units("angles", q[:, ~slide], table.angle, "angle", kinds_known=given)
        sentences += unlikely_units("prismatic joints", q[:, slide], table.joint_unit, "joint_length")
        for role, option in ((POSITIONS, "length"), (ROTATIONS, "rotation_angle")):
            alike = [column for column in self.numbers if column.role == role]
            alike = [column for column in alike if column.unit == alike[0].unit]  # no angles of places
            sentences += unlikely_units(role, raw[:, self.places(alike)], str(alike[0].unit), option) if alike else []
        return sentences


def check_count(what: str, items: Sequence[object], count: int, each: str) -> None:
    """Raise MeasurementError unless there are ``count`` items."""
    if len(items) != count:
        got = f"{len(items)} ({listed([str(item) for item in items])})"
        raise MeasurementError.of(what, expected=count, got=got, fix=f"pass one per {each}")


def _joint_columns(joints: Any, kinds: Sequence[str] | None) -> tuple[tuple[str, ...], Tensor, bool]:
    """Names of the joints, which of them are prismatic, and whether that is known."""
    if isinstance(joints, PoseColumns):
        joints, kinds = joints.texts, kinds if joints.robot is None else joints.robot.kinds
    kinds = getattr(joints, "kinds", None) if kinds is None else kinds
    joints = getattr(joints, "joint_names", joints)  # a robot
    texts = isinstance(joints, Collection) and not isinstance(joints, str)
    if not texts or len(joints) == 0 or not all(isinstance(name, str) for name in joints):
        expected, fix = "names of columns, or a robot", "pass a list such as ['q1', 'q2'], in the robot's order"
        raise MeasurementError.of("`joints`", expected=expected, got=as_written(joints), fix=fix)
    of_each = ["revolute"] * len(joints) if kinds is None else list(kinds)
    if len(of_each) != len(joints):
        expected = f"{len(of_each)} columns, one for each of `kinds`, in the robot's order"
        raise MeasurementError.of("`joints`", expected=expected, got=f"{len(joints)} ({listed(joints)})")
    for kind in of_each:
        check_choice("kinds", kind, [allowed for allowed in KINDS if allowed != "fixed"])
    prismatic = torch.tensor([kind == "prismatic" for kind in of_each], dtype=torch.bool, device=HOST)
    return tuple(name.strip() for name in joints), prismatic, kinds is not None
