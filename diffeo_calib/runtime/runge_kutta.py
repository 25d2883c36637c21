"""Tableaus of the explicit Runge-Kutta methods, by their names in model files."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from diffeo_calib.runtime.arrays import Array

Tableau = tuple[Array, Array]
"""Coefficients (s, s), strictly lower triangular, and weights (s,)."""


@cache
def rk4() -> Tableau:
    """The classical method of order 4."""
    coefficients = [[0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    return np.array(coefficients), np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6])


@cache
def rk8() -> Tableau:
    """The method of order 8 by Dormand and Prince; coefficients from SciPy."""
    from scipy.integrate import DOP853  # noqa: PLC0415  # slow to import, and not the default

    return DOP853.A.copy(), DOP853.B.copy()


MOST_STEPS = 1024
"""Largest number of steps on [0, 1]: errors are pure rounding long before."""

TABLEAUS: dict[str, Callable[[], Tableau]] = {"rk4": rk4, "rk8": rk8}
