"""Covariance of the measurements, one block per configuration."""

from __future__ import annotations

from copy import copy

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError


class Noise:
    """Covariance blocks R_i (N, m, m) of the measurements, and their Cholesky factors.

    Raises:
        InputError: a block is not symmetric positive definite.
    """

    def __init__(self, covariance: Tensor) -> None:
        self.covariance = covariance
        factor, info = torch.linalg.cholesky_ex(covariance)
        bad = (info > 0) | ~torch.isclose(covariance, covariance.mT, rtol=1e-9, atol=0.0).flatten(1).all(1)
        if bool(bad.any()):
            raise InputError.of(
                "`noise`",
                expected="symmetric positive definite blocks (N, m, m) in m^2",
                got=f"{int(bad.sum())} invalid block(s), the first at row {int(bad.nonzero()[0])}",
            )
        self._factor = factor

    def to(self, device: torch.device | str) -> Noise:
        """The same noise on a device."""
        moved = copy(self)
        moved.covariance, moved._factor = self.covariance.to(device), self._factor.to(device)
        return moved

    def solve(self, residual: Tensor) -> Tensor:
        """R^-1 r: (N, m) -> (N, m)."""
        return torch.cholesky_solve(residual[:, :, None], self._factor)[:, :, 0]

    def multiply(self, values: Tensor) -> Tensor:
        """R values: (N, m, k) -> (N, m, k)."""
        return self.covariance @ values

    def whiten(self, values: Tensor, rows: Tensor | slice = slice(None)) -> Tensor:
        """C^-1 values with R = C C^T, for all configurations or for ``rows``: (N, m, k) -> (N, m, k)."""
        return torch.linalg.solve_triangular(self._factor[rows], values, upper=False)

    def unwhiten(self, values: Tensor) -> Tensor:
        """C^-T values with R = C C^T: (N, m, k) -> (N, m, k)."""
        return torch.linalg.solve_triangular(self._factor.mT, values, upper=True)

    def add_to(self, gram: Tensor) -> Tensor:
        """G + blockdiag(R): (N m, N m)."""
        n, m, _ = self.covariance.shape
        out = gram.clone()
        blocks = out.view(n, m, n, m)
        index = torch.arange(n, device=gram.device)
        blocks[index, :, index, :] = blocks[index, :, index, :] + self.covariance
        return out
