"""Rows that show a ball, in sockets or by readings, that cannot be right, or that leave something open."""

from __future__ import annotations

from collections.abc import Sequence

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
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.identification.registration import (
    SocketRegistration,
    distances,
    register_sockets,
    socket_means,
    spread,
)
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import InputError, MeasurementError, few, sentence, warn_user
from diffeo_calib.common.quantiles import known
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.measurements.checks import in_other_unit, rare_names
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.rows import NO_SOCKET
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.conditional import diagonal_blocks
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.payload import check_unladen
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import Devices, check_devices
from diffeo_calib.sensors.tables import sees_frame

TILT = "tilt the tool by 20 degrees or more, to several sides"
STEPS, REACHED_M, LARGEST_STEP_RAD = 30, 1e-4, 0.3


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


def warn_of_what_is_open(data: TangentData, devices: Sequence[Devices]) -> None:
    """Warn of directions of the ball and joints that rows which tell no coordinates do not show.

    Args:
        data: the rows around the geometric calibration. devices: where readings were found to come from.
    """
    if data.shared is None:
        return
    whole = data.nominal.jacobian(data.x, data.theta)
    shown = data.jacobian.square().mean((0, 1)).sqrt() / whole.square().mean((0, 1)).sqrt().clamp(min=1e-9)
    by_ball = data.sensitivities[..., data.nominal.geometry.slices["tool"]].flatten(0, 1)
    shared = data.shared.flatten(0, 1)
    shared = shared / shared.norm(dim=0).clamp(min=1e-12)
    known = torch.linalg.lstsq(shared, by_ball, rcond=1e-6, driver="gelsd").solution  # moved devices do as well
    tilt = torch.linalg.svdvals(by_ball - shared @ known) / data.coordinates**0.5
    for own in devices:
        for what, fix in own.open_sentences():
            warn_user(sentence(what, fix=fix))
    if float(tilt.min()) < gates.TILTED:
        what = "the tool is hardly tilted: where the ball is on it, along one direction, is not determined"
        warn_user(sentence(what, fix=TILT))
    names = data.nominal.geometry.chain.joint_names
    unseen = [name for name, share in zip(names, shown.tolist(), strict=True) if share < gates.UNSEEN]
    if unseen:
        what = f"the readings hardly change with {few(unseen)}: errors of such joints are not determined"
        warn_user(sentence(what, fix="add devices that see these joints turn"))


def warn_of_size(fix: str, size: float, share: float, expected: float) -> None:
    """Warn where most of the error that the model expects is the robot's size.

    Args:
        fix: what to do. size: relative deviation of the size. share: of the expected error. expected: this, m.
    """
    if share < gates.SIZE_SHARE:
        return
    what = (
        f"the readings hold too little length: the robot's size is known to {100 * size:.2f} % (one standard "
        f"deviation), which is {100 * share:.0f} % of the expected error of {1e3 * expected:.2f} mm and rests on the "
        "robot's description"
    )
    warn_user(sentence(what, fix=fix))


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
    median, motion = float(found.distances.median()), _motion(robot, data.q)
    far = median > gates.SOCKET_FAR * robot.reach
    tried = (other_units, other_conventions) if far and around is None else (other_units,)

    def left(reading: Reading) -> tuple[float, float]:
        again = register_sockets(robot if around is None else around, reading.q, data.socket_numbers)
        return float(again.distances.median()), _motion(robot, reading.q)

    fix = (
        "check the unit and the order of the joints, and that rows carry the names of their own sockets: of the place "
    )
    refuse_or_warn(
        "these rows do not fit the robot" + ": the ball is in no socket" * far,
        expected=f"a spread within sockets well below the {1e3 * motion:.3g} mm that the tip moves",
        got=f"a median of {1e3 * median:.3g} mm",
        mistake=likely_mistake(robot, data, median, tried, left),
        otherwise=fix + "and of the socket in it" if far else None,
    )
    _check_tilt(found)
    _check_distances(data, found)


def _motion(robot: Tree, q: Tensor) -> float:
    """Motion of the tip over configurations (N, n), m."""
    return max(spread(robot.tip_poses(q)[..., :3, 3]), 1e-9)


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


def _check_tilt(found: SocketRegistration) -> None:
    most, _, least = found.tilt.tolist()
    if most < gates.TURNED:
        what = "the tool hardly turns while the ball rests in a socket: where the ball is on the tool is not determined"
        raise MeasurementError.of(what, fix="measure each socket with the tool turned and tilted in many ways")
    if least < gates.TILTED:
        what = "the tool is never tilted in the sockets: the place of the ball along one direction is not determined"
        warn_user(sentence(what, fix=TILT))


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


def warn_of_flat_places(fitted: FittedMap, positions: Tensor, socket: Tensor, place: Tensor, now: float) -> None:
    """Warn of sockets near a plane if one place away from it would make the expected error smaller.

    All sockets on one table need not leave anything open: a tool that tilts shows errors of all joints, and the rows
    reach as many joint values as with a raised block. So the place is raised in the model: joint values that bring the
    ball there, and what rows with these would tell.

    Args:
        fitted: the map, without rigid motions. positions: (S, 3) of the sockets, m.
        socket: (N,) number of the socket of each row of the map, -1 for none. place: (S,) the place of each socket.
        now: the expected error, m.
    """
    _, s, axes = torch.linalg.svd(positions - positions.mean(0), full_matrices=False)
    reach = float(positions.norm(dim=1).max())
    if len(s) < 3 or float(s[2]) > gates.FLAT * reach * len(positions) ** 0.5:
        return
    rows = (socket >= 0).nonzero()[:, 0]
    usual = place[socket[rows]].mode().values
    rows = rows[place[socket[rows]] == usual]
    resting = fitted.x[rows], positions[socket[rows]], socket[rows]
    step = gates.RAISED * reach * axes[2]
    tried = (with_raised_place(fitted, *resting, sign * step) for sign in (1.0, -1.0))
    errors = [error for error in tried if error is not None]
    if errors and min(errors) < gates.WORTHWHILE_PLACE * now:
        what = "the sockets lie near a plane"
        expected = (
            f"about {1e3 * min(errors):.2g} mm of error with one place {1e3 * gates.RAISED * reach:.0f} mm away from it"
        )
        fix = "raise or tilt the block at one place, and tilt the tool"
        warn_user(sentence(what, expected=expected, got=f"{1e3 * now:.2g} mm", fix=fix))


def with_raised_place(fitted: FittedMap, q: Tensor, points: Tensor, socket: Tensor, away: Tensor) -> float | None:
    """Root mean square error, m, of the ball that the model expects over its workspace with one more place.

    Args:
        fitted: the map, without rigid motions. q: (M, n) configurations, points: (M, 3) m and socket: (M,) numbers of
            the rows at one place. away: (3,) from there to the new one, m.

    Returns:
        None if the robot does not reach it.
    """
    q, there = _reached(fitted, q, points + away)
    if int(there.sum()) < len(there) / 2:
        return None
    socket = socket[there]
    at, new = fitted.geodesic.linearise(fitted.everywhere), fitted.geodesic.linearise(q[there])
    own, between, m = fitted.covariance_between(new), fitted.covariance_between(at, new), fitted.m
    same = (socket[:, None] == socket).to(own) * PLACES.found_m_rad**2
    noise = torch.block_diag(*fitted.new_noise.expand(len(socket), -1, -1))
    K = own + noise + torch.kron(same, torch.eye(m, dtype=own.dtype, device=own.device))
    gain = between @ torch.linalg.solve(K, between.mT)
    after = fitted.covariance_at(at) - diagonal_blocks(gain, len(fitted.everywhere))
    return float(after.diagonal(dim1=1, dim2=2).sum(1).mean().clamp(min=0).sqrt())


def _reached(fitted: FittedMap, q: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Joint values (N, n) near q that bring the ball to points (N, 3), m, and which of them (N,) do."""
    for _ in range(STEPS):
        miss = target - fitted(q).detach()[:, -3:]
        step = (torch.linalg.pinv(fitted.jacobian(q).detach()[:, -3:]) @ miss[..., None])[..., 0]
        q = q + step * (LARGEST_STEP_RAD / step.abs().amax(1, keepdim=True).clamp(min=LARGEST_STEP_RAD))
    return q, (target - fitted(q).detach()[:, -3:]).norm(dim=1) < REACHED_M
