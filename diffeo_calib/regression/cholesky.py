"""Conditioning by one Cholesky factor of G + R: momenta, marginal likelihood, leave-one-out errors."""

from __future__ import annotations

from functools import cached_property
from math import log, pi

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.common.threads import large_work
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.conditional import NOISE_ADVICE, DataConditional, diagonal_blocks


class CholeskyRegression(DataConditional):
    """Conditioning by a Cholesky factor of G + R.

    Args:
        linearisation: first-order response of k1 at the data.
        factor: (N m, N m) lower Cholesky factor of G + R.
    """

    def __init__(self, linearisation: Linearisation, factor: Tensor) -> None:
        super().__init__(linearisation)
        self.factor = factor

    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k)."""
        return torch.cholesky_solve(values.flatten(0, 1), self.factor).view_as(values)

    def explained(self, cross: Tensor) -> Tensor:
        """cross (G + R)^-1 cross^T = |L^-1 cross^T|^2, half the work of a solution: (M, r, N m) -> (M, r, r)."""
        with large_work(cross.numel()):
            white = torch.linalg.solve_triangular(self.factor.T, cross.flatten(0, 1), upper=True, left=False)
            white = white.view_as(cross)
            return white @ white.mT

    def log_marginal_likelihood(self, target: Tensor) -> Tensor:
        """log N(target; 0, G + R), scalar."""
        quadratic = (target * self.mu(target)).sum()
        log_det = 2.0 * torch.diagonal(self.factor).log().sum()
        return -0.5 * (quadratic + log_det + target.numel() * log(2.0 * pi))

    def leave_one_out(self, target: Tensor) -> Tensor:
        """Leave-one-out errors at every configuration, [(G+R)^-1]_ii^-1 mu_i: (N, m) in m."""
        return torch.linalg.solve(self.inverse_blocks(len(target)), self.mu(target)[:, :, None])[:, :, 0]

    @cached_property
    def inverse(self) -> Tensor:
        """(G + R)^-1, kept from then on: (N m, N m)."""
        return self._inverted()

    def inverse_blocks(self, rows: int) -> Tensor:
        """[(G + R)^-1]_ii for each of N = ``rows`` configurations: (N, m, m)."""
        return diagonal_blocks(self.inverse if "inverse" in vars(self) else self._inverted(), rows)

    def _inverted(self) -> Tensor:
        with large_work(self.factor.numel()):
            return torch.cholesky_inverse(self.factor)


def factorise(linearisation: Linearisation, noise: Noise, gram: Tensor | None = None) -> CholeskyRegression:
    """Build G + R and its Cholesky factor; pass ``gram`` if G is known already.

    Raises:
        NumericalError: G + R is not positive definite in float64.
    """
    matrix = noise.add_to(linearisation.gram() if gram is None else gram)
    with large_work(matrix.numel()):
        factor, info = torch.linalg.cholesky_ex(matrix)
    if int(info):
        raise NumericalError.of(
            "the matrix G + R of the Gauss-Newton step is not positive definite",
            expected="noise that float64 can resolve beside the kernels' amplitudes",
            fix=NOISE_ADVICE,
        )
    return CholeskyRegression(linearisation, factor)
