"""Refuse rows that cannot be right, or that another reading of their table explains far better; warn of doubtful ones.

Positions and poses are judged by registration and geometric calibration; rows that show a ball, in sockets or by
readings, by the ball.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import combinations
from math import inf
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates, likely_mistakes
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.identification.registration import (
    SocketRegistration,
    can_register,
    distances,
    register_inliers,
    register_sockets,
    socket_means,
    spread,
    with_large_offsets,
)
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MOST_NAMES, InputError, MeasurementError, RobotError, few, sentence, warn_user
from diffeo_calib.common.quantiles import chi2_median, known
from diffeo_calib.measurements.checks import LARGEST_JOINT_ANGLE_RAD, in_other_unit
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.readings import KIND, Readings, SocketReadings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.payload import check_unladen
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import joint_name_fix
from diffeo_calib.sensors.devices import check_devices
from diffeo_calib.sensors.kinds import sees_frame


def check_joints(robot: Tree, data: Any) -> None:
    """Refuse joints that are not the robot's; warn of joints that never or hardly move."""
    ours = few(robot.joint_names, MOST_NAMES)
    if data.n != robot.n:
        what, fix = f"the measurements do not fit robot '{robot.name}'", "check the base and tip links, and the "
        raise MeasurementError.of(what, expected=f"{robot.n} joints ({ours})", got=data.n, fix=fix + "joint columns")
    if data.joint_names is not None and tuple(data.joint_names) != tuple(robot.joint_names):
        what, got = f"the measurements' joints are not those of robot '{robot.name}'", few(data.joint_names, MOST_NAMES)
        raise RobotError.of(what, expected=ours, got=got, fix=joint_name_fix(robot, data.joint_names))
    if len(data) == 1:
        return  # the registration refuses a single row
    low, high = robot.limits.to(data.q.device).unbind(1)
    turns, strokes = torch.tensor(robot.periodic, dtype=torch.bool, device=data.q.device), (high - low).clamp(max=1.0)
    ranges = (data.q.amax(0) - data.q.amin(0)) / torch.where(turns | (strokes <= 0), 1.0, strokes)
    still = ranges < gates.FIXED_RANGE
    if bool(still.all()):
        what = f"all {len(data)} rows hold the same configuration: the robot does not move"
        raise MeasurementError.of(what, fix="measure poses in which every joint moves")
    for flags, words in ((still, "never moved"), ((ranges < gates.SMALL_RANGE) & ~still, "hardly moved")):
        if bool(flags.any()):
            names = ", ".join(name for name, flag in zip(robot.joint_names, flags, strict=True) if flag)
            fix = "the model is valid only near this joint position; measure poses in which every joint moves"
            warn_user(sentence(f"{names}: {words} in these measurements", fix=fix))


def check_limits(robot: Tree, data: Any) -> None:
    """Warn of joints far beyond the robot's limits, but for whole turns.

    Reading the data warns of joints that span several turns.
    """
    low, high = robot.limits.to(data.q.device).unbind(1)
    turns = torch.tensor(robot.periodic, dtype=torch.bool, device=data.q.device)
    q = data.q - robot.whole_turns(data.q)
    least, most, margin = q.amin(0), q.amax(0), gates.LIMIT_EXCESS * (high - low)
    beyond = margin.isfinite() & (margin > 0) & ((least < low - margin) | (most > high + margin))
    beyond = beyond & ~(turns & (data.q.abs().amax(0) > LARGEST_JOINT_ANGLE_RAD))
    if where := beyond.nonzero()[:, 0].tolist():
        which, first = few([robot.joint_names[joint] for joint in where], MOST_NAMES), where[0]
        unit, other = ("rad", "degrees") if robot.periodic[first] else ("m", "millimetres")
        ranges = [f"{float(a[first]):.3g} to {float(b[first]):.3g} {unit}" for a, b in ((low, high), (least, most))]
        fix = f"check the joint's offset, sign and unit (not in {other}?)"
        warn_user(sentence(f"{which}: far beyond the robot's limits", expected=ranges[0], got=ranges[1], fix=fix))


def quantum(values: Tensor, *, turning: bool) -> tuple[float, str] | None:
    """The step in which a joint's values (N,) were written, rad or m, and the step in words; None if they were not.

    Steps are powers of ten, whole or half, in rad, deg, m or mm.
    """
    units = (("rad", 1.0), ("degrees", math.pi / 180)) if turning else (("m", 1.0), ("mm", 1e-3))
    steps = [step for k in range(gates.DIGITS + 1) for step in (10.0**-k, 5 * 10.0 ** -(k + 1))]
    named = [(step * size, f"{step:g} {unit}") for unit, size in units for step in steps]
    for size, words in sorted(named, reverse=True):
        multiples = values / size
        several = len(multiples.round().unique()) >= gates.DIGIT_VALUES  # else near the same multiple of a large step
        if several and float((multiples - multiples.round()).abs().max()) < gates.DIGIT_REMAINDER:
            return size, words
    return None


def warn_of_rounding(robot: Tree, data: Any, tangent: TangentData, left_out: LeaveOneOut) -> None:
    """Warn if the joint values have so few digits that their rounding explains much of the remaining error."""
    each = [quantum(values, turning=turns) for values, turns in zip(data.q.unbind(1), robot.periodic, strict=True)]
    steps = {name: step for name, step in zip(robot.joint_names, each, strict=True) if step is not None}
    if not steps or len(data) < gates.DIGIT_ROWS:
        return
    variances = tangent.x.new_tensor([0.0 if step is None else step[0] ** 2 / 12 for step in each])  # uniform
    points = tangent.y.shape[1] // 3 if tangent.noise_model.modes.shape[1] else tangent.noise_model.bodies
    caused = float((tangent.jacobian.square() @ variances).unflatten(1, (points, -1)).sum(-1).mean().sqrt())
    errors = left_out.errors.unflatten(1, (points, -1))
    squares, size = errors.square().nansum(-1)[~errors.isnan().all(-1)], errors.shape[2]
    remaining = float((size * squares.median() / chi2_median(size)).sqrt())
    if gates.ROUNDING_LEAST * remaining < caused < gates.ROUNDING_MOST * remaining:
        words = " and ".join(sorted({words for _, words in steps.values()}))
        got = f"{1e3 * caused:.2g} mm RMS of position error from this rounding, {1e3 * remaining:.2g} mm remain in all"
        fix = "write more digits of the joint values, unless the robot was commanded to exactly these"
        what = f"the values of {few([*steps], MOST_NAMES)} are rounded to {words}"
        warn_user(sentence(what, expected="readings with more digits", got=got, fix=fix))


# --- positions and poses ----------------------------------------------------------------------------------------------


def registered(robot: Tree, data: Measurements) -> Identification:
    """Base and markers from the inliers.

    Raises:
        MeasurementError: points that never move, copied or computed ones, or rows that another reading explains far
            better.
    """
    check_markers(robot, data)
    registration, inliers = register_inliers(robot, data)
    _check_motion(robot, data)
    likely_mistakes.check_row_order(robot, data, registration)
    registration = with_large_offsets(data, registration, inliers)
    _check_registration(robot, data, registration)
    return registration


def refuse_mistakes(robot: Tree, data: Measurements) -> None:
    """Raise MeasurementError for rows far from a model that another reading explains far better."""
    if len(data) >= 2 * (2 + robot.n) and can_register(data.points):
        _check_motion(robot, data)
        _check_registration(robot, data, register_inliers(robot, data)[0])


def _check_motion(robot: Tree, data: Measurements) -> None:
    """Refuse markers that never move, although the robot's tip does: they determine nothing."""
    measured, tips = spread(data.points), spread(robot.tip_poses(data.q)[..., :3, 3])
    if tips > 0 and measured < gates.NEVER_MOVED_M:
        fix = "check the columns of the positions; with two arms that hold one rigid tool measure other rows, a ball "
        fix += "in one hand that rests in sockets of a block in the other (`--base LEFT --tip RIGHT --socket ...`)"
        expected = f"a spread of about {tips:.3g} m, the tip's over these configurations"
        what = "the measured points never move, and so tell nothing about the robot"
        raise MeasurementError.of(what, expected=expected, got=f"{measured:.3g} m", fix=fix)


def _check_registration(robot: Tree, data: Measurements, registration: Identification) -> None:
    """Refuse measurements that no base and markers explain, but another reading does."""
    measured, nominal = spread(data.points), spread(registration.geometry.points(data.q))
    typical = float(distances(registration.geometry, data).nanmedian())
    if typical > gates.REGISTERED_RESIDUAL * max(measured, nominal):
        what = "the measurements do not fit this robot: no base frame and markers explain them"
        expected = f"residuals well below the points' spread of {measured:.3g} m"
        said = {"what": what, "expected": expected, "got": f"a median of {typical:.3g} m"}
        likely_mistakes.check_fit(robot, data, typical, said)


def check_identification(data: Measurements, identification: Identification) -> None:
    """Doubt measurements that even a full geometric calibration leaves unexplained.

    Raises:
        MeasurementError: another reading explains them far better, or several markers that a column names.

    Warns:
        DiffeoCalibWarning: none does.
    """
    geometry = identification.geometry
    if (several := marker_column(geometry, data)) is not None:
        column, words = several
        fix = f"name the column: --marker {column} (in Python `marker`)"
        raise MeasurementError.of(f"column '{column}' takes {words}: which marker does a row show", fix=fix)
    size, typical = spread(data.points), float(distances(geometry, data).nanmedian())
    angles = known(data.bodies.errors(data, geometry.points(data.q))[..., 3:].norm(dim=-1))
    turned = bool((angles > gates.ORIENTATION_RAD).double().mean() > gates.ORIENTATION_SHARE)  # false without angles
    if not turned and typical <= gates.GEOMETRIC_RESIDUAL * size:
        return
    what, got = "measurements", f"a median of {typical:.3g} m"
    expected = f"residuals well below the points' spread of {size:.3g} m"
    if turned:
        what, got = "measured orientations", f"a median of {math.degrees(float(angles.median())):.3g} degrees"
        expected = f"errors well below {math.degrees(gates.ORIENTATION_RAD):.0f} degrees"
    what = f"the {what} do not fit this robot, even with geometric errors"
    reached = float(geometry.chain.tip_poses(data.q)[..., :3, 3].norm(dim=-1).max())
    least = max(gates.UNEXPLAINED_RESIDUAL * size, gates.LARGE_PER_REACH * reached)  # points may hardly move
    advice = "check the angle unit, the order of the joints, the tip link or DH convention, and that rows pair joints "
    advice = f"{advice}with their own points" * (turned or typical >= least)
    said = {"what": what, "expected": expected, "got": got}
    likely_mistakes.check_fit(geometry.chain, data, typical, said, advice)


def warn_of_no_errors(robot: Tree, data: TangentData, registration: Identification, fit: Identification) -> None:
    """Warn of rows that show no errors of the robot: they may have been computed, not measured."""
    points = data.nominal(data.x, torch.zeros_like(data.theta))
    predicted = points if data.observe is None else data.observe.value(points)
    rms = float((data.y - predicted)[data.visible].square().mean().sqrt())
    size = float((data.y - data.y.mean(0)).abs().amax())  # the reach of a robot with prismatic joints may have no bound
    slices, count = data.nominal.geometry.slices, gates.NOMINAL_OVERDETERMINED
    placed = sum(slices[name].stop - slices[name].start for name in ("base", "tool"))
    exact = rms < gates.EXACT_SHARE * size and data.coordinates > count * placed
    shown = registration.noise > min(gates.NOMINAL_RATIO * fit.noise, gates.NOMINAL_SHARE * size)
    enough = robot.n >= gates.NOMINAL_JOINTS and data.coordinates > count * data.nominal.geometry.size
    enough &= not is_cartesian(robot)  # errors of a machine without links are the deformation's
    if exact or (enough and not shown):
        what = f"these rows show no errors of the robot: its description explains them to {1e3 * rms:.2g} mm RMS"
        fix = "if they were computed, use what a device measured, not the position that the controller displays; to "
        fix += "try the package without one, simulate a robot with errors (`diffeo-calib demo`)"
        warn_user(sentence(f"{what}, and errors of its links explain no more", fix=fix))


# --- markers ----------------------------------------------------------------------------------------------------------


def marker_column(geometry: Geometry, data: Measurements) -> tuple[str, str] | None:
    """A column that was not read, and why it names which of several markers a row shows; None without one.

    Rows of another marker than that of the geometry are off by a constant in the frame of its tip.
    """
    if data.markers > 1 or not isinstance(data.origin, TableOrigin) or bool(data.points.isnan().any()):
        return None
    error, columns = (data.points - geometry.points(data.q))[:, 0].cpu(), data.origin.columns
    in_tip = (geometry.marker_poses(data.q)[:, 0, :3, :3].cpu().mT @ error[:, :, None])[:, :, 0]
    for column, texts in data.origin.texts(data.line_numbers).items():
        names, count = list(dict.fromkeys(texts)), len(texts)
        if not 1 < len(names) <= gates.MOST_MARKERS or "" in names or column in {*columns.names, columns.table.session}:
            continue
        rows = torch.tensor([[text == name for name in names] for text in texts], dtype=error.dtype, device=HOST)
        if float(rows.sum(0).min()) < gates.MARKER_ROWS:
            continue
        means = [rows.mT @ values / rows.sum(0)[:, None] for values in (in_tip, error)]
        left = [float((values - rows @ mean).norm()) for values, mean in zip((in_tip, error), means, strict=True)]
        alone, freedom = float(in_tip.norm()), ((count - 1) / (count - len(names))) ** 0.5
        if left[0] * freedom < gates.MARKERS_LEFT * min(alone, left[1] * freedom):
            jump, per_row = 1e3 * float(torch.cdist(means[0], means[0]).max()), 1e3 / count**0.5
            words = f"{len(names)} values between which the points jump by {jump:.3g} mm on the tool (RMS error "
            return column, f"{words}{alone * per_row:.3g} mm, and {left[0] * per_row:.3g} mm without these jumps)"
    return None


def unmeasured_markers(robot: Tree, data: Measurements) -> Iterator[tuple[int, str, bool]]:
    """Markers that copy another one, and those that the nominal robot explains although it does not explain others.

    ``data``: rows of one set-up. Yields the number of a marker, what it is in words, and whether that is proved.
    """
    places, turns, size = data.origins, robot.tip_poses(data.q)[..., :3, :3], spread(data.points)
    about = torch.linalg.svdvals((turns - turns[:1]).reshape(-1, 3))  # of turns about one axis the last one is 0
    turning = float(about[-1]) > gates.MOVED_RAD_M * len(turns) ** 0.5
    for marker, other in combinations(range(places.shape[1]), 2):
        away = places[:, other] - places[:, marker]
        away = away[~away.isnan().any(-1)]
        if len(away) < gates.STUCK_ROWS:
            continue
        shifted = bool(away.any())
        if not shifted or (turning and float((away - away.median(0).values).abs().max()) < gates.DIGITS_SHARE * size):
            words = f"marker {other} is a copy of marker {marker}" + ", shifted by the same in every row" * shifted
            yield other, words, True
    tips = data.bodies.tips(data.on or robot.tips[:1] * data.points.shape[1])
    if robot.n < gates.NOMINAL_JOINTS or len(set(tips)) == len(tips):
        return
    medians = [inf] * len(tips)  # median residuals of the nominal robot, m, of each by itself
    for k, visible in enumerate(data.seen_bodies.unbind(1)):
        if int(visible.sum()) >= gates.STUCK_ROWS:
            alone = Measurements.of_points(data.q[visible], data.origins[visible][:, [k]], (tips[k],), None)
            medians[k] = likely_mistakes.residual_of(robot, alone)
    for k, typical in enumerate(medians):
        far = max(other for other, tip in zip(medians, tips, strict=True) if tip == tips[k])
        explained = gates.DIGITS_SHARE * size < far < gates.RIGHT_READING * size
        if explained and typical < min(gates.FOLLOWED * far, gates.NOMINAL_SHARE * size):
            words = f"marker {k} follows the nominal robot to {1e3 * typical:.4f} mm, another one to {1e3 * far:.3g} mm"
            yield k, f"{words}: wished places", typical < gates.DIGITS_SHARE * size


def check_markers(robot: Tree, data: Measurements) -> None:
    """Refuse markers that are no measurements, with the proof; warn of doubtful ones."""
    for marker, words, proved in unmeasured_markers(robot, data):
        triples = data.origin.columns.table.triples if isinstance(data.origin, TableOrigin) else []
        numbers = data.marker_names or range(data.markers)
        names = triples[marker] if len(triples) == data.markers else [f"marker {numbers[marker]}"]
        fix = f"leave {few(names)} out: wished or computed places, or the same marker twice, are no measurements"
        if proved:
            raise MeasurementError.of(words, fix=fix)
        warn_user(sentence(words, fix=f"if they were not measured, {fix}"))


# --- readings, and the ball in its socket -----------------------------------------------------------------------------


def check_readings(robot: Tree, tables: Sequence[Readings], *, alone: bool) -> None:
    """Refuse another tip than the robot has, too few rows, and what does not go with sockets.

    Args:
        robot: n joints. tables: readings of one kind each. alone: whether no other rows tell of the robot.
    """
    tips = {table.on for table in tables if not sees_frame(table)}
    if None in tips and len(robot.tips) > 1:
        fix = "name the tip that carries the ball (`with_tips`), or load the robot with that one"
        raise InputError.of("readings of a robot with several tips", expected="one", got=few(robot.tips), fix=fix)
    for tip in tips - {None, *robot.tips}:
        raise InputError.of("the tip of the readings", expected=few(robot.tips), got=tip)
    for table in tables:
        check_devices(table)
    resting = [table for table in tables if table.kind == KIND]
    for table in resting:
        check_unladen(table.payload, "rows with sockets", fix="leave the masses out; measure all with the same load")
        needed = len(table.names) + gates.SOCKET_SURPLUS
        if len(table) < needed:
            fix = "measure more rows in each socket: its place is three unknowns, and that of the ball three more"
            raise MeasurementError.of("rows with sockets", expected=f"at least {needed}", got=len(table), fix=fix)
    if alone and not resting and (count := sum(map(len, tables))) < gates.READING_ROWS:
        fix, expected = "measure more rows, better 150, or hold out fewer of them (--holdout)", gates.READING_ROWS
        raise MeasurementError.of("`readings`", expected=f"at least {expected} rows", got=count, fix=fix)


def check_socket_registration(
    robot: Tree, data: SocketReadings, fit: SocketRegistration, beside: tuple[Geometry, Measurements] | None = None
) -> None:
    """Refuse rows that fit with one mistake undone, a tool that never turns, and distances in another unit.

    Warns:
        DiffeoCalibWarning: a ball in no socket, or not that of the robot that a device saw; a known distance that is
            not the robot's.

    Args:
        robot: n joints. data: the rows. fit: their registration. beside: the robot as a device saw it, and its rows.
    """
    median, socket, around = (
        float(fit.distances.median()),
        data.device,
        beside[0] if beside else Geometry.nominal(robot),
    )
    far, usual = median > gates.SOCKET_FAR * robot.reach, inf
    if beside is not None and len(known(beside[1].points)) >= gates.OVERDETERMINED * (6 + 3 * beside[1].markers):
        usual = float(distances(*beside).nanmedian())  # fewer positions are fitted nearly exactly

    def left(reading: likely_mistakes.Reading) -> tuple[float, float]:
        again = register_sockets(around, reading.q, socket)
        return float(again.distances.median()), max(spread(robot.tip_poses(reading.q)[..., :3, 3]), 1e-9)

    motion, tried = left(likely_mistakes.Reading.of(robot, data))[1], [partial(likely_mistakes.other_units, slides=far)]
    if far and beside is None:
        tried.append(partial(likely_mistakes.other_conventions, judge=left))
    what = "these rows do not fit the robot" + ": the ball is in no socket" * far
    expected = f"a spread within sockets well below the {1e3 * motion:.3g} mm that the tip moves"
    if median > max(gates.OTHER_ROBOT_RESIDUALS * usual, gates.OTHER_ROBOT_SHARE * robot.reach):
        what, far = "the rows in sockets do not fit the robot whose positions were measured", True
        expected = f"a spread within sockets below the {1e3 * usual:.3g} mm of these"
    fix = "check that all rows are of one robot, the unit and the order of the joints, and that rows carry the names "
    fix += "of their own sockets: of the place and of the socket in it"
    said = {"what": what, "expected": expected, "got": f"a median of {1e3 * median:.3g} mm"}
    likely_mistakes.check_fit(robot, data, median, said, fix * far, groups=tried, judge=left)
    if fit.turning < gates.TURNED:
        what = "the tool hardly turns while the ball rests in a socket: where the ball is on the tool is not determined"
        raise MeasurementError.of(what, fix="measure each socket with the tool turned and tilted in many ways")
    for first, second, length in data.lengths:
        apart = float((fit.positions[first] - fit.positions[second]).norm())
        there = (socket == first) | (socket == second)
        off = max(float(values.median()) for values in (fit.distances, fit.distances[there]))  # as bent links leave it
        if abs(apart - length) <= max(gates.DISTANCE_SHARE * length, gates.DISTANCE_MEDIANS * off):
            continue
        what = f"the known distance of the sockets '{data.names[first]}' and '{data.names[second]}'"
        said = {"what": what, "expected": f"about {1e3 * apart:.4g} mm, by the robot", "got": f"{1e3 * length:.4g} mm"}
        if in_other_unit(length / max(apart, 1e-9), gates.DISTANCE_SHARE):
            raise MeasurementError.of(**said, fix="check the unit of `distances` (mm or m)")
        fix = "check between which sockets it is, and that the rows carry the names of their own sockets"
        warn_user(sentence(**said, fix=fix))


def warn_of_wrong_sockets(data: SocketReadings, points: Tensor) -> None:
    """Warn of rows that fit another socket than their own; refuse them if they are many.

    Args:
        data: the rows. points: (N, 3) places of the ball by a geometric calibration, m.
    """
    socket = data.device
    away = (points[:, None] - socket_means(points, socket)).norm(dim=-1)  # (N, S)
    error = away.gather(1, socket[:, None])[:, 0]
    nearest, where = away.scatter(1, socket[:, None], torch.inf).min(1)
    wrong = (error > gates.WRONG_SOCKET_MEDIANS * error.median()) & (nearest < gates.OTHER_SOCKET_FITS * error)
    rows = wrong.nonzero()[:, 0].tolist()
    if not rows:
        return
    named = [f"row {int(data.line_numbers[row])} fits '{data.names[int(where[row])]}'" for row in rows]
    what = f"{len(rows)} of {len(data)} rows seem to be in another socket than they say: {few(named)}"
    if len(rows) > gates.WRONG_SOCKETS * len(data):
        raise MeasurementError.of(what, fix="check the columns that name the place and the socket")
    warn_user(sentence(what, fix="check their sockets; they hardly count"))
