"""A region that holds 95 % of new measurements although their noise differs from configuration to configuration.

A camera on the tool errs most across its line of sight, and the more the farther the board is; joint noise moves a
marker by its lever arms. A new measurement has the mean covariance M of the rows, but its errors are a mixture of
Gaussians, with heavier tails than one. Of a marker whose errors e have the covariance C_i,

    d^2 = e^T M^-1 e,    a sum of independent chi-squares times the eigenvalues of M^-1 C_i,

is gamma-distributed to a good approximation, with mean tr(M^-1 C_i) and variance 2 tr((M^-1 C_i)^2) (F. Satterthwaite,
"An approximate distribution of estimates of variance components", 1946), exactly if C_i is a multiple of M.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.calibration.student_t import CONFIDENCE
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.measurements.pose_frames import own_blocks

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
