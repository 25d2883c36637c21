"""Noise with heavy tails: Student's t as a Gaussian whose variance differs from measurement to measurement.

A t-distributed error of scale 1 and nu degrees of freedom is Gaussian with variance 1 / w, w unknown. Given the
squared distance d^2 of an error of k coordinates, in units of the noise, the expected weight is

    w = (nu + k) / (nu + d^2),

so that a fit with heavy tails is a sequence of weighted Gaussian ones (expectation maximisation; K. Lange,
R. Little, J. Taylor, "Robust statistical modeling using the t distribution", 1989). nu is estimated with the
weights: clean data drive it to infinity, where all weights are 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, log

import torch
from torch import Tensor

FEWEST_FREEDOM = 2.0
"""Smallest nu: below it the variance is infinite."""
GAUSSIAN = 100.0
"""nu from which noise counts as Gaussian."""
FIRST = 4.0
"""nu to start with: safe for clean and for dirty data."""
SPREAD = 2.0
"""Log-normal prior of nu around :data:`FIRST`, e-folds: a handful of errors says little about tails."""


@dataclass(frozen=True)
class Tails:
    """How heavy the tails are, and what that means for every measurement.

    Args:
        freedom: nu, infinite for Gaussian noise.
        weights: (N, P) expected weight of each marker of each row; about 1 for good ones.
    """

    freedom: float
    weights: Tensor

    @classmethod
    def none(cls, rows: int, markers: int) -> Tails:
        """Gaussian noise."""
        return cls(inf, torch.ones(rows, markers, dtype=torch.float64))

    def rows(self, index: Tensor | slice) -> Tails:
        """The tails of some rows."""
        return Tails(self.freedom, self.weights[index])


def reweight(squares: Tensor, dim: int, freedom: float = FIRST) -> Tails:
    """One step of expectation maximisation: weights for the old nu, and the new nu for these weights.

    Args:
        squares: (N, P) squared distances of the errors in units of the noise.
        dim: k, coordinates of each.
        freedom: nu so far; infinite counts as :data:`GAUSSIAN`.
    """
    nu = min(freedom, GAUSSIAN)
    weights = (nu + dim) / (nu + squares)
    half = torch.tensor((nu + dim) / 2.0, dtype=torch.float64)
    excess = float((torch.digamma(half) - ((nu + squares) / 2.0).log() - weights).mean())  # E[log w] - E[w]
    updated = _freedom(excess, squares.numel())
    if updated >= GAUSSIAN:
        return Tails(inf, torch.ones_like(weights))
    return Tails(updated, (updated + dim) / (updated + squares))


def _freedom(excess: float, count: int) -> float:
    """Maximise count (nu/2 log(nu/2) - log Gamma(nu/2) + nu/2 excess) + log prior over nu, on a logarithmic grid."""
    grid = torch.logspace(log(FEWEST_FREEDOM), log(1.01 * GAUSSIAN), 400, base=torch.e, dtype=torch.float64)
    half = grid / 2.0
    value = count * (half * half.log() - torch.lgamma(half) + half * excess)
    prior = -0.5 * ((grid / FIRST).log() / SPREAD).square()
    return float(grid[int((value + prior).argmax())])
