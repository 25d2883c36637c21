"""Sums of short kernels over nearby pairs: blocks of points that are too far apart to matter are left out.

Points are sorted into blocks by halving the cloud across its longest side, until a block has few points. Two blocks
interact if their boxes come closer than the distance beyond which the kernel and its first two derivatives are below
the accuracy. It pays where length scales are much smaller than the cloud of points; fourier.py pays where they are not.

Where a kernel and its spectral density are negligible is found at length scale 1, from samples. Bounds hold for the
kernel as a function of the difference of two points and for its first two derivatives, of which all formulas are made.
"""

from __future__ import annotations

from functools import lru_cache
from math import gamma, pi

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.reductions.formulas import Formula, Points
from diffeo_calib.kernels.reductions.fused.sums import FUSED
from diffeo_calib.kernels.reductions.tiled import Tiled

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


BLOCK = 128
"""Most points of a block: small enough for tight boxes, large enough for the overhead of a block."""
WORTHWHILE_NEAR_SHARE = 0.7
"""Share of near pairs below which it pays. Sums over all pairs of one cloud visit half of them."""


def sums(
    formula: Formula, profile: Profile, rows: Points | None, columns: Points, accuracy: float
) -> tuple[Tensor, ...] | None:
    """The results of a formula within an accuracy; None where too many pairs are near. As :func:`fourier.sums`."""
    at = columns if rows is None else rows
    distance = negligible_beyond(profile, at.features.shape[1], accuracy)
    if distance is None or min(len(at.features), len(columns.features)) <= 2 * BLOCK:
        return None
    with torch.no_grad():
        column_blocks = blocks(columns.features)
        row_blocks = column_blocks if rows is None else blocks(at.features)
        near = _near(_boxes(at.features, row_blocks), _boxes(columns.features, column_blocks), distance)
        if float(near.to(torch.float64).mean()) > WORTHWHILE_NEAR_SHARE * (0.5 if rows is None else 1.0):
            return None
        return _over_blocks(formula, profile, (at, row_blocks), (columns, column_blocks), near)


def blocks(at: Tensor) -> list[Tensor]:
    """Row numbers of points (N, D) in blocks of neighbours, at most BLOCK each."""
    found, open_ = [], [torch.arange(len(at), dtype=torch.int64, device=at.device)]
    while open_:
        own = open_.pop()
        if len(own) <= BLOCK:
            found.append(own)
            continue
        points = at[own]
        longest = int((points.amax(0) - points.amin(0)).argmax())
        order, half = points[:, longest].argsort(stable=True), len(own) // 2
        open_ += [own[order[half:]], own[order[:half]]]
    return found


def _boxes(at: Tensor, members: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Lowest and highest coordinates of every block: (B, D) each."""
    return torch.stack([at[own].amin(0) for own in members]), torch.stack([at[own].amax(0) for own in members])


def _near(rows: tuple[Tensor, Tensor], columns: tuple[Tensor, Tensor], distance: float) -> Tensor:
    """Which boxes come closer than a distance: (A, B) bool."""
    gap = torch.maximum(rows[0][:, None] - columns[1][None], columns[0][None] - rows[1][:, None]).relu()
    return gap.square().sum(-1) < distance**2


def _over_blocks(
    formula: Formula,
    profile: Profile,
    rows: tuple[Points, list[Tensor]],
    columns: tuple[Points, list[Tensor]],
    near: Tensor,
) -> tuple[Tensor, ...]:
    """The results over near blocks, in the points' own order."""
    (at, row_blocks), (others, column_blocks) = rows, columns
    order, parts = torch.cat(row_blocks), []
    for own, which in zip(row_blocks, near, strict=True):
        chosen = [column_blocks[k] for k in which.nonzero()[:, 0].tolist()]
        members = torch.cat(chosen) if chosen else order[:0]
        near_points = (_taken(at, own), _taken(others, members))
        parts.append(FUSED.reduce(formula, profile, *near_points) or Tiled().reduce(formula, profile, *near_points))
    back = torch.empty_like(order).index_copy_(
        0, order, torch.arange(len(order), dtype=order.dtype, device=order.device)
    )
    return tuple(torch.cat(part)[back] for part in zip(*parts, strict=True))


def _taken(points: Points, rows: Tensor) -> Points:
    return Points(*(None if t is None else t[rows] for t in points))
