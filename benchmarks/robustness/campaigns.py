"""Campaigns of the simulated arm that leave something open: a tool that never turns, joints that stand still, lines.

Each is a function (arm, count, generator) -> joint values (count, 6) in rad, all within the arm's limits. A campaign is
planned with the nominal robot, as a user would plan it.
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi, radians

import torch
from torch import Tensor

from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.robots.simulated_arm import SimulatedArm
from diffeo_calib.robots.tree import Chain

HOME = (0.2, 0.3, -0.7, 0.4, 0.9, -0.5)
"""Joint values of the pose around which small campaigns are planned, rad."""
TINY_RAD = radians(0.5)
STEPS = 50
"""Of the search for joint values."""
PLACED = 1e-9
"""Largest error of a planned pose, m and rad."""

Triple = tuple[float, float, float]
Campaign = Callable[[SimulatedArm, int, torch.Generator], Tensor]


def uniform(count: int, low: Tensor, high: Tensor, generator: torch.Generator) -> Tensor:
    """(count, k) uniform between bounds (k,)."""
    return low + (high - low) * torch.rand(count, len(low), dtype=torch.float64, generator=generator)


def joints(arm: SimulatedArm, count: int, generator: torch.Generator) -> Tensor:
    """(count, 6) uniform between the joint limits."""
    low, high = arm.nominal.limits.unbind(1)
    return uniform(count, low, high, generator)


def reached(chain: Chain, targets: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """Joint values (N, 6) of target poses (N, 4, 4) by damped Newton steps, and which rows were reached (N,)."""
    q = start.clone()
    low, high = chain.limits.unbind(1)
    for _ in range(STEPS):
        at = chain(q)
        error = torch.cat([targets[:, :3, 3] - at[:, :3, 3], _turn(targets[:, :3, :3] @ at[:, :3, :3].mT)], 1)
        J = chain.jacobian(q)
        eye = 1e-8 * torch.eye(6, dtype=q.dtype)
        step = (J.mT @ torch.linalg.solve(J @ J.mT + eye, error[..., None]))[..., 0]
        q = (q + step.clamp(-0.2, 0.2)).clamp(low, high)
    return q, error.abs().amax(1) < PLACED


def _turn(R: Tensor) -> Tensor:
    """Rotation vectors (N, 3) of small rotations, twice the sine for large ones."""
    skewed = 0.5 * (R - R.mT)
    return torch.stack([skewed[:, 2, 1], skewed[:, 0, 2], skewed[:, 1, 0]], 1)


def planned(arm: SimulatedArm, count: int, generator: torch.Generator, size: Triple, turn: Triple) -> Tensor:
    """Poses in a box of a size [m] around home, each turned by up to ``turn`` [rad] about the axes of the base."""
    home = arm.nominal(torch.tensor([HOME], dtype=torch.float64))[0]
    half, found = 0.5 * torch.tensor(size, dtype=torch.float64), []
    while sum(map(len, found)) < count:
        shifts = uniform(2 * count, -half, half, generator)
        turns = uniform(2 * count, -torch.tensor(turn), torch.tensor(turn), generator)
        targets = transforms(rotation(turns) @ home[:3, :3], home[:3, 3] + shifts)
        q, good = reached(arm.nominal, targets, torch.tensor(HOME, dtype=torch.float64).expand(2 * count, 6))
        found.append(q[good])
    return torch.cat(found)[:count]


def held(*which: int) -> Campaign:
    """Joints that never move."""

    def campaign(arm: SimulatedArm, count: int, generator: torch.Generator) -> Tensor:
        q = joints(arm, count, generator)
        q[:, list(which)] = torch.tensor(HOME, dtype=torch.float64)[list(which)]
        return q

    return campaign


def box(size: Triple, turn: float, *, upright: bool = False) -> Campaign:
    """See :func:`planned`; turned by up to ``turn`` [rad] about all axes, or the vertical one alone."""
    turns = (0.0, 0.0, turn) if upright else (turn, turn, turn)
    return lambda arm, count, generator: planned(arm, count, generator, size, turns)


def tiny(arm: SimulatedArm, count: int, generator: torch.Generator) -> Tensor:
    """Every joint within one degree."""
    home = torch.tensor(HOME, dtype=torch.float64)
    return uniform(count, home - TINY_RAD, home + TINY_RAD, generator)


def one_at_a_time(arm: SimulatedArm, count: int, generator: torch.Generator) -> Tensor:
    """From home one joint moves, then the next."""
    every = joints(arm, count, generator)
    q = torch.tensor(HOME, dtype=torch.float64).repeat(count, 1)
    rows = torch.arange(count)
    q[rows, rows % 6] = every[rows, rows % 6]
    return q


def repeats(arm: SimulatedArm, count: int, generator: torch.Generator) -> Tensor:
    """Five configurations, again and again."""
    return joints(arm, 5, generator)[torch.arange(count) % 5]


def two_clusters(arm: SimulatedArm, count: int, generator: torch.Generator) -> Tensor:
    """Two configurations, with five degrees around each."""
    centres = torch.tensor([HOME, (-1.2, 1.0, -1.6, -1.0, -0.8, 2.0)], dtype=torch.float64)
    spread = uniform(count, torch.full((6,), -radians(5)), torch.full((6,), radians(5)), generator)
    return centres[torch.arange(count) % 2] + spread


def elbow_up(arm: SimulatedArm, count: int, generator: torch.Generator) -> Tensor:
    """The elbow bent one way, the wrist too."""
    q = joints(arm, count, generator)
    low, high = arm.nominal.limits.unbind(1)
    q[:, 2] = low[2] + (q[:, 2] - low[2]) * (-0.3 - low[2]) / (high[2] - low[2])
    q[:, 4] = 0.3 + (q[:, 4] - low[4]) * (high[4] - 0.3) / (high[4] - low[4])
    return q


def half_turn(arm: SimulatedArm, count: int, generator: torch.Generator) -> Tensor:
    """Every joint in the middle quarter of its range."""
    q, middle = joints(arm, count, generator), arm.nominal.limits.mean(1)
    return middle + 0.25 * (q - middle)


CAMPAIGNS: dict[str, Campaign] = {
    "everywhere": joints,
    "tool never turned": box((0.4, 0.4, 0.3), 0.0),
    "tool turned by 0.3 degrees": box((0.4, 0.4, 0.3), radians(0.3)),
    "tool turned by 3 degrees": box((0.4, 0.4, 0.3), radians(3.0)),
    "wrist locked": held(3, 4, 5),
    "last joint locked": held(5),
    "first joint locked": held(0),
    "two joints move": held(0, 1, 4, 5),
    "one joint moves": held(0, 1, 2, 4, 5),
    "tiny ranges": tiny,
    "tool turned about the vertical": box((0.4, 0.4, 0.3), pi / 6, upright=True),
    "plane": box((0.4, 0.4, 0.0), pi / 6, upright=True),
    "plane, tool never turned": box((0.4, 0.4, 0.0), 0.0),
    "line, tool never turned": box((0.4, 0.0, 0.0), 0.0),
    "line": box((0.4, 0.0, 0.0), pi / 6),
    "small cube": box((0.05, 0.05, 0.05), radians(20.0)),
    "small cube, tool never turned": box((0.05, 0.05, 0.05), 0.0),
    "one joint at a time": one_at_a_time,
    "five poses repeated": repeats,
    "two clusters": two_clusters,
    "elbow up": elbow_up,
    "a quarter of every range": half_turn,
}
"""What the robot does -> its configurations. The first one is honest."""
