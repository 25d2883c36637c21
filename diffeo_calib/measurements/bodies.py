"""What a device sees of the tool: single markers, or frames that three points represent, each as one body."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.measurements.pose_frames import (
    POINTS,
    block_diagonal,
    by_frame,
    frame_tips,
    frames_of_points,
    pose_jacobian,
    transforms_of_frames,
    visible_rotation_numbers,
)
from diffeo_calib.measurements.poses import angle_between
from diffeo_calib.measurements.rows import NO_SOCKET
from diffeo_calib.measurements.table import Measurements


@dataclass(frozen=True)
class Bodies(ABC):
    """The bodies that some rows show.

    Args:
        data: N rows, B bodies each.
    """

    data: Measurements
    words = "markers"
    """What they are called."""
    points = 1
    """Points that represent each."""

    @property
    def count(self) -> int:
        """B."""
        return self.data.markers // self.points

    def on_tips(self, on: Sequence[str]) -> Measurements:
        """The rows with their bodies on the tips of these points, unless they name some themselves."""
        return self.data

    def name(self, body: int) -> str:
        """What findings call a body."""
        return f"marker {body}"

    def number(self, body: int) -> int | None:
        """Its number as a marker; None if it is alone or no marker."""
        return body if self.count > 1 else None

    def tip(self, body: int) -> str | None:
        """The tip of one of several frames."""
        return None

    @property
    def exchangeable(self) -> range:
        """Bodies whose numbers may be exchanged in a row."""
        return range(self.count)

    def mirrored(self) -> Iterator[Tensor]:
        """Points (N, P, 3) in a frame of the other hand; none where a rotation shows the hand."""
        yield torch.cat([self.data.points[..., :2], -self.data.points[..., 2:]], dim=-1)

    @abstractmethod
    def predicted(self, model: Any) -> tuple[Tensor, Tensor]:
        """Mean and covariance (N, B, k, k) of the bodies by a model under the payloads of the rows, m and rad."""

    @abstractmethod
    def errors(self, mean: Tensor) -> Tensor:
        """(N, B, k) measured minus predicted, m and rad; NaN where hidden."""

    @abstractmethod
    def turns(self, points: Tensor) -> Tensor:
        """(N, T) angles, rad, from T measured frames to those of points (N, P, 3); T is 0 for markers."""

    @property
    def modes(self) -> Tensor | None:
        """(N, T, 9, 6) displacements of points by a shift and a turn, see :class:`NoiseModel`; None for markers."""
        return None

    def modes_of(self, points: Tensor) -> Tensor | None:
        """The same of other rows of the device, whose points (K, P, 3) are known, m; None for markers."""
        return None

    @property
    def kinds(self) -> Tensor | None:
        """(N, B) int64, 1 for the ball in sockets beside bodies that a device saw, 0; None if all are of one kind."""
        resting = self.data.socket_numbers != NO_SOCKET
        if bool(resting.all()) or self.data.sockets is None:
            return None
        found = torch.zeros(len(self.data), self.count, dtype=torch.int64, device=self.data.q.device)
        found[:, -1] = 1
        return found


class Markers(Bodies):
    """Single points."""

    def predicted(self, model: Any) -> tuple[Tensor, Tensor]:
        """Positions."""
        return model.predict(self.data.q)

    def errors(self, mean: Tensor) -> Tensor:
        """Three coordinates."""
        return self.data.points - mean

    def turns(self, points: Tensor) -> Tensor:
        """None."""
        return points.new_zeros(len(points), 0)


@dataclass(frozen=True)
class Frames(Bodies):
    """Frames that three points represent.

    Args:
        measured: (N, T, 4, 4), m. lever: distance of the points from their origins, m.
    """

    measured: Tensor
    lever: float
    words = "poses"
    points = POINTS

    def on_tips(self, on: Sequence[str]) -> Measurements:
        """See :class:`Bodies`."""
        named = self.data.on is not None or len(on) != self.data.markers
        return self.data if named else self.data.with_tips(on[::POINTS])

    def name(self, body: int) -> str:
        """By its tip."""
        return self.data.body_names[body]

    def number(self, body: int) -> None:
        """None."""

    def tip(self, body: int) -> str | None:
        """See :class:`Bodies`."""
        return frame_tips(self.data.on, self.count)[body] if self.count > 1 else None

    @property
    def exchangeable(self) -> range:
        """None: a tip has one frame."""
        return range(0)

    def mirrored(self) -> Iterator[Tensor]:
        """None."""
        yield from ()

    def predicted(self, model: Any) -> tuple[Tensor, Tensor]:
        """Poses."""
        poses, covariance = model.predict_poses(self.data.q)
        return by_frame(poses), by_frame(covariance)

    def errors(self, mean: Tensor) -> Tensor:
        """Three coordinates of the origin and a rotation vector."""
        shift = self.measured[..., :3, 3] - mean[..., :3, 3]
        turned = transforms_of_frames(self.measured[..., :3, :3] @ mean[..., :3, :3].mT, self.measured[..., :3, 3])
        return torch.cat([shift, visible_rotation_numbers(turned, "rotvec", "rad")], 2)

    def turns(self, points: Tensor) -> Tensor:
        """See :class:`Bodies`."""
        found = frames_of_points(points, self.lever)
        return angle_between(found[..., :3, :3], self.measured[..., :3, :3])

    @property
    def modes(self) -> Tensor:
        """See :class:`Bodies`: zero where hidden."""
        return pose_jacobian(self.measured, self.lever, self.data.board).nan_to_num(0.0)

    def modes_of(self, points: Tensor) -> Tensor:
        """See :class:`Bodies`; a camera sees its board where it is in these rows."""
        frames, seen = frames_of_points(points, self.lever), seen_board(self.data)
        board = None
        if seen is not None:
            away = seen.origins.mean(0) - frames[:, 0, :3, 3]
            board = (frames[:, 0, :3, :3].mT @ away[..., None])[..., 0]
        return pose_jacobian(frames, self.lever, board)


def bodies_of(data: Measurements) -> Bodies:
    """What the rows of a table show."""
    frames, lever = data.frames, data.lever
    return Markers(data) if frames is None or lever is None else Frames(data, frames, lever)


def table_of_points(q: Tensor, points: Tensor, lever: float | None, on: Sequence[str] | None = None) -> Measurements:
    """Points (N, P, 3) of tips as a table: of the poses that they represent if they have a lever, m."""
    if lever is None:
        return Measurements(q, points, doubt=False)
    return Measurements.from_poses(q, frames_of_points(points, lever), lever=lever, doubt=False, on=on)


def origins(lever: float | None, like: Tensor) -> Tensor:
    """The origins of measured frames as means of their points, (3 T, 9 T); the identity (3 P, 3 P) for markers.

    Args:
        lever: of the frames, m. like: (..., m) of the coordinates.
    """
    m = like.shape[-1]
    eye = torch.eye(3, dtype=like.dtype, device=like.device)
    if lever is None:
        return torch.eye(m, dtype=like.dtype, device=like.device)
    return block_diagonal((eye.repeat(1, POINTS) / POINTS).expand(1, m // (3 * POINTS), -1, -1))[0]


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


def seen_board(data: Measurements) -> SeenBoard | None:
    """The board of some rows; None unless a camera on the tool saw one."""
    if data.board is None or data.poses is None or data.lever is None:
        return None
    axes = data.poses[:, :3, :3]
    return SeenBoard(data.board, data.poses[:, :3, 3] + (axes @ data.board[..., None])[..., 0], axes, data.lever)
