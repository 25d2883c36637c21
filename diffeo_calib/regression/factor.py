"""The covariance of numbers with features of any variance, factorised: priors of metres cost no digits."""

from __future__ import annotations

from functools import cached_property
from math import log, pi

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.common.threads import large_work
from diffeo_calib.regression.conditional import NOISE_ADVICE


class Factor:
    """K = L L^T + H H^T of numbers with features H (M, K): L, W = L^-1 H and B.

    Args:
        L: (M, M) lower Cholesky factor. W: (M, K).
    """

    def __init__(self, L: Tensor, W: Tensor) -> None:
        self.L, self.W = L, W
        eye = torch.eye(W.shape[1], dtype=W.dtype, device=W.device)
        self.B, info = torch.linalg.cholesky_ex(eye + W.T @ W)
        if int(info):
            raise NumericalError.of("the covariance of the unknowns is not positive definite", fix=NOISE_ADVICE)

    @classmethod
    def of(cls, F: Tensor, H: Tensor) -> Factor:
        """Of F + H H^T.

        Raises:
            NumericalError: it is not positive definite in float64.
        """
        with large_work(F.numel()):
            L, info = torch.linalg.cholesky_ex(F)
            if int(info):
                raise NumericalError.of("the covariance of the rows is not positive definite", fix=NOISE_ADVICE)
            return cls(L, torch.linalg.solve_triangular(L, H, upper=False))

    @property
    def matrix(self) -> Tensor:
        """K (M, M)."""
        H = self.L @ self.W
        return self.L @ self.L.T + H @ H.T

    def white(self, values: Tensor) -> Tensor:
        """L^-1 values (M, k)."""
        return torch.linalg.solve_triangular(self.L, values, upper=False)

    def solve(self, values: Tensor) -> Tensor:
        """K^-1 values (M, k)."""
        return self.solved(values)[0]

    def solved(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """K^-1 values (M, k) and H^T K^-1 values (K, k), in which nothing cancels."""
        white = self.white(values)
        shift = torch.cholesky_solve(self.W.T @ white, self.B)
        return torch.linalg.solve_triangular(self.L.T, white - self.W @ shift, upper=True), shift

    def of_white(self, values: Tensor) -> Tensor:
        """C values (M,) with C C^T = K^-1: L^-T (1 + W W^T)^-1/2 values."""
        U, less = self._root
        white = values - U @ (less * (U.T @ values))
        return torch.linalg.solve_triangular(self.L.T, white[:, None], upper=True)[:, 0]

    @cached_property
    def _root(self) -> tuple[Tensor, Tensor]:
        """U and d with (1 + W W^T)^-1/2 = 1 - U diag(d) U^T."""
        U, deviations, _ = torch.linalg.svd(self.W, full_matrices=False)
        return U, 1.0 - (1.0 + deviations.square()).rsqrt()

    @cached_property
    def inverse(self) -> Tensor:
        """K^-1 (M, M)."""
        with large_work(self.L.numel()):
            Y = torch.linalg.solve_triangular(self.B.T, self.W, upper=True, left=False)
            Y = torch.linalg.solve_triangular(self.L.T, Y, upper=True)
            return torch.cholesky_inverse(self.L).addmm_(Y, Y.T, alpha=-1.0)

    def log_density(self, values: Tensor, solved: Tensor) -> float:
        """log N(values; 0, K) for (M,) with K^-1 values."""
        log_det = float(self.L.diagonal().log().sum() + self.B.diagonal().log().sum())
        return -0.5 * float(values @ solved) - log_det - 0.5 * len(values) * log(2.0 * pi)

    def by_variance(self, features_mu: Tensor) -> Tensor:
        """Derivative of the log density by the logarithm of each feature's variance, with H^T K^-1 values: (K,)."""
        return 0.5 * (features_mu.square() - 1.0 + torch.cholesky_inverse(self.B).diagonal())
