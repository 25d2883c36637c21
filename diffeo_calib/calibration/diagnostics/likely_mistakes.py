"""Likely mistakes in measurements that do not fit a robot: each usual one is undone and the robot registered again.

The mistake whose correction explains the measurements far better is reported. All of them concern tables and
conventions. They are judged by the registration alone, whose few unknowns cannot compensate for them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, product
from math import pi

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.measurements.poses import mark_points
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.chain import Chain


@dataclass(frozen=True)
class MistakeLimits:
    """When a mistake counts as found.

    Args:
        remaining: largest part of the residual that may remain after its correction.
        decisive: part of the residual below which no other mistake is tried.
        rows: largest number of rows that are registered.
    """

    remaining: float = 0.2
    decisive: float = 0.02
    rows: int = 60


LIMITS = MistakeLimits()
RIGHT_ANGLES = ((pi / 2, "90"), (-pi / 2, "-90"), (pi, "180"))
"""Usual joint offsets of another convention [rad, deg]."""
NO_MISTAKE_FOUND = (
    "check the angle unit, the order of the joints, the tip link or DH convention, "
    "and that rows pair joints with their own points"
)


def likely_mistake(robot: Chain, data: Measurements, typical: float) -> str:
    """Advice on measurements that no registration explains.

    Args:
        robot: n joints. data: N rows. typical: median residual of the measurements as they are, m.

    Returns:
        a phrase: the mistake that explains them, if there is one, else what to check.
    """
    best, words = LIMITS.remaining * typical, NO_MISTAKE_FOUND
    for q, points, mistake in _corrections(robot, data):
        residual = _residual(robot, q, points)
        if residual < best:
            best, words = residual, mistake
        if best < LIMITS.decisive * typical:
            break
    return words


def _residual(robot: Chain, q: Tensor, points: Tensor) -> float:
    """Median distance after registration of a random subset of the rows, m; infinite if the rows are too few."""
    if len(q) < 2 * (2 + robot.n):
        return torch.inf
    rows = torch.randperm(len(q), generator=seeded(0), device=HOST)[: LIMITS.rows]
    geometry = register(robot, q[rows], points[rows]).geometry
    return float((geometry.points(q[rows]) - points[rows]).norm(dim=-1).median())


def _corrections(robot: Chain, data: Measurements) -> Iterator[tuple[Tensor, Tensor, str]]:
    """Configurations and points with one mistake undone, and the advice if that was the mistake."""
    q, points = data.q, data.points
    pair = "pair every configuration with its own"
    yield q[:-1], points[1:], f"the points seem to be one row too late: {pair}"
    yield q[1:], points[:-1], f"the points seem to be one row too early: {pair}"
    yield from _corrections_of_frames(data)
    yield from _corrections_of_joints(robot, data)


def _corrections_of_frames(data: Measurements) -> Iterator[tuple[Tensor, Tensor, str]]:
    if data.poses is None or data.lever is None:
        mirrored = torch.cat([data.points[..., :2], -data.points[..., 2:]], dim=-1)
        words = "the frame of the measurements seems to be left-handed: exchange two position columns, or change a sign"
        yield data.q, mirrored, words
        return
    words = "the positions alone fit: check the convention and the unit of the rotation columns"
    yield data.q, data.poses[:, None, :3, 3], words
    words = "the poses seem to be inverted: give those of the tool in the measuring frame"
    yield data.q, mark_points(torch.linalg.inv(data.poses), data.lever), words


def _corrections_of_joints(robot: Chain, data: Measurements) -> Iterator[tuple[Tensor, Tensor, str]]:
    names, turning = robot.joint_names, torch.tensor(robot.periodic, dtype=torch.bool, device=data.q.device)
    for factor, words in ((pi / 180, "degrees: convert them to radians"), (180 / pi, "radians that were converted")):
        q = torch.where(turning, factor * data.q, data.q)
        yield q, data.points, f"the joint values seem to be {words}; check the angle unit"
    for k, name in enumerate(names):
        q = data.q.clone()
        q[:, k] *= -1
        yield q, data.points, f"{name} seems to count the other way: change the sign of its column, or of its axis"
    for a, b in combinations(range(len(names)), 2):
        q = data.q.clone()
        q[:, [a, b]] = data.q[:, [b, a]]
        words = f"the columns of {names[a]} and {names[b]} seem to be exchanged: check the order of the joints"
        yield q, data.points, words
    # Last: half a turn of one joint may look like another one that counts the other way.
    for k, (offset, degrees) in product(range(len(names)), RIGHT_ANGLES):
        if robot.periodic[k]:
            q = data.q.clone()
            q[:, k] += offset
            words = f"{names[k]} seems to have another offset: its values fit with {degrees} degrees added"
            yield q, data.points, words
