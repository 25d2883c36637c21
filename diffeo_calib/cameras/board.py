"""A printed board that is not quite what was meant: its scale, unequal along x and y, and its bending.

    b' = ((1 + scale + stretch) x, (1 + scale - stretch) y, z + size (bend_x a^2 + bend_xy a b + bend_y b^2)),

(a, b) = (x, y) / size from the board's middle, size half of its larger side, so that bends are deflections per size.

Pinhole cameras with lens distortion: OpenCV's model (plumb bob) of five coefficients, and its derivatives.

x = X / Z,  y = Y / Z,  s = x^2 + y^2,  g = 1 + k1 s + k2 s^2 + k3 s^3,
u = fx (g x + 2 p1 x y + p2 (s + 2 x^2)) + cx,    v = fy (g y + p1 (s + 2 y^2) + 2 p2 x y) + cy.
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
    a, b = x / size, y / size
    bent = z + size * (torch.stack([a * a, a * b, b * b], -1) @ board[2:])
    return torch.stack([(1 + board[0] + board[1]) * x, (1 + board[0] - board[1]) * y, bent], -1)


def board_slopes(points: Tensor, size: float) -> Tensor:
    """Derivatives (..., 3, 5) of the board's points by its parameters, in which they are linear."""
    units = torch.eye(len(BOARD), dtype=points.dtype, device=points.device)
    return torch.stack([real_board(points, unit, size) - points for unit in units], -1)


LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")  # parameters of a lens: pixels for the first four


def project(points: Tensor, lens: Tensor) -> Tensor:
    """Pixels (..., 2) of points (..., 3) in the camera's frame, whose z axis looks ahead; lens (9,)."""
    return _distorted(points, lens) * lens[:2] + lens[2:4]


def project_slopes(points: Tensor, lens: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of pixels by the points (..., 2, 3), pixels per m, and by the lens (..., 2, 9)."""
    k1, k2, p1, p2, k3 = lens[4:]
    z = points[..., 2]
    x, y = points[..., 0] / z, points[..., 1] / z
    s, zero, unit = x * x + y * y, torch.zeros_like(x), torch.ones_like(x)
    g, slope = 1 + s * (k1 + s * (k2 + s * k3)), 2 * (k1 + s * (2 * k2 + 3 * s * k3))
    across = slope * x * y + 2 * p1 * x + 2 * p2 * y
    by_x = torch.stack([g + slope * x * x + 2 * p1 * y + 6 * p2 * x, across], -1)
    by_y = torch.stack([across, g + slope * y * y + 6 * p1 * y + 2 * p2 * x], -1)
    by_point = torch.stack([by_x, by_y, -(by_x * x[..., None] + by_y * y[..., None])], -1) / z[..., None, None]
    u, v = _distorted(points, lens).unbind(-1)
    k = torch.stack([x * s, x * s**2, 2 * x * y, s + 2 * x * x, x * s**3], -1)
    m = torch.stack([y * s, y * s**2, s + 2 * y * y, 2 * x * y, y * s**3], -1)
    focal = lens[:2, None]
    first = torch.stack([torch.stack([u, zero, unit, zero], -1), torch.stack([zero, v, zero, unit], -1)], -2)
    return focal * by_point, torch.cat([first, focal * torch.stack([k, m], -2)], -1)


def _distorted(points: Tensor, lens: Tensor) -> Tensor:
    """Distorted tangents of angles (..., 2)."""
    k1, k2, p1, p2, k3 = lens[4:]
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    s = x * x + y * y
    g = 1 + s * (k1 + s * (k2 + s * k3))
    return torch.stack(
        [g * x + 2 * p1 * x * y + p2 * (s + 2 * x * x), g * y + p1 * (s + 2 * y * y) + 2 * p2 * x * y], -1
    )


@dataclass(frozen=True, eq=False)
class View:
    """Range of views in images of a board, for planning more with the same camera."""

    points: Tensor  # (K, 3) corners of the board as it was meant, m
    fewest: int  # corners in an image
    near: float  # distance of their middle from the camera, m
    far: float
    # cosine of the flattest angle between the board's z axis and the line to its middle, negative if z looks at us
    facing: float

    @classmethod
    def of(cls, pixels: Tensor, poses: Tensor, points: Tensor) -> View:
        """Views of images with ``pixels`` (N, .) of a board at poses (N, 4, 4), m, with corners (K, 3)."""
        away, cosine = towards(poses, points)
        side = float(cosine.median().sign()) or 1.0
        facing = side * max(float((side * cosine).min()), 0.0)
        return cls(points, int(pixels.sum(1).min()), float(away.min()), float(away.max()), facing)

    @property
    def numbers(self) -> list[float]:
        """All constants."""
        return [float(self.fewest), self.near, self.far, self.facing, *self.points.flatten().tolist()]


def towards(poses: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Distances (N,) of the middle of points on boards at poses (N, 4, 4), m, and cosines of z axes to the line."""
    middle = poses[:, :3, :3] @ points.mean(0) + poses[:, :3, 3]
    away = middle.norm(dim=1)
    return away, (middle * poses[:, :3, 2]).sum(1) / away
