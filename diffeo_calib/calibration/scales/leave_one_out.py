"""Outliers: heavy tails of the noise, estimated together with the tangent model, and leave-one-out errors.

The weights of Student's t (student.py) need the errors that the model leaves, not those it was fitted to:
their second moments under the posterior are exact,

    E[r r^T] = R mu mu^T R + R - R [(G + R)^-1]_ii R.

Large data sets are looked at in random blocks, each with its own Cholesky factor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.calibration.student_t import Tails, reweight
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.cholesky import factorise

BLOCK_COORDINATES = 1500
"""Measured coordinates of one block: a few hundred poses predict one more nearly as well as thousands do."""
ROUNDS = 8
"""Steps of expectation maximisation at most."""
SETTLED = 0.01
"""Largest relative change of a weight at which it ends: gross errors make all weights small at first."""

FEWEST_FREEDOM = 8.0
"""Degrees of freedom that the scales are granted at least."""


@dataclass(frozen=True)
class LeaveOneOut:
    """What each configuration's measurement is predicted to be from all others (of its block).

    Args:
        errors: (N, m) measured minus predicted, m.
        squares: (N, bodies) squared distances in units of the predicted covariance, tails left out.
        effective: effective number of parameters, trace of G (G + R)^-1; None with several blocks, where it is not
            that of the whole fit.
    """

    errors: Tensor
    squares: Tensor
    effective: float | None

    def uncertainty(self, configurations: int) -> float:
        """Factor on variances, since their scales were estimated from the same few data.

        What is left of the coordinates of so many different configurations (repeats are no news of the robot) after
        the effective parameters, nu, has decided the scale of all variances: the
        95 % region of three coordinates is then that of Student's t (a Gaussian whose variance has an inverse
        chi-squared posterior with nu degrees of freedom), here as a Gaussian's with the same volume.
        """
        from scipy.stats import chi2, f  # noqa: PLC0415  # slow to import, not needed to use a model

        if self.effective is None:
            return 1.0
        freedom = max(configurations * self.errors.shape[1] - self.effective, FEWEST_FREEDOM)
        return float(3 * f.ppf(0.95, 3, freedom) / chi2.ppf(0.95, 3))


def estimate_tails(evidence: TangentData, scales: Hyperparameters, seed: int = 0) -> Tails:
    """Weights and degrees of freedom, the scales held fixed."""
    blocks = [(rows, _Block(part, scales)) for rows, part in _blocks(evidence, seed)]
    tails = evidence.tails
    for _ in range(ROUNDS):
        squares = torch.empty_like(tails.weights)
        for rows, block in blocks:
            squares[rows] = block.squares(tails.rows(rows))
        before, tails = tails, reweight(squares, evidence.sensor.freedom)
        if float((tails.weights / before.weights - 1.0).abs().max()) < SETTLED:
            break
    return tails


def leave_one_out(evidence: TangentData, scales: Hyperparameters, seed: int = 0) -> LeaveOneOut:
    """Leave-one-out errors in closed form."""
    errors, squares = torch.empty_like(evidence.y), torch.empty_like(evidence.tails.weights)
    effective = []
    for rows, part in _blocks(evidence, seed):
        errors[rows], squares[rows], number = _Block(part, scales).left_out(part.tails)
        effective.append(number)
    return LeaveOneOut(errors, squares, effective[0] if len(effective) == 1 else None)


def _blocks(evidence: TangentData, seed: int) -> Iterator[tuple[Tensor, TangentData]]:
    """Random blocks of about equal size that cover all rows."""
    n, m = evidence.y.shape
    count = -(-n * m // BLOCK_COORDINATES)
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    for rows in order.tensor_split(count):
        yield rows, evidence.rows(rows)


class _Block:
    """Everything about one block that does not depend on the weights."""

    def __init__(self, evidence: TangentData, scales: Hyperparameters) -> None:
        model = evidence.linearised()
        self.sensor, self.target = evidence.sensor, model.target
        self.noise, self.linearisation = model.noise(scales), model.linearisation(scales)
        self.gram = self.linearisation.gram()

    def _solved(self, tails: Tails) -> tuple[Tensor, Tensor, Tensor]:
        """R (N, m, m), mu (N, m) and [(G + R)^-1]_ii (N, m, m)."""
        noise = self.sensor.weighted(self.noise, tails)
        dense = factorise(self.linearisation, Noise(noise), self.gram)
        return noise, dense.mu(self.target), dense.inverse_blocks(len(noise))

    def squares(self, tails: Tails) -> Tensor:
        """Expected squared distances of the errors in units of the noise without tails: (N, bodies)."""
        noise, mu, inverse = self._solved(tails)
        residual = noise @ mu[:, :, None]
        moments = residual @ residual.mT + noise - noise @ inverse @ noise
        return self.sensor.squares(self.noise, moments)

    def left_out(self, tails: Tails) -> tuple[Tensor, Tensor, float]:
        """Leave-one-out errors (N, m), their squared distances (N, bodies), effective number of parameters."""
        noise, mu, inverse = self._solved(tails)
        covariance = torch.linalg.inv(inverse)  # of the prediction, with this row's own inflated noise
        error = covariance @ mu[:, :, None]
        predicted = covariance - noise + self.noise
        effective = mu.numel() - float((noise * inverse).sum())
        return error[:, :, 0], self.sensor.squares(predicted, error @ error.mT), effective
