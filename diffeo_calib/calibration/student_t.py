"""Noise with heavy tails: Student's t as a Gaussian whose variance differs from measurement to measurement.

A t-distributed error of scale 1 and nu degrees of freedom is Gaussian with variance 1 / w, w unknown. Given the
squared distance d^2 of an error of k coordinates, in units of the noise, the expected weight is

    w = (nu + k) / (nu + d^2),

so that a fit with heavy tails is a sequence of weighted Gaussian ones (expectation maximisation; K. Lange,
R. Little, J. Taylor, "Robust statistical modeling using the t distribution", 1989). nu is estimated with the
weights: many clean data drive it to infinity, where all weights are 1; a few make it large.
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
LIKELY = 4.0
"""Centre of the log-normal prior of nu: safe for clean and for dirty data."""
SPREAD = 2.0
"""Its width, e-folds: a handful of errors says little about tails."""


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


def reweight(squares: Tensor, dim: int) -> Tails:
    """One round of expectation maximisation: the nu that makes the errors most likely, and the weights for it.

    Args:
        squares: (N, P) squared distances of the errors in units of the noise.
        dim: k, coordinates of each.
    """
    freedom = _freedom(squares.flatten(), dim)
    if freedom >= GAUSSIAN:
        return Tails(inf, torch.ones_like(squares))
    return Tails(freedom, (freedom + dim) / (freedom + squares))


def _freedom(squares: Tensor, dim: int) -> float:
    """Maximise the likelihood of t-distributed errors, times the prior, over nu on a logarithmic grid.

    Of the errors themselves, not of errors and weights together, which would creep (C. Liu, D. Rubin, "The ECME
    algorithm", 1994): after ten rounds clean data would still count as heavy-tailed.
    """
    grid = torch.logspace(log(FEWEST_FREEDOM), log(1.01 * GAUSSIAN), 400, base=torch.e, dtype=torch.float64)
    half = (grid + dim) / 2.0
    distances = torch.stack([(squares / nu).log1p().sum() for nu in grid])
    value = squares.numel() * (torch.lgamma(half) - torch.lgamma(grid / 2.0) - 0.5 * dim * grid.log())
    prior = -0.5 * ((grid / LIKELY).log() / SPREAD).square()
    return float(grid[int((value - half * distances + prior).argmax())])
