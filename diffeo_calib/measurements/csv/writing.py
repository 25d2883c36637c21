"""Tables as CSV files that can be read back, rows of numbers block by block, and programs with other joint values."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from math import isfinite
from os import PathLike
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.errors import MeasurementError, listed
from diffeo_calib.common.files import WholeFile
from diffeo_calib.measurements.csv.cells import repeated
from diffeo_calib.measurements.csv.columns import check_count
from diffeo_calib.measurements.csv.lines import TextTable
from diffeo_calib.measurements.csv.sensors import (
    CAMERA,
    IMAGE,
    ImageColumns,
    PositionColumns,
    ReadingColumns,
    SocketColumns,
    numeric_columns,
    text_columns,
)
from diffeo_calib.measurements.observations import Observations
from diffeo_calib.measurements.poses import by_frame
from diffeo_calib.measurements.readings import ONE_DEVICE
from diffeo_calib.measurements.table_format import TableFormat, flat_names

Cells = Sequence[Sequence[float | str]]
"""Rows of cells: numbers and texts."""
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
            deviations (B, P, 3), m, or (B, 6) or (B, T, 6): of positions, m, and of rotations about the measuring
            frame's axes, rad; and more cells (B, k) as they are written.
        table: the format, of poses with defaults as in :func:`write_measurements`.
        prefixes: what the names of the columns of each marker or frame begin with. more: k names of further columns.
        poses: whether the blocks hold poses. columns: further fields of the format, such as ``joints`` and ``kinds``.
    """
    table = replace(table, **columns, position=[[f"{prefix}{axis}" for axis in "xyz"] for prefix in prefixes])
    table = replace(table, std=[f"{prefix}std_{axis}" for prefix in prefixes for axis in "xyz"])
    table = table.for_writing(rotation_std=True, prefixes=prefixes) if poses else table
    numeric, own = numeric_columns(table), PositionColumns(table.for_reading())
    of_bodies = [name for body in own.each for k in (0, 2, 1, 3) for name in body[k].names]
    names = [*numeric.joints.columns, *of_bodies]

    def rows(q: Tensor, mean: Tensor, deviations: Tensor, *others: Tensor) -> Cells:
        frames, spreads = by_frame(mean) if poses else None, deviations.reshape(len(q), len(prefixes), -1)
        places, turns = (mean, None) if frames is None else (frames[..., :3, 3], spreads[..., 3:])
        cells = numeric.from_si({"q": q, **own.numbers(places, frames, spreads[..., :3], turns)})
        beside = torch.cat(others, 1).tolist() if others else [[]] * len(q)
        lines = zip(*(cells[name] for name in names), strict=True)
        return [[*line, *own] for line, own in zip(lines, beside, strict=True)]

    write_rows(path, [*names, *more], (rows(*block) for block in blocks), table)


def write_rows(path: str | PathLike[str], names: Sequence[str], blocks: Iterable[Cells], table: TableFormat) -> None:
    """Write rows (B, columns) whose numbers are already in the units of the file; InputError if that fails.

    Texts are written as they are, NaN becomes an empty cell.
    """

    def cell(value: str | float) -> str:
        if isinstance(value, str):
            return value
        return repr(value).replace(".", table.decimal) if isfinite(value) else ""

    with WholeFile(path) as file:
        file.write(csv_text([names], table.sep))
        for block in blocks:
            file.write(csv_text((map(cell, row) for row in block), table.sep))


def csv_text(rows: Iterable[Iterable[object]], sep: str, end: str = "\r\n") -> bytes:
    """Rows of cells as CSV."""
    text = io.StringIO(newline="")
    csv.writer(text, delimiter=sep, lineterminator=end).writerows(rows)
    return text.getvalue().encode()


Column = Sequence[str] | Sequence[float]


def write_columns(path: Path, sheet: TextTable, cells: Mapping[str, Column], table: TableFormat) -> None:
    """Write a table with other and more columns; overwrites.

    ``cells``: name -> texts, or numbers in the units of the file, of which NaN is an empty cell.
    """
    added = {name: own for name, own in cells.items() if name not in sheet.header}
    kept = [cells.get(name, [row[k] for _, row in sheet.rows]) for k, name in enumerate(sheet.header)]
    write_rows(path, [*sheet.header, *added], [list(zip(*kept, *added.values(), strict=True))], table)


SOCKET, SESSION = "socket", "session"
"""Names of columns that are written."""


@outside_inference_mode
def write_measurements(path: str | PathLike[str], data: Any, table: TableFormat, **columns: Any) -> TableFormat:
    """Write a CSV file that :func:`read_measurements` or :func:`read_observations` reads back; overwrites.

    In rad and m the round trip of joints and points is exact; in other units it is exact to the last digits of
    float64. Standard deviations, payloads, covariates and names of set-ups and devices are written if they are known.
    Cells are empty for hidden markers, and where a row of another kind has no value. Every row is one line.

    Args:
        path: the file.
        data: measurements, readings or observations, rad, m and pixels.
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
        and v, with a number after it for a second table of the same kind. Known distances between sockets are not in
        the file, but in this format.

    Raises:
        MeasurementError: unknown unit, a number of names that does not match, names for something that the table
            does not hold, or both positions and poses.
        InputError: a file that cannot be written.
    """
    whole, table = Observations.joined([data]), replace(table, **columns)
    names = table.joints or whole.joint_names or [f"q{i + 1}" for i in range(whole.n)]
    table, kinds = _sheet(whole, replace(table, joints=names))
    numeric = numeric_columns(table)
    check_count("joint columns", numeric.joints.texts, whole.n, "joint")
    sockets = () if table.sockets is None else table.sockets.names
    images = [IMAGE, CAMERA] * any(isinstance(one, ImageColumns) for one in table.readings)
    sessions = {table.session, *(one.device for one in table.readings)} - {None}
    twice = repeated([*numeric.names, *sockets, *images, *sessions])
    if twice:
        what, fix, got = "the names of the columns", "rename the joints or positions", f"{listed(twice)} twice"
        raise MeasurementError.of(what, expected="distinct names", got=got, fix=fix)
    found: list[tuple[int, dict[str, float | str]]] = []
    for part, rows, sensor in zip(whole.parts, whole.index, kinds, strict=True):
        values, texts, lines = sensor.written(part, table)
        known = {"q": part.q, "payload": part.payload, **part.drifting}
        of_lines = {name: own if own is None else own[lines.to(own.device)] for name, own in known.items()}
        cells = {**numeric.from_si({**of_lines, **values}), **texts}
        each = [dict(zip(cells, line, strict=True)) for line in zip(*cells.values(), strict=True)]
        found += zip(rows[lines].tolist(), each, strict=True)
    there = {name for _, cells in found for name in cells}
    if empty := [name for name in numeric.names if name not in there]:
        what, got = f"the column(s) {listed(empty)}", "measurements without these values"
        raise MeasurementError.of(what, got=got, fix="leave the names out")
    header = [name for name in (*numeric.names, *text_columns(table)) if name in there]
    in_order = sorted(found, key=lambda line: line[0])
    write_rows(path, header, [[[cells.get(name, "") for name in header] for _, cells in in_order]], table)
    return table


def _sheet(whole: Observations, table: TableFormat) -> tuple[TableFormat, list[Any]]:
    """The format, by default that of :func:`write_measurements`, and the columns of each part."""
    measured = [part for part in whole.parts if part.kind in ("position", "pose")]
    if len(measured) > 1:
        fix = "write them to two files"
        raise MeasurementError.of("a table with rows of positions and of poses", expected="one of them", fix=fix)
    device, names = measured[0] if measured else None, set(whole.device_names) - {""}
    board = None if device is None else device.board
    if table.camera_on_tool != (board is not None):
        got = "poses seen by a camera on the tool" if board is not None else "measurements without such a camera"
        fix = f"pass camera_on_tool={board is not None}, and read the table with the same format"
        raise MeasurementError.of(f"`camera_on_tool` is {table.camera_on_tool}", got=got, fix=fix)
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
    known = [*whole.covariate_names, *["payload"] * (whole.payload is not None)]
    beside = {name: getattr(table, name) or name for name in known}
    own = session if device is not None and device.session is not None else None
    others = _others(whole, session)
    sockets = next((one for one in others if isinstance(one, SocketColumns)), None)
    readings = tuple(one for one in others if one not in (None, sockets))
    table = replace(table, **beside, sockets=sockets, readings=readings, session=own)
    return table, [one or PositionColumns(table.for_reading()) for one in others]


def _others(whole: Observations, session: str | None) -> list[Any]:
    """The columns of each part, None for positions and poses; those of a second part of a kind with a number."""
    found, taken = list[Any](), list[str]()
    for part in whole.parts:
        if "corners" in part.columns:
            found.append(ImageColumns.of(part, session))
        elif part.kind == "socket":
            sockets = part.with_sockets_of_rows().sockets  # a reader finds these alone
            distances = {(sockets.names[a], sockets.names[b]): length for a, b, length in sockets.distances}
            found.append(SocketColumns((SOCKET,), distances or None, sockets.distance_std, part.ball_tip))
        elif part.kind in ("position", "pose"):
            found.append(None)
        else:
            taken.append(part.value_names[0])
            number = "" if (count := taken.count(taken[-1])) == 1 else str(count)
            names = tuple(f"{name}{number}" for name in part.value_names)
            std = () if part.std is None else tuple(f"std_{name}" for name in names)
            given = part.kind, names, session, part.offset_std, part.intrinsics
            found.append(ReadingColumns(*given, std=std, on=part.on, unit=part.unit))
    return found
