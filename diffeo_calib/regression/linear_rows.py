"""Linearised rows beside a model: what is open since its fit, and what their errors share.

    r = S u + e + noise,    u ~ N(mu, P),    cov(e) = C,    cov(noise) = R,

r measured minus predicted, u shifts of devices and markers, C the posterior covariance of the fit and of whatever has
drifted since. With V = C + R and K = V + S P S^T their evidence is that of N(S mu, K), and rows J left out are off
their prediction by (K^-1)_JJ^-1 mu_J with mu = K^-1 (r - S mu).

Places are where the rows fit best, weighed by the noise alone:

    u = mu + A (r - S mu),    A = ((P + B)^-1 + S^T R^-1 S)^-1 S^T R^-1,    U = (1 - A S) P (1 - A S)^T + A V A^T.

B is the covariance of the markers' old places by the fit, a part of C, where the fit hardly knew them, as along the
axis of a tool that was never tilted: there the rows place a marker, though it stayed. R in place of V in the weights
costs 1 % where the model is right. Where the robot has changed since its fit, errors are not correlated as C says, and
weights by V do harm: on another series of a UR10 more rows hurt, and where the model is uncertain by centimetres, as
much is left in the rows, although another place explains it.

Evidence is what rows say of unknowns u that a hypothesis opens. With errors r of covariance K, and effects E of the
unknowns,

    g = E^T K^-1 r,    H = E^T K^-1 E,    u = H^-1 g,    cov(u) = H^-1.

They explain the gain g^T u of r^T K^-1 r: by chance chi-squared, one degree of freedom per unknown. With a prior
N(0, s^2) of the unknowns the log evidence grows by

    1/2 g^T (H + s^-2)^-1 g - 1/2 log |1 + s^2 H|.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import nan
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.regression.cholesky import Factor
from diffeo_calib.regression.conditional import Process, diagonal_blocks

RELATIVE_RIDGE = 1e-9  # relative size of the diagonal that keeps H invertible where rows do not determine all unknowns


class Evidence(NamedTuple):
    """What rows say of U unknowns: g (..., U) and H (..., U, U), see above; r^T K^-1 r of a count of errors."""

    g: Tensor
    H: Tensor
    total: float = 0.0
    count: int = 1

    @classmethod
    def of(cls, E: Tensor, process: Process) -> Evidence:
        """By the rows of a process, with effects (M, U) on their numbers."""
        target = process.numbers.target
        return cls(E.T @ process.mu, E.T @ (process.inverse @ E), float(target @ process.mu), len(target))

    @property
    def size(self) -> Tensor:
        """(..., U) the most probable unknowns."""
        ridge = RELATIVE_RIDGE * self.H.diagonal(dim1=-2, dim2=-1).amax(-1, keepdim=True)
        H = self.H + torch.diag_embed(ridge.expand_as(self.g))
        return (torch.linalg.pinv(H, hermitian=True) @ self.g[..., None])[..., 0]

    @property
    def gain(self) -> Tensor:
        """(...) what they explain."""
        return (self.g * self.size).sum(-1)

    @property
    def excess(self) -> Tensor:
        """(...) mean square, at least one, of what they leave unexplained: of errors that K understates."""
        return ((self.total - self.gain) / self.count).clamp(min=1.0)

    def log_odds(self, variances: Tensor) -> Tensor:
        """(S, ...) by how much the log evidence grows with a prior of each variance (S,)."""
        h, V = torch.linalg.eigh(self.H)
        scaled = variances[:, None] * h.clamp(min=0.0)  # (S, U)
        gains = torch.einsum("su,...u->s...", variances[:, None] / (1.0 + scaled), (self.g @ V).square())
        return 0.5 * (gains - scaled.log1p().sum(1).view(-1, *[1] * (gains.ndim - 1)))

    def log_odds_of(self, variances: Tensor) -> Tensor:
        """(S,) the same of one g (U,) with priors of different variances (S, U)."""
        root, eye = variances.sqrt(), torch.eye(len(self.g), dtype=self.g.dtype, device=self.g.device)
        low = torch.linalg.cholesky(eye + root[:, :, None] * self.H * root[:, None])
        white = torch.linalg.solve_triangular(low, (root * self.g)[..., None], upper=False)
        return 0.5 * white.square().sum((1, 2)) - low.diagonal(dim1=1, dim2=2).log().sum(1)


@dataclass(frozen=True, eq=False)
class LinearRows:
    """M rows of R numbers and k unknowns."""

    residual: Tensor  # (M, R) r, m
    S: Tensor  # (M, R, k)
    C: Tensor  # (M R, M R), m^2
    noise: Tensor  # (M, R, R) blocks of R, m^2
    visible: Tensor  # (M, R) boolean, the numbers that were measured
    prior: Tensor  # (k, k) P
    mean: Tensor  # (k,) mu
    by_fit: Tensor  # (k, k) B

    @cached_property
    def slopes(self) -> Tensor:
        """(M R, k) S."""
        return self.S.flatten(0, 1)

    @cached_property
    def V(self) -> Tensor:
        """(M R, M R), m^2."""
        V = self.C + torch.block_diag(*self.noise)
        return 0.5 * (V + V.mT)

    @cached_property
    def target(self) -> Tensor:
        """(M R,) r - S mu."""
        return self.residual.flatten() - self.slopes @ self.mean

    @cached_property
    def factor(self) -> Factor:
        """Factor of K."""
        return Factor.of(self.V, self.slopes @ torch.linalg.cholesky(self.prior))

    @cached_property
    def solved(self) -> Tensor:
        """(M, R) K^-1 (r - S mu)."""
        return self.factor.solve(self.target[:, None]).view(self.residual.shape)

    @cached_property
    def precisions(self) -> Tensor:
        """(M, R, R) blocks of K^-1: of each row's error as the model and all other rows predict it."""
        return diagonal_blocks(self.factor.inverse, len(self.residual))

    @cached_property
    def left_out(self) -> Tensor:
        """(M, R) how far each row is from its prediction by the model and all other rows, m; NaN where hidden."""
        return self.shown(torch.linalg.solve(self.precisions, self.solved[..., None])[..., 0])

    @property
    def left_out_squares(self) -> Tensor:
        """(M,) their squares in units of their covariance."""
        return (self.solved * self.left_out).nansum(1)

    def shown(self, values: Tensor) -> Tensor:
        """Values (M, R) or (M R,), NaN where hidden."""
        return values.view(self.residual.shape).masked_fill(~self.visible, nan)

    def log_evidence(self, scale: float = 1.0) -> float:
        """log N(r; S mu, scale V + S P S^T), but for a constant."""
        target, roots = self.target / scale**0.5, self.slopes @ torch.linalg.cholesky(self.prior / scale)
        factor = self.factor if scale == 1.0 else Factor.of(self.V, roots)
        return factor.log_density(target, factor.solve(target[:, None])[:, 0])

    @cached_property
    def gain(self) -> Tensor:
        """A (k, M R)."""
        weighted = torch.linalg.solve(self.noise, self.S)
        inverse = torch.linalg.inv(self.prior + self.by_fit) + (weighted.mT @ self.S).sum(0)
        return torch.linalg.solve(inverse, weighted.flatten(0, 1).mT)

    @property
    def step(self) -> Tensor:
        """u (k,)."""
        return self.mean + self.gain @ self.target

    @property
    def covariance(self) -> Tensor:
        """U (k, k)."""
        missed = torch.eye(len(self.prior), dtype=self.V.dtype, device=self.V.device) - self.gain @ self.slopes
        return missed @ self.prior @ missed.mT + self.gain @ self.V @ self.gain.mT

    @cached_property
    def after_placing(self) -> Tensor:
        """(M R, M R) what becomes of errors once everything is where the rows fit best, 1 - S A."""
        eye = torch.eye(len(self.slopes), dtype=self.V.dtype, device=self.V.device)
        return eye - self.slopes @ self.gain
