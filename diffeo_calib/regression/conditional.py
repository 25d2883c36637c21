"""The interface of all ways to condition on the data, and the part that Cholesky and conjugate gradients share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.linearisation import Linearisation

NOISE_ADVICE = "raise `noise` or lower the kernels' variances"
"""How to repair a matrix that float64 cannot factorise."""
BLOCK_ENTRIES = 1 << 21
"""Number of covariances between data and queries that are computed together (16 MiB, within usual caches)."""


class Features(NamedTuple):
    """Features f at M configurations: what parameters and data add to the covariance of the fields, a column each.

    covariance(x, x') = F(x, x') + sum_k sign_k f_k(x) f_k(x')^T, with F that of the fields alone.

    Args:
        values: (k, M m). signs: (k,) 1 or -1.
    """

    values: Tensor
    signs: Tensor

    @classmethod
    def of(cls, *parts: tuple[Tensor, int]) -> Features:
        """Several features (k_i, M m), each with its sign."""
        signs = [values.new_full((len(values),), float(sign)) for values, sign in parts]
        return cls(torch.cat([values for values, _ in parts]), torch.cat(signs))


class Conditional(ABC):
    """The Gaussian conditional of one linearisation on the data.

    Shifts that rows of the data share are parameters of unit variance after those of the nominal map. Linearisations
    that take part in some have columns for all; others have none.

    Attributes:
        size: number of measured coordinates or momenta that are conditioned on.
    """

    size: int

    @property
    def inner(self) -> Conditional:
        """The same with rigid motions, where they are left out."""
        return self

    @abstractmethod
    def features(self, at: Linearisation) -> Features:
        """Features of a linearisation, from which covariances between any of its configurations follow cheaply.

        Raises:
            InputError: the conditional is computed by iteration and has no features.
        """

    def posterior(self, at: Linearisation) -> Tensor:
        """Posterior covariance at the M configurations of a projected linearisation, all at once: (M, r, r).

        Nothing large cancels in covariances from features.
        """
        values, signs = self.features(at)
        values = values.T.reshape(*at.sensitivity.shape[:2], -1)
        return at.fields.own_blocks() + (values * signs) @ values.mT

    def covariance_between(self, at: Linearisation, other: Linearisation | None = None) -> Tensor:
        """Posterior covariance of k1 between two linearisations, by default the same: (M m, M' m') in m^2."""
        mine, signs = self.features(at)
        theirs = mine if other is None else self.features(other).values
        return at.fields.gram(None if other is None else other.fields) + (mine.T * signs) @ theirs

    def compared(self, points: Tensor, targets: Tensor, fit: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Points (M, 3) as they are compared with targets, m: rigid motions are errors like others.

        Args:
            fit: the best rigid transform (4, 4) from points to targets.
        """
        return points

    def covariance(self, at: Linearisation, directions: Tensor | None = None) -> Tensor:
        """Posterior covariance of k1 at the M configurations of a linearisation.

        Args:
            directions: (M, r, m) linear functions of k1(x) whose covariance is wanted instead of that of all m
                coordinates. The fewer, the faster.

        Returns:
            (M, r, r), in m^2 without directions.
        """
        count, m, _ = at.sensitivity.shape
        if directions is None:
            directions = torch.eye(m, dtype=at.sensitivity.dtype, device=at.sensitivity.device).expand(count, m, m)
        wanted = directions.shape[1]
        blocks = [at.sensitivity.new_zeros(0, wanted, wanted)]
        together = max(1, BLOCK_ENTRIES // max(wanted * self.size, 1))
        for rows in torch.arange(count, device=directions.device).split(together) if count else ():
            blocks.append(self.posterior(at.rows(rows).projected(directions[rows])))
        return torch.cat(blocks)


class DataConditional(Conditional):
    """Conditioning with all N data of m numbers as control points; the unknown is mu, the momentum at time 1.

    Args:
        linearisation: first-order response of k1 at the data to fields and parameters.
    """

    def __init__(self, linearisation: Linearisation) -> None:
        self.linearisation, self.size = linearisation, linearisation.sensitivity.shape[:2].numel()

    @abstractmethod
    def solve(self, values: Tensor) -> Tensor:
        """(G + R)^-1 values: (N, m, k) -> (N, m, k)."""

    def mu(self, target: Tensor) -> Tensor:
        """(G + R)^-1 target: (N, m) -> (N, m)."""
        return self.solve(target[:, :, None])[:, :, 0]

    def momenta(self, target: Tensor) -> Momenta:
        """Posterior mode of b, p, theta: mu transported back to time 0.

        Args:
            target: (N, m) measured minus linearised model at zero fields, m.
        """
        return self.linearisation.momenta(self.mu(target))

    def explained(self, cross: Tensor) -> Tensor:
        """cross (G + R)^-1 cross^T for several matrices: (M, r, N m) -> (M, r, r)."""
        columns = cross.flatten(0, 1).T.reshape(*self.linearisation.sensitivity.shape[:2], -1)  # (N, m, M r)
        return cross @ self.solve(columns).flatten(0, 1).view(-1, *cross.shape[:2]).movedim(0, 1)


def of_parameters(at: Linearisation, count: int) -> Tensor:
    """Derivatives (M, r, count) by all parameters, zero by shifts of which a linearisation says nothing."""
    return torch.nn.functional.pad(at.sensitivity, (0, count - at.sensitivity.shape[2]))


def diagonal_blocks(matrix: Tensor, rows: int) -> Tensor:
    """The diagonal blocks of a matrix: (M m, M m) -> (M, m, m)."""
    m = len(matrix) // max(rows, 1)
    index = torch.arange(rows, device=matrix.device)
    return matrix.view(rows, m, rows, m)[index, :, index, :]
