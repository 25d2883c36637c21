"""Which boards a camera sees, and what images of them would tell; see :mod:`~diffeo_calib.cameras.images`."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from diffeo_calib.cameras.images import UNKNOWNS, Camera, Images, State, inverses, undistorted

EDGE_SHARE = 1.02
"""Largest angle from the axis at which corners are seen, relative to that of the image's own corners."""
MOST_TOGETHER = 512
"""Images whose slopes are held at a time."""


def sees(camera: Camera, poses: Tensor) -> Tensor:
    """(N,) boolean: whether it sees boards at poses (N, 4, 4) in its frame, m, as well as in the worst of its images.

    They are as near and as little inclined, and show as many corners. A camera without images sees all.
    """
    if camera.view is None:
        return torch.ones(len(poses), dtype=torch.bool, device=poses.device)
    found = camera.view.allows(poses)
    found[found.clone()] = shown(camera, poses[found]).sum(1) >= camera.view.fewest
    return found


def shown(camera: Camera, poses: Tensor) -> Tensor:
    """(N, K) boolean: which corners of boards at poses (N, 4, 4) are inside the image of a camera with images.

    Far outside of the image, where nothing showed the distortion, it may fold rays back into it.
    """
    points, size = _corners(camera), camera.unknowns.new_tensor([camera.width - 1, camera.height - 1])
    edge = undistorted(size * size.new_tensor([[0, 0], [0, 1], [1, 0], [1, 1]]), camera.lens).norm(dim=1).max()
    there = points @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
    ahead = there[..., :2].norm(dim=-1) <= EDGE_SHARE * edge * there[..., 2]
    pixels = camera.pixels(poses, points.expand(len(poses), -1, -1))
    return ahead & (pixels >= 0).all(-1) & (pixels <= size).all(-1)


def expected(camera: Camera, poses: Tensor) -> tuple[Tensor, Tensor]:
    """Measurements expected from images of boards at poses (N, 4, 4), m, by a camera that has taken images before.

    Returns:
        covariance (N, 6, 6) of shift (m) and turn (rad) of the boards in the camera's axes, and effects (N, 6, 14) of
        the errors of lens and board on them.
    """
    points, parts = _corners(camera), list[tuple[Tensor, Tensor]]()
    eye = torch.eye(len(UNKNOWNS), dtype=poses.dtype, device=poses.device)
    whole = replace(camera, root=eye)
    for some in poses.split(MOST_TOGETHER):
        images = Images(points.expand(len(some), -1, -1), points[:0], camera.width, camera.height)
        seen = shown(camera, some)[..., None, None] / camera.noise
        by_pose, by_unknowns = ((own * seen).flatten(1, 2) for own in State(images, whole, some, 0.0 * eye[0]).slopes())
        covariance = inverses(by_pose.mT @ by_pose)
        parts.append((covariance, covariance @ by_pose.mT @ by_unknowns))
    covariances, effects = (torch.cat(each) for each in zip(*parts, strict=True))
    return covariances, effects


def _corners(camera: Camera) -> Tensor:
    if camera.view is None:
        raise AssertionError("a camera with images")
    return camera.view.points
