"""Tables as CSV files: any separator, decimal mark and unit in the file, SI inside.

Units must be named: they are never guessed, but values that look as if they were in another unit cause a warning.
Every mistake in a file is one error that names the file, the line and the column.
"""

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
from diffeo_calib.measurements.csv.cells import read_texts
from diffeo_calib.measurements.csv.columns import (
    ChainLike,
    Columns,
    check_count,
    position_triples,
)
from diffeo_calib.measurements.csv.origin import TableOrigin
from diffeo_calib.measurements.csv.rows import rotation_parts, write_rows
from diffeo_calib.measurements.csv.sockets import SocketColumns, check_socket_options, read_rows_in_sockets
from diffeo_calib.measurements.csv.tables import TableFile, to_measurements
from diffeo_calib.measurements.pose_frames import seen_bodies
from diffeo_calib.measurements.poses import LEVER
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.sockets import Distances, require_positions
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_checks import file_sha256
from diffeo_calib.measurements.table_format import Names, TableFormat, check_choice
from diffeo_calib.measurements.table_frame import default_triples, frame_prefixes
from diffeo_calib.measurements.tool_camera import inverse_poses

LOG = logging.getLogger(__name__)
Rows = TypeVar("Rows", Measurements, Readings)


@outside_inference_mode
def read_measurements(
    path: str | PathLike[str],
    joints: Sequence[str] | ChainLike,
    position: Names | None = None,
    *,
    length: str,
    angle: str,
    sep: str = ",",
    decimal: str = ".",
    duplicates: str = "error",
    kinds: Sequence[str] | None = None,
    rotation: Names | None = None,
    convention: str | None = None,
    rotation_angle: str | None = None,
    lever: float = LEVER,
    std: Names | None = None,
    rotation_std: Names | None = None,
    joint_length: str | None = None,
    payload: str | None = None,
    on: Sequence[str] | None = None,
    camera_on_tool: bool = False,
    session: str | None = None,
    socket: Sequence[str] | str | None = None,
    distances: Distances | None = None,
    distance_std: float | None = None,
) -> Measurements:
    """Read a table of measurements from a CSV file (UTF-8, one header line) and convert it to SI.

    Only the named columns are read as numbers; other columns may hold anything. Blank lines are skipped. With several
    markers, the cells x, y and z of a marker are all empty where it was hidden; with several frames all of a frame's.

    Args:
        path: the file.
        joints: names of the joint columns in the robot's order, or the robot (``joint_names``, ``kinds``).
        position: names of the x, y and z columns of the marker, or one such triple per marker; None if all rows are in
            sockets. With ``socket`` every row has either a position or a socket, and empty cells for the other.
        length: unit of the positions in the file, ``"m"`` or ``"mm"``.
        angle: unit of the revolute joints in the file, ``"rad"`` or ``"deg"``.
        sep: one character between cells.
        decimal: ``"."`` or ``","``.
        duplicates: what to do with rows that repeat an earlier row exactly: ``"error"`` refuses them, ``"keep"``
            keeps them, ``"drop"`` drops them with a warning. Real repeats differ by noise.
        kinds: kind of every joint; by default those of the robot, or all revolute.
        rotation: names of the columns of the tool's rotation, for measured poses, or one such list for each frame on
            several tips. ``position`` is then the triple of the frame's origin, or one for each. Rotation and position
            map from the tool's frame to the measuring frame.
        convention: how all rotations are written: ``"rotvec"``, ``"quat_xyzw"``, ``"quat_wxyz"``, ``"matrix"`` (nine
            columns row by row) or an order of Euler angles: extrinsic as ``"xyz"``, intrinsic as ``"XYZ"``.
        rotation_angle: unit of Euler angles, rotation vectors and ``rotation_std``, ``"rad"`` or ``"deg"``.
        lever: see :meth:`Measurements.from_poses`; in m, whatever the unit of length in the file.
        std: names of columns with standard deviations of the positions, in the unit of length: one for all, one
            per marker or three per marker.
        rotation_std: names of columns with standard deviations of the rotation about the axes of the measuring frame,
            which are not the axes of Euler angles: one for all, or one or three for each frame.
        joint_length: unit of the prismatic joints in the file, ``"m"`` or ``"mm"``; that of the positions by default.
        payload: name of a column with the known mass that the robot carried at its tip, in any unit; 0 without load.
            For another link see :meth:`Measurements.with_payload`.
        session: name of a column whose texts tell the set-ups of the measuring device apart, see :meth:`with_sessions`.
        camera_on_tool: the poses are those of a fixed board in the frame of a camera on the tool, and standard
            deviations are along its axes; see :meth:`Measurements.from_poses`.
        on: names of the tips that carry the markers or frames, one for each, for a robot with several tips.
        socket: names of the columns that name the socket which held the ball, such as ``["place", "socket"]``; see
            :meth:`Measurements.from_sockets`. The place is the first, or all but the last.
        distances: known distances between sockets, in m, whatever the unit of length in the file.
        distance_std: their standard deviation, m.

    Returns:
        Measurements in rad and m, rows in the order of the file.

    Raises:
        MeasurementError: anything unreadable, missing, ragged, not finite or repeated (file, line and column are
            named); numbers that do not form a rotation, standard deviations that are not positive.

    Warns:
        DiffeoCalibWarning: values that look as if they were in another unit; rows dropped.
    """
    plain = TableFormat(length, angle, sep, decimal, rotation, convention, rotation_angle, lever)
    table = replace(plain, std=std, rotation_std=rotation_std, joint_length=joint_length, payload=payload)
    table = replace(table, camera_on_tool=camera_on_tool)
    rows = {"duplicates": duplicates, "kinds": kinds}
    if socket is not None:
        check_socket_options(position, table, session)
        names = SocketColumns((socket,) if isinstance(socket, str) else tuple(socket), distances, distance_std)
        return read_socket_table(path, joints, names, table, **rows, position=position, session=session, on=on)
    if distances is not None or distance_std is not None:
        raise MeasurementError.of("`distances` without `socket`", fix="name the columns of the sockets too")
    if position is None:
        raise MeasurementError.of("`position` is missing", fix="name the columns of the marker, or those of `socket`")
    return read_table(path, joints, position, table, **rows, session=session).with_tips(on)


def read_table(
    path: str | PathLike[str],
    joints: Sequence[str] | ChainLike,
    position: Names,
    table: TableFormat,
    *,
    duplicates: str = "error",
    kinds: Sequence[str] | None = None,
    session: str | None = None,
) -> Measurements:
    """The same as :func:`read_measurements` for a format that is given as one object."""
    check_choice("duplicates", duplicates, ("error", "keep", "drop"))
    columns = Columns.of(table.for_reading(), joints, kinds, position_triples(position))
    with TableFile(Path(path), columns) as file:
        values, lines = file.read()
    data = to_measurements(Path(path), values, lines, columns).with_line_numbers(lines)
    if session is not None:
        data = data.with_sessions(read_texts(Path(path), table.sep, session, lines))
    sha256 = file_sha256(Path(path))
    data = data.with_file_sha256(sha256).with_origin(TableOrigin(Path(path), columns, sha256))
    LOG.info("read %d rows of %s", len(data), shown(path))
    return data if duplicates == "keep" else without_copies(Path(path), data, lines, drop=duplicates == "drop")


def read_socket_table(
    path: str | PathLike[str],
    joints: Sequence[str] | ChainLike,
    sockets: SocketColumns,
    table: TableFormat,
    *,
    duplicates: str = "error",
    **options: Any,
) -> Measurements:
    """Read rows in which a ball rested in sockets, see :func:`read_rows_in_sockets`; errors of `read_measurements`."""
    check_choice("duplicates", duplicates, ("error", "keep", "drop"))
    data = read_rows_in_sockets(Path(path), joints, sockets, table, **options)
    data = data.with_file_sha256(file_sha256(Path(path)))
    LOG.info("read %d rows of %s", len(data), shown(path))
    if duplicates == "keep":
        return data
    return without_copies(Path(path), data, data.line_numbers.tolist(), drop=duplicates == "drop")


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
    with open_joints(path, joints, table, kinds=kinds) as file:
        return file.read()[0].q


def open_joints(
    path: str | PathLike[str],
    joints: Sequence[str] | ChainLike,
    table: TableFormat,
    *,
    kinds: Sequence[str] | None = None,
) -> TableFile:
    """The same file as :func:`read_joints` reads, to be read in blocks."""
    return TableFile(Path(path), Columns.of(table.joints_only(), joints, kinds, []))


def open_measurements(
    path: str | PathLike[str],
    joints: Sequence[str] | ChainLike,
    position: Names,
    table: TableFormat,
    *,
    kinds: Sequence[str] | None = None,
) -> TableFile:
    """The same file as :func:`read_table` reads, to be read in blocks; exact repeats of rows are kept."""
    return TableFile(Path(path), Columns.of(table.for_reading(), joints, kinds, position_triples(position)))


def write_measurements(
    path: str | PathLike[str],
    data: Measurements,
    table: TableFormat,
    *,
    joints: Sequence[str] | ChainLike | None = None,
    position: Names | None = None,
    kinds: Sequence[str] | None = None,
) -> None:
    """Write a CSV file that :func:`read_measurements` reads back with the same format; overwrites.

    In rad and m the round trip of joints and points is exact; in other units it is exact to the last digits of
    float64. Standard deviations and payloads are written if they are known. The cells of hidden markers are empty.

    Args:
        path: the file.
        data: measurements, rad and m.
        table: the format. Defaults: convention ``"rotvec"``, ``rotation_angle`` that of ``angle``; for the columns of
            the rotation rx, ry, rz for a rotation vector, qx, qy, qz, qw or qw, qx, qy, qz for a quaternion, r11, r12,
            ..., r33 for a matrix, and euler1, euler2, euler3 for Euler angles, with TIP_ before them for frames on
            several tips; for standard deviations std_x, ... for a position column x, ..., and std_rx, std_ry, std_rz
            for the rotation; payload for masses. ``std`` has three names per marker.
        joints: names of the joint columns, or the robot; default ``data.joint_names`` or q1, q2, ...
        position: x, y, z columns of every marker or frame; default x, y, z for one, else ``NAME_x``, ... with the names
            of the frames' tips, ``data.marker_names`` or marker1, marker2, ...
        kinds: kind of every joint; by default those of the robot, or all revolute.

    Raises:
        MeasurementError: unknown unit, a number of names that does not match, or names for something that the
            measurements do not hold.
        InputError: a file that cannot be written.
    """
    require_positions(data, "a table of positions", "its rows and the names of their sockets are in the table read")
    triples = position_triples(position or default_triples(data))
    bodies = seen_bodies(data).shape[1]
    check_count("position triples", triples, bodies, "marker" if data.poses is None else "frame")
    _check_held(data, table)
    if data.poses is not None:
        table = table.for_writing(rotation_std=data.rotation_std is not None, prefixes=frame_prefixes(data))
    if data.std is not None and table.std is None:
        table = replace(table, std=[f"std_{name}" for triple in triples for name in triple])
    if data.payload is not None and table.payload is None:
        table = replace(table, payload="payload")
    names = joints or data.joint_names or [f"q{i + 1}" for i in range(data.n)]
    columns = Columns.of(table, names, kinds, triples)
    check_count("joint columns", columns.joints, data.n, "joint")
    if data.std is not None:
        check_count("columns of standard deviations", columns.std, 3 * len(triples), "coordinate")
    write_rows(path, columns.names, [_in_file_units(data, columns)], table)


def _in_file_units(data: Measurements, columns: Columns) -> Tensor:
    """All columns of measurements, (N, c), in the units of the file."""
    frames = data.frames if data.frames is None or data.board is None else inverse_poses(data.frames)
    points = data.points if frames is None else frames[..., :3, 3]
    std = [] if data.std is None else [columns.lengths_from_si(data.std)]
    rotations = [] if frames is None else rotation_parts(frames, data.rotation_std, columns.table)
    parts = [columns.joints_from_si(data.q), columns.lengths_from_si(points), *rotations[:1]]
    parts += [] if data.payload is None else [data.payload.cpu()[:, None]]
    parts += [*std, *rotations[1:]]
    return torch.cat(parts, dim=1)


def _check_held(data: Measurements, table: TableFormat) -> None:
    """Refuse names for columns that the measurements cannot fill."""
    held = {"rotation": data.poses, "convention": data.poses, "rotation_angle": data.poses}
    deviations, payload = {"std": data.std, "rotation_std": data.rotation_std}, {"payload": data.payload}
    for group, what in ((held, "poses"), (deviations, "standard deviations"), (payload, "payloads")):
        empty = [name for name, values in group.items() if values is None and getattr(table, name) is not None]
        if empty:
            names = " and ".join(f"`{name}`" for name in empty)
            raise MeasurementError.of(names, got=f"measurements without {what}", fix="leave it out")
    if table.camera_on_tool != (data.board is not None):
        got = "poses seen by a camera on the tool" if data.board is not None else "measurements without such a camera"
        fix = f"pass camera_on_tool={data.board is not None}, and read the table with the same format"
        raise MeasurementError.of(f"`camera_on_tool` is {table.camera_on_tool}", got=got, fix=fix)


def without_copies(path: Path, data: Rows, lines: Sequence[int], drop: bool) -> Rows:
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
