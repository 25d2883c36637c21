"""Find geometric errors from measured points: all parameters of a :class:`Geometry` by maximum a posteriori,

    min over theta   sum_ik |y_k(q_i; theta) - y_ik|^2 / sigma^2 + sum_j (theta_j / s_j)^2,

sigma the standard deviation of the noise, s_j that of the Gaussian prior of parameter j. The prior makes the
problem regular whatever the poses are. Rows may share shifts c with the prior N(0, 1): y_i is then y_i + Z_i c.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import sqrt
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.device import seeded
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.threads import torch_alone
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.process.tails import Tails, reweight
from diffeo_calib.robots.cartesian import is_cartesian, turns_nowhere
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.devices import Devices

MEDIAN_CHI2_3 = 2.37
"""Median of chi-squared with 3 degrees of freedom."""


@dataclass(frozen=True)
class EstimationLimits:
    """When the joint estimation of noise, tails and prior ends, and the range of its results.

    Args:
        smallest_noise_m: lower bound of the noise; no device that measures a robot resolves less.
        rounds: largest number of fits.
        noise_change: relative change of the noise at which the estimation has converged.
        smallest_prior: lower bound of estimated prior deviations, m or rad. largest_prior: their upper bound.
        coordinates: measured coordinates of the random rows that stand for all rows where there are more. What a
            rigid geometry cannot explain is larger than the error that noise then leaves in its few parameters.
    """

    smallest_noise_m: float = 1e-6
    rounds: int = 10
    noise_change: float = 3e-3
    smallest_prior: float = 1e-5
    largest_prior: float = 0.1
    coordinates: int = 8000


LIMITS = EstimationLimits()
PRECISE = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-12)


@dataclass(frozen=True)
class Prior:
    """Standard deviations of the Gaussian prior; its mean is the geometry that identification starts from.

    Args:
        translation: of every moving joint's error translation [m].
        rotation: of every moving joint's error rotation [rad].
        base_translation: of the base [m].
        base_rotation: of the base [rad].
        tool: of the markers [m].
    """

    translation: float = 1e-3
    rotation: float = 1e-3
    base_translation: float = PLACES.sought_base_m_rad
    base_rotation: float = PLACES.sought_base_m_rad
    tool: float = PLACES.marker_m

    def root(self, geometry: Geometry, held: Sequence[int] = ()) -> Tensor:
        """Square root (K, f) of the covariance of the parameters of ``geometry``, of which some are held [m or rad]."""
        free = torch.ones(geometry.size, dtype=torch.bool, device=geometry.base.device)
        free[list(held)] = False
        return self.deviations(geometry).diag()[:, free]

    def deviations(self, geometry: Geometry) -> Tensor:
        """Standard deviation of each of the K parameters of ``geometry`` [m or rad]."""
        base = [self.base_translation] * 3 + [self.base_rotation] * 3
        joint = [self.translation] * 3 + [self.rotation] * 3
        every = base + joint * geometry.chain.moving + [self.tool] * 3 * geometry.markers
        return torch.tensor(every, dtype=torch.float64, device=geometry.base.device)


@dataclass(frozen=True, eq=False)
class Identification:
    """Result of an identification or a registration.

    Args:
        geometry: the geometry, with the estimated parameters absorbed.
        rms: root mean square distance from predicted to measured points [m].
        noise: standard deviation of one measured coordinate, given or estimated [m]; for Student's t its scale.
        covariance: (K, K) posterior covariance of the parameters at ``geometry`` [m, rad]; rows of parameters that
            were held fixed are zero.
        iterations: steps taken.
        status: how the search ended, in one sentence.
        theta: (K,) estimated parameters of the geometry that the search started from [m, rad].
        prior: the prior, given or estimated.
        tails: weights of the measurements (N, P), 1 where they are hidden; all 1 if the noise was given or is Gaussian.
    """

    geometry: Geometry
    rms: float
    noise: float
    covariance: Tensor
    iterations: int
    status: str
    theta: Tensor
    prior: Prior
    tails: Tails

    @property
    def deviations(self) -> Tensor:
        """Posterior standard deviation of each of the K parameters [m or rad]."""
        return self.covariance.diagonal().clamp(min=0).sqrt()

    def with_ball(self, ball: Identification) -> Identification:
        """The same with a ball, found around the same robot as its only marker, as one more marker."""
        geometry, own = self.geometry, ball.geometry
        whole = geometry.with_tool(torch.cat([geometry.tool, own.tool]), (*geometry.on, *own.on))
        covariance = geometry.tool.new_zeros(whole.size, whole.size)
        covariance[:-3, :-3], covariance[-3:, -3:] = self.covariance, ball.covariance[-3:, -3:]
        theta, status = torch.cat([self.theta, self.theta.new_zeros(3)]), f"{self.status[:-1]}; {ball.status}"
        return replace(self, geometry=whole, covariance=covariance, theta=theta, status=status)


def held_parameters(geometry: Geometry, *, adrift: bool = False) -> tuple[int, ...]:
    """Numbers of the parameters that stay zero.

    Errors between the joints of a commanded pose, which are numbers and no links. Of parts that no row tells apart one:
    ``adrift`` without a measuring device, where the robot stands, and its first joint; with one, where the first marker
    of a machine with commanded places sits.
    """
    base, joints, tool = (range(geometry.size)[geometry.slices[name]] for name in ("base", "joints", "tool"))
    held = {*joints} if is_cartesian(geometry.chain) else set[int]()
    if adrift:
        held |= {*base, *joints[:6]}
    elif turns_nowhere(geometry.chain):
        held |= {*tool[:3]}
    return tuple(sorted(held))


def identify(
    geometry: Geometry,
    q: Tensor,
    points: Tensor,
    noise: float | None = None,
    prior: Prior | None = None,
    *,
    shared: Tensor | None = None,
    held: Sequence[int] | None = None,
) -> Identification:
    """Find all 6 + 6 n_all + 3 P parameters of a geometry, starting from the given one (usually from ``register``).

    Without ``noise``, the noise level and its degrees of freedom (Student's t, so that outliers lose their influence)
    are estimated together with the parameters by expectation maximisation; without ``prior`` also the prior deviations
    of the joints' errors. Of many rows a random sample of some thousands is used.

    Args:
        geometry: the start, and the centre of the prior.
        q: (N, n) joint values [rad or m].
        points: (N, P, 3) measured markers [m]; NaN where they are hidden.
        noise: standard deviation of one coordinate [m].
        prior: see :class:`Prior`; with ``noise`` but without ``prior``, its defaults.
        shared: (N, P, 3, c) effects Z of shifts of unit variance that rows share [m].
        held: numbers of parameters that stay zero; see :func:`held_parameters`, by default those with a device.

    Note:
        Cost: some ten singular value decompositions of a (3 N P + K) x K matrix.
    """
    q, points = q.detach().cpu(), points.detach().cpu()
    held = held_parameters(geometry) if held is None else held
    own = MeasuredPoints(q, points, points.new_zeros(*points.shape, 0) if shared is None else shared)
    rows = Rows(geometry, (own,))
    if noise is not None:
        sigma, used = points.new_full(points.shape[:2], noise), prior or Prior()
        fit = solve(rows, sigma, used.root(geometry, held), **PRECISE)
        left = fit.errors
        tails, level = Tails.none(*points.shape[:2], device=points.device), noise
    else:
        fit, used, tails, level = _estimate(Rows(geometry, (own.sample(),)), prior, held)
        left = rows.errors(fit.theta, fit.shifts)
        if len(tails.weights) < len(q):
            tails = reweight(body_squares(left) / level**2, 3)
    how = "estimated" if noise is None else "given"
    rms = float(body_squares(left).nanmean().sqrt())
    ended = f"{'converged' if fit.converged else 'stopped before converging'} after {fit.iterations} steps"
    status = f"{ended}: {in_mm(rms, level, how)}."
    found = geometry.absorb(fit.theta)
    return Identification(found, rms, level, fit.covariance, fit.iterations, status, fit.theta, used, tails)


class MeasuredPoints(NamedTuple):
    """Measured markers (N, P, 3), m, NaN where hidden, with effects (N, P, 3, c) of shifts that rows share."""

    q: Tensor
    points: Tensor
    effects: Tensor

    @property
    def freedom(self) -> int:
        """Number c of shifts of unit variance."""
        return self.effects.shape[3]

    def errors(self, points: Tensor, shifts: Tensor) -> Tensor:
        """Predicted minus measured numbers (N, B, d) of B bodies, m, for points (N, P, 3) and shifts (c,)."""
        return points - self.points - self.effects @ shifts

    def slopes(self, points: Tensor, by_errors: Tensor, shifts: Tensor) -> Tensor:
        """Their derivatives (N, B, d, f + c) by f errors that move points by (N, P, 3, f), then by the shifts."""
        return torch.cat([by_errors, -self.effects], 3)

    def sample(self) -> MeasuredPoints:
        """Random rows that stand for all of them, if there are many."""
        count = max(1, LIMITS.coordinates // self.points[0].numel())
        if len(self.q) <= count:
            return self
        index = torch.randperm(len(self.q), generator=seeded(0), device=self.q.device)[:count].sort().values
        return MeasuredPoints(*(own[index] for own in self))


class ReadRows(NamedTuple):
    """Readings of one kind of the first marker, a ball, and devices around which their places are sought."""

    data: Readings
    devices: Devices

    @property
    def q(self) -> Tensor:
        return self.data.q

    @property
    def freedom(self) -> int:
        return self.devices.freedom

    def moved(self, shifts: Tensor) -> Devices:
        """The devices after shifts, in units of their deviations."""
        return self.devices.moved(shifts.view(len(self.devices.names), -1) * self.devices.deviations)

    def errors(self, points: Tensor, shifts: Tensor) -> Tensor:
        return -self.moved(shifts).errors(self.data, points[:, 0])[:, None]

    def slopes(self, points: Tensor, by_errors: Tensor, shifts: Tensor) -> Tensor:
        devices, ball = self.moved(shifts), points[:, 0]
        device = devices.numbers(self.data)
        own = devices.observation(device).slope(ball) @ by_errors[:, 0]
        return torch.cat([own, devices.shared(ball, device)], 2)[:, None]


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of several kinds, and the geometry that explains them.

    Args:
        geometry: the start. parts: the rows.
        tips: (N, P, 4, 4) their poses at the rows of every part where errors of joints and base stay zero, so
            that only the markers move; None where they may not.
    """

    geometry: Geometry
    parts: tuple[MeasuredPoints | ReadRows, ...]
    tips: Sequence[Tensor] | None = None

    def points(self, theta: Tensor) -> list[Tensor]:
        """The markers (N, P, 3) at the rows of every part, m."""
        if self.tips is None:
            return [self.geometry.points(own.q, theta) for own in self.parts]
        tool = self.geometry.tool + theta[self.geometry.slices["tool"]].view(-1, 3)
        return [(T[..., :3, :3] @ tool[..., None])[..., 0] + T[..., :3, 3] for T in self.tips]

    def by_errors(self, theta: Tensor, root: Tensor) -> list[Tensor]:
        """Derivatives (N, P, 3, f) of these by unknowns u, theta = root u; with known poses of the only marker."""
        if self.tips is None:
            return [self.geometry.sensitivities(own.q, theta) @ root for own in self.parts]
        return [T[..., :3, :3] @ root[self.geometry.slices["tool"]] for T in self.tips]

    def split(self, shifts: Tensor) -> tuple[Tensor, ...]:
        """Shifts of every part."""
        return shifts.split([own.freedom for own in self.parts])

    def errors(self, theta: Tensor, shifts: Tensor) -> list[Tensor]:
        """Predicted minus measured numbers of every part, m."""
        each = zip(self.parts, self.points(theta), self.split(shifts), strict=True)
        return [own.errors(points, own_shifts) for own, points, own_shifts in each]

    def slopes(self, theta: Tensor, shifts: Tensor, root: Tensor) -> list[Tensor]:
        """Derivatives of all numbers by the unknowns u (f,), theta = root u, then by all shifts."""
        sizes, found, f = [own.freedom for own in self.parts], [], root.shape[1]
        each = zip(self.parts, self.points(theta), self.by_errors(theta, root), self.split(shifts), strict=True)
        for place, (own, points, by_errors, own_shifts) in enumerate(each):
            slopes = own.slopes(points, by_errors, own_shifts)
            around = sum(sizes[:place]), sum(sizes[place + 1 :])
            found.append(torch.cat([slopes[..., :f], torch.nn.functional.pad(slopes[..., f:], around)], 3))
        return found


def body_squares(errors: Sequence[Tensor]) -> Tensor:
    """Squares (N, B) of errors (N, B, d) of several kinds of rows; NaN where hidden."""
    return torch.cat([own.square().sum(2) for own in errors])


def _estimate(rows: Rows, prior: Prior | None, held: Sequence[int]) -> tuple[Fit, Prior, Tails, float]:
    """Parameters, prior deviations, tails and noise level together."""
    zero = rows.geometry.tool.new_zeros(rows.geometry.size)
    start = body_squares(rows.errors(zero, zero.new_zeros(rows.parts[0].freedom)))
    # The median, so that a few gross outliers do not set the level.
    level = max(sqrt(float(start.nanmedian()) / MEDIAN_CHI2_3), LIMITS.smallest_noise_m)
    used, fits = prior or Prior(), list[Fit]()

    def solved(sigma: Tensor) -> Fit:
        nonlocal used
        root = used.root(rows.geometry, held)
        fits.append(solve(rows, sigma, root, start=fits[-1].theta if fits else None, **PRECISE))
        used = used if prior else _scaled(used, root, rows.geometry, fits[-1])
        return fits[-1]

    fit, tails, level = weighed_fits(solved, (level, reweight(start / level**2, 3)))
    return fit._replace(iterations=sum(each.iterations for each in fits)), used, tails, level


def weighed_fits(solved: Callable[[Tensor], Fit], start: tuple[float, Tails]) -> tuple[Fit, Tails, float]:
    """A fit with the noise level and the degrees of freedom of Student's t that it leaves: expectation maximisation.

    Args:
        solved: least squares for standard deviations (N, B) of the bodies, m. start: the noise level, m, and tails.
    """
    level, tails = start
    for _ in range(LIMITS.rounds):
        fit = solved(level / tails.weights.sqrt())
        determined = float(fit.leverage.sum())  # number of parameters that the data determine
        squares, numbers = body_squares(fit.errors), sum(int((~own.isnan()).sum()) for own in fit.errors)
        total = float((tails.weights * squares).nansum())
        before, level = level, max(sqrt(total / max(numbers - determined, 1.0)), LIMITS.smallest_noise_m)
        dim = torch.cat([torch.full_like(own[..., 0], own.shape[2]) for own in fit.errors])
        tails = reweight(squares / level**2 + fit.leverage / tails.weights, dim)
        if abs(level - before) < LIMITS.noise_change * level:
            break
    return fit, tails, level


def _scaled(prior: Prior, root: Tensor, geometry: Geometry, fit: Fit) -> Prior:
    """Deviations of the joints' errors that maximise the expected likelihood of the parameters (M step)."""
    squares, free = fit.theta.square() + fit.covariance.diagonal(), (root > 0).any(1).to(root)
    parts = ((part * free)[geometry.slices["joints"]] for part in (squares, torch.ones_like(squares)))
    total, count = (part.view(-1, 2, 3).sum(dim=(0, 2)) for part in parts)
    deviations = (total / count.clamp(min=1.0)).sqrt()
    translation, rotation = deviations.clamp(LIMITS.smallest_prior, LIMITS.largest_prior).tolist()
    return replace(prior, translation=translation, rotation=rotation)


class Fit(NamedTuple):
    """One least-squares fit.

    Args:
        theta: (K,) errors. covariance: (K, K). shifts: of all parts.
        errors: (N, B, d) of every part, m. leverage: (N, B) of all rows.
    """

    theta: Tensor
    covariance: Tensor
    shifts: Tensor
    errors: list[Tensor]
    leverage: Tensor
    iterations: int
    converged: bool


def solve(rows: Rows, sigma: Tensor, root: Tensor, *, start: Tensor | None = None, **options: Any) -> Fit:
    """Fit errors theta = root u, and shifts: the prior is then one row of the identity per unknown without units.

    Args:
        rows: see :class:`Rows`. sigma: (N, B) standard deviations of the bodies of all rows, m.
        root: (K, f) square root of the prior covariance of the errors, its columns orthogonal. start: (K,).
        options: of scipy.
    """
    f = root.shape[1]
    u0 = root.new_zeros(f + sum(own.freedom for own in rows.parts))
    u0[:f] = 0.0 if start is None else (root.mT @ start) / root.square().sum(0)
    hidden = [own.isnan() for own in rows.errors(root @ u0[:f], u0[f:])]
    weights = [1 / own[..., None] for own in sigma.split([len(own) for own in hidden])]

    def errors(u: Tensor) -> Tensor:
        each = zip(weights, rows.errors(root @ u[:f], u[f:]), hidden, strict=True)
        return torch.cat([(w * own).masked_fill(h, 0.0).flatten() for w, own, h in each])

    def slopes(u: Tensor) -> Tensor:
        each = zip(weights, rows.slopes(root @ u[:f], u[f:], root), hidden, strict=True)
        return torch.cat([(w[..., None] * own).masked_fill(h[..., None], 0.0).flatten(0, 2) for w, own, h in each])

    found = least_squares_of(errors, slopes, u0, **options)
    theta, shifts, known = root @ found.u[:f], found.u[f:], root @ found.root[:f]
    parts = zip(found.leverage.split([own.numel() for own in hidden]), hidden, strict=True)
    leverage = torch.cat([own.view(h.shape).sum(2) for own, h in parts])
    left = rows.errors(theta, shifts)
    return Fit(theta, known @ known.mT, shifts, left, leverage, found.iterations, found.converged)


class Minimum(NamedTuple):
    """The least squares of errors (M,) and of the unknowns u (k,) themselves.

    Args:
        root: (k, k), its square is the covariance of u. leverage: (M,) of the errors.
    """

    u: Tensor
    root: Tensor
    leverage: Tensor
    iterations: int
    converged: bool


def least_squares_of(
    errors: Callable[[Tensor], Tensor], slopes: Callable[[Tensor], Tensor], u0: Tensor, **options: Any
) -> Minimum:
    """Unknowns u (k,) with the prior N(0, 1) that explain errors (M,) of unit variance; options are those of scipy."""
    from scipy.optimize import least_squares  # noqa: PLC0415  # slow to import, not needed to use a model

    size = len(errors(u0)) + len(u0)  # raises where the start cannot be measured

    def residual(u: np.ndarray) -> np.ndarray:
        try:
            return np.concatenate([errors(torch.from_numpy(u).clone()).numpy(), u])
        except InputError:  # behind a camera: scipy shortens the step
            return np.full(size, np.inf)

    def jacobian(u: np.ndarray) -> np.ndarray:
        return np.concatenate([slopes(torch.from_numpy(u).clone()).numpy(), np.eye(len(u))])

    derivatives: Any = jacobian  # scipy's stubs know its names of difference schemes only
    with torch_alone():
        fit = least_squares(residual, u0.numpy(), derivatives, **options)
        U, s, Vt = np.linalg.svd(jacobian(fit.x), full_matrices=False)  # s >= 1 by the prior rows
    leverage = torch.from_numpy(np.square(U[: -len(fit.x)]).sum(1))
    u, root = torch.from_numpy(fit.x).clone(), torch.from_numpy(Vt.T / s).clone()  # aligned: the same digits every time
    return Minimum(u, root, leverage, int(fit.nfev), fit.status > 0)


def in_mm(rms: float, noise: float, how: str) -> str:
    """Say how large residual and noise are."""
    return f"residual {1e3 * rms:.4g} mm RMS, noise {1e3 * noise:.4g} mm per coordinate ({how})"
