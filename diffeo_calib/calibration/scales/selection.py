"""Choose the scales: maximal marginal likelihood of the tangent model, times a weak log-normal prior.

Amplitudes that the data do not support shrink: towards zero the prior is wider. The search climbs from a
few starts on a subset of the poses; a failed factorisation is a rejected step.

Default scales: the residual of the geometric calibration, divided by the lever arms of the joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Prior
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import NumericalError
from diffeo_calib.common.threads import torch_alone
from diffeo_calib.fitting.result import Progress, silent
from diffeo_calib.process.scales import JOINT_SCALES, SENSOR_SHARE, Hyperparameters
from diffeo_calib.regression.cholesky import Factor
from diffeo_calib.robots.cartesian import is_cartesian

MESHING_LENGTHSCALE_RAD = 0.22
"""Default length scale of the transmission kernels on a circle: meshing of a reduction gear."""
TRANSMISSION_STARTS_RAD = (MESHING_LENGTHSCALE_RAD, 0.7)
"""Length scales of the transmission kernels on a circle from which the search starts: meshing of a reduction gear
(tens of periods per turn) and eccentricity (one)."""
OBJECTIVE_OF_FAILURE = 1e12  # objective where G + R cannot be factorised: the line search then shortens its step
LARGEST_GAIN = 1e5
"""Variance by an unknown, relative to that of the fields and the noise, up to which it costs no digits among them; a
factor of its own for all unknowns would take half as long again."""


POSES, COORDINATES = 150, 900  # largest number of poses, and of measured coordinates, in the likelihood
ITERATIONS = 40  # of the optimiser from a given start, at most
FIRST, FEWEST_FIRST, MOST_FIRST, FIRST_COORDINATES = 20, 15, 60, 450
"""Iterations from each of several starts with so many measured coordinates, at least, and at most: fewer coordinates
cost less per iteration and have more local optima, and get more iterations."""
LOG_RANGE = 9.0  # bound on the logarithm of a scale relative to its default

LENGTH, GROWTH, SHRINKAGE = 1.0, 1.0, 2.0
"""Log-normal prior of the scales around their defaults, standard deviations in e-folds: of length scales and noise, of
amplitudes above their defaults, and of those below."""
AXES = 0.3
"""Standard deviation of each axis of commanded poses or places around the mean of the slides, or of the turns.
The axes of such a frame are a choice: fields look alike along all of them unless the rows say otherwise. Scales
that were free for each axis would fit 20 poses too well, and the regions of a hand-eye transform would hold 0.90
for 0.95."""
SHORT = 0.3  # of the default length scales and noise


@dataclass(frozen=True)
class Selection:
    """Scales and how they were chosen."""

    scales: Hyperparameters  # the scales
    status: str  # a sentence about the choice
    interrupted: bool = False  # whether Ctrl-C ended the search


def select(
    centre: Hyperparameters,
    data: TangentData,
    *,
    start: Hyperparameters | None = None,
    seed: int = 0,
    iterations: int | None = None,
    progress: Progress = silent,
) -> Selection:
    """Maximise the marginal likelihood, times the prior, over all scales.

    Args:
        centre: centre of the prior: the defaults.
        data: the measurements.
        start: where the search starts; by default it makes shorter searches from the defaults with each of several
            transmission length scales, and of commanded poses or places from short waves and little noise.
        iterations: of the optimiser from every start; by default as many as the number of coordinates allows.

    Returns:
        the best scales that were evaluated; Ctrl-C ends the search early.
    """
    subset = data.sample(POSES, COORDINATES, seed)[1].trusted(0.5 * data.tails.gross)  # likely good ones
    search = _Search(centre, subset, progress)
    try:
        if start is not None:
            search.best = start  # until better scales are found
            search.climb([start], iterations or ITERATIONS)
        else:
            usual = centre.transmission_lengthscale
            factors = [length / MESHING_LENGTHSCALE_RAD for length in TRANSMISSION_STARTS_RAD]
            starts = [replace(centre, transmission_lengthscale=usual * factor) for factor in factors]
            if is_cartesian(data.nominal.geometry.chain):  # from the others, short waves look like noise
                lengths = {"coupled_lengthscale": SHORT * centre.coupled_lengthscale}
                noise = {"joint_noise": SHORT * centre.joint_noise, "sensor_noise": SHORT * centre.sensor_noise}
                starts.append(replace(centre, **lengths, **noise))
            wanted = int(FIRST * (FIRST_COORDINATES / subset.y.numel()) ** 2)
            search.climb(starts, iterations or min(max(wanted, FEWEST_FIRST), MOST_FIRST))
    except KeyboardInterrupt:
        return Selection(search.best, "search interrupted, the best so far are kept", interrupted=True)
    status = f"log marginal likelihood {search.best_likelihood:.1f} on {len(subset.x)} poses"
    return Selection(search.best, status)


class LogPosterior(NamedTuple):
    """Log marginal likelihood of what was measured, log prior density up to a constant, and gradient of their sum."""

    likelihood: float
    prior: float
    gradient: Tensor


def log_posterior(logarithms: Tensor, centre: Hyperparameters, data: TangentData) -> LogPosterior | None:
    """Log posterior density of scales given by their logarithms, and its gradient by these.

    Returns:
        None where G + R is not positive definite in float64.
    """
    numbers, pairs, point = data.numbers(centre), data.pairs, logarithms.detach().clone().requires_grad_()
    with torch.enable_grad():
        scales = centre.from_logarithms(point)
        noise = data.noise_of_numbers(scales)
        variance, values = data.unknowns_variance(scales), pairs.values(scales)
    F, S = numbers.with_noise(pairs.matrix(values), noise.detach()), numbers.S
    wide = variance.detach() * S.square().amax(0) > LARGEST_GAIN * F.diagonal().min()
    narrow, S = S[:, ~wide], S[:, wide]
    F, root = F.addmm_(narrow * variance.detach()[~wide], narrow.T), variance.detach()[wide].sqrt()
    try:
        factor = Factor.of(F, S * root)
    except NumericalError:
        return None
    mu = factor.solve(numbers.target[:, None])[:, 0]
    slope = factor.inverse.addr_(mu, mu, beta=-0.5, alpha=0.5)  # of the likelihood by F + R, in closed form
    with torch.enable_grad():
        by_noise = (numbers.blocks(slope) * noise).sum()
        explained = (root * (S.T @ mu)).square() - 1.0 + torch.cholesky_inverse(factor.B).diagonal()
        by_unknowns = 0.5 * explained @ variance[wide].log() + ((slope @ narrow) * narrow).sum(0) @ variance[~wide]
        away, amplitudes = point - centre.logarithms(), centre.amplitudes()
        means = _means(centre, data)
        mean = means @ away
        widths = torch.where(amplitudes, torch.where(mean.detach() > 0, GROWTH, SHRINKAGE), LENGTH)
        density = -0.5 * (means.diagonal() @ (mean / widths).square() + ((away - mean) / AXES).square().sum())
        (pairs.inner(values, numbers.square(slope)) + by_noise + by_unknowns + density).backward()
    gradient = torch.zeros_like(point) if point.grad is None else point.grad
    return LogPosterior(factor.log_density(numbers.target, mu), float(density.detach()), gradient)


def _means(centre: Hyperparameters, data: TangentData) -> Tensor:
    """(S, S) matrix of the means over scales that are alike: of slides, or turns, of commanded poses; else each."""
    chain = data.nominal.geometry.chain
    kinds = chain.periodic if is_cartesian(chain) else range(chain.n)
    return _means_of(tuple(kinds), tuple((name, getattr(centre, name).numel()) for name in centre.searched))


@cache
def _means_of(kinds: tuple[int, ...], sizes: tuple[tuple[str, int], ...]) -> Tensor:
    keys = [(name, kinds[k] if name in JOINT_SCALES else k) for name, size in sizes for k in range(size)]
    same = torch.tensor([[key == other for other in keys] for key in keys], dtype=torch.float64, device=HOST)
    return same / same.sum(1)


class _Search:
    """Climbs of the log posterior, and the best scales that were evaluated."""

    def __init__(self, centre: Hyperparameters, data: TangentData, progress: Progress) -> None:
        self.centre, self.data, self.progress = centre, data, progress
        self.best, self.best_value, self.best_likelihood = centre, -float("inf"), -float("inf")
        self.done = self.ends = self.total = 0

    def climb(self, starts: Sequence[Hyperparameters], iterations: int) -> None:
        """Run the optimiser from each start."""
        from scipy.optimize import minimize  # noqa: PLC0415  # slow to import, not needed to use a model

        origin, reach = self.centre.logarithms().numpy(), LOG_RANGE
        bounds = list(zip(origin - reach, origin + reach, strict=True))
        options, self.total = {"maxiter": iterations}, len(starts) * iterations
        for number, start in enumerate(starts):
            self.done, self.ends = number * iterations, (number + 1) * iterations
            x0 = start.logarithms().numpy().clip(origin - reach, origin + reach)
            with torch_alone():
                minimize(self._objective, x0, jac=True, method="L-BFGS-B", bounds=bounds, options=options)

    def _objective(self, vector: np.ndarray) -> tuple[float, np.ndarray]:
        """Minus the log posterior and its gradient, for scipy."""
        self.done = min(self.done + 1, self.ends)
        self.progress("hyper-parameters", self.done, self.total)
        point = torch.from_numpy(vector)
        posterior = log_posterior(point, self.centre, self.data)
        if posterior is None:
            return OBJECTIVE_OF_FAILURE, np.zeros_like(vector)
        value = posterior.likelihood + posterior.prior
        if value > self.best_value:
            self.best, self.best_value = self.centre.from_logarithms(point), value
            self.best_likelihood = posterior.likelihood
        return -value, -posterior.gradient.numpy()


LARGEST_AMPLITUDE_RATIO = 3.0
"""Largest default error amplitude of a joint, relative to the smallest of all joints. It bounds joints that have
hardly any lever arm in the data."""
SMALLEST_LOAD_RATIO = 0.05
"""Smallest effect of a family of gravity features, relative to the largest, that its default takes into account."""
SMALLEST_LEVER = 1e-12
SMALLEST_HALF_RANGE_M, SMALLEST_RATIO = 5e-3, 50.0
"""Of a slide's values, and in units of the noise: the encoder of one that stands still tells values apart that mean
nothing, and a field would fold a shorter kernel's space."""
SMALLEST_SPREAD_M = 1e-3  # of the markers
SMALLEST_LOAD_M = 1e-9  # displacement per unit coefficient


def defaults(data: TangentData, noise: float, prior: Prior) -> Hyperparameters:
    """Scales from the residual of the geometric calibration.

    Args:
        data: the measurements around the geometric calibration.
        noise: standard deviation of that calibration's residual per coordinate, m.
        prior: deviations of geometric errors that it estimated.
    """
    x = data.x
    lever = data.jacobian.square().mean((0, 1)).sqrt()  # (n,) per coordinate
    amplitude = noise / lever.clamp(min=SMALLEST_LEVER)
    amplitude = amplitude.clamp(max=LARGEST_AMPLITUDE_RATIO * float(amplitude.min()))
    # The metre is no natural unit of a slide: measure it in half-ranges, as a circle in radians.
    half_range = (0.5 * (x.amax(0) - x.amin(0))).clamp(min=max(SMALLEST_HALF_RANGE_M, SMALLEST_RATIO * noise))
    unit = torch.where(
        torch.tensor(data.space.periodic, dtype=torch.bool, device=x.device), torch.ones_like(half_range), half_range
    )
    points = data.points.reshape(-1, 3)
    size = max(float(points.std(0).norm()) if len(points) > 1 else 1.0, SMALLEST_SPREAD_M)  # m
    own, lateral = _load_effects(data)
    others = data.noise_model.kind_count - 1
    return Hyperparameters(
        transmission_lengthscale=MESHING_LENGTHSCALE_RAD * unit,
        transmission_amplitude=0.5 * amplitude,
        coupled_lengthscale=unit,
        coupled_amplitude=0.5 * amplitude,
        joint_noise=0.2 * amplitude,
        task_lengthscale=x.new_tensor(size),
        task_amplitude=x.new_tensor(0.2 * noise),
        sensor_noise=x.new_tensor(SENSOR_SHARE * noise),
        rotation_noise=x.new_tensor(SENSOR_SHARE * noise / size),
        translation_errors=x.new_tensor(prior.translation),
        rotation_errors=x.new_tensor(prior.rotation),
        compliance=0.3 * noise / own,
        lateral_compliance=0.1 * noise / lateral,
        gravity=x.new_ones(3),
        other_noise=x.new_full((others,), SENSOR_SHARE * noise) if others else None,
    )


def _load_effects(data: TangentData) -> tuple[Tensor, Tensor]:
    """RMS displacement per coordinate for unit coefficients of each joint, own and lateral compliance: (J,) each."""
    geometry, elasticity = data.nominal.geometry, data.nominal.elasticity
    nothing = data.x.new_zeros(geometry.chain.moving)
    if elasticity is None:
        return nothing + 1.0, nothing + 1.0
    squares = data.sensitivities[..., data.nominal.sag].square().mean((0, 1))  # (K,)
    effects = []
    for own in (True, False):
        of_this_kind = torch.where((elasticity.own == own) & ~elasticity.loaded, squares, 0.0)
        effect = nothing.index_add(0, elasticity.joints, of_this_kind).sqrt()
        effects.append(effect.clamp(min=max(SMALLEST_LOAD_RATIO * float(effect.max()), SMALLEST_LOAD_M)))
    return effects[0], effects[1]
