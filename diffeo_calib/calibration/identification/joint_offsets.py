"""Joint offsets that are far from a robot's description: tens of degrees, where geometric errors are milliradians.

An encoder was mounted at another angle, a homing switch was moved, or the robot was not mastered. The prior of a
geometric calibration excludes such offsets. They are therefore estimated before it, together with base and markers, as
one constant per joint, by robust least squares.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.threads import torch_alone
from diffeo_calib.robots.geometry import Geometry

OFFSET_STD = 0.5
"""Prior standard deviation of a joint offset, rad or m; it only chooses among offsets that poses cannot separate."""
INLIER_ERROR = 0.1
"""Error of a coordinate, relative to the median distance, beyond which Huber's loss grows linearly."""
MAX_EVALUATIONS = 100


def find_joint_offsets(geometry: Geometry, q: Tensor, points: Tensor) -> Tensor:
    """Offsets to add to the joint values so that base and markers explain the points best.

    Args:
        geometry: a registered robot. q: (N, n) joint values [rad or m]. points: (N, P, 3) [m].

    Returns:
        (n,) [rad or m]; zero where base or markers could explain the same change.
    """
    from scipy.optimize import least_squares  # noqa: PLC0415  # slow to import, not needed to use a model

    n, parts = q.shape[1], geometry.slices
    places = [*range(*parts["base"].indices(geometry.size)), *range(*parts["tool"].indices(geometry.size))]
    free = torch.tensor(places, device=q.device)
    typical = float((geometry.points(q) - points).norm(dim=-1).median())

    def at(u: np.ndarray) -> tuple[Tensor, Tensor]:
        values = torch.from_numpy(u)
        theta = torch.zeros(geometry.size, dtype=q.dtype, device=q.device).index_copy(0, free, values[n:])
        return q + values[:n], theta

    def residual(u: np.ndarray) -> np.ndarray:
        error = ((geometry.points(*at(u)) - points) / typical).flatten().numpy()
        return np.concatenate([error, u[:n] / OFFSET_STD])

    def slopes(u: np.ndarray) -> np.ndarray:
        by_joint, by_place = geometry.jacobian(*at(u)), geometry.sensitivities(*at(u))[..., free]
        rows = torch.cat([by_joint, by_place], -1).flatten(0, 2) / typical
        return np.concatenate([rows.numpy(), np.eye(n, len(u)) / OFFSET_STD])

    start = np.zeros(n + len(free))
    # Huber's loss on every coordinate: a few gross outliers have little influence.
    options = {"loss": "huber", "f_scale": INLIER_ERROR, "x_scale": "jac", "max_nfev": MAX_EVALUATIONS}
    with torch_alone():
        found = least_squares(residual, start, slopes, **options)  # pyright: ignore[reportArgumentType]
    return torch.from_numpy(found.x[:n])


def with_joint_offsets(geometry: Geometry, offsets: Tensor) -> Geometry:
    """The geometry with other joint offsets (n,): its points at q are those of the given geometry at q + offsets."""
    chain = geometry.chain
    amounts = chain.coupling.to(offsets) @ offsets  # of all moving joints, mimic joints included
    motion = amounts[:, None] * chain.axes
    turning = chain.revolute[:, None]
    twists = torch.cat([torch.where(turning, 0.0, motion), torch.where(turning, motion, 0.0)], 1)  # (n_all, 6)
    theta = torch.zeros(geometry.size, dtype=twists.dtype, device=twists.device)
    theta[geometry.slices["joints"]] = twists.flatten()
    return geometry.absorb(theta)
