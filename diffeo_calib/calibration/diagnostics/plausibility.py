"""Refuse or doubt measurements that cannot belong to this robot, before they are calibrated away."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.likely_mistakes import likely_mistake
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.identification.joint_offsets import find_zeros, with_zeros
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.common.errors import MOST_NAMES, DiffeoCalibWarning, MeasurementError, RobotError, few, sentence
from diffeo_calib.measurements.poses import angle_between, poses_from_marks
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.unit_checks import LARGEST_JOINT_ANGLE_RAD
from diffeo_calib.robots.chain import Chain
from diffeo_calib.robots.geometry import Geometry

UNIT_RATIO = 30.0
"""Measured over nominal spread of the markers beyond which the length unit must be wrong."""
MISFIT = 0.25
"""Residual of the registration over the spread of the markers beyond which rows do not belong together."""
GEOMETRIC_MISFIT, DOUBTFUL_MISFIT = 0.06, 0.02
"""The same after the geometric calibration, refused and warned of: a UR10 leaves 0.001, a wrong tip link 0.1."""
MOTIONLESS, HARDLY = 1e-3, 0.05
"""Ranges of a joint, rad or m, below which it counts as not moved, or hardly."""
TURNED, TURNED_SHARE = 0.1, 0.1
"""Orientation errors after the geometric calibration, rad, that more than this share of the poses cannot have."""
BEYOND = 0.25
"""Part of a joint's range by which it may be beyond its limits without a word: files of robots are often careless."""
FAR = 5.0
"""Distance of a marker from the tip, in reaches of the robot, at which it is not known where it is."""
DRAWS, SURPLUS = 50, 2
"""Registrations of random rows that are tried in case that many rows are grossly wrong, and how many times as many rows
as are needed: of six rows all are good with probability 0.12 where 30 % are wrong, so that one of 50 draws will do."""
GROSS = 10.0
"""Rows further from the registration than so many median distances do not take part in it."""
MOST_WRONG = 0.4
"""Share of wrong rows that is not calibrated away."""
OVERSTATED, ROUNDING = 10.0, 1e-6
"""Given standard deviations over the residual from which their unit is wrong, and the smallest residual [m]."""
CONSISTENT = 0.02
"""Residual over the spread of the markers with which rows of which none is grossly off need no other draw."""
OTHER_ZEROS = 0.01
"""Residual of the registration over the spread of the markers from which other zeros of the joints are looked for."""
ZEROS_LEAVE, NOTABLE_ZERO, FARTHEST_ZERO = 0.3, 0.2, 0.8
"""Part of the residual that they may leave, part of the largest one from which others are told, and the largest that is
believed [rad]."""
TRIMS = 5


def check_joints(robot: Chain, data: Measurements) -> None:
    """Raise if the joints are not the robot's; warn of joints that never move."""
    if data.n != robot.n:
        raise MeasurementError(
            sentence(
                f"the measurements do not fit robot '{robot.name}'",
                expected=f"{robot.n} joints ({few(robot.joint_names, MOST_NAMES)})",
                got=data.n,
                fix="check the base and tip links, and the joint columns",
            )
        )
    if data.joint_names is not None and tuple(data.joint_names) != tuple(robot.joint_names):
        raise RobotError(
            sentence(
                f"the measurements' joints are not those of robot '{robot.name}'",
                expected=few(robot.joint_names, MOST_NAMES),
                got=few(data.joint_names, MOST_NAMES),
                fix="put the columns in the robot's order",
            )
        )
    if len(data) == 1:
        return  # of one row nothing can be said but that it is too few, as the registration does
    still = (data.q.amax(0) - data.q.amin(0)) < MOTIONLESS
    if bool(still.all()):
        what = f"all {len(data)} rows hold the same configuration: the robot does not move"
        raise MeasurementError(sentence(what, fix="measure poses in which every joint moves"))
    hardly = (data.q.amax(0) - data.q.amin(0)) < HARDLY
    for flags, words in ((still, "never moved"), (hardly & ~still, "hardly moved")):
        if bool(flags.any()):
            names = ", ".join(name for name, flag in zip(robot.joint_names, flags, strict=True) if flag)
            fix = "the model holds near this position of it only; measure poses in which every joint moves"
            warnings.warn(
                sentence(f"{names}: {words} in these measurements", fix=fix), DiffeoCalibWarning, stacklevel=3
            )


def check_limits(robot: Chain, data: Measurements) -> None:
    """Warn of joints far beyond the robot's limits, but for turns so many that reading the data has told of them."""
    low, high = robot.limits.unbind(1)
    least, most, margin = data.q.amin(0), data.q.amax(0), BEYOND * (high - low)
    turns = torch.tensor(robot.periodic)
    beyond = margin.isfinite() & (margin > 0) & ((least < low - margin) | (most > high + margin))
    beyond = beyond & ~(turns & (data.q.abs().amax(0) > LARGEST_JOINT_ANGLE_RAD))
    for kind, unit, other in ((turns, "rad", "degrees"), (~turns, "m", "millimetres")):
        where = [int(joint) for joint in (beyond & kind).nonzero()]
        if where:
            first = where[0]
            which = few([robot.joint_names[joint] for joint in where], MOST_NAMES)
            expected = f"{float(low[first]):.3g} to {float(high[first]):.3g} {unit}"
            got = f"{float(least[first]):.3g} to {float(most[first]):.3g} {unit}"
            fix = f"check the joint's zero, sign and unit (not in {other}?)"
            text = sentence(f"{which}: far beyond the robot's limits", expected=expected, got=got, fix=fix)
            warnings.warn(text, DiffeoCalibWarning, stacklevel=3)


def registered(robot: Chain, data: Measurements) -> Identification:
    """Base and markers, from the rows that are not grossly wrong.

    Raises:
        MeasurementError: units that cannot be right, or rows that do not belong together.
    """
    kept = _credible(robot, data)
    registration = _trimmed(robot, data, kept)
    if float(_distances(registration.geometry, data).median()) > OTHER_ZEROS * _spread(data.points):
        registration = _with_other_zeros(registration, data, kept)
    _check_units(robot, data)
    _check_registration(robot, data, registration)
    _check_majority(robot, data, registration)
    _check_placed(robot, data, registration)
    return registration


def _trimmed(robot: Chain | Geometry, data: Measurements, kept: Tensor) -> Identification:
    """Registration of the rows that are not far off, from a first guess of which these are."""
    for _ in range(TRIMS):
        registration = register(robot, data.q[kept], data.points[kept])
        distances = _distances(registration.geometry, data).amax(1)
        near = distances <= GROSS * float(distances.median())
        if bool((near == kept).all()) or int(near.sum()) < 0.5 * len(data):
            break
        kept = near
    return registration


def _with_other_zeros(registration: Identification, data: Measurements, kept: Tensor) -> Identification:
    """The registration with other zeros of the joints, if they explain by far the most; said aloud."""
    geometry = registration.geometry
    names, periodic = geometry.chain.joint_names, geometry.chain.periodic
    if len(data) < 2 * (2 + len(names)):
        return registration
    zeros = find_zeros(geometry, data.q[kept], data.points[kept])
    again = _trimmed(with_zeros(geometry, zeros), data, kept)
    left, was = (float(_distances(r.geometry, data).median()) for r in (again, registration))
    turned = zeros[torch.tensor(periodic)]
    explained = left <= min(ZEROS_LEAVE * was, DOUBTFUL_MISFIT * _spread(data.points))
    if not explained or bool((turned.abs() > FARTHEST_ZERO).any()):
        return registration
    far = [
        f"{name} by {math.degrees(zero):.1f} degrees" if turns else f"{name} by {1e3 * zero:.1f} mm"
        for name, zero, turns in zip(names, zeros.tolist(), periodic, strict=True)
        if abs(zero) >= NOTABLE_ZERO * float(zeros.abs().max())
    ]
    text = sentence(
        f"the zeros of joints are far from the robot's description: {', '.join(far)}",
        got=f"residuals of {1e3 * was:.3g} mm, with these added to the joint values {1e3 * left:.3g} mm",
        fix="they are calibrated from there; check the offsets in the description, and the order of the joints",
    )
    warnings.warn(text, DiffeoCalibWarning, stacklevel=4)
    return again


def _credible(robot: Chain, data: Measurements) -> Tensor:
    """Rows (N,) boolean to register with: those near the best of a few registrations, of all rows and of random ones.

    A least-squares fit of all rows follows gross outliers where they are many; a few random rows may be free of them.
    """
    start = _distances(register(robot, data.q, data.points).geometry, data).amax(1)
    if float(start.max()) <= GROSS * float(start.median()) <= GROSS * CONSISTENT * _spread(data.points):
        return torch.ones(len(data), dtype=torch.bool)
    best = start
    generator = torch.Generator().manual_seed(0)
    drawn = SURPLUS * math.ceil(2.0 / data.markers + 1.0)  # 6 + 3 P unknowns, 3 P coordinates per row
    for _ in range(DRAWS if len(data) > 2 * drawn else 0):
        rows = torch.randperm(len(data), generator=generator)[:drawn]
        distances = _distances(register(robot, data.q[rows], data.points[rows]).geometry, data).amax(1)
        best = distances if float(distances.median()) < float(best.median()) else best
    if float(best.median()) > 0.5 * float(start.median()):
        return torch.ones(len(data), dtype=torch.bool)
    return best <= GROSS * float(best.median())


def check_identification(data: Measurements, identification: Identification) -> None:
    """Refuse or doubt measurements of which most rows are not explained even by a full geometric calibration."""
    _check_orientations(data, identification)
    spread, typical = _spread(data.points), float(_distances(identification.geometry, data).median())
    if typical <= DOUBTFUL_MISFIT * spread:
        return
    text = sentence(
        "the measurements do not fit this robot, even with geometric errors",
        expected=f"residuals well below the points' spread of {spread:.3g} m",
        got=f"a median of {typical:.3g} m",
        fix=likely_mistake(identification.geometry.chain, data, typical),
    )
    if typical > GEOMETRIC_MISFIT * spread:
        raise MeasurementError(text)
    warnings.warn(text, DiffeoCalibWarning, stacklevel=3)


def check_deviations(data: Measurements, registration: Identification) -> None:
    """Refuse known standard deviations that are far larger than what even the nominal robot leaves."""
    if data.std is None or data.points.numel() < 2 * (6 + 3 * data.markers):
        return  # so few data are fitted nearly exactly: residuals say nothing
    given, left = float(data.std.median()), max(registration.noise, ROUNDING)
    if given > OVERSTATED * left:
        raise MeasurementError(
            sentence(
                "the given standard deviations cannot be right",
                expected=f"at most what the nominal robot leaves, {1e3 * left:.3g} mm per coordinate",
                got=f"a median of {1e3 * given:.3g} mm",
                fix="check `std` and its unit, or leave it out: noise is estimated",
            )
        )


def doubt_outliers(flagged: int, data: Measurements, reason: str) -> None:
    """Warn of measurements of which so many rows look wrong that the others may be the wrong ones."""
    if flagged > MOST_WRONG * len(data):
        text = sentence(
            f"{flagged} of {len(data)} rows contradict the others: this calibration means little",
            expected=f"at most {100 * MOST_WRONG:.0f} %",
            got=f"of the worst row: {reason}",
            fix="check that rows pair joints with their own points, and that markers keep their numbers",
        )
        warnings.warn(text, DiffeoCalibWarning, stacklevel=3)


def _check_orientations(data: Measurements, identification: Identification) -> None:
    """Refuse poses whose orientations do not belong to the robot: a wrong convention or unit."""
    if data.poses is None or data.lever is None:
        return
    found = poses_from_marks(identification.geometry.points(data.q), data.lever)
    angles = angle_between(found[:, :3, :3], data.poses[:, :3, :3])
    if float((angles > TURNED).double().mean()) > TURNED_SHARE:
        raise MeasurementError(
            sentence(
                "the measured orientations do not fit this robot, even with geometric errors",
                expected=f"errors well below {math.degrees(TURNED):.0f} degrees",
                got=f"a median of {math.degrees(float(angles.median())):.3g} degrees",
                fix="check the convention and the unit of the rotation columns, and whether poses are inverted",
            )
        )


def _check_placed(robot: Chain, data: Measurements, registration: Identification) -> None:
    """Refuse measurements that leave it open where the markers are."""
    reach = (
        _spread(robot(data.q)[:, None, :3, 3])
        + float(robot.tip_offset[:3, 3].norm())
        + float(robot.offsets[:, :3, 3].norm(dim=1).sum())
    )
    far = float(registration.geometry.tool.norm(dim=1).max())
    if far > FAR * reach:
        raise MeasurementError(
            sentence(
                f"{len(data)} poses do not determine where base and markers are",
                expected=f"markers within {FAR * reach:.3g} m of the tip",
                got=f"{far:.3g} m",
                fix="measure more poses, and turn more joints, the wrist above all",
            )
        )


def _check_units(robot: Chain, data: Measurements) -> None:
    measured, tips = _spread(data.points), _spread(robot(data.q)[:, None, :3, 3])
    if tips > 0 and not 1 / UNIT_RATIO < measured / tips < UNIT_RATIO:
        raise MeasurementError(
            sentence(
                "the measured points do not have the robot's size",
                expected=f"a spread of about {tips:.3g} m, the tip's over these configurations",
                got=f"{measured:.3g} m",
                fix="check the length unit (mm or m) and the angle unit (deg or rad)",
            )
        )


def _check_registration(robot: Chain, data: Measurements, registration: Identification) -> None:
    measured, nominal = _spread(data.points), _spread(registration.geometry.points(data.q))
    typical = float(_distances(registration.geometry, data).median())
    if typical > MISFIT * max(measured, nominal):
        raise MeasurementError(
            sentence(
                "the measurements do not fit this robot: no base frame and markers explain them",
                expected=f"residuals well below the points' spread of {measured:.3g} m",
                got=f"a median of {typical:.3g} m",
                fix=likely_mistake(robot, data, typical),
            )
        )


def _check_majority(robot: Chain, data: Measurements, registration: Identification) -> None:
    """Refuse measurements of which hardly more than half belong together."""
    distances = _distances(registration.geometry, data).amax(1)
    typical = float(distances.median())
    wrong = distances > GROSS * typical
    if float(wrong.double().mean()) > MOST_WRONG and float(distances[wrong].median()) > MISFIT * _spread(data.points):
        raise MeasurementError(
            sentence(
                f"the measurements do not fit this robot: {int(wrong.sum())} of {len(data)} rows contradict the others",
                expected=f"at most {100 * MOST_WRONG:.0f} % of them further off than {GROSS * typical:.3g} m",
                got=f"a median of {float(distances[wrong].median()):.3g} m",
                fix=likely_mistake(robot, data, float(distances[wrong].median())),
            )
        )


def _distances(geometry: Geometry, data: Measurements) -> Tensor:
    """From predicted to measured markers, (N, P) in m."""
    return (geometry.points(data.q) - data.points).norm(dim=-1)


def _spread(points: Tensor) -> float:
    """Root mean square distance of the markers from their centre, m; a few gross outliers do not count."""
    squares = (points - points.median(dim=0, keepdim=True).values).square().sum(-1)
    return float(squares[squares <= GROSS**2 * squares.median()].mean().sqrt())
