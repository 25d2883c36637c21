"""Directions a campaign leaves open: markers and frames it does not determine, paths in a plane, single joints.

So do joint values of few digits: what their rounding does to the positions is told, too. The calibration goes on, and
its predictions carry the deviations that follow. The warnings say what to measure.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import MOST_NAMES, few, sentence, warn_user
from diffeo_calib.common.quantiles import chi2_median
from diffeo_calib.kinematics.re_registration.registered_map import undetermined
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import skew
from diffeo_calib.robots.tree import Tree

FEWEST_POSES = 6
"""Poses from which the shape of a path says something."""


@dataclass(frozen=True)
class CampaignLimits:
    """When something is warned about. Lengths are relative to the largest distance of the tip from the base.

    Args:
        flat: RMS distance of the markers from a plane, a line or a point, below which they lie on it.
        leaves: RMS speed with which some joint would leave the plane or line.
        moved: distance of a joint from its median value from which it has moved, rad or m.
        single_share: share of rows in which at most one joint has moved, from which joints moved one at a time.
        fewest_joints: joints that must have moved for this.
        samples: number of poses that show what the robot could determine. sampled: largest joint value of them, rad or
            m. seen: RMS motion of the markers by a direction's unit step from which some poses determine it.
    """

    flat: float = 0.02
    leaves: float = 0.1
    moved: float = 0.05
    single_share: float = 0.9
    fewest_joints: int = 3
    samples: int = 200
    sampled: float = 3.2
    seen: float = 0.05


LIMITS = CampaignLimits()


def warn_of_open_directions(robot: Tree, data: Measurements, registration: Identification) -> None:
    """Warn of what the measurements leave open.

    Args:
        robot: the nominal chain. data: the measurements. registration: base and markers.
    """
    for text in undetermined_places(robot, data, registration):
        warn_user(f"{text}.")
    measured = data.q[data.places.to(data.q.device) < 0]  # sockets on one table need not leave anything open
    _warn_of_flat_paths(registration.geometry, measured, _reached(robot, data, registration))
    _warn_of_single_joints(robot, data.q)


def undetermined_places(robot: Tree, data: Measurements, registration: Identification) -> tuple[str, ...]:
    """Sentences about the directions of base and markers that the measurements hardly determine; arguments as above."""
    reached = _reached(robot, data, registration)
    covariance = _about_the_middle(registration, data.q, _within_reach(registration.geometry, reached))
    rigid, tool = data.lever is not None, registration.geometry.tool
    return undetermined(covariance, tool, reached, registration.noise, registration.geometry.on, rigid=rigid)


def _reached(robot: Tree, data: Measurements, registration: Identification) -> float:
    """Largest distance of the tip from the base, m."""
    return max(float(robot.tip_poses(data.q)[..., :3, 3].norm(dim=-1).max()), registration.noise)


def _within_reach(geometry: Geometry, reached: float) -> Tensor:
    """Projection (6 + 3 P, 6 + 3 P) onto the directions of base and markers that some poses of the robot determine.

    Whatever a SCARA robot does, the height of its marker and that of its base cannot be told apart, and need not be.
    """
    slopes = geometry.sensitivities(sampled_configurations(geometry.chain))[..., _places(geometry)].flatten(0, 2)
    unit = slopes.new_ones(slopes.shape[1])
    unit[3:6] = 1 / reached  # a turn as the motion at the reach, m
    _, s, Vt = torch.linalg.svd(slopes * unit, full_matrices=False)
    seen = Vt[s > LIMITS.seen * LIMITS.samples**0.5]
    return unit[:, None] * (seen.mT @ seen) / unit


def sampled_configurations(chain: Tree) -> Tensor:
    """Joint values (200, n) all over the range of the robot, at most half a turn to either side, rad or m."""
    low, high = chain.limits.unbind(1)
    low, high = low.clamp(min=-LIMITS.sampled), high.clamp(max=LIMITS.sampled)
    draws = torch.rand(LIMITS.samples, chain.n, dtype=low.dtype, generator=seeded(0), device=HOST)
    return low + (high - low) * draws


def _places(geometry: Geometry) -> Tensor:
    """Numbers of the parameters of base and markers, (6 + 3 P,)."""
    every, parts = torch.arange(geometry.size, device=HOST), geometry.slices
    return torch.cat([every[parts["base"]], every[parts["tool"]]])


def _about_the_middle(registration: Identification, q: Tensor, within_reach: Tensor) -> Tensor:
    """Covariance of the measuring frame, about the middle of the rows and along its own axes, and of the markers.

    Args:
        within_reach: projection onto the directions that count.
    """
    geometry, places = registration.geometry, _places(registration.geometry)
    covariance = within_reach @ registration.covariance[places[:, None], places] @ within_reach.mT
    R, middle = geometry.base[:3, :3], geometry.points(q).mean((0, 1))
    arm = R.mT @ (middle - geometry.base[:3, 3])  # of the middle, in the robot's base
    to = torch.eye(len(places), dtype=q.dtype, device=q.device)
    to[:3, :3], to[3:6, 3:6], to[:3, 3:6] = R, R, -R @ skew(arm)
    return to @ covariance @ to.mT


def _warn_of_flat_paths(geometry: Geometry, q: Tensor, reached: float) -> None:
    """Warn of markers in a plane, on a line or near a point that the robot could leave."""
    if len(q) < FEWEST_POSES:  # three points always lie in a plane
        return
    middles = geometry.points(q).mean(1)
    _, s, axes = torch.linalg.svd(middles - middles.mean(0), full_matrices=False)
    spreads = s / len(q) ** 0.5
    speeds = geometry.jacobian(q).mean(1)  # (N, 3, n)
    leaving = torch.einsum("ac,ncl->nal", axes, speeds).square().mean(0).sqrt().amax(1)  # along each axis
    open_axes = (spreads < LIMITS.flat * reached) & (leaving > LIMITS.leaves * reached)
    count = int(open_axes.sum())
    if count:
        away = 1e3 * float(spreads[open_axes].square().sum().sqrt())
        what = f"the measured positions lie near {('a plane', 'a line', 'one point')[count - 1]}"
        fix = "predictions elsewhere are extrapolated; spread the poses over the workspace that you will use"
        warn_user(sentence(what, got=f"{away:.2g} mm RMS away from it", fix=fix))


def _warn_of_single_joints(robot: Tree, q: Tensor) -> None:
    """Warn if the joints moved one at a time."""
    moved = (q - q.median(0).values).abs() > LIMITS.moved
    single, joints = int((moved.sum(1) <= 1).sum()), moved.any(0)
    if single >= LIMITS.single_share * len(q) and int(joints.sum()) >= LIMITS.fewest_joints:
        names = few([name for name, any_row in zip(robot.joint_names, joints, strict=True) if bool(any_row)], 12)
        what = f"{names} moved one at a time in {single} of {len(q)} rows"
        fix = "what depends on several joints, such as sag, is extrapolated; measure poses in which all joints differ"
        warn_user(sentence(what, fix=fix))


@dataclass(frozen=True)
class RoundingLimits:
    """When joint values count as rounded, and when that is reported.

    Args:
        digits: most digits after the decimal point of a column that is looked at.
        remainder: largest distance from a multiple of the last digit, as a part of it.
        fewest_values: different multiples of the step that a column must hold. fewest_rows: fewer leave errors as
            large as those of rounding, whatever the digits.
        least: part of the remaining error from which rounding is reported. most: multiple of it beyond which it cannot
            have happened: the values were commanded with few digits, and reached.
    """

    digits: int = 5
    remainder: float = 1e-3
    fewest_values: int = 8
    fewest_rows: int = 20
    least: float = 0.5
    most: float = 1.5


ROUNDING_LIMITS = RoundingLimits()


def quantum(values: Tensor, *, turning: bool, limits: RoundingLimits = ROUNDING_LIMITS) -> tuple[float, str] | None:
    """The step in which a joint's values (N,) were written, rad or m, and the step in words; None if they were not.

    Steps are powers of ten, whole or half, in rad, deg, m or mm.
    """
    units = (("rad", 1.0), ("degrees", pi / 180)) if turning else (("m", 1.0), ("mm", 1e-3))
    steps = [
        (step * size, f"{step:g} {unit}")
        for unit, size in units
        for digits in range(limits.digits + 1)
        for step in (10.0**-digits, 5 * 10.0 ** -(digits + 1))
    ]
    for size, words in sorted(steps, reverse=True):
        multiples = values / size
        few = len(multiples.round().unique()) < limits.fewest_values  # near the same multiple of any large step
        if not few and float((multiples - multiples.round()).abs().max()) < limits.remainder:
            return size, words
    return None


def warn_of_rounding(
    robot: Tree,
    data: Any,
    tangent: TangentData,
    left_out: LeaveOneOut,
    limits: RoundingLimits = ROUNDING_LIMITS,
) -> None:
    """Warn if the joint values have so few digits that their rounding explains much of the remaining error.

    Args:
        robot: n joints. data: N rows. tangent: the same around the geometric calibration.
        left_out: leave-one-out errors.
        limits: when rounding is found and reported.

    Warns:
        DiffeoCalibWarning: the step, the joints, the position error that it causes, and what remains.
    """
    found = {}
    for k, name in enumerate(robot.joint_names):
        step = quantum(data.q[:, k], turning=robot.periodic[k], limits=limits)
        if step is not None:
            found[k] = (name, *step)
    if not found or len(data) < limits.fewest_rows:
        return
    variances, bodies = tangent.x.new_zeros(robot.n), tangent.noise_model.bodies
    for k, (_, size, _) in found.items():
        variances[k] = size**2 / 12  # of a uniform distribution
    points = bodies if tangent.noise_model.modes is None else tangent.y.shape[1] // 3
    caused = float((tangent.jacobian.square() @ variances).unflatten(1, (points, -1)).sum(-1).mean().sqrt())
    seen = left_out.errors.unflatten(1, (points, -1))
    squares = seen.square().nansum(-1)[~seen.isnan().all(-1)]
    size = seen.shape[2]
    remaining = float((size * squares.median() / chi2_median(size)).sqrt())
    if not limits.least * remaining < caused < limits.most * remaining:
        return
    steps = sorted({words for _, _, words in found.values()})
    which = few([name for name, _, _ in found.values()], MOST_NAMES)
    text = sentence(
        f"the values of {which} are rounded to {' and '.join(steps)}",
        expected="readings with more digits",
        got=f"{1e3 * caused:.2g} mm RMS of position error from this rounding, {1e3 * remaining:.2g} mm remain in all",
        fix="write more digits of the joint values, unless the robot was commanded to exactly these",
    )
    warn_user(text)
