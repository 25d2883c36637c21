"""Choose the scales: maximal marginal likelihood of the tangent model, times a weak log-normal prior.

Amplitudes that the data do not support shrink: towards zero the prior is wider. The search climbs from a
few starts on a subset of the poses; a failed factorisation is a rejected step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log, pi

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.calibration.scales.hyperparameters import MESHING, Hyperparameters
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.threads import torch_alone
from diffeo_calib.fitting.result import Progress, silent

SUBSET_POSES, SUBSET_COORDINATES = 150, 900
"""What the likelihood looks at, at most."""
ITERATIONS = 40
"""Of the optimiser."""
FIRST_ITERATIONS, FIRST_COORDINATES = (15, 60), 450
"""The same from each of several starts: 20 with so many coordinates, more with fewer, which cost less and have
more local optima."""
LENGTH_WIDTH = 1.0
"""Standard deviation of the log-normal prior of length scales and noise, e-folds."""
GROWTH_WIDTH, SHRINK_WIDTH = 1.0, 2.0
"""The same of amplitudes, above and below their defaults."""
BOUND = 9.0
"""Bound on the logarithm of a scale against its default."""
TRANSMISSION_STARTS = (MESHING, 0.7)
"""Length scales (rad on a circle) of the transmission kernels from which the likelihood is climbed:
meshing of a reduction gear (tens of periods per turn) and eccentricity (one)."""


@dataclass(frozen=True)
class Selection:
    """Scales and where they come from.

    Args:
        scales: the scales.
        status: a sentence about the choice.
        interrupted: whether Ctrl-C ended the search.
        likelihood: log marginal likelihood of the rows that were looked at; None if nothing was selected.
    """

    scales: Hyperparameters
    status: str
    interrupted: bool = False
    likelihood: float | None = None


def select(
    centre: Hyperparameters,
    evidence: TangentData,
    *,
    start: Hyperparameters | None = None,
    iterations: int = ITERATIONS,
    seed: int = 0,
    progress: Progress = silent,
) -> Selection:
    """Maximise the marginal likelihood, times the prior, over all scales.

    Args:
        centre: centre of the prior: the defaults.
        evidence: the measurements.
        start: where to climb from, to the top; otherwise a shorter climb from the defaults with each of several
            transmission length scales.
        iterations: at most, from ``start``.
        seed: draws the subset of poses.
        progress: called as ``progress(task, done, total)``.

    Returns:
        the best scales met; Ctrl-C ends the search early.
    """
    _, some = evidence.sample(SUBSET_POSES, SUBSET_COORDINATES, seed)
    search = _Search(centre, some, progress)
    try:
        if start is not None:
            search.best = start  # until a better one is met
            search.climb(start, iterations)
        else:
            for scale in TRANSMISSION_STARTS:
                search.climb(_with_transmission(centre, scale), search.first_iterations)
    except KeyboardInterrupt:
        return Selection(search.best, "search interrupted, the best so far are kept", interrupted=True)
    status = f"log marginal likelihood {search.best_likelihood:.1f} on {search.rows} poses"
    return Selection(search.best, status, likelihood=search.best_likelihood)


def _with_transmission(scales: Hyperparameters, lengthscale: float) -> Hyperparameters:
    factor = lengthscale / MESHING
    return replace(scales, transmission_lengthscale=scales.transmission_lengthscale * factor)


class _Search:
    """Likelihood times prior as a function of the scales' logarithms, and the best point met."""

    def __init__(self, centre: Hyperparameters, evidence: TangentData, progress: Progress) -> None:
        self.centre, self.progress = centre, progress
        self.best, self.best_value, self.best_likelihood = centre, -float("inf"), -float("inf")
        self.model, self.rows = evidence.linearised(), len(evidence.x)
        self.origin = centre.logarithms()
        shrinks = centre.amplitudes()
        self.above = torch.where(shrinks, GROWTH_WIDTH, LENGTH_WIDTH)
        self.below = torch.where(shrinks, SHRINK_WIDTH, LENGTH_WIDTH)
        self.done, self.total = 0, ITERATIONS

    @property
    def first_iterations(self) -> int:
        """Iterations from each of several starts."""
        fewest, most = FIRST_ITERATIONS
        return int(min(max(20 * (FIRST_COORDINATES / self.model.target.numel()) ** 2, fewest), most))

    def climb(self, start: Hyperparameters, iterations: int) -> None:
        """Run the optimiser from one start."""
        from scipy.optimize import minimize  # noqa: PLC0415  # slow to import, not needed to use a model

        self.done, self.total = 0, iterations
        origin = self.origin.numpy()
        bounds = list(zip(origin - BOUND, origin + BOUND, strict=True))
        x0 = start.logarithms().numpy().clip(origin - BOUND, origin + BOUND)
        with torch_alone():
            minimize(self._objective, x0, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": iterations})

    def _objective(self, vector: np.ndarray) -> tuple[float, np.ndarray]:
        self.done = min(self.done + 1, self.total)
        self.progress("hyper-parameters", self.done, self.total)
        point = torch.tensor(vector, requires_grad=True)
        try:
            matrix = self.model.covariance(self.centre.from_logarithms(point.detach()))
        except InputError:  # the noise blocks alone are not positive definite in float64
            return 1e12, np.zeros_like(vector)
        likelihood, slope = log_likelihood(matrix, self.model.target.flatten())
        if slope is None:
            return 1e12, np.zeros_like(vector)  # rejected by the line search
        away = point - self.origin
        prior = -0.5 * (away / torch.where(away > 0, self.above, self.below)).square().sum()
        (self.model.inner(self.centre.from_logarithms(point), slope) + prior).backward()
        value = likelihood + float(prior.detach())
        if value > self.best_value:
            self.best_value, self.best_likelihood = value, likelihood
            self.best = self.centre.from_logarithms(point.detach())
        gradient = point.grad
        return -value, np.zeros_like(vector) if gradient is None else -gradient.numpy()


def log_likelihood(matrix: Tensor, target: Tensor) -> tuple[float, Tensor | None]:
    """log N(target; 0, matrix), and its derivative by the matrix, 1/2 (mu mu^T - matrix^-1).

    In closed form: automatic differentiation of the factorisation costs several times more. None for a matrix
    that is not positive definite in float64.
    """
    factor, info = torch.linalg.cholesky_ex(matrix)
    if int(info):
        return -float("inf"), None
    mu = torch.cholesky_solve(target[:, None], factor)[:, 0]
    value = -0.5 * float(target @ mu) - float(factor.diagonal().log().sum()) - 0.5 * len(target) * log(2 * pi)
    return value, 0.5 * (torch.outer(mu, mu) - torch.cholesky_inverse(factor))
