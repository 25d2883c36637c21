"""Machines with commanded poses or places: these numbers take the place of joint values.

The nominal kinematics are the identity, k0(p) = p, written as a chain: three slides along x, y and z, a constant
rotation M, and turns about z, y and x,

    pose(p) = T(x, y, z) M R_z(a) R_y(b) R_x(c).

M is the middle of the poses, or turned so that b stays far from +-90 degrees, where a and c are not distinct.
"""

from __future__ import annotations

from math import asin, degrees, pi

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.se3 import nearest_rotations, rigid_poses, transforms
from diffeo_calib.robots.tree import Chain, Tree

SLIDES, TURNS = ("pose_x", "pose_y", "pose_z"), ("pose_a", "pose_b", "pose_c")
PLACES = SLIDES[:1], SLIDES[:2], SLIDES  # names of the joints; and those of places
BEYOND, LEAST_BEYOND, LEAST_BEYOND_RAD = 0.25, 0.01, 0.35
"""Limits lie beyond the poses by this share of their range; of slides at least by a share of the largest range, so that
one that stood still can be corrected; of turns at least by so much."""
FLAT, STEEPEST = 0.8, 0.97  # sine of the largest b about the mean of the poses, and about any middle
DIRECTIONS = 2000  # of the z-axis of M that are tried


def cartesian(poses: object) -> Chain:
    """A machine whose input is a commanded pose, or a commanded place.

    Args:
        poses: (N, 4, 4) rigid transforms, or (N, k) places of k = 1, 2 or 3 coordinates, m: those of the rows that will
            calibrate it, from which its limits follow.

    Returns:
        a chain from "base" to "flange" with k or 6 joints, whose values are those of :func:`pose_inputs`.

    Raises:
        InputError: wrong shape, no rigid transforms, or orientations that reach too far from their middle.
    """
    given = _checked(poses)
    if given.ndim == 2:
        return _chain(given)
    middle = _middle(given[:, :3, :3])
    return _chain(pose_inputs(_chain(given[:, :3, 3], middle), given), middle)


def is_cartesian(robot: Tree) -> bool:
    """Whether the inputs of a robot are numbers of poses."""
    return robot.joint_names in (*PLACES, (*SLIDES, *TURNS))


def turns_nowhere(robot: Tree) -> bool:
    """Whether commands are places: no row tells a marker's place on the machine from that of the base."""
    return robot.joint_names in PLACES


def pose_inputs(robot: Tree, poses: object) -> Tensor:
    """The joint values (N, k) [m, rad] of poses (N, 4, 4), or of places (N, k), m; the robot leads back to the poses.

    Raises:
        RobotError: a robot that is not one of :func:`cartesian`.
        InputError: poses of another kind than those of the robot, or farther from their middle than it can tell.
    """
    if not is_cartesian(robot):
        raise RobotError.of(f"robot '{robot.name}'", expected="a machine with commanded poses, see dc.cartesian")
    given = _checked(poses)
    if (given.ndim == 3) != (robot.n == 6) or (given.ndim == 2 and given.shape[1] != robot.n):
        expected = "(N, 4, 4)" if robot.n == 6 else f"(N, {robot.n})"
        raise InputError.of("`poses`", expected=expected, got=str(tuple(given.shape)))
    if given.ndim == 2:
        return given
    middle = next(joint.origin[:3, :3] for joint in robot.joints if joint.name == TURNS[0]).to(given.device)
    R = middle.mT @ given[:, :3, :3]
    steep = R[:, 2, 0].abs()
    if bool((steep > STEEPEST).any()):
        row, largest = int(steep.argmax()), degrees(asin(STEEPEST))
        expected = f"orientations that turn by less than {largest:.0f} degrees about y from the middle of all"
        got = f"{degrees(asin(min(float(steep.max()), 1.0))):.0f}"
        fix = "calibrate the rows in groups of like orientations, or by joint values and the robot's description"
        raise InputError.of(f"`poses`, row {row}", expected=expected, got=got, fix=fix)
    turns = torch.atan2(R[:, 1, 0], R[:, 0, 0]), torch.asin(-R[:, 2, 0]), torch.atan2(R[:, 2, 1], R[:, 2, 2])
    return torch.cat([given[:, :3, 3], torch.stack(turns, 1)], 1)


def _middle(R: Tensor) -> Tensor:
    """M (3, 3) of rotations (N, 3, 3): their mean; of widely spread ones a frame whose z is far from all their x."""
    mean, x = nearest_rotations(R.mean(0)), R[:, :, 0]
    if float((x @ mean[:, 2]).abs().max()) < FLAT:
        return mean
    draws = torch.randn(DIRECTIONS, 3, generator=seeded(0), dtype=torch.float64, device=HOST)
    ways = torch.nn.functional.normalize(draws, dim=1).to(R)
    z = ways[(x @ ways.mT).abs().amax(0).argmin()]
    side = torch.nn.functional.normalize(torch.linalg.cross(z, mean[:, (mean.mT @ z).abs().argmin()], dim=0), dim=0)
    return torch.stack([torch.linalg.cross(side, z, dim=0), side, z], 1)


def _checked(poses: object) -> Tensor:
    """Poses (N, 4, 4) with exact rotations, or places."""
    also = [("N", 1), ("N", 2), ("N", 3)]
    given = as_tensor(poses, "poses", ("N", 4, 4), also=also, fix="pass one transform, or one place, per row")
    return given if given.ndim == 2 else rigid_poses(given)


def _chain(inputs: Tensor, middle: Tensor | None = None) -> Chain:
    """The machine whose inputs have the range of these (N, k); with turns about a middle (3, 3) if there is one."""
    inputs, eye = inputs.detach().cpu(), torch.eye(4, dtype=torch.float64, device="cpu")
    low, high = inputs.amin(0), inputs.amax(0)
    beyond = BEYOND * (high - low)
    beyond[:3] = beyond[:3].clamp(min=LEAST_BEYOND * float((high - low)[:3].max()))
    beyond[3:] = beyond[3:].clamp(min=LEAST_BEYOND_RAD)
    ends = list(zip((low - beyond).tolist(), (high + beyond).tolist(), strict=True))
    slides = zip(SLIDES, eye[:3, :3], ends, strict=False)
    joints = [Joint(name, "prismatic", eye, axis, *limits) for name, axis, limits in slides]
    if middle is not None:
        origins = [transforms(middle.detach().cpu(), eye.new_zeros(3)), eye, eye]
        limits = [(max(least, -pi), min(most, pi)) for least, most in ends[3:]] or [(-pi, pi)] * 3
        turns = zip(TURNS, origins, eye[:3, :3].flip(0), limits, strict=True)
        joints += [Joint(name, "revolute", origin, axis, *bounds) for name, origin, axis, bounds in turns]
    return Chain("machine", "base", "flange", joints)
