"""What a configuration must respect: the view of the measuring device, a floor, a column, the user's own check.

A criterion takes configurations (N, n) and says which are allowed (N,). Links are straight lines from one joint's
origin to the next, and on to the tip and the markers: leave room for the links' thickness in floors and columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import cos, pi
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, check_number
from diffeo_calib.common.errors import InputError
from diffeo_calib.robots.tree import Tree

POINTS_PER_LINK = 8
"""Points of each link that are checked: 8 cm apart on a link of 0.6 m."""

Criterion = Callable[[Tensor], Any]
"""Configurations (N, n) -> (N,) boolean, whether each is allowed."""


@dataclass(frozen=True)
class Tracker:
    """A measuring device and the reflector that it has to see. Everything in m and rad.

    Args:
        position: (3,) of the device, in the robot's base frame.
        marker: (3,) place of the reflector, in the tip's frame.
        direction: (3,) in which the reflector looks, in the tip's frame, of any length.
        half_angle: largest angle between that direction and the line to the device.

    Raises:
        InputError: wrong shapes, a direction without length, an angle outside (0, pi].
    """

    position: Sequence[float]
    marker: Sequence[float] = (0.0, 0.0, 0.0)
    direction: Sequence[float] = (0.0, 0.0, 1.0)
    half_angle: float = pi / 4

    def __post_init__(self) -> None:
        for name in ("position", "marker", "direction"):
            as_tensor(getattr(self, name), f"{name} of the tracker", (3,))
        if not float(as_tensor(self.direction, "direction of the tracker", (3,)).norm()) > 0:
            raise InputError.of("`direction` of the tracker", expected="a vector other than zero", got="(0, 0, 0)")
        check_number(self.half_angle, "`half_angle` of the tracker, in rad", above=0.0, below=pi + 1e-9)

    def sees(self, robot: Tree) -> Criterion:
        """Whether the reflector looks at the device."""
        parts = (self.position, self.marker, self.direction)
        position, marker, direction = (as_tensor(part, "tracker", (3,)) for part in parts)

        def criterion(q: Tensor) -> Tensor:
            tip = robot(q)
            line = position - (tip[:, :3, :3] @ marker + tip[:, :3, 3])
            along = (line * (tip[:, :3, :3] @ direction)).sum(1)
            return along >= cos(self.half_angle) * line.norm(dim=1) * direction.norm()

        return criterion


def above_floor(robot: Tree, height: float, points: Tensor) -> Criterion:
    """Whether all moving points are above a height in the robot's base frame, m.

    Args:
        robot: the chain. height: of the floor. points: (P, 3) on the tool, in the tip's frame, m.
    """
    return lambda q: (_links(robot, q, points)[..., 2] >= height).all(1)


def outside_column(robot: Tree, column: Sequence[float], points: Tensor) -> Criterion:
    """Whether all moving points are outside an upright cylinder.

    Args:
        robot: the chain. column: x, y and radius, and the height of its top if it ends, in the robot's base frame, m.
        points: (P, 3) on the tool, in the tip's frame, m.
    """
    x, y, radius, *top = column

    def criterion(q: Tensor) -> Tensor:
        places = _links(robot, q, points)
        inside = (places[..., 0] - x).square() + (places[..., 1] - y).square() < radius**2
        return ~(inside & (places[..., 2] < top[0]) if top else inside).any(1)

    return criterion


def check_column(column: object) -> list[float]:
    """x, y, radius and perhaps the top of a column.

    Raises:
        InputError: other numbers.
    """
    numbers = as_tensor(column, "column", (3,), also=((4,),), fix="pass x, y, radius and perhaps the top, in m")
    if not float(numbers[2]) > 0:
        raise InputError.of("the radius of `column`", expected="a positive number of m", got=float(numbers[2]))
    return numbers.tolist()


def _links(robot: Tree, q: Tensor, points: Tensor) -> Tensor:
    """Points on everything that moves: from the first joint's origin, which stays, along all links to the tool.

    Returns:
        (N, K, 3) in the robot's base frame, m, the first joint's origin left out.
    """
    frames, tip = robot.frames(q)
    corners = torch.cat([frames[..., :3, 3], tip[:, None, :3, 3]], 1)  # (N, n_all + 1, 3)
    tool = points @ tip[:, :3, :3].mT + tip[:, None, :3, 3]  # (N, P, 3)
    starts = torch.cat([corners[:, :-1], corners[:, -1:].expand_as(tool)], 1)
    ends = torch.cat([corners[:, 1:], tool], 1)
    share = torch.arange(1, POINTS_PER_LINK + 1, dtype=q.dtype, device=q.device)[:, None] / POINTS_PER_LINK
    return (starts[:, :, None] + share * (ends - starts)[:, :, None]).flatten(1, 2)
