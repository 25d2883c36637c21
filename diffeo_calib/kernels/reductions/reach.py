"""Where a kernel and its spectral density are negligible, at length scale 1. For sums within an accuracy.

Bounds hold for the kernel as a function of the difference of two points and for its first two derivatives, which all
formulas are made of.
"""

from __future__ import annotations

from functools import lru_cache
from math import gamma, pi

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.kernels.profiles import Profile

DERIVATIVES = 2
"""The highest derivative of the kernel in a formula."""
STEPS, FARTHEST = 4096, 60.0
"""Distances and frequencies that are looked at."""


@lru_cache(maxsize=256)
def negligible_beyond(profile: Profile, dim: int, accuracy: float) -> float | None:
    """The distance beyond which the kernel of ``dim`` features and its derivatives are below an accuracy, if any.

    A factor of 3^dim is left for the copies of a kernel on a lattice.
    """
    r = _grid()
    kappa = profile.derivatives(r.square(), DERIVATIVES)
    second = 2 * kappa[1].abs() + 4 * r.square() * kappa[2].abs()
    size = torch.stack([kappa[0].abs(), 2 * r * kappa[1].abs(), second]).amax(0)
    return _first_below(3.0**dim * size.flip(0).cummax(0).values.flip(0), accuracy)


@lru_cache(maxsize=256)
def bandwidth(profile: Profile, dim: int, accuracy: float) -> float | None:
    """The frequency beyond which the spectral density, with its first two moments, adds up to less than an accuracy."""
    w = _grid()
    density = profile.spectral_density(w.square(), dim)
    if density is None:
        return None
    shell = density * (2.0 * pi ** (dim / 2) / gamma(dim / 2)) * w ** (dim - 1) * (FARTHEST / STEPS)
    beyond = torch.stack([shell * w**k for k in range(DERIVATIVES + 1)]).flip(1).cumsum(1).flip(1)
    return _first_below(beyond.amax(0), accuracy)


def _grid() -> Tensor:
    return torch.linspace(0.0, FARTHEST, STEPS + 1, dtype=torch.float64, device=HOST)[1:]


def _first_below(values: Tensor, level: float) -> float | None:
    """Where on the grid decreasing values fall below a level."""
    below = values < level
    return float(_grid()[below][0]) if bool(below[-1]) else None
