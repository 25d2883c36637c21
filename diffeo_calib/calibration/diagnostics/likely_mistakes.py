"""What may be wrong with measurements that do not fit a robot: the usual mistakes, tried one by one.

Each is undone and the robot registered again; the one that explains by far the most is told. All of them are slips of
tables and conventions, so that they are looked for in the registration, where nothing else can hide them.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product
from math import pi

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.measurements.poses import mark_points
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.chain import Chain

EXPLAINS = 0.2
"""Part of the present residual that a mistake, once undone, may leave to count as the likely one."""
CONVINCES = 0.02
"""Part from which no other mistake is looked for."""
ROWS = 60
"""Rows that are looked at, at most."""
QUARTERS = ((pi / 2, "90"), (-pi / 2, "-90"), (pi, "180"))
"""Zeros of joints are elsewhere by right angles, in general [rad, deg]."""
ANYTHING = (
    "check the angle unit, the order of the joints, the tip link or DH convention, "
    "and that rows pair joints with their own points"
)


def likely_mistake(robot: Chain, data: Measurements, typical: float) -> str:
    """What to do about measurements of which a typical row is so far from any registration.

    Args:
        robot: n joints. data: N rows. typical: median distance that is left as they are, m.

    Returns:
        a phrase: the mistake that explains them, if there is one, else what to check.
    """
    best, words = EXPLAINS * typical, ANYTHING
    for q, points, mistake in _mistakes(robot, data):
        left = _left(robot, q, points)
        if left < best:
            best, words = left, mistake
        if best < CONVINCES * typical:
            break
    return words


def _left(robot: Chain, q: Tensor, points: Tensor) -> float:
    """Median distance after registration of some of the rows, m; infinite where they are too few to tell."""
    if len(q) < 2 * (2 + robot.n):
        return torch.inf
    rows = torch.randperm(len(q), generator=torch.Generator().manual_seed(0))[:ROWS]
    geometry = register(robot, q[rows], points[rows]).geometry
    return float((geometry.points(q[rows]) - points[rows]).norm(dim=-1).median())


def _mistakes(robot: Chain, data: Measurements) -> Iterator[tuple[Tensor, Tensor, str]]:
    """Configurations and points without a certain mistake, and what to do if that was it."""
    q, points = data.q, data.points
    pair = "pair every configuration with its own"
    yield q[:-1], points[1:], f"the points seem to be one row too late: {pair}"
    yield q[1:], points[:-1], f"the points seem to be one row too early: {pair}"
    yield from _mistakes_of_frames(data)
    yield from _mistakes_of_joints(robot, data)


def _mistakes_of_frames(data: Measurements) -> Iterator[tuple[Tensor, Tensor, str]]:
    if data.poses is None or data.lever is None:
        mirrored = data.points * torch.tensor([1.0, 1.0, -1.0], dtype=data.points.dtype)
        words = "the frame of the measurements seems to be left-handed: exchange two position columns, or change a sign"
        yield data.q, mirrored, words
        return
    words = "the positions alone fit: check the convention and the unit of the rotation columns"
    yield data.q, data.poses[:, None, :3, 3], words
    words = "the poses seem to be inverted: give those of the tool in the measuring frame"
    yield data.q, mark_points(torch.linalg.inv(data.poses), data.lever), words


def _mistakes_of_joints(robot: Chain, data: Measurements) -> Iterator[tuple[Tensor, Tensor, str]]:
    names, turning = robot.joint_names, torch.tensor(robot.periodic)
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
    for k, (shift, degrees) in product(range(len(names)), QUARTERS):
        if turning[k]:
            q = data.q.clone()
            q[:, k] += shift
            yield q, data.points, f"the zero of {names[k]} seems to be elsewhere: {degrees} degrees added to it fit"
