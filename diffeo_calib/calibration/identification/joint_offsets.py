"""Zeros of joints that are far from a robot's description: tens of degrees, where geometric errors are milliradians.

Encoders are mounted, homing switches moved and mastering is forgotten. The prior of a geometric calibration does not
expect that, so that it is looked for first: base, markers and one constant per joint, by robust least squares.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.threads import torch_alone
from diffeo_calib.robots.geometry import Geometry

USUAL = 0.5
"""Standard deviation of a zero, rad or m; it only decides between joints that the poses cannot tell apart."""


def find_zeros(geometry: Geometry, q: Tensor, points: Tensor) -> Tensor:
    """What has to be added to the joint values so that base and markers explain the points best.

    Args:
        geometry: a registered robot. q: (N, n) joint values [rad or m]. points: (N, P, 3) [m].

    Returns:
        (n,) [rad or m]; zero where base or markers could carry it as well.
    """
    from scipy.optimize import least_squares  # noqa: PLC0415  # slow to import, not needed to use a model

    n, parts = q.shape[1], geometry.slices
    free = torch.tensor([*range(*parts["base"].indices(geometry.size)), *range(*parts["tool"].indices(geometry.size))])
    typical = float((geometry.points(q) - points).norm(dim=-1).median())

    def at(u: np.ndarray) -> tuple[Tensor, Tensor]:
        values = torch.from_numpy(u)
        theta = torch.zeros(geometry.size, dtype=torch.float64).index_copy(0, free, values[n:])
        return q + values[:n], theta

    def residual(u: np.ndarray) -> np.ndarray:
        error = ((geometry.points(*at(u)) - points) / typical).flatten().numpy()
        return np.concatenate([error, u[:n] / USUAL])

    def slopes(u: np.ndarray) -> np.ndarray:
        by_joint, by_place = geometry.jacobian(*at(u)), geometry.sensitivities(*at(u))[..., free]
        rows = torch.cat([by_joint, by_place], -1).flatten(0, 2) / typical
        return np.concatenate([rows.numpy(), np.eye(n, len(u)) / USUAL])

    start = np.zeros(n + len(free))
    # Huber's loss on every coordinate: a few gross rows do not decide.
    with torch_alone():
        found = least_squares(residual, start, slopes, loss="huber", f_scale=0.1, x_scale="jac", max_nfev=100)  # pyright: ignore[reportArgumentType]
    return torch.from_numpy(found.x[:n])


def with_zeros(geometry: Geometry, zeros: Tensor) -> Geometry:
    """The geometry whose joints count from elsewhere: its points at q are the other's at q + zeros (n,)."""
    chain = geometry.chain
    amounts = chain.coupling.to(zeros) @ zeros  # of all moving joints, passive ones too
    motion = amounts[:, None] * chain.axes
    turning = chain.revolute[:, None]
    twists = torch.cat([torch.where(turning, 0.0, motion), torch.where(turning, motion, 0.0)], 1)  # (n_all, 6)
    theta = torch.zeros(geometry.size, dtype=torch.float64)
    theta[geometry.slices["joints"]] = twists.flatten()
    return geometry.absorb(theta)
