"""Images of a board with a known lens, as corners."""

import torch
from simulated_camera import FEWEST_SEEN, HEIGHT, WIDTH, seen_corners, true_camera
from torch import Tensor

from diffeo_calib.cameras.images import Images
from diffeo_calib.robots.se3 import rotation, transforms

CAMERA = true_camera()


def boards(count: int, seed: int = 0) -> Tensor:
    """Poses (N, 4, 4) of the board in front of the camera, m."""
    draw = torch.randn(count, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    size = draw.new_tensor([0.05, 0.04, 0.06, 0.4, 0.4, 0.4])
    return transforms(rotation(size[3:] * draw[:, 3:]), size[:3] * draw[:, :3] + draw.new_tensor([0.0, 0.0, 0.45]))


def images(count: int, noise_px: float, seed: int = 0) -> tuple[Images, Tensor]:
    """Images that show enough corners, and the true poses of the board."""
    poses = boards(count, seed)
    corners = seen_corners(poses, noise_px, seed)
    shown = (~corners[..., 3].isnan()).sum(1) >= FEWEST_SEEN
    return Images(corners[shown, :, :3], corners[shown, :, 3:], WIDTH, HEIGHT), poses[shown]
