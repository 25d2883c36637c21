"""Errors of the tangent model that decide about outliers: weights by heavy tails, and leave-one-out errors.

The weights (process/tails.py) need the errors of the measurements, not the residuals of the fit, which are smaller.
The second moments of the errors under the posterior are exact:

    E[r r^T] = R mu mu^T R + R - R [(G + R)^-1]_ii R.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, nan

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.tangent_data import KEPT_COORDINATES, TangentData
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.quantiles import known
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.process.tails import Tails, gross_weights, reweight
from diffeo_calib.regression.regions import region_factor

BLOCK_COORDINATES = KEPT_COORDINATES
"""Measured coordinates of one block: a few hundred poses predict another pose nearly as well as thousands do."""
ROUNDS = 8
"""Largest number of steps of expectation maximisation."""
WEIGHT_CHANGE = 0.01
"""Largest relative change of a weight at which it has converged: gross errors make all weights small at first."""
SMALLEST_FREEDOM = 8.0
"""Lower bound of the degrees of freedom with which the data determine the scale of all variances."""


@dataclass(frozen=True)
class LeaveOneOut:
    """Errors of each configuration's measurement as predicted from all others of its block.

    Args:
        errors: (N, m) measured minus predicted, m; NaN where markers are hidden.
        squares: (N, bodies) squared distances in units of the predicted covariance, tails left out; NaN as well.
        effective: effective number of parameters, trace of G (G + R)^-1; None with several blocks, since no block
            is the whole fit.
        numbers: how many were measured; those of the errors by default. A pose has six, its three points nine errors.
    """

    errors: Tensor
    squares: Tensor
    effective: float | None
    numbers: int | None = None

    @property
    def count(self) -> int:
        """How many numbers were measured."""
        return len(known(self.errors)) if self.numbers is None else self.numbers

    def inflation(self, configurations: int) -> float:
        """Factor on all variances that accounts for estimating their scale from few data.

        With nu coordinates of ``configurations`` different configurations beyond the effective number of parameters
        (repeated poses add no information about the robot), the variances have an inverse chi-squared posterior with
        nu degrees of freedom. The 95 % region of three coordinates is then that of Student's t.
        """
        if self.effective is None:
            return 1.0
        per_row = self.count / len(self.errors)
        freedom = max(configurations * per_row - self.effective, SMALLEST_FREEDOM)
        return region_factor(freedom, 3)


def estimate_tails(
    data: TangentData,
    scales: Hyperparameters,
    seed: int = 0,
    *,
    rounds: int = ROUNDS,
    block_coordinates: int = BLOCK_COORDINATES,
) -> Tails:
    """Weights and degrees of freedom for given scales, by expectation maximisation from the weights of the data.

    Memory does not grow with the number of blocks. An outlier anywhere counts: no sample could stand for all rows.

    Args:
        data: the measurements. scales: held fixed. seed: draws the blocks.
        rounds: largest number of steps.
        block_coordinates: largest number of measured coordinates of a block.
    """
    data = data.told
    tails = data.tails
    for _ in range(rounds):
        squares = torch.empty_like(tails.weights)
        for rows, part in _parts(data, seed, block_coordinates):
            squares[rows] = _expected_squares(part, scales, tails.rows(rows))
        before, tails = tails, reweight(squares, data.noise_model.freedom)
        if _settled(before, tails):
            break
    return _among_gross(data, scales, tails, seed)


def _among_gross(data: TangentData, scales: Hyperparameters, tails: Tails, seed: int) -> Tails:
    """The weights beside gross rows, if left-out errors show any."""
    for _ in range(ROUNDS):
        weights = gross_weights(leave_one_out(data.with_tails(tails), scales, seed).squares, data.noise_model.freedom)
        if weights is None:
            break
        before, tails = tails, Tails(inf, weights, gross=True)
        if _settled(before, tails):
            break
    return tails


def _settled(before: Tails, after: Tails) -> bool:
    """Whether no weight has changed by far."""
    return float((after.weights / before.weights - 1.0).abs().max()) < WEIGHT_CHANGE


def leave_one_out(
    data: TangentData, scales: Hyperparameters, seed: int = 0, *, block_coordinates: int = BLOCK_COORDINATES
) -> LeaveOneOut:
    """Leave-one-out errors in closed form; arguments as of :func:`estimate_tails`."""
    told = data.told
    errors, squares = torch.empty_like(told.y), torch.empty_like(told.tails.weights)
    effective = []
    for rows, part in _parts(told, seed, block_coordinates):
        every = torch.arange(len(rows), device=rows.device)
        errors[rows], squares[rows] = left_out_rows(part, scales, every, part.noise(scales))
        inverse = part.numbers.diagonal_blocks(part.process(scales).inverse)
        own = part.numbers.blocks_of_table(part.weighted_noise(scales))
        noise = float(sum((one * block).sum() for one, block in zip(own, inverse, strict=True)))
        effective.append(part.coordinates - noise)
    errors = data.in_coordinates(errors).masked_fill(~data.visible, nan)
    return LeaveOneOut(errors, squares, effective[0] if len(effective) == 1 else None, told.coordinates)


def random_blocks(data: TangentData, seed: int, coordinates: int) -> list[Tensor]:
    """Row numbers of random blocks of about equal size, each with about ``coordinates`` coordinates at most."""
    n, m = data.y.shape
    count = -(-n * m // coordinates)
    order = torch.randperm(n, generator=seeded(seed), device=HOST)
    return list(order.to(data.y.device).tensor_split(count))


def _parts(data: TangentData, seed: int, coordinates: int) -> Iterator[tuple[Tensor, TangentData]]:
    """Row numbers and data of random blocks; a single one is the data themselves, with the matrices that they keep."""
    blocks = random_blocks(data, seed, coordinates)
    if len(blocks) == 1:
        yield torch.arange(len(data.x), device=data.x.device), data
    else:
        yield from ((rows, data.rows(rows)) for rows in blocks)


def _expected_squares(part: TangentData, scales: Hyperparameters, tails: Tails) -> Tensor:
    """Expected squared distances of the errors in units of the noise without tails: (N, bodies)."""
    part.expected(scales)  # the same for all weights
    data, numbers = part.with_tails(tails), part.numbers
    process, noise = data.process(scales), data.weighted_noise(scales)
    inverse = numbers.blocks_in_table(numbers.diagonal_blocks(process.inverse))
    residual = noise @ numbers.in_table(process.mu)[:, :, None]
    moments = residual @ residual.mT + noise - noise @ inverse @ noise
    return data.noise_model.squares(data.noise(scales), moments)


def left_out_rows(data: TangentData, scales: Hyperparameters, part: Tensor, new: Tensor) -> tuple[Tensor, Tensor]:
    """Errors (N, m) of rows predicted without their part, and their squared distances (N, bodies).

    Args:
        data: the measurements. scales: held fixed. part: (N,) that is left out with each row; negative for none: NaN.
        new: (N, m, m) noise of a new measurement like each row, whose predicted covariance is the unit of squares.
    """
    numbers, process, own = data.numbers, data.process(scales), data.weighted_noise(scales)
    errors, covariance = process.left_out(part[numbers.owner])
    errors = numbers.in_table(errors)
    predicted = numbers.blocks_in_table(numbers.diagonal_blocks(covariance)) - own + new
    predicted = torch.where(part[:, None, None] < 0, own, predicted)
    return errors, data.noise_model.squares(predicted, errors[:, :, None] * errors[:, None])
