"""How certain is the expected error of a campaign? The limit below which the true one is, with a probability.

The errors over the target have a posterior N(0, S) at given scales: their mean square is distributed about as chi-
squared with (tr S)^2 / tr S^2 degrees of freedom, scaled to the same mean and variance. The scales are uncertain, too.
With the Fisher information of the rows, and the prior,

    F_ij = 1/2 tr(K^-1 K_i K^-1 K_j) + delta_ij / width^2,    K_i: derivative of their covariance by log scale i,

the logarithm of the RMS error has the variance s^2 = g^T F^-1 g, with the gradient g by the log scales. Both variances
of the mean square, relative to its mean, add up to those of chi-squared with nu degrees of freedom:

    2 / nu = 2 tr S^2 / (tr S)^2 + 4 s^2.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf, isinf

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.selection import SCALE_PRIOR
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.campaign.posterior import Rows
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.process.scales import Hyperparameters

EXCEEDANCE_PROBABILITY = 0.05
"""Probability that the true error is above the limit."""
MOST_COORDINATES = 450
"""Measured numbers of random rows that stand for all."""
LOG_SCALE_STEP = 0.2
"""Of a log scale, between which derivatives are taken."""


def scales_deviation(
    data: TangentData, scales: Hyperparameters, target: Callable[[Hyperparameters], Rows], compared: Tensor
) -> float:
    """Standard deviation of the log RMS error over the target by uncertain scales.

    Args:
        data: the rows that they were selected with. target: the places at other scales.
        compared: (T r, T 3 P) what of the errors there counts.
    """
    _, some = data.sample(len(data.x), MOST_COORDINATES, 0)
    point = scales.logarithms()

    def at(logarithms: Tensor) -> tuple[Tensor, float]:
        """Covariance of the rows, and log RMS error over the target."""
        here = scales.from_logarithms(logarithms)
        rows, there = Rows.of(some, here), target(here)
        K = rows.covariance(rows) + rows.noises
        by = torch.linalg.solve_triangular(torch.linalg.cholesky(K), rows.covariance(there) @ compared.T, upper=False)
        own = (compared @ there.covariance(there) * compared).sum()
        return K, 0.5 * float((own - by.square().sum()).log())

    low = torch.linalg.cholesky(at(point)[0])
    white, slopes = [], []
    for step in LOG_SCALE_STEP * torch.eye(len(point), dtype=point.dtype, device=point.device):
        (K, value), (K_before, value_before) = at(point + step), at(point - step)
        half = torch.linalg.solve_triangular(low, (K - K_before) / (2 * LOG_SCALE_STEP), upper=False)
        white.append(torch.linalg.solve_triangular(low, half.T, upper=False).flatten())
        slopes.append((value - value_before) / (2 * LOG_SCALE_STEP))
    W, g = torch.stack(white), torch.tensor(slopes, dtype=point.dtype, device=point.device)
    F = 0.5 * W @ W.T + torch.eye(len(g), dtype=W.dtype, device=W.device) / SCALE_PRIOR.growth**2
    return float(g @ torch.linalg.solve(F, g)) ** 0.5


def limit_of(error: float, covariance: Tensor, scales_deviation: float) -> float:
    """The error that the true one exceeds with 5 % probability, m.

    Args:
        error: the expected one, m. covariance: S (R, R), m^2. scales_deviation: see :func:`scales_deviation`.
    """
    if isinf(scales_deviation):
        return inf
    freedom = 1.0 / (float(covariance.square().sum() / covariance.trace() ** 2) + 2.0 * scales_deviation**2)
    return error * (chi2_above(EXCEEDANCE_PROBABILITY, freedom) / freedom) ** 0.5
