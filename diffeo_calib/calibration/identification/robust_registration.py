"""Registration that survives gross outliers, and joint offsets that are far from the robot's description.

Such offsets are tens of degrees, where geometric errors are milliradians: an encoder was mounted at another angle, a
homing switch was moved, or the robot was not mastered. The prior of a geometric calibration excludes them. They are
therefore estimated before it, together with base and markers, as one constant per joint, by robust least squares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.identification.registration import can_register, register
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import sentence, warn_user
from diffeo_calib.common.hidden_values import largest_known
from diffeo_calib.common.threads import torch_alone
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import marker_tips

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


@dataclass(frozen=True)
class RegistrationLimits:
    """Which rows take part in a registration, and when joint offsets are estimated with it.

    A residual is a median distance; "relative" means relative to the spread of the markers.

    Args:
        gross_distances: number of median distances from which a row is a gross outlier and does not take part.
        rounds: largest number of registrations of the rows that take part.
        draws: number of registrations of random rows that are tried if there may be many gross outliers.
        surplus: size of these draws, as a multiple of the rows that are needed. With 30 % outliers all of six rows
            are inliers with probability 0.12, so that 50 draws are enough.
        consistent_residual: relative residual with which rows without gross outliers need no draws.
        examined_residual: relative residual from which joint offsets are estimated.
        remaining: largest part of the residual that may remain with offsets that are accepted.
        accepted_residual: largest relative residual that may remain with them.
        largest_offset_rad: largest offset of a turning joint that is accepted.
        reported: smallest offset that is reported, as a part of the largest.
    """

    gross_distances: float = 10.0
    rounds: int = 5
    draws: int = 50
    surplus: int = 2
    consistent_residual: float = 0.02
    examined_residual: float = 0.01
    remaining: float = 0.3
    accepted_residual: float = 0.02
    largest_offset_rad: float = 0.8
    reported: float = 0.2


LIMITS = RegistrationLimits()


def register_robustly(robot: Tree, data: Measurements) -> Identification:
    """Base and markers from the rows that are no gross outliers; joint offsets too if they explain far more.

    Warns:
        DiffeoCalibWarning: joint offsets are far from the robot's description.
    """
    return with_large_offsets(data, *register_inliers(robot, data))


def register_inliers(robot: Tree, data: Measurements) -> tuple[Identification, Tensor]:
    """Base and markers from the rows that are no gross outliers, and a first guess (N,) of these rows."""
    on = marker_tips(robot, data)
    inliers = _inliers(robot, data, on)
    return _registered(robot, data, inliers, on), inliers


def with_large_offsets(data: Measurements, registration: Identification, inliers: Tensor) -> Identification:
    """The registration, with joint offsets if these explain far more; then with a warning."""
    if float(distances(registration.geometry, data).nanmedian()) > LIMITS.examined_residual * spread(data.points):
        return _with_offsets(registration, data, inliers)
    return registration


def distances(geometry: Geometry, data: Measurements) -> Tensor:
    """From predicted to measured markers, (N, P) in m; NaN where they are hidden."""
    return (geometry.points(data.q) - data.points).norm(dim=-1)


def largest_distances(geometry: Geometry, data: Measurements) -> Tensor:
    """The largest distance of each row from predicted to measured markers, (N,) in m."""
    each = distances(geometry, data)
    return largest_known(each)


def spread(points: Tensor) -> float:
    """Root mean square distance of the markers from their centre without gross outliers and hidden markers, m."""
    squares = (points - points.nanmedian(dim=0, keepdim=True).values).square().sum(-1)
    return float(squares[squares <= LIMITS.gross_distances**2 * squares.nanmedian()].mean().sqrt())


def _registered(robot: Tree | Geometry, data: Measurements, inliers: Tensor, on: tuple[str, ...]) -> Identification:
    """Registration without gross outliers, from a first guess (N,) of the inliers; ``on``: tips of the markers."""
    for _ in range(LIMITS.rounds):
        registration = register(robot, data.q[inliers], data.points[inliers], on)
        largest = largest_distances(registration.geometry, data)
        near = largest <= LIMITS.gross_distances * float(largest.median())
        few_rows = int(near.sum()) < 0.5 * len(data) or not can_register(data.points[near])
        if bool((near == inliers).all()) or few_rows:
            break
        inliers = near
    return registration


def _with_offsets(registration: Identification, data: Measurements, inliers: Tensor) -> Identification:
    """The registration with joint offsets, if these explain far more; then with a warning."""
    geometry = registration.geometry
    chain = geometry.chain
    if len(data) < 2 * (2 + chain.n):
        return registration
    offsets = find_joint_offsets(geometry, data.q[inliers], data.points[inliers])
    again = _registered(with_joint_offsets(geometry, offsets), data, inliers, geometry.on)
    after, before = (float(distances(r.geometry, data).nanmedian()) for r in (again, registration))
    explained = after <= min(LIMITS.remaining * before, LIMITS.accepted_residual * spread(data.points))
    turned = offsets[torch.tensor(chain.periodic, dtype=torch.bool, device=offsets.device)]
    if not explained or bool((turned.abs() > LIMITS.largest_offset_rad).any()):
        return registration
    text = sentence(
        f"joint offsets are far from the robot's description: {_large_offsets(chain, offsets)}",
        got=f"residuals of {1e3 * before:.3g} mm, and of {1e3 * after:.3g} mm with these offsets added to the joints",
        fix="the calibration starts from these offsets; check those in the description, and the order of the joints",
    )
    warn_user(text)
    return again


def _large_offsets(chain: Tree, offsets: Tensor) -> str:
    """The largest offsets (n,), with names and units."""
    smallest = LIMITS.reported * float(offsets.abs().max())
    named = zip(chain.joint_names, offsets.tolist(), chain.periodic, strict=True)
    return ", ".join(
        f"{name} by {math.degrees(offset):.1f} degrees" if turns else f"{name} by {1e3 * offset:.1f} mm"
        for name, offset, turns in named
        if abs(offset) >= smallest
    )


def _inliers(robot: Tree, data: Measurements, on: tuple[str, ...]) -> Tensor:
    """Rows (N,) boolean that are near the best of a few registrations, of all rows and of random subsets.

    With the inliers every marker is seen.

    A least-squares fit of all rows is drawn towards gross outliers if there are many; a few random rows may be free
    of them.
    """
    start = largest_distances(register(robot, data.q, data.points, on).geometry, data)
    every = torch.ones_like(start, dtype=torch.bool)
    gross = LIMITS.gross_distances
    if float(start.max()) <= gross * float(start.median()) <= gross * LIMITS.consistent_residual * spread(data.points):
        return every
    best = start
    generator = seeded(0)
    seen = data.visible.double().mean()
    drawn = LIMITS.surplus * math.ceil((2.0 / data.markers + 1.0) / float(seen))  # 6 + 3 P unknowns, 3 P coordinates
    for _ in range(LIMITS.draws if len(data) > 2 * drawn else 0):
        rows = torch.randperm(len(data), generator=generator, device=HOST)[:drawn]
        if not can_register(data.points[rows]):
            continue
        largest = largest_distances(register(robot, data.q[rows], data.points[rows], on).geometry, data)
        best = largest if float(largest.median()) < float(best.median()) else best
    near = best <= gross * float(best.median())
    if float(best.median()) > 0.5 * float(start.median()) or not can_register(data.points[near]):
        return every
    return near
