"""Find geometric errors from measured points: all parameters of a :class:`Geometry` by maximum a posteriori,

    min over theta   sum_ik |y_k(q_i; theta) - y_ik|^2 / sigma^2 + sum_j (theta_j / s_j)^2,

sigma the standard deviation of the noise, s_j that of the Gaussian prior of parameter j. The prior makes the
problem regular whatever the poses are. Rows may share shifts c with the prior N(0, 1): y_i is then y_i + Z_i c.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import sqrt
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, positive
from diffeo_calib.common.device import seeded
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.common.quantiles import known
from diffeo_calib.common.threads import torch_alone
from diffeo_calib.measurements.checks import marker_places
from diffeo_calib.process.tails import Tails, reweight
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.tree import Tree

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
F = TypeVar("F")


@dataclass(frozen=True)
class Prior:
    """Standard deviations of the Gaussian prior; its mean is the geometry that identification starts from.

    Args:
        translation: of every moving joint's error translation [m].
        rotation: of every moving joint's error rotation [rad].
        base_translation: of the base [m].
        base_rotation: of the base [rad].
        tool: of the markers [m].

    Raises:
        InputError: a value that is not a positive number.
    """

    translation: float = 1e-3
    rotation: float = 1e-3
    base_translation: float = PLACES.sought_base_m_rad
    base_rotation: float = PLACES.sought_base_m_rad
    tool: float = PLACES.marker_m

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            positive(value, f"Prior.{name}")

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


def held_parameters(geometry: Geometry) -> tuple[int, ...]:
    """Numbers of the parameters that no row can tell apart from where the robot stands, without a measuring device."""
    base, joints = geometry.slices["base"], geometry.slices["joints"]
    return (*range(base.start, base.stop), *range(joints.start, joints.start + 6))


def identify(
    geometry: Geometry,
    q: Tensor,
    points: Tensor,
    noise: float | Tensor | None = None,
    prior: Prior | None = None,
    *,
    shared: Tensor | None = None,
    held: Sequence[int] = (),
) -> Identification:
    """Find all 6 + 6 n_all + 3 P parameters of a geometry, starting from the given one (usually from ``register``).

    Without ``noise``, the noise level and its degrees of freedom (Student's t, so that outliers lose their influence)
    are estimated together with the parameters by expectation maximisation; without ``prior`` also the prior deviations
    of the joints' errors. Of many rows a random sample of some thousands is used.

    Args:
        geometry: the start, and the centre of the prior.
        q: (N, n) joint values [rad or m].
        points: (N, P, 3) measured markers [m]; NaN where they are hidden.
        noise: standard deviation of one coordinate [m]: one for all, one per pose (N,) or per marker (N, P).
        prior: see :class:`Prior`; with ``noise`` but without ``prior``, its defaults.
        shared: (N, P, 3, c) effects Z of shifts of unit variance that rows share [m].
        held: numbers of parameters that stay zero.

    Raises:
        InputError: wrong shapes, or values that are not finite.
        MeasurementError: another number of markers than the geometry has, or numbers of rows that differ.

    Note:
        Cost: some ten singular value decompositions of a (3 N P + K) x K matrix.
    """
    q, points = checked_rows(geometry.chain, q, points, geometry.markers)
    rows = _Rows(geometry, q, points, points.new_zeros(*points.shape, 0) if shared is None else shared, tuple(held))
    if noise is not None:
        sigma, used = _given_noise(noise, points), prior or Prior()
        fit = _solve(rows, sigma, used)
        tails, level = Tails.none(*points.shape[:2], device=points.device), float(sigma.square().mean().sqrt())
    else:
        fit, used, tails, level = _estimate(rows.sample(), prior)
        if len(tails.weights) < len(q):
            tails = reweight(rows.squares(fit.theta, fit.shifts) / level**2, 3)
    how = "estimated" if noise is None else "given"
    found = geometry.absorb(fit.theta)
    rms = float(rows.squares(fit.theta, fit.shifts).nanmean().sqrt())
    ended = f"{'converged' if fit.converged else 'stopped before converging'} after {fit.iterations} steps"
    status = f"{ended}: {in_mm(rms, level, how)}."
    return Identification(found, rms, level, fit.covariance, fit.iterations, status, fit.theta, used, tails)


class _Rows(NamedTuple):
    """The measurements, and the geometry that explains them.

    Args:
        geometry: the start. q: (N, n). points: (N, P, 3). shared: (N, P, 3, c). held: numbers of fixed parameters.
    """

    geometry: Geometry
    q: Tensor
    points: Tensor
    shared: Tensor
    held: tuple[int, ...]

    def squares(self, theta: Tensor, shifts: Tensor) -> Tensor:
        """Squared distances (N, P) from measured to fitted points, m^2."""
        return (self.geometry.points(self.q, theta) - self.points - self.shared @ shifts).square().sum(-1)

    def sample(self) -> _Rows:
        """Random rows that stand for all of them, if there are many."""
        count = max(1, LIMITS.coordinates // self.points[0].numel())
        if len(self.q) <= count:
            return self
        index = torch.randperm(len(self.q), generator=seeded(0), device=self.q.device)[:count].sort().values
        return self._replace(q=self.q[index], points=self.points[index], shared=self.shared[index])


def _estimate(rows: _Rows, prior: Prior | None) -> tuple[_Fit, Prior, Tails, float]:
    """Parameters, prior deviations, tails and noise level together."""
    start = (rows.geometry.points(rows.q) - rows.points).square().sum(-1)
    # The median, so that a few gross outliers do not set the level.
    level = max(sqrt(float(start.nanmedian()) / MEDIAN_CHI2_3), LIMITS.smallest_noise_m)
    used, fits = prior or Prior(), list[_Fit]()

    def solved(sigma: Tensor) -> _Fit:
        nonlocal used
        fits.append(_solve(rows, sigma, used, start=fits[-1].theta if fits else None))
        used = used if prior else _scaled(used, rows, fits[-1])
        return fits[-1]

    fit, tails, level = weighed_fits(solved, (level, reweight(start / level**2, 3)), 3, len(known(rows.points)))
    return fit._replace(iterations=sum(each.iterations for each in fits)), used, tails, level


def weighed_fits(
    solved: Callable[[Tensor], F], start: tuple[float, Tails], dim: int | Tensor, numbers: int
) -> tuple[F, Tails, float]:
    """A fit with the noise level and the degrees of freedom of Student's t that it leaves: expectation maximisation.

    Args:
        solved: least squares for standard deviations (N, B) of the bodies, m, with their ``squares`` and ``leverage``.
        start: the noise level, m, and tails. dim: numbers of each body. numbers: that were measured.
    """
    fit, (level, tails) = None, start
    for _ in range(LIMITS.rounds):
        fit: Any = solved(level / tails.weights.sqrt())
        determined = float(fit.leverage.sum())  # number of parameters that the data determine
        total = float((tails.weights * fit.squares).nansum())
        before, level = level, max(sqrt(total / max(numbers - determined, 1.0)), LIMITS.smallest_noise_m)
        tails = reweight(fit.squares / level**2 + fit.leverage / tails.weights, dim)
        if abs(level - before) < LIMITS.noise_change * level:
            break
    return fit, tails, level


def _scaled(prior: Prior, rows: _Rows, fit: _Fit) -> Prior:
    """Deviations of the joints' errors that maximise the expected likelihood of the parameters (M step)."""
    squares, joints = fit.theta.square() + fit.covariance.diagonal(), rows.geometry.slices["joints"]
    free = torch.ones_like(squares)
    free[list(rows.held)] = 0.0
    total, count = ((part * free)[joints].view(-1, 2, 3).sum(dim=(0, 2)) for part in (squares, free))
    deviations = (total / count.clamp(min=1.0)).sqrt()
    translation, rotation = deviations.clamp(LIMITS.smallest_prior, LIMITS.largest_prior).tolist()
    return replace(prior, translation=translation, rotation=rotation)


class _Fit(NamedTuple):
    """One least-squares fit: theta (K,), covariance (K, K), squared distances (N, P), m^2, and leverage (N, P)."""

    theta: Tensor
    covariance: Tensor
    shifts: Tensor
    squares: Tensor
    leverage: Tensor
    iterations: int
    converged: bool


def _solve(rows: _Rows, sigma: Tensor, prior: Prior, *, start: Tensor | None = None) -> _Fit:
    """Fit theta = scale * u: the prior is then one row of the identity per parameter, and u has no units."""
    geometry, q, points, shared, held = rows
    hidden = points.isnan().any(2, keepdim=True)
    weight, points = (1 / sigma[..., None]).masked_fill(hidden, 0.0), points.masked_fill(hidden, 0.0)  # (N, P, 1 and 3)
    scale = prior.deviations(geometry)  # (K,)
    scale[list(held)] = 0.0
    size, shifting = len(scale), (-weight[..., None] * shared).flatten(0, 2)

    def errors(u: Tensor) -> Tensor:
        return (weight * (geometry.points(q, scale * u[:size]) - points)).flatten() + shifting @ u[size:]

    def slopes(u: Tensor) -> Tensor:
        by_theta = weight[..., None] * geometry.sensitivities(q, scale * u[:size]) * scale
        return torch.cat([by_theta.flatten(0, 2), shifting], 1)

    u0 = scale.new_zeros(size + shared.shape[-1])
    u0[:size] = 0.0 if start is None else torch.where(scale > 0, start / scale, 0.0)
    found = least_squares_of(errors, slopes, u0, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    root = found.root[:size] * scale[:, None]
    theta, shifts = scale * found.u[:size], found.u[size:]
    leverage = found.leverage.view(points.shape).sum(-1)
    squares = rows.squares(theta, shifts)
    return _Fit(theta, root @ root.mT, shifts, squares, leverage, found.iterations, found.converged)


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

    def residual(u: np.ndarray) -> np.ndarray:
        return np.concatenate([errors(torch.from_numpy(u)).numpy(), u])

    def jacobian(u: np.ndarray) -> np.ndarray:
        return np.concatenate([slopes(torch.from_numpy(u)).numpy(), np.eye(len(u))])

    derivatives: Any = jacobian  # scipy's stubs know its names of difference schemes only
    with torch_alone():
        fit = least_squares(residual, u0.numpy(), derivatives, **options)
        U, s, Vt = np.linalg.svd(jacobian(fit.x), full_matrices=False)  # s >= 1 by the prior rows
    leverage = torch.from_numpy(np.square(U[: -len(fit.x)]).sum(1))
    return Minimum(torch.from_numpy(fit.x), torch.from_numpy(Vt.T / s), leverage, int(fit.nfev), fit.status > 0)


def checked_rows(chain: Tree, q: Tensor, points: Tensor, markers: int | None = None) -> tuple[Tensor, Tensor]:
    """Check joint values and points against each other, and return both detached, on the CPU."""
    q = chain.joint_values(q).detach().cpu()
    fix = "pass metres, one row per pose"
    three = isinstance(points, Tensor) and points.ndim == 3
    points = marker_places(points).cpu() if three else as_tensor(points, "points", ("N", "P", 3), fix=fix)
    if len(points) != len(q):
        what = "`q` and `points` must have one row per pose each"
        got = f"{len(q)} and {len(points)} rows"
        raise MeasurementError.of(what, expected="as many rows", got=got, fix="check how they were read")
    if markers is not None and points.shape[1] != markers:
        expected, got = f"{markers} markers, as the geometry has", str(points.shape[1])
        raise MeasurementError.of("`points`", expected=expected, got=got, fix="register them together first")
    return q, points


def _given_noise(noise: float | Tensor, points: Tensor) -> Tensor:
    """Standard deviation of every marker (N, P)."""
    N, P, _ = points.shape
    shape = ((), ("N",), ("N", "P"))[min(noise.ndim, 2)] if isinstance(noise, Tensor) else ()
    given = positive(noise, "noise", shape).detach().cpu()
    if tuple(given.shape) not in ((), (N,), (N, P)):
        expected = f"one value, {N}, or ({N}, {P})"
        raise MeasurementError.of("`noise`", expected=expected, got=str(tuple(given.shape)))
    return (given[:, None] if given.ndim == 1 else given).expand(N, P)


def in_mm(rms: float, noise: float, how: str) -> str:
    """Say how large residual and noise are."""
    return f"residual {1e3 * rms:.4g} mm RMS, noise {1e3 * noise:.4g} mm per coordinate ({how})"
