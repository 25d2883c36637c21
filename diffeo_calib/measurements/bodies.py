"""Bodies seen on the tool, markers or frames that three points each represent: the only place that knows both.

A body has an origin, the marker itself or that of its frame, and numbers that tell where it is: three coordinates, of
frames a rotation vector too. In a registration it is an unknown around its old place.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, printable
from diffeo_calib.measurements.pose_frames import (
    POINTS,
    block_diagonal,
    by_frame,
    directions_of_frames,
    frame_tips,
    frames_of_points,
    middles,
    own_blocks,
    points_of_frames,
    pose_jacobian,
    transforms_of_frames,
    visible_rotation_numbers,
)
from diffeo_calib.measurements.poses import angle_between, check_lever, mark_points, rotation_numbers
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.sockets import BALL
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.se3 import rotation, skew

POSE_NAMES = ("x", "y", "z", "rx", "ry", "rz")


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


class Bodies:
    """Markers; :class:`Frames` differ. Tables ``data`` are :class:`Measurements` of such bodies."""

    lever: float | None = None
    """Distance of the points of a frame from its origin, m; None for markers."""
    points, numbers = 1, 3
    """Points of one of them, and numbers that tell where it is."""
    kind, one, many, maker = "points", "marker", "markers", "Measurements"
    """Their name in messages; the function that makes a table of them."""

    def tips(self, on: Sequence[str]) -> Sequence[str]:
        """The tip of each body, of those of all points."""
        return on[:: self.points]

    def predicted(self, model: Any, q: Any, *, noise: bool = True) -> Predicted:
        """Prediction of a calibrated model at configurations (N, n), by default of new measurements."""
        mean, covariance = model.predict(q, noise=noise)
        return Predicted(mean, mean, covariance, POSE_NAMES[:3])

    def written(self, model: Any, q: Tensor) -> tuple[Tensor, Tensor]:
        """The same as files hold it: markers (N, B, 3) m, or poses; covariances."""
        return model.predict(q)

    def origins(self, points: Tensor) -> Tensor:
        """Origins (N, B, 3) of bodies with points (N, P, 3), m."""
        return points

    def averaging(self, like: Tensor) -> Tensor:
        """The origins (3 B,) as linear functions of all coordinates (m,) of points: (3 B, m), m that of ``like``."""
        return torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)

    def claimed(self, points: Tensor, covariance: Tensor, usual: Tensor) -> tuple[Tensor, Tensor]:
        """Origins (N, B, 3) of points (N, P, 3), m, and their covariances, from those of all points (N, 3 P, 3 P).

        ``usual``: (N, P, 3), in place of points that are hidden.
        """
        return points, own_blocks(covariance, points.shape[1])

    def noise_rms(self, noise: Tensor) -> float:
        """RMS distance of a measured origin from the true one, m, by the covariance of all coordinates (3 P, 3 P)."""
        return float(noise.diagonal().view(-1, 3).sum(1).mean()) ** 0.5

    def perhaps_moved(self, *, far: bool) -> bool:
        """Whether a device or body may have moved, from whether the origins are ``far`` off."""
        return far

    def errors(self, data: Any, points: Tensor) -> Tensor:
        """(N, B, k) measured minus predicted by points (N, P, 3), m and rad; NaN where hidden."""
        return data.points - points

    def turns(self, data: Any, points: Tensor) -> Tensor:
        """(N, T) angles, rad, from T measured frames to those of points (N, P, 3); T is 0 for markers."""
        return points.new_zeros(len(points), 0)

    def modes(self, data: Any) -> Tensor | None:
        """(N, T, 9, 6) displacements of points by a shift and a turn, see :class:`NoiseModel`; None for markers."""
        return None

    def modes_of(self, data: Any, points: Tensor) -> Tensor | None:
        """The same of other rows of the device, whose points (K, P, 3) are known, m; None for markers."""
        return None

    def mirrored(self, data: Any) -> Iterator[Tensor]:
        """Points (N, P, 3) in a frame of the other hand; none where a rotation shows the hand."""
        yield torch.cat([data.points[..., :2], -data.points[..., 2:]], dim=-1)

    def exchangeable(self, data: Any) -> range:
        """Bodies whose numbers may be exchanged in a row."""
        return range(data.markers)

    def on_tips(self, data: Any, on: Sequence[str]) -> Any:
        """The rows with their frames on the tips of these points, unless they name some themselves."""
        return data

    def labels(self, data: Any) -> list[tuple[int | None, str | None]]:
        """Number of each of several markers, tip of each of several frames."""
        return [(number if data.markers > 1 else None, None) for number in range(data.markers)]

    def represented(self, data: Any) -> Any:
        """The rows with the points of these bodies."""
        return data

    def check_points(self, points: int) -> None:
        """Raise InputError for a number of points of a model that no such bodies have."""

    def pose_lever(self) -> float:
        """The lever; InputError for markers."""
        what, fix = "this model was calibrated with points: it has no poses", "calibrate with measured poses"
        raise InputError.of(what, fix=f"{fix} (Measurements.from_poses), or call the model for its points")

    def at(self, old: Tensor) -> Body:
        """As unknowns around old places (P, 3), m."""
        return FreePoints(old, torch.zeros_like(old))

    def nowhere(self, points: int, like: Tensor) -> Tensor:
        """Old places (P, 3) of bodies that nobody has seen: at the tip, m."""
        return like.new_zeros(points, 3)

    def prefixes(self, model: Any) -> list[str]:
        """Nothing for a single marker, ball_ for the ball."""
        if model.markers == 1:
            return [""]
        seen = model.markers - model.ball
        return [*("marker_" if seen == 1 else f"marker{k + 1}_" for k in range(seen)), *[f"{BALL}_"] * model.ball]

    def place_lines(self, model: Any) -> Iterator[str]:
        """Where the bodies of a model are in the frames of their tips, for a record."""
        geometry = model.geometry
        for number, (tip, marker) in enumerate(zip(geometry.on, geometry.tool.tolist(), strict=True)):
            place = " ".join(f"{value:.6f}" for value in marker)
            yield f"marker {number} in the frame of {printable(tip)} [m]: {place}"

    def moved_words(self, points: int) -> str:
        """Name in messages for this number of points of the tool that may have moved."""
        return "the marker" if points == 1 else "the markers"

    def name(self, number: int, count: int) -> str:
        """Name of one of several bodies."""
        return f"marker {number}" if count > 1 else "marker"


class Frames(Bodies):
    """Measured frames, on one or several tips.

    Args:
        lever: distance of their points from their origins, m.
    """

    points, numbers = POINTS, 6
    kind, one, many, maker = "poses", "frame", "poses", "Measurements.from_poses"

    def __init__(self, lever: float) -> None:
        check_lever(lever)
        self.lever: float = lever

    def predicted(self, model: Any, q: Any, *, noise: bool = True) -> Predicted:
        """See :class:`Bodies`."""
        frames, covariance = map(by_frame, model.predict_poses(q, noise=noise))
        turns = visible_rotation_numbers(frames, "rotvec", "rad")
        mean = torch.cat([frames[..., :3, 3], turns.to(frames)], 2)
        return Predicted(points_of_frames(frames, self.lever), mean, covariance, POSE_NAMES)

    def written(self, model: Any, q: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`Bodies`."""
        return model.predict_poses(q)

    def origins(self, points: Tensor) -> Tensor:
        """See :class:`Bodies`."""
        return middles(points)

    def averaging(self, like: Tensor) -> Tensor:
        """Means of three points."""
        mean = torch.eye(3, dtype=like.dtype, device=like.device).repeat(1, POINTS) / POINTS
        return block_diagonal(mean.expand(1, like.shape[-1] // (3 * POINTS), -1, -1))[0]

    def claimed(self, points: Tensor, covariance: Tensor, usual: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`Bodies`."""
        frames = frames_of_points(points.where(~points.isnan(), usual), self.lever)
        along = directions_of_frames(frames, self.lever)
        whole = own_blocks(along @ covariance @ along.mT, frames.shape[1])
        return frames[..., :3, 3], whole[..., :3, :3]

    def noise_rms(self, noise: Tensor) -> float:
        """See :class:`Bodies`; the origin is the mean of its three points."""
        blocks = own_blocks(noise[None], len(noise) // 9)[0].unflatten(2, (3, 3)).unflatten(1, (3, 3))
        return float(blocks.mean((1, 3)).diagonal(dim1=1, dim2=2).sum(1).mean()) ** 0.5

    def perhaps_moved(self, *, far: bool) -> bool:
        """See :class:`Bodies`; a turn does not show in the origins."""
        return True

    def errors(self, data: Any, points: Tensor) -> Tensor:
        """Three coordinates of the origin and a rotation vector."""
        mean = frames_of_points(points, self.lever)
        shift = data.frames[..., :3, 3] - mean[..., :3, 3]
        turned = transforms_of_frames(data.frames[..., :3, :3] @ mean[..., :3, :3].mT, data.frames[..., :3, 3])
        return torch.cat([shift, visible_rotation_numbers(turned, "rotvec", "rad")], 2)

    def turns(self, data: Any, points: Tensor) -> Tensor:
        """See :class:`Bodies`."""
        return angle_between(frames_of_points(points, self.lever)[..., :3, :3], data.frames[..., :3, :3])

    def modes(self, data: Any) -> Tensor:
        """See :class:`Bodies`: zero where hidden."""
        return pose_jacobian(data.frames, self.lever, data.board).nan_to_num(0.0)

    def mirrored(self, data: Any) -> Iterator[Tensor]:
        """None."""
        yield from ()

    def exchangeable(self, data: Any) -> range:
        """None: a tip has one frame."""
        return range(0)

    def on_tips(self, data: Any, on: Sequence[str]) -> Any:
        """See :class:`Bodies`."""
        named = data.on is not None or len(on) != data.markers
        return data if named else data.with_tips(self.tips(on))

    def labels(self, data: Any) -> list[tuple[int | None, str | None]]:
        """See :class:`Bodies`."""
        frames = data.markers // POINTS
        return [(None, tip if frames > 1 else None) for tip in frame_tips(data.on, frames)]

    def modes_of(self, data: Any, points: Tensor) -> Tensor:
        """See :class:`Bodies`; a camera sees its board where it is in these rows."""
        frames, seen = frames_of_points(points, self.lever), seen_board(data)
        board = None
        if seen is not None:
            away = seen.origins.mean(0) - frames[:, 0, :3, 3]
            board = (frames[:, 0, :3, :3].mT @ away[..., None])[..., 0]
        return pose_jacobian(frames, self.lever, board)

    def represented(self, data: Any) -> Any:
        """See :class:`Bodies`."""
        if data.frames is None or data.lever == self.lever:
            return data
        return with_attributes(data, points=points_of_frames(data.frames, self.lever), lever=self.lever)

    def check_points(self, points: int) -> None:
        """See :class:`Bodies`."""
        if points % POINTS:
            raise InputError.of("a model of poses", expected="three points for each", got=points)

    def pose_lever(self) -> float:
        """See :class:`Bodies`."""
        return self.lever

    def at(self, old: Tensor) -> Body:
        """See :class:`Bodies`."""
        turn = torch.eye(3, dtype=old.dtype, device=old.device).expand(len(old) // POINTS, 3, 3)
        return RigidFrames(old, self.lever, turn, torch.zeros_like(turn[:, 0]))

    def nowhere(self, points: int, like: Tensor) -> Tensor:
        """See :class:`Bodies`."""
        eye = torch.eye(4, dtype=like.dtype, device=like.device)
        return mark_points(eye, self.lever).repeat(points // POINTS, 1)

    def prefixes(self, model: Any) -> list[str]:
        """Nothing for a single frame, else TIP_."""
        frames = model.markers // POINTS
        return [""] if frames == 1 else [f"{tip}_" for tip in frame_tips(model.on, frames)]

    def place_lines(self, model: Any) -> Iterator[str]:
        """See :class:`Bodies`."""
        for tip, frame in zip(self.tips(model.geometry.on), by_frame(model.measured_frame[None])[0], strict=True):
            yield f"measured frame in the frame of {printable(tip)}, 4 x 4 [m]:"
            yield from matrix_lines(frame)

    def moved_words(self, points: int) -> str:
        """See :class:`Bodies`."""
        return "the tool" if points <= POINTS else "the tools"

    def name(self, number: int, count: int) -> str:
        """See :class:`Bodies`."""
        return "measured frame"


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
    if data.board is None or data.poses is None or data.lever is None:
        return None
    axes = data.poses[:, :3, :3]
    return SeenBoard(data.board, data.poses[:, :3, 3] + (axes @ data.board[..., None])[..., 0], axes, data.lever)


def bodies_of(lever: float | None) -> Bodies:
    """Frames whose points have this distance from their origins, m; markers without."""
    return Bodies() if lever is None else Frames(lever)


@dataclass(frozen=True)
class FreePoints:
    """Markers that move independently: d = 3 P.

    Args:
        old: (P, 3) places that the prior prefers, m.
        shift: (P, 3) from the old to the present places, m.
    """

    old: Tensor
    shift: Tensor

    lever = None

    @property
    def points(self) -> Tensor:
        """(P, 3) the present places, m."""
        return self.old + self.shift

    @property
    def slopes(self) -> Tensor:
        """(3 P, d) derivatives of the present places by the unknowns."""
        return torch.eye(self.old.numel(), dtype=self.old.dtype, device=self.old.device)

    @property
    def from_old(self) -> Tensor:
        """(d,) the unknowns that lead from the old places to the present ones, to first order at the present."""
        return self.shift.flatten()

    def stepped(self, step: Tensor) -> FreePoints:
        """After a step (d,) of the unknowns."""
        return replace(self, shift=self.shift + step.view(-1, 3))

    def at(self, points: Tensor) -> FreePoints:
        """The body at the places nearest to these (P, 3)."""
        return replace(self, shift=points - self.old)

    def deviations(self, metres: float) -> Tensor:
        """(d,) prior standard deviations of a body that may have moved by this distance, m."""
        return torch.full_like(self.old.flatten(), metres)


@dataclass(frozen=True)
class RigidFrames:
    """The three points of each of T measured frames, which move as one: d = 6 T, shifts [m] and turns [rad].

    Args:
        old: (3 T, 3) places that the prior prefers, m.
        lever: distance of the points from their centres, m.
        turn: (T, 3, 3) and shift: (T, 3) of the old points of each frame about their centre, m.
    """

    old: Tensor
    lever: float
    turn: Tensor
    shift: Tensor

    @property
    def points(self) -> Tensor:
        """See :class:`FreePoints`."""
        old = self.old.unflatten(0, (-1, POINTS))
        centre = old.mean(1, keepdim=True)
        return ((old - centre) @ self.turn.mT + centre + self.shift[:, None]).flatten(0, 1)

    @property
    def slopes(self) -> Tensor:
        """See :class:`FreePoints`."""
        points = self.points.unflatten(0, (-1, POINTS))
        eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(*points.shape[:2], 3, 3)
        own = torch.cat([eye, -skew(points - points.mean(1, keepdim=True))], -1).flatten(1, 2)
        return torch.block_diag(*own)

    @property
    def from_old(self) -> Tensor:
        """See :class:`FreePoints`."""
        return torch.cat([self.shift, rotation_numbers(self.turn, "rotvec").to(self.shift.device)], 1).flatten()

    def stepped(self, step: Tensor) -> RigidFrames:
        """See :class:`FreePoints`."""
        shift, turn = step.view(-1, 6).split(3, 1)
        return replace(self, shift=self.shift + shift, turn=rotation(turn) @ self.turn)

    def at(self, points: Tensor) -> RigidFrames:
        """See :class:`FreePoints`."""
        pairs = zip(self.old.split(POINTS), points.split(POINTS), strict=True)
        turn = torch.stack([rigid_fit(old, new)[:3, :3] for old, new in pairs])
        return replace(self, turn=turn, shift=(points - self.old).unflatten(0, (-1, POINTS)).mean(1))

    def deviations(self, metres: float) -> Tensor:
        """See :class:`FreePoints`."""
        sizes = [metres] * 3 + [metres / self.lever] * 3
        return torch.tensor(sizes * len(self.turn), dtype=self.old.dtype, device=self.old.device)


Body = FreePoints | RigidFrames
"""The points of the tool as unknowns around their old places."""


def matrix_lines(transform: Tensor) -> Iterator[str]:
    """A transform (4, 4) as a matrix, and as a place and a rotation vector."""
    for row in transform.tolist():
        yield "  " + " ".join(f"{value: .8f}" for value in row)
    turn = rotation_numbers(transform[None, :3, :3], "rotvec")[0]
    numbers = torch.cat([transform[:3, 3], turn]).tolist()
    yield "  x y z rx ry rz [m, rad]: " + " ".join(f"{value:.6f}" for value in numbers)
