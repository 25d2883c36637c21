"""Arrays that come from outside, as float64: all kinds that hold real numbers, and no other kind. NumPy alone."""

from __future__ import annotations

import numpy as np

ARRAY_KINDS = {
    "b": "booleans",
    "c": "complex numbers",
    "m": "time differences",
    "M": "dates",
    "V": "records with named fields",
}
"""What NumPy would convert to numbers, or cut down to real ones, without a warning."""


def real_array(value: object) -> np.ndarray:
    """Convert anything but a tensor to a float64 array.

    Raises:
        TypeError, ValueError, OverflowError, RecursionError: no real numbers.
    """
    found = value if isinstance(value, np.ndarray) else np.asarray(value)
    if found.dtype.kind in ARRAY_KINDS:
        raise TypeError(ARRAY_KINDS[found.dtype.kind])
    if isinstance(found, np.ma.MaskedArray) and bool(np.ma.getmaskarray(found).any()):
        raise ValueError("masked values, which are missing")
    if found.dtype == object and any(isinstance(entry, (bool, np.bool_, np.datetime64)) for entry in found.flat):
        raise TypeError("objects that are no numbers")
    # torch wants memory that may be written to, and forwards; columns of data frames are often read-only
    return np.require(found, np.float64, ["C", "W", "E"])
