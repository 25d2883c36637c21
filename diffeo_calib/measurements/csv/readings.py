"""The columns of a CSV file with readings of devices that measure no position."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, shown, warn_user
from diffeo_calib.measurements.csv.cells import BadCells, read_texts
from diffeo_calib.measurements.csv.columns import ChainLike, Columns
from diffeo_calib.measurements.csv.files import without_copies
from diffeo_calib.measurements.csv.tables import TableFile
from diffeo_calib.measurements.readings import ReadingKind, Readings
from diffeo_calib.measurements.table_checks import file_sha256
from diffeo_calib.measurements.table_format import TableFormat, check_choice
from diffeo_calib.measurements.unit_checks import unlikely_position_units

LOG = logging.getLogger(__name__)
ONE_READING = "every line is one reading of one device: fill the cell in, or remove the line"


@dataclass(frozen=True)
class ReadingColumns:
    """How a table holds readings.

    Args:
        kind: of the readings. values: name of their column, of two columns for images, or one number for all rows, in
            the unit of length of the table.
        device: name of the column that names the device of each row; None for one device.
        offset_std: of the unknown zero of distances, m. intrinsics: fx, fy, cx, cy of the camera in pixels.
    """

    kind: ReadingKind
    values: tuple[str, ...] | float
    device: str | None = None
    offset_std: float = 0.0
    intrinsics: tuple[float, float, float, float] = (1.0, 1.0, 0.0, 0.0)

    def seen(self, path: Path, table: TableFormat, lines: Sequence[int]) -> Tensor:
        """(N, r) the readings in these lines of a file, in its unit of length or in pixels."""
        if not isinstance(self.values, tuple):
            return torch.full((len(lines), 1), self.values, dtype=torch.float64, device=HOST)
        return torch.stack([_numbers(path, table, name, lines) for name in self.values], 1)

    def check_lengths(self, path: Path, seen: Tensor, lines: Sequence[int]) -> None:
        """Raise MeasurementError for absolute distances (N, 1) in these lines of a file that are not positive."""
        if self.kind != "distance" or self.offset_std or not isinstance(self.values, tuple):
            return
        bad = BadCells()
        for row in (seen[:, 0] <= 0.0).nonzero()[:, 0].tolist():
            bad.add(lines[row], self.values[0], f"{float(seen[row, 0]):g}")
        if bad.count:
            fix = "repair or remove these lines; distances with an unknown zero are displacements"
            raise bad.error(path, "a distance above 0", fix)

    def readings(self, q: Tensor, seen: Tensor, devices: list[str] | None, joints: Sequence[str]) -> Readings:
        """The readings (N, r), in m or in pixels, of configurations (N, n)."""
        if self.kind == "image":
            fx, fy, cx, cy = self.intrinsics
            return Readings.images(q, seen, devices, joints, focal=(fx, fy), centre=(cx, cy), doubt=False)
        if self.kind == "height":
            return Readings.heights(q, seen, devices, joints, doubt=False)
        return Readings.distances(q, seen, devices, joints, offset_std=self.offset_std, doubt=False)


def read_readings(
    path: str | PathLike[str],
    joints: Sequence[str] | ChainLike,
    columns: ReadingColumns,
    table: TableFormat,
    *,
    duplicates: str = "error",
    kinds: Sequence[str] | None = None,
) -> Readings:
    """Read a table of readings; the other arguments and errors are those of :func:`read_measurements`."""
    check_choice("duplicates", duplicates, ("error", "keep", "drop"))
    path, own = Path(path), Columns.of(table.joints_only(), joints, kinds, [])
    with TableFile(path, own) as file:
        values, lines = file.read()
    seen = columns.seen(path, table, lines)
    columns.check_lengths(path, seen, lines)
    devices = None if columns.device is None else _devices(path, table, columns.device, lines)
    data = columns.readings(values.q, seen / table.per_metre ** (columns.kind != "image"), devices, own.joints)
    if columns.kind == "distance":
        for text in unlikely_position_units(float(seen.abs().max()), table.length):
            warn_user(f"file '{path}': {text}".replace("positions", "distances"))
    numbers = torch.tensor(lines, dtype=torch.int64, device=HOST)
    data = replace(data, line_numbers=numbers, file_sha256=file_sha256(path))
    LOG.info("read %d rows of %s", len(data), shown(path))
    return data if duplicates == "keep" else without_copies(path, data, lines, drop=duplicates == "drop")


def _devices(path: Path, table: TableFormat, column: str, lines: Sequence[int]) -> list[str]:
    """(N,) names of the devices of these lines."""
    expected = "the name of the device of this reading"
    return read_texts(path, table.sep, column, lines, expected=expected, fix=ONE_READING)


def _numbers(path: Path, table: TableFormat, column: str, lines: Sequence[int]) -> Tensor:
    """(N,) the cells of a column in the unit of the file."""
    found = []
    texts = read_texts(path, table.sep, column, lines, expected="a number", fix=ONE_READING)
    for line, text in zip(lines, texts, strict=True):
        try:
            value = float(text.replace(table.decimal, ".")) if table.decimal == "." or "." not in text else float("nan")
        except ValueError:
            value = float("nan")
        if not isfinite(value):
            what = f"file '{path}', line {line}, column '{column}'"
            fix = "repair or remove this line; pass `decimal` if the numbers have another decimal mark"
            raise MeasurementError.of(what, expected="a number", got=shown(repr(text)), fix=fix)
        found.append(value)
    return torch.tensor(found, dtype=torch.float64, device=HOST)
