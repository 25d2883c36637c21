"""Refuse measurements that cannot belong to a robot, and warn of doubtful ones, before they are calibrated away.

Rows that were computed by the nominal robot's controller or a program, not measured.

If nothing but the digits of a table separates its rows from the nominal robot, they say nothing about its errors: a
device would see some tenths of a millimetre of these.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.campaign import quantum
from diffeo_calib.calibration.diagnostics.likely_mistakes import likely_mistake
from diffeo_calib.calibration.diagnostics.misplaced_rows import check_row_order
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.identification.registration import (
    ROBUST,
    can_register,
    distances,
    largest_distances,
    register_inliers,
    spread,
    with_large_offsets,
)
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import MOST_NAMES, MeasurementError, RobotError, few, sentence, warn_user
from diffeo_calib.common.quantiles import known
from diffeo_calib.measurements.checks import LARGEST_JOINT_ANGLE_RAD
from diffeo_calib.measurements.pose_frames import POINTS
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import joint_name_fix


@dataclass(frozen=True)
class PlausibilityLimits:
    """Limits beyond which measurements are refused or warned about.

    A relative residual is a median distance divided by the spread of the markers.

    Args:
        never_moved_m: spread of the markers below which they stand still: no device of robots repeats so well.
        spread_ratio: measured over nominal spread of the markers from which the length unit must be wrong.
        registration_residual: relative residual after registration that is refused.
        geometric_residual: relative residual after the geometric calibration that is refused; a UR10 leaves 0.001, a
            wrong tip link 0.1. warned_residual: the same, warned about.
        fixed_range: range of a joint, rad or m, below which it never moved. small_range: below which it hardly moved.
        orientation_rad: largest plausible orientation error after the geometric calibration.
        orientation_share: share of poses that may exceed it.
        limit_excess: part of a joint's range by which its values may exceed its limits; robot files are often
            careless.
        marker_reaches: distance of a marker from the tip, in reaches of the robot, at which it is undetermined.
        gross_share: largest share of gross outliers.
        deviation_ratio: given standard deviation over residual from which its unit is wrong.
        smallest_residual_m: residual below which rounding may dominate.
    """

    never_moved_m: float = 1e-6
    spread_ratio: float = 30.0
    registration_residual: float = 0.25
    geometric_residual: float = 0.06
    warned_residual: float = 0.02
    fixed_range: float = 1e-3
    small_range: float = 0.05
    orientation_rad: float = 0.1
    orientation_share: float = 0.1
    limit_excess: float = 0.25
    marker_reaches: float = 5.0
    gross_share: float = 0.4
    deviation_ratio: float = 10.0
    smallest_residual_m: float = 1e-6


LIMITS = PlausibilityLimits()


def check_joints(robot: Tree, data: Any) -> None:
    """Refuse joints that are not the robot's; warn of joints that never or hardly move."""
    _check_names(robot, data)
    if len(data) == 1:
        return  # the registration refuses a single row
    ranges = data.q.amax(0) - data.q.amin(0)
    still = ranges < LIMITS.fixed_range
    if bool(still.all()):
        what = f"all {len(data)} rows hold the same configuration: the robot does not move"
        raise MeasurementError.of(what, fix="measure poses in which every joint moves")
    hardly = (ranges < LIMITS.small_range) & ~still
    for flags, words in ((still, "never moved"), (hardly, "hardly moved")):
        if bool(flags.any()):
            names = ", ".join(name for name, flag in zip(robot.joint_names, flags, strict=True) if flag)
            fix = "the model is valid only near this joint position; measure poses in which every joint moves"
            warn_user(sentence(f"{names}: {words} in these measurements", fix=fix))


def _check_names(robot: Tree, data: Any) -> None:
    """Refuse another number of joints, or other names."""
    if data.n != robot.n:
        raise MeasurementError.of(
            f"the measurements do not fit robot '{robot.name}'",
            expected=f"{robot.n} joints ({few(robot.joint_names, MOST_NAMES)})",
            got=data.n,
            fix="check the base and tip links, and the joint columns",
        )
    if data.joint_names is not None and tuple(data.joint_names) != tuple(robot.joint_names):
        raise RobotError.of(
            f"the measurements' joints are not those of robot '{robot.name}'",
            expected=few(robot.joint_names, MOST_NAMES),
            got=few(data.joint_names, MOST_NAMES),
            fix=joint_name_fix(robot, data.joint_names),
        )


def check_limits(robot: Tree, data: Any) -> None:
    """Warn of joints far beyond the robot's limits, unless they span several turns: reading the data warns of that."""
    low, high = robot.limits.to(data.q.device).unbind(1)
    least, most, margin = data.q.amin(0), data.q.amax(0), LIMITS.limit_excess * (high - low)
    turns = torch.tensor(robot.periodic, dtype=torch.bool, device=data.q.device)
    beyond = margin.isfinite() & (margin > 0) & ((least < low - margin) | (most > high + margin))
    beyond = beyond & ~(turns & (data.q.abs().amax(0) > LARGEST_JOINT_ANGLE_RAD))
    for kind, unit, other in ((turns, "rad", "degrees"), (~turns, "m", "millimetres")):
        where = [int(joint) for joint in (beyond & kind).nonzero()]
        if where:
            first = where[0]
            which = few([robot.joint_names[joint] for joint in where], MOST_NAMES)
            expected = f"{float(low[first]):.3g} to {float(high[first]):.3g} {unit}"
            got = f"{float(least[first]):.3g} to {float(most[first]):.3g} {unit}"
            fix = f"check the joint's offset, sign and unit (not in {other}?)"
            text = sentence(f"{which}: far beyond the robot's limits", expected=expected, got=got, fix=fix)
            warn_user(text)


def registered(robot: Tree, data: Measurements) -> Identification:
    """Base and markers from the inliers.

    Raises:
        MeasurementError: units that cannot be right, or rows that do not belong together.
    """
    registration, inliers = register_inliers(robot, data)
    _check_units(robot, data)
    check_row_order(robot, data, registration)
    registration = with_large_offsets(data, registration, inliers)
    _check_registration(robot, data, registration)
    _check_gross_outliers(robot, data, registration)
    _check_markers(robot, data, registration)
    return registration


def refuse_mistakes(robot: Tree, data: Measurements) -> None:
    """Raise MeasurementError for rows far from a model that no base and markers explain, with the likely mistake."""
    if len(data) >= 2 * (2 + robot.n) and can_register(data.points):
        _check_units(robot, data)
        _check_registration(robot, data, register_inliers(robot, data)[0])


def check_identification(data: Measurements, identification: Identification) -> None:
    """Refuse measurements that even a full geometric calibration leaves unexplained, or warn of them."""
    _check_orientations(data, identification)
    size, typical = spread(data.points), _typical(identification, data)
    if typical <= LIMITS.warned_residual * size:
        return
    text = sentence(
        "the measurements do not fit this robot, even with geometric errors",
        expected=f"residuals well below the points' spread of {size:.3g} m",
        got=f"a median of {typical:.3g} m",
        fix=likely_mistake(identification.geometry.chain, data, typical),
    )
    if typical > LIMITS.geometric_residual * size:
        raise MeasurementError(text)
    warn_user(text)


def check_deviations(data: Measurements, registration: Identification) -> None:
    """Refuse known standard deviations that are far larger than the residual of the registration."""
    if data.std is None or len(known(data.points)) < 2 * (6 + 3 * data.markers):
        return  # few data are fitted nearly exactly: their residual does not show the noise
    given, residual = float(data.std.nanmedian()), max(registration.noise, LIMITS.smallest_residual_m)
    if given > LIMITS.deviation_ratio * residual:
        raise MeasurementError.of(
            "the given standard deviations cannot be right",
            expected=f"at most the residual of the nominal robot, {1e3 * residual:.3g} mm per coordinate",
            got=f"a median of {1e3 * given:.3g} mm",
            fix="check `std` and its unit, or leave it out: noise is estimated",
        )


def _check_orientations(data: Measurements, identification: Identification) -> None:
    """Refuse poses whose orientations do not belong to the robot: a wrong convention or unit."""
    angles = known(data.bodies.turns(data, identification.geometry.points(data.q)))
    if len(angles) and float((angles > LIMITS.orientation_rad).double().mean()) > LIMITS.orientation_share:
        raise MeasurementError.of(
            "the measured orientations do not fit this robot, even with geometric errors",
            expected=f"errors well below {math.degrees(LIMITS.orientation_rad):.0f} degrees",
            got=f"a median of {math.degrees(float(angles.median())):.3g} degrees",
            fix=likely_mistake(identification.geometry.chain, data, _typical(identification, data)),
        )


def _typical(identification: Identification, data: Measurements) -> float:
    """Median residual, m."""
    return float(distances(identification.geometry, data).nanmedian())


def _check_markers(robot: Tree, data: Measurements, registration: Identification) -> None:
    """Refuse measurements that leave the markers undetermined."""
    reach = spread(robot.tip_poses(data.q)[..., :3, 3]) + float(robot.place_offsets[:, :3, 3].norm(dim=1).sum())
    farthest = float(registration.geometry.tool.norm(dim=1).max())
    if farthest > LIMITS.marker_reaches * reach:
        raise MeasurementError.of(
            f"{len(data)} poses do not determine where base and markers are",
            expected=f"markers within {LIMITS.marker_reaches * reach:.3g} m of the tip",
            got=f"{farthest:.3g} m",
            fix="measure more poses, and turn more joints, above all the wrist",
        )


def _check_units(robot: Tree, data: Measurements) -> None:
    """Refuse markers whose spread is not that of the robot's tip, above all if they never move."""
    measured, tips = spread(data.points), spread(robot.tip_poses(data.q)[..., :3, 3])
    if tips > 0 and measured < LIMITS.never_moved_m:
        raise MeasurementError.of(
            "the measured points never move, and so tell nothing about the robot",
            expected=f"a spread of about {tips:.3g} m, the tip's over these configurations",
            got=f"{measured:.3g} m",
            fix="check the columns of the positions; with two arms that hold one rigid tool measure other rows, a ball "
            "in one hand that rests in sockets of a block in the other (`--base LEFT --tip RIGHT --socket ...`)",
        )
    if tips > 0 and not 1 / LIMITS.spread_ratio < measured / tips < LIMITS.spread_ratio:
        raise MeasurementError.of(
            "the measured points do not have the robot's size",
            expected=f"a spread of about {tips:.3g} m, the tip's over these configurations",
            got=f"{measured:.3g} m",
            fix="check the length unit (mm or m) and the angle unit (deg or rad)"
            + ", and the unit of the prismatic joints (`joint_length`)" * (not all(robot.periodic)),
        )


def _check_registration(robot: Tree, data: Measurements, registration: Identification) -> None:
    """Refuse measurements that no base and markers explain."""
    measured, nominal = spread(data.points), spread(registration.geometry.points(data.q))
    typical = _typical(registration, data)
    if typical > LIMITS.registration_residual * max(measured, nominal):
        raise MeasurementError.of(
            "the measurements do not fit this robot: no base frame and markers explain them",
            expected=f"residuals well below the points' spread of {measured:.3g} m",
            got=f"a median of {typical:.3g} m",
            fix=likely_mistake(robot, data, typical),
        )


def _check_gross_outliers(robot: Tree, data: Measurements, registration: Identification) -> None:
    """Refuse measurements with many gross outliers that are far off."""
    largest = largest_distances(registration.geometry, data)
    limit = ROBUST.gross_distances * float(largest.median())
    gross = largest > limit
    if float(gross.double().mean()) <= LIMITS.gross_share:
        return
    typical = float(largest[gross].median())
    if typical > LIMITS.registration_residual * spread(data.points):
        raise MeasurementError.of(
            f"the measurements do not fit this robot: {int(gross.sum())} of {len(data)} rows are outliers",
            expected=f"at most {100 * LIMITS.gross_share:.0f} % of them with errors above {limit:.3g} m",
            got=f"a median error of the outliers of {typical:.3g} m",
            fix=likely_mistake(robot, data, typical),
        )


@dataclass(frozen=True)
class NominalLimits:
    """When rows are the nominal robot's own.

    Args:
        share: residual after registration, in the extent of the measured values, that no device and no robot leaves.
        digits: residual, in what the digits of joints and values explain, up to which there is nothing else.
        coarsest_m: coarsest digit of values that is looked at.
        doubted_share: residual, in that extent, from which errors of a robot show.
        doubted: residual of the registration, in that of the geometric calibration, up to which errors of links explain
            nothing.
        overdetermined: measured coordinates per unknown from which residuals tell something.
        fewest_joints: of robots whose errors base and marker cannot absorb.
    """

    share: float = 1e-6
    digits: float = 1.15
    coarsest_m: float = 2e-4
    doubted_share: float = 1e-4
    doubted: float = 1.15
    overdetermined: float = 3.0
    fewest_joints: int = 3


NOMINAL = NominalLimits()
WHAT = "these rows are those of the nominal robot, as its controller or a simulation computes them"
FIX = (
    "use what a device measured, not the position that the controller displays; to try the package without one, "
    "simulate a robot with errors (`diffeo-calib demo`)"
)


def check_not_nominal(robot: Tree, data: TangentData, registration: Identification, found: Identification) -> None:
    """Refuse rows that the nominal robot explains to their last digit; warn of those that show no errors of links.

    Args:
        robot: n joints. data: the rows around the geometric calibration.
        registration: base and markers, or ball and devices. found: the geometric calibration.
    """
    points = data.nominal(data.x, torch.zeros_like(data.theta))
    predicted = points if data.observe is None else data.observe.value(points)
    errors = (data.y - predicted).masked_fill(~data.visible, torch.nan)
    rms = float(errors.square().nanmean().sqrt())
    size = float((data.y - data.y.mean(0)).abs().amax())  # the reach of a robot with prismatic joints may have no bound
    spare = int(data.visible.sum()) > NOMINAL.overdetermined * _placed_numbers(data)
    if spare and (rms < NOMINAL.share * size or _by_digits(robot, data, errors)):
        expected = "errors of some 0.1 mm, which every robot has"
        raise MeasurementError.of(WHAT, expected=expected, got=f"{1e3 * rms:.2g} mm RMS", fix=FIX)
    shown = registration.noise > min(NOMINAL.doubted * found.noise, NOMINAL.doubted_share * size)
    if (
        not shown
        and robot.n >= NOMINAL.fewest_joints
        and data.coordinates > NOMINAL.overdetermined * data.nominal.geometry.size
    ):
        what = f"these rows show no errors of the robot: its description explains them to {1e3 * rms:.2g} mm RMS, and "
        what += "errors of its links explain no more"
        warn_user(sentence(what, fix=f"if they were computed, {FIX}"))


def _placed_numbers(data: TangentData) -> int:
    """Numbers of base, markers and devices."""
    slices = data.nominal.geometry.slices
    devices = 0 if data.shared is None else data.shared.shape[2]
    return sum(slices[name].stop - slices[name].start for name in ("base", "tool")) + devices


def _by_digits(robot: Tree, data: TangentData, errors: Tensor) -> bool:
    """Whether the digits of joints and values explain errors (N, R)."""
    slopes = data.jacobian
    for width in (1, POINTS):  # single points, or the middles of three that stand for a pose
        if errors.shape[1] % (3 * width) and width > 1:
            continue
        values, own, by_joints = (_middles(v, width) for v in (data.y, errors, slopes))
        found = [
            None if bool(seen.isnan().any()) else quantum(column, turning=False)
            for column, seen in zip(values.unbind(1), own.unbind(1), strict=True)
        ]
        steps = [step[0] for step in found if step is not None and step[0] <= NOMINAL.coarsest_m]
        if len(steps) < len(found):
            continue
        joints = [quantum(data.x[:, k], turning=robot.periodic[k]) for k in range(robot.n)]
        variances = data.x.new_tensor([0.0 if step is None else step[0] ** 2 / 12 for step in joints])
        explained = data.x.new_tensor(steps).square().mean() / 12 + (by_joints.square() @ variances).mean()
        return bool(own.square().mean() < NOMINAL.digits**2 * explained)
    return False


def _middles(values: Tensor, width: int) -> Tensor:
    """Means of ``width`` points that follow one another: (N, 3 width k, ...) -> (N, 3 k, ...)."""
    return values if width == 1 else values.unflatten(1, (-1, width, 3)).mean(2).flatten(1, 2)
