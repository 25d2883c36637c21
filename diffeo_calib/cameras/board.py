"""A printed board that is not quite what was meant: its scale, unequal along x and y, and its bending.

    b' = ((1 + scale + stretch) x, (1 + scale - stretch) y, z + size (bend_x a^2 + bend_xy a b + bend_y b^2)),

(a, b) = (x, y) / size from the board's middle, size half of its larger side, so that bends are deflections per size.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

BOARD = ("scale", "stretch", "bend_x", "bend_xy", "bend_y")


@dataclass(frozen=True)
class BoardPrior:
    """Standard deviations of a board: relative size, difference of its x and y scales, and deflection of its edge [m].

    The defaults are those of a laser print on a flat plate: measure 200 mm with a caliper to know the scale to 2e-4.
    """

    scale: float = 1e-3
    stretch: float = 5e-4
    bend_m: float = 3e-4

    def deviations(self, size: float) -> list[float]:
        """(5,) of the parameters of a board whose larger side is twice ``size``, m."""
        return [self.scale, self.stretch, *[self.bend_m / size] * 3]


def real_board(points: Tensor, board: Tensor, size: float) -> Tensor:
    """Points (..., 3) of the board as it is, m, from those meant; board (5,)."""
    x, y, z = points.unbind(-1)
    return torch.stack([(1 + board[0] + board[1]) * x, (1 + board[0] - board[1]) * y, z], -1) + torch.cat(
        [torch.zeros_like(points[..., :2]), (size * (_bends(points, size) @ board[2:]))[..., None]], -1
    )


def board_slopes(points: Tensor, size: float) -> Tensor:
    """Derivatives (..., 3, 5) of the board's points by its parameters."""
    x, y, _ = points.unbind(-1)
    zero = torch.zeros_like(x)
    flat = torch.stack([torch.stack([x, x], -1), torch.stack([y, -y], -1), torch.stack([zero, zero], -1)], -2)
    bends = size * _bends(points, size)
    return torch.cat([flat, torch.stack([torch.zeros_like(bends), torch.zeros_like(bends), bends], -2)], -1)


def _bends(points: Tensor, size: float) -> Tensor:
    a, b = points[..., 0] / size, points[..., 1] / size
    return torch.stack([a * a, a * b, b * b], -1)
