"""What rows say of unknowns u that a hypothesis opens.

With errors r of covariance K, and effects E of the unknowns,

    g = E^T K^-1 r,    H = E^T K^-1 E,    u = H^-1 g,    cov(u) = H^-1.

They explain the gain g^T u of r^T K^-1 r: by chance chi-squared, one degree of freedom per unknown. With a prior
N(0, s^2) of the unknowns the log evidence grows by

    1/2 g^T (H + s^-2)^-1 g - 1/2 log |1 + s^2 H|.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.regression.conditional import Process

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
