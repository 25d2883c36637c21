"""A region that holds 95 % of new measurements although their noise differs from configuration to configuration.

A camera on the tool errs most across its line of sight, and the more the farther the board is; joint noise moves a
marker by its lever arms. A new measurement has the mean covariance M of the rows, but its errors are a mixture of
Gaussians, with heavier tails than one. Of a marker whose errors e have the covariance C_i,

    d^2 = e^T M^-1 e,    a sum of independent chi-squares times the eigenvalues of M^-1 C_i,

is gamma-distributed to a good approximation, with mean tr(M^-1 C_i) and variance 2 tr((M^-1 C_i)^2) (F. Satterthwaite,
"An approximate distribution of estimates of variance components", 1946), exactly if C_i is a multiple of M.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.maps.noise import without_hidden
from diffeo_calib.measurements.poses import own_blocks
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.regions import CONFIDENCE, region_factor

HALVINGS = 50
"""Of the interval in which the quantile lies: to the last digit."""


def differing_factor(covariance: Tensor, mean: Tensor, seen: Tensor) -> float:
    """Factor, one or more, on the mean covariance with which 95 % regions of markers hold 95 % of all rows' errors.

    Args:
        covariance: (N, 3 P, 3 P) of every row, m^2. mean: (3 P, 3 P) over the rows, m^2.
        seen: (N, 3 P) boolean: the coordinates that were measured.
    """
    markers = len(mean) // 3
    visible = seen.unflatten(1, (markers, 3)).all(2)
    relative = torch.linalg.solve(own_blocks(mean[None], markers), own_blocks(covariance, markers))[visible]
    first = relative.diagonal(dim1=-2, dim2=-1).sum(-1)
    second = (relative * relative.mT).sum((-2, -1))
    gaussian = chi2_above(1.0 - CONFIDENCE, 3)
    low, high = gaussian, gaussian * max(float(first.max()), 1.0)  # more than any single row needs
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        inside = torch.special.gammainc(first.square() / (2.0 * second), middle * first / (2.0 * second)).mean()
        low, high = (low, middle) if float(inside) >= CONFIDENCE else (middle, high)
    return low / gaussian


def new_noise(data: TangentData, scales: Hyperparameters) -> Tensor:
    """Covariance (m, m) of a new measurement of all coordinates, m^2, inflated so that its 95 % region holds 95 %.

    It is the mean over the rows. Heavy tails widen it, and that the noise differs between rows. Points of which only
    functionals were measured have the noise of these in each coordinate.
    """
    if data.observe is None:
        return _typical(data, data.noise_model, data.jacobian, scales)
    whole = data.nominal.jacobian(data.x, data.theta)
    if data.beside is None:
        return _typical(data, NoiseModel(whole.shape[1] // 3), whole, scales)
    beside = replace(data.beside, tails=data.tails)  # their own are those of the geometric calibration
    known, ball = new_noise(beside, scales), _typical(data, NoiseModel(1), whole[:, -3:], scales)
    return known if len(known) == whole.shape[1] else torch.block_diag(known, ball)


def _typical(data: TangentData, noise: NoiseModel, jacobian: Tensor, scales: Hyperparameters) -> Tensor:
    """The same for a noise model of coordinates with their derivatives (N, m, n)."""
    mean, seen = noise.mean_covariance(scales, jacobian), noise.coordinates(jacobian[..., 0])
    between_rows = differing_factor(noise.covariance(scales, jacobian), mean, seen)
    return mean * between_rows * region_factor(data.tails.freedom, noise.largest_freedom)


def noise_of_new_rows(data: TangentData, scales: Hyperparameters) -> Tensor:
    """(N, m, m) covariance of new measurements like these rows, m^2, as predictions have it.

    Rows with known deviations keep their own: the mean over images, say, is the noise of none of them.
    """
    own = data.noise(scales)
    if data.observe is not None or data.noise_model.known is not None:
        return own * region_factor(data.tails.freedom, data.noise_model.largest_freedom)
    return without_hidden(new_noise(data, scales).expand_as(own), data.visible)
