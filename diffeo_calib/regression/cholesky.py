"""Conditioning by Cholesky factors: of numbers with features of any variance, and of G + R."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from math import log, pi

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.common.threads import large_work
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.conditional import NOISE_ADVICE, DataConditional, diagonal_blocks, lower_root


class Factor:
    """K = L L^T + H H^T of numbers with features H (M, K), L, W = L^-1 H and B: priors of metres cost no digits.

    Args:
        L: (M, M) lower Cholesky factor. W: (M, K). gram: (K, K) W^T W.
    """

    def __init__(self, L: Tensor, W: Tensor, gram: Tensor) -> None:
        self.L, self.W, self._gram = L, W, gram
        eye = torch.eye(W.shape[1], dtype=W.dtype, device=W.device)
        self.B, info = torch.linalg.cholesky_ex(eye + gram)
        if int(info):
            raise NumericalError.of("the covariance of the unknowns is not positive definite", fix=NOISE_ADVICE)

    @classmethod
    def of(cls, F: Tensor, H: Tensor) -> Factor:
        """Of F + H H^T.

        Raises:
            NumericalError: it is not positive definite in float64.
        """
        with large_work(F.numel()):
            L = lower_root(F)
            W = torch.linalg.solve_triangular(L, H, upper=False)
            return cls(L, W, W.T @ W)

    def joined(self, cross: Tensor, L: Tensor, W: Tensor) -> Factor:
        """That of these and m more numbers.

        Args:
            cross: (M, m) L^-1 times their covariance with these, without H. L: (m, m) of what these leave of theirs.
            W: (m, K) their rows.
        """
        M, whole = len(self.L), L.new_empty(len(self.L) + len(L), len(self.L) + len(L))
        whole[:M, :M], whole[:M, M:], whole[M:, :M], whole[M:, M:] = self.L, 0.0, cross.T, L
        return Factor(whole, torch.cat([self.W, W]), self._gram + W.T @ W)

    def beside(self, H: Tensor) -> Factor:
        """That of K + H H^T for more features (M, k), with its inverse by that of K (M. Woodbury, 1950)."""
        W, V = torch.cat([self.W, self.white(H)], 1), self.inverse @ H
        other = Factor(self.L, W, W.T @ W)
        root = torch.linalg.cholesky(torch.eye(H.shape[1], dtype=H.dtype, device=H.device) + H.T @ V)
        Y = torch.linalg.solve_triangular(root, V.T, upper=False)
        vars(other)["inverse"] = self.inverse.addmm(Y.T, Y, alpha=-1.0)
        return other

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


class CholeskyRegression(DataConditional):
    """Conditioning by a :class:`Factor` of G + R. Coordinates that were not measured take no part.

    Args:
        linearisation: first-order response of k1 at the data. noise: R.

    Attributes:
        seen: the S coordinates that were measured, among the N m. factor: of these, (S, S).

    Raises:
        NumericalError: F + R is not positive definite in float64.
    """

    def __init__(self, linearisation: Linearisation, noise: Noise) -> None:
        super().__init__(linearisation, noise)
        visible = noise.visible
        self.seen = slice(None) if bool(visible.all()) else visible.flatten().nonzero()[:, 0]
        matrix = noise.own.add_to(linearisation.fields.gram())
        self.factor = Factor.of(matrix[self.seen][:, self.seen], self.slopes[self.seen])

    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k); zero where nothing was measured."""
        return self._spread(self.factor.solve(values.flatten(0, 1)[self.seen])).view_as(values)

    def white(self, values: Tensor) -> Tensor:
        return self.factor.white(values[self.seen])

    @property
    def apart(self) -> tuple[Tensor, Tensor]:
        return self.factor.W, self.factor.B

    def momenta(self, target: Tensor) -> Momenta:
        """Fields by mu, transported back to time 0; parameters apart, since S^T mu would lose their digits."""
        mu, shift = self.factor.solved(target.flatten()[self.seen, None])
        found = self.linearisation.fields.momenta(self._spread(mu[:, 0]).view_as(target))
        return replace(found, theta=(self.deviations * shift[:, 0])[: len(self.linearisation.spec.prior_variance)])

    def of_white(self, values: Tensor) -> Tensor:
        """C values with C C^T = (G + R)^-1: (S,) -> (N m,)."""
        return self._spread(self.factor.of_white(values))

    def left_out(self, target: Tensor) -> tuple[Tensor, Tensor]:
        """Errors (N, m) of every configuration predicted by all others, [(G + R)^-1]_ii^-1 mu_i, and their covariance.

        The covariance (N, m, m) holds the noise of the configuration itself; it is one where nothing was measured.
        """
        inverse = torch.eye(self.size, dtype=target.dtype, device=target.device)
        at = torch.arange(self.size, device=target.device)[self.seen]
        inverse[at[:, None], at] = self.factor.inverse
        own = torch.linalg.inv(diagonal_blocks(inverse, len(target)))
        return (own @ self.mu(target)[:, :, None])[:, :, 0], own

    def _spread(self, flat: Tensor) -> Tensor:
        """Values (S, ...) of what was measured as those of all, zero elsewhere: (N m, ...)."""
        if isinstance(self.seen, slice):
            return flat
        return flat.new_zeros(self.size, *flat.shape[1:]).index_copy(0, self.seen, flat)
