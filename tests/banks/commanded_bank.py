"""Machines with commanded poses or places, and what was measured of them."""

from __future__ import annotations

from pathlib import Path

import torch
from numbers_bank import normal as drawn
from torch import Tensor

from diffeo_calib.robots.se3 import transforms

ROWS = 24
DOWN = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))


def turned(axes: Tensor) -> Tensor:
    """Rotations (N, 3, 3) of rotation vectors (N, 3), rad."""
    K = torch.zeros(len(axes), 3, 3, dtype=torch.float64)
    K[:, 2, 1], K[:, 0, 2], K[:, 1, 0] = axes.unbind(1)
    return (K - K.mT).matrix_exp()


def flange(seed: int = 0) -> Tensor:
    """(N, 4, 4) poses of a flange above a board at (0.5, 0, 0), m."""
    draws = drawn(ROWS, 6, seed=seed)
    R = turned(0.35 * draws[:, 3:]) @ torch.tensor(DOWN, dtype=torch.float64)
    places = torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64) - 0.4 * R[:, :, 2] + 0.05 * draws[:, :3]
    return transforms(R, places)


CAMERA = transforms(turned(torch.tensor([[0.1, -0.05, 0.8]])), torch.tensor([[0.03, -0.06, 0.05]]))[0]
BOARD = transforms(turned(torch.tensor([[0.02, 0.01, 0.3]])), torch.tensor([[0.5, 0.02, 0.01]]))[0]


def seen(commanded: Tensor, *, camera_on_tool: bool, seed: int = 9) -> Tensor:
    """(N, 4, 4) what a camera measures, m: the board of a camera on the tool, or the tool of a fixed one."""
    exact = (
        torch.linalg.inv(commanded @ CAMERA) @ BOARD if camera_on_tool else torch.linalg.inv(BOARD) @ commanded @ CAMERA
    )
    noise = drawn(len(commanded), 6, seed=seed)
    return transforms(turned(3e-4 * noise[:, 3:]) @ exact[:, :3, :3], exact[:, :3, 3] + 1e-4 * noise[:, :3])


def write_columns(path: Path, **columns: Tensor) -> Path:
    """A table with the columns of each group, such as ``x_y_z=(N, 3)``, or ``"cmd_x|cmd_y"``."""
    names = [name for group in columns for name in group.split("|" if "|" in group else "_")]
    lines = [",".join(f"{value:.8g}" for value in row) for row in torch.cat([*columns.values()], 1).tolist()]
    path.write_text("\n".join([",".join(names), *lines, ""]), encoding="utf-8")
    return path


def bent(places: Tensor) -> Tensor:
    """A gantry out of square by 1 mrad, whose rail is bent, m."""
    x, y, z = places.unbind(1)
    return torch.stack([x + 1e-3 * y, y + 3e-4 * torch.sin(5.0 * x), z], 1)


def cells(path: Path) -> list[list[str]]:
    return [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
