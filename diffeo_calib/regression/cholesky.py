"""Cholesky factors of numbers with features of any variance: priors of metres beside noise of micrometres."""

from __future__ import annotations

from functools import cached_property
from math import log, pi

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.common.threads import large_work

NOISE_ADVICE = "raise `noise` or lower the kernels' variances"  # how to repair a matrix that float64 cannot factorise


def lower_root(F: Tensor) -> Tensor:
    """L with L L^T = F (M, M); NumericalError where F is not positive definite in float64."""
    with large_work(F.numel()):
        L, info = torch.linalg.cholesky_ex(F)
    if int(info):
        raise NumericalError.of("the covariance of the rows is not positive definite", fix=NOISE_ADVICE)
    return L


class Factor:
    """K = L L^T + H H^T of numbers with features H (M, K): priors of metres cost no digits.

    Args:
        L: (M, M) lower Cholesky factor of K - H H^T. W: (M, K) L^-1 H.
    """

    def __init__(self, L: Tensor, W: Tensor) -> None:
        self.L, self.W = L, W
        self.B, info = torch.linalg.cholesky_ex(torch.eye(W.shape[1], dtype=W.dtype, device=W.device) + W.T @ W)
        if int(info):
            raise NumericalError.of("the covariance of the unknowns is not positive definite", fix=NOISE_ADVICE)

    @classmethod
    def of(cls, F: Tensor, H: Tensor) -> Factor:
        """Factor F + H H^T; NumericalError where it is not positive definite in float64."""
        with large_work(F.numel()):
            L = lower_root(F)
            return cls(L, torch.linalg.solve_triangular(L, H, upper=False))

    def joined(self, cross: Tensor, L: Tensor, W: Tensor) -> Factor:
        """The factor of these and m more numbers.

        Args:
            cross: (M, m) L^-1 times their covariance with these, without H. L: (m, m) of what these leave of theirs.
            W: (m, K) their rows.
        """
        rows = torch.cat([torch.nn.functional.pad(self.L, (0, len(L))), torch.cat([cross.T, L], 1)])
        return Factor(rows, torch.cat([self.W, W]))

    def beside(self, H: Tensor) -> Factor:
        """The factor of K + H H^T for more features (M, k), with its inverse by that of K (M. Woodbury, 1950)."""
        W, V = torch.cat([self.W, self.white(H)], 1), self.inverse @ H
        other = Factor(self.L, W)
        root = torch.linalg.cholesky(torch.eye(H.shape[1], dtype=H.dtype, device=H.device) + H.T @ V)
        Y = torch.linalg.solve_triangular(root, V.T, upper=False)
        vars(other)["inverse"] = self.inverse.addmm(Y.T, Y, alpha=-1.0)
        return other

    def with_features(self, columns: Tensor, H: Tensor) -> Factor:
        """The factor with other features (M, k) in some of its columns (k,)."""
        return Factor(self.L, self.W.index_copy(1, columns, self.white(H)))

    @property
    def matrix(self) -> Tensor:
        """K (M, M)."""
        H = self.L @ self.W
        return self.L @ self.L.T + H @ H.T

    def white(self, values: Tensor) -> Tensor:
        """L^-1 values (M, k)."""
        with large_work(values.numel()):
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
