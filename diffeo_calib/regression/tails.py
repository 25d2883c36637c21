"""Noise with heavy tails: Student's t as a Gaussian whose variance differs from measurement to measurement.

A t-distributed error of scale 1 and nu degrees of freedom is Gaussian with variance 1 / w, w unknown. Given the
squared distance d^2 of an error of k coordinates, in units of the noise, the expected weight is

    w = (nu + k) / (nu + d^2),

so that a fit with heavy tails is a sequence of weighted Gaussian fits (expectation maximisation; K. Lange,
R. Little, J. Taylor, "Robust statistical modeling using the t distribution", 1989). nu is estimated together with
the weights. With many clean measurements it goes to infinity, where all weights are 1; with few it becomes large.

Where a share e of the errors is N(0, c R), c large, and the others are N(0, R), Student's t gives the good ones weights
of up to 2.5, which count as known precisions: with 5 % gross rows the deviations of the robot come out half as large as
its errors. There the weights are P(good) + P(gross) / c, never more than one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf, log

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.regression.regions import student_likelihood

FREEDOM_CENTRE, FREEDOM_EFOLDS = 4.0, 2.0
"""Log-normal prior of nu: the most probable one, safe for clean data and for data with outliers, and the standard
deviation of log nu; wide, since a handful of errors hardly determines the tails."""
SMALLEST_FREEDOM, GAUSSIAN_FREEDOM = 2.0, 100.0
"""Bound below which the variance would be infinite, and nu from which noise counts as Gaussian."""
WEIGHT_CHANGE = 0.02
"""Largest relative change of a weight at which it has converged: gross errors make all weights small at first."""
FREEDOM_GRID_POINTS = 400  # points of the logarithmic grid of nu: steps of one percent


@dataclass(frozen=True)
class Tails:
    """How heavy the tails are, and the resulting weight of every measurement."""

    freedom: float  # nu, infinite for Gaussian noise
    weights: Tensor  # (N, P) expected weight of each marker of each row; about 1 for inliers
    gross: bool = False  # whether they are those of good and gross measurements

    @classmethod
    def none(cls, rows: int, markers: int, *, device: torch.device = HOST) -> Tails:
        """Gaussian noise."""
        return cls(inf, torch.ones(rows, markers, dtype=torch.float64, device=device))

    def settled(self, before: Tails) -> bool:
        """Whether no weight has changed by far in a round."""
        return float((self.weights / before.weights - 1.0).abs().max()) < WEIGHT_CHANGE

    def rows(self, index: Tensor | slice) -> Tails:
        """The tails of some rows."""
        return replace(self, weights=self.weights[index])


def reweight(squares: Tensor, dim: int | Tensor) -> Tails:
    """One round of expectation maximisation: the most probable nu for these errors, and the weights it implies.

    nu maximises the likelihood of the errors alone, times the prior, on a logarithmic grid. That of errors and weights
    together would converge slowly (C. Liu, D. Rubin, "The ECME algorithm", 1994): after ten rounds clean data would
    still count as heavy-tailed.

    Args:
        squares: (N, P) squared distances of the errors in units of the noise; NaN where hidden, with weight 1.
        dim: k, coordinates of each error, the same for all or (N, P).
    """
    low, high = log(SMALLEST_FREEDOM), log(1.01 * GAUSSIAN_FREEDOM)
    grid = torch.logspace(low, high, FREEDOM_GRID_POINTS, base=torch.e, dtype=squares.dtype, device=squares.device)
    prior = -0.5 * ((grid / FREEDOM_CENTRE).log() / FREEDOM_EFOLDS).square()
    freedom = float(grid[int((prior + student_likelihood(*_seen(squares, dim), grid)).argmax())])
    if freedom >= GAUSSIAN_FREEDOM:
        return Tails(inf, torch.ones_like(squares))
    return Tails(freedom, ((freedom + dim) / (freedom + squares)).nan_to_num(1.0))


def _seen(squares: Tensor, dim: int | Tensor) -> tuple[Tensor, Tensor]:
    """Squares and numbers of coordinates of the errors that are not hidden: (n,) each."""
    there = ~squares.isnan()
    return squares[there], torch.as_tensor(dim, dtype=squares.dtype, device=squares.device).expand_as(squares)[there]


FACTORS = tuple(25.0 * 4e4 ** (i / 34) for i in range(35))
SHARES = (0.005, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.17, 0.23, 0.3, 0.4)
VARIANCES = (16.0, 4.0, 2.0, 1.0, 0.5, 0.25, 0.12, 0.06, 0.03)
"""Candidates of c, e, and the variance of good errors: noise chosen with gross ones among them is too large."""
FREEDOMS = tuple(2.0 * 100.0 ** (i / 19) for i in range(20))
EVIDENCE = 5.0  # log likelihood by which good and gross must explain errors better than Student's t


def gross_weights(squares: Tensor, dim: int | Tensor) -> Tensor | None:
    """Weights (N, P) of good and gross measurements; None where Student's t explains the errors nearly as well.

    Squares and dim as of :func:`reweight`, of left-out errors: those under the posterior hold the fields' uncertainty.
    """
    d2, k = _seen(squares, dim)
    shares, factors = squares.new_tensor(SHARES)[:, None, None], squares.new_tensor(FACTORS)[:, None]
    freedoms, best, likeliest, student = squares.new_tensor(FREEDOMS), -inf, (0.0, 1.0, 1.0), -inf
    for s in VARIANCES:
        scale = 0.5 * float(k.sum()) * log(s)
        student = max(student, float(student_likelihood(d2 / s, k, freedoms).max()) - scale)
        good, gross = -0.5 * d2 / s, -0.5 * (d2 / (factors * s) + k * factors.log())
        value = torch.logaddexp((1.0 - shares).log() + good, shares.log() + gross).sum(2) - scale
        if float(value.max()) > best:
            share, factor = divmod(int(value.argmax()), len(FACTORS))
            best, likeliest = float(value.max()), (SHARES[share], FACTORS[factor], s)
    if best < student + EVIDENCE:
        return None
    share, c, s = likeliest
    odds = log((1.0 - share) / share) + 0.5 * dim * log(c) - 0.5 * squares / s * (1.0 - 1.0 / c)
    good = torch.sigmoid(odds)
    if float(good.nanmean()) < 0.5:  # noise that is said to be far too small is not gross
        return None
    return (good + (1.0 - good) / c).nan_to_num(1.0)


def estimated(tails: Tails, freedom: Tensor, squares: Callable[..., Tensor], rounds: int = 8) -> Tails:
    """Tails by expectation maximisation, then beside gross measurements, if left-out errors show any.

    Args:
        tails: to begin with. freedom: (N, P) coordinates of each error. rounds: most of either.
        squares: of errors beside some tails, as of :func:`reweight`: of rows that are ``left_out``, or as they are
            expected under the posterior.
    """
    for _ in range(rounds):
        before, tails = tails, reweight(squares(tails, left_out=False), freedom)
        if tails.settled(before):
            break
    for _ in range(rounds):
        weights = gross_weights(squares(tails, left_out=True), freedom)
        if weights is None:
            break
        before, tails = tails, Tails(inf, weights, gross=True)
        if tails.settled(before):
            break
    return tails
