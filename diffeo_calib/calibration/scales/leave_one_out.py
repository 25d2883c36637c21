"""Errors of the tangent model that decide about outliers and about the size of regions.

Weights by heavy tails (regression/tails.py) need the errors of the measurements, not the residuals of the fit, which
are smaller. The second moments of the errors under the posterior are exact:

    E[r r^T] = R mu mu^T R + R - R [(G + R)^-1]_ii R.

Leave-one-out errors keep the scales fixed. There are some fifty scales; chosen on 30 poses they fit these very poses,
and leave-one-out errors look much smaller than errors of other poses. Where there are many rows, the scales were chosen
on a sample of them, and the leave-one-out errors of all other rows are those of new ones. Where there are few, they are
divided into folds, and the scales are selected again without each fold, from where they are. The squares

    d^2 = squared error of a body with k coordinates in units of its predicted covariance, that of a new row,

lead to the factor on all variances with which 95 % regions hold (regression/regions.py). Rows of one motion, and
repeats, help each other: they are left out together, and count as one.

Rows in sockets have a fold for each place. What decides about errors elsewhere, such as the size of the robot, shows
only by place: each place is one degree of freedom of the ratio, however many rows it has. Positions that were measured
beside them show it too, and add one for each configuration.

A machine with commanded poses is known by a field alone. With many rows its error is far below the noise of each, where
no row contradicts it. Neighbours share it: parts of the space are left out, and their errors judged along the few
directions in which these are the most uncertain, close to the means over the part.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import nan

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.selection import COORDINATES, POSES, select
from diffeo_calib.calibration.scales.tangent_data import KEPT_COORDINATES, TangentData
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.quantiles import chi2_median
from diffeo_calib.fitting.result import Progress, silent
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.regions import region_factor, region_scale
from diffeo_calib.regression.tails import Tails, estimated

BLOCK_COORDINATES = KEPT_COORDINATES
"""Measured coordinates of one block: a few hundred poses predict another pose nearly as well as thousands do."""
SMALLEST_FREEDOM = 8.0  # lower bound of the degrees of freedom with which the data determine the scale of all variances


@dataclass(frozen=True)
class LeaveOneOut:
    """Errors of each configuration's measurement as predicted from all others of its block."""

    errors: Tensor  # (N, m) measured minus predicted, m; NaN where markers are hidden
    squares: Tensor  # (N, bodies) squared distances in units of the predicted covariance, tails left out; NaN as well
    # effective number of parameters, trace of G (G + R)^-1; None with several blocks, since no block is the whole fit
    effective: float | None
    count: int  # how many numbers were measured: of a pose six, its three points have nine errors

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


def weighed(data: TangentData, scales: Hyperparameters, seed: int = 0) -> TangentData:
    """The measurements with the weights that outliers get with these scales, by expectation maximisation.

    Memory does not grow with the number of blocks. An outlier anywhere counts: no sample could stand for all rows.
    """

    def squares(tails: Tails, *, left_out: bool) -> Tensor:
        if left_out:
            return leave_one_out(data.with_tails(tails), scales, seed).squares
        averages = torch.empty_like(tails.weights)
        for rows, part in _parts(data, seed):
            part.expected(scales)  # the same for all weights
            now = part.with_tails(tails.rows(rows))
            process, noise = now.process(scales), now.weighted_noise(scales)
            inverse = now.blocks_in_coordinates(process.numbers.blocks(process.inverse))
            residual = noise @ now.in_coordinates(process.numbers.in_table(process.mu)[:, :, None])
            moments = residual @ residual.mT + noise - noise @ inverse @ noise
            averages[rows] = now.noise_model.squares(now.noise(scales), moments)
        return averages

    return data.with_tails(estimated(data.tails, data.noise_model.freedom, squares))


def leave_one_out(data: TangentData, scales: Hyperparameters, seed: int = 0) -> LeaveOneOut:
    """Leave-one-out errors in closed form."""
    errors, squares = torch.empty_like(data.y), torch.empty_like(data.tails.weights)
    effective, count = [], 0
    for rows, part in _parts(data, seed):
        every = torch.arange(len(rows), device=rows.device)
        errors[rows], squares[rows] = left_out_rows(part, scales, every, part.noise(scales))
        process = part.process(scales)
        noise = float((part.noise_of_numbers(scales) * process.numbers.blocks(process.inverse)).sum())
        effective.append(len(process.mu) - noise)
        count += len(process.mu)
    errors = errors.masked_fill(~data.visible, nan)
    return LeaveOneOut(errors, squares, effective[0] if len(effective) == 1 else None, count)


def variance_ratio(data: TangentData, left_out: LeaveOneOut) -> float:
    """Squared leave-one-out errors relative to what the scales predict: medians, since outliers are reported apart."""
    return float((left_out.squares / data.noise_model.of_freedom(chi2_median, left_out.squares)).nanmedian())


def _parts(data: TangentData, seed: int) -> Iterator[tuple[Tensor, TangentData]]:
    """Row numbers and data of random blocks of about equal size; a single one is the data, with what they keep."""
    count = -(-len(data.x) * data.size // BLOCK_COORDINATES)
    if count == 1:
        yield torch.arange(len(data.x), device=data.x.device), data
        return
    order = torch.randperm(len(data.x), generator=seeded(seed), device=HOST).to(data.x.device)
    yield from ((rows, data.rows(rows)) for rows in order.tensor_split(count))


def left_out_rows(data: TangentData, scales: Hyperparameters, part: Tensor, new: Tensor) -> tuple[Tensor, Tensor]:
    """Errors (N, m) of rows predicted without their part, and their squared distances (N, bodies).

    Args:
        data: the measurements. scales: held fixed. part: (N,) that is left out with each row; negative for none: NaN.
        new: (N, m, m) noise of a new measurement like each row, whose predicted covariance is the unit of squares.
    """
    process, noise = data.process(scales), data.weighted_noise(scales)
    errors, covariance = process.rows_left_out(part)
    errors = data.in_coordinates(errors[:, :, None])[:, :, 0]
    predicted = data.blocks_in_coordinates(covariance) - noise + new
    predicted = torch.where(part[:, None, None] < 0, noise, predicted)
    return errors, data.noise_model.squares(predicted, errors[:, :, None] * errors[:, None])


FEWEST_OUTSIDE = 100  # rows, or motions, outside of the sample on which scales were chosen from which these judge them
MOST_COORDINATES = 3000  # measured coordinates of a random part that stands for all rows where there are more
FOLDS, ITERATIONS = 5, 10
"""Number of folds, at most one for each configuration; iterations of the search for scales without a fold."""
NEAR = 0.2  # distance of consecutive rows, relative to that of any two, below which they belong to one motion
FEWEST_MOTIONS = 5  # below which repeats alone are left out together
OUTLIER_WEIGHT = 0.05  # of a row below which it is a gross error, which no region is meant to hold
FEWEST_PLACES = 2  # places that a single one counts as: without a second one nothing can be left out
HALVINGS, FEWEST_HALVED, PART_MODES = 5, 100, 3
"""How often the space of commanded poses is halved into parts that are left out, rows from which it is, and directions
in which the error of a part is judged."""


def cross_validated_inflation(
    centre: Hyperparameters | None,
    scales: Hyperparameters,
    data: TangentData,
    groups: Tensor,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> float | None:
    """Factor on all variances with which 95 % regions hold rows outside of the fit, see above.

    Args:
        centre: default scales; None for scales of other robots, for which all rows are new.
        scales: the selected ones. data: the measurements.
        groups: (N,) a number for each configuration, the same for its repeats.
        seed: draws the folds, as it drew the sample on which the scales were selected.

    Returns:
        None if Ctrl-C ended the search.
    """
    chosen, _ = data.sample(POSES, COORDINATES, seed)
    new = torch.ones(len(data.x), dtype=torch.bool, device=data.x.device)
    new[chosen] = centre is None
    rows, data = data.sample(len(data.x), MOST_COORDINATES, seed)
    numbers, new = motions(data.x, groups[rows]), new[rows]
    if int(numbers.max()) + 1 < FEWEST_MOTIONS:
        numbers = groups[rows].unique(return_inverse=True)[1]
    if centre is None or len(numbers[new].unique()) >= FEWEST_OUTSIDE:
        part = torch.where(torch.isin(numbers, numbers[new]), numbers, -1)
        squares = left_out_rows(data, scales, part, data.noise_of_new_rows(scales))[1]
        squares[~new] = nan
    else:
        squares, folds = torch.full_like(data.tails.weights, nan), random_folds(numbers, FOLDS, seed)
        try:
            for done, (inside, rows) in enumerate(folds):
                progress("cross-validation", done, len(folds))
                again = select(centre, data.rows(inside), start=scales, seed=seed, iterations=ITERATIONS)
                if again.interrupted:
                    return None
                part = torch.where(torch.isin(numbers, numbers[rows]), numbers, -1)
                distances = left_out_rows(data, again.scales, part, data.noise_of_new_rows(again.scales))[1]
                squares[rows] = distances[rows]
        except KeyboardInterrupt:
            return None
    squares = squares.masked_fill(data.tails.weights < OUTLIER_WEIGHT, nan)
    judged = (~squares.isnan()).any(1)
    each = torch.bincount(numbers[judged], minlength=int(numbers.max()) + 1)[numbers].clamp(min=1)
    weights = (1.0 / (each * squares.shape[1]))[:, None].expand_as(squares)
    return region_scale(squares, data.noise_model.freedom, weights)


def inflation_by_places(
    data: TangentData, scales: Hyperparameters, place: Tensor, shared: Tensor, groups: Tensor
) -> float:
    """Inflation by rows in sockets, a fold for each place, scales kept.

    The ratio is that of the places. How uncertain it is follows from all that shows how large errors elsewhere are:
    each place is one degree of freedom, and so is each configuration that a device measured.

    Args:
        data: the measurements. scales: held fixed.
        place: (N,) number of each row's place, negative for rows that stay in all folds. shared: (N,) of what its
            coordinates share an unknown shift with: its socket.
        groups: (N,) a number for each configuration, the same for its repeats.
    """
    process = data.process(scales)
    owner = process.numbers.owner
    resting, errors = place >= 0, process.left_out(place[owner])[0]
    total = float((errors * process.mu).nansum())
    sockets = len(torch.stack([place, shared], 1)[resting].unique(dim=0))
    count = int(resting[owner].sum()) - 3 * sockets
    units = max(len(place[resting].unique()), FEWEST_PLACES) + len(groups[~resting].unique())
    return max(total / max(count, 1), 1.0) * region_factor(units, 3)


def inflation_by_parts(data: TangentData, scales: Hyperparameters, seed: int = 0) -> float:
    """Inflation of a field by parts of the space of inputs that are left out, scales kept; ``seed`` draws some rows."""
    data = data.sample(len(data.x), MOST_COORDINATES, seed)[1]
    process = data.process(scales)
    part = halved(data.x)[process.numbers.owner]
    errors, covariance = process.left_out(part)
    squares = list[Tensor]()
    for number in part.unique():
        at = (part == number).nonzero()[:, 0]
        values, modes = torch.linalg.eigh(covariance[at[:, None], at])
        squares.append(((modes.mT @ errors[at]).square() / values)[-PART_MODES:].mean())  # hidden rows have fewer
    return region_scale(PART_MODES * torch.stack(squares), PART_MODES)


def halved(x: Tensor) -> Tensor:
    """(N,) part of the space, 0 to 31, of inputs (N, n): halved along the widest one; repeats stay together."""
    scaled = (x - x.amin(0)) / (x.amax(0) - x.amin(0)).clamp(min=torch.finfo(x.dtype).tiny)
    part = torch.zeros(len(x), dtype=torch.int64, device=x.device)
    for _ in range(HALVINGS):
        for number in part.unique().flip(0):  # no new number is still to be halved
            at = (part == number).nonzero()[:, 0]
            along = scaled[at, (scaled[at].amax(0) - scaled[at].amin(0)).argmax()]
            part[at] = 2 * number + (along > along.median())
    return part


def random_folds(groups: Tensor, count: int, seed: int) -> list[tuple[Tensor, Tensor]]:
    """Row numbers outside and inside of each of at most ``count`` folds with about as many configurations.

    Args:
        groups: (N,) a number 0, 1, ... for each configuration.
    """
    configurations = int(groups.max()) + 1
    order = torch.randperm(configurations, generator=seeded(seed), device=HOST).to(groups.device)
    fold = order[groups] % count
    return [((fold != k).nonzero()[:, 0], (fold == k).nonzero()[:, 0]) for k in range(min(count, configurations))]


def motions(x: Tensor, groups: Tensor) -> Tensor:
    """(N,) number 0, 1, ... of the motion that each row belongs to: consecutive rows that are close, and repeats.

    Args:
        x: (N, n) configurations in their order. groups: (N,) a number for each configuration.
    """
    scaled = x / (0.5 * (x.amax(0) - x.amin(0))).clamp(min=torch.finfo(x.dtype).tiny)
    usual = (2.0 * (scaled - scaled.mean(0)).square().sum(1).mean()).sqrt()
    apart = (scaled[1:] - scaled[:-1]).norm(dim=1) >= NEAR * usual
    runs = torch.cat([apart.new_zeros(1), apart]).cumsum(0)
    labels, before = runs, torch.full_like(runs, -1)
    while not bool((labels == before).all()):
        before = labels
        for together in (groups, runs):
            lowest = labels.new_full((int(together.max()) + 1,), len(x))
            labels = lowest.scatter_reduce(0, together, labels, "amin")[together]
    return labels.unique(return_inverse=True)[1]
