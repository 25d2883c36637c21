"""Find geometric errors from measured points: all parameters of a :class:`Geometry` by maximum a posteriori,

    min over theta   sum_ik |y_k(q_i; theta) - y_ik|^2 / sigma^2 + sum_j (theta_j / s_j)^2,

sigma the standard deviation of the noise, s_j that of the Gaussian prior of parameter j. The prior makes the
problem regular whatever the poses are. Rows may share shifts c with the prior N(0, 1): y_i is then y_i + Z_i c.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import nan, sqrt
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

SMALLEST_NOISE_M = 1e-6
"""Lower bound of the noise; no device that measures a robot resolves less."""
ROUNDS, NOISE_CHANGE = 10, 3e-3
"""Most rounds of estimation, and the relative change of the noise at which they have converged."""
SMALLEST_PRIOR, LARGEST_PRIOR = 1e-5, 0.1
"""Range of estimated prior deviations, m or rad."""
COORDINATES = 8000
"""Measured coordinates of the random rows that stand for all rows where there are more. What a rigid geometry cannot
explain is larger than the error that noise then leaves in its few parameters."""
PRECISE: dict[str, Any] = {"xtol": 1e-12, "ftol": 1e-12, "gtol": 1e-12, "max_nfev": 200}


@dataclass(frozen=True)
class Prior:
    """Standard deviations of the Gaussian prior; its mean is the geometry that identification starts from."""

    translation: float = 1e-3  # of every moving joint's error translation [m]
    rotation: float = 1e-3  # of every moving joint's error rotation [rad]
    base_translation: float = PLACES.sought_base_m_rad  # of the base [m]
    base_rotation: float = PLACES.sought_base_m_rad  # of the base [rad]
    tool: float = PLACES.marker_m  # of the markers [m]

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
    """Result of an identification or a registration."""

    geometry: Geometry  # the geometry, with the estimated parameters absorbed
    rms: float  # root mean square distance from predicted to measured points [m]
    noise: float  # standard deviation of one measured coordinate, given or estimated [m]; for Student's t its scale
    # (K, K) posterior covariance of the parameters at ``geometry`` [m, rad]; rows of parameters that were held fixed
    # are zero
    covariance: Tensor
    theta: Tensor  # (K,) estimated parameters of the geometry that the search started from [m, rad]
    prior: Prior  # the prior, given or estimated
    # weights of the measurements (N, P), 1 where they are hidden; all 1 if the noise was given or is Gaussian
    tails: Tails
    devices: tuple[Devices, ...] = ()  # those of readings that were found with it, in the order of their tables
    # root mean square distance of the measured points, each predicted by the others to first order [m]
    left_out: float = nan

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
        theta = torch.cat([self.theta, self.theta.new_zeros(3)])
        return replace(self, geometry=whole, covariance=covariance, theta=theta)


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
    held = held_parameters(geometry) if held is None else held
    rows = Rows(geometry, (MeasuredPoints.of(q, points, shared),))
    if noise is None:
        return estimated(rows, held, prior)
    sigma, used = rows.parts[0].q.new_full(points.shape[:2], noise), prior or Prior()
    fit = solve(rows, sigma, used.root(geometry, held), **PRECISE)
    return _identification(rows, fit, noise, used, Tails.none(*points.shape[:2]))


class MeasuredPoints(NamedTuple):
    """Measured markers (N, P, 3), m, NaN where hidden, with effects (N, P, 3, c) of shifts that rows share."""

    q: Tensor
    points: Tensor
    effects: Tensor

    @classmethod
    def of(cls, q: Tensor, points: Tensor, shared: Tensor | None = None) -> MeasuredPoints:
        """Markers without shifts by default."""
        q, points = q.detach().cpu(), points.detach().cpu()
        return cls(q, points, points.new_zeros(*points.shape, 0) if shared is None else shared)

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
        count = max(1, COORDINATES // self.points[0].numel())
        if len(self.q) <= count:
            return self
        index = torch.randperm(len(self.q), generator=seeded(0), device=self.q.device)[:count].sort().values
        return MeasuredPoints(*(own[index] for own in self))

    def devices(self, shifts: Tensor) -> tuple[Devices, ...]:
        """The devices of readings after shifts (c,)."""
        return ()


class ReadRows(NamedTuple):
    """Readings of one kind of the first marker, a ball, and devices around which their places are sought."""

    data: Readings
    around: Devices

    @property
    def q(self) -> Tensor:
        return self.data.q

    @property
    def freedom(self) -> int:
        return self.around.freedom

    def devices(self, shifts: Tensor) -> tuple[Devices, ...]:
        around = self.around  # shifts are in units of their deviations
        return (around.moved(shifts.view(len(around.names), -1) * around.deviations),)

    def errors(self, points: Tensor, shifts: Tensor) -> Tensor:
        return -self.devices(shifts)[0].errors(self.data, points[:, 0])[:, None]

    def slopes(self, points: Tensor, by_errors: Tensor, shifts: Tensor) -> Tensor:
        (devices,), ball = self.devices(shifts), points[:, 0]
        device = devices.numbers(self.data)
        own = devices.observation(device).slope(ball) @ by_errors[:, 0]
        return torch.cat([own, devices.shared(ball, device)], 2)[:, None]

    def sample(self) -> ReadRows:
        return self


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of several kinds, and the geometry that explains them."""

    geometry: Geometry  # the start
    parts: tuple[MeasuredPoints | ReadRows, ...]  # the rows
    rigid: bool = False  # whether errors of joints and base stay zero, so that only the markers move on their tips

    @cached_property
    def tips(self) -> list[Tensor]:
        """Poses (N, P, 4, 4) of the markers' tips at the rows of every part, without errors."""
        return [self.geometry.marker_poses(own.q) for own in self.parts]

    def points(self, theta: Tensor) -> list[Tensor]:
        """The markers (N, P, 3) at the rows of every part, m."""
        if not self.rigid:
            return [self.geometry.points(own.q, theta) for own in self.parts]
        tool = self.geometry.tool + theta[self.geometry.slices["tool"]].view(-1, 3)
        return [(T[..., :3, :3] @ tool[..., None])[..., 0] + T[..., :3, 3] for T in self.tips]

    def by_errors(self, theta: Tensor, root: Tensor) -> list[Tensor]:
        """Derivatives (N, P, 3, f) of these by unknowns u, theta = root u; with known poses of the only marker."""
        if not self.rigid:
            return [self.geometry.sensitivities(own.q, theta) @ root for own in self.parts]
        return [T[..., :3, :3] @ root[self.geometry.slices["tool"]] for T in self.tips]

    @property
    def freedom(self) -> list[int]:
        """Number of shifts of every part."""
        return [own.freedom for own in self.parts]

    def devices(self, shifts: Tensor) -> tuple[Devices, ...]:
        """Those of all readings after all shifts."""
        each = zip(self.parts, shifts.split(self.freedom), strict=True)
        return tuple(one for own, some in each for one in own.devices(some))

    def errors(self, theta: Tensor, shifts: Tensor) -> list[Tensor]:
        """Predicted minus measured numbers of every part, m."""
        each = zip(self.parts, self.points(theta), shifts.split(self.freedom), strict=True)
        return [own.errors(points, own_shifts) for own, points, own_shifts in each]

    def slopes(self, theta: Tensor, shifts: Tensor, root: Tensor) -> list[Tensor]:
        """Derivatives of all numbers by the unknowns u (f,), theta = root u, then by all shifts."""
        sizes, found, f = self.freedom, [], root.shape[1]
        each = zip(self.parts, self.points(theta), self.by_errors(theta, root), shifts.split(sizes), strict=True)
        for place, (own, points, by_errors, own_shifts) in enumerate(each):
            slopes = own.slopes(points, by_errors, own_shifts)
            around = sum(sizes[:place]), sum(sizes[place + 1 :])
            found.append(torch.cat([slopes[..., :f], torch.nn.functional.pad(slopes[..., f:], around)], 3))
        return found


def estimated(rows: Rows, held: Sequence[int], prior: Prior | None = None) -> Identification:
    """Parameters and devices, with noise level and degrees of freedom of Student's t: expectation maximisation.

    Args:
        rows: of any kinds. held: see :func:`identify`. prior: its deviations of the joints' errors are estimated too
            by default.
    """
    some = replace(rows, parts=tuple(own.sample() for own in rows.parts))
    used, zero = prior or Prior(), rows.geometry.tool.new_zeros(rows.geometry.size)
    at = zero, zero.new_zeros(sum(rows.freedom))
    errors = some.errors(*at)
    dim = torch.cat([torch.full_like(own[..., 0], own.shape[2]) for own in errors])
    # The median, so that a few gross outliers do not set the level; that of chi-squared by Wilson and Hilferty.
    typical = (body_squares(errors) / (dim * (1.0 - 2.0 / (9.0 * dim)) ** 3)).nanmedian()
    level = max(sqrt(float(typical)), SMALLEST_NOISE_M)
    tails = reweight(body_squares(errors) / level**2, dim)
    for _ in range(ROUNDS):
        root = used.root(rows.geometry, held)
        fit = solve(some, level / tails.weights.sqrt(), root, start=at, **PRECISE)
        at = fit.theta, fit.shifts
        used = used if prior else _scaled(used, root, rows.geometry, fit)
        determined = float(fit.leverage.sum())  # number of parameters that the data determine
        squares, numbers = body_squares(fit.errors), sum(int((~own.isnan()).sum()) for own in fit.errors)
        total = float((tails.weights * squares).nansum())
        before, level = level, max(sqrt(total / max(numbers - determined, 1.0)), SMALLEST_NOISE_M)
        tails = reweight(squares / level**2 + fit.leverage / tails.weights, dim)
        if abs(level - before) < NOISE_CHANGE * level:
            break
    left_out = body_squares(fit.errors) / (1.0 - fit.leverage / dim).square()
    fit = fit._replace(errors=rows.errors(*at))
    if len(tails.weights) < sum(len(own) for own in fit.errors):
        tails = reweight(body_squares(fit.errors) / level**2, 3)
    return replace(_identification(rows, fit, level, used, tails), left_out=float(left_out.nanmean().sqrt()))


def _identification(rows: Rows, fit: Fit, level: float, prior: Prior, tails: Tails) -> Identification:
    """A fit, with the errors of all rows."""
    rms = float(body_squares(fit.errors).nanmean().sqrt())
    known = fit.covariance, fit.theta, prior, tails, rows.devices(fit.shifts)
    return Identification(rows.geometry.absorb(fit.theta), rms, level, *known)


def body_squares(errors: Sequence[Tensor]) -> Tensor:
    """Squares (N, B) of errors (N, B, d) of several kinds of rows; NaN where hidden."""
    return torch.cat([own.square().sum(2) for own in errors])


def _scaled(prior: Prior, root: Tensor, geometry: Geometry, fit: Fit) -> Prior:
    """Deviations of the joints' errors that maximise the expected likelihood of the parameters (M step)."""
    squares, free = fit.theta.square() + fit.covariance.diagonal(), (root > 0).any(1).to(root)
    parts = ((part * free)[geometry.slices["joints"]] for part in (squares, torch.ones_like(squares)))
    total, count = (part.view(-1, 2, 3).sum(dim=(0, 2)) for part in parts)
    deviations = (total / count.clamp(min=1.0)).sqrt()
    translation, rotation = deviations.clamp(SMALLEST_PRIOR, LARGEST_PRIOR).tolist()
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


def solve(
    rows: Rows, sigma: Tensor, root: Tensor, *, start: tuple[Tensor, Tensor] | None = None, **options: Any
) -> Fit:
    """Fit errors theta = root u, and shifts: the prior is then one row of the identity per unknown without units.

    Args:
        rows: see :class:`Rows`. sigma: (N, B) standard deviations of the bodies of all rows, m.
        root: (K, f) square root of the prior covariance of the errors, its columns orthogonal.
        start: theta (K,) and shifts; zero by default.
        options: of scipy.

    Raises:
        InputError: a start that cannot be measured.
    """
    from scipy.optimize import least_squares  # noqa: PLC0415  # slow to import, not needed to use a model

    f = root.shape[1]
    u0 = root.new_zeros(f + sum(rows.freedom))
    if start is not None:
        u0 = torch.cat([(root.mT @ start[0]) / root.square().sum(0), start[1]])
    hidden = [own.isnan() for own in rows.errors(root @ u0[:f], u0[f:])]
    weights = [1 / own[..., None] for own in sigma.split([len(own) for own in hidden])]
    size = len(u0) + sum(own.numel() for own in hidden)

    def residual(u: np.ndarray) -> np.ndarray:
        at = torch.from_numpy(u).clone()
        try:
            each = zip(weights, rows.errors(root @ at[:f], at[f:]), hidden, strict=True)
        except InputError:  # behind a camera: scipy shortens the step
            return np.full(size, np.inf)
        return torch.cat([*((w * own).masked_fill(h, 0.0).flatten() for w, own, h in each), at]).numpy()

    def jacobian(u: np.ndarray) -> np.ndarray:
        at = torch.from_numpy(u).clone()
        each = zip(weights, rows.slopes(root @ at[:f], at[f:], root), hidden, strict=True)
        slopes = [(w[..., None] * own).masked_fill(h[..., None], 0.0).flatten(0, 2) for w, own, h in each]
        return torch.cat([*slopes, torch.eye(len(u), dtype=at.dtype, device=at.device)]).numpy()

    derivatives: Any = jacobian  # scipy's stubs know its names of difference schemes only
    with torch_alone():
        found = least_squares(residual, u0.numpy(), derivatives, **options)
        U, s, Vt = np.linalg.svd(jacobian(found.x), full_matrices=False)  # s >= 1 by the prior rows
    u, V = torch.from_numpy(found.x).clone(), torch.from_numpy(Vt.T / s).clone()  # aligned: the same digits every time
    theta, shifts, known = root @ u[:f], u[f:], root @ V[:f]
    leverage = torch.from_numpy(np.square(U[: -len(u)]).sum(1)).split([own.numel() for own in hidden])
    each = torch.cat([own.view(h.shape).sum(2) for own, h in zip(leverage, hidden, strict=True)])
    return Fit(theta, known @ known.mT, shifts, rows.errors(theta, shifts), each)
