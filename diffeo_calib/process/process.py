"""What is known of fields and unknowns from rows: one Gaussian, conditioned on more rows by one block of Cholesky.

With F the covariance of the rows' numbers by the fields and R that of their noise, L L^T = F + R, W = L^-1 S P^1/2 of
the unknowns with prior N(0, P), and B B^T = 1 + W^T W,

    u^ = P^1/2 B^-T B^-1 W^T alpha,    alpha = L^-1 target,    mu = L^-T (alpha - W P^-1/2 u^) = K^-1 target,

where K = F + R + S P S^T is never formed: priors of metres beside noise of micrometres cost no digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import nan

import torch
from torch import Tensor

from diffeo_calib.kernels.spaces import Space
from diffeo_calib.process.numbers import Covariance, Numbers
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.cholesky import Factor
from diffeo_calib.regression.conditional import lower_root


@dataclass(frozen=True)
class Expected:
    """Numbers as the rows so far predict them, without noise: mean (M,), covariance F + D D^T."""

    numbers: Numbers  # of M
    mean: Tensor  # (M,)
    fields: Tensor  # F (M, M)
    features: Tensor  # D (M, K)
    white: Tensor  # V (M', M) L^-1 F(rows so far, numbers)
    unknowns: Tensor  # (M, K) S P^1/2 - V^T W

    @property
    def covariance(self) -> Tensor:
        """(M, M)."""
        return self.fields + self.features @ self.features.T


@dataclass(frozen=True, eq=False)
class Process:
    """The posterior of fields and unknowns by the rows given so far."""

    scales: Hyperparameters  # of the fields
    space: Space  # that of the joints
    variance: Tensor  # (K,) prior P of the unknowns
    numbers: Numbers  # of the rows so far
    factor: Factor  # their covariance with noise
    alpha: Tensor  # (M,) L^-1 target

    @classmethod
    def prior(cls, scales: Hyperparameters, space: Space, variance: Tensor, like: Numbers) -> Process:
        """What is known before any row; ``like``: numbers of any rows, for their sizes."""
        none = like.none
        K = len(variance)
        empty = Factor(*(variance.new_zeros(shape) for shape in ((0, 0), (0, K), (K, K))))
        return cls(scales, space, variance, none, empty, none.target)

    def given(self, new: Numbers, noise: Sequence[Tensor], at: Expected | None = None) -> Process:
        """Conditioned on more rows.

        Args:
            new: their numbers. noise: (N, r, r) of every part. at: :meth:`expected` of them, if known already.

        Raises:
            NumericalError: their covariance is not positive definite in float64.
        """
        at = self.expected(new) if at is None else at
        L = lower_root(new.add_blocks(at.fields.clone(), noise))
        right = torch.cat([(new.target - at.white.T @ self.alpha)[:, None], at.unknowns], 1)
        right = torch.linalg.solve_triangular(L, right, upper=False)
        numbers = self.numbers.joined(new) if len(self.alpha) else new
        factor, alpha = self.factor.joined(at.white, L, right[:, 1:]), torch.cat([self.alpha, right[:, 0]])
        return replace(self, numbers=numbers, factor=factor, alpha=alpha)

    def opened(self, E: Tensor, size: float | None = None) -> Process:
        """The same rows beside unknowns of this standard deviation, of any by default, with effects (M, U) on them."""
        E = E / E.norm(dim=0).clamp(min=torch.finfo(E.dtype).tiny) if size is None else size * E
        return replace(self, variance=torch.cat([self.variance, E.new_ones(E.shape[1])]), factor=self.factor.beside(E))

    def expected(self, new: Numbers, before: Expected | None = None) -> Expected:
        """Numbers as the rows so far predict them; ``before``: the same by the first of these rows alone."""
        L, W = self.factor.L, self.factor.W
        if not len(L):
            U = new.S * self.variance.sqrt()
            return Expected(new, torch.zeros_like(new.target), self._covariance(new, new), U, U.new_zeros(0, len(U)), U)
        if before is None:
            n, F, U = 0, self._covariance(new, new), new.S * self.variance.sqrt()
            V = X = torch.linalg.solve_triangular(L, self._covariance(self.numbers, new), upper=False)
        else:
            n, F, U, V = len(before.white), before.fields, before.unknowns, before.white
            if n == len(L):
                return before
            X = self._covariance(self.numbers.later(n), new) - L[n:, :n] @ V
            X = torch.linalg.solve_triangular(L[n:, n:], X, upper=False)
            V = torch.cat([V, X])
        U = U - X.T @ W[n:]
        features = torch.linalg.solve_triangular(self.factor.B, U.T, upper=False).T
        return Expected(new, V.T @ self.alpha + U @ self._shift, F - X.T @ X, features, V, U)

    def between(self, a: Expected, b: Expected) -> Tensor:
        """Covariance (Ma, Mb) of numbers as the rows so far predict them."""
        return self._covariance(a.numbers, b.numbers) - a.white.T @ b.white + a.features @ b.features.T

    def _covariance(self, a: Numbers, b: Numbers) -> Tensor:
        """Prior covariance by the fields (Ma, Mb)."""
        pairs = Covariance(a, b, self.space)
        return pairs.matrix(pairs.values(self.scales))

    @cached_property
    def _shift(self) -> Tensor:
        """(K,) P^-1/2 u^."""
        return torch.cholesky_solve(self.factor.W.T @ self.alpha[:, None], self.factor.B)[:, 0]

    @property
    def estimate(self) -> Tensor:
        """(K,) posterior mean of the unknowns."""
        return self.variance.sqrt() * self._shift

    @property
    def covariance(self) -> Tensor:
        """(K, K) posterior covariance of the unknowns."""
        root = torch.linalg.solve_triangular(self.factor.B, torch.diag(self.variance.sqrt()), upper=False)
        return root.T @ root

    @cached_property
    def mu(self) -> Tensor:
        """(M,) K^-1 target."""
        white = self.alpha - self.factor.W @ self._shift
        return torch.linalg.solve_triangular(self.factor.L.T, white[:, None], upper=True)[:, 0]

    @property
    def inverse(self) -> Tensor:
        """(M, M) K^-1."""
        return self.factor.inverse

    @property
    def evidence(self) -> float:
        """log N(target; 0, K) of all numbers; that of later ones given the others is a difference."""
        return self.factor.log_density(self.numbers.target, self.mu)

    def left_out(self, group: Tensor) -> tuple[Tensor, Tensor]:
        """Errors (M,) of groups of numbers as all others predict them, and their covariances with noise in (M, M).

        Args:
            group: (M,) that of each number; negative for none, with the error NaN.
        """
        errors, covariance = torch.full_like(self.mu, nan), torch.zeros_like(self.inverse)
        counts = group[group >= 0].unique(return_counts=True)[1]
        parts = group.argsort(stable=True)[int((group < 0).sum()) :].split(counts.tolist())
        for size in counts.unique().tolist():
            at = torch.stack([part for part in parts if len(part) == size])
            block = torch.linalg.inv(self.inverse[at[:, :, None], at[:, None]])
            errors[at] = (block @ self.mu[at][:, :, None])[:, :, 0]
            covariance[at[:, :, None], at[:, None]] = block
        return errors, covariance
