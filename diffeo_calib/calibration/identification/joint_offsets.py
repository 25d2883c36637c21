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
        geometry: a registered robot. q: (N, n) joint values [rad or m]. points: (N, P, 3) [m]; NaN where hidden.

    Returns:
        (n,) [rad or m]; zero where base or markers could explain the same change.
    """
    from scipy.optimize import least_squares  # noqa: PLC0415  # slow to import, not needed to use a model

    n, places = q.shape[1], OffsetsAndPlaces(geometry, q, points)
    typical = float((geometry.points(q) - points).norm(dim=-1).nanmedian())

    def residual(u: np.ndarray) -> np.ndarray:
        return np.concatenate([places.errors(u) / typical, u[:n] / OFFSET_STD])

    def slopes(u: np.ndarray) -> np.ndarray:
        return np.concatenate([places.slopes(u) / typical, np.eye(n, len(u)) / OFFSET_STD])

    start = np.zeros(places.size)
    # Huber's loss on every coordinate: a few gross outliers have little influence.
    options = {"loss": "huber", "f_scale": INLIER_ERROR, "x_scale": "jac", "max_nfev": MAX_EVALUATIONS}
    with torch_alone():
        found = least_squares(residual, start, slopes, **options)  # pyright: ignore[reportArgumentType]
    return torch.from_numpy(found.x[:n])


class OffsetsAndPlaces:
    """Errors of points as functions of joint offsets, the base's twist and the markers' shifts.

    The unknowns are the n offsets [rad or m], then the 6 of the base [m, rad], then the 3 P of the markers [m].

    Args:
        geometry: at zero of all unknowns. q: (N, n). points: (N, P, 3) m; where they are hidden (NaN) errors are zero.
    """

    def __init__(self, geometry: Geometry, q: Tensor, points: Tensor) -> None:
        self.geometry, self.q, self.points, parts = geometry, q, points, geometry.slices
        places = [*range(*parts["base"].indices(geometry.size)), *range(*parts["tool"].indices(geometry.size))]
        self.places = torch.tensor(places, dtype=torch.int64, device=q.device)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.q.shape[1] + len(self.places)

    def errors(self, u: np.ndarray) -> np.ndarray:
        """Of every coordinate: (3 N P,) m."""
        return (self.geometry.points(*self._at(u)) - self.points).nan_to_num(0.0).flatten().numpy()

    def slopes(self, u: np.ndarray) -> np.ndarray:
        """Derivatives of the errors: (3 N P, size)."""
        at = self._at(u)
        by_place = self.geometry.sensitivities(*at)[..., self.places]
        every = torch.cat([self.geometry.jacobian(*at), by_place], -1)
        return every.masked_fill(self.points.isnan()[..., None], 0.0).flatten(0, 2).numpy()

    def _at(self, u: np.ndarray) -> tuple[Tensor, Tensor]:
        values, n = torch.from_numpy(u), self.q.shape[1]
        zero = torch.zeros(self.geometry.size, dtype=self.q.dtype, device=self.q.device)
        return self.q + values[:n], zero.index_copy(0, self.places, values[n:])


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
