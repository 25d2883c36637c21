"""The columns of a CSV file by the kind of their rows: positions or poses, a ball in sockets, readings of devices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isnan
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, warn_user
from diffeo_calib.measurements.checks import unlikely_units
from diffeo_calib.measurements.csv.cells import BadCells, TextCells
from diffeo_calib.measurements.csv.columns import Columns, Values
from diffeo_calib.measurements.csv.tables import to_measurements
from diffeo_calib.measurements.readings import MILLIMETRES, Readings
from diffeo_calib.measurements.sockets import SEPARATOR, Distances
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import Names, TableFormat

ONE_READING = "every line is one reading of one device: fill the cell in, or remove the line"


class FileRows(NamedTuple):
    """Some lines of a file.

    Args:
        cells: its cells as text. columns: its columns of numbers. values: these in SI. lines: numbers of the lines.
        alone: whether all lines of the file hold rows of one kind, so that no cell may be empty.
    """

    cells: TextCells
    columns: Columns
    values: Values
    lines: list[int]
    alone: bool

    def of(self, chosen: Tensor) -> FileRows:
        """The lines that a mask (N,) chooses."""
        values = Values(*(None if value is None else value[chosen] for value in self.values))  # pyright: ignore
        return self._replace(values=values, lines=[self.lines[row] for row in chosen.nonzero()[:, 0].tolist()])

    def names(self, column: str | None, expected: str, fix: str = "fill it in") -> list[str] | None:
        """Names of devices or set-ups; None without a column, or where other kinds alone fill it."""
        if column is None or not (self.alone or any(self.cells.texts(column, self.lines, empty=True))):
            return None
        return self.cells.texts(column, self.lines, expected=expected, fix=fix)


class SensorColumns(Protocol):
    """The columns of rows of one kind."""

    @property
    def word(self) -> str:
        """Name of the contents of a row, such as "a position"."""
        ...

    def filled(self, rows: FileRows) -> Tensor:
        """(N,) boolean, which lines hold such a row; MeasurementError for lines that fill some of its cells."""
        ...

    def table(self, rows: FileRows) -> Any:
        """The rows of these lines, all of which hold one."""
        ...

    def own_lines(self, rows: FileRows) -> FileRows:
        """The line of every row."""
        ...


class OneLineEach:
    """Rows of one line."""

    def own_lines(self, rows: FileRows) -> FileRows:
        """See :class:`SensorColumns`."""
        return rows


@dataclass(frozen=True)
class PositionColumns(OneLineEach):
    """Measured positions or poses, whose columns are those of a table's :class:`Columns`.

    Args:
        session: column that names the set-up of every row; None for one. on: tips of the markers or frames.
    """

    session: str | None = None
    on: Sequence[str] | None = None
    word: str = field(default="a position", init=False)

    def filled(self, rows: FileRows) -> Tensor:
        """See :class:`SensorColumns`."""
        return ~rows.values.points.isnan().flatten(1).all(1)

    def table(self, rows: FileRows) -> Measurements:
        """See :class:`SensorColumns`."""
        data = to_measurements(rows.cells.path, rows.values, rows.lines, rows.columns).with_tips(self.on)
        return data.with_sessions(rows.names(self.session, "a name"), remounted=rows.columns.table.remounted)


@dataclass(frozen=True)
class SocketColumns(OneLineEach):
    """How a table names sockets.

    Args:
        names: of the columns, such as place and socket; the last one names the socket at its place.
        distances: known distances between sockets, m. distance_std: their standard deviation, m.
        on: name of the tip that carries the ball.
    """

    names: Sequence[str]
    distances: Distances | None = None
    distance_std: float | None = None
    on: str | None = None
    word: str = field(default="a socket", init=False)

    def filled(self, rows: FileRows) -> Tensor:
        """See :class:`SensorColumns`."""
        found = torch.tensor([bool(text) for text in self._texts(rows)], dtype=torch.bool, device=HOST)
        if not bool(found.any()):
            what, fix = f"file '{rows.cells.path}': no line names a socket", "leave `socket` out"
            raise MeasurementError.of(what, expected="some rows in sockets", fix=fix)
        return found

    def table(self, rows: FileRows) -> Measurements:
        """See :class:`SensorColumns`."""
        known = {"distances": self.distances, "distance_std": self.distance_std}
        data = Measurements.from_sockets(rows.values.q, self._texts(rows), rows.columns.joints, **known, doubt=False)
        return data.with_tips(None if self.on is None else [self.on])

    def _texts(self, rows: FileRows) -> list[str]:
        """The socket of each line, such as "front/0"; "" where its cells are empty, if they may be."""
        if not self.names:
            fix = "pass ['place', 'socket']"
            raise MeasurementError.of("`socket`", expected="names of columns", got="none", fix=fix)
        fix = "fill it in; lines without a socket hold a measured position, whose columns must be named (`position`)"
        said = {"expected": "the name of a place or socket", "fix": fix, "empty": not rows.alone}
        cells = list(zip(*(rows.cells.texts(name, rows.lines, **said) for name in self.names), strict=True))
        _check_whole(rows, self.names, [[bool(text) for text in row] for row in cells], "a name")
        return [SEPARATOR.join(row) if all(row) else "" for row in cells]


@dataclass(frozen=True)
class ReadingColumns(OneLineEach):
    """How a table holds readings.

    Args:
        kind: of the readings. values: name of their column, of two columns for images, or one number for all rows, in
            the unit of length of the table. Beside other kinds these are the rows that name a device.
        device: name of the column that names the device of each row; None for one device.
        offset_std: of the unknown zero of distances, m. intrinsics: fx, fy, cx, cy of the camera in pixels.
        std: names of columns with standard deviations, one or, of images, two, in the unit of the readings.
        on: name of the tip that carries the ball.
        unit: of readings of devices of your own that are no lengths, see :meth:`Readings.of`.
    """

    kind: str
    values: tuple[str, ...] | float
    device: str | None = None
    offset_std: float = 0.0
    intrinsics: tuple[float, float, float, float] = (1.0, 1.0, 0.0, 0.0)
    std: tuple[str, ...] = ()
    on: str | None = None
    unit: tuple[str, float] = MILLIMETRES

    @property
    def word(self) -> str:
        """See :class:`SensorColumns`."""
        return "an image" if self.kind == "image" else f"a {self.kind}"

    def filled(self, rows: FileRows) -> Tensor:
        """See :class:`SensorColumns`."""
        if isinstance(self.values, tuple):
            there = ~self._read(rows, self.values).isnan()
            _check_whole(rows, self.values, there.tolist(), "a number")
            found = there.all(1)
        elif self.device is None:
            fix = "name the column of its devices: the rows that name one hold this reading"
            raise MeasurementError.of(f"one {self.kind} for all rows beside rows of other kinds", fix=fix)
        else:
            names = rows.cells.texts(self.device, rows.lines, empty=True)
            found = torch.tensor([bool(name) for name in names], dtype=torch.bool, device=HOST)
        if not bool(found.any()):
            what = f"file '{rows.cells.path}': no line holds {self.word}"
            raise MeasurementError.of(what, expected="some rows of this kind", fix="leave its columns out")
        return found

    def table(self, rows: FileRows) -> Readings:
        """See :class:`SensorColumns`."""
        table, shape = rows.columns.table, (len(rows.lines), 1)
        if isinstance(self.values, tuple):
            seen = self._read(rows, self.values)
            if self.kind == "distance" and not self.offset_std:
                fix = "repair or remove these lines; distances with an unknown zero are displacements"
                _check_positive(rows, self.values, seen, "a distance above 0", fix)
        else:
            seen = torch.full(shape, self.values, dtype=torch.float64, device=HOST)
        std = self._read(rows, self.std) if self.std else None
        if std is not None:
            _check_positive(rows, self.std, std, "a positive standard deviation", "repair these lines")
        if self.kind == "distance":
            for text in unlikely_units("positions", float(seen.abs().max()), table.length, "length"):
                warn_user(f"file '{rows.cells.path}': {text}".replace("positions", "distances"))
        devices = rows.names(self.device, "the name of the device of this reading", ONE_READING)
        data = self._readings(rows, table, devices, seen, std)
        return data.with_tips(None if self.on is None else [self.on])

    def _readings(
        self, rows: FileRows, table: TableFormat, devices: list[str] | None, seen: Tensor, std: Tensor | None
    ) -> Readings:
        """The readings (N, r) in the units of the file."""
        q, joints, known = rows.values.q, rows.columns.joints, {"std": std, "doubt": False}
        if self.kind == "image":
            (fx, fy, cx, cy), r = self.intrinsics, seen.shape[1]
            known["std"] = None if std is None else std.expand(-1, r)
            return Readings.images(q, seen, devices, joints, focal=(fx, fy), centre=(cx, cy), **known)
        lengths, known["std"] = seen / table.per_metre, None if std is None else std / table.per_metre
        if self.kind == "height":
            return Readings.heights(q, lengths, devices, joints, **known)
        if self.kind == "distance":
            return Readings.distances(q, lengths, devices, joints, offset_std=self.offset_std, **known)
        per_value = table.per_metre if self.unit == MILLIMETRES else self.unit[1]
        known["std"] = None if std is None else std / per_value
        own = {"unit": self.unit, "numbers": seen.shape[1], **known}
        return Readings.of(self.kind, q, seen / per_value, devices, joints, **own)

    def _read(self, rows: FileRows, names: Sequence[str]) -> Tensor:
        """(N, c) numbers in the unit of the file, NaN where empty."""
        decimal, empty = rows.columns.table.decimal, not rows.alone
        return torch.stack(
            [rows.cells.numbers(name, rows.lines, decimal, ONE_READING, empty=empty) for name in names], 1
        )


@dataclass(frozen=True)
class TableColumns:
    """The columns of a table, of whatever kinds its rows are. Units are those of a :class:`TableFormat`.

    Args:
        joints: names of the joint columns in the robot's order, or the robot.
        position: names of the x, y and z columns of the marker, or one such triple per marker; None without positions.
        sockets: those of a ball in sockets. readings: those of each kind of reading, and of images (csv/images.py).
        session: column that names the set-up of the device that measures positions or poses.
        kinds: kind of every joint; by default those of the robot, or all revolute.
        on: names of the tips that carry the markers or frames, for a robot with several tips.
    """

    joints: Any
    position: Names | None = None
    sockets: SocketColumns | None = None
    readings: tuple[Any, ...] = ()
    session: str | None = None
    kinds: Sequence[str] | None = None
    on: Sequence[str] | None = None

    @property
    def sensors(self) -> list[SensorColumns]:
        """The columns of each kind."""
        positions = [] if self.position is None else [PositionColumns(self.session, self.on)]
        return [*positions, *([] if self.sockets is None else [self.sockets]), *self.readings]


def _check_whole(rows: FileRows, names: Sequence[str], there: Sequence[Sequence[bool]], expected: str) -> None:
    """Raise MeasurementError for a line that fills some of these columns alone."""
    for line, row in zip(rows.lines, there, strict=True):
        if any(row) and not all(row):
            what = f"file '{rows.cells.path}', line {line}, column '{names[list(row).index(False)]}'"
            raise MeasurementError.of(what, expected=expected, got="an empty cell", fix="fill it in")


def _check_positive(rows: FileRows, names: Sequence[str], seen: Tensor, expected: str, fix: str) -> None:
    """Raise MeasurementError for numbers (N, c) that are not positive, or missing."""
    bad = BadCells()
    for row, column in (~(seen > 0.0)).nonzero().tolist():
        value = float(seen[row, column])
        bad.add(rows.lines[row], names[int(column)], "" if isnan(value) else f"{value:g}")
    if bad.count:
        raise bad.error(Path(rows.cells.path), expected, fix)
