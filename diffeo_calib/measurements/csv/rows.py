"""Rows of numbers written as CSV files, block by block: measurements and predictions."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from math import isnan
from os import PathLike

import torch
from torch import Tensor

from diffeo_calib.common.files import WholeFile
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.pose_frames import by_frame
from diffeo_calib.measurements.table_format import TableFormat, flat_names
from diffeo_calib.measurements.table_frame import visible_rotation_numbers

Cells = Sequence[Sequence[float | str]]
"""Rows of cells: numbers and texts."""
Predictions = tuple[Tensor, Tensor, Tensor]
"""Configurations (B, n) [rad or m], predicted points or poses, and their standard deviations."""


def write_predictions(
    path: str | PathLike[str],
    blocks: Iterable[Predictions],
    table: TableFormat,
    *,
    joints: Sequence[str],
    kinds: Sequence[str] | None = None,
    prefixes: Sequence[str] = ("",),
) -> None:
    """Write configurations, predicted markers and their standard deviations; overwrites.

    Columns: the joints, then x, y, z, std_x, std_y, std_z for each marker; of several markers with prefixes.

    Args:
        path: the file; it appears when the last block is written.
        blocks: configurations (B, n), rad and m, markers (B, P, 3), m, and their standard deviations (B, P, 3), m.
        table: units, separator and decimal mark.
        joints: names of the joint columns.
        kinds: kind of every joint; all revolute by default.
        prefixes: what the names of the columns of each marker begin with.

    Raises:
        InputError: a file that cannot be written.
    """
    columns = Columns.of(table.joints_only(), joints, kinds, [])
    names = [f"{prefix}{kind}{axis}" for prefix in prefixes for kind in ("", "std_") for axis in "xyz"]

    def rows(q: Tensor, points: Tensor, deviations: Tensor) -> Tensor:
        lengths = columns.lengths_from_si(torch.cat([points, deviations], dim=-1))
        return torch.cat([columns.joints_from_si(q), lengths], dim=1)

    write_rows(path, [*columns.joints, *names], (rows(*block) for block in blocks), table)


def write_pose_predictions(
    path: str | PathLike[str],
    blocks: Iterable[Predictions],
    table: TableFormat,
    *,
    joints: Sequence[str],
    kinds: Sequence[str] | None = None,
    prefixes: Sequence[str] = ("",),
) -> None:
    """Write configurations, predicted poses and their standard deviations; overwrites.

    Columns: the joints, then for each frame x, y, z, std_x, std_y, std_z, the columns of the rotation, and std_rx,
    std_ry, std_rz; of several frames with prefixes.

    Args:
        path: the file; it appears when the last block is written.
        blocks: configurations (B, n), rad and m, poses (B, 4, 4) or (B, T, 4, 4), m, and standard deviations (B, 6) or
            (B, T, 6): of positions, m, and of rotations about the measuring frame's axes, rad.
        table: the format, with defaults as in :func:`write_measurements`.
        joints: names of the joint columns.
        kinds: kind of every joint; all revolute by default.
        prefixes: what the names of the columns of each frame begin with.

    Raises:
        MeasurementError: unknown unit or convention.
        InputError: a file that cannot be written.
    """
    table = table.for_writing(rotation_std=True, prefixes=prefixes)
    columns = Columns.of(table.joints_only(), joints, kinds, [])
    turns, deviations = (_per_frame(flat_names(names), len(prefixes)) for names in (table.rotation, table.rotation_std))
    lengths = ("x", "y", "z", "std_x", "std_y", "std_z")
    names = list(columns.joints)
    for prefix, turn, deviation in zip(prefixes, turns, deviations, strict=True):
        names += [*(f"{prefix}{name}" for name in lengths), *turn, *deviation]

    def rows(q: Tensor, poses: Tensor, deviations: Tensor) -> Tensor:
        parts, spreads = [columns.joints_from_si(q)], deviations.reshape(len(q), -1, 6)
        for pose, own in zip(by_frame(poses).unbind(1), spreads.unbind(1), strict=True):
            parts.append(columns.lengths_from_si(torch.cat([pose[:, :3, 3], own[:, :3]], dim=1)))
            parts += rotation_parts(pose[:, None], own[:, 3:], table)
        return torch.cat(parts, dim=1)

    write_rows(path, names, (rows(*block) for block in blocks), table)


def _per_frame(names: Sequence[str], count: int) -> list[Sequence[str]]:
    each = len(names) // count
    return [names[k * each : (k + 1) * each] for k in range(count)]


def write_rows(
    path: str | PathLike[str],
    names: Sequence[str],
    blocks: Iterable[Tensor | Cells],
    table: TableFormat,
) -> None:
    """Write rows (B, columns) whose numbers are already in the units of the file; InputError if that fails.

    Texts are written as they are, NaN becomes an empty cell.
    """
    with WholeFile(path) as file:
        file.write(_text([names], table))
        for block in blocks:
            rows = block.tolist() if isinstance(block, Tensor) else block
            file.write(_text(([_cell(value, table) for value in row] for row in rows), table))


def _cell(value: float | str, table: TableFormat) -> str:
    if isinstance(value, str):
        return value
    return "" if isnan(value) else repr(value).replace(".", table.decimal)


def rotation_parts(frames: Tensor, std: Tensor | None, table: TableFormat) -> list[Tensor]:
    """Rotations (N, T k) of frames (N, T, 4, 4), and their standard deviations (N, 3 T) if known, in the file's units.

    NaN where hidden.
    """
    unit = table.rotation_angle or "rad"
    numbers = visible_rotation_numbers(frames, table.convention or "rotvec", unit).flatten(1).cpu()
    known = None if std is None else std.flatten(1).cpu()
    return [numbers] if known is None else [numbers, known.rad2deg() if unit == "deg" else known]


def _text(rows: Iterable[Sequence[str]], table: TableFormat) -> bytes:
    text = io.StringIO(newline="")
    csv.writer(text, delimiter=table.sep).writerows(rows)
    return text.getvalue().encode()
