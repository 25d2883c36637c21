"""Small helpers on NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def as_index(columns: Sequence[int]) -> slice | list[int]:
    """Columns as an index; consecutive ones as a slice, which makes no copy."""
    columns = list(columns)
    consecutive = bool(columns) and columns == list(range(columns[0], columns[0] + len(columns)))
    return slice(columns[0], columns[-1] + 1) if consecutive else columns


def cross(a: Array, b: Array) -> Array:
    """a x b along the last axis; several times faster than np.cross on few rows."""
    return a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]


_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
