"""Measured frames, one of them or one on each of several tips: all of them as (N, T, 4, 4), and as 3 T points.

Users pass and get (N, 4, 4) where a single frame was measured. A frame that a row does not show is NaN as a whole, and
so are its three points.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffeo_calib.common.checks import real_tensor, wrapped
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.poses import (
    ONE_POSE,
    check_lever,
    mark_jacobian,
    mark_points,
    marks,
    pose_directions,
    poses_from_marks,
    poses_of_triangles,
    rigid_poses,
)
from diffeo_calib.robots.se3 import transforms

POINTS = 3
"""Points that represent a frame."""


def by_frame(values: Tensor) -> Tensor:
    """Poses (N, 4, 4) or (N, T, 4, 4), or covariances of the same form, as those of T frames: (N, T, k, k)."""
    return values if values.ndim == 4 else values[:, None]


def of_frames(values: Tensor) -> Tensor:
    """The inverse of :func:`by_frame`: (N, T, k, k) -> (N, k, k) if there is a single frame."""
    return values[:, 0] if values.shape[1] == 1 else values


def checked_frames(poses: object) -> Tensor:
    """Check poses (N, 4, 4) or (N, T, 4, 4) and return the nearest rigid ones (N, T, 4, 4), NaN where hidden.

    Raises:
        InputError: wrong shape, values that are not finite, no rigid transform, or a row without any frame.
    """
    given = real_tensor(poses, "poses").detach()
    if given.ndim != 4 or given.shape[1] < 2:
        return rigid_poses(given[:, 0] if given.ndim == 4 and given.shape[1] == 1 else given)[:, None]
    if given.shape[2:] != (4, 4):
        expected, got = "shape (N, 4, 4) or (N, T, 4, 4)", tuple(given.shape)
        raise InputError.of("`poses` has the wrong shape", expected=expected, got=got, fix=ONE_POSE)
    hidden = given.isnan().flatten(2).all(2)
    rows = hidden.all(1).nonzero()[:, 0].tolist()
    if rows:
        what = f"`poses`, row {rows[0]}: no frame was seen"
        raise InputError.of(what, expected="at least one in every row", fix="leave this row out")
    eye = torch.eye(4, dtype=given.dtype, device=given.device)
    count = given.shape[1]
    flat = torch.where(hidden[..., None, None], eye, given).flatten(0, 1)
    frames = rigid_poses(flat, lambda k: f"`poses`, row {k // count}, frame {k % count}").unflatten(0, (-1, count))
    return frames.masked_fill(hidden[..., None, None], torch.nan)


def points_of_frames(frames: Tensor, lever: float) -> Tensor:
    """The points that represent T frames, those of a frame adjacent: (N, T, 4, 4) -> (N, 3 T, 3) m."""
    return mark_points(frames, lever).flatten(1, 2)


def frames_of_points(points: Tensor, lever: float) -> Tensor:
    """The frames (N, T, 4, 4), NaN where hidden, of points (N, 3 T, 3), m; see :func:`poses_from_marks`."""
    triples = points.unflatten(1, (-1, POINTS))
    if wrapped(points):
        check_lever(lever)
        return poses_of_triangles(triples)
    hidden = triples.isnan().flatten(2).any(2)
    if not bool(hidden.any()):
        return poses_from_marks(triples.flatten(0, 1), lever).unflatten(0, triples.shape[:2])
    found = triples.new_full((*hidden.shape, 4, 4), torch.nan)
    found[~hidden] = poses_from_marks(triples[~hidden], lever)
    return found


def middles(points: Tensor) -> Tensor:
    """The origins (N, T, 3) of frames that 3 T points (N, 3 T, 3) represent, m."""
    return points.unflatten(1, (-1, POINTS)).mean(2)


def transforms_of_frames(rotations: Tensor, places: Tensor) -> Tensor:
    """Poses (N, T, 4, 4) of rotations (N, T, 3, 3) and places (N, T, 3), m; NaN as a whole where either is."""
    frames = transforms(rotations, places)
    return frames.masked_fill(frames.isnan().any(3, keepdim=True).any(2, keepdim=True), torch.nan)


def directions_of_frames(frames: Tensor, lever: float) -> Tensor:
    """Derivatives of all (dt, dw) by all points, see :func:`pose_directions`: (N, T, 4, 4) -> (N, 6 T, 9 T)."""
    return block_diagonal(pose_directions(frames, lever))


def block_diagonal(blocks: Tensor) -> Tensor:
    """Blocks (N, T, a, b) along the diagonal of matrices (N, T a, T b)."""
    eye = torch.eye(blocks.shape[1], dtype=blocks.dtype, device=blocks.device)
    return torch.einsum("ntab,ts->ntasb", blocks, eye).flatten(3, 4).flatten(1, 2)


def own_blocks(matrix: Tensor, count: int) -> Tensor:
    """The ``count`` blocks on the diagonal of matrices (N, m, m): (N, count, m / count, m / count)."""
    index, size = torch.arange(count, device=matrix.device), matrix.shape[1] // count
    return matrix.view(len(matrix), count, size, count, size)[:, index, :, index, :].movedim(0, 1)


def frame_tips(on: Sequence[str] | None, frames: int) -> tuple[str, ...]:
    """Names of measured frames: those of their tips, or frame1, frame2, ... where these are not known.

    Args:
        on: names of the tips of their points, in threes. frames: how many there are.
    """
    tips = tuple(on[::POINTS]) if on is not None else ()
    return tips if len(set(tips)) == frames else tuple(f"frame{k + 1}" for k in range(frames))


def kind_of_points(points: int, lever: float | None) -> str:
    """Phrase for a number of points, such as "2 marker(s)", "poses" or "poses on 2 tips"."""
    frames = points // POINTS
    return f"{points} marker(s)" if lever is None else f"poses on {frames} tips" if frames > 1 else "poses"


def inverse_poses(poses: Tensor) -> Tensor:
    """Camera in the board's frame from board in the camera's frame, or the other way round: (..., 4, 4)."""
    turned = poses[..., :3, :3].mT
    found = transforms(turned, -(turned @ poses[..., :3, 3:])[..., 0])
    return torch.where(poses.isnan(), poses, found)


def camera_jacobian(poses: Tensor, lever: float, board: Tensor) -> Tensor:
    """Derivatives (N, 9, 6) of the points of cameras at poses (N, 4, 4), m, by errors (-dt, -dw) of the board's pose.

    Shift, m, and turn, rad, are along and about the axes of the camera, in whose frame the board's origin is at
    ``board`` (N, 3), m; coordinates of a point are adjacent.
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
