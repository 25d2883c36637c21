"""What rows of coordinates show: markers, or frames that stand for three points each. What differs between them.

A body has an origin: the marker itself, or that of its frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.errors import printable
from diffeo_calib.measurements.pose_frames import (
    POINTS,
    by_frame,
    directions_of_frames,
    frames_of_points,
    middles,
    own_blocks,
    points_of_frames,
)
from diffeo_calib.measurements.poses import rotation_numbers


class BodyKind:
    """Markers: points that a device measured, or a ball. Frames differ, see :class:`FrameKind`."""

    points_each = 1
    """Points that stand for one body."""

    def tips(self, on: Sequence[str]) -> Sequence[str]:
        """The tip of each body, of those of all points."""
        return on[:: self.points_each]

    def origins(self, points: Tensor) -> Tensor:
        """Origins (N, B, 3) of bodies with points (N, P, 3), m."""
        return points

    def predicted(self, model: Any, q: Tensor, *, noise: bool = True) -> tuple[Tensor, Tensor]:
        """What a model predicts at q (N, n) as it is written to files: markers (N, B, 3) m, or poses; covariances."""
        return model.predict(q, noise=noise)

    def shown(self, model: Any, q: Tensor, *, noise: bool = True) -> tuple[Tensor, Tensor, Tensor]:
        """The same as points (N, P, 3), origins (N, B, 3), m, and covariances of the origins (N, B, 3, 3), m^2."""
        points, covariance = model.predict(q, noise=noise)
        return points, points, covariance

    def claimed(self, points: Tensor, covariance: Tensor, usual: Tensor) -> tuple[Tensor, Tensor]:
        """Origins (N, B, 3) of points (N, P, 3), m, and their covariances, from those of all points (N, 3 P, 3 P).

        ``usual``: (N, P, 3), in place of points that are hidden.
        """
        return points, own_blocks(covariance, points.shape[1])

    def noise_rms(self, noise: Tensor) -> float:
        """RMS distance of a measured origin from the true one, m, by the covariance of all coordinates (3 P, 3 P)."""
        return float(noise.diagonal().view(-1, 3).sum(1).mean()) ** 0.5

    def perhaps_moved(self, *, far: bool) -> bool:
        """Whether a device or marker may have moved, from whether the origins are ``far`` off."""
        return far

    def name(self, number: int, count: int) -> str:
        """What one of several bodies is called."""
        return f"marker {number}" if count > 1 else "marker"

    def place_lines(self, model: Any) -> Iterator[str]:
        """Where the bodies of a model are in the frames of their tips, for a record."""
        geometry = model.geometry
        for number, (tip, marker) in enumerate(zip(geometry.on, geometry.tool.tolist(), strict=True)):
            place = " ".join(f"{value:.6f}" for value in marker)
            yield f"marker {number} in the frame of {printable(tip)} [m]: {place}"


class FrameKind(BodyKind):
    """Frames whose poses a device measured.

    Args:
        lever: distance of their points from their origins, m.
    """

    points_each = POINTS

    def __init__(self, lever: float) -> None:
        self.lever = lever

    def origins(self, points: Tensor) -> Tensor:
        """See :class:`BodyKind`."""
        return middles(points)

    def predicted(self, model: Any, q: Tensor, *, noise: bool = True) -> tuple[Tensor, Tensor]:
        """See :class:`BodyKind`."""
        return model.predict_poses(q, noise=noise)

    def shown(self, model: Any, q: Tensor, *, noise: bool = True) -> tuple[Tensor, Tensor, Tensor]:
        """See :class:`BodyKind`."""
        frames, covariance = map(by_frame, model.predict_poses(q, noise=noise))
        return points_of_frames(frames, self.lever), frames[..., :3, 3], covariance[..., :3, :3]

    def claimed(self, points: Tensor, covariance: Tensor, usual: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`BodyKind`."""
        frames = frames_of_points(points.where(~points.isnan(), usual), self.lever)
        along = directions_of_frames(frames, self.lever)
        whole = own_blocks(along @ covariance @ along.mT, frames.shape[1])
        return frames[..., :3, 3], whole[..., :3, :3]

    def noise_rms(self, noise: Tensor) -> float:
        """See :class:`BodyKind`; the origin is the mean of its three points."""
        blocks = own_blocks(noise[None], len(noise) // 9)[0].unflatten(2, (3, 3)).unflatten(1, (3, 3))
        return float(blocks.mean((1, 3)).diagonal(dim1=1, dim2=2).sum(1).mean()) ** 0.5

    def perhaps_moved(self, *, far: bool) -> bool:
        """See :class:`BodyKind`; a turn does not show in the origins."""
        return True

    def name(self, number: int, count: int) -> str:
        """See :class:`BodyKind`."""
        return "measured frame"

    def place_lines(self, model: Any) -> Iterator[str]:
        """See :class:`BodyKind`."""
        for tip, frame in zip(self.tips(model.geometry.on), by_frame(model.measured_frame[None])[0], strict=True):
            yield f"measured frame in the frame of {printable(tip)}, 4 x 4 [m]:"
            yield from matrix_lines(frame)


def body_kind(lever: float | None) -> BodyKind:
    """The kind of bodies whose points have this lever [m]; None for markers."""
    return BodyKind() if lever is None else FrameKind(lever)


def matrix_lines(transform: Tensor) -> Iterator[str]:
    """A transform (4, 4) as a matrix, and as a place and a rotation vector."""
    for row in transform.tolist():
        yield "  " + " ".join(f"{value: .8f}" for value in row)
    turn = rotation_numbers(transform[None, :3, :3], "rotvec")[0]
    numbers = torch.cat([transform[:3, 3], turn]).tolist()
    yield "  x y z rx ry rz [m, rad]: " + " ".join(f"{value:.6f}" for value in numbers)
