"""The columns of a CSV file by the kind of their rows: positions or poses, sockets, readings of devices, images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, as_written, few, listed, shown, warn_user
from diffeo_calib.measurements.checks import of_measurements, unlikely_units
from diffeo_calib.measurements.csv.cells import bad_cells
from diffeo_calib.measurements.csv.columns import (
    DEVIATION,
    POSITIONS,
    ROTATION_STD,
    ROTATIONS,
    STD,
    Body,
    Check,
    Column,
    Columns,
)
from diffeo_calib.measurements.csv.tables import FileRows
from diffeo_calib.measurements.images import Known
from diffeo_calib.measurements.observations import WITH_POSITION
from diffeo_calib.measurements.poses import (
    from_spherical,
    inverse_poses,
    of_frames,
    rotation_matrices,
    rotation_numbers,
    to_spherical,
    transforms_of_frames,
)
from diffeo_calib.measurements.readings import MILLIMETRES, SEPARATOR, Distances, Readings, SocketReadings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import ZERO, TableFormat, column_names, flat_names, numbers_of

ONE_READING = "every line is one reading of one device: fill the cell in, or remove the line"
LENGTH = Check(
    "a distance above 0", fix="repair or remove these lines; distances with an unknown zero are displacements"
)
IMAGE, POINT, PIXEL, CAMERA = "image", ("board_x", "board_y"), ("u", "v"), "camera"
"""Columns of images: name of the image, place of the corner on the board in the unit of length, pixels; name of the
camera, if there are several."""

Written = tuple[dict[str, Tensor], Mapping[str, Sequence[str]], Tensor]
"""Rows as lines of a file: numbers in SI and texts by their column, and the row (M,) of each line."""


class SensorColumns:
    """The columns of rows of one kind; ``word``: name of the contents of a row, such as "a position".

    Of lines ``filled`` is which of them hold such a row, (N,) boolean; ``table`` their rows, and the first line of
    each; ``written`` is the inverse of ``table``; joints, payloads and covariates are those of the rows.
    """

    word: ClassVar[str]
    hidden: ClassVar[bool] = False  # whether rows may show some of it alone, and leave the other cells empty
    texts: Mapping[str, bool]  # columns of texts, and whether a table must have them
    filled: Any
    table: Any
    written: Any

    def bodies(self, table: TableFormat) -> Sequence[Body]:
        """The columns of numbers beside joints, payloads and covariates."""
        return ()


@dataclass(frozen=True)
class PositionColumns(SensorColumns):
    """Measured positions or poses, whose columns a table's :class:`TableFormat` names."""

    form: TableFormat
    word, hidden = "a position", True

    @property
    def texts(self) -> Mapping[str, bool]:
        names = self.form.session, self.form.marker and self.form.marker.partition("=")[0]
        return {name: True for name in names if name is not None}

    @cached_property
    def each(self) -> list[Body]:
        """The columns of every marker or frame; MeasurementError for numbers of names that do not match."""
        form, count = self.form, len(self.form.triples)
        for name in (ROTATIONS[:-1], ROTATION_STD):
            lists: Any = getattr(form, name) or ()
            if len(flat_names(lists)) > 1 and len(lists) != count:
                expected, fix = "a list for each position", "name those of every frame, or leave the rotations out"
                raise MeasurementError.of(f"`{name}`", expected=expected, got=as_written(lists), fix=fix)
        std: Any = form.std if isinstance(form.std, str) else flat_names(form.std) or form.std
        if std is not None:
            expected = "names of columns: one, one per marker or three per marker"
            std = column_names(STD, std, expected, (1, count, 3 * count))
        if form.spherical and std and len(std) == 3 * count:  # deviations are along x, y and z
            fix = "name one for all directions of each marker, or leave them out: the noise is estimated"
            raise MeasurementError.of("`std` of a distance and two angles", got=listed(std), fix=fix)
        unit, turned = form.rotation_angle or "rad", form.convention is not None and numbers_of(form.convention) == 3
        parts = (
            (flat_names(form.triples), Column("", form.length, role=POSITIONS)),
            (flat_names(form.rotation), Column("", unit if turned else None, role=ROTATIONS)),
            (std or (), Column("", form.length, DEVIATION, STD)),
            (flat_names(form.rotation_std), Column("", unit, DEVIATION, ROTATION_STD)),
        )
        bodies, word = list[Body](), f"shows this {'frame' if form.rotation else 'marker'}"
        for k in range(count):
            of_each = [(names, len(names) // count, column) for names, column in parts]  # or those of all
            own = [(names[k * n : k * n + n] if n else names, column) for names, n, column in of_each]
            columns = [column._replace(name=name) for names, column in own for name in names]
            if form.spherical:
                columns[1:3] = [column._replace(unit=form.spherical.rpartition("_")[2]) for column in columns[1:3]]
            bodies.append(Body(columns, word))
        return bodies

    def bodies(self, table: TableFormat) -> list[Body]:
        """Deviations of all belong to none of several, nor does a coordinate that is 0 in all rows."""
        some = dict.fromkeys(c for body in self.each for c in body.columns if c.check == DEVIATION or c.name == ZERO)
        shared = [column for column in some if sum(column in body.columns for body in self.each) > 1]
        own = [body._replace(columns=[c for c in body.columns if c not in shared]) for body in self.each]
        return [*own, Body(shared, "")]

    def filled(self, rows: FileRows) -> Tensor:
        return torch.stack([~rows.numbers(body.columns[:1]).isnan()[:, 0] for body in self.each]).any(0)

    def table(self, rows: FileRows) -> tuple[Measurements, FileRows]:
        """MeasurementError for numbers that do not form a rotation."""
        form, names, joints = self.form, None, rows.columns.joints.texts
        places = (rows.numbers(body.of(POSITIONS)) for body in self.each)
        points = torch.stack([torch.cat([xyz, 0.0 * xyz[:, : 3 - xyz.shape[1]]], 1) for xyz in places], 1)  # in a plane
        points = from_spherical(points, form.spherical) if form.spherical else points
        std, turn_std = (
            torch.stack([rows.numbers(body.of(role)).expand(-1, 3) for body in self.each], 1)
            if self.each[0].of(role)
            else None
            for role in (STD, ROTATION_STD)
        )
        if form.marker is not None:
            first, at, names = self._markers(rows, form.marker)
            nowhere = points.new_full((len(first), len(names), 3), torch.nan)
            points, std = nowhere.index_put(at, points[:, 0]), std if std is None else nowhere.index_put(at, std[:, 0])
            rows = rows.of(first)
        if form.convention is None:
            data = Measurements(rows.q, points, joints, names, std=std, doubt=False)
        else:
            poses = of_frames(transforms_of_frames(self._rotations(rows, form.convention), points))
            spreads = [spread if spread is None or len(self.each) > 1 else spread[:, 0] for spread in (std, turn_std)]
            how: Any = {"lever": form.lever, "position_std": spreads[0], "rotation_std": spreads[1], "doubt": False}
            data = Measurements.from_poses(rows.q, poses, joints, camera_on_tool=form.camera_on_tool, **how)
        set_ups = rows.devices(form.session, "a name")
        return data.with_tips(form.on).with_sessions(set_ups, remounted=form.remounted), rows

    def _markers(self, rows: FileRows, marker: str) -> tuple[Tensor, tuple[Tensor, Tensor], Sequence[str]]:
        """The first line (N,) of every row; row and marker of each line; names of the markers, which a column holds.

        A row holds lines that follow each other with the same joint values, payload and session, of different markers.
        """
        column, _, given = marker.partition("=")
        texts = rows.named(column, "the name of a marker")
        names = given.split(",") if given else list(dict.fromkeys(texts))
        if unknown := [name for name in dict.fromkeys(texts) if name not in names]:
            what, fix = f"file '{rows.path}', column '{column}'", "remove their lines, or calibrate with all of them"
            raise MeasurementError.of(what, expected=f"markers of the model: {few(names)}", got=few(unknown), fix=fix)
        sessions = [""] * len(texts) if self.form.session is None else rows.texts[self.form.session]
        loads = rows.beside.get("payload", torch.zeros(len(texts), dtype=torch.float64, device=HOST))
        poses = list(zip(rows.q.tolist(), loads.tolist(), sessions, strict=True))
        numbers, first = list[int](), list[int]()
        for line, pose in enumerate(poses):
            if not first or pose != poses[first[-1]] or texts[line] in texts[first[-1] : line]:
                first.append(line)
            numbers.append(len(first) - 1)
        at = [names.index(text) for text in texts]
        begin, row, marker_number = (torch.tensor(own, dtype=torch.int64, device=HOST) for own in (first, numbers, at))
        return begin, (row, marker_number), names

    def _rotations(self, rows: FileRows, convention: str) -> Tensor:
        """Rotations (N, T, 3, 3) of frames, NaN where hidden."""
        numbers = torch.stack([rows.numbers(body.of(ROTATIONS)) for body in self.each], 1)
        visible = ~numbers.isnan().any(2)
        shown = visible.nonzero().tolist()

        def place(number: int) -> str:
            row, frame = shown[number]
            names = ", ".join(column.name for column in self.each[frame].of(ROTATIONS))
            return f"file '{rows.path}', line {rows.lines[row]}, columns {names}"

        rotations = numbers.new_full((*visible.shape, 3, 3), torch.nan)
        with of_measurements():
            rotations[visible] = rotation_matrices(numbers[visible], convention, place=place)
        return rotations

    def numbers(
        self, places: Tensor, frames: Tensor | None, std: Tensor | None, turn_std: Tensor | None
    ) -> dict[str, Tensor]:
        """Places (N, B, 3), rotations of frames (N, B, 4, 4), and deviations (N, B, 3), in SI, by their columns."""
        places = to_spherical(places, self.form.spherical) if self.form.spherical else places
        turns = None if frames is None else rotation_numbers(frames[..., :3, :3], self.form.convention or "rotvec")
        parts = {POSITIONS: places, ROTATIONS: turns, STD: std, ROTATION_STD: turn_std}
        each = (
            (body.of(role), part[:, k].T)
            for k, body in enumerate(self.each)
            for role, part in parts.items()
            if part is not None
        )
        return {column.name: values for pairs in each for column, values in zip(*pairs, strict=True)}

    def written(self, part: Any, table: TableFormat) -> Written:
        frames = part.frames if part.frames is None or part.board is None else inverse_poses(part.frames)
        places, turn_std = (part.points if frames is None else frames[..., :3, 3]), part.rotation_std
        turn_std = None if turn_std is None else turn_std.view_as(places)
        texts = {} if self.form.session is None else {self.form.session: part.device_names}
        return self.numbers(places, frames, part.std, turn_std), texts, *part.index


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

    def table(self, rows: FileRows) -> tuple[SocketReadings, FileRows]:
        fix = "fill it in; lines without a socket hold a measured position, whose columns must be named (`position`)"
        parts = [rows.named(name, "the name of a place or socket", fix) for name in self.names]
        names = [SEPARATOR.join(row) for row in zip(*parts, strict=True)]
        options = {"distances": self.distances, "distance_std": self.distance_std}
        data = Measurements.from_sockets(rows.q, names, rows.columns.joints.texts, **options, doubt=False)
        return data.with_tips(None if self.on is None else [self.on]), rows

    def written(self, part: Any, table: TableFormat) -> Written:
        return {}, {self.names[0]: part.device_names}, *part.index


@dataclass(frozen=True)
class ReadingColumns(SensorColumns):
    """How a table holds readings.

    Args:
        kind: of the readings: "distance", "height", "image", or that of devices of your own.
        values: name of their column, of two columns for images, or one number for all rows, in the unit of length of
            the table. Beside other kinds these are the rows that name a device.
        device: name of the column that names the device of each row; None for one device.
        offset_std: of the unknown zero of distances, m. intrinsics: fx, fy, cx, cy of the camera in pixels.
        std: names of columns with standard deviations, one or, of images, two, in the unit of the readings.
        on: name of the tip that carries the ball.
        unit: of readings of devices of your own that are no lengths, see :meth:`Readings.of`.
    """

    kind: str
    values: tuple[str, ...] | str | float
    device: str | None = None
    offset_std: float = 0.0
    intrinsics: tuple[float, float, float, float] | None = None
    std: tuple[str, ...] | str = ()
    on: str | None = None
    unit: tuple[str, float] = MILLIMETRES

    def __post_init__(self) -> None:
        """Raise MeasurementError for a number of columns that does not match the kind, and a lens of no image."""
        if self.kind in (*WITH_POSITION, "socket"):
            expected = "a kind of readings, such as 'distance', 'height' or 'image'"
            raise MeasurementError.of("`kind`", expected=expected, got=self.kind, fix="name its columns otherwise")
        if (self.intrinsics is None) != (self.kind != "image"):
            fix = "pass fx, fy, cx, cy in pixels" if self.kind == "image" else "leave it out"
            raise MeasurementError.of(f"`intrinsics` of {self.kind!r}", got=as_written(self.intrinsics), fix=fix)
        count = {"distance": 1, "height": 1, "image": 2}.get(self.kind, 0)
        for name, allowed in (("values", (count,)), ("std", (0, 1, count))):
            given: Any = getattr(self, name)
            if isinstance(given, bool) or not isinstance(given, (int, float)):
                names: Any = (given,) if isinstance(given, str) else given
                expected = f"{count} names of columns for {self.kind!r}"
                names = column_names(name, names, expected, allowed) if count else tuple(names)
                object.__setattr__(self, name, names)

    @property
    def word(self) -> str:
        return "an image" if self.kind == "image" else f"a {self.kind}"

    @property
    def texts(self) -> Mapping[str, bool]:
        return {} if self.device is None else {self.device: True}

    def unit_in(self, table: TableFormat) -> str | float | None:
        """Unit of readings in a table, as of :class:`Column`."""
        return None if self.kind == "image" else table.length if self.unit == MILLIMETRES else self.unit[1]

    def bodies(self, table: TableFormat) -> list[Body]:
        unit, check = self.unit_in(table), LENGTH if self.kind == "distance" and not self.offset_std else None
        values = [Column(name, unit, check) for name in self.values] if isinstance(self.values, tuple) else []
        return [Body([*values, *(Column(name, unit, DEVIATION) for name in self.std)], f"holds {self.word}")]

    def filled(self, rows: FileRows) -> Tensor:
        if isinstance(self.values, tuple):
            return ~rows.numbers(self.bodies(rows.columns.table)[0].values).isnan().any(1)
        if self.device is None:
            fix = "name the column of its devices: the rows that name one hold this reading"
            raise MeasurementError.of(f"one {self.kind} for all rows beside rows of other kinds", fix=fix)
        return rows.filled(self.device)

    def table(self, rows: FileRows) -> tuple[Readings, FileRows]:
        q, joints, table, (body,) = (
            rows.q,
            rows.columns.joints.texts,
            rows.columns.table,
            self.bodies(rows.columns.table),
        )
        per_si = Column("", self.unit_in(table)).per_si
        if isinstance(self.values, tuple):
            values = rows.numbers(body.values)
        else:
            values = torch.full((len(q), 1), float(self.values) / per_si, dtype=torch.float64, device=HOST)
        devices = rows.devices(self.device, "the name of the device of this reading", ONE_READING)
        std = rows.numbers(body.columns[-len(self.std) :]).expand_as(values) if self.std else None
        given, options = (q, values, devices, joints), {"std": std, "doubt": False}
        if (lens := self.intrinsics) is not None:
            data = Readings.images(*given, focal=lens[:2], centre=lens[2:], **options)
        elif self.kind == "distance":
            for text in unlikely_units("positions", values * per_si, table.length, "length"):
                warn_user(f"file '{rows.path}': {text}".replace("positions", "distances"))
            data = Readings.distances(*given, offset_std=self.offset_std, **options)
        else:
            data = Readings.of(self.kind, *given, unit=self.unit, numbers=values.shape[1], **options)
        return data.with_tips(None if self.on is None else [self.on]), rows

    def written(self, part: Any, table: TableFormat) -> Written:
        names = self.values if isinstance(self.values, tuple) else ()
        values = dict(zip(names, part.reported.T, strict=True))
        values |= dict(zip(self.std, part.reported_std.T, strict=True)) if self.std else {}
        return values, {} if self.device is None else {self.device: part.device_names}, *part.index


@dataclass(frozen=True)
class ImageColumns(SensorColumns):
    """How a table holds images.

    Args:
        camera: width and height of the images, pixels, or what is known of lens and board; of several cameras by the
            names in the column `camera`.
        camera_on_tool: whether the camera is on the tool; else the board is.
        device: column that names the set-up of every image; None for one.
    """

    camera: Known | Mapping[str, Known]
    camera_on_tool: bool = False
    device: str | None = None
    word = "an image"

    @property
    def texts(self) -> Mapping[str, bool]:
        return {CAMERA: False, IMAGE: True} | ({} if self.device is None else {self.device: True})

    def bodies(self, table: TableFormat) -> list[Body]:
        columns = [*(Column(name, table.length) for name in POINT), *map(Column, PIXEL)]
        return [Body(columns, f"holds {self.word}")]

    def filled(self, rows: FileRows) -> Tensor:
        return rows.filled(IMAGE)

    def table(self, rows: FileRows) -> tuple[Measurements, FileRows]:
        names = rows.named(IMAGE, "the name of the image")
        if CAMERA in rows.texts:
            names = [f"{camera}/{image}" for camera, image in zip(rows.texts[CAMERA], names, strict=True)]
        images, q = dict[str, list[int]](), rows.q
        for row, name in enumerate(names):
            images.setdefault(name, []).append(row)
        for name, indices in images.items():
            other = (q[indices] != q[indices[0]]).any(1).nonzero()[:, 0].tolist()
            if other:
                what, got = f"file '{rows.path}', image '{name}'", few([rows.lines[indices[row]] for row in other])
                fix = "give every image a name of its own, and its joint values in all of its lines"
                raise MeasurementError.of(what, expected="the same joint values", got=f"others in line {got}", fix=fix)
        ((columns, _),) = self.bodies(rows.columns.table)
        flat = rows.numbers(columns)
        if empty := flat.isnan().nonzero().tolist():
            bad = [(rows.lines[row], columns[k].name, "") for row, k in empty]
            raise bad_cells(rows.path, bad, "a number", "fill it in, or delete the line")
        flat = torch.cat([flat[:, :2], torch.zeros_like(flat[:, :1]), flat[:, 2:]], 1)
        corners = flat.new_full((len(images), max(map(len, images.values())), 5), torch.nan)
        for number, indices in enumerate(images.values()):
            corners[number, : len(indices)] = flat[indices]
        first = rows.of(torch.tensor([indices[0] for indices in images.values()], dtype=torch.int64, device=HOST))
        options: dict[str, Any] = {"camera_on_tool": self.camera_on_tool, "doubt": False}
        if CAMERA in rows.texts:
            options["seen_by"] = first.named(CAMERA, "the name of the camera")
        data = Measurements.from_images(first.q, corners, self.camera, rows.columns.joints.texts, **options)
        data = data.with_columns(image_names=dict(zip(first.lines, images, strict=True)))
        set_ups = first.devices(self.device, "a name")
        return (data if set_ups is None else data.with_sessions(set_ups)), first

    def written(self, part: Any, table: TableFormat) -> Written:
        """A line for each corner."""
        number, corner = (~part.corners[..., 0].isnan()).nonzero().unbind(1)
        visible, whose = part.corners[number, corner], number.tolist()
        texts = {IMAGE: [str(k) for k in whose]}
        named = {CAMERA: part.camera_names} if len(part.cameras) > 1 else {}
        named |= {} if self.device is None else {self.device: part.device_names}
        texts |= {name: [column[k] for k in whose] for name, column in named.items()}
        return dict(zip((*POINT, *PIXEL), visible[:, [0, 1, 3, 4]].T, strict=True)), texts, number


def columns_of(table: TableFormat) -> Columns:
    """The columns of a table, by the kinds of its rows.

    Raises:
        MeasurementError: no kind of rows, options of rotations that do not match, or options for something that is not
            measured.
    """
    sensors = [] if table.position is None else [PositionColumns(table.for_reading())]
    sensors = [*sensors, *([] if table.sockets is None else [table.sockets]), *table.readings]
    if not sensors:
        fix = "name the columns of the marker, or those of `socket`"
        raise MeasurementError.of("`position` is missing", fix=fix)
    if table.remounted and table.session is None:
        raise MeasurementError.of("`remounted` without `session`", fix="name the column of the set-ups too")
    if table.marker is not None and (len(sensors) > 1 or len(table.triples) != 1 or table.rotation is not None):
        expected = "one position (x, y, z) in every line, and neither rotations, sockets nor readings"
        raise MeasurementError.of(f"`marker` ({shown(table.marker)})", expected=expected, fix="leave it out")
    options = "rotation", "rotation_std", "std", "camera_on_tool", "remounted", "session"
    names = [f"`{name}`" for name in options if getattr(table, name) not in (None, False)]
    if table.position is None and names:
        what = f"{' and '.join(names)} beside `{'socket' if table.sockets is not None else 'readings'}`"
        fix = "leave it out: no position was measured; sockets of another set-up are other places"
        raise MeasurementError.of(what, fix=fix)
    return Columns.of(table, sensors)
