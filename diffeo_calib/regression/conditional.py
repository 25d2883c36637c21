"""The interface of all ways to condition on the data, and the part that Cholesky and conjugate gradients share."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.linearisation import Linearisation

NOISE_ADVICE = "raise `noise` or lower the kernels' variances"
"""How to repair a matrix that float64 cannot factorise."""


class Conditional(ABC):
    """The Gaussian conditional of one linearisation on the data."""

    @abstractmethod
    def momenta(self, target: Tensor) -> Momenta:
        """Posterior mode of b, p, theta.

        Args:
            target: (N, m) measured minus linearised model at zero fields, m.
        """

    @abstractmethod
    def covariance(self, at: Linearisation) -> Tensor:
        """Posterior covariance of k1 at the M configurations of a linearisation: (M, m, m) in m^2."""


class DataConditional(Conditional):
    """Conditioning with all data as control points; the unknown is mu, the momentum at time 1.

    Args:
        linearisation: first-order response of k1 at the data to fields and parameters.
    """

    def __init__(self, linearisation: Linearisation) -> None:
        self.linearisation = linearisation

    @abstractmethod
    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k)."""

    def mu(self, target: Tensor) -> Tensor:
        """(G + R)^-1 target: (N, m) -> (N, m)."""
        return self.solve(target[:, :, None])[:, :, 0]

    def momenta(self, target: Tensor) -> Momenta:
        """mu transported back to time 0."""
        return self.linearisation.momenta(self.mu(target))

    def covariance(self, at: Linearisation) -> Tensor:
        """G(x, x) - G(x, data) (G + R)^-1 G(data, x), its diagonal blocks."""
        cross = self.linearisation.gram(at)  # (N m, M m'), where other points may have another m'
        shaped = cross.view(*self.linearisation.sensitivity.shape[:2], cross.shape[1])
        return diagonal_blocks(at.gram() - self.explained(shaped), len(at.sensitivity))

    def explained(self, cross: Tensor) -> Tensor:
        """cross^T (G + R)^-1 cross: (N, m, k) -> (k, k)."""
        return cross.flatten(0, 1).T @ self.solve(cross).flatten(0, 1)


def diagonal_blocks(matrix: Tensor, rows: int) -> Tensor:
    """The diagonal blocks of a matrix: (M m, M m) -> (M, m, m)."""
    m = len(matrix) // max(rows, 1)
    index = torch.arange(rows, device=matrix.device)
    return matrix.view(rows, m, rows, m)[index, :, index, :]
