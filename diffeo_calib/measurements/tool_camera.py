"""Poses measured by a camera on the tool that sees a fixed board, and their errors.

What such a camera measures is the pose (R, t) of the board in its own frame. The robot moves the camera: its pose in
the frame of the board is the inverse, (R^T, -R^T t), and the board's frame is the measuring frame. Errors dt of the
position and dw of the rotation, in the camera's axes, turn the camera about the board, not about itself: with S = R^T,
the point at arm a in the camera's frame moves by

    dp = -S dt - S (dw x (a - t)),

so that an error of the rotation moves the camera by as much as it is far from the board, and position and rotation of
the camera err together. The position is known best if the board's origin is in its middle.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.measurements.poses import mark_jacobian, marks
from diffeo_calib.robots.se3 import transforms


def inverse_poses(poses: Tensor) -> Tensor:
    """Camera in the board's frame from board in the camera's frame, or the other way round: (..., 4, 4)."""
    turned = poses[..., :3, :3].mT
    found = transforms(turned, -(turned @ poses[..., :3, 3:])[..., 0])
    return torch.where(poses.isnan(), poses, found)


class SeenBoard(NamedTuple):
    """A board that a camera on the tool saw in N rows.

    Args:
        board: (N, 3) its origin in the camera's frame, m. origins: (N, 3) the same in the measuring frame.
        axes: (N, 3, 3) of the camera. lever: of the points that represent its poses, m.
    """

    board: Tensor
    origins: Tensor
    axes: Tensor
    lever: float


def seen_board(data: Any) -> SeenBoard | None:
    """The board of some rows; None unless a camera on the tool saw one."""
    if data.board is None:
        return None
    axes = data.poses[:, :3, :3]
    return SeenBoard(data.board, data.poses[:, :3, 3] + (axes @ data.board[..., None])[..., 0], axes, data.lever)


def camera_jacobian(poses: Tensor, lever: float, board: Tensor) -> Tensor:
    """Derivatives of the three points of a camera's pose by the errors (-dt, -dw) of the board's pose that it sees.

    Args:
        poses: (N, 4, 4) of the camera in the measuring frame, m.
        lever: distance of the points from the camera's origin, m.
        board: (N, 3) the board's origin in the camera's frame, m.

    Returns:
        (N, 9, 6): coordinates of a point adjacent; three columns for the position in m, three for the rotation in rad,
        along and about the axes of the camera.
    """
    axes = poses[:, :3, :3]
    arms = lever * marks(poses.device) - board[:, None]  # (N, point, 3) from the board, in the camera's frame
    eye = torch.eye(3, dtype=poses.dtype, device=poses.device).expand(len(poses), 3, 3, 3)  # (N, point, axis, 3)
    by_turn = torch.linalg.cross(eye, arms[:, :, None].expand_as(eye)).mT
    return (axes[:, None] @ torch.cat([eye, by_turn], dim=-1)).flatten(1, 2)


def pose_jacobian(poses: Tensor, lever: float, board: Tensor | None) -> Tensor:
    """Derivatives (N, T, 9, 6) of the three points of each frame by the errors of measured poses.

    Args:
        poses: (N, T, 4, 4), m, NaN where hidden; T is 1 for a camera. lever: distance of the points, m.
        board: see :func:`camera_jacobian`; None if the measuring device stood and saw the tool.
    """
    return mark_jacobian(poses, lever) if board is None else camera_jacobian(poses[:, 0], lever, board)[:, None]
