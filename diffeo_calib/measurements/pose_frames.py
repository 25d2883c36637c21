"""Measured frames, one of them or one on each of several tips: all of them as (N, T, 4, 4), and as 3 T points.

Users pass and get (N, 4, 4) where a single frame was measured. A frame that a row does not show is NaN as a whole, and
so are its three points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import real_tensor, wrapped
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.poses import (
    ONE_POSE,
    check_lever,
    mark_points,
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
    """The frames whose points are nearest to the given ones: (N, 3 T, 3) -> (N, T, 4, 4) m, NaN where hidden.

    See :func:`poses_from_marks`.
    """
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
    """What so many points are, such as "2 marker(s)", "poses" or "poses on 2 tips"."""
    frames = points // POINTS
    return f"{points} marker(s)" if lever is None else f"poses on {frames} tips" if frames > 1 else "poses"


def seen_bodies(data: Any) -> Tensor:
    """Which markers, or frames, of some measurements were seen: (N, P) or (N, T) boolean."""
    return data.visible if data.lever is None else data.visible[:, ::POINTS]


def body_names(data: Any) -> list[str]:
    """What messages call the markers or frames of some measurements, such as "marker 0", "the frame on 'hand'"."""
    if data.lever is None:
        return [f"marker {name}" for name in data.marker_names or range(data.markers)]
    frames = data.markers // POINTS
    return ["the frame"] if frames == 1 else [f"the frame on '{tip}'" for tip in frame_tips(data.on, frames)]
