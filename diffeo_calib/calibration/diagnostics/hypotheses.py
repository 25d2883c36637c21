"""What is wrong? A hypothesis opens unknowns u, and the rows say how much these explain.

With errors r of covariance K, and effects E of the unknowns,

    g = E^T K^-1 r,    H = E^T K^-1 E,    u = H^-1 g,    cov(u) = H^-1.

They explain the gain g^T u of r^T K^-1 r: by chance chi-squared, one degree of freedom per unknown. With a prior
N(0, s^2) of the unknowns the log evidence grows by

    1/2 g^T (H + s^-2)^-1 g - 1/2 log |1 + s^2 H|.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.process.process import Process
from diffeo_calib.regression.factor import Factor

RELATIVE_RIDGE = 1e-9
"""Relative size of the diagonal that keeps H invertible where rows do not determine all unknowns."""


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
        return cls(E.T @ process.mu, E.T @ process.factor.solve(E), float(target @ process.mu), len(target))

    @classmethod
    def by(cls, E: Tensor, r: Tensor, factor: Tensor) -> Evidence:
        """By errors (M,), with effects (M, U) on them and the Cholesky factor (M, M) of K."""
        white = torch.linalg.solve_triangular(factor, torch.cat([r[:, None], E], 1), upper=False)
        r, E = white[:, 0], white[:, 1:]
        return cls(E.T @ r, E.T @ E, float(r @ r), len(r))

    @property
    def size(self) -> Tensor:
        """(..., U) the most probable unknowns."""
        level = RELATIVE_RIDGE * self.H.diagonal(dim1=-2, dim2=-1).amax()
        H = self.H + level * torch.eye(self.H.shape[-1], dtype=level.dtype, device=level.device)
        return (torch.linalg.pinv(H, hermitian=True) @ self.g[..., None])[..., 0]

    @property
    def gain(self) -> Tensor:
        """(...) what they explain."""
        return (self.g * self.size).sum(-1)

    @property
    def excess(self) -> float:
        """Mean square, at least one, of what they leave unexplained: of errors that K understates."""
        return max(1.0, (self.total - float(self.gain)) / self.count)

    def log_odds(self, variances: Tensor) -> Tensor:
        """(S, ...) by how much the log evidence grows with a prior of each variance (S,)."""
        h, V = torch.linalg.eigh(self.H)
        scaled = variances[:, None] * h.clamp(min=0.0)  # (S, U)
        gains = torch.einsum("su,...u->s...", variances[:, None] / (1.0 + scaled), (self.g @ V).square())
        return 0.5 * (gains - scaled.log1p().sum(1).view(-1, *[1] * (gains.ndim - 1)))


def opened(process: Process, E: Tensor) -> Process:
    """The same rows beside unknowns of any size, with effects (M, U) on their numbers."""
    E = E / E.norm(dim=0).clamp(min=torch.finfo(E.dtype).tiny)
    W = torch.linalg.solve_triangular(process.factor.L, E, upper=False)
    factor, variance = Factor(process.factor.L, torch.cat([process.factor.W, W], 1)), E.new_ones(E.shape[1])
    return replace(process, variance=torch.cat([process.variance, variance]), factor=factor)


def worth_it(before: Tensor, after: Tensor) -> bool:
    """Whether left-out errors (N, m), m, prove unknowns that were opened: most of them, and not a few large ones."""
    first, second = before.square().nansum(1), after.square().nansum(1)
    gain = first - second
    sure = float(gain.mean()) > gates.SURE * float(gain.std()) / len(gain) ** 0.5
    return sure and float(second.mean()) < gates.WORTH**2 * float(first.mean())


def left_out_rms(process: Process) -> float:
    """RMS of the errors of rows, m, as all other rows predict them."""
    total, numbers = 0.0, process.numbers
    for part, block in zip(numbers.parts, numbers.diagonal_blocks(process.inverse), strict=True):
        mu = process.mu[part.numbers].view(*part.cells.shape, 1)
        total += float(torch.linalg.solve(block, mu).square().sum())
    return (total / len(numbers.q)) ** 0.5
