"""The columns of a table: which are wanted, their order, and their conversion between the file's units and SI.

Joint values are columns, expressions of columns, or those of a machine's commanded pose. ``-{J2}+90``, ``{J3}+{J2}`` or
``360/4096*{ticks5}-180`` is a sum of numbers, and of columns in braces times numbers, in the units of the table. Any
other text is the name of a column.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from math import degrees, pi
from pathlib import Path
from runpy import run_path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import DiffeoCalibError, MeasurementError, as_written, few, listed
from diffeo_calib.common.files import PROGRAM
from diffeo_calib.measurements.checks import of_measurements, unlikely_units
from diffeo_calib.measurements.csv.cells import repeated
from diffeo_calib.measurements.poses import readings_of, rotation_matrices, rotation_numbers
from diffeo_calib.measurements.table_format import (
    CONVENTIONS,
    MAKERS,
    SPHERICAL_UNITS,
    UNITS_PER_METRE,
    TableFormat,
    check_choice,
    column_names,
    numbers_of,
)
from diffeo_calib.robots.cartesian import cartesian, pose_inputs
from diffeo_calib.robots.joint import KINDS
from diffeo_calib.robots.se3 import transforms
from diffeo_calib.robots.tree import Chain

FACTOR = r"(?:\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?|pi|\{[^{}]+\})"
TERM = rf"{FACTOR}(?:\s*[*/]\s*{FACTOR})*"
EXPRESSION = re.compile(rf"\s*[+-]?\s*{TERM}(?:\s*[+-]\s*{TERM})*\s*")
COMPARED_ROWS, SAME_SHARE = 8, 1e-6
"""Rows of a function's output that are compared, and how alike they are, as a share of the largest coordinate."""
SIGNED_TERM = re.compile(rf"([+-]?)\s*({TERM})")
WITH_OPERATOR = re.compile(rf"([*/]?)\s*({FACTOR})")


@dataclass(frozen=True)
class JointExpressions:
    """The n joint values of a line as ``matrix @ cells + offset``, in the units of the table."""

    texts: tuple[str, ...]  # n names or expressions
    columns: tuple[str, ...]  # the c columns that they name, in order of their first appearance
    matrix: Tensor  # (n, c)
    offset: Tensor  # (n,)

    @classmethod
    def of(cls, texts: Sequence[str]) -> JointExpressions:
        """Parse names and expressions; MeasurementError for a product, or a column below a fraction line."""
        parsed = [_parsed(text) for text in texts]
        columns = tuple(dict.fromkeys(name for factors, _ in parsed for name in factors))
        rows = [[factors.get(name, 0.0) for name in columns] for factors, _ in parsed]
        matrix = torch.tensor(rows, dtype=torch.float64, device=HOST)
        offset = torch.tensor([constant for _, constant in parsed], dtype=torch.float64, device=HOST)
        return cls(tuple(texts), columns, matrix, offset)

    @property
    def plain(self) -> Tensor:
        """(n,) boolean, which joints are columns as they are."""
        return ((self.matrix == 1.0).sum(1) == 1) & ((self.matrix != 0.0).sum(1) == 1) & (self.offset == 0.0)

    def values(self, cells: Tensor) -> Tensor:
        """Cells (N, c) -> joint values (N, n)."""
        return cells @ self.matrix.mT + self.offset

    def cells(self, values: Tensor) -> Tensor:
        """The inverse of :meth:`values`; MeasurementError where the joints do not tell every column."""
        n, c = self.matrix.shape
        if n != c or int(torch.linalg.matrix_rank(self.matrix)) < n:
            what, fix = f"columns to be written, {listed(self.columns)}", "name one for each joint"
            raise MeasurementError.of(
                what, expected=f"columns that the joints determine, {listed(self.texts)}", fix=fix
            )
        return torch.linalg.solve(self.matrix, (values - self.offset).mT).mT


def _parsed(text: str) -> tuple[dict[str, float], float]:
    if "{" not in text or not EXPRESSION.fullmatch(text):
        return {text: 1.0}, 0.0
    factors, constant = dict[str, float](), 0.0
    for sign, term in SIGNED_TERM.findall(text):
        value, names = -1.0 if sign == "-" else 1.0, list[str]()
        for operator, factor in WITH_OPERATOR.findall(term):
            if factor.startswith("{"):
                names.append(factor[1:-1].strip() if operator != "/" else "")
            else:
                number = pi if factor == "pi" else float(factor)
                value = value * number if operator != "/" else value / number if number else torch.nan
        if len(names) > 1 or "" in names or not abs(value) < torch.inf:
            fix = "write sums of terms such as -0.5*{J2}, {J3}/2 and 90"
            raise MeasurementError.of(f"'{text}'", expected="a linear expression of columns", got=f"'{term}'", fix=fix)
        if names:
            factors[names[0]] = factors.get(names[0], 0.0) + value
        else:
            constant += value
    return factors, constant


@dataclass(frozen=True, eq=False)
class PoseColumns:
    """The columns of places, or of poses, and the joints of a machine that they tell; see :class:`JointExpressions`."""

    columns: tuple[str, ...]  # x, y, z and the numbers of a rotation; 1 to 3 of a place; or what a function takes
    # How the rotation is written; empty for places. Or FILE.py:NAME, a function of the cells (N, c) as they stand in
    # the table, a tensor, that returns places (N, k) or poses (N, 4, 4), in its unit of length.
    convention: str = ""
    robot: Chain | None = None  # the machine, see cartesian; None before the poses are read
    angle: str = "rad"  # unit of Euler angles and rotation vectors

    @classmethod
    def of(cls, text: str) -> PoseColumns:
        """Parse ``X,Y,Z``, ``X,Y,Z,A,B,C=CONVENTION``, or ``A,B,C=FILE.py:NAME``; MeasurementError for others."""
        names, equal, convention = text.rpartition("=") if "=" in text else (text, "", "")
        columns = tuple(name.strip() for name in names.split(","))
        if len(columns) > 3 and not equal:
            what = f"the columns of a pose, {text}"
            raise MeasurementError.of(what, expected=f"=CONVENTION behind them: {CONVENTIONS}", got="none")
        convention = MAKERS.get(convention.strip(), convention.strip())
        with of_measurements():
            count = 3 + numbers_of(convention) if equal and PROGRAM not in convention else len(columns)
        if len(columns) != count or "" in columns or repeated(columns):
            expected = f"{count} names of columns" if equal else "names of columns"
            raise MeasurementError.of(f"the columns of a pose, {text}", expected=expected, got=as_written(columns))
        return cls(columns, convention)

    @property
    def text(self) -> str:
        """What :meth:`of` parses."""
        return ",".join(self.columns) + f"={self.convention}" * bool(self.convention)

    @property
    def is_program(self) -> bool:
        """Whether a function makes the poses of the columns."""
        return PROGRAM in self.convention

    @property
    def written(self) -> PoseColumns:
        """Columns in which poses of the machine are written: these, but of a function what it returns."""
        if not self.is_program or self.robot is None:
            return self
        names = ("x", "y", "z", "rx", "ry", "rz")[: self.robot.n]
        return replace(self, columns=names, convention="rotvec" if self.robot.n == 6 else "")

    @property
    def texts(self) -> tuple[str, ...]:
        """Names of the joints; of the columns without a machine."""
        return self.columns if self.robot is None else self.robot.joint_names

    @property
    def plain(self) -> Tensor:
        """(n,) boolean, which joints are columns as they are."""
        return torch.tensor([not self.convention] * len(self.texts), dtype=torch.bool, device=HOST)

    def poses(self, cells: Tensor, per_metre: float = 1.0) -> Tensor:
        """Cells (N, c) -> poses (N, 4, 4), or places (N, k), in the unit of the table, or with so many of it in m."""
        made = _made(self.convention, cells) if self.is_program else cells
        if made.ndim == 3:
            return transforms(made[:, :3, :3], made[:, :3, 3] / per_metre)
        if self.is_program or not self.convention:
            return made / per_metre
        with of_measurements():
            place = "row {} of the commanded poses".format
            turns = rotation_matrices(cells[:, 3:], self.convention, angle=self.angle, place=place)
        return transforms(turns, cells[:, :3] / per_metre)

    def program_rows(self, cells: Tensor, poses: Tensor) -> tuple[tuple[float, ...], ...]:
        """Some of the cells (N, c) that a function took, and behind them what it made of them, m."""
        rows = torch.cat([cells, _flat(poses)], 1)[:: -(-len(cells) // COMPARED_ROWS)]
        return tuple(map(tuple, rows.tolist()))

    def check_program(self, kept: Sequence[Sequence[float]], per_metre: float) -> None:
        """Raise MeasurementError for another function than that whose :meth:`program_rows` a model keeps."""
        rows = torch.tensor(kept, dtype=torch.float64, device=HOST)
        cells, before = rows.tensor_split([len(self.columns)], 1)
        now = _flat(self.poses(cells, per_metre))
        if now.shape == before.shape and _alike(now, before):
            return
        got = f"one that makes {now.shape[1]} numbers of {len(self.columns)}"
        if now.shape == before.shape:
            away = (now - before).abs().amax(0)
            got = f"one whose places differ by up to {1e3 * float(away[-3:].max()):.3g} mm"
            got += "".join(f", directions by {degrees(float(turn)):.3g} degrees" for turn in away[:-3].sort()[0][-1:])
        what, expected = f"--robot-pose {self.text}", "the function that the model was fitted with"
        fix = "restore the file and the unit of what it returns (--length), or fit again"
        raise MeasurementError.of(what, expected=expected, got=got, fix=fix)

    def reread(self, table: Mapping[str, Tensor], per_metre: float) -> Iterator[tuple[Chain, Tensor, str]]:
        """Machine and joint values (N, n) of these columns in every other convention and unit, and its options.

        ``table``: the columns of a file with so many units of length per metre.
        """
        if not self.convention or self.is_program:
            return
        cells = torch.stack([table[name] for name in self.columns], 1)
        for convention, angle, turns in readings_of(cells[:, 3:]):
            poses = transforms(turns, cells[:, :3] / per_metre)
            if convention != self.convention or (cells.shape[1] == 6 and angle != self.angle):
                with suppress(DiffeoCalibError):  # turns that no machine has
                    text = f"--robot-pose {replace(self, convention=convention).text} --angle {angle}"
                    yield (machine := cartesian(poses)), pose_inputs(machine, poses), text

    def values(self, cells: Tensor) -> Tensor:
        """Cells (N, c) -> joint values (N, n), in the units of the table; without a machine the cells themselves."""
        if self.robot is None:
            return cells
        with of_measurements():
            q = pose_inputs(self.robot, self.poses(cells))
        return torch.cat([q[:, :3], q[:, 3:].rad2deg() if self.angle == "deg" else q[:, 3:]], 1)

    def cells(self, values: Tensor) -> Tensor:
        """The inverse of :meth:`values`; NaN stays NaN."""
        if self.robot is None or not self.convention:
            return values
        q = torch.cat([values[:, :3], values[:, 3:].deg2rad() if self.angle == "deg" else values[:, 3:]], 1)
        finite = q.isfinite().all(1, keepdim=True)
        poses = self.robot(q.where(finite, 0.0)).masked_fill(~finite[..., None], torch.nan)
        turns = rotation_numbers(poses[:, :3, :3], self.convention, angle=self.angle)
        return torch.cat([poses[:, :3, 3], turns], 1)


def _made(program: str, cells: Tensor) -> Tensor:
    """Poses (N, 4, 4) or places (N, k) that a function makes of cells (N, c); MeasurementError if it does not."""
    path, _, name = program.rpartition(":")
    function: Callable[[Tensor], Any] | None = _names(path).get(name)
    if function is None:
        raise MeasurementError.of(f"the file '{path}'", expected=f"a function {name}", got="none of this name")

    def made(rows: Tensor) -> Tensor:
        try:
            return torch.as_tensor(function(rows.clone()), dtype=cells.dtype, device=cells.device).detach()
        except (Exception, SystemExit) as error:
            got = f"{type(error).__name__}: {error}"
            raise MeasurementError.of(f"{program} of {len(rows)} rows", got=got) from error

    output = made(cells)
    places = output.ndim == 2 and 1 <= output.shape[1] <= 3
    if output.ndim == 0 or len(output) != len(cells) or not (places or output.shape[1:] == (4, 4)):
        expected = f"places ({len(cells)}, k) with k = 1, 2 or 3, or poses ({len(cells)}, 4, 4)"
        raise MeasurementError.of(f"what {program} returns", expected=expected, got=str(tuple(output.shape)))
    lost = (~output.isfinite().flatten(1).all(1)).nonzero()[:, 0].tolist()
    if lost:
        fix = "leave these rows out, or check the unit of their columns"
        raise MeasurementError.of(f"what {program} returns of row {few(lost)}", expected="finite numbers", fix=fix)
    some = torch.arange(0, len(cells), max(2, -(-len(cells) // COMPARED_ROWS)), device=cells.device).flip(0)
    again = made(cells[some])
    if again.shape != output[some].shape or not _alike(_flat(again), _flat(output[some])):
        got = "other numbers beside other rows, or each time"
        fix = "a function treats every row by itself, and draws nothing"
        raise MeasurementError.of(f"what {program} returns of a row", expected="always the same", got=got, fix=fix)
    return output


def _flat(poses: Tensor) -> Tensor:
    """Places (N, k) as they are; of poses (N, 4, 4) the axes of the frame, and behind them its place: (N, 12)."""
    return poses if poses.ndim == 2 else poses[:, :3].mT.flatten(1)


def _alike(now: Tensor, before: Tensor) -> bool:
    """Whether rows of :func:`_flat` are the same but for rounding."""
    size = torch.ones_like(before[0])
    size[-3:] = before[:, -3:].abs().max()
    return bool(((now - before).abs() <= SAME_SHARE * size).all())


@cache
def _names(path: str) -> dict[str, Any]:
    """What a file of Python defines, run once; it may import files beside it."""
    sys.path.append(str(Path(path).resolve().parent))
    try:
        return run_path(path, run_name=Path(path).stem)
    except OSError as error:
        fix = "check the path, relative to the current folder"
        raise MeasurementError.of(f"'{path}' cannot be read ({error.strerror})", fix=fix) from error
    except (Exception, SystemExit) as error:
        raise MeasurementError.of(f"'{path}' does not run", got=f"{type(error).__name__}: {error}") from error


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
