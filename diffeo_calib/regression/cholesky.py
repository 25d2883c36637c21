"""Conditioning by one Cholesky factor of G + R: momenta, marginal likelihood, leave-one-out errors."""

from __future__ import annotations

from math import log, pi

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError, sentence
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.conditional import DataConditional, diagonal_blocks


class CholeskyRegression(DataConditional):
    """A factorised G + R.

    Args:
        linearisation: how k1 at the data moves.
        factor: (N m, N m) lower Cholesky factor of G + R.
    """

    def __init__(self, linearisation: Linearisation, factor: Tensor) -> None:
        super().__init__(linearisation)
        self.factor = factor

    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k)."""
        return torch.cholesky_solve(values.flatten(0, 1), self.factor).view_as(values)

    def log_marginal_likelihood(self, target: Tensor) -> Tensor:
        """log N(target; 0, G + R), scalar."""
        quadratic = (target * self.mu(target)).sum()
        log_det = 2.0 * torch.diagonal(self.factor).log().sum()
        return -0.5 * (quadratic + log_det + target.numel() * log(2.0 * pi))

    def leave_one_out(self, target: Tensor) -> Tensor:
        """Errors (N, m) in m at each configuration when it is left out: [(G+R)^-1]_ii^-1 mu_i."""
        return torch.linalg.solve(self.inverse_blocks(len(target)), self.mu(target)[:, :, None])[:, :, 0]

    def inverse_blocks(self, rows: int) -> Tensor:
        """[(G + R)^-1]_ii of N configurations: (N, m, m)."""
        return diagonal_blocks(torch.cholesky_inverse(self.factor), rows)


def factorise(linearisation: Linearisation, noise: Noise, gram: Tensor | None = None) -> CholeskyRegression:
    """Build G + R and its Cholesky factor; ``gram`` is G where it is known already.

    Raises:
        NumericalError: G + R is not positive definite in float64.
    """
    factor, info = torch.linalg.cholesky_ex(noise.add_to(linearisation.gram() if gram is None else gram))
    if int(info):
        raise NumericalError(
            sentence(
                "the matrix G + R of the Gauss-Newton step is not positive definite",
                expected="noise large enough for float64 against the kernels' amplitudes",
                fix="raise `noise` or lower the kernels' variances",
            )
        )
    return CholeskyRegression(linearisation, factor)
