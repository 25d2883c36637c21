"""Leave-one-out errors of the tangent model, and the weights of gross errors that follow from them.

Large data sets are split into random blocks, each with its own Cholesky factor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import nan

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.tangent_data import KEPT_COORDINATES, TangentData
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.quantiles import known
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.process.tails import Tails, reweight
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
    """Weights and gross errors for given scales, by expectation maximisation from the weights of the data.

    Args:
        data: the measurements. scales: held fixed. seed: draws the blocks.
        rounds: largest number of steps.
        block_coordinates: largest number of measured coordinates of a block.
    """
    data = data.told
    blocks, tails = list(_parts(data, seed, block_coordinates)), data.tails
    for _ in range(rounds):
        squares = torch.empty_like(tails.weights)
        for rows, part in blocks:
            squares[rows] = _squares(part, scales, tails.rows(rows))
        before, tails = tails, _reweighted(squares, data)
        if _settled(before, tails):
            break
    return tails


def tails_of_many(data: TangentData, scales: Hyperparameters, seed: int = 0) -> Tails:
    """The same for many rows, one block at a time, so that memory does not grow with the number of blocks.

    Each block finds its own weights, and the errors with those decide. An outlier anywhere counts: no sample could
    stand for all rows.
    """
    data = data.told
    squares = torch.empty_like(data.tails.weights)
    for rows in random_blocks(data, seed, BLOCK_COORDINATES):
        part = data.rows(rows)
        tails = part.tails
        for _ in range(ROUNDS):
            squares[rows] = _squares(part, scales, tails)
            before, tails = tails, _reweighted(squares[rows], part)
            if _settled(before, tails):
                break
    return _reweighted(squares, data)


def _reweighted(squares: Tensor, data: TangentData) -> Tails:
    """Weights of left-out errors; every kind of device has gross errors of its own."""
    return reweight(squares, data.noise_model.freedom, kinds=data.noise_model.kinds)


def _squares(part: TangentData, scales: Hyperparameters, tails: Tails) -> Tensor:
    """Squared left-out errors with these weights, in units of what is predicted for a good measurement: (N, bodies).

    Squares of the errors under the posterior would not do: they hold the fields' own uncertainty, so that a row that
    once weighs little goes on looking gross.
    """
    part.expected(scales)  # the same for all weights
    return _left_out(part.with_tails(tails), scales)[1]


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
        errors[rows], squares[rows], number = _left_out(part, scales)
        effective.append(number)
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


def _left_out(data: TangentData, scales: Hyperparameters) -> tuple[Tensor, Tensor, float]:
    """Leave-one-out errors (N, m), their squared distances (N, bodies), effective number of parameters."""
    numbers, process, noise = data.numbers, data.process(scales), data.weighted_noise(scales)
    blocks, own = numbers.diagonal_blocks(process.inverse), numbers.blocks_of_table(noise)
    covariance = numbers.blocks_in_table([torch.linalg.inv(block) for block in blocks])  # with the row's own noise
    error = covariance @ numbers.in_table(process.mu)[:, :, None]
    effective = len(process.mu) - float(sum((one * block).sum() for one, block in zip(own, blocks, strict=True)))
    squares = data.noise_model.squares(covariance - noise + data.noise(scales), error @ error.mT)
    return error[:, :, 0], squares, effective
