"""The order in which to measure chosen poses: short moves of the joints from each to the next."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

SMALLEST_STROKE = 1e-9


def move_times(q: Tensor, turning: tuple[bool, ...]) -> Tensor:
    """Durations of the moves between configurations: all joints start together and the slowest decides.

    Args:
        q: (N, n) rad or m. turning: which joints turn; a slide counts in units of half its stroke here.

    Returns:
        (N, N), the largest difference of any joint.
    """
    half = 0.5 * (q.amax(0) - q.amin(0)).clamp(min=SMALLEST_STROKE)
    turns = torch.tensor(turning, dtype=torch.bool, device=q.device)
    unit = q / torch.where(turns, torch.ones_like(half), half)
    return (unit[:, None] - unit[None]).abs().amax(-1)


def short_path(times: Tensor) -> Tensor:
    """An order of N points whose path is short: nearest neighbours, then reversals of parts (2-opt).

    Args:
        times: (N, N) symmetric durations of the moves.

    Returns:
        (N,) row numbers. The path starts at the first point or at another, wherever that shortens it.
    """
    D = times.cpu().numpy()
    path = _nearest_neighbours(D)
    # A point at no distance from all others closes the path to a tour, which has no ends to be treated apart.
    closed = np.zeros((len(D) + 1, len(D) + 1))
    closed[:-1, :-1] = D
    tour = np.append(path, len(D))
    while True:
        after = np.roll(tour, -1)
        old = closed[tour, after]
        change = closed[np.ix_(tour, tour)] + closed[np.ix_(after, after)] - old[:, None] - old[None]
        change = np.triu(change, 1)
        first, last = np.unravel_index(change.argmin(), change.shape)
        if change[first, last] > -1e-12 * (1 + old.sum()):
            break
        tour[first + 1 : last + 1] = tour[first + 1 : last + 1][::-1].copy()
    start = int(np.flatnonzero(tour == len(D))[0])
    return torch.from_numpy(np.roll(tour, -start)[1:].astype(np.int64)).to(times.device)


def _nearest_neighbours(D: np.ndarray) -> np.ndarray:
    """From the first point always to the nearest that is left."""
    open_ = np.ones(len(D), dtype=bool)
    path = [0]
    open_[0] = False
    while open_.any():
        path.append(int(np.where(open_, D[path[-1]], np.inf).argmin()))
        open_[path[-1]] = False
    return np.array(path)
