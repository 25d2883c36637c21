"""Directions a campaign leaves open: markers and frames it does not determine, paths in a plane, single joints.

So do joint values of few digits: what their rounding does to the positions is told, too. The calibration goes on, and
its predictions carry the deviations that follow. The warnings say what to measure.
"""

from __future__ import annotations

from math import pi
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
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
    geometry, reached, q = registration.geometry, _reached(robot, data, registration), data.q
    every, parts = torch.arange(geometry.size, device=HOST), geometry.slices
    places = torch.cat([every[parts["base"]], every[parts["tool"]]])
    # Whatever a SCARA robot does, the height of its marker and that of its base cannot be told apart, and need not be.
    slopes = geometry.sensitivities(sampled_configurations(geometry.chain))[..., places].flatten(0, 2)
    unit = slopes.new_ones(len(places))
    unit[3:6] = 1 / reached  # a turn as the motion at the reach, m
    _, s, Vt = torch.linalg.svd(slopes * unit, full_matrices=False)
    some_poses = Vt[s > gates.SEEN * gates.SAMPLES**0.5]
    # The frame about the middle of the rows and along its own axes.
    R, middle = geometry.base[:3, :3], geometry.points(q).mean((0, 1))
    arm = R.mT @ (middle - geometry.base[:3, 3])  # of the middle, in the robot's base
    to = torch.eye(len(places), dtype=q.dtype, device=q.device)
    to[:3, :3], to[3:6, 3:6], to[:3, 3:6] = R, R, -R @ skew(arm)
    to = to @ (unit[:, None] * (some_poses.mT @ some_poses) / unit)
    covariance = to @ registration.covariance[places[:, None], places] @ to.mT
    rigid = data.lever is not None
    return undetermined(covariance, geometry.tool, reached, registration.noise, geometry.on, rigid=rigid)


def _reached(robot: Tree, data: Measurements, registration: Identification) -> float:
    """Largest distance of the tip from the base, m."""
    return max(float(robot.tip_poses(data.q)[..., :3, 3].norm(dim=-1).max()), registration.noise)


def sampled_configurations(chain: Tree) -> Tensor:
    """Joint values (200, n) all over the range of the robot, at most half a turn to either side, rad or m."""
    low, high = chain.limits.unbind(1)
    low, high = low.clamp(min=-gates.SAMPLED_RAD_M), high.clamp(max=gates.SAMPLED_RAD_M)
    draws = torch.rand(gates.SAMPLES, chain.n, dtype=low.dtype, generator=seeded(0), device=HOST)
    return low + (high - low) * draws


def _warn_of_flat_paths(geometry: Geometry, q: Tensor, reached: float) -> None:
    """Warn of markers in a plane, on a line or near a point that the robot could leave."""
    if len(q) < gates.PATH_POSES:  # three points always lie in a plane
        return
    middles = geometry.points(q).mean(1)
    _, s, axes = torch.linalg.svd(middles - middles.mean(0), full_matrices=False)
    spreads = s / len(q) ** 0.5
    speeds = geometry.jacobian(q).mean(1)  # (N, 3, n)
    leaving = torch.einsum("ac,ncl->nal", axes, speeds).square().mean(0).sqrt().amax(1)  # along each axis
    open_axes = (spreads < gates.FLAT * reached) & (leaving > gates.LEAVES * reached)
    count = int(open_axes.sum())
    if count:
        away = 1e3 * float(spreads[open_axes].square().sum().sqrt())
        what = f"the measured positions lie near {('a plane', 'a line', 'one point')[count - 1]}"
        fix = "predictions elsewhere are extrapolated; spread the poses over the workspace that you will use"
        warn_user(sentence(what, got=f"{away:.2g} mm RMS away from it", fix=fix))


def _warn_of_single_joints(robot: Tree, q: Tensor) -> None:
    """Warn if the joints moved one at a time."""
    moved = (q - q.median(0).values).abs() > gates.MOVED_RAD_M
    single, joints = int((moved.sum(1) <= 1).sum()), moved.any(0)
    if single >= gates.SINGLE_SHARE * len(q) and int(joints.sum()) >= gates.SINGLE_JOINTS:
        names = few([name for name, any_row in zip(robot.joint_names, joints, strict=True) if bool(any_row)], 12)
        what = f"{names} moved one at a time in {single} of {len(q)} rows"
        fix = "what depends on several joints, such as sag, is extrapolated; measure poses in which all joints differ"
        warn_user(sentence(what, fix=fix))


def quantum(values: Tensor, *, turning: bool) -> tuple[float, str] | None:
    """The step in which a joint's values (N,) were written, rad or m, and the step in words; None if they were not.

    Steps are powers of ten, whole or half, in rad, deg, m or mm.
    """
    units = (("rad", 1.0), ("degrees", pi / 180)) if turning else (("m", 1.0), ("mm", 1e-3))
    steps = [
        (step * size, f"{step:g} {unit}")
        for unit, size in units
        for digits in range(gates.DIGITS + 1)
        for step in (10.0**-digits, 5 * 10.0 ** -(digits + 1))
    ]
    for size, words in sorted(steps, reverse=True):
        multiples = values / size
        few = len(multiples.round().unique()) < gates.DIGIT_VALUES  # near the same multiple of any large step
        if not few and float((multiples - multiples.round()).abs().max()) < gates.DIGIT_REMAINDER:
            return size, words
    return None


def warn_of_rounding(
    robot: Tree,
    data: Any,
    tangent: TangentData,
    left_out: LeaveOneOut,
) -> None:
    """Warn if the joint values have so few digits that their rounding explains much of the remaining error.

    Args:
        robot: n joints. data: N rows. tangent: the same around the geometric calibration.
        left_out: leave-one-out errors.

    Warns:
        DiffeoCalibWarning: the step, the joints, the position error that it causes, and what remains.
    """
    found = {}
    for k, name in enumerate(robot.joint_names):
        step = quantum(data.q[:, k], turning=robot.periodic[k])
        if step is not None:
            found[k] = (name, *step)
    if not found or len(data) < gates.DIGIT_ROWS:
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
    if not gates.ROUNDING_LEAST * remaining < caused < gates.ROUNDING_MOST * remaining:
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
