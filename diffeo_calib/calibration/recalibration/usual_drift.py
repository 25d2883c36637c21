"""Small changes of everything between two dates, whose sizes the new rows choose.

A test names what has changed clearly. Temperature, wear and new screws change everything a little. In each of three
groups, the geometry, the load and the transmissions of all joints, errors may differ from the old ones by s^2 times
their old prior variance; the sizes s^2 maximise the evidence of the new rows with a wide prior below one percent.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import exp, log

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.calibration.recalibration.changed_parts import ChangedPart, Transmission, parts_of
from diffeo_calib.calibration.recalibration.changes import Drift
from diffeo_calib.calibration.recalibration.new_rows import NewRows
from diffeo_calib.maps.noise import Noise

USUAL_SIZE, EFOLDS = exp(-6.0), 2.5
"""Log-normal prior of s^2: its centre, and the standard deviation of its logarithm."""
STARTS = log(USUAL_SIZE), -3.0
"""Of the search, logarithms of s^2: hardly any change, and a clear one."""
LEAST_GAIN = 4.0
"""Log evidence by which drift must explain the rows better: what chance exceeds in one of twenty, for three sizes."""
LEAST_GAIN_OF_INLIERS = 0.5
"""The same where rows that do not fit the old model have hardly any weight: outliers look like a change."""
LOG_VARIANCE_RANGE = -12.0, 4.0
"""Of the logarithm of s^2."""


def usual_drift(rows: NewRows, named: Sequence[Drift]) -> list[Drift]:
    """What may differ between the dates, besides what a test named.

    Args:
        rows: the new rows as the old model sees them. named: parts that have changed, which are free already.
    """
    free = {each.part.name for each in named}
    groups: dict[str, list[ChangedPart]] = {}
    for part in parts_of(rows):
        if part.name not in free:
            groups.setdefault("transmissions" if isinstance(part, Transmission) else part.name, []).append(part)
    if not groups:
        return []
    roots = [torch.cat([part.root(rows.at) for part in parts], 2).flatten(0, 1) for parts in groups.values()]
    known = [each.variance**0.5 * each.part.root(rows.at) for each in named]
    doubted = rows.if_drifting([*known, *(root.view(*rows.y.shape, -1) for root in roots)])
    base = rows.posterior if not known else rows.if_drifting(known).posterior
    residual, sizes = rows.residual.flatten(), None
    for weighed, gain in ((rows, LEAST_GAIN_OF_INLIERS), (doubted, LEAST_GAIN)):
        sizes = _likeliest(Noise(weighed.weighted_noise).add_to(base), roots, residual, gain)
        if sizes is None:
            return []
    return [Drift(part, size) for parts, size in zip(groups.values(), sizes or [], strict=True) for part in parts]


def _likeliest(covariance: Tensor, roots: list[Tensor], residual: Tensor, gain: float) -> list[float] | None:
    """The sizes s^2 of changes with these columns (M R, c) beside a covariance (M R, M R) that is known, m^2.

    None where changes explain the residuals by less than ``gain`` better, in log evidence.
    """
    from scipy.optimize import minimize  # noqa: PLC0415  # slow to import, not needed to use a model

    grams = [root @ root.T for root in roots]

    def objective(vector: np.ndarray) -> tuple[float, np.ndarray]:
        logs = torch.from_numpy(vector)
        total = covariance + sum((float(size) * gram for size, gram in zip(logs.exp(), grams, strict=True)), 0.0)
        factor = torch.linalg.cholesky(total)
        mu = torch.cholesky_solve(residual[:, None], factor)[:, 0]
        slope = 0.5 * (torch.cholesky_inverse(factor) - torch.outer(mu, mu))
        away = (logs - log(USUAL_SIZE)) / EFOLDS
        value = 0.5 * residual @ mu + factor.diagonal().log().sum() + 0.5 * away.square().sum()
        by_size = torch.stack([(slope * gram).sum() for gram in grams]) * logs.exp() + away / EFOLDS
        return float(value), by_size.numpy()

    bounds = [LOG_VARIANCE_RANGE] * len(grams)
    starts = [np.full(len(grams), start) for start in STARTS]
    found = [minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts]
    best = min(found, key=lambda each: float(each.fun))
    still, _ = objective(np.full(len(grams), LOG_VARIANCE_RANGE[0]))
    prior = 0.5 * len(grams) * ((LOG_VARIANCE_RANGE[0] - log(USUAL_SIZE)) / EFOLDS) ** 2
    if still - prior - float(best.fun) < gain:
        return None
    return [exp(value) for value in best.x.tolist()]
