"""The columns of a table: which are wanted, their order, and their conversion between the file's units and SI."""

from __future__ import annotations

import math
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
    UNITS_PER_METRE,
    ZERO,
    TableFormat,
    check_choice,
    column_names,
    flat_names,
)
from diffeo_calib.robots.joint import KINDS

Values = dict[Any, Tensor]
"""Numbers of the rows of a table in SI by the keys of :attr:`Columns.groups`."""


PER_SI = {**UNITS_PER_METRE, "rad": 1.0, "deg": 180.0 / math.pi, None: 1.0}
"""Units per rad or m; numbers without a unit are as they are."""


class Check(NamedTuple):
    """What numbers are expected to be; whether they may be zero; what to do about others."""

    expected: str
    zero: bool = False
    fix: str = "repair these lines, or leave this column out"


MASS = Check("a mass of 0 or more", zero=True)
DEVIATION = Check("a positive standard deviation")


class Group(NamedTuple):
    """Columns of numbers of one quantity."""

    names: tuple[str, ...]  # of the columns
    unit: str | float | None = None  # in the file: m, mm, rad, deg, or how many of it are one in SI; None without
    check: Check | None = None  # what the numbers are expected to be
    what: str = ""  # name of numbers whose unit is judged by their size

    def to_si(self, values: Tensor) -> Tensor:
        """Numbers in the unit of the file -> rad, m, or as they are."""
        return values / self.per_si

    def from_si(self, values: Tensor) -> Tensor:
        """The inverse of :meth:`to_si`, on the host, one row for each of the values (N, ...)."""
        return values.cpu().reshape(len(values), -1) * self.per_si

    @property
    def per_si(self) -> float:
        """Units per rad or m."""
        return self.unit if isinstance(self.unit, (int, float)) else PER_SI[self.unit]


class Hideable(NamedTuple):
    """Columns of values and of deviations that lines may leave empty together: their places; what they show."""

    values: list[int]
    deviations: list[int]
    word: str


Body = tuple[Sequence[Group], str]
"""The columns of a marker, frame or reading, and what lines do that fill them, such as "holds a distance"."""


@dataclass(frozen=True)
class Columns:
    """The wanted columns of a table."""

    table: TableFormat  # what it holds, and the units
    joints: JointExpressions | PoseColumns  # names or expressions of n joints, or the columns of a pose
    prismatic: Tensor  # (n,) which of them are prismatic
    kinds_known: bool  # whether the kinds of the joints were given; otherwise all are taken as revolute
    # of numbers: "q", those beside joints by what they hold, and what was measured by themselves
    groups: dict[Any, Group]
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
        for name, column in table.beside.items():
            column_names(name, [column], "the name of a column", (1,))
        given, groups = table.joints, list[Group]()
        for sensor in sensors:
            groups += [group for group in sensor.groups(table) if group not in groups]  # kinds may share deviations
        read = replace(given, angle=table.angle) if isinstance(given, PoseColumns) else JointExpressions.of(names)
        every = {"q": Group(read.columns)} | {group: group for group in groups if group.names}
        for name, column in table.beside.items():
            every[name] = Group((column.strip(),), check=MASS if name == "payload" else None)
        columns = cls(table, read, prismatic, kinds_known, every, sensors)
        alike = [name for place, group in enumerate(groups) if group in groups[:place] for name in group.names]
        named = [*columns.names, *alike]
        for _ in range(table.in_a_plane - 1):
            named.remove(ZERO)
        twice = repeated(named) or repeated(names)
        if twice:
            markers = len(table.triples)
            plain = len(columns.names) + len(alike) == len(names) + 3 * markers
            what = "`joints`" + " and `position`" * bool(markers) if plain else "the named columns"
            fix = "name every column once"
            deviations = {*twice} & {*flat_names(table.std), *flat_names(table.rotation_std)}
            fix += ", and one that holds the deviations of all axes alone" * bool(deviations)
            raise MeasurementError.of(what, expected="distinct columns", got=f"{listed(twice)} twice", fix=fix)
        return columns

    @property
    def names(self) -> list[str]:
        """All columns, joints first."""
        return [name for group in self.groups.values() for name in group.names]

    @property
    def texts(self) -> dict[str, bool]:
        """The columns of texts, and whether a table must have them."""
        pairs = [pair for sensor in self.sensors for pair in sensor.texts.items()]
        return {name: any(needed for other, needed in pairs if other == name) for name, _ in pairs}

    @property
    def all_hidden(self) -> bool:
        """Whether rows may show no marker, because they hold something else."""
        return len(self.sensors) > 1

    @property
    def hideable(self) -> list[Hideable]:
        """The columns of every body that lines may leave empty, markers and frames first.

        Deviations are values where there are no others.
        """
        found, every = list[Hideable](), torch.arange(len(self.names), device=HOST)
        places = {group: own[0].tolist() for group, own in self.parts(every[None]).items()}
        for sensor in (one for one in self.sensors if self.all_hidden or one.hidden):
            for groups, word in sensor.bodies(self.table):
                known = [k for group in groups if group.check == DEVIATION for k in places.get(group, [])]
                values = [k for group in groups if group.check != DEVIATION for k in places.get(group, [])]
                found += [Hideable(values or known, known if values else [], word)] if values or known else []
        return found

    def to_si(self, raw: Tensor) -> Values:
        """Rows (N, c) in the units of the file as those of each group (N, columns), or (N,) beside joints."""
        found = self.parts(raw)
        values = {name: group.to_si(found[name]) for name, group in self.groups.items()}
        values["q"] = self.joints.values(found["q"]) / self._per_joint
        return values | {name: values[name][:, 0] for name in self.table.beside}

    def from_si(self, values: Mapping[Any, Tensor | None]) -> dict[str, list[float]]:
        """The cells of columns by name, of values in SI by what they are."""
        rows = {name: own for name, own in values.items() if own is not None}
        found = {"q": self.joints_from_si(rows.pop("q"))}
        found |= {name: self.groups[name].from_si(own) for name, own in rows.items()}
        pairs = [zip(self.groups[name].names, own.T.tolist(), strict=True) for name, own in found.items()]
        return {column: cells for pair in pairs for column, cells in pair}

    def joints_from_si(self, q: Tensor) -> Tensor:
        """Joint values (N, n) in rad and m as the cells (N, c) of their columns, in the file's units."""
        return self.joints.cells(q.cpu() * self._per_joint)

    @property
    def _per_joint(self) -> Tensor:
        """(n,) units per rad or m."""
        units = [self.table.joints_per_metre if slides else PER_SI[self.table.angle] for slides in self.prismatic]
        return torch.tensor(units, dtype=torch.float64, device=HOST)

    def unlikely_units(self, raw: Tensor) -> list[str]:
        """Sentences about values (N, c), in the file's units, that look as if they were in another unit."""
        found, table, plain = self.parts(raw), self.table, self.joints.plain
        q = self.joints.values(found["q"])[:, plain] if bool(plain.any()) else found["q"][:, :0]
        slide, known = self.prismatic[plain], self.kinds_known
        sentences = unlikely_units("angles", q[:, ~slide], table.angle, "angle", kinds_known=known)
        sentences += unlikely_units("prismatic joints", q[:, slide], table.joint_unit, "joint_length")
        for what, option in (("positions", "length"), ("rotations", "rotation_angle")):
            own = {key: group.unit for key, group in self.groups.items() if group.what == what}
            cells = torch.cat([found[key] for key in own] or [raw[:, :0]], 1)
            sentences += unlikely_units(what, cells, str(next(iter(own.values()), None)), option)
        return sentences

    def parts(self, raw: Tensor) -> Values:
        """The columns of each group of rows (N, c)."""
        return dict(zip(self.groups, raw.split([len(own.names) for own in self.groups.values()], dim=1), strict=True))


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
    if (
        not isinstance(joints, Collection)
        or isinstance(joints, str)
        or len(joints) == 0
        or not all(isinstance(name, str) for name in joints)
    ):
        expected, fix = "names of columns, or a robot", "pass a list such as ['q1', 'q2'], in the robot's order"
        raise MeasurementError.of("`joints`", expected=expected, got=as_written(joints), fix=fix)
    known = kinds is not None
    kinds = list(kinds) if known else ["revolute"] * len(joints)
    if len(kinds) != len(joints):
        expected = f"{len(kinds)} columns of joints, one for each of `kinds`"
        fix = "name a column for every joint of the robot, in its order"
        raise MeasurementError.of("`joints`", expected=expected, got=f"{len(joints)} ({listed(joints)})", fix=fix)
    for kind in kinds:
        check_choice("kinds", kind, [known for known in KINDS if known != "fixed"])
    prismatic = torch.tensor([kind == "prismatic" for kind in kinds], dtype=torch.bool, device=HOST)
    return tuple(name.strip() for name in joints), prismatic, known
