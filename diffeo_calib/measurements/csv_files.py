"""Tables as CSV files: any separator, decimal mark and unit in the file, SI inside.

Units exist only at these doors, where they must be named: they are never guessed, only doubted with a
warning. Every mistake in a file is one error that names the file, the line and the column.
"""

from __future__ import annotations

import csv
import warnings
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, MeasurementError, few, sentence
from diffeo_calib.measurements.csv_cells import read_columns
from diffeo_calib.measurements.csv_columns import (
    ChainLike,
    Columns,
    Format,
    Orientation,
    Values,
    check_choice,
    check_count,
    default_triples,
    position_triples,
)
from diffeo_calib.measurements.poses import rotation_matrices, rotation_numbers, transforms
from diffeo_calib.measurements.table import LEVER, Measurements


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

    Only the named columns are read as numbers; the others may hold anything. Blank lines are skipped.

    Args:
        path: the file.
        joints: names of the joint columns in the robot's order, or the robot (``joint_names``, ``kinds``).
        position: names of the x, y and z columns of the marker, or one such triple per marker.
        length: unit of the positions **and of the prismatic joints** in the file, ``"m"`` or ``"mm"``.
        angle: unit of the revolute joints in the file, ``"rad"`` or ``"deg"``.
        sep: one character between cells.
        decimal: ``"."`` or ``","``.
        duplicates: what to do with rows that copy an earlier row exactly: ``"error"`` refuses them, ``"keep"``
            keeps them, ``"drop"`` drops them with a warning. Real repeats differ by noise.
        kinds: kind of every joint; without it, those of the robot, or all revolute.
        rotation: names of the columns of the tool's rotation, for measured poses; ``position`` is then the one triple
            of the frame's origin, and rotation and position lead from the tool's frame to the measuring frame.
        convention: how the rotation is written: ``"rotvec"``, ``"quat_xyzw"``, ``"quat_wxyz"``, ``"matrix"`` (nine
            columns row by row) or an order of Euler angles: ``"xyz"`` about fixed, ``"XYZ"`` about turned axes.
        rotation_angle: unit of Euler angles, rotation vectors and ``rotation_std``, ``"rad"`` or ``"deg"``.
        lever: of :meth:`Measurements.from_poses`, in m whatever the file's unit is.
        std: names of columns with standard deviations of the positions, in the unit of length: one for all, one
            per marker or three per marker.
        rotation_std: three columns with standard deviations of the rotation about the axes of the measuring frame;
            those of Euler angles are about other axes.

    Returns:
        Measurements in rad and m, rows in the order of the file.

    Raises:
        MeasurementError: anything unreadable, missing, ragged, not finite or repeated (file, line and column named);
            numbers that are no rotation, standard deviations that are not positive.

    Warns:
        DiffeoCalibWarning: values that look as if they were in the other unit; rows dropped.
    """
    check_choice("duplicates", duplicates, ("error", "keep", "drop"))
    orientation = Orientation.of(rotation, convention, rotation_angle, rotation_std)
    columns = Columns.of(joints, kinds, position_triples(position), orientation=orientation, std=std)
    values, lines = _read(Path(path), columns, Format(length, angle, sep, decimal))
    data = _measurements(Path(path), values, lines, columns, lever).with_numbers(lines)
    return data if duplicates == "keep" else _without_copies(Path(path), data, lines, drop=duplicates == "drop")


def read_joints(
    path: str | PathLike[str],
    joints: Sequence[str] | ChainLike,
    *,
    angle: str,
    length: str = "m",
    sep: str = ",",
    decimal: str = ".",
    kinds: Sequence[str] | None = None,
) -> Tensor:
    """Read joint configurations alone from a CSV file, such as those to predict at.

    Args, errors and warnings are those of :func:`read_measurements`; ``length`` is the unit of prismatic joints.

    Returns:
        (N, n) in rad (revolute) and m (prismatic), rows in the order of the file.
    """
    values, _ = _read(Path(path), Columns.of(joints, kinds, []), Format(length, angle, sep, decimal))
    return values.q


def write_measurements(
    path: str | PathLike[str],
    data: Measurements,
    *,
    length: str,
    angle: str,
    joints: Sequence[str] | ChainLike | None = None,
    position: Sequence[str] | Sequence[Sequence[str]] | None = None,
    sep: str = ",",
    decimal: str = ".",
    kinds: Sequence[str] | None = None,
    rotation: Sequence[str] | None = None,
    convention: str | None = None,
    rotation_angle: str | None = None,
    std: Sequence[str] | Sequence[Sequence[str]] | None = None,
    rotation_std: Sequence[str] | None = None,
) -> None:
    """Write a CSV file that :func:`read_measurements` reads back with the same options; overwrites.

    In rad and m the round trip of joints and points is exact; otherwise it is exact to the last digits of float64.
    Standard deviations are written if they are known.

    Args:
        path: the file.
        data: measurements, rad and m.
        length: unit of positions and prismatic joints in the file, ``"m"`` or ``"mm"``.
        angle: unit of revolute joints in the file, ``"rad"`` or ``"deg"``.
        joints: names of the joint columns, or the robot; default ``data.joint_names`` or q1, q2, ...
        position: x, y, z columns of every marker; default x, y, z for one marker or poses, else ``NAME_x``, ... with
            ``data.marker_names`` or marker1, marker2, ...
        sep: one character between cells.
        decimal: ``"."`` or ``","``.
        kinds: kind of every joint; without it, those of the robot, or all revolute.
        rotation: columns of the rotation of poses; default rx, ry, rz for a rotation vector, qx, qy, qz, qw or qw,
            qx, qy, qz for a quaternion, r11, r12, ..., r33 for a matrix, euler1, euler2, euler3 for Euler angles.
        convention: of the rotation, as for reading; default ``"rotvec"``.
        rotation_angle: unit of the rotation's angles in the file; default that of ``angle``.
        std: three columns per marker; default std_x, ... for a position column x, ...
        rotation_std: three columns; default std_rx, std_ry, std_rz, about the axes of the measuring frame.

    Raises:
        MeasurementError: unknown unit, a number of names that does not match, names for what the measurements do not
            hold, or a place that cannot be written.
    """
    layout = Format(length, angle, sep, decimal)
    names = joints or data.joint_names or [f"q{i + 1}" for i in range(data.n)]
    triples = position_triples(position or default_triples(data))
    check_count("position triples", triples, data.markers if data.poses is None else 1, "marker")
    _check_held(data, rotation=rotation, convention=convention, rotation_angle=rotation_angle)
    _check_held(data, std=std, rotation_std=rotation_std)
    orientation = None
    if data.poses is not None:
        known = data.rotation_std is not None
        unit = rotation_angle or angle
        orientation = Orientation.default(rotation, convention or "rotvec", unit, rotation_std, known=known)
    if data.std is not None and std is None:
        std = [f"std_{name}" for triple in triples for name in triple]
    columns = Columns.of(names, kinds, triples, orientation=orientation, std=std)
    check_count("joint columns", columns.joints, data.n, "joint")
    if data.std is not None:
        check_count("columns of standard deviations", columns.std, 3 * len(triples), "coordinate")
    _write(Path(path), columns.names, _table(data, layout, columns), layout)


def write_predictions(
    path: str | PathLike[str],
    q: Tensor,
    points: Tensor,
    deviations: Tensor,
    *,
    joints: Sequence[str],
    length: str,
    angle: str,
    sep: str = ",",
    decimal: str = ".",
    kinds: Sequence[str] | None = None,
    poses: Tensor | None = None,
    rotation_deviations: Tensor | None = None,
    convention: str = "rotvec",
    rotation_angle: str | None = None,
) -> None:
    """Write configurations, predicted markers and their standard deviations; overwrites.

    Columns: the joints, then x, y, z, std_x, std_y, std_z, for several markers each with the prefix marker1_, ...
    Poses add the columns of the rotation, named as by :func:`write_measurements`, and std_rx, std_ry, std_rz.

    Args:
        path: the file.
        q: (N, n) configurations, rad and m.
        points: (N, P, 3) markers, m; of poses (N, 1, 3) the positions.
        deviations: (N, P, 3) standard deviations, m.
        joints: names of the joint columns.
        length: unit of lengths in the file, ``"m"`` or ``"mm"``.
        angle: unit of revolute joints in the file, ``"rad"`` or ``"deg"``.
        sep: one character between cells.
        decimal: ``"."`` or ``","``.
        kinds: kind of every joint; all revolute without it.
        poses: (N, 4, 4) predicted poses, m.
        rotation_deviations: (N, 3) standard deviations of their rotations, rad, about the measuring frame's axes.
        convention: how the rotations are written. rotation_angle: their unit; default that of ``angle``.

    Raises:
        MeasurementError: unknown unit or convention, or a place that cannot be written.
    """
    layout, columns = Format(length, angle, sep, decimal), Columns.of(joints, kinds, [])
    markers = points.shape[1]
    prefixes = [f"marker{k + 1}_" for k in range(markers)] if markers > 1 else [""]
    names = [f"{prefix}{kind}{axis}" for prefix in prefixes for kind in ("", "std_") for axis in "xyz"]
    parts = [layout.from_si(q, torch.cat([points, deviations], -1), columns)]
    if poses is not None:
        known = rotation_deviations is not None
        turn = Orientation.default(None, convention, rotation_angle or angle, None, known=known)
        names = [*names, *turn.columns, *turn.std]
        parts += _rotation_parts(poses, rotation_deviations, turn)
    _write(Path(path), [*columns.joints, *names], torch.cat(parts, dim=1), layout)


def _write(path: Path, names: Sequence[str], table: Tensor, layout: Format) -> None:
    """Write a table (N, columns) whose numbers are already in the units of the file."""
    try:
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, delimiter=layout.sep)
            writer.writerow(names)
            writer.writerows([repr(value).replace(".", layout.decimal) for value in row] for row in table.tolist())
    except OSError as error:
        what = f"file '{path}' cannot be written ({error.strerror})"
        raise MeasurementError(sentence(what, fix="choose an existing, writable folder")) from error


def _table(data: Measurements, layout: Format, columns: Columns) -> Tensor:
    """All columns of measurements, (N, c), in the units of the file."""
    points = data.points if data.poses is None else data.poses[:, None, :3, 3]
    std = [] if data.std is None else [layout.lengths(data.std)]
    turns: list[Tensor] = []
    if data.poses is not None and columns.orientation is not None:
        turns = _rotation_parts(data.poses, data.rotation_std, columns.orientation)
    return torch.cat([layout.from_si(data.q, points, columns), *turns[:1], *std, *turns[1:]], dim=1)


def _rotation_parts(poses: Tensor, std: Tensor | None, turn: Orientation) -> list[Tensor]:
    """Rotations (N, k), and their standard deviations (N, 3) if known, in the units of the file."""
    numbers = rotation_numbers(poses[:, :3, :3], turn.convention, angle=turn.angle).cpu()
    return [numbers] if std is None else [numbers, std.cpu().rad2deg() if turn.angle == "deg" else std.cpu()]


def _check_held(data: Measurements, **options: object) -> None:
    """Refuse names for columns that the measurements cannot fill."""
    held = {"std": data.std, "rotation_std": data.rotation_std}
    empty = [name for name, value in options.items() if value is not None and held.get(name, data.poses) is None]
    if empty:
        what = " and ".join(f"`{name}`" for name in empty)
        got = "measurements without " + ("standard deviations" if empty[0] in held else "poses")
        raise MeasurementError(sentence(what, got=got, fix="leave it out"))


def _read(path: Path, columns: Columns, layout: Format) -> tuple[Values, list[int]]:
    """Return what the columns hold, and the line number of every row."""
    raw, lines = read_columns(path, columns.names, layout.sep, layout.decimal)  # (N, c), units of the file
    for doubt in layout.doubts(raw, columns):
        warnings.warn(f"file '{path}': {doubt}", DiffeoCalibWarning, stacklevel=3)
    _check_deviations(path, raw[:, len(columns.names) - len(columns.deviations) :], lines, columns.deviations)
    return layout.to_si(raw, columns), lines


def _check_deviations(path: Path, values: Tensor, lines: Sequence[int], names: Sequence[str]) -> None:
    bad = (values <= 0).nonzero()
    if len(bad):
        row, column = (int(i) for i in bad[0])
        what = f"file '{path}', line {lines[row]}, column '{names[column]}'"
        others = f" ({len(bad)} such cells)" * (len(bad) > 1)
        got, fix = f"{float(values[row, column]):g}{others}", "repair these lines, or do without this column"
        raise MeasurementError(sentence(what, expected="a positive standard deviation", got=got, fix=fix))


def _measurements(path: Path, values: Values, lines: Sequence[int], columns: Columns, lever: float) -> Measurements:
    """Measurements of points, or of poses if there are rotations."""
    turn = columns.orientation
    if turn is None:
        return Measurements(values.q, values.points, columns.joints, std=values.std, doubt=False)

    def place(row: int) -> str:
        return f"file '{path}', line {lines[row]}, columns {', '.join(turn.columns)}"

    try:
        rotations = rotation_matrices(values.rotations, turn.convention, angle=turn.angle, place=place)
    except InputError as error:
        raise MeasurementError(str(error)) from None
    std = None if values.std is None else values.std[:, 0]
    return Measurements.from_poses(
        values.q,
        transforms(rotations, values.points[:, 0]),
        columns.joints,
        lever=lever,
        position_std=std,
        rotation_std=values.rotation_std,
        doubt=False,
    )


def _without_copies(path: Path, data: Measurements, lines: Sequence[int], drop: bool) -> Measurements:
    """Drop or refuse the rows that copy an earlier one."""
    copies = data.copies()
    if copies and not drop:
        listed = few([f"{lines[row]} repeats {lines[earlier]}" for earlier, row in copies])
        what = f"file '{path}': {len(copies)} line(s) repeat an earlier line exactly: line {listed}"
        fix = "real repeats differ by noise: remove them, or pass duplicates='drop' or duplicates='keep'"
        raise MeasurementError(sentence(what, fix=fix))
    dropped = [row for _, row in copies]
    if dropped:
        text = f"file '{path}': dropped {len(dropped)} line(s) that repeat an earlier one exactly"
        text = f"{text} (line {few([lines[row] for row in dropped])}); pass duplicates='keep' to keep them."
        warnings.warn(text, DiffeoCalibWarning, stacklevel=3)
    return data.rows(np.setdiff1d(np.arange(len(data)), dropped))
