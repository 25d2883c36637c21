"""Simulated rows of an arm whose ball rests in the sockets of a block that stands at several places.

The true ball of a :class:`SimulatedArm` is brought to each socket by Newton steps on its true kinematics, from random
configurations with the tool turned and tilted; the ball then misses the socket's middle by the repeatability.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, radians

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import check_count, check_number
from diffeo_calib.common.errors import NumericalError
from diffeo_calib.robots.simulated_arm import SimulatedArm

SPACING = 0.05
"""Between the two sockets of a block [m]."""
RADII, HEIGHTS, SIDE = (0.4, 0.8), (0.0, 0.5), 2.0
"""Places of the block: distance from the robot's axis and height [m], angle to either side [rad]."""
STEPS = 40
REACHED = 1e-10
"""Largest miss after the Newton steps [m]."""
DRAWS = 400
"""Random configurations for every row that is wanted."""
FEWEST = 20
"""Fewer rows are drawn from as many configurations as these."""
TRIED = 5
"""Of those near a socket with a tilt that is allowed, so many are brought to it for every row that is wanted."""


@dataclass(frozen=True, eq=False)
class SocketRows:
    """Rows in sockets, and the truth about them.

    Args:
        q: (N, n) joint values, rad. names: of the socket of every row. positions: the sockets by name, (3,) in the
            robot's base, m.
    """

    q: Tensor
    names: tuple[str, ...]
    positions: dict[str, Tensor]


def rest_in_sockets(
    arm: SimulatedArm,
    seed: int = 0,
    *,
    places: int = 6,
    rows: int = 20,
    repeatability: float = 2e-5,
    tilt: float = 60.0,
) -> SocketRows:
    """Rows of an arm in a block with two sockets, 50 mm apart, at several places.

    Args:
        arm: with one marker, the ball. seed: draws places, configurations and errors.
        places: number of places. rows: of each socket.
        repeatability: standard deviation of a coordinate of the ball in its socket, m.
        tilt: largest angle of the tool's axis from straight down, degrees.

    Raises:
        NumericalError: a socket that cannot be reached often enough.
    """
    check_count(places, "`places`")
    check_count(rows, "`rows`")
    check_number(repeatability, "`repeatability`", above=-1e-300)
    rng, found, names = np.random.default_rng([seed, 6]), [], []
    positions: dict[str, Tensor] = {}
    starts = _tilted(arm, arm.sample(DRAWS * max(rows, FEWEST), seed), tilt)
    for place in range(places):
        middle, along = _place(rng)
        for number in range(2):
            name, target = f"{place}/{number}", middle + (number - 0.5) * SPACING * along
            near = (arm.nominal(starts)[:, :3, 3] - target).norm(dim=1).argsort()[: len(starts) // 3]
            near = near[torch.from_numpy(rng.permutation(len(near)))][: TRIED * max(rows, FEWEST)]
            ball = target + repeatability * torch.from_numpy(rng.standard_normal((len(near), 3)))
            q = _reached(arm, starts[near], ball, tilt)[:rows]
            if len(q) < rows:
                what = f"socket {name} at {[round(value, 3) for value in target.tolist()]} m"
                raise NumericalError.of(what, expected=f"{rows} configurations that reach it", got=len(q))
            found.append(q)
            names += [name] * rows
            positions[name] = target
    return SocketRows(torch.cat(found), tuple(names), positions)


def _place(rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Middle of the block and direction from its first to its second socket, (3,) each, in the robot's base."""
    angle, radius, height, turn = (
        rng.uniform(-SIDE, SIDE),
        rng.uniform(*RADII),
        rng.uniform(*HEIGHTS),
        rng.uniform(0, pi),
    )
    middle = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
    return torch.from_numpy(middle), torch.from_numpy(np.array([np.cos(turn), np.sin(turn), 0.0]))


def _tilted(arm: SimulatedArm, q: Tensor, tilt: float) -> Tensor:
    """The configurations whose tool points down, but for a tilt."""
    return q[-arm.nominal(q)[:, 2, 2] > cos(radians(tilt))]


def _reached(arm: SimulatedArm, q: Tensor, ball: Tensor, tilt: float) -> Tensor:
    """Configurations near q (M, n) that bring the ball to points (M, 3) in the robot's base, if they can."""
    R, t = arm.truth.base[:3, :3], arm.truth.base[:3, 3]
    target = ball @ R.mT + t
    low, high = arm.nominal.limits.unbind(1)
    for _ in range(STEPS):
        miss = target - arm.true_points(q)[:, 0]
        if float(miss.norm(dim=1).quantile(0.8)) < REACHED:
            break
        step = (torch.linalg.pinv(arm.truth.jacobian(q)[:, 0]) @ miss[..., None])[..., 0]
        q = q + step * (0.3 / step.abs().amax(1, keepdim=True).clamp(min=0.3))
    miss = (target - arm.true_points(q)[:, 0]).norm(dim=1)
    return _tilted(arm, q[(miss < REACHED) & ((q > low) & (q < high)).all(1)], tilt)
