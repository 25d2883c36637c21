"""The factor on predicted covariances with which 95 % regions hold, from errors of rows that took no part.

Of a right covariance C the squares d^2 = e^T C^-1 e of errors e of k coordinates are chi-squared with k degrees of
freedom. Of a covariance that is too small or too large, and of errors with heavier tails than a Gaussian's, they are

    d^2 / (k s)  ~  F(k, nu),

with a scale s and degrees of freedom nu. Few rows determine neither, so that both have priors, and the region is that
of a new error whose s and nu are distributed as the rows say: with few rows it widens by itself, as Student's t does.
Of many rows their own 95 % quantile says more than any distribution: outliers, and noise that is small in most rows and
large in some, are no Student's t. The factor is the geometric mean of both, the quantile with the weight of the rows
and the distribution with that of :data:`ROWS`. Constants and this rule were chosen on simulated arms of
eleven kinds and three real series.
"""

from __future__ import annotations

from collections.abc import Callable
from math import exp, inf, log

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.quantiles import chi2_above, f_below

CONFIDENCE = 0.95
SCALES = np.exp(np.linspace(np.log(0.05), np.log(200.0), 120))
FREEDOMS = np.exp(np.linspace(np.log(2.0), np.log(200.0), 30))
HALVINGS = 70  # of an interval in which a value is sought: to the last digit
BLOCK = 1 << 16  # numbers of a likelihood that are added at once
FACTORS = 0.01, 1e4  # between which the factor is sought


FREEDOM, FREEDOM_EFOLDS = 40.0, 0.8  # log-normal prior of nu: its centre, and the standard deviation of its logarithm
ROWS = 60.0  # number of independent errors whose quantile counts as much as the distribution
SCALE_EFOLDS, OTHER_DATE = 0.8, 2.0
"""Standard deviation of log s around zero, of a calibration's own scales and on another date.

There a robot may have changed by any amount: variances of 1 to 50 times the old ones are usual, and a
prior as narrow as that of a calibration's own scales takes a third of the factor from ten rows that ask for 50."""


def region_scale(
    squares: Tensor, dim: int | Tensor, weights: Tensor | None = None, efolds: float = SCALE_EFOLDS
) -> float:
    """Factor on all covariances with which their 95 % regions hold 95 % of new errors.

    Args:
        squares: d^2 of errors that took no part, of any shape; NaN where nothing was measured.
        dim: k, coordinates of each error, the same for all or of the shape of ``squares``.
        weights: number of independent errors that each stands for; all one by default.
        efolds: standard deviation of log s before these errors.

    Returns:
        one if there are no errors at all, above one or below.
    """
    there = ~squares.isnan()
    if not bool(there.any()):
        return 1.0
    values = squares[there].numpy(force=True)
    dims = np.full(len(values), dim) if isinstance(dim, int) else dim[there].numpy(force=True)
    shares = np.ones(len(values)) if weights is None else weights[there].double().numpy(force=True)
    nu, s = FREEDOMS[:, None], SCALES  # of every pair the probability: (len(FREEDOMS), len(SCALES))
    logs = -0.5 * (np.log(nu / FREEDOM) / FREEDOM_EFOLDS) ** 2 - 0.5 * (np.log(s) / efolds) ** 2
    d2, k, count, freedoms = map(torch.from_numpy, (values, dims, shares, FREEDOMS))
    likelihood = torch.stack([student_likelihood(d2 / each, k, freedoms, count) for each in s.tolist()], 1).numpy()
    logs = logs + likelihood - 0.5 * (dims @ shares) * np.log(s)
    density = np.exp(logs - logs.max())
    density = density / density.sum()
    counts = {int(k): float(shares[dims == k].sum() / shares.sum()) for k in np.unique(dims)}
    high = smallest(lambda at: _held(exp(at), counts, density) >= CONFIDENCE, *map(log, FACTORS))
    number = float(shares.sum())
    ratios = values / np.array([chi2_above(1.0 - CONFIDENCE, k) for k in dims])
    order = np.argsort(ratios)  # a new one of n lies below the k-th with the probability k / (n + 1)
    effective = shares.sum() ** 2 / np.square(shares).sum()
    below = shares[order].cumsum() / shares.sum() * effective / (effective + 1.0)
    quantile = float(np.interp(CONFIDENCE, below, np.log(ratios[order].clip(min=np.finfo(float).tiny))))
    return float(np.exp((number * quantile + ROWS * high) / (number + ROWS)))


def smallest(holds: Callable[[float], bool], low: float, high: float) -> float:
    """The smallest number from which on a condition holds, between two bounds."""
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


def region_factor(freedom: float, dim: int) -> float:
    """Factor on a Gaussian's variance that gives it the 95 % region of Student's t in ``dim`` coordinates.

    The t-distribution is that of errors with heavy tails, or of Gaussian errors whose variance was estimated with
    ``freedom`` degrees of freedom.
    """
    if freedom == inf:
        return 1.0
    return dim * f_below(CONFIDENCE, dim, freedom) / chi2_above(1.0 - CONFIDENCE, dim)


def student_likelihood(squares: Tensor, dim: Tensor, freedoms: Tensor, shares: Tensor | None = None) -> Tensor:
    """Log likelihood (F,) of n errors under Student's t of each nu (F,), relative to (2 pi)^(-k/2) of each error.

    They have squares d^2 (n,) and k = dim (n,) coordinates, and count by their shares (n,), one by default.
    """
    value, shares = torch.zeros_like(freedoms), torch.ones_like(squares) if shares is None else shares
    for k in dim.unique().tolist():
        some, count, half = squares[dim == k], shares[dim == k], 0.5 * (freedoms + k)
        parts = freedoms[:, None].split(max(1, BLOCK // len(some)))
        distances = torch.cat([(some / nu).log1p() @ count for nu in parts])
        density = torch.lgamma(half) - torch.lgamma(0.5 * freedoms) - 0.5 * k * (0.5 * freedoms).log()
        value = value + count.sum() * density - half * distances
    return value


def _held(factor: float, counts: dict[int, float], density: np.ndarray) -> float:
    """Share of new errors in regions whose covariances are multiplied by a factor."""
    from scipy.special import fdtr  # noqa: PLC0415  # slow to import, not needed to use a model

    total = 0.0
    for k, share in counts.items():
        bound = factor * chi2_above(1.0 - CONFIDENCE, k) / (k * SCALES)
        total += share * float((density * fdtr(k, FREEDOMS[:, None], bound)).sum())
    return total
