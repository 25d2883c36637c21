"""Find geometric errors, devices and what rows share: all parameters of a :class:`Geometry` by maximum a posteriori,

    min over theta, c   sum_ib |e_ib(theta, c)|^2 / sigma_k^2 + sum_j (theta_j / s_j)^2 + |c|^2,

e_ib the errors of body b of row i, such as of a marker, whose rows are of kind k with noise sigma_k, s_j the standard
deviation of the Gaussian prior of parameter j. The prior makes the problem regular whatever the poses are. What rows of
a kind share has the prior c ~ N(0, 1): increments of devices of readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, sqrt
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.threads import torch_alone
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.regression.tails import Tails, reweight
from diffeo_calib.robots.cartesian import is_cartesian, turns_nowhere
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.devices import Devices

SMALLEST_NOISE_M = 1e-6  # lower bound of the noise; no device that measures a robot resolves less
ROUNDS, NOISE_CHANGE = 10, 3e-3
"""Most rounds of estimation, and the relative change of the noise at which they have converged."""
SMALLEST_PRIOR, LARGEST_PRIOR = 1e-5, 0.1  # range of estimated prior deviations, m or rad
SHARED_NUMBERS = 3.0
"""Numbers as which the noise of all kinds counts for that of one, in logarithms: of a few rows nothing may be left."""
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
    rms: float  # root mean square error of a body, such as the distance of a marker, over rows of all kinds [m]
    noise: float  # standard deviation of one measured number, given or estimated [m]; for Student's t its scale
    # (K, K) posterior covariance of the parameters at ``geometry`` [m, rad]; rows of parameters that were held fixed
    # are zero
    covariance: Tensor
    theta: Tensor  # (K,) estimated parameters of the geometry that the search started from [m, rad]
    prior: Prior  # the prior, given or estimated
    # weights of the measurements of every kind of rows (N, B), 1 where they are hidden; all 1 if the noise was given
    # or is Gaussian
    weights: tuple[Tensor, ...]
    freedom: float = inf  # of Student's t
    devices: tuple[Devices, ...] = ()  # those of readings, in the order of their tables

    @property
    def deviations(self) -> Tensor:
        """Posterior standard deviation of each of the K parameters [m or rad]."""
        return self.covariance.diagonal().clamp(min=0).sqrt()

    @property
    def tails(self) -> Tails:
        """Tails of the first kind of rows, such as those that tell coordinates."""
        return Tails(self.freedom, self.weights[0])


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


class KindRows(NamedTuple):
    """Rows of one kind: measured markers, the first of a geometry, or readings of its last points."""

    q: Tensor  # (N, n)
    y: Tensor  # (N, B, d) numbers of B bodies, m, NaN where hidden
    around: Devices | None = None  # of readings: those around which their places are sought
    device: Tensor = torch.zeros(0, dtype=torch.int64, device=HOST)  # (N,) numbers of these

    @classmethod
    def positions(cls, q: Tensor, points: Tensor) -> KindRows:
        """Measured markers (N, P, 3), m."""
        return cls(q.detach().cpu(), points.detach().cpu())

    @classmethod
    def read(cls, data: Readings, around: Devices) -> KindRows:
        return cls(data.q, around.values(data)[:, None], around, around.numbers(data))

    @property
    def freedom(self) -> int:
        """Number c of shifts of unit variance, those of devices."""
        return 0 if self.around is None else self.around.freedom

    def devices(self, shifts: Tensor) -> tuple[Devices, ...]:
        """The devices after shifts (c,)."""
        return () if self.around is None else (self.around.shifted(shifts),)

    def errors(self, points: Tensor, shifts: Tensor) -> Tensor:
        """Predicted minus measured numbers (N, B, d), m, for points (N, P', 3) and shifts (c,)."""
        for devices in self.devices(shifts):
            return devices.observation(self.device).value(devices.points_of(points))[:, None] - self.y
        return points[:, : self.y.shape[1]] - self.y

    def slopes(self, points: Tensor, by_errors: Tensor, shifts: Tensor) -> Tensor:
        """Their derivatives (N, B, d, f + c) by f errors that move points by (N, P', 3, f), then by the shifts."""
        for devices in self.devices(shifts):
            places = devices.points_of(points)
            by_points = devices.observation(self.device).slope(places)
            slopes = by_points @ by_errors[:, -devices.seen_points :].flatten(1, 2)
            return torch.cat([slopes, devices.shared(places, self.device)], 2)[:, None]
        return by_errors[:, : self.y.shape[1]]

    def sample(self) -> KindRows:
        """Random rows that stand for all of them, if there are many markers."""
        count = max(1, COORDINATES // self.y[0].numel())
        if self.around is not None or len(self.q) <= count:
            return self
        index = torch.randperm(len(self.q), generator=seeded(0), device=self.q.device)[:count].sort().values
        return KindRows(self.q[index], self.y[index])


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of several kinds, and the geometry that explains them."""

    geometry: Geometry  # the start
    parts: tuple[KindRows, ...]  # the rows of every kind

    @property
    def freedom(self) -> list[int]:
        """Number of shifts of every part."""
        return [part.freedom for part in self.parts]

    def errors(self, theta: Tensor, shifts: Tensor) -> list[Tensor]:
        """Predicted minus measured numbers (N, B, d) of every part, m."""
        each = zip(self.parts, shifts.split(self.freedom), strict=True)
        return [part.errors(self.geometry.points(part.q, theta), some) for part, some in each]

    def slopes(self, theta: Tensor, shifts: Tensor, root: Tensor) -> list[Tensor]:
        """Derivatives of all numbers by the unknowns u (f,), theta = root u, then by all shifts."""
        sizes, blocks, f = self.freedom, [], root.shape[1]
        for place, (part, some) in enumerate(zip(self.parts, shifts.split(sizes), strict=True)):
            by_errors = self.geometry.sensitivities(part.q, theta) @ root  # (N, P, 3, f) of the markers
            slopes = part.slopes(self.geometry.points(part.q, theta), by_errors, some)
            around = sum(sizes[:place]), sum(sizes[place + 1 :])
            blocks.append(torch.cat([slopes[..., :f], torch.nn.functional.pad(slopes[..., f:], around)], 3))
        return blocks

    def found(self, fit: Fit, noise: float, prior: Prior, tails: Tails) -> Identification:
        """A fit to some of the rows, with the errors and weights (M,) of all of them."""
        errors, shifts = self.errors(fit.theta, fit.shifts), fit.shifts.split(self.freedom)
        return Identification(
            geometry=self.geometry.absorb(fit.theta),
            rms=float(body_squares(errors).nanmean().sqrt()),
            noise=noise,
            covariance=fit.covariance,
            theta=fit.theta,
            prior=prior,
            weights=tuple(_as_bodies(tails.weights, errors)),
            freedom=tails.freedom,
            devices=tuple(each for part, some in zip(self.parts, shifts, strict=True) for each in part.devices(some)),
        )


def body_squares(errors: Sequence[Tensor]) -> Tensor:
    """Squares (M,) of errors (N, B, d) of all bodies of several kinds of rows; NaN where hidden."""
    return torch.cat([part.square().sum(2).flatten() for part in errors])


def sizes_and_kinds(errors: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Numbers d (M,) of all bodies, and (M,) of which kind of rows each is."""
    sizes = [part[..., 0].numel() for part in errors]
    counts = torch.tensor(sizes, dtype=torch.int64, device=errors[0].device)
    kind = torch.arange(len(errors), device=errors[0].device).repeat_interleave(counts)
    return errors[0].new_tensor([part.shape[2] for part in errors])[kind], kind


def typical_noise(errors: Sequence[Tensor]) -> Tensor:
    """Noise (k,) of every kind of rows by the median of its errors (N, B, d), m: gross outliers do not set the level.

    The median of chi-squared is by Wilson and Hilferty.
    """
    medians = torch.stack([part.square().sum(2).nanmedian() for part in errors])
    dim = medians.new_tensor([part.shape[2] for part in errors])
    return (medians / (dim * (1.0 - 2.0 / (9.0 * dim)) ** 3)).sqrt().clamp(min=SMALLEST_NOISE_M)


def identify(
    geometry: Geometry, q: Tensor, points: Tensor, noise: float | None = None, prior: Prior | None = None
) -> Identification:
    """Find all 6 + 6 n_all + 3 P parameters of a geometry, starting from the given one (usually from ``register``).

    Args:
        geometry: the start, and the centre of the prior. q: (N, n) joint values [rad or m].
        points: (N, P, 3) measured markers [m]; NaN where they are hidden.
        noise: standard deviation of one coordinate [m]; by default it is estimated, see :func:`estimated`.
        prior: see :class:`Prior`; with ``noise`` but without ``prior``, its defaults.
    """
    rows, held = Rows(geometry, (KindRows.positions(q, points),)), held_parameters(geometry)
    if noise is None:
        return estimated(rows, held, prior)
    used, sigma = prior or Prior(), points.new_full((points[..., 0].numel(),), noise)
    fit = solve(rows, sigma, used.root(geometry, held), **PRECISE)
    return rows.found(fit, noise, used, Tails(inf, torch.ones_like(sigma)))


def estimated(rows: Rows, held: Sequence[int], prior: Prior | None = None) -> Identification:
    """Parameters and what rows share, with noise levels, by expectation maximisation.

    Noise is that of Student's t, so that outliers lose their influence, of a scale for every kind of rows. Without
    ``prior`` the prior deviations of the joints' errors are estimated too. Of many rows that tell coordinates a random
    sample of some thousands is used.

    Args:
        rows: of any kinds. held: numbers of parameters that stay zero; see :func:`held_parameters`.

    Note:
        Cost: some ten singular value decompositions of a matrix of as many rows as there are numbers and unknowns.
    """
    some = replace(rows, parts=tuple(part.sample() for part in rows.parts))
    used, zero = prior or Prior(), rows.geometry.tool.new_zeros(rows.geometry.size)
    at = zero, zero.new_zeros(sum(rows.freedom))
    errors = some.errors(*at)
    (dim, kind), noise = sizes_and_kinds(errors), 0.0
    sigma = typical_noise(errors)[kind]
    tails = reweight(body_squares(errors) / sigma.square(), dim)
    for _ in range(ROUNDS):
        root = used.root(rows.geometry, held)
        fit = solve(some, sigma / tails.weights.sqrt(), root, start=at, **PRECISE)
        at = fit.theta, fit.shifts
        used = used if prior else _scaled(used, root, rows.geometry, fit)
        squares, none = body_squares(fit.errors), dim.new_zeros(len(fit.errors))
        free = none.index_add(0, kind, dim.masked_fill(squares.isnan(), 0.0) - fit.leverage)  # not determined by rows
        total = none.index_add(0, kind, (tails.weights * squares).nan_to_num(0.0))
        noise = max(sqrt(float(total.sum()) / max(float(free.sum()), 1.0)), SMALLEST_NOISE_M)
        free = free.clamp(min=1.0)
        alone, shared = (total / free).sqrt().clamp(min=SMALLEST_NOISE_M), SHARED_NUMBERS * (len(none) > 1)
        levels = alone * (noise / alone) ** (shared / (free + shared))
        before, sigma = sigma, levels[kind]
        tails = reweight(squares / sigma.square() + fit.leverage / tails.weights, dim)
        if float(((sigma - before).abs() / sigma).max()) < NOISE_CHANGE:
            break
    if any(part is not whole for part, whole in zip(some.parts, rows.parts, strict=True)):
        errors = rows.errors(*at)
        (dim, kind) = sizes_and_kinds(errors)
        tails = reweight(body_squares(errors) / levels[kind].square(), dim)
    return rows.found(fit, noise, used, tails)


def _scaled(prior: Prior, root: Tensor, geometry: Geometry, fit: Fit) -> Prior:
    """Deviations of the joints' errors that maximise the expected likelihood of the parameters (M step)."""
    squares, free = fit.theta.square() + fit.covariance.diagonal(), (root > 0).any(1).to(root)
    parts = ((part * free)[geometry.slices["joints"]] for part in (squares, torch.ones_like(squares)))
    total, count = (part.view(-1, 2, 3).sum(dim=(0, 2)) for part in parts)
    deviations = (total / count.clamp(min=1.0)).sqrt()
    translation, rotation = deviations.clamp(SMALLEST_PRIOR, LARGEST_PRIOR).tolist()
    return replace(prior, translation=translation, rotation=rotation)


class Fit(NamedTuple):
    """One least-squares fit."""

    theta: Tensor  # (K,) errors
    covariance: Tensor  # (K, K)
    shifts: Tensor  # (c,) of all parts
    errors: list[Tensor]  # (N, B, d) of every part, m
    leverage: Tensor  # (M,) of all bodies


def solve(
    rows: Rows, sigma: Tensor, root: Tensor, *, start: tuple[Tensor, Tensor] | None = None, **options: Any
) -> Fit:
    """Fit errors theta = root u, and shifts: the prior is then one row of the identity per unknown without units.

    Args:
        rows: see :class:`Rows`. sigma: (M,) standard deviations of all bodies, m.
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
    hidden = [part.isnan() for part in rows.errors(root @ u0[:f], u0[f:])]
    weights = _as_bodies(1 / sigma, hidden)
    size = len(u0) + sum(part.numel() for part in hidden)

    def residual(u: np.ndarray) -> np.ndarray:
        at = torch.from_numpy(u).clone()
        try:
            each = zip(weights, rows.errors(root @ at[:f], at[f:]), hidden, strict=True)
        except InputError:  # behind a camera: scipy shortens the step
            return np.full(size, np.inf)
        return torch.cat([*((w[..., None] * part).masked_fill(h, 0.0).flatten() for w, part, h in each), at]).numpy()

    def jacobian(u: np.ndarray) -> np.ndarray:
        at = torch.from_numpy(u).clone()
        return _white_slopes(rows, sigma, root, (root @ at[:f], at[f:])).numpy()

    derivatives: Any = jacobian  # scipy's stubs know its names of difference schemes only
    with torch_alone():
        solution = least_squares(residual, u0.numpy(), derivatives, **options)
    u = torch.from_numpy(solution.x).clone()  # aligned: the same digits every time
    return posterior(rows, sigma, root, (root @ u[:f], u[f:]))


def _as_bodies(values: Tensor, errors: Sequence[Tensor]) -> list[Tensor]:
    """Values (M,) of all bodies as (N, B) of those with errors (N, B, d)."""
    each = values.split([part[..., 0].numel() for part in errors])
    return [part.view(like.shape[:2]) for part, like in zip(each, errors, strict=True)]


def _white_slopes(rows: Rows, sigma: Tensor, root: Tensor, at: tuple[Tensor, Tensor]) -> Tensor:
    """Slopes of all numbers in units of their noise by unknowns u and shifts, with the prior's rows; zero if hidden."""
    errors, slopes = rows.errors(*at), rows.slopes(*at, root)
    each = zip(_as_bodies(sigma, errors), errors, slopes, strict=True)
    white = [(slope / s[..., None, None]).masked_fill(e.isnan()[..., None], 0.0).flatten(0, 2) for s, e, slope in each]
    return torch.cat([*white, torch.eye(white[0].shape[1], dtype=root.dtype, device=root.device)])


def posterior(rows: Rows, sigma: Tensor, root: Tensor, at: tuple[Tensor, Tensor]) -> Fit:
    """What is known at theta and shifts; arguments as of :func:`solve`."""
    white, f, errors = _white_slopes(rows, sigma, root, at), root.shape[1], rows.errors(*at)
    with torch_alone():
        U, s, Vt = np.linalg.svd(white.numpy(), full_matrices=False)  # s >= 1 by the prior rows
    factor = root @ torch.from_numpy(Vt.T / s).clone()[:f]
    leverage = torch.from_numpy(np.square(U[: -white.shape[1]]).sum(1)).split([part.numel() for part in errors])
    each = [part.view(like.shape).sum(2).flatten() for part, like in zip(leverage, errors, strict=True)]
    return Fit(at[0], factor @ factor.mT, at[1], errors, torch.cat(each))


def described(rows: Rows, noise: Sequence[float] = (), *, adrift: bool = False) -> Identification:
    """Base, markers and devices that were found in closed form, as a geometric calibration is; all weights are 1.

    Args:
        rows: around these places. noise: of the first kinds of rows, m; by default the typical one of its errors.
        adrift: whether the base was not sought.
    """
    geometry, zero = rows.geometry, rows.geometry.tool.new_zeros(rows.geometry.size)
    joints, held = range(geometry.size)[geometry.slices["joints"]], held_parameters(geometry, adrift=adrift)
    places = {"base_translation": PLACES.open_base_m, "base_rotation": PLACES.open_base_rad}
    root = Prior(**places, tool=sqrt(geometry.markers) * PLACES.marker_m).root(geometry, [*joints, *held])
    at = zero, zero.new_zeros(sum(rows.freedom))
    errors = rows.errors(*at)
    levels = torch.cat([zero.new_tensor(noise), typical_noise(errors)[len(noise) :]])
    counts = levels.new_tensor([int((~part.isnan()).all(2).sum()) for part in errors])
    # The errors of a nominal robot vary slowly with its configuration, so that many rows share them.
    sigma = (levels.clamp(min=SMALLEST_NOISE_M) * counts.sqrt())[sizes_and_kinds(errors)[1]]
    fit = posterior(rows, sigma, root, at)
    return rows.found(fit, float(levels[0]), Prior(), Tails(inf, torch.ones_like(sigma)))
