"""Tables as CSV files: any separator, decimal mark and unit in the file, SI inside.

Units must be named: they are never guessed, but values that look as if they were in another unit cause a warning.
Every mistake in a file is one error that names the file, the line and the column.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError, few, warn_user
from diffeo_calib.common.files import write_whole
from diffeo_calib.common.inference_mode import outside_inference_mode
from diffeo_calib.measurements.csv_cells import read_columns
from diffeo_calib.measurements.csv_columns import (
    ChainLike,
    Columns,
    Values,
    check_count,
    default_triples,
    position_triples,
)
from diffeo_calib.measurements.poses import LEVER, rotation_matrices, rotation_numbers, transforms
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_checks import file_sha256
from diffeo_calib.measurements.table_format import TableFormat, check_choice


@outside_inference_mode
def read_measurements(
    path: str | PathLike[str],
    joints: Sequence[str] | ChainLike,
    position: Sequence[str] | Sequence[Sequence[str]],
    *,
    length: str,
    angle: str,
    sep: str = ",",
    decimal: str = ".",
    duplicates: str = "error",
    kinds: Sequence[str] | None = None,
    rotation: Sequence[str] | None = None,
    convention: str | None = None,
    rotation_angle: str | None = None,
    lever: float = LEVER,
    std: Sequence[str] | Sequence[Sequence[str]] | None = None,
    rotation_std: Sequence[str] | None = None,
) -> Measurements:
    """Read a table of measurements from a CSV file (UTF-8, one header line) and convert it to SI.

    Only the named columns are read as numbers; other columns may hold anything. Blank lines are skipped.

    Args:
        path: the file.
        joints: names of the joint columns in the robot's order, or the robot (``joint_names``, ``kinds``).
        position: names of the x, y and z columns of the marker, or one such triple per marker.
        length: unit of the positions **and of the prismatic joints** in the file, ``"m"`` or ``"mm"``.
        angle: unit of the revolute joints in the file, ``"rad"`` or ``"deg"``.
        sep: one character between cells.
        decimal: ``"."`` or ``","``.
        duplicates: what to do with rows that repeat an earlier row exactly: ``"error"`` refuses them, ``"keep"``
            keeps them, ``"drop"`` drops them with a warning. Real repeats differ by noise.
        kinds: kind of every joint; by default those of the robot, or all revolute.
        rotation: names of the columns of the tool's rotation, for measured poses. ``position`` is then the one triple
            of the frame's origin. Rotation and position map from the tool's frame to the measuring frame.
        convention: how the rotation is written: ``"rotvec"``, ``"quat_xyzw"``, ``"quat_wxyz"``, ``"matrix"`` (nine
            columns row by row) or an order of Euler angles: extrinsic as ``"xyz"``, intrinsic as ``"XYZ"``.
        rotation_angle: unit of Euler angles, rotation vectors and ``rotation_std``, ``"rad"`` or ``"deg"``.
        lever: see :meth:`Measurements.from_poses`; in m, whatever the unit of length in the file.
        std: names of columns with standard deviations of the positions, in the unit of length: one for all, one
            per marker or three per marker.
        rotation_std: names of three columns with standard deviations of the rotation about the axes of the measuring
            frame, which are not the axes of Euler angles.

    Returns:
        Measurements in rad and m, rows in the order of the file.

    Raises:
        MeasurementError: anything unreadable, missing, ragged, not finite or repeated (file, line and column are
            named); numbers that do not form a rotation, standard deviations that are not positive.

    Warns:
        DiffeoCalibWarning: values that look as if they were in another unit; rows dropped.
    """
    table = TableFormat(
        length, angle, sep, decimal, rotation, convention, rotation_angle, lever, std=std, rotation_std=rotation_std
    )
    return read_table(path, joints, position, table, duplicates=duplicates, kinds=kinds)


def read_table(
    path: str | PathLike[str],
    joints: Sequence[str] | ChainLike,
    position: Sequence[str] | Sequence[Sequence[str]],
    table: TableFormat,
    *,
    duplicates: str = "error",
    kinds: Sequence[str] | None = None,
) -> Measurements:
    """The same as :func:`read_measurements` for a format that is given as one object."""
    check_choice("duplicates", duplicates, ("error", "keep", "drop"))
    columns = Columns.of(table.for_reading(), joints, kinds, position_triples(position))
    values, lines = _read(Path(path), columns)
    data = _measurements(Path(path), values, lines, columns).with_line_numbers(lines)
    data = data.with_file_sha256(file_sha256(Path(path)))
    return data if duplicates == "keep" else _without_copies(Path(path), data, lines, drop=duplicates == "drop")


def read_joints(
    path: str | PathLike[str],
    joints: Sequence[str] | ChainLike,
    table: TableFormat,
    *,
    kinds: Sequence[str] | None = None,
) -> Tensor:
    """Read joint configurations alone from a CSV file, for instance to predict positions.

    Args, errors and warnings are those of :func:`read_measurements`. Of the format only units, separator and decimal
    mark matter.

    Returns:
        (N, n) in rad (revolute) and m (prismatic), rows in the order of the file.
    """
    values, _ = _read(Path(path), Columns.of(table.joints_only(), joints, kinds, []))
    return values.q


def write_measurements(
    path: str | PathLike[str],
    data: Measurements,
    table: TableFormat,
    *,
    joints: Sequence[str] | ChainLike | None = None,
    position: Sequence[str] | Sequence[Sequence[str]] | None = None,
    kinds: Sequence[str] | None = None,
) -> None:
    """Write a CSV file that :func:`read_measurements` reads back with the same format; overwrites.

    In rad and m the round trip of joints and points is exact; in other units it is exact to the last digits of
    float64. Standard deviations are written if they are known.

    Args:
        path: the file.
        data: measurements, rad and m.
        table: the format. Defaults: convention ``"rotvec"``, ``rotation_angle`` that of ``angle``; for the columns of
            the rotation rx, ry, rz for a rotation vector, qx, qy, qz, qw or qw, qx, qy, qz for a quaternion, r11, r12,
            ..., r33 for a matrix, and euler1, euler2, euler3 for Euler angles; for standard deviations std_x, ... for
            a position column x, ..., and std_rx, std_ry, std_rz for the rotation. ``std`` has three names per marker.
        joints: names of the joint columns, or the robot; default ``data.joint_names`` or q1, q2, ...
        position: x, y, z columns of every marker; default x, y, z for one marker or poses, else ``NAME_x``, ... with
            ``data.marker_names`` or marker1, marker2, ...
        kinds: kind of every joint; by default those of the robot, or all revolute.

    Raises:
        MeasurementError: unknown unit, a number of names that does not match, names for something that the
            measurements do not hold, or a file that cannot be written.
    """
    triples = position_triples(position or default_triples(data))
    check_count("position triples", triples, data.markers if data.poses is None else 1, "marker")
    _check_held(data, table)
    if data.poses is not None:
        table = table.for_writing(rotation_std=data.rotation_std is not None)
    if data.std is not None and table.std is None:
        table = replace(table, std=[f"std_{name}" for triple in triples for name in triple])
    names = joints or data.joint_names or [f"q{i + 1}" for i in range(data.n)]
    columns = Columns.of(table, names, kinds, triples)
    check_count("joint columns", columns.joints, data.n, "joint")
    if data.std is not None:
        check_count("columns of standard deviations", columns.std, 3 * len(triples), "coordinate")
    _write(Path(path), columns.names, _in_file_units(data, columns), table)


def write_predictions(
    path: str | PathLike[str],
    q: Tensor,
    points: Tensor,
    deviations: Tensor,
    table: TableFormat,
    *,
    joints: Sequence[str],
    kinds: Sequence[str] | None = None,
) -> None:
    """Write configurations, predicted markers and their standard deviations; overwrites.

    Columns: the joints, then x, y, z, std_x, std_y, std_z, for several markers each with the prefix marker1_, ...

    Args:
        path: the file.
        q: (N, n) configurations, rad and m.
        points: (N, P, 3) markers, m.
        deviations: (N, P, 3) standard deviations, m.
        table: units, separator and decimal mark.
        joints: names of the joint columns.
        kinds: kind of every joint; all revolute by default.

    Raises:
        MeasurementError: a file that cannot be written.
    """
    columns, markers = Columns.of(table.joints_only(), joints, kinds, []), points.shape[1]
    prefixes = [f"marker{k + 1}_" for k in range(markers)] if markers > 1 else [""]
    names = [f"{prefix}{kind}{axis}" for prefix in prefixes for kind in ("", "std_") for axis in "xyz"]
    lengths = columns.lengths_from_si(torch.cat([points, deviations], dim=-1))
    _write(Path(path), [*columns.joints, *names], torch.cat([columns.joints_from_si(q), lengths], dim=1), table)


def write_pose_predictions(
    path: str | PathLike[str],
    q: Tensor,
    poses: Tensor,
    deviations: Tensor,
    table: TableFormat,
    *,
    joints: Sequence[str],
    kinds: Sequence[str] | None = None,
) -> None:
    """Write configurations, predicted poses and their standard deviations; overwrites.

    Columns: the joints, then x, y, z, std_x, std_y, std_z, the columns of the rotation, and std_rx, std_ry, std_rz.

    Args:
        path: the file.
        q: (N, n) configurations, rad and m.
        poses: (N, 4, 4) predicted poses, m.
        deviations: (N, 6) standard deviations: of positions, m, and of rotations about the measuring frame's axes, rad.
        table: the format, with defaults as in :func:`write_measurements`.
        joints: names of the joint columns.
        kinds: kind of every joint; all revolute by default.

    Raises:
        MeasurementError: unknown unit or convention, or a file that cannot be written.
    """
    table = table.for_writing(rotation_std=True)
    columns = Columns.of(table.joints_only(), joints, kinds, [])
    names = [*columns.joints, *"xyz", "std_x", "std_y", "std_z", *(table.rotation or ()), *(table.rotation_std or ())]
    lengths = columns.lengths_from_si(torch.cat([poses[:, :3, 3], deviations[:, :3]], dim=1))
    rotations = _rotation_parts(poses, deviations[:, 3:], table)
    _write(Path(path), names, torch.cat([columns.joints_from_si(q), lengths, *rotations], dim=1), table)


def _write(path: Path, names: Sequence[str], rows: Tensor, table: TableFormat) -> None:
    """Write rows (N, columns) whose numbers are already in the units of the file."""
    try:
        text = io.StringIO(newline="")
        writer = csv.writer(text, delimiter=table.sep)
        writer.writerow(names)
        writer.writerows([repr(value).replace(".", table.decimal) for value in row] for row in rows.tolist())
        write_whole(path, text.getvalue().encode())
    except OSError as error:
        what = f"file '{path}' cannot be written ({error.strerror})"
        raise MeasurementError.of(what, fix="choose an existing, writable folder") from error


def _in_file_units(data: Measurements, columns: Columns) -> Tensor:
    """All columns of measurements, (N, c), in the units of the file."""
    points = data.points if data.poses is None else data.poses[:, :3, 3]
    std = [] if data.std is None else [columns.lengths_from_si(data.std)]
    rotations = [] if data.poses is None else _rotation_parts(data.poses, data.rotation_std, columns.table)
    parts = [columns.joints_from_si(data.q), columns.lengths_from_si(points), *rotations[:1], *std, *rotations[1:]]
    return torch.cat(parts, dim=1)


def _rotation_parts(poses: Tensor, std: Tensor | None, table: TableFormat) -> list[Tensor]:
    """Rotations (N, k), and their standard deviations (N, 3) if known, in the units of the file."""
    unit = table.rotation_angle or "rad"
    numbers = rotation_numbers(poses[:, :3, :3], table.convention or "rotvec", angle=unit).cpu()
    return [numbers] if std is None else [numbers, std.cpu().rad2deg() if unit == "deg" else std.cpu()]


def _check_held(data: Measurements, table: TableFormat) -> None:
    """Refuse names for columns that the measurements cannot fill."""
    held = {"rotation": data.poses, "convention": data.poses, "rotation_angle": data.poses}
    deviations = {"std": data.std, "rotation_std": data.rotation_std}
    for group, what in ((held, "poses"), (deviations, "standard deviations")):
        empty = [name for name, values in group.items() if values is None and getattr(table, name) is not None]
        if empty:
            names = " and ".join(f"`{name}`" for name in empty)
            raise MeasurementError.of(names, got=f"measurements without {what}", fix="leave it out")


def _read(path: Path, columns: Columns) -> tuple[Values, list[int]]:
    """Return the values of the columns, and the line number of every row."""
    raw, lines = read_columns(path, columns.names, columns.table.sep, columns.table.decimal)  # (N, c), file's units
    for text in columns.unlikely_units(raw):
        warn_user(f"file '{path}': {text}")
    _check_deviations(path, raw[:, len(columns.names) - len(columns.deviations) :], lines, columns.deviations)
    return columns.to_si(raw), lines


def _check_deviations(path: Path, values: Tensor, lines: Sequence[int], names: Sequence[str]) -> None:
    bad = (values <= 0).nonzero()
    if len(bad):
        row, column = (int(i) for i in bad[0])
        what = f"file '{path}', line {lines[row]}, column '{names[column]}'"
        count = f" ({len(bad)} such cells)" * (len(bad) > 1)
        got, fix = f"{float(values[row, column]):g}{count}", "repair these lines, or leave this column out"
        raise MeasurementError.of(what, expected="a positive standard deviation", got=got, fix=fix)


def _measurements(path: Path, values: Values, lines: Sequence[int], columns: Columns) -> Measurements:
    """Measurements of points, or of poses if there are rotations."""
    table = columns.table
    if table.convention is None:
        return Measurements(values.q, values.points, columns.joints, std=values.std, doubt=False)

    def place(row: int) -> str:
        return f"file '{path}', line {lines[row]}, columns {', '.join(columns.rotation)}"

    try:
        rotations = rotation_matrices(values.rotations, table.convention, angle=columns.rotation_unit, place=place)
    except InputError as error:
        raise MeasurementError(str(error)) from None
    return Measurements.from_poses(
        values.q,
        transforms(rotations, values.points[:, 0]),
        columns.joints,
        lever=table.lever,
        position_std=None if values.std is None else values.std[:, 0],
        rotation_std=values.rotation_std,
        doubt=False,
    )


def _without_copies(path: Path, data: Measurements, lines: Sequence[int], drop: bool) -> Measurements:
    """Drop or refuse the rows that repeat an earlier one exactly."""
    copies = data.copies()
    if copies and not drop:
        pairs = few([f"{lines[row]} repeats {lines[earlier]}" for earlier, row in copies])
        what = f"file '{path}': {len(copies)} line(s) repeat an earlier line exactly: line {pairs}"
        fix = "real repeats differ by noise: remove these lines, or pass duplicates='drop' or duplicates='keep'"
        raise MeasurementError.of(what, fix=fix)
    dropped = [row for _, row in copies]
    if dropped:
        text = f"file '{path}': dropped {len(dropped)} line(s) that repeat an earlier line exactly"
        warn_user(f"{text} (line {few([lines[row] for row in dropped])}); pass duplicates='keep' to keep them.")
    return data.rows(np.setdiff1d(np.arange(len(data)), dropped))
