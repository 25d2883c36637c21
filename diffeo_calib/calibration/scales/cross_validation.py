"""Do the predicted deviations hold for rows that took no part in the choice of the scales?

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
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.differing_noise import noise_of_new_rows
from diffeo_calib.calibration.scales.leave_one_out import left_out_rows
from diffeo_calib.calibration.scales.selection import SEARCH_LIMITS, select
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.fitting.result import Progress, silent
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.regions import region_factor, region_scale


@dataclass(frozen=True)
class FoldLimits:
    """Size of the cross-validation.

    Args:
        outside: rows, or motions, outside of the sample on which scales were chosen from which these judge them.
        coordinates: measured coordinates of a random part that stands for all rows where there are more.
        folds: number of folds, at most one for each configuration.
        iterations: of the search for scales without a fold.
        near: distance of consecutive rows, relative to that of any two, below which they belong to one motion.
        fewest_motions: below which repeats alone are left out together.
        outlier_weight: of a row below which it is a gross error, which no region is meant to hold.
    """

    outside: int = 100
    coordinates: int = 3000
    folds: int = 5
    iterations: int = 10
    near: float = 0.2
    fewest_motions: int = 5
    outlier_weight: float = 0.05


LIMITS = FoldLimits()
FEWEST_PLACES = 2
"""Places that a single one counts as: without a second one nothing can be left out."""


def cross_validated_inflation(
    centre: Hyperparameters | None,
    scales: Hyperparameters,
    data: TangentData,
    groups: Tensor,
    *,
    seed: int = 0,
    limits: FoldLimits = LIMITS,
    progress: Progress = silent,
) -> float | None:
    """Factor on all variances with which 95 % regions hold rows outside of the fit, see above.

    Args:
        centre: default scales; None for scales of other robots, for which all rows are new.
        scales: the selected ones. data: the measurements.
        groups: (N,) a number for each configuration, the same for its repeats.
        seed: draws the folds, as it drew the sample on which the scales were selected.
        limits: size of the cross-validation.
        progress: called as ``progress(task, done, total)``.

    Returns:
        None if Ctrl-C ended the search.
    """
    chosen, _ = data.sample(SEARCH_LIMITS.poses, SEARCH_LIMITS.coordinates, seed)
    new = torch.ones(len(data.x), dtype=torch.bool, device=data.x.device)
    new[chosen] = centre is None
    rows, data = data.sample(len(data.x), limits.coordinates, seed)
    numbers, new = motions(data.x, groups[rows], limits), new[rows]
    if centre is None or len(numbers[new].unique()) >= limits.outside:
        squares = left_out_squares(data, scales, torch.where(torch.isin(numbers, numbers[new]), numbers, -1))
        squares[~new] = nan
    else:
        found = _squares_of_folds(centre, scales, data, numbers, seed=seed, limits=limits, progress=progress)
        if found is None:
            return None
        squares = found
    squares = squares.masked_fill(data.tails.weights < limits.outlier_weight, nan)
    seen = (~squares.isnan()).any(1)
    each = torch.bincount(numbers[seen], minlength=int(numbers.max()) + 1)[numbers].clamp(min=1)
    weights = (1.0 / (each * squares.shape[1]))[:, None].expand_as(squares)
    return region_scale(squares, data.noise_model.freedom, weights)


def _squares_of_folds(
    centre: Hyperparameters,
    scales: Hyperparameters,
    data: TangentData,
    numbers: Tensor,
    *,
    seed: int,
    limits: FoldLimits,
    progress: Progress,
) -> Tensor | None:
    """Squares (N, bodies) of all rows with scales that were selected without their fold; None after Ctrl-C."""
    search = replace(SEARCH_LIMITS, iterations=limits.iterations)
    squares, folds = torch.full_like(data.tails.weights, nan), random_folds(numbers, limits.folds, seed)
    try:
        for done, (inside, rows) in enumerate(folds):
            progress("cross-validation", done, len(folds))
            again = select(centre, data.rows(inside), start=scales, seed=seed, limits=search)
            if again.interrupted:
                return None
            part = torch.where(torch.isin(numbers, numbers[rows]), numbers, -1)
            squares[rows] = left_out_squares(data, again.scales, part)[rows]
    except KeyboardInterrupt:
        return None
    return squares


def inflation_by_places(
    data: TangentData, scales: Hyperparameters, place: Tensor, shared: Tensor, groups: Tensor
) -> float:
    """The same factor for rows in sockets, a fold for each place, scales kept.

    The ratio is that of the places. How uncertain it is follows from all that shows how large errors elsewhere are:
    each place is one degree of freedom, and so is each configuration that a device measured.

    Args:
        data: the measurements. scales: held fixed.
        place: (N,) number of each row's place, negative for rows that stay in all folds. shared: (N,) of what its
            coordinates share an unknown shift with: its socket.
        groups: (N,) a number for each configuration, the same for its repeats.
    """
    process, owner = data.process(scales), data.numbers.owner
    resting, errors = place >= 0, process.left_out(place[owner])[0]
    total = float((errors * process.mu).nansum())
    sockets = len(torch.stack([place, shared], 1)[resting].unique(dim=0))
    count = int(resting[owner].sum()) - 3 * sockets
    units = max(len(place[resting].unique()), FEWEST_PLACES) + len(groups[~resting].unique())
    return max(total / max(count, 1), 1.0) * region_factor(units, 3)


def random_folds(groups: Tensor, count: int, seed: int) -> list[tuple[Tensor, Tensor]]:
    """Row numbers outside and inside of each of at most ``count`` folds with about as many configurations.

    Args:
        groups: (N,) a number 0, 1, ... for each configuration.
    """
    configurations = int(groups.max()) + 1
    order = torch.randperm(configurations, generator=seeded(seed), device=HOST).to(groups.device)
    fold = order[groups] % count
    return [((fold != k).nonzero()[:, 0], (fold == k).nonzero()[:, 0]) for k in range(min(count, configurations))]


def motions(x: Tensor, groups: Tensor, limits: FoldLimits = LIMITS) -> Tensor:
    """(N,) number 0, 1, ... of the motion that each row belongs to: consecutive rows that are close, and repeats.

    Args:
        x: (N, n) configurations in their order. groups: (N,) a number for each configuration.
    """
    scaled = x / (0.5 * (x.amax(0) - x.amin(0))).clamp(min=torch.finfo(x.dtype).tiny)
    usual = (2.0 * (scaled - scaled.mean(0)).square().sum(1).mean()).sqrt()
    apart = (scaled[1:] - scaled[:-1]).norm(dim=1) >= limits.near * usual
    runs = torch.cat([apart.new_zeros(1), apart]).cumsum(0)
    labels, before = runs, torch.full_like(runs, -1)
    while not bool((labels == before).all()):
        before = labels
        for together in (groups, runs):
            lowest = labels.new_full((int(together.max()) + 1,), len(x))
            labels = lowest.scatter_reduce(0, together, labels, "amin")[together]
    found = labels.unique(return_inverse=True)[1]
    return found if int(found.max()) + 1 >= limits.fewest_motions else groups.unique(return_inverse=True)[1]


def left_out_squares(data: TangentData, scales: Hyperparameters, part: Tensor) -> Tensor:
    """Squared errors (N, bodies) of rows predicted without their part (N,), in units of those predicted for new rows.

    NaN for hidden markers, and for rows of no part.
    """
    return left_out_rows(data.told, scales, part, data.blocks_in_numbers(noise_of_new_rows(data, scales)))[1]
