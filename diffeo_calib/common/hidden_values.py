"""Statistics of values some of which are missing: NaN in the place of what a hidden marker would have shown.

Medians are torch's ``nanmedian``, means ``nanmean``.
"""

from __future__ import annotations

from math import inf

from torch import Tensor


def largest_known(values: Tensor, dim: int = 1) -> Tensor:
    """Largest value along an axis, NaN left out; NaN where there is nothing else."""
    found = values.nan_to_num(-inf, posinf=inf).amax(dim)
    return found.masked_fill(values.isnan().all(dim), float("nan"))


def known(values: Tensor) -> Tensor:
    """The values that are not NaN, in one row."""
    return values[~values.isnan()]
