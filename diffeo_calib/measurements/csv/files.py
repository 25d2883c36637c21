"""Tables as CSV files: any separator, decimal mark and unit in the file, SI inside.

Units must be named: they are never guessed, but values that look as if they were in another unit cause a warning.
Every mistake in a file is one error that names the file, the line and the column.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.errors import MeasurementError, as_written, few, shown, warn_user
from diffeo_calib.measurements.checks import file_sha256
from diffeo_calib.measurements.csv.columns import ChainLike, Columns, Joints
from diffeo_calib.measurements.csv.pose_columns import PoseColumns
from diffeo_calib.measurements.csv.sensors import FileRows, ReadingColumns, SensorColumns, SocketColumns, TableColumns
from diffeo_calib.measurements.csv.tables import TableFile, TableOrigin
from diffeo_calib.measurements.csv.writing import write_measurements  # noqa: F401  # read and written by one module
from diffeo_calib.measurements.observations import joined_tables
from diffeo_calib.measurements.poses import LEVER
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.measurements.sockets import Distances
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import Names, TableFormat, check_choice, column_names
from diffeo_calib.robots.se3 import transforms

LOG = logging.getLogger(__name__)
Rows = TypeVar("Rows", bound=RowGroups)


@outside_inference_mode
def read_observations(
    path: str | PathLike[str],
    columns: TableColumns,
    table: TableFormat,
    *,
    duplicates: str = "error",
    growing: bool = False,
) -> Any:
    """Read a table whose rows may be of several kinds; units and errors are those of :func:`read_measurements`.

    With several kinds, a line fills the cells of some of them and leaves the others empty. A line that fills those of
    two kinds is two observations, and so two rows with the same line number.

    Args:
        path: the file. columns: its columns. table: units, separator and decimal mark, columns of rotations, deviations
            and payloads. duplicates: "error", "keep" or "drop". growing: whether rows will be added, so that none may
            be judged by the others.

    Returns:
        :class:`Measurements` of positions, poses, sockets, or positions and sockets; :class:`Readings` of one kind;
        else :class:`Observations`. Rows are in the order of the file.
    """
    check_choice("duplicates", duplicates, ("error", "keep", "drop"))
    file = path if isinstance(path, Path) else Path(path)
    sensors, numbers = columns.sensors, columns.numeric(table)
    with TableFile(file, numbers, columns.texts) as whole:
        rows = FileRows(file, numbers, *whole.read(zeros=not growing), alone=len(sensors) == 1)
    tables = []
    for sensor, here in _divided(rows, sensors):
        own = sensor.own_lines(here)
        found = sensor.table(here).with_line_numbers(own.lines)
        time, temperature = own.values.get("time"), own.values.get("temperature")
        tables.append(found.with_payload(own.values.get("payload")).with_covariates(time=time, temperature=temperature))
    data = tables[0] if rows.alone else joined_tables(tables)
    data = data if rows.alone else data.rows(data.lines.argsort(stable=True))
    sha256 = file_sha256(file)
    data = data.with_file_sha256(sha256)
    if rows.alone and columns.position is not None:
        marker = columns.marker and f"{columns.marker.partition('=')[0]}={','.join(data.marker_names)}"
        data = data.with_origin(TableOrigin(file, numbers, sha256, columns.session, marker))
    LOG.info("read %d rows of %s", len(data), shown(path))
    return data if duplicates == "keep" else without_copies(file, data, data.lines, drop=duplicates == "drop")


def _divided(rows: FileRows, sensors: Sequence[SensorColumns]) -> list[tuple[SensorColumns, FileRows]]:
    """Each kind and the lines that hold it; MeasurementError for lines without any."""
    if rows.alone:
        return [(sensors[0], rows)]
    filled = [sensor.filled(rows) for sensor in sensors]
    for sensor in (sensor for sensor, here in zip(sensors, filled, strict=True) if not bool(here.any())):
        what = f"file '{rows.path}': no line holds {sensor.word}"
        raise MeasurementError.of(what, expected="some rows of this kind", fix="leave its columns out")
    empty = [rows.lines[row] for row in (~torch.stack(filled).any(0)).nonzero()[:, 0].tolist()]
    if empty:
        what, words = f"file '{rows.path}', line {few(empty)}", [sensor.word for sensor in sensors]
        fix, got = "fill in one of them, or remove the line", "neither" if len(words) == 2 else "none of them"
        expected = " or ".join([", ".join(words[:-1]), words[-1]])
        raise MeasurementError.of(what, expected=expected, got=got, fix=fix)
    return [(sensor, rows.of(here)) for sensor, here in zip(sensors, filled, strict=True)]


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


@outside_inference_mode
def read_measurements(
    path: str | PathLike[str],
    robot: Sequence[str] | ChainLike,
    position: Names | None = None,
    *,
    joints: Sequence[str] | None = None,
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
    time: str | None = None,
    temperature: str | None = None,
    on: Sequence[str] | None = None,
    camera_on_tool: bool = False,
    session: str | None = None,
    remounted: bool = False,
    marker: str | None = None,
    socket: Sequence[str] | str | None = None,
    distances: Distances | None = None,
    distance_std: float | None = None,
) -> Measurements:
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
            sockets. With ``socket`` every line has a position or a socket, and empty cells for the other; a line with
            both is two rows.
        length: unit of the positions in the file, ``"m"``, ``"mm"``, ``"cm"`` or ``"inch"``.
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
        joint_length: unit of the prismatic joints in the file, as ``length``; that of the positions by default.
        payload: name of a column with the known mass that the robot carried at its tip, in any unit; 0 without load.
            For another link see :meth:`Measurements.with_payload`.
        time, temperature: names of columns with which something may drift, see :meth:`Measurements.with_covariates`.
        session: name of a column whose texts tell the set-ups of the measuring device apart, see :meth:`with_sessions`.
        remounted: whether the markers were mounted anew between these instead, see there.
        marker: name of a column that names the marker of every line, where each has the position of one. Lines with the
            same joint values that follow each other are one row. Markers are in the order in which they appear, or, for
            rows of a model, in the one that ``"COLUMN=A,B,C"`` gives.
        camera_on_tool: the poses are those of a fixed board in the frame of a camera on the tool, and standard
            deviations are along its axes; see :meth:`Measurements.from_poses`.
        on: names of the tips that carry the markers or frames, one for each, for a robot with several tips.
        socket: names of the columns that name the socket which held the ball, such as ``["place", "socket"]``; see
            :meth:`Measurements.from_sockets`. The place is the first, or all but the last.
        distances: known distances between sockets, in m, whatever the unit of length in the file.
        distance_std: their standard deviation, m.

    Returns:
        Measurements in rad and m, rows in the order of the file; of poses beside rows in sockets
        :class:`~diffeo_calib.measurements.observations.Observations`.

    Raises:
        MeasurementError: anything unreadable, missing, ragged, not finite or repeated (file, line and column are
            named); numbers that do not form a rotation, standard deviations that are not positive.

    Warns:
        DiffeoCalibWarning: values that look as if they were in another unit; rows dropped; what was skipped.
    """
    plain = TableFormat(length, angle, sep, decimal, rotation, convention, rotation_angle, lever)
    table = replace(plain, std=std, rotation_std=rotation_std, joint_length=joint_length, payload=payload)
    table = replace(table, camera_on_tool=camera_on_tool, remounted=remounted, time=time, temperature=temperature)
    if socket is None and (distances is not None or distance_std is not None):
        raise MeasurementError.of("`distances` without `socket`", fix="name the columns of the sockets too")
    tip = None if not on or isinstance(on, str) else on[-1]
    names = (socket,) if isinstance(socket, str) else tuple(socket or ())
    sockets = None if socket is None else SocketColumns(names, distances, distance_std, tip)
    columns = TableColumns(robot, position, sockets, session=session, kinds=kinds, on=on, marker=marker)
    return _read(path, columns, table, duplicates, joints)


def _read(
    path: str | PathLike[str], columns: TableColumns, table: TableFormat, duplicates: str, joints: Sequence[str] | None
) -> Any:
    """Read columns, whose joints may have other names in the file than in the robot."""
    robot = columns.joints
    if joints is None:
        return read_observations(path, columns, table, duplicates=duplicates)
    names, kinds = (robot.joint_names, robot.kinds) if isinstance(robot, ChainLike) else (robot, None)
    if len(names) != len(joints):
        got, fix = f"{len(joints)} columns", "name a column for every joint of the robot, in its order"
        raise MeasurementError.of("`joints`", expected=len(names), got=got, fix=fix)
    columns = replace(columns, joints=joints, kinds=columns.kinds or kinds)
    return read_observations(path, columns, table, duplicates=duplicates).with_joint_names(names)


@outside_inference_mode
def read_readings(
    path: str | PathLike[str],
    robot: Sequence[str] | ChainLike,
    values: Sequence[str] | str | float,
    kind: str = "distance",
    *,
    joints: Sequence[str] | None = None,
    length: str,
    angle: str,
    sep: str = ",",
    decimal: str = ".",
    duplicates: str = "error",
    kinds: Sequence[str] | None = None,
    joint_length: str | None = None,
    std: Sequence[str] | str | None = None,
    payload: str | None = None,
    session: str | None = None,
    on: str | None = None,
    offset_std: float = 0.0,
    intrinsics: tuple[float, float, float, float] | None = None,
) -> Readings:
    """Read a table of distances, heights or places in images from a CSV file, in SI.

    Args:
        path, robot, joints, sep, decimal, duplicates, kinds, joint_length, payload: as in :func:`read_measurements`.
        values: name of the column of the readings, of the two columns u and v of images, or one number for all rows.
        kind: "distance", "height" or "image".
        length: unit of the readings in the file, as in :func:`read_measurements`; images are in pixels.
        angle: unit of the revolute joints in the file, ``"rad"`` or ``"deg"``.
        std: name of a column with standard deviations of the readings in their unit, or of two for images.
        session: name of the column that names the device of each row: fixed point, plane or camera. One by default.
        on: name of the tip that carries the ball, for a robot with several tips.
        offset_std: standard deviation of the unknown zero of distances, in m, whatever the unit of length in the file.
        intrinsics: fx, fy, cx, cy of the camera, pixels.

    Raises:
        MeasurementError: anything unreadable, missing, not finite or repeated (file, line and column are named); an
            unknown kind, or a number of columns that does not match it.

    Warns:
        DiffeoCalibWarning: values that look as if they were in another unit; rows dropped.
    """
    check_choice("kind", kind, ("distance", "height", "image"))
    constant = isinstance(values, (int, float)) and not isinstance(values, bool)
    count, several = 2 if kind == "image" else 1, (1, 2) if kind == "image" else (1,)
    if constant and kind != "image":
        names: tuple[str, ...] | float = float(values)  # pyright: ignore[reportArgumentType]
    else:
        given = [values] if isinstance(values, str) else values
        names = column_names("values", given, f"{count} names of columns for {kind!r}", (count,))
    if (intrinsics is None) != (kind != "image"):
        fix = "pass fx, fy, cx, cy in pixels" if kind == "image" else "leave it out"
        raise MeasurementError.of(f"`intrinsics` of {kind!r}", got=as_written(intrinsics), fix=fix)
    given = [std] if isinstance(std, str) else std
    known = () if given is None else column_names("std", given, "names of columns", several)
    of_kind = ReadingColumns(kind, names, session, offset_std, intrinsics or (1.0, 1.0, 0.0, 0.0), known, on)
    table = TableFormat(length, angle, sep, decimal, joint_length=joint_length, payload=payload)
    return _read(path, TableColumns(robot, readings=(of_kind,), kinds=kinds), table, duplicates, joints)


def read_joints(
    path: str | PathLike[str],
    joints: Joints,
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
        return file.read()[0]["q"]


def open_joints(
    path: str | PathLike[str],
    joints: Joints,
    table: TableFormat,
    *,
    kinds: Sequence[str] | None = None,
) -> TableFile:
    """The same file as :func:`read_joints` reads, to be read in blocks."""
    return TableFile(Path(path), Columns.of(table.joints_only(), joints, kinds, []))


def read_poses(path: Path, columns: PoseColumns, table: TableFormat) -> Tensor:
    """The poses (N, 4, 4), or places (N, k), m, to which a machine was told to go."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numbers of rotations are read as angles
        cells = read_joints(path, replace(columns, robot=None), replace(table, angle="rad", joint_length=None))
    poses = replace(columns, angle=table.angle).poses(cells)
    if poses.ndim == 2:
        return poses / table.joints_per_metre
    return transforms(poses[:, :3, :3], poses[:, :3, 3] / table.joints_per_metre)
