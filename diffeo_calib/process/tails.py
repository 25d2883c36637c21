"""Good or gross: noise with a share of gross errors, as Gaussians whose variance differs between measurements.

Errors of good measurements are N(0, R), those of gross ones N(0, c R). The share e of gross ones and c are those of the
largest likelihood of all errors; a measurement then counts with its expected precision (expectation maximisation),

    w = P(good) + P(gross) / c,

never more than a good one. Student's t would give good measurements among gross ones weights above one, which count as
known precisions: with 5 % gross rows the deviations of the robot would come out half as large as its errors. It is used
where the errors themselves have heavy tails, such as those of a camera far from its board, and are likelier by it (K.
Lange, R. Little, J. Taylor, "Robust statistical modeling using the t distribution", 1989),

    w = (nu + k) / (nu + d^2)    for squared distances d^2 of k coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, log

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.quantiles import chi2_above, chi2_probability
from diffeo_calib.regression.regions import region_factor

FACTORS = torch.logspace(log(3.0), log(1e6), 45, base=torch.e, dtype=torch.float64).tolist()
"""Candidates of c. Small ones with large shares are noise with heavy tails, such as a camera's."""
SHARES = (0.005, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.17, 0.23, 0.3, 0.4)
"""Candidates of e, beside none."""
FREEDOMS = torch.logspace(log(2.0), log(50.0), 30, base=torch.e, dtype=torch.float64).tolist()
"""Candidates of nu."""
SMALLER = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)
"""Candidates where the noise was chosen before the gross errors were known, which then made it too large."""
EVIDENCE = 2.0
"""Log likelihood that gross errors must gain."""
GROSS_WEIGHT = 0.05
"""Weight below which a measurement counts as gross: no region is meant to hold it."""
CONFIDENCE = 0.95
HALVINGS = 60


@dataclass(frozen=True)
class Tails:
    """How many measurements are gross, how large their errors are, and the resulting weight of every measurement.

    Args:
        share: e, probability that a measurement is gross; zero for Gaussian noise.
        factor: c, variance of gross errors relative to good ones.
        weights: (N, P) expected precision of each marker of each row, relative to a good one: between 1 / c and 1.
        freedom: nu of Student's t where that explains the errors better; e is zero then. Infinite otherwise.
    """

    share: float
    factor: float
    weights: Tensor
    freedom: float = inf

    @classmethod
    def none(cls, rows: int, markers: int, *, device: torch.device = HOST) -> Tails:
        """Gaussian noise."""
        return cls(0.0, 1.0, torch.ones(rows, markers, dtype=torch.float64, device=device))

    def rows(self, index: Tensor | slice) -> Tails:
        """The tails of some rows."""
        return replace(self, weights=self.weights[index])

    def weighed(self, squares: Tensor, dim: int | Tensor) -> Tails:
        """The weights of other errors with the same share and factor; arguments as of :func:`reweight`."""
        if self.freedom < inf:
            return replace(self, weights=((self.freedom + dim) / (self.freedom + squares)).nan_to_num(1.0))
        if self.share == 0.0:
            return Tails(0.0, 1.0, torch.ones_like(squares))
        good = torch.sigmoid(_log_odds(squares, dim, self.share, self.factor))
        return Tails(self.share, self.factor, (good + (1.0 - good) / self.factor).nan_to_num(1.0))

    def region_factor(self, dim: int) -> float:
        """Factor on the variance of good errors whose 95 % region holds 95 % of new measurements that are not gross."""
        if self.share == 0.0:
            return region_factor(self.freedom, dim) if self.freedom < inf else 1.0
        end = _largest_square(self.share, self.factor, dim)

        def held(square: float) -> float:
            wrong = chi2_probability(square / self.factor, dim)
            return 1.0 - (1.0 - self.share) * chi2_probability(square, dim) - self.share * wrong

        wanted, low, high = CONFIDENCE * held(end), 0.0, end
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if held(middle) >= wanted else (middle, high)
        return max(high / chi2_above(1.0 - CONFIDENCE, dim), 1.0)


def reweight(
    squares: Tensor, dim: int | Tensor, scales: Sequence[float] = (1.0,), *, kinds: Tensor | None = None
) -> Tails:
    """One round of expectation maximisation: the likeliest share and size of gross errors, and the weights they imply.

    Args:
        squares: (N, P) squared distances of the errors in units of the noise; NaN where hidden, with weight 1.
        dim: k, coordinates of each error, the same for all or (N, P).
        scales: candidates of the variance of good errors in units of the noise, see :data:`SMALLER`.
        kinds: (N, P) numbers of kinds of measurements with gross errors of their own. Share and factor are then those
            of the most frequent kind.
    """
    seen = ~squares.isnan()
    if kinds is not None:
        numbers, counts = kinds[seen].unique(return_counts=True)
        each = [reweight(squares.masked_fill(kinds != number, torch.nan), dim, scales) for number in numbers]
        weights = torch.stack([one.weights for one in each]).amin(0)  # one where a kind has nothing to say
        return replace(each[int(counts.argmax())], weights=weights)
    own, k = squares[seen], dim if isinstance(dim, int) else dim[seen]
    shares = squares.new_tensor(SHARES)[:, None]
    best, found, heavy = EVIDENCE, (0.0, 1.0, 1.0), inf
    for scale in scales:
        smaller = -0.5 * (own * (1.0 / scale - 1.0) + k * log(scale))
        for factor in FACTORS:
            gross = shares.log() - _log_odds(own / scale, k, 0.5, factor)
            gain = (torch.logaddexp((1.0 - shares).log(), gross) + smaller).sum(1)
            if float(gain.max()) > best:
                best, found = float(gain.max()), (SHARES[int(gain.argmax())], factor, scale)
    for freedom in FREEDOMS:
        gain = float((_log_student(own, k, freedom) + 0.5 * own).sum())
        if gain > best:
            best, found = gain, (0.0, 1.0, 1.0)
            heavy = freedom
    share, factor, scale = found
    return Tails(share, factor, squares, heavy if share == 0.0 else inf).weighed(squares / scale, dim)


def _log_student(squares: Tensor, dim: int | Tensor, freedom: float) -> Tensor:
    """log density of Student's t relative to that of a Gaussian at zero distance."""
    k, nu = torch.as_tensor(dim, dtype=squares.dtype, device=squares.device), squares.new_tensor(freedom)
    level = torch.lgamma(0.5 * (nu + k)) - torch.lgamma(0.5 * nu) - 0.5 * k * (0.5 * nu).log()
    return level - 0.5 * (nu + k) * (squares / nu).log1p()


def _log_odds(squares: Tensor, dim: int | Tensor, share: float, factor: float) -> Tensor:
    """log P(good) / P(gross), like the squares."""
    spread = 0.5 * dim * log(factor)
    return log((1.0 - share) / share) + spread - 0.5 * squares * (1.0 - 1.0 / factor)


def _largest_square(share: float, factor: float, dim: int) -> float:
    """The squared distance from which a measurement counts as gross; a very large one if none does."""
    if factor * GROSS_WEIGHT <= 1.0:
        return 1e3 * factor
    good = (GROSS_WEIGHT - 1.0 / factor) / (1.0 - 1.0 / factor)
    odds = log((1.0 - share) / share) + 0.5 * dim * log(factor) - log(good / (1.0 - good))
    return 2.0 * odds / (1.0 - 1.0 / factor)
