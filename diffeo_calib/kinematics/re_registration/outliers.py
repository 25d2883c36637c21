"""Rows of a registration that contradict all others.

Leaving rows J out lowers the quadratic form of the residuals by mu_J^T (K^-1)_JJ^-1 mu_J with K = V + S P S^T and
mu = K^-1 r (r the residual minus S times the prior mean). Compared with what remains, this is an F test (externally
studentised residuals), so that an outlier does not hide itself. Single rows are tried first, then pairs, which may hide
each other.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.kinematics.re_registration.estimate import Estimate

PRIOR_FREEDOM = 10.0
"""The model's own covariance counts as an estimate of the scale with so many degrees of freedom."""
FALSE_ALARM_PROBABILITY = 0.001
"""Probability that clean rows have an outlier."""
MOST_PAIRS = 800


def worst_rows(found: Estimate) -> list[int]:
    """The one or two rows that contradict all others, or none."""
    M = len(found.rows.residual)
    for size in (1, 2):
        sets = list(combinations(range(M), size))
        if M - size < 3 or len(sets) > MOST_PAIRS:
            continue
        numbers = torch.tensor(sets, dtype=torch.int64, device=found.T.device)
        falls = _falls(found, numbers)
        chances = _chances(found, falls, numbers)
        best = int(np.lexsort((-falls.numpy(force=True), chances))[0])  # of equal chances the largest fall
        if chances[best] * len(sets) < FALSE_ALARM_PROBABILITY:
            return list(sets[best])
    return []


def scale(found: Estimate) -> float:
    """Square of the residuals' scale in units of what model and noise lead to expect."""
    return float(_scales(found, found.T.new_zeros(()), found.T.new_zeros(()))[0])


def _scales(found: Estimate, without: Tensor, coordinates: Tensor) -> tuple[Tensor, Tensor]:
    """The same without parts of the quadratic form that belong to so many coordinates, and degrees of freedom."""
    freedom = (found.rows.visible.sum() - coordinates - found.determined).clamp(min=0.0) + PRIOR_FREEDOM
    return ((found.quadratic - without).clamp(min=0.0) + PRIOR_FREEDOM) / freedom, freedom


def _falls(found: Estimate, sets: Tensor) -> Tensor:
    """Fall of the quadratic form without each set of rows: (K, size) -> (K,)."""
    m = found.rows.residual.shape[1]
    S = found.rows.slopes.flatten(0, 1)[:, found.free]
    mu = found.precision @ (found.rows.residual.flatten() - S @ found.mean)
    places = (sets[..., None] * m + torch.arange(m, device=sets.device)).flatten(1)  # (K, size m)
    blocks = found.precision[places[:, :, None], places[:, None, :]]
    chosen = mu[places]
    return (chosen * torch.linalg.solve(blocks, chosen[..., None])[..., 0]).sum(1)


def _chances(found: Estimate, falls: Tensor, sets: Tensor) -> np.ndarray:
    """Probabilities (K,) of such falls by chance."""
    from scipy.stats import f  # noqa: PLC0415  # slow to import, not needed to use a model

    coordinates = found.rows.visible.sum(1).to(falls)[sets].sum(1)
    variances, freedom = _scales(found, falls, coordinates)
    ratios = falls / coordinates / variances
    return f.sf(*(values.numpy(force=True) for values in (ratios, coordinates, freedom)))
