"""The columns of a CSV file by the kind of their rows: positions or poses, a ball in sockets, readings of devices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, few, shown, warn_user
from diffeo_calib.measurements.checks import of_measurements, unlikely_units
from diffeo_calib.measurements.csv.columns import DEVIATION, Check, Columns, Group
from diffeo_calib.measurements.csv.tables import FileRows
from diffeo_calib.measurements.pose_frames import inverse_poses, of_frames, transforms_of_frames
from diffeo_calib.measurements.poses import rotation_matrices, rotation_numbers
from diffeo_calib.measurements.readings import MILLIMETRES, Readings
from diffeo_calib.measurements.sockets import SEPARATOR, Distances
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat

ONE_READING = "every line is one reading of one device: fill the cell in, or remove the line"
LENGTH = Check(
    "a distance above 0", fix="repair or remove these lines; distances with an unknown zero are displacements"
)

Written = tuple[Mapping[Any, Tensor | None], Mapping[str, Sequence[str]], Tensor]
"""Rows as lines of a file: numbers in SI by what they are, texts by their column, and the row (M,) of each line."""


class SensorColumns:
    """The columns of rows of one kind; ``word``: name of the contents of a row, such as "a position"."""

    word: ClassVar[str]
    texts: Mapping[str, bool]
    """Columns of texts, and whether a table must have them."""

    def groups(self, table: TableFormat) -> tuple[Group, ...]:
        """The columns of numbers beside joints, positions, payloads and covariates."""
        return ()

    filled: Any
    """Lines -> (N,) boolean, which of them hold such a row."""
    table: Any
    """Lines, all of which hold one -> their rows."""
    written: Any
    """The inverse of ``table``; joints, payloads and covariates are those of the rows."""

    def own_lines(self, rows: FileRows) -> FileRows:
        """The line of every row."""
        return rows


@dataclass(frozen=True)
class PositionColumns(SensorColumns):
    """Measured positions or poses, whose columns a table's :class:`TableFormat` names."""

    form: TableFormat
    word = "a position"

    @property
    def texts(self) -> Mapping[str, bool]:
        own = self.form.session, self.form.marker and self.form.marker.partition("=")[0]
        return {name: True for name in own if name is not None}

    def filled(self, rows: FileRows) -> Tensor:
        return ~rows.values["points"].isnan().flatten(1).all(1)

    def own_lines(self, rows: FileRows) -> FileRows:
        """The first line of every row."""
        return self._with_markers(rows)[0]

    def table(self, rows: FileRows) -> Measurements:
        """MeasurementError for numbers that do not form a rotation."""
        rows, names = self._with_markers(rows)
        values, columns, table = rows.values, rows.columns, rows.columns.table
        q, joints, known = values["q"], columns.joints.texts, [values.get("std"), values.get("rotation_std")]
        if table.convention is None:
            data = Measurements(q, values["points"], joints, names, std=known[0], doubt=False)
        else:
            if len(columns.triples) == 1:
                known = [None if own is None else own[:, 0] for own in known]
            poses = of_frames(transforms_of_frames(_rotations(rows, table.convention), values["points"]))
            how = {"lever": table.lever, "position_std": known[0], "rotation_std": known[1]}
            data = Measurements.from_poses(q, poses, joints, **how, camera_on_tool=table.camera_on_tool, doubt=False)
        set_ups = rows.devices(self.form.session, "a name")
        return data.with_tips(self.form.on).with_sessions(set_ups, remounted=table.remounted)

    def _with_markers(self, rows: FileRows) -> tuple[FileRows, Sequence[str] | None]:
        """The rows, with (N, P, 3) of all markers, NaN where hidden, if a column names that of every line; these names.

        A row holds lines that follow each other with the same joint values, payload and session, of different markers.
        """
        if self.form.marker is None:
            return rows, None
        column, _, given = self.form.marker.partition("=")
        texts, values = rows.named(column, "the name of a marker"), rows.values
        names = given.split(",") if given else list(dict.fromkeys(texts))
        if unknown := [name for name in dict.fromkeys(texts) if name not in names]:
            what, fix = f"file '{rows.path}', column '{column}'", "remove their lines, or calibrate with all of them"
            raise MeasurementError.of(what, expected=f"markers of the model: {few(names)}", got=few(unknown), fix=fix)
        sessions = [""] * len(texts) if self.form.session is None else rows.texts[self.form.session]
        loads = values.get("payload", torch.zeros(len(texts), dtype=torch.float64, device=HOST))
        poses = list(zip(values["q"].tolist(), loads.tolist(), sessions, strict=True))
        numbers, first = list[int](), list[int]()
        for line, pose in enumerate(poses):
            if not first or pose != poses[first[-1]] or texts[line] in texts[first[-1] : line]:
                first.append(line)
            numbers.append(len(first) - 1)
        places = [names.index(text) for text in texts]
        of_rows = rows.of(torch.tensor(first, dtype=torch.int64, device=HOST))
        for key in {"points", "std"} & {*values}:
            own = torch.full((len(first), len(names), 3), torch.nan, dtype=torch.float64, device=HOST)
            own[numbers, places] = values[key][:, 0]
            of_rows = of_rows._replace(values={**of_rows.values, key: own})
        return of_rows, names

    def written(self, part: Any, table: TableFormat) -> Written:
        frames = part.frames if part.frames is None or part.board is None else inverse_poses(part.frames)
        values = {"points": part.points if frames is None else frames[..., :3, 3], "std": part.std}
        if frames is not None:
            values |= {"rotations": written_rotations(frames, table), "rotation_std": part.rotation_std}
        return values, {} if self.form.session is None else {self.form.session: part.device_names}, *part.index


def written_rotations(frames: Tensor, table: TableFormat) -> Tensor:
    """Rotations (N, T, k) of frames (N, T, 4, 4) as a table writes them."""
    convention, angle = table.convention or "rotvec", table.rotation_angle or "rad"
    return rotation_numbers(frames[..., :3, :3], convention, angle=angle)


def _rotations(rows: FileRows, convention: str) -> Tensor:
    """Rotations (N, T, 3, 3) of frames, NaN where hidden."""
    columns, lines = rows.columns, rows.lines
    numbers = rows.values["rotations"].unflatten(1, (len(columns.triples), -1))
    seen, count = ~numbers.isnan().any(2), numbers.shape[2]
    shown = seen.nonzero().tolist()

    def place(number: int) -> str:
        row, frame = shown[number]
        own = columns.rotation[frame * count : (frame + 1) * count]
        return f"file '{rows.path}', line {lines[row]}, columns {', '.join(own)}"

    found = numbers.new_full((*seen.shape, 3, 3), torch.nan)
    with of_measurements():
        found[seen] = rotation_matrices(numbers[seen], convention, angle=columns.rotation_unit, place=place)
    return found


@dataclass(frozen=True)
class SocketColumns(SensorColumns):
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
    word = "a socket"

    @property
    def texts(self) -> Mapping[str, bool]:
        if not self.names:
            fix = "pass ['place', 'socket']"
            raise MeasurementError.of("`socket`", expected="names of columns", got="none", fix=fix)
        return dict.fromkeys(self.names, True)

    def filled(self, rows: FileRows) -> Tensor:
        return torch.stack([rows.filled(name) for name in self.names]).any(0)

    def table(self, rows: FileRows) -> Measurements:
        fix = "fill it in; lines without a socket hold a measured position, whose columns must be named (`position`)"
        parts = [rows.named(name, "the name of a place or socket", fix) for name in self.names]
        names = [SEPARATOR.join(row) for row in zip(*parts, strict=True)]
        known = {"distances": self.distances, "distance_std": self.distance_std}
        data = Measurements.from_sockets(rows.values["q"], names, rows.columns.joints.texts, **known, doubt=False)
        return data.with_tips(None if self.on is None else [self.on])

    def written(self, part: Any, table: TableFormat) -> Written:
        return {}, {self.names[0]: part.row_sockets}, *part.index


@dataclass(frozen=True)
class ReadingColumns(SensorColumns):
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
        return "an image" if self.kind == "image" else f"a {self.kind}"

    @property
    def texts(self) -> Mapping[str, bool]:
        return {} if self.device is None else {self.device: True}

    def groups(self, table: TableFormat) -> tuple[Group, Group]:
        unit = None if self.kind == "image" else table.length if self.unit == MILLIMETRES else self.unit[1]
        check = LENGTH if self.kind == "distance" and not self.offset_std else None
        names = self.values if isinstance(self.values, tuple) else ()
        return Group(names, unit, check), Group(self.std, unit, DEVIATION)

    def filled(self, rows: FileRows) -> Tensor:
        if isinstance(self.values, tuple):
            return ~rows.values[self.groups(rows.columns.table)[0]].isnan().any(1)
        if self.device is None:
            fix = "name the column of its devices: the rows that name one hold this reading"
            raise MeasurementError.of(f"one {self.kind} for all rows beside rows of other kinds", fix=fix)
        return rows.filled(self.device)

    def table(self, rows: FileRows) -> Readings:
        q, joints, table = rows.values["q"], rows.columns.joints.texts, rows.columns.table
        own, own_std = self.groups(table)
        if isinstance(self.values, tuple):
            seen = rows.values[own]
        else:
            seen = own.to_si(torch.full((len(q), 1), self.values, dtype=torch.float64, device=HOST))
        devices = rows.devices(self.device, "the name of the device of this reading", ONE_READING)
        std = rows.values[own_std].expand_as(seen) if self.std else None
        given, known = (q, seen, devices, joints), {"std": std, "doubt": False}
        if self.kind == "image":
            data = Readings.images(*given, focal=self.intrinsics[:2], centre=self.intrinsics[2:], **known)
        elif self.kind == "distance":
            for text in unlikely_units("positions", own.from_si(seen), table.length, "length"):
                warn_user(f"file '{rows.path}': {text}".replace("positions", "distances"))
            data = Readings.distances(*given, offset_std=self.offset_std, **known)
        else:
            data = Readings.of(self.kind, *given, unit=self.unit, numbers=seen.shape[1], **known)
        return data.with_tips(None if self.on is None else [self.on])

    def written(self, part: Any, table: TableFormat) -> Written:
        own, std = self.groups(table)
        values = {own: part.reported} | ({std: part.reported_std} if self.std else {})
        return values, {} if self.device is None else {self.device: part.device_names}, *part.index


def sensors_of(table: TableFormat) -> list[SensorColumns]:
    """The columns of each kind of rows of a table."""
    positions = [] if table.position is None else [PositionColumns(table)]
    return [*positions, *([] if table.sockets is None else [table.sockets]), *table.readings]


def text_columns(table: TableFormat) -> dict[str, bool]:
    """The columns of texts, and whether a table must have them."""
    pairs = [pair for sensor in sensors_of(table) for pair in sensor.texts.items()]
    return {name: any(needed for other, needed in pairs if other == name) for name, _ in pairs}


def numeric_columns(table: TableFormat) -> Columns:
    """The columns of numbers.

    Raises:
        MeasurementError: no kind of rows, or options for something that is not measured.
    """
    sensors = sensors_of(table)
    _check_options(table, several=len(sensors) != 1)
    table = table if table.position is None else table.for_reading()
    readings = [(own, sensor.word) for sensor in sensors if (own := sensor.groups(table))]
    return Columns.of(table, readings, all_hidden=len(sensors) > 1)


def _check_options(table: TableFormat, *, several: bool) -> None:
    if not sensors_of(table):
        fix = "name the columns of the marker, or those of `socket`"
        raise MeasurementError.of("`position` is missing", fix=fix)
    if table.remounted and table.session is None:
        raise MeasurementError.of("`remounted` without `session`", fix="name the column of the set-ups too")
    if table.marker is not None and (several or len(table.triples) != 1 or table.rotation is not None):
        expected = "one position (x, y, z) in every line, and neither rotations, sockets nor readings"
        raise MeasurementError.of(f"`marker` ({shown(table.marker)})", expected=expected, fix="leave it out")
    options = "rotation", "rotation_std", "std", "camera_on_tool", "remounted", "session"
    names = [f"`{name}`" for name in options if getattr(table, name) not in (None, False)]
    if table.position is None and names:
        beside = "socket" if table.sockets is not None else "readings"
        fix = "leave it out: no position was measured; sockets of another set-up are other places"
        raise MeasurementError.of(f"{' and '.join(names)} beside `{beside}`", fix=fix)
