"""Quantiles of values, and of the chi-square and F distributions.

The latter are from `scipy.special`: `scipy.stats` takes half a second to import.

Statistics of values some of which are missing: NaN in the place of what a hidden marker would have shown.

Medians are torch's ``nanmedian``, means ``nanmean``.
"""

from __future__ import annotations

from math import inf, nan
from typing import Any

import numpy as np
import torch
from torch import Tensor

MOST_FOR_TORCH = 1 << 24  # largest number of values for which torch computes quantiles


def quantile(values: Tensor, fraction: float) -> float:
    """The value that the given fraction of values does not exceed; NaN of no values."""
    if not values.numel():
        return nan
    if values.numel() <= MOST_FOR_TORCH:
        return float(torch.quantile(values, fraction))
    return float(np.quantile(values.cpu().numpy(), fraction))


def _special() -> Any:
    """scipy.special, which is slow to import and not needed to use a model."""
    from scipy import special  # noqa: PLC0415

    return special


def chi2_median(freedom: float) -> float:
    """The median of chi-square with this number of degrees of freedom."""
    return chi2_above(0.5, freedom)


def chi2_above(probability: float, freedom: float) -> float:
    """The value that chi-square with this number of degrees of freedom exceeds with this probability."""
    return float(_special().chdtri(freedom, probability))


def chi2_probability(value: float, freedom: float) -> float:
    """The probability that chi-square with this number of degrees of freedom exceeds a value."""
    return float(_special().chdtrc(freedom, value))


def f_below(probability: float, upper: float, lower: float) -> float:
    """The value below which the F ratio of ``upper`` and ``lower`` degrees of freedom lies with this probability."""
    return float(_special().fdtri(upper, lower, probability))


def above_estimated(probability: float, freedom: float, lower: float) -> float:
    """As :func:`chi2_above`, of squares in units of a variance that ``lower`` degrees of freedom estimate."""
    return freedom * f_below(1.0 - probability, freedom, lower)


def binomial_band(count: int, share: float, chance: float) -> tuple[int, int]:
    """The successes of ``count`` trials of probability ``share``: fewer, or more, have at most this chance each."""
    at_most = _special().bdtr(np.arange(count + 1), count, share)
    at_least = 1.0 - np.concatenate([[0.0], at_most[:-1]])
    return int((at_most > chance).argmax()), int(np.flatnonzero(at_least > chance)[-1])


def largest_known(values: Tensor, dim: int = 1) -> Tensor:
    """Largest value along an axis, NaN left out; NaN where there is nothing else."""
    largest = values.nan_to_num(-inf, posinf=inf).amax(dim)
    return largest.masked_fill(values.isnan().all(dim), float("nan"))


def known(values: Tensor) -> Tensor:
    """The values that are not NaN, in one row."""
    return values[~values.isnan()]
