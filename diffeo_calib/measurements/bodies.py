"""Bodies seen on the tool, markers or frames that three points each represent: the only place that knows both."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements import poses as pose_math
from diffeo_calib.measurements.rows import with_attributes

BALL = "ball"  # name of the last marker, if the other ones have names
NUMBERS = ("x", "y", "z", "rx", "ry", "rz")


class Predicted(NamedTuple):
    """Points (N, P, 3), m; means (N, B, k) of B bodies, m and rad, covariances (N, B, k, k), names of the k numbers."""

    points: Tensor
    mean: Tensor
    covariance: Tensor
    names: tuple[str, ...]

    @property
    def origins(self) -> Tensor:
        """(N, B, 3) of the bodies, m."""
        return self.mean[..., :3]

    @property
    def places(self) -> Tensor:
        """(N, B, 3, 3) covariances of the origins, m^2."""
        return self.covariance[..., :3, :3]

    @property
    def claimed(self) -> Tensor:
        """(N, B) RMS distances of the origins, m."""
        return self.places.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()


@dataclass(frozen=True)
class Bodies:
    """Markers, or measured frames on one or several tips. Tables ``data`` are :class:`Measurements` of such bodies."""

    lever: float | None = None  # distance of the points of a frame from its origin, m; None for markers

    def __post_init__(self) -> None:
        if self.lever is not None:
            pose_math.check_lever(self.lever)

    @property
    def points(self) -> int:
        """Points of one of them."""
        return 1 if self.lever is None else pose_math.POINTS

    @property
    def numbers(self) -> int:
        """Numbers that tell where one is."""
        return 3 if self.lever is None else 6

    @property
    def kind(self) -> str:
        """Name of what is measured of them."""
        return "points" if self.lever is None else "poses"

    @property
    def many(self) -> str:
        """Their name in messages."""
        return "markers" if self.lever is None else "poses"

    def tips(self, on: Sequence[str]) -> Sequence[str]:
        """The tip of each body, of those of all points."""
        return on[:: self.points]

    def frames(self, geometry: Any) -> list[tuple[str, Tensor]]:
        """Measured frames (4, 4) in the frames of their tips, m, with what they are; none for markers."""
        if self.lever is None:
            return []
        pairs = zip(self.tips(geometry.on), pose_math.frames_of_points(geometry.tool[None], self.lever)[0], strict=True)
        return [(f"measured frame in the frame of {tip}", frame) for tip, frame in pairs]

    def predicted(self, model: Any, q: Any, *, noise: bool = True) -> Predicted:
        """Prediction of a calibrated model at configurations (N, n), by default of new measurements."""
        if self.lever is None:
            mean, covariance = model.predict(q, noise=noise)
            return Predicted(mean, mean, covariance, NUMBERS[:3])
        frames, covariance = map(pose_math.by_frame, model.predict_poses(q, noise=noise))
        turns = pose_math.rotation_numbers(frames[..., :3, :3], "rotvec")
        mean = torch.cat([frames[..., :3, 3], turns.to(frames)], 2)
        return Predicted(pose_math.points_of_frames(frames, self.lever), mean, covariance, NUMBERS)

    def written(self, model: Any, q: Tensor) -> tuple[Tensor, Tensor]:
        """The columns as files hold them: markers (N, B, 3) m, or poses; covariances."""
        return model.predict(q) if self.lever is None else model.predict_poses(q)

    def origins(self, points: Tensor) -> Tensor:
        """Origins (N, B, 3) of bodies with points (N, P, 3), m."""
        return points.unflatten(1, (-1, self.points)).mean(2)

    def averaging(self, like: Tensor) -> Tensor:
        """The origins (3 B,) as linear functions of all coordinates (m,) of points: (3 B, m), m that of ``like``."""
        mean = torch.eye(3, dtype=like.dtype, device=like.device).repeat(1, self.points) / self.points
        return pose_math.block_diagonal(mean.expand(1, like.shape[-1] // (3 * self.points), -1, -1))[0]

    def claimed(self, points: Tensor, covariance: Tensor, usual: Tensor) -> tuple[Tensor, Tensor]:
        """Origins (N, B, 3) of points (N, P, 3), m, and their covariances, from those of all points (N, 3 P, 3 P).

        ``usual``: (N, P, 3), in place of points that are hidden.
        """
        if self.lever is None:
            return points, pose_math.own_blocks(covariance, points.shape[1])
        frames = pose_math.frames_of_points(points.where(~points.isnan(), usual), self.lever)
        along = pose_math.directions_of_frames(frames, self.lever)
        whole = pose_math.own_blocks(along @ covariance @ along.mT, frames.shape[1])
        return frames[..., :3, 3], whole[..., :3, :3]

    def noise_rms(self, noise: Tensor) -> float:
        """RMS distance of a measured origin from the true one, m, by the covariance of all coordinates (3 P, 3 P)."""
        A = self.averaging(noise)
        return float((A @ noise @ A.mT).diagonal().view(-1, 3).sum(1).mean()) ** 0.5

    def errors(self, data: Any, points: Tensor) -> Tensor:
        """(N, B, k) measured minus predicted by points (N, P, 3), m and rad; NaN where hidden."""
        if self.lever is None:
            return data.points - points
        mean = pose_math.frames_of_points(points, self.lever)
        shift = data.frames[..., :3, 3] - mean[..., :3, 3]
        turned = pose_math.rotation_numbers(data.frames[..., :3, :3] @ mean[..., :3, :3].mT, "rotvec")
        return torch.cat([shift, turned], 2)

    def modes(self, data: Any) -> Tensor | None:
        """(N, T, 9, 6) displacements of points by a shift and a turn, zero where hidden; None for markers."""
        if self.lever is None:
            return None
        return pose_math.pose_jacobian(data.frames, self.lever, data.board).nan_to_num(0.0)

    def modes_of(self, data: Any, points: Tensor) -> Tensor | None:
        """Modes of other rows of the device, whose points (K, P, 3) are known, m: a camera sees its board there."""
        if self.lever is None:
            return None
        frames, camera = pose_math.frames_of_points(points, self.lever), seen_board(data)
        board = None
        if camera is not None:
            away = camera.origins.mean(0) - frames[:, 0, :3, 3]
            board = (frames[:, 0, :3, :3].mT @ away[..., None])[..., 0]
        return pose_math.pose_jacobian(frames, self.lever, board)

    def moved_words(self, points: int) -> str:
        """Name in messages for this number of points of the tool that may have moved."""
        return f"the {'marker' if self.lever is None else 'tool'}{'s' * (points > self.points)}"

    def mirrored(self, data: Any) -> Iterator[Tensor]:
        """Points (N, P, 3) in a frame of the other hand; none where a rotation shows the hand."""
        yield from [] if self.lever is not None else [data.points * data.points.new_tensor([1.0, 1.0, -1.0])]

    def exchangeable(self, data: Any) -> range:
        """Bodies whose numbers may be exchanged in a row: a tip has one frame."""
        return range(data.markers if self.lever is None else 0)

    def labels(self, data: Any, on: Sequence[str] | None = None) -> list[tuple[int | None, str | None]]:
        """Number of each of several markers, tip of each of several frames; ``on``: of points that name none."""
        count = data.markers // self.points
        if self.lever is None:
            return [(number if count > 1 else None, None) for number in range(count)]
        return [(None, tip if count > 1 else None) for tip in pose_math.frame_tips(data.on or on, count)]

    def represented(self, data: Any) -> Any:
        """The rows with the points of these bodies."""
        if self.lever is None or data.frames is None or data.lever == self.lever:
            return data
        return with_attributes(data, points=pose_math.points_of_frames(data.frames, self.lever), lever=self.lever)

    def check_points(self, points: int) -> None:
        """Raise InputError for a number of points of a model that no such bodies have."""
        if points % self.points:
            raise InputError.of("a model of poses", expected="three points for each", got=points)

    def pose_lever(self) -> float:
        """The lever; InputError for markers."""
        if self.lever is None:
            what, fix = "this model was calibrated with points: it has no poses", "calibrate with measured poses"
            raise InputError.of(what, fix=f"{fix} (Measurements.from_poses), or call the model for its points")
        return self.lever

    def nowhere(self, points: int, like: Tensor) -> Tensor:
        """Old places (P, 3) of bodies that nobody has seen: at the tip, m."""
        if self.lever is None:
            return like.new_zeros(points, 3)
        eye = torch.eye(4, dtype=like.dtype, device=like.device)
        return pose_math.mark_points(eye, self.lever).repeat(points // pose_math.POINTS, 1)

    def prefixes(self, model: Any) -> list[str]:
        """Nothing for a single marker or frame; marker1_, ... and ball_ for the ball, TIP_ of frames."""
        count = model.markers // self.points
        if count == 1:
            return [""]
        if self.lever is not None:
            return [f"{tip}_" for tip in pose_math.frame_tips(model.on, count)]
        markers = count - model.ball
        return [*("marker_" if markers == 1 else f"marker{k + 1}_" for k in range(markers)), *[f"{BALL}_"] * model.ball]

    def name(self, number: int, count: int) -> str:
        """Name of one of several bodies."""
        return "measured frame" if self.lever is not None else f"marker {number}" if count > 1 else "marker"


class SeenBoard(NamedTuple):
    """A board that a camera on the tool saw in N rows."""

    board: Tensor  # (N, 3) its origin in the camera's frame, m
    origins: Tensor  # (N, 3) the same in the measuring frame
    axes: Tensor  # (N, 3, 3) of the camera
    lever: float  # of the points that represent its poses, m


def seen_board(data: Any) -> SeenBoard | None:
    """The board of some rows; None unless a camera on the tool saw one."""
    if data.board is None or data.poses is None or data.lever is None:
        return None
    axes = data.poses[:, :3, :3]
    return SeenBoard(data.board, data.poses[:, :3, 3] + (axes @ data.board[..., None])[..., 0], axes, data.lever)


def placement_lines(
    geometry: Any, *, poses: bool, ball: bool = False, frame: str = "the measuring frame"
) -> Iterator[str]:
    """Where the robot's base was found in the measuring ``frame``, and the markers in their tips' frames.

    Args:
        geometry: as refined with the deformations. poses: whether the markers are the points of measured frames, three
            of each. ball: whether the last one of several is a ball that rested in sockets.
    """
    yield f"robot base in {frame}: {transform_words(geometry.base)}"
    yield from marker_lines(geometry.tool, geometry.on, poses=poses, ball=ball)


def marker_lines(
    points: Tensor, tips: Sequence[str], *, poses: bool, ball: bool = False, std: Tensor | None = None
) -> Iterator[str]:
    """Places (P, 3) of markers, m, or of the frames that they represent; ``std``: standard deviations (P, 3)."""
    places, tips = (points, tips) if not poses else (points.unflatten(0, (-1, 3)).mean(1), tips[:: pose_math.POINTS])
    for k, (place, tip) in enumerate(zip(places, tips, strict=True)):
        what = "measured frame" if poses else "marker" + f" {k}" * (len(places) > 1 + ball)
        what = "ball" if ball and k == len(places) - 1 > 0 else what
        end = "" if std is None else f", known to {triple(1e3 * std[k], '.2g')} mm"
        yield f"{what} in the frame of '{tip}': {triple(1e3 * place)} mm{end}"


def transform_words(frame: Tensor) -> str:
    """A transform (4, 4), m, in words."""
    turn = pose_math.rotation_numbers(frame[None, :3, :3], "rotvec", angle="deg")[0]
    return f"{triple(1e3 * frame[:3, 3])} mm, rotation vector {triple(turn)} deg"


def triple(values: Tensor, digits: str = ".3f") -> str:
    """Lengths, or other numbers, in words, separated by blanks."""
    return " ".join(f"{value:{digits}}" for value in values.tolist())
