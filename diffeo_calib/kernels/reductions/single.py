"""Sums over all pairs in single precision, added up in double precision: half the time on a CPU.

Squared distances of points L apart have errors of a few units in the last place of L^2, so that the clouds must not be
large at the accuracy asked for.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions.formulas import Formula, Points
from diffeo_calib.kernels.reductions.fused.sums import FUSED
from diffeo_calib.kernels.reductions.nearby import DERIVATIVES
from diffeo_calib.kernels.reductions.tiled import CPU_ELEMENTS, GPU_ELEMENTS, Tiled

ROUNDING = 2.0**-22
"""Error of a pair, relative to the largest square of a feature: four units in the last place."""
LARGEST_DERIVATIVE = 1e3
"""Of profiles at zero distance: beyond it rounding of the distance of close points would count."""
RANGE = 1e15
"""Of the largest momentum, and of directions: products of two of them must neither overflow nor vanish."""
SMALLEST_PAIRS = 1 << 20
"""Pairs below which converting the points is not worth it."""


def sums(
    formula: Formula, profile: Profile, rows: Points | None, columns: Points, accuracy: float
) -> tuple[Tensor, ...] | None:
    """The results of a formula within an accuracy; None where rounding would exceed it. As :func:`fourier.sums`."""
    at = columns if rows is None else rows
    if len(at.features) * len(columns.features) < SMALLEST_PAIRS or columns.features.dtype != torch.float64:
        return None
    coinciding = profile.derivative(torch.zeros((), dtype=torch.float64, device=HOST), DERIVATIVES)
    if float(coinciding.abs()) > LARGEST_DERIVATIVE:
        return None
    with torch.no_grad():
        largest = max(float(t.features.square().sum(-1).max()) for t in (at, columns))
        if ROUNDING * max(1.0, largest) > accuracy or not _in_range(at) or not _in_range(columns):
            return None
        points = (None if rows is None else _single(rows), _single(columns))
        elements = 2 * (CPU_ELEMENTS if at.features.device.type == "cpu" else GPU_ELEMENTS)
        found = FUSED.reduce(formula, profile, *points, dtype=torch.float64)
        return found or Tiled(elements, totals=torch.float64).reduce(formula, profile, *points)


def _in_range(points: Points) -> bool:
    sizes = [float(t.abs().max()) for t in (points.momenta, points.d_features, points.d_momenta) if t is not None]
    return all(size == 0.0 or 1.0 / RANGE < size < RANGE for size in sizes)


def _single(points: Points) -> Points:
    return Points(*(None if t is None else t.to(torch.float32) for t in points))
