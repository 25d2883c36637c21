"""Tables as CSV files: any separator, decimal mark and unit in the file, SI inside.

Units are never guessed. Every mistake in a file is one error that names the file, the line and the column.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.errors import MeasurementError, few, listed, shown, warn_user
from diffeo_calib.common.files import as_path
from diffeo_calib.measurements.checks import quiet
from diffeo_calib.measurements.csv.cells import repeated
from diffeo_calib.measurements.csv.columns import (
    POSITIONS,
    ROTATION_STD,
    ROTATIONS,
    STD,
    Columns,
    PoseColumns,
    check_count,
)
from diffeo_calib.measurements.csv.lines import Cells, write_rows
from diffeo_calib.measurements.csv.sensors import (
    CAMERA,
    IMAGE,
    ImageColumns,
    PositionColumns,
    ReadingColumns,
    SensorColumns,
    SocketColumns,
    columns_of,
)
from diffeo_calib.measurements.csv.tables import FileRows, TableOrigin, read_table
from diffeo_calib.measurements.observations import Observations, joined_tables
from diffeo_calib.measurements.poses import by_frame
from diffeo_calib.measurements.readings import ONE_DEVICE
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.measurements.table_format import Names, TableFormat, check_choice, flat_names
from diffeo_calib.robots.tree import Tree

LOG = logging.getLogger(__name__)
Rows = TypeVar("Rows", bound=RowGroups)


@outside_inference_mode
def read_observations(
    path: str | PathLike[str], table: TableFormat, *, duplicates: str = "error", growing: bool = False
) -> Any:
    """Read a table whose rows may be of several kinds; units and errors are those of :func:`read_measurements`.

    With several kinds, a line fills the cells of some of them and leaves the others empty. A line that fills those of
    two kinds is two observations, and so two rows with the same line number.

    Args:
        path: the file. table: what it holds. duplicates: "error", "keep" or "drop". growing: whether rows will be
            added, so that none may be judged by the others.

    Returns:
        :class:`Measurements` of positions, poses, sockets, or positions and sockets; :class:`Readings` of one kind;
        else :class:`Observations`. Rows are in the order of the file.
    """
    check_choice("duplicates", duplicates, ("error", "keep", "drop"))
    file = as_path(path)
    columns = columns_of(table)
    rows, alone = read_table(file, columns, zeros=not growing), len(columns.sensors) == 1
    tables = []
    for sensor, here in _divided(rows):
        part, first = sensor.table(here)
        part = part.with_line_numbers(first.lines).with_payload(first.beside.get("payload"))
        tables.append(part.with_covariates(**{name: first.beside.get(name) for name in ("time", "temperature")}))
    data = tables[0] if alone else joined_tables(tables)
    data = data if alone else data.rows(data.line_numbers.argsort(stable=True))
    data = data.with_columns(file_sha256=rows.sha256)
    if alone and table.position is not None:
        marker = table.marker and f"{table.marker.partition('=')[0]}={','.join(data.marker_names)}"
        columns = replace(columns, table=replace(table, marker=marker))
        data = data.with_columns(origin=TableOrigin(file, columns, rows.sha256))
    LOG.info("read %d rows of %s", len(data), shown(path))
    return data if duplicates == "keep" else _without_copies(file, data, drop=duplicates == "drop")


def _divided(rows: FileRows) -> list[tuple[SensorColumns, FileRows]]:
    """Each kind and the lines that hold it; MeasurementError for lines without any."""
    sensors = rows.columns.sensors
    if len(sensors) == 1:
        return [(sensors[0], rows)]
    filled = [sensor.filled(rows) for sensor in sensors]
    for sensor in (sensor for sensor, here in zip(sensors, filled, strict=True) if not bool(here.any())):
        what = f"file '{rows.path}': no line holds {sensor.word}"
        raise MeasurementError.of(what, expected="some rows of this kind", fix="leave its columns out")
    empty = [rows.lines[row] for row in (~torch.stack(filled).any(0)).nonzero()[:, 0].tolist()]
    if empty:
        what, expected = f"file '{rows.path}', line {few(empty)}", " or ".join(sensor.word for sensor in sensors)
        raise MeasurementError.of(what, expected=expected, got="empty cells", fix="fill them in, or remove the line")
    return [(sensor, rows.of(here)) for sensor, here in zip(sensors, filled, strict=True)]


def _without_copies(path: Path, data: Rows, drop: bool) -> Rows:
    copies, at = data.copies(), data.line_numbers.tolist()
    if copies and not drop:
        pairs = few([f"{at[row]} repeats {at[earlier]}" for earlier, row in copies])
        what = f"file '{path}': {len(copies)} line(s) repeat an earlier line exactly: line {pairs}"
        fix = "real repeats differ by noise: remove these lines, or pass duplicates='drop' or duplicates='keep'"
        raise MeasurementError.of(what, fix=fix)
    dropped = [row for _, row in copies]
    if dropped:
        text = f"file '{path}': dropped {len(dropped)} line(s) that repeat an earlier line exactly"
        warn_user(f"{text} (line {few([at[row] for row in dropped])}); pass duplicates='keep' to keep them.")
    return data.rows(np.setdiff1d(np.arange(len(data)), dropped))


@outside_inference_mode
def read_measurements(
    path: str | PathLike[str],
    robot: Sequence[str] | Tree,
    position: Names | None = None,
    *,
    joints: Sequence[str] | None = None,
    length: str,
    angle: str,
    duplicates: str = "error",
    **columns: Any,
) -> Any:
    """Read a table of measurements from a CSV file and convert it to SI.

    Only the named columns are read as numbers; other columns may hold anything. Blank lines, comments (#, %, //), lines
    before the header and a row of units below it are skipped; without a header columns are named "1", "2", ... The
    cells x, y and z of a marker, or all of a frame, are empty where it was hidden, or hold a word such as MISSING, a
    number beyond 1e12, or 0, 0, 0 far from all other rows. Rows without any marker are left out.

    Args:
        path: the file.
        robot: whose joints name the columns (``joint_names``, ``kinds``); or these names without a robot, in its order.
        joints: names of the columns in the robot's order, where they are not those of its joints, or expressions of
            columns in the units of the file, such as ``"-{J2}+90"``, ``"{J3}+{J2}"`` or ``"360/4096*{ticks5}-180"``.
        position: names of the x, y and z columns of the marker, or one such triple per marker; None if all rows are in
            sockets, or read by other devices. With ``socket`` a line has a position or a socket, and empty cells for
            the other, or is two rows.
        length, angle: units in the file, ``"m"``, ``"mm"``, ``"cm"``, ``"um"`` or ``"inch"``; ``"rad"`` or ``"deg"``.
        duplicates: what to do with rows that repeat an earlier row exactly: ``"error"`` refuses them, ``"keep"``
            keeps them, ``"drop"`` drops them with a warning. Real repeats differ by noise.
        columns: all else that the table says, as fields of :class:`TableFormat` (``sep``, ``decimal``, ``rotation``,
            ``convention``, ``rotation_angle``, ``std``, ``payload``, ``session``, ``marker``, ``on``, ...), of which
            ``readings`` are :class:`ReadingColumns`, one for each kind of device; and ``socket``, ``distances`` and
            ``distance_std``, the fields of :class:`SocketColumns`.

    Returns:
        Measurements in rad and m, rows in the order of the file; of readings of one kind alone :class:`Readings`; of
        several kinds, and of poses beside rows in sockets,
        :class:`~diffeo_calib.measurements.observations.Observations`.

    Raises:
        MeasurementError: anything unreadable, missing, ragged, not finite or repeated (file, line and column are
            named); numbers that do not form a rotation, standard deviations that are not positive.

    Warns:
        DiffeoCalibWarning: values that look as if they were in another unit; rows dropped; what was skipped.
    """
    options = {name: columns.pop(name, None) for name in ("socket", "distances", "distance_std")}
    sockets, socket, on = None, options.pop("socket"), columns.get("on")
    if socket is not None:
        tip = None if not on or isinstance(on, str) else on[-1]
        sockets = SocketColumns((socket,) if isinstance(socket, str) else tuple(socket), **options, on=tip)
    elif any(value is not None for value in options.values()):
        raise MeasurementError.of("`distances` without `socket`", fix="name the columns of the sockets too")
    table = TableFormat(length, angle, **columns, joints=robot, position=position, sockets=sockets)
    if joints is None:
        return read_observations(path, table, duplicates=duplicates)
    names: Any = getattr(robot, "joint_names", robot)
    kinds = table.kinds or getattr(robot, "kinds", None)
    check_count("`joints`", joints, len(names), "joint of the robot, in its order")
    table = replace(table, joints=joints, kinds=kinds)
    return read_observations(path, table, duplicates=duplicates).with_joint_names(names)


def read_joints(path: str | PathLike[str], table: TableFormat) -> Tensor:
    """Joint configurations (N, n), rad (revolute) and m (prismatic), of a file, see :func:`read_measurements`."""
    return read_configurations(path, table)["q"]


def read_configurations(path: str | PathLike[str], table: TableFormat) -> dict[str, Tensor]:
    """Joint values "q" as of :func:`read_joints`, with the "payload" (N,), "time" and "temperature" that are named."""
    rows = read_table(as_path(path), Columns.of(table.joints_only()))
    return {"q": rows.q} | rows.beside


def read_poses(path: Path, table: TableFormat) -> tuple[Tensor, Tensor]:
    """The cells (N, c) of the columns ``table.joints``, and the commanded poses (N, 4, 4), or places (N, k), m."""
    columns: PoseColumns = table.joints
    plain = replace(table, joints=replace(columns, robot=None), angle="rad", joint_length=None, kinds=None)
    with quiet():  # numbers of rotations are read as angles
        cells = read_joints(path, plain)
    try:
        return cells, replace(columns, angle=table.angle).poses(cells, table.joints_per_metre)
    except MeasurementError as error:
        raise MeasurementError(f"file '{path}': {error}") from None


# --- writing

Predictions = tuple[Tensor, ...]
"""Configurations (B, n) [rad or m], predicted points or poses, standard deviations, and perhaps more cells (B, k)."""


def write_predictions(
    path: str | PathLike[str],
    blocks: Iterable[Predictions],
    table: TableFormat,
    *,
    prefixes: Sequence[str] = ("",),
    more: Sequence[str] = (),
    poses: bool = False,
    **columns: Any,
) -> None:
    """Write configurations, predicted markers or poses and their standard deviations; overwrites.

    Columns: the joints, then for each marker or frame x, y, z, std_x, std_y, std_z and, of a pose, the columns of the
    rotation, and std_rx, std_ry, std_rz; of several with prefixes; then more.

    Args:
        path: the file; it appears when the last block is written.
        blocks: configurations (B, n), rad and m; markers (B, P, 3), m, or poses (B, 4, 4) or (B, T, 4, 4), m; standard
            deviations (B, P, 3) or (B, T, 6), m, and rad about the measuring axes; more cells (B, k) as written.
        table: the format, of poses with defaults as in :func:`write_measurements`; columns: further fields of it.
        prefixes: of the columns of each marker or frame. more: k further columns. poses: whether these are predicted.
    """
    position = [[f"{prefix}{axis}" for axis in "xyz"] for prefix in prefixes]
    table = replace(table, **columns, position=position, spherical=None)
    table = replace(table, std=[f"{prefix}std_{axis}" for prefix in prefixes for axis in "xyz"])
    table = table.for_writing(rotation_std=True, prefixes=prefixes) if poses else table
    numeric = columns_of(table)
    sensor: PositionColumns = numeric.sensors[0]
    order = POSITIONS, STD, ROTATIONS, ROTATION_STD
    of_bodies = [column.name for body in sensor.each for role in order for column in body.of(role)]
    names = [*numeric.joints.columns, *of_bodies]

    def rows(q: Tensor, mean: Tensor, deviations: Tensor, *others: Tensor) -> Cells:
        frames, spreads = by_frame(mean) if poses else None, deviations.reshape(len(q), len(prefixes), -1)
        places, turns = (mean, None) if frames is None else (frames[..., :3, 3], spreads[..., 3:])
        cells = numeric.cells(q, sensor.numbers(places, frames, spreads[..., :3], turns))
        beside = torch.cat(others, 1).tolist() if others else [[]] * len(q)
        lines = zip(*(cells[name] for name in names), strict=True)
        return [[*line, *extra] for line, extra in zip(lines, beside, strict=True)]

    write_rows(path, [*names, *more], (rows(*block) for block in blocks), table)


SOCKET, SESSION = "socket", "session"  # names of columns that are written


@outside_inference_mode
def write_measurements(path: str | PathLike[str], data: Any, table: TableFormat, **columns: Any) -> TableFormat:
    """Write a CSV file that :func:`read_measurements` or :func:`read_observations` reads back; overwrites.

    In rad and m the round trip of joints and points is exact; in other units to the last digits of float64. All that is
    known is written. Cells are empty for hidden markers, and where a row of another kind has no value.

    Args:
        path: the file. data: measurements, readings or observations, rad, m and pixels.
        table: the format. Defaults: convention ``"rotvec"``, ``rotation_angle`` that of ``angle``; for the columns of
            the rotation rx, ry, rz for a rotation vector, qx, qy, qz, qw or qw, qx, qy, qz for a quaternion, r11, r12,
            ..., r33 for a matrix, and euler1, euler2, euler3 for Euler angles, with TIP_ before them for frames on
            several tips; for standard deviations std_x, ... for a position column x, ..., and std_rx, std_ry, std_rz
            for the rotation; payload for masses, time and temperature. ``std`` has three names per marker.
        columns: further fields of the format. Defaults: ``data.joint_names`` or q1, q2, ...; for positions x, y, z for
            one marker or frame, else ``NAME_x``, ... with the names of the frames' tips, ``data.marker_names`` or
            marker1, marker2, ...; "session" for set-ups and devices.

    Returns:
        the format of the file. Sockets are in the column ``socket``, readings in distance, displacement, height, or u
        and v, with a number after it for a second table of the same kind. Known distances are in this format alone.

    Raises:
        MeasurementError: names that do not match, or of what the table does not hold; both positions and poses.
        InputError: a file that cannot be written.
    """
    whole, table = Observations.joined([data]), replace(table, **columns)
    names = table.joints or whole.joint_names or [f"q{i + 1}" for i in range(whole.n)]
    table, kinds = _sheet(whole, replace(table, joints=names))
    numeric = columns_of(table)
    check_count("joint columns", numeric.joints.texts, whole.n, "joint")
    sockets = () if table.sockets is None else table.sockets.names
    images = [IMAGE, CAMERA] * any(isinstance(reading, ImageColumns) for reading in table.readings)
    sessions = {table.session, *(reading.device for reading in table.readings)} - {None}
    twice = repeated([*numeric.names, *sockets, *images, *sessions])
    if twice:
        what, fix, got = "the names of the columns", "rename the joints or positions", f"{listed(twice)} twice"
        raise MeasurementError.of(what, expected="distinct names", got=got, fix=fix)
    written: list[tuple[int, dict[str, float | str]]] = []
    for part, rows, sensor in zip(whole.parts, whole.index, kinds, strict=True):
        numbers, texts, lines = sensor.written(part, table)
        beside = part.drifting | ({} if part.payload is None else {"payload": part.payload})
        numbers |= {getattr(table, name): values[lines.to(values.device)] for name, values in beside.items()}
        cells = {**numeric.cells(part.q[lines.to(part.q.device)], numbers), **texts}
        each = [dict(zip(cells, line, strict=True)) for line in zip(*cells.values(), strict=True)]
        written += zip(rows[lines].tolist(), each, strict=True)
    there = {name for _, cells in written for name in cells}
    if empty := [name for name in numeric.names if name not in there]:
        what, got = f"the column(s) {listed(empty)}", "measurements without these values"
        raise MeasurementError.of(what, got=got, fix="leave the names out")
    header = [name for name in (*numeric.names, *numeric.texts) if name in there]
    in_order = sorted(written, key=lambda line: line[0])
    write_rows(path, header, [[[cells.get(name, "") for name in header] for _, cells in in_order]], table)
    return table


def _sheet(whole: Observations, table: TableFormat) -> tuple[TableFormat, list[Any]]:
    """The format, by default that of :func:`write_measurements`, and the columns of each part."""
    measured = [part for part in whole.parts if part.kind in ("position", "pose")]
    if len(measured) > 1:
        fix = "write them to two files"
        raise MeasurementError.of("a table with rows of positions and of poses", expected="one of them", fix=fix)
    device = measured[0] if measured else None
    names = {name for part in whole.parts if part.kind != "socket" for name in part.device_names} - {""}
    board = None if device is None else device.board
    if table.camera_on_tool != (board is not None):
        fix = "pass as it is with the measurements, and read the table with the same format"
        raise MeasurementError.of("`camera_on_tool`", expected=board is not None, got=table.camera_on_tool, fix=fix)
    if table.session is not None and not names:
        raise MeasurementError.of("`session`", got="a table without set-ups or devices", fix="leave it out")
    if device is not None and device.corners is not None:
        device, table = None, replace(table, camera_on_tool=False)
    if table.position is not None and device is None:
        raise MeasurementError.of("`position`", got="a table without positions", fix="leave it out")
    session = (table.session or SESSION) if names - ({ONE_DEVICE} if device is None else set()) else None
    if device is not None:
        position = table.position or [[f"{prefix}{axis}" for axis in "xyz"] for prefix in device.prefixes]
        on = device.on and list(device.bodies.tips(device.on))
        table = replace(table, position=position, remounted=device.remounted, on=on)
        bodies, triples = device.seen_bodies.shape[1], table.triples
        check_count("position triples", triples, bodies, "marker" if device.poses is None else "frame")
        if device.poses is not None:
            table = table.for_writing(rotation_std=device.rotation_std is not None, prefixes=device.prefixes)
        if device.std is not None:
            std = table.std or [f"std_{name}" for triple in triples for name in triple]
            check_count("columns of standard deviations", flat_names(std), 3 * len(triples), "coordinate")
            table = replace(table, std=std)
    fields = [*whole.covariate_names, *["payload"] * (whole.payload is not None)]
    beside = {name: getattr(table, name) or name for name in fields}
    column = session if device is not None and device.session is not None else None
    others = _others(whole, session)
    sockets = next((other for other in others if isinstance(other, SocketColumns)), None)
    readings = tuple(other for other in others if other not in (None, sockets))
    table = replace(table, **beside, sockets=sockets, readings=readings, session=column)
    return table, [other or PositionColumns(table.for_reading()) for other in others]


def _others(whole: Observations, session: str | None) -> list[Any]:
    """The columns of each part, None for positions and poses; those of a second part of a kind with a number."""
    columns, taken = list[Any](), list[str]()
    for part in whole.parts:
        if "corners" in part.columns:
            several, sizes = len(part.cameras) > 1, {name: (c.width, c.height) for name, c in part.cameras.items()}
            set_ups = part.session_names and not (several and part.device_names == part.camera_names)
            camera = sizes if several else sizes.popitem()[1]
            columns.append(ImageColumns(camera, part.board is not None, session if set_ups else None))
        elif part.kind == "socket":
            distances = {
                (part.names[a], part.names[b]): length for a, b, length in part.lengths
            }  # a reader finds these
            columns.append(SocketColumns((SOCKET,), distances or None, part.distance_std, part.ball_tip))
        elif part.kind in ("position", "pose"):
            columns.append(None)
        else:
            taken.append(part.value_names[0])
            number = "" if (count := taken.count(taken[-1])) == 1 else str(count)
            names = tuple(f"{name}{number}" for name in part.value_names)
            std = () if part.std is None else tuple(f"std_{name}" for name in names)
            lens = part.intrinsics if part.kind == "image" else None
            how = {"intrinsics": lens, "std": std, "on": part.on, "unit": part.unit}
            columns.append(ReadingColumns(part.kind, names, session, part.offset_std, **how))
    return columns
