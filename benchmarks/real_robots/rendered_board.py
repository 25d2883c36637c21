"""Rendered images of a printed ChArUco board: lens, blur and noise of a camera. Needs OpenCV."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import torch
from scipy.ndimage import map_coordinates
from simulated_camera import CORNERS, HEIGHT, SQUARE, WIDTH, true_camera
from torch import Tensor

from diffeo_calib.cameras.board import real_board
from diffeo_calib.cameras.images import Camera, undistorted

SQUARES = CORNERS[0] + 1, CORNERS[1] + 1
MARKER, DICTIONARY = 0.022, "DICT_5X5_100"
"""Side of a marker, m."""
BOARD = f"charuco:{SQUARES[0]}x{SQUARES[1]}:{SQUARE}:{MARKER}:{DICTIONARY}"
TEXELS, MARGIN = 60, 40
"""Texture: pixels of a square, and white around the board."""
FINER = 2
"""Samples of a pixel along each side."""
BACKGROUND, COARSE = 110, 8
"""Grey value; samples between those that look for the page."""


FACING = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64).diag()
"""From the board of simulated_camera.py, whose z axis leaves the paper, to that of OpenCV, whose z axis enters it."""


def texture(dictionary: str = DICTIONARY) -> np.ndarray:
    """The printed page."""
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    board = cv2.aruco.CharucoBoard(SQUARES, SQUARE, MARKER, markers)
    size = SQUARES[0] * TEXELS + 2 * MARGIN, SQUARES[1] * TEXELS + 2 * MARGIN
    return board.generateImage(size, marginSize=MARGIN)


def rendered(
    pose: Tensor,
    page: np.ndarray,
    *,
    blur_px: float = 0.6,
    noise: float = 2.0,
    seed: int = 0,
    camera: Camera | None = None,
) -> np.ndarray:
    """A grey image of the board at a pose (4, 4) in the camera's frame, m.

    Args:
        pose: of the board's middle. page: see :func:`texture`. blur_px: standard deviation of the lens' blur, pixels.
        noise: standard deviation of grey values, of 255. seed: of the noise. camera: with the print; the usual lens.
    """
    camera, rays = camera or true_camera(), _rays()
    found = _on_page(rays[::COARSE, ::COARSE], pose, page, camera)
    inside = ((found > -1) & (found < found.new_tensor([page.shape[1], page.shape[0]]))).all(-1)
    # the part of the image that shows the page, whose corners may lie between the samples; all else is background
    box = tuple(
        slice(COARSE * max(0, int(some.min()) - 3), COARSE * (int(some.max()) + 4))
        for some in (inside.any(1 - axis).nonzero() for axis in range(2))
        if len(some)
    )
    shown = np.full((FINER * HEIGHT, FINER * WIDTH), BACKGROUND, dtype=np.uint8)
    if box:
        at = _on_page(rays[box], pose, page, camera).numpy()
        own = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": BACKGROUND}
        shown[box] = cv2.remap(page, at[..., 0], at[..., 1], cv2.INTER_LINEAR, **own)
    grey = cv2.resize(shown.astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    grey = cv2.GaussianBlur(grey, (0, 0), blur_px) if blur_px else grey
    grey = 20 + 0.8 * grey + noise * np.random.default_rng(seed).standard_normal(grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def _on_page(rays: Tensor, pose: Tensor, page: np.ndarray, camera: Camera) -> Tensor:
    """Where rays (..., 3) meet the page, (..., 2) in its pixels; far away behind the camera."""
    # from the plane of the board as it was meant to that of the image: bends and scales are small, two rounds do
    R, t = pose[:3, :3].float(), pose[:3, 3].float()
    flat = torch.zeros_like(rays)
    depth = lift = torch.zeros_like(rays[..., 0])
    for _ in range(2):
        depth = ((t @ R[:, 2]) + lift) / (rays @ R[:, 2])
        flat = (rays * depth[..., None] - t) @ R
        flat[..., 2] = 0.0
        real = real_board(flat, camera.board.float(), camera.half_size)
        lift, flat = real[..., 2], flat + (flat - real) * flat.new_tensor([1.0, 1.0, 0.0])
    at = flat[..., :2] / SQUARE * TEXELS + flat.new_tensor([page.shape[1] / 2, page.shape[0] / 2]) - 0.5
    return at.masked_fill((depth <= 0)[..., None], -1e6)


@cache
def _rays() -> Tensor:
    """Points (rows, columns, 3) at the depth 1 m seen at all samples; undistorted on a coarse grid, which is smooth."""
    rows, columns = np.mgrid[-16 : HEIGHT + 17 : 16, -16 : WIDTH + 17 : 16]
    known = undistorted(torch.from_numpy(np.stack([columns, rows], -1).astype(float)), true_camera().lens)
    rows, columns = np.mgrid[0 : HEIGHT * FINER, 0 : WIDTH * FINER]
    at = ((np.stack([rows, columns]) + 0.5) / FINER - 0.5 + 16) / 16
    parts = [map_coordinates(known[..., k].numpy(), at, order=3) for k in range(2)]  # cv2.remap knows 1/32 of a cell
    found = torch.from_numpy(np.stack(parts, -1)).float()  # 0.1 micrometres at the board
    return torch.cat([found, torch.ones_like(found[..., :1])], -1)
