"""Exact minima of quadratic functions in boxes, for all rows at once (primal active sets)."""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def box_minimum(H: Array, g: Array, low: Array, high: Array) -> Array:
    """Minimise 1/2 s^T H s + g^T s over low <= s <= high, row by row.

    Starts at s = 0 and moves to the minimum on the face of the box that it is on; a bound that is hit on the way joins
    the face; at the minimum of a face the bound whose multiplier is most wrong leaves it. Finite, since the function
    falls from face to face (J. Nocedal, S. Wright, "Numerical optimization", 2006, section 16.5).

    Args:
        H: (N, n, n) positive definite. g: (N, n). low: (N, n) at most 0. high: (N, n) at least 0.

    Returns:
        (N, n).
    """
    count, n = g.shape
    s = np.zeros_like(g)
    fixed = ((low >= 0) & (g > 0)) | ((high <= 0) & (g < 0)) | (low >= high)
    todo = np.arange(count)
    for _ in range(10 * n):
        moved, held, open_ = _face_step(H[todo], g[todo], low[todo], high[todo], s=s[todo], fixed=fixed[todo])
        s[todo], fixed[todo] = moved, held
        todo = todo[open_]
        if not len(todo):
            break
    return s


def _face_step(H: Array, g: Array, low: Array, high: Array, *, s: Array, fixed: Array) -> tuple[Array, Array, Array]:
    """One step on the faces: new s, new fixed joints, and whether a row goes on."""
    free = ~fixed
    reduced = H * (free[:, :, None] & free[:, None, :]) + fixed[:, :, None] * np.eye(s.shape[1])
    slope = g + (H @ s[:, :, None])[:, :, 0]
    way = -np.linalg.solve(reduced, (slope * free)[:, :, None])[:, :, 0] * free
    end = np.where(way > 0, high, low)
    room = np.where(way != 0, (end - s) / np.where(way != 0, way, 1.0), np.inf)
    share = np.minimum(room.min(1), 1.0)[:, None]
    hit = free & (room <= share) & (share < 1.0)
    s = np.where(hit, end, s + share * way)
    blocked = hit.any(1)
    slope = g + (H @ s[:, :, None])[:, :, 0]
    wrong = np.where(fixed & (low < high), np.where(s <= low, -slope, slope), 0.0)
    worst = wrong.argmax(1)
    scale = np.abs(g).max(1) + 1e-300
    leave = ~blocked & (wrong.max(1) > 1e-13 * scale)
    fixed = fixed | hit
    fixed[np.flatnonzero(leave), worst[leave]] = False
    return s, fixed, blocked | leave
