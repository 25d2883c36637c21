"""Quantiles of the chi-square and F distributions from `scipy.special`: `scipy.stats` takes half a second to import."""

from __future__ import annotations


def chi2_median(freedom: float) -> float:
    """The median of chi-square with this number of degrees of freedom."""
    return chi2_above(0.5, freedom)


def chi2_above(probability: float, freedom: float) -> float:
    """The value that chi-square with this number of degrees of freedom exceeds with this probability."""
    from scipy.special import chdtri  # noqa: PLC0415  # slow to import, not needed to use a model

    return float(chdtri(freedom, probability))


def f_below(probability: float, upper: float, lower: float) -> float:
    """The value below which the F ratio of ``upper`` and ``lower`` degrees of freedom lies with this probability."""
    from scipy.special import fdtri  # noqa: PLC0415  # see above

    return float(fdtri(upper, lower, probability))
