"""Rows of any kinds, and of several, read from one CSV file."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.errors import MeasurementError, few, shown, warn_user
from diffeo_calib.common.inference_mode import outside_inference_mode
from diffeo_calib.measurements.csv.cells import TextCells
from diffeo_calib.measurements.csv.columns import Columns, position_triples
from diffeo_calib.measurements.csv.origin import TableOrigin
from diffeo_calib.measurements.csv.sensors import FileRows, SensorColumns, TableColumns
from diffeo_calib.measurements.csv.tables import TableFile
from diffeo_calib.measurements.observations import joined_tables
from diffeo_calib.measurements.splits import RowGroups
from diffeo_calib.measurements.table_checks import file_sha256
from diffeo_calib.measurements.table_format import TableFormat, check_choice

LOG = logging.getLogger(__name__)
Rows = TypeVar("Rows", bound=RowGroups)


@outside_inference_mode
def read_observations(
    path: str | PathLike[str], columns: TableColumns, table: TableFormat, *, duplicates: str = "error"
) -> Any:
    """Read a table whose rows may be of several kinds; units and errors are those of :func:`read_measurements`.

    With several kinds, a line fills the cells of some of them and leaves the others empty. A line that fills those of
    two kinds is two observations, and so two rows with the same line number.

    Args:
        path: the file. columns: its columns. table: units, separator and decimal mark, columns of rotations, deviations
            and payloads. duplicates: "error", "keep" or "drop".

    Returns:
        :class:`Measurements` of positions, poses, sockets, or positions and sockets; :class:`Readings` of one kind;
        else :class:`Observations`. Rows are in the order of the file.
    """
    check_choice("duplicates", duplicates, ("error", "keep", "drop"))
    file, sensors = Path(path), columns.sensors
    numbers = numeric_columns(columns, table)
    with TableFile(file, numbers) as whole:
        values, lines = whole.read()
    rows = FileRows(TextCells(file, table.sep), numbers, values, lines, alone=len(sensors) == 1)
    tables = [_laden(sensor, own) for sensor, own in _divided(rows, sensors)]
    data = tables[0] if rows.alone else joined_tables(tables)
    data = data if rows.alone else data.rows(data.lines.argsort(stable=True))
    sha256 = file_sha256(file)
    data = data.with_file_sha256(sha256)
    if rows.alone and columns.position is not None:
        data = data.with_origin(TableOrigin(file, numbers, sha256))
    LOG.info("read %d rows of %s", len(data), shown(path))
    return data if duplicates == "keep" else without_copies(file, data, data.lines, drop=duplicates == "drop")


def numeric_columns(columns: TableColumns, table: TableFormat) -> Columns:
    """The joints, positions and payloads of a table.

    Raises:
        MeasurementError: no kind of rows, or options for something that is not measured.
    """
    _check_options(columns, table)
    if columns.position is None:
        return Columns.of(table.joints_only(), columns.joints, columns.kinds, [])
    triples = position_triples(columns.position)
    found = Columns.of(table.for_reading(), columns.joints, columns.kinds, triples)
    return replace(found, all_hidden=len(columns.sensors) > 1)


def _laden(sensor: SensorColumns, rows: FileRows) -> Any:
    """The rows of one kind, with their lines and payloads."""
    own = sensor.own_lines(rows)
    return sensor.table(rows).with_payload(own.values.payload).with_line_numbers(own.lines)


def _divided(rows: FileRows, sensors: Sequence[SensorColumns]) -> list[tuple[SensorColumns, FileRows]]:
    """Each kind and the lines that hold it; MeasurementError for lines without any."""
    if rows.alone:
        return [(sensors[0], rows)]
    filled = [sensor.filled(rows) for sensor in sensors]
    empty = [rows.lines[row] for row in (~torch.stack(filled).any(0)).nonzero()[:, 0].tolist()]
    if empty:
        what, words = f"file '{rows.cells.path}', line {few(empty)}", [sensor.word for sensor in sensors]
        fix, got = "fill in one of them, or remove the line", "neither" if len(words) == 2 else "none of them"
        expected = " or ".join([", ".join(words[:-1]), words[-1]])
        raise MeasurementError.of(what, expected=expected, got=got, fix=fix)
    return [(sensor, rows.of(here)) for sensor, here in zip(sensors, filled, strict=True)]


def _check_options(columns: TableColumns, table: TableFormat) -> None:
    if not columns.sensors:
        fix = "name the columns of the marker, or those of `socket`"
        raise MeasurementError.of("`position` is missing", fix=fix)
    if columns.position is not None:
        return
    given = {"rotation": table.rotation, "rotation_std": table.rotation_std, "std": table.std}
    given |= {"camera_on_tool": table.camera_on_tool or None, "session": columns.session}
    names = [f"`{name}`" for name, value in given.items() if value is not None]
    if names:
        beside = "socket" if columns.sockets is not None else "readings"
        fix = "leave it out: no position was measured; sockets of another set-up are other places"
        raise MeasurementError.of(f"{' and '.join(names)} beside `{beside}`", fix=fix)


def without_copies(path: Path, data: Rows, lines: Sequence[int] | Tensor, drop: bool) -> Rows:
    """Drop or refuse the rows that repeat an earlier one exactly."""
    copies, count = data.copies(), len(data.q)
    at = [int(line) for line in lines]
    if copies and not drop:
        pairs = few([f"{at[row]} repeats {at[earlier]}" for earlier, row in copies])
        what = f"file '{path}': {len(copies)} line(s) repeat an earlier line exactly: line {pairs}"
        fix = "real repeats differ by noise: remove these lines, or pass duplicates='drop' or duplicates='keep'"
        raise MeasurementError.of(what, fix=fix)
    dropped = [row for _, row in copies]
    if dropped:
        text = f"file '{path}': dropped {len(dropped)} line(s) that repeat an earlier line exactly"
        warn_user(f"{text} (line {few([at[row] for row in dropped])}); pass duplicates='keep' to keep them.")
    return data.rows(np.setdiff1d(np.arange(count), dropped))
