"""Cholesky factors of numbers with features of any variance: priors of metres beside noise of micrometres."""

from __future__ import annotations

from functools import cached_property
from math import log, pi

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.common.threads import large_work

NOISE_ADVICE = "raise `noise` or lower the kernels' variances"  # how to repair a matrix that float64 cannot factorise
MOST_ADDED = 128  # rows of a factor that are kept apart from the first ones


def lower_root(F: Tensor) -> Tensor:
    """L with L L^T = F (M, M); NumericalError where F is not positive definite in float64."""
    with large_work(F.numel()):
        L, info = torch.linalg.cholesky_ex(F)
    if int(info):
        raise NumericalError.of("the covariance of the rows is not positive definite", fix=NOISE_ADVICE)
    return L


class Factor:
    """K = L L^T + H H^T of numbers with features H (M, K), L, W = L^-1 H and B: priors of metres cost no digits.

    Args:
        first: lower Cholesky factor of the first numbers. W: (M, K). gram: (K, K) W^T W.
        added: the rows of L below it (m, M), apart because copying it takes longer than a new row.
    """

    def __init__(self, first: Tensor, W: Tensor, gram: Tensor, added: Tensor | None = None) -> None:
        self.first, self.W, self._gram = first, W, gram
        self.added = first[:0] if added is None else added
        eye = torch.eye(W.shape[1], dtype=W.dtype, device=W.device)
        self.B, info = torch.linalg.cholesky_ex(eye + gram)
        if int(info):
            raise NumericalError.of("the covariance of the unknowns is not positive definite", fix=NOISE_ADVICE)

    @classmethod
    def of(cls, F: Tensor, H: Tensor) -> Factor:
        """Factor F + H H^T.

        Raises:
            NumericalError: it is not positive definite in float64.
        """
        with large_work(F.numel()):
            L = lower_root(F)
            W = torch.linalg.solve_triangular(L, H, upper=False)
            return cls(L, W, W.T @ W)

    def joined(self, cross: Tensor, L: Tensor, W: Tensor) -> Factor:
        """The factor of these and m more numbers.

        Args:
            cross: (M, m) L^-1 times their covariance with these, without H. L: (m, m) of what these leave of theirs.
            W: (m, K) their rows.
        """
        first, old = (self.first, self.added) if len(self.added) <= MOST_ADDED else (self.L, self.first[:0])
        M = len(self.W)
        added = L.new_zeros(len(old) + len(L), M + len(L))
        added[: len(old), : old.shape[1]], added[len(old) :, :M], added[len(old) :, M:] = old, cross.T, L
        return Factor(first, torch.cat([self.W, W]), self._gram + W.T @ W, added)

    @cached_property
    def L(self) -> Tensor:
        """(M, M) lower Cholesky factor of K - H H^T."""
        if not len(self.added):
            return self.first
        whole = self.first.new_zeros(len(self.W), len(self.W))
        whole[: len(self.first), : len(self.first)], whole[len(self.first) :] = self.first, self.added
        return whole

    def further(self, values: Tensor, sooner: Tensor) -> Tensor:
        """The rows of L^-1 values after the first n, ``sooner`` (n, k), from the values after n."""
        start, M, parts = len(sooner), len(self.first), [sooner]
        for n, rows in ((start, self.first[start:]), (max(start, M), self.added[max(start - M, 0) :])):
            if len(rows):
                sooner_rows = torch.cat(parts) if len(parts) > 1 else sooner
                right = values[: len(rows)] - rows[:, :n] @ sooner_rows
                parts.append(torch.linalg.solve_triangular(rows[:, n:], right, upper=False))
                values = values[len(rows) :]
        return torch.cat(parts[1:])

    def below(self, n: int) -> Tensor:
        """The block of L of the numbers after the first n."""
        M = len(self.first)
        return self.added[n - M :, n:] if n >= M else self.L[n:, n:]

    def beside(self, H: Tensor) -> Factor:
        """The factor of K + H H^T for more features (M, k), with its inverse by that of K (M. Woodbury, 1950)."""
        W, V = torch.cat([self.W, self.white(H)], 1), self.inverse @ H
        other = Factor(self.first, W, W.T @ W, self.added)
        root = torch.linalg.cholesky(torch.eye(H.shape[1], dtype=H.dtype, device=H.device) + H.T @ V)
        Y = torch.linalg.solve_triangular(root, V.T, upper=False)
        vars(other)["inverse"] = self.inverse.addmm(Y.T, Y, alpha=-1.0)
        return other

    def with_features(self, columns: Tensor, H: Tensor) -> Factor:
        """The factor with other features (M, k) in some of its columns (k,)."""
        W = self.W.index_copy(1, columns, self.white(H))
        return Factor(self.first, W, W.T @ W, self.added)

    @property
    def matrix(self) -> Tensor:
        """K (M, M)."""
        H = self.L @ self.W
        return self.L @ self.L.T + H @ H.T

    def white(self, values: Tensor) -> Tensor:
        """L^-1 values (M, k)."""
        return self.further(values, values[:0])

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
