"""Do the predicted deviations hold for poses that took no part in the choice of the scales?

Leave-one-out errors keep the scales fixed. There are some fifty scales; chosen on 30 poses they fit these very poses,
and leave-one-out errors look much smaller than errors of other poses. So the poses are divided into folds, the scales
are selected again without each fold, from where they are, and the fold is predicted with these scales:

    ratio = mean of d^2 / k,    d^2 = squared error of a body with k coordinates in units of its predicted covariance.

With many data the scales hardly depend on a fold, and to select them again would take long.

Rows in sockets have a fold for each place. What decides about errors elsewhere, such as the size of the robot, shows
only by place: each place is one degree of freedom of the ratio, however many rows it has. Positions that were measured
beside them show it too, and add one for each configuration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.scales.selection import SEARCH_LIMITS, select
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.calibration.student_t import region_factor
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.fitting.result import Progress, silent
from diffeo_calib.regression.conditional import diagonal_blocks


@dataclass(frozen=True)
class FoldLimits:
    """Size of the cross-validation.

    Args:
        coordinates: measured coordinates up to which it is worth its time: about six for each scale.
        folds: number of folds, at most one for each configuration.
        iterations: of the search for scales without a fold.
    """

    coordinates: int = 300
    folds: int = 5
    iterations: int = 10


LIMITS = FoldLimits()
FEWEST_PLACES = 2
"""Places that a single one counts as: without a second one nothing can be left out."""


def cross_validated_inflation(
    centre: Hyperparameters,
    scales: Hyperparameters,
    data: TangentData,
    groups: Tensor,
    *,
    seed: int = 0,
    limits: FoldLimits = LIMITS,
    progress: Progress = silent,
) -> float | None:
    """Factor on all variances with which 95 % regions hold poses outside of the fit.

    It is the ratio above, or one if that is less, widened as Student's t for the uncertainty of the ratio itself.
    Errors of one configuration are strongly correlated, so each counts as one degree of freedom. Rows with heavy tails
    count with their weights.

    Args:
        centre: default scales. scales: the selected ones. data: the measurements.
        groups: (N,) a number for each configuration: its repeats stay in one fold.
        seed: draws the folds.
        limits: size of the cross-validation.
        progress: called as ``progress(task, done, total)``.

    Returns:
        None if Ctrl-C ended the search.
    """
    search = replace(SEARCH_LIMITS, iterations=limits.iterations)
    total, folds = 0.0, random_folds(groups, limits.folds, seed)
    try:
        for done, (inside, rows) in enumerate(folds):
            progress("cross-validation", done, len(folds))
            again = select(centre, data.rows(inside), start=scales, seed=seed, limits=search)
            if again.interrupted:
                return None
            squares = left_out_squares(data, again.scales, rows)
            total += float((data.tails.weights[rows] * squares).nansum())
    except KeyboardInterrupt:
        return None
    ratio = total / data.measured_freedom
    return max(ratio, 1.0) * region_factor(int(groups.max()) + 1, 3)


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
    dense = data.factorised(scales)
    inverse, mu = dense.inverse, dense.mu(data.target)
    coordinates = torch.arange(mu.numel(), device=mu.device).view(mu.shape)
    total, count, places = 0.0, 0, place[place >= 0].unique()
    for number in places:
        rows = (place == number).nonzero()[:, 0]
        seen = data.visible[rows]
        index, errors = coordinates[rows][seen], mu[rows][seen]
        total += float(errors @ torch.linalg.solve(inverse[index][:, index], errors))
        count += len(index) - 3 * len(shared[rows].unique())
    units = max(len(places), FEWEST_PLACES) + len(groups[place < 0].unique())
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


def left_out_squares(data: TangentData, scales: Hyperparameters, rows: Tensor) -> Tensor:
    """Squared errors of some rows, predicted from all others, in units of their predicted covariance, tails left out.

    With A the block of (G + R)^-1 that belongs to the rows, their errors are A^-1 mu with the covariance A^-1.

    Args:
        data: the measurements. scales: held fixed. rows: (M,) row numbers.

    Returns:
        (M, bodies); NaN for hidden markers.
    """
    m, dense, part = data.y.shape[1], data.factorised(scales), data.rows(rows)
    index = (rows[:, None] * m + torch.arange(m, device=rows.device)).flatten()
    covariance = torch.linalg.inv(dense.inverse[index][:, index])
    errors = (covariance @ dense.mu(data.target).flatten()[index]).view(len(rows), m, 1)
    predicted = diagonal_blocks(covariance, len(rows)) - part.weighted_noise(scales) + part.noise(scales)
    return part.noise_model.squares(predicted, errors @ errors.mT)
