"""Rows that show a ball, in sockets or by readings, that cannot be right."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.likely_mistakes import (
    Reading,
    likely_mistake,
    other_conventions,
    other_units,
    refuse_or_warn,
)
from diffeo_calib.calibration.diagnostics.open_directions import TILT
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.identification.registration import (
    SocketRegistration,
    distances,
    register_sockets,
    socket_means,
    spread,
)
from diffeo_calib.common.errors import InputError, MeasurementError, few, sentence, warn_user
from diffeo_calib.common.quantiles import known
from diffeo_calib.measurements.checks import in_other_unit, rare_names
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.rows import NO_SOCKET
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.payload import check_unladen
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import check_devices
from diffeo_calib.sensors.tables import sees_frame


def check_readings(robot: Tree, tables: Sequence[Readings], *, alone: bool) -> None:
    """Refuse another tip than the robot has, and too few rows.

    Args:
        robot: n joints. tables: readings of one kind each. alone: whether no other rows tell of the robot.
    """
    if not tables:
        return
    balls = [table for table in tables if not sees_frame(table)]
    tip = balls[0].on if balls else robot.tips[0]
    if tip is None and len(robot.tips) > 1:
        fix = "name the tip that carries the ball (`with_tips`), or load the robot with that one"
        raise InputError.of("readings of a robot with several tips", expected="one", got=few(robot.tips), fix=fix)
    if tip is not None and tip not in robot.tips:
        raise InputError.of("the tip of the readings", expected=few(robot.tips), got=tip)
    count = sum(map(len, tables))
    if alone and count < gates.READING_ROWS:
        fix = "measure more rows, better 150, or hold out fewer of them (--holdout)"
        expected = f"at least {gates.READING_ROWS} rows"
        raise MeasurementError.of("`readings`", expected=expected, got=count, fix=fix)
    for table in tables:
        check_devices(table)


def check_sockets(robot: Tree, data: Measurements) -> None:
    """Refuse rows in sockets that are too few, or measured in a way that does not go with them."""
    socket, sockets = data.socket_numbers, data.known_sockets
    if len(robot.tips) > 1:
        raise MeasurementError.of("sockets", expected="a robot with one tip", got=few(robot.tips), fix="pass one `tip`")
    check_unladen(data.payload, "rows with sockets", fix="leave the masses out; measure all rows with the same load")
    resting = socket[socket != NO_SOCKET]
    counts = torch.bincount(resting, minlength=len(sockets.names))
    single = rare_names(data.row_sockets, data.line_numbers.tolist(), gates.SOCKET_ROWS)
    if single:
        expected = f"at least {gates.SOCKET_ROWS} rows in every socket, better 10 or more"
        fix = "check the name, measure more rows there, with the tool turned and tilted otherwise, or leave it out"
        raise MeasurementError.of("rows with sockets", expected=expected, got=few(single), fix=fix)
    needed = len(counts) + gates.SOCKET_SURPLUS
    if len(resting) < needed:
        fix = "measure more rows in each socket: its place is three unknowns, and that of the ball three more"
        raise MeasurementError.of("rows with sockets", expected=f"at least {needed}", got=len(resting), fix=fix)


def check_registration(
    robot: Tree, data: Measurements, found: SocketRegistration, around: Geometry | None = None
) -> None:
    """Refuse rows that fit with one mistake undone, or that do not determine where the ball is.

    Warns:
        DiffeoCalibWarning: a ball in no socket, a tool that never tilted, a known distance that is not the robot's.

    Args:
        robot: n joints. data: rows in sockets alone. found: their registration. around: the robot as a device saw it.
    """
    median, socket = float(found.distances.median()), data.socket_numbers
    far = median > gates.SOCKET_FAR * robot.reach

    def left(reading: Reading) -> tuple[float, float]:
        again = register_sockets(robot if around is None else around, reading.q, socket)
        return float(again.distances.median()), max(spread(robot.tip_poses(reading.q)[..., :3, 3]), 1e-9)

    motion, tried = left(Reading.of(robot, data))[1], [partial(other_units, slides=far)]
    if far and around is None:
        tried.append(partial(other_conventions, judge=left))
    fix = "check the unit and the order of the joints, and that rows carry the names of their own sockets: of the "
    refuse_or_warn(
        "these rows do not fit the robot" + ": the ball is in no socket" * far,
        expected=f"a spread within sockets well below the {1e3 * motion:.3g} mm that the tip moves",
        got=f"a median of {1e3 * median:.3g} mm",
        mistake=likely_mistake(robot, data, median, tried, left),
        otherwise=fix + "place and of the socket in it" if far else None,
    )
    most, _, least = found.tilt.tolist()
    if most < gates.TURNED:
        what = "the tool hardly turns while the ball rests in a socket: where the ball is on the tool is not determined"
        raise MeasurementError.of(what, fix="measure each socket with the tool turned and tilted in many ways")
    if least < gates.TILTED:
        what = "the tool is never tilted in the sockets: the place of the ball along one direction is not determined"
        warn_user(sentence(what, fix=TILT))
    _check_distances(data, found)


def warn_of_other_robot(robot: Tree, device: Measurements, start: Identification, found: SocketRegistration) -> None:
    """Warn of rows in sockets that do not belong to the robot that a device measured.

    Args:
        robot: n joints. device: rows with measured positions. start: their registration. found: that of the ball.
    """
    if len(known(device.points)) < gates.OVERDETERMINED * (6 + 3 * device.markers):
        return  # few positions are fitted nearly exactly: their residual does not show the robot's errors
    typical, own = float(distances(start.geometry, device).nanmedian()), float(found.distances.median())
    if own > max(gates.OTHER_ROBOT_RESIDUALS * typical, gates.OTHER_ROBOT_SHARE * robot.reach):
        what = "the rows in sockets do not fit the robot whose positions were measured"
        got = f"a median of {1e3 * own:.3g} mm"
        expected = f"a spread within sockets below the {1e3 * typical:.3g} mm of these"
        fix = "check that all rows are of one robot, with the same joint columns and units, and name their own sockets"
        warn_user(sentence(what, expected=expected, got=got, fix=fix))


def warn_of_wrong_sockets(data: Measurements, points: Tensor) -> None:
    """Warn of rows that fit another socket than their own; refuse them if they are many.

    Args:
        data: rows in sockets alone. points: (N, 3) places of the ball by a geometric calibration, m.
    """
    socket, sockets = data.socket_numbers, data.known_sockets
    middles = socket_means(points, socket)
    away = (points[:, None] - middles).norm(dim=-1)  # (N, S)
    own = away.gather(1, socket[:, None])[:, 0]
    nearest, where = away.scatter(1, socket[:, None], torch.inf).min(1)
    wrong = (own > gates.WRONG_SOCKET_MEDIANS * own.median()) & (nearest < gates.OTHER_SOCKET_FITS * own)
    rows = wrong.nonzero()[:, 0].tolist()
    if not rows:
        return
    named = [f"row {int(data.line_numbers[row])} fits '{sockets.names[int(where[row])]}'" for row in rows]
    what = f"{len(rows)} of {len(data)} rows seem to be in another socket than they say: {few(named)}"
    if len(rows) > gates.WRONG_SOCKETS * len(data):
        raise MeasurementError.of(what, fix="check the columns that name the place and the socket")
    warn_user(sentence(what, fix="check their sockets; they hardly count"))


def _check_distances(data: Measurements, found: SocketRegistration) -> None:
    """Refuse known distances that are those of the robot in another unit, and warn of other ones."""
    median, sockets = float(found.distances.median()), data.known_sockets
    for first, second, length in sockets.distances:
        seen = float((found.positions[first] - found.positions[second]).norm())
        if abs(seen - length) <= max(gates.DISTANCE_SHARE * length, gates.DISTANCE_MEDIANS * median):
            continue
        what = f"the known distance of the sockets '{sockets.names[first]}' and '{sockets.names[second]}'"
        said = {"expected": f"about {1e3 * seen:.4g} mm, by the robot", "got": f"{1e3 * length:.4g} mm"}
        if in_other_unit(length / max(seen, 1e-9), gates.DISTANCE_SHARE):
            raise MeasurementError.of(what, **said, fix="check the unit of `distances` (mm or m)")
        fix = "check between which sockets it is, and that the rows carry the names of their own sockets"
        warn_user(sentence(what, **said, fix=fix))
