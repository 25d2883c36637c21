"""What rows leave open: places that they do not determine, paths in a plane, joints that they do not show.

The calibration goes on, and its predictions carry the deviations that follow. The warnings say what to measure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import few, sentence, warn_user
from diffeo_calib.kinematics.registered_map import undetermined
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.se3 import twist_at
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import Devices

TILT = "tilt the tool by 20 degrees or more, to several sides"


def warn_of_open_directions(robot: Tree, data: Measurements, registration: Identification) -> None:
    """Warn of what the measurements leave open: places, and a path that the robot could leave."""
    for text in undetermined_places(robot, data.q, registration, rigid=data.lever is not None):
        warn_user(f"{text}.")
    if len(data) >= gates.PATH_POSES:  # three points always lie in a plane
        geometry, reached = registration.geometry, _reached(robot, data.q, registration)
        middles = geometry.points(data.q).mean(1)
        _, s, axes = torch.linalg.svd(middles - middles.mean(0), full_matrices=False)
        spreads, speeds = s / len(data) ** 0.5, geometry.jacobian(data.q).mean(1)  # (N, 3, n)
        leaving = torch.einsum("ac,ncl->nal", axes, speeds).square().mean(0).sqrt().amax(1)  # along each axis
        flat = (spreads < gates.FLAT * reached) & (leaving > gates.LEAVES * reached)
        if count := int(flat.sum()):
            away = 1e3 * float(spreads[flat].square().sum().sqrt())
            what = f"the measured positions lie near {('a plane', 'a line', 'one point')[count - 1]}"
            fix = "predictions elsewhere are extrapolated; spread the poses over the workspace that you will use"
            warn_user(sentence(what, got=f"{away:.2g} mm RMS away from it", fix=fix))


def warn_of_single_joints(robot: Tree, data: Any) -> None:
    """Warn of joints that moved one at a time in most rows of any kinds."""
    moved = (data.q - data.q.median(0).values).abs() > gates.MOVED_RAD_M
    single, joints = int((moved.sum(1) <= 1).sum()), moved.any(0)
    if single >= gates.SINGLE_SHARE * len(data) and int(joints.sum()) >= gates.SINGLE_JOINTS:
        names = few([name for name, flag in zip(robot.joint_names, joints, strict=True) if bool(flag)], 12)
        what = f"{names} moved one at a time in {single} of {len(data)} rows"
        fix = "what depends on several joints, such as sag, is extrapolated; measure poses in which all joints differ"
        warn_user(sentence(what, fix=fix))


def undetermined_places(robot: Tree, q: Tensor, registration: Identification, *, rigid: bool) -> tuple[str, ...]:
    """Sentences about the directions of base and markers that rows (N, n) hardly determine; ``rigid``: of poses."""
    geometry, reached = registration.geometry, _reached(robot, q, registration)
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
    to[:6, :6] = torch.block_diag(R, R) @ twist_at(arm)
    to = to @ (unit[:, None] * (some_poses.mT @ some_poses) / unit)
    covariance = to @ registration.covariance[places[:, None], places] @ to.mT
    return undetermined(covariance, geometry.tool, reached, registration.noise, geometry.on, rigid=rigid)


def _reached(robot: Tree, q: Tensor, registration: Identification) -> float:
    """Largest distance of the tip from the base, m."""
    return max(float(robot.tip_poses(q)[..., :3, 3].norm(dim=-1).max()), registration.noise)


def sampled_configurations(chain: Tree) -> Tensor:
    """Joint values (200, n) all over the range of the robot, at most half a turn to either side, rad or m."""
    low, high = chain.limits.unbind(1)
    low, high = low.clamp(min=-gates.SAMPLED_RAD_M), high.clamp(max=gates.SAMPLED_RAD_M)
    draws = torch.rand(gates.SAMPLES, chain.n, dtype=low.dtype, generator=seeded(0), device=HOST)
    return low + (high - low) * draws


# --- the ball on a tool ---------------------------------------------------------------------------------------------


def warn_of_what_is_open(data: TangentData, devices: Sequence[Devices]) -> None:
    """Warn of directions of the ball and joints that rows which tell no coordinates do not show."""
    if not data.shared.shape[2]:
        return
    whole = data.nominal.jacobian(data.x, data.theta)
    shares = data.jacobian.square().mean((0, 1)).sqrt() / whole.square().mean((0, 1)).sqrt().clamp(min=1e-9)
    by_ball = data.sensitivities[..., data.nominal.geometry.slices["tool"]].flatten(0, 1)
    tilt = torch.linalg.svdvals(without_shared(by_ball, data.shared.flatten(0, 1))) / data.coordinates**0.5
    for device in devices:
        for what, fix in device.open_sentences():
            warn_user(sentence(what, fix=fix))
    if float(tilt.min()) < gates.TILTED:
        what = "the tool is hardly tilted: where the ball is on it, along one direction, is not determined"
        warn_user(sentence(what, fix=TILT))
    names = data.nominal.geometry.chain.joint_names
    unseen = [name for name, share in zip(names, shares.tolist(), strict=True) if share < gates.UNSEEN]
    if unseen:
        what = f"the readings hardly change with {few(unseen)}: errors of such joints are not determined"
        warn_user(sentence(what, fix="add devices that see these joints turn"))


def without_shared(effects: Tensor, shared: Tensor) -> Tensor:
    """Effects (M, k) on numbers less what unknowns that rows share, with effects (M, c), do as well."""
    if not shared.shape[1]:
        return effects
    shared = shared / shared.norm(dim=0).clamp(min=1e-12)
    return effects - shared @ torch.linalg.lstsq(shared, effects, rcond=1e-6, driver="gelsd").solution
