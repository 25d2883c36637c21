"""Rows with a ball in sockets that cannot be right, or that leave something open."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.identification.robust_registration import distances
from diffeo_calib.calibration.identification.socket_registration import SocketRegistration, socket_means
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, few, sentence, warn_user
from diffeo_calib.common.hidden_values import known
from diffeo_calib.measurements.rows import NO_SOCKET
from diffeo_calib.measurements.sockets import Sockets
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree


@dataclass(frozen=True)
class SocketLimits:
    """When rows in sockets are refused or warned about.

    Args:
        fewest_in_socket: rows of a socket; one says nothing, since its place is not known.
        surplus: rows beyond the number of sockets that are needed at least.
        reach_share: median distance of the ball from its socket that is refused, as a part of the robot's reach.
        unit_ratio: known over found distance, or the other way round, from which a unit must be wrong.
        distance_share: relative error of a distance that is refused, if it also exceeds ``distance_medians`` median
            distances of the ball from its socket.
        turned: motion of the ball per unit of its offset, by turns of the tool in the sockets, below which its place is
            not determined along any direction. tilted: the same along one direction, which is warned about.
        wrong_medians: distance from its socket, in medians, from which a row may be in a wrong one. fits: distance from
            another socket, relative to that, below which it is.
        wrong_share: share of such rows that is refused.
        other_residuals: median spread within sockets, in median residuals of measured positions, and other_share: in
            reaches of the robot, above both of which the rows are not those of one robot. overdetermined: measured
            coordinates per unknown of base and markers from which residuals are compared.
    """

    fewest_in_socket: int = 2
    surplus: int = 6
    reach_share: float = 0.02
    unit_ratio: float = 10.0
    distance_share: float = 0.1
    distance_medians: float = 5.0
    turned: float = 0.02
    tilted: float = 0.05
    wrong_medians: float = 8.0
    fits: float = 0.3
    wrong_share: float = 0.25
    other_residuals: float = 2.5
    other_share: float = 1e-3
    overdetermined: float = 2.0


LIMITS = SocketLimits()


def check_sockets(robot: Tree, data: Measurements) -> Sockets:
    """The sockets of rows; MeasurementError if they are too few, or measured in a way that does not go with them."""
    if data.sockets is None or data.socket is None:
        raise MeasurementError.of("the rows have no sockets", fix="pass Measurements.from_sockets(...)")
    if len(robot.tips) > 1:
        raise MeasurementError.of("sockets", expected="a robot with one tip", got=few(robot.tips), fix="pass one `tip`")
    check_no_sessions(data)
    if data.payload is not None:
        fix = "leave the masses out; measure all rows with the same load"
        raise MeasurementError.of("rows with sockets", expected="no payloads", got="a column of masses", fix=fix)
    resting = data.socket[data.socket != NO_SOCKET]
    counts = torch.bincount(resting, minlength=len(data.sockets.names))
    single = [name for name, n in zip(data.sockets.names, counts.tolist(), strict=True) if n < LIMITS.fewest_in_socket]
    if single:
        expected = f"at least {LIMITS.fewest_in_socket} rows in every socket, better 10 or more"
        fix = "measure more rows there, with the tool turned and tilted otherwise, or leave it out"
        raise MeasurementError.of(f"socket {few(single)}", expected=expected, got="1 row", fix=fix)
    needed = len(counts) + LIMITS.surplus
    if len(resting) < needed:
        fix = "measure more rows in each socket: its place is three unknowns, and that of the ball three more"
        raise MeasurementError.of("rows with sockets", expected=f"at least {needed}", got=len(resting), fix=fix)
    if not data.sockets.distances and data.without_device:
        what = "no distance between sockets is known: the size of the robot rests on its description"
        warn_user(sentence(what, fix="pass one: a printed block with two sockets and a caliper are enough"))
    return data.sockets


def check_no_sessions(data: Measurements) -> None:
    """Refuse rows in sockets that were measured in several set-ups."""
    if data.without_device and len(data.session_names) > 1:
        fix = "give the sockets of each session names of their own, and leave the sessions out"
        raise MeasurementError.of("rows with sockets", expected="no sessions", got=few(data.session_names), fix=fix)


def check_registration(robot: Tree, data: Measurements, found: SocketRegistration) -> None:
    """Refuse rows whose ball is in no socket, or that do not determine its place; warn of a tool that never tilted."""
    _check_tilt(found)
    median = float(found.distances.median())
    if median > LIMITS.reach_share * robot.reach:
        raise MeasurementError.of(
            "these rows do not fit the robot: the ball is in no socket",
            expected=f"a spread within sockets well below {1e3 * LIMITS.reach_share * robot.reach:.3g} mm",
            got=f"a median of {1e3 * median:.3g} mm",
            fix="check the unit and the order of the joints, and that rows carry the names of their own sockets: of "
            "the place and of the socket in it",
        )
    _check_distances(data, found)


def warn_of_other_robot(robot: Tree, device: Measurements, start: Identification, found: SocketRegistration) -> None:
    """Warn of rows in sockets that do not belong to the robot that a device measured.

    Args:
        robot: n joints. device: rows with measured positions. start: their registration. found: that of the ball.
    """
    if len(known(device.points)) < LIMITS.overdetermined * (6 + 3 * device.markers):
        return  # few positions are fitted nearly exactly: their residual does not show the robot's errors
    typical, spread = float(distances(start.geometry, device).nanmedian()), float(found.distances.median())
    if spread > max(LIMITS.other_residuals * typical, LIMITS.other_share * robot.reach):
        what = "the rows in sockets do not fit the robot whose positions were measured"
        got = f"a median of {1e3 * spread:.3g} mm"
        expected = f"a spread within sockets below the {1e3 * typical:.3g} mm of these"
        fix = "check that all rows are of one robot, with the same joint columns and units, and name their own sockets"
        warn_user(sentence(what, expected=expected, got=got, fix=fix))


def warn_of_wrong_sockets(data: Measurements, points: Tensor) -> None:
    """Warn of rows that fit another socket than their own; refuse them if they are many.

    Args:
        data: rows in sockets alone. points: (N, 3) places of the ball by a geometric calibration, m.
    """
    if data.sockets is None or data.socket is None:
        return
    socket = data.socket.to(HOST)
    middles = socket_means(points, socket)
    away = (points[:, None] - middles).norm(dim=-1)  # (N, S)
    own = away.gather(1, socket[:, None])[:, 0]
    nearest, where = away.scatter(1, socket[:, None], torch.inf).min(1)
    wrong = (own > LIMITS.wrong_medians * own.median()) & (nearest < LIMITS.fits * own)
    rows = wrong.nonzero()[:, 0].tolist()
    if not rows:
        return
    named = [f"row {int(data.line_numbers[row])} fits '{data.sockets.names[int(where[row])]}'" for row in rows]
    what = f"{len(rows)} of {len(data)} rows seem to be in another socket than they say: {few(named)}"
    if len(rows) > LIMITS.wrong_share * len(data):
        raise MeasurementError.of(what, fix="check the columns that name the place and the socket")
    warn_user(sentence(what, fix="check their sockets; they hardly count"))


def _check_tilt(found: SocketRegistration) -> None:
    most, _, least = found.tilt.tolist()
    if most < LIMITS.turned:
        what = "the tool hardly turns while the ball rests in a socket: where the ball is on the tool is not determined"
        raise MeasurementError.of(what, fix="measure each socket with the tool turned and tilted in many ways")
    if least < LIMITS.tilted:
        what = "the tool is never tilted in the sockets: the place of the ball along one direction is not determined"
        warn_user(sentence(what, fix="tilt the tool by 20 degrees or more, to several sides"))


def _check_distances(data: Measurements, found: SocketRegistration) -> None:
    """Refuse known distances that are not those of the robot."""
    if data.sockets is None:
        return
    median = float(found.distances.median())
    for first, second, length in data.sockets.distances:
        seen = float((found.positions[first] - found.positions[second]).norm())
        ratio = length / max(seen, 1e-9)
        name = " and ".join(f"'{data.sockets.names[number]}'" for number in (first, second))
        if not 1 / LIMITS.unit_ratio < ratio < LIMITS.unit_ratio:
            fix = "check the unit of `distances` (mm or m), and which sockets they are between"
        elif abs(seen - length) > max(LIMITS.distance_share * length, LIMITS.distance_medians * median):
            fix = "check between which sockets it is, and that the rows carry the names of their own sockets"
        else:
            continue
        what = f"the known distance of the sockets {name}"
        expected = f"about {1e3 * seen:.4g} mm, by the robot"
        raise MeasurementError.of(what, expected=expected, got=f"{1e3 * length:.4g} mm", fix=fix)
