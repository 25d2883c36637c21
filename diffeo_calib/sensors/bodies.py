"""What a device sees of the tool, markers or measured frames, and these as unknowns of a registration."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.pose_frames import (
    POINTS,
    by_frame,
    frame_tips,
    points_of_frames,
    visible_rotation_numbers,
)
from diffeo_calib.measurements.poses import check_lever, mark_points, rotation_numbers
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.sockets import BALL
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.se3 import rotation, skew

POSE_NAMES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True)
class Body(ABC):
    """Markers in the tip's frame, as unknowns around their old places.

    Args:
        old: (P, 3) places that the prior prefers, m.
    """

    old: Tensor

    @property
    def lever(self) -> float | None:
        """Distance of the points of a frame from its origin, m; None for markers."""
        return None

    @property
    @abstractmethod
    def points(self) -> Tensor:
        """(P, 3) the present places, m."""

    @property
    @abstractmethod
    def slopes(self) -> Tensor:
        """(3 P, d) derivatives of the present places by the unknowns."""

    @property
    @abstractmethod
    def from_old(self) -> Tensor:
        """(d,) the unknowns that lead from the old places to the present ones, to first order at the present."""

    @abstractmethod
    def stepped(self, step: Tensor) -> Body:
        """After a step (d,) of the unknowns."""

    @abstractmethod
    def at(self, points: Tensor) -> Body:
        """The body at the places nearest to these (P, 3)."""

    @abstractmethod
    def deviations(self, metres: float) -> Tensor:
        """(d,) prior standard deviations of a body that may have moved by so many metres."""


@dataclass(frozen=True)
class FreePoints(Body):
    """Markers that move independently: d = 3 P.

    Args:
        shift: (P, 3) from the old to the present places, m.
    """

    shift: Tensor

    @property
    def points(self) -> Tensor:
        """See the base class."""
        return self.old + self.shift

    @property
    def slopes(self) -> Tensor:
        """See the base class."""
        return torch.eye(self.old.numel(), dtype=self.old.dtype, device=self.old.device)

    @property
    def from_old(self) -> Tensor:
        """See the base class."""
        return self.shift.flatten()

    def stepped(self, step: Tensor) -> FreePoints:
        """See the base class."""
        return replace(self, shift=self.shift + step.view(-1, 3))

    def at(self, points: Tensor) -> FreePoints:
        """See the base class."""
        return replace(self, shift=points - self.old)

    def deviations(self, metres: float) -> Tensor:
        """See the base class."""
        return torch.full_like(self.old.flatten(), metres)


@dataclass(frozen=True)
class RigidFrame(Body):
    """The three points of a measured frame, which move as one: d = 6, shift [m] and turn [rad].

    Args:
        arm: distance of the points from their centre, m. turn: (3, 3) and shift: (3,) of the old points about it.
    """

    arm: float
    turn: Tensor
    shift: Tensor

    @property
    def lever(self) -> float | None:
        """See the base class."""
        return self.arm

    @property
    def points(self) -> Tensor:
        """See the base class."""
        centre = self.old.mean(0)
        return (self.old - centre) @ self.turn.mT + centre + self.shift

    @property
    def slopes(self) -> Tensor:
        """See the base class."""
        points = self.points
        eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(len(points), 3, 3)
        return torch.cat([eye, -skew(points - points.mean(0))], -1).flatten(0, 1)

    @property
    def from_old(self) -> Tensor:
        """See the base class."""
        return torch.cat([self.shift, rotation_numbers(self.turn[None], "rotvec")[0].to(self.shift.device)])

    def stepped(self, step: Tensor) -> RigidFrame:
        """See the base class."""
        return replace(self, shift=self.shift + step[:3], turn=rotation(step[3:]) @ self.turn)

    def at(self, points: Tensor) -> RigidFrame:
        """See the base class."""
        moved = rigid_fit(self.old, points)
        return replace(self, turn=moved[:3, :3], shift=points.mean(0) - self.old.mean(0))

    def deviations(self, metres: float) -> Tensor:
        """See the base class."""
        sizes = [metres] * 3 + [metres / self.arm] * 3
        return torch.tensor(sizes, dtype=self.old.dtype, device=self.old.device)


@dataclass(frozen=True)
class SeveralFrames(Body):
    """Measured frames on several tips, which move independently: d = 6 T.

    Args:
        frames: T of them.
    """

    frames: tuple[RigidFrame, ...]

    @property
    def lever(self) -> float | None:
        """See the base class."""
        return self.frames[0].lever

    @property
    def points(self) -> Tensor:
        """See the base class."""
        return torch.cat([frame.points for frame in self.frames])

    @property
    def slopes(self) -> Tensor:
        """See the base class."""
        return torch.block_diag(*(frame.slopes for frame in self.frames))

    @property
    def from_old(self) -> Tensor:
        """See the base class."""
        return torch.cat([frame.from_old for frame in self.frames])

    def stepped(self, step: Tensor) -> SeveralFrames:
        """See the base class."""
        steps = step.chunk(len(self.frames))
        return replace(self, frames=tuple(f.stepped(own) for f, own in zip(self.frames, steps, strict=True)))

    def at(self, points: Tensor) -> SeveralFrames:
        """See the base class."""
        places = points.chunk(len(self.frames))
        return replace(self, frames=tuple(f.at(own) for f, own in zip(self.frames, places, strict=True)))

    def deviations(self, metres: float) -> Tensor:
        """See the base class."""
        return torch.cat([frame.deviations(metres) for frame in self.frames])


class Bodies(ABC):
    """What is seen of the tool: markers, or measured frames that three points represent."""

    lever: float | None = None
    """Distance of the points of a frame from its origin, m; None for markers."""
    points: ClassVar[int]
    """Points of one of them."""
    numbers: ClassVar[int]
    """Coordinates that tell where one of them is."""
    kind: ClassVar[str]
    one: ClassVar[str]
    many: ClassVar[str]
    maker: ClassVar[str]
    """Of a table of them."""

    @abstractmethod
    def check_points(self, points: int) -> None:
        """Raise InputError for so many points of a model that no such bodies have."""

    @abstractmethod
    def pose_lever(self) -> float:
        """The lever; InputError for markers."""

    @abstractmethod
    def at(self, old: Tensor) -> Body:
        """As unknowns around old places (P, 3), m."""

    @abstractmethod
    def nowhere(self, points: int, like: Tensor) -> Tensor:
        """Old places (P, 3) of bodies that nobody has seen: at the tip, m."""

    @abstractmethod
    def represented(self, data: Measurements) -> Measurements:
        """The rows with the points of these bodies."""

    @abstractmethod
    def predicted(self, model: Any, q: Any) -> Predicted:
        """New measurements that a calibrated model expects at configurations (N, n)."""

    @abstractmethod
    def prefixes(self, model: Any) -> list[str]:
        """What the names of the columns of each body begin with."""

    def moved_words(self, points: int) -> str:
        """What messages call so many points of the tool that may have moved."""
        return "the tool" if points <= POINTS else "the tools"


class Predicted(NamedTuple):
    """Means (N, B, k) of B bodies, m and rad, their covariances (N, B, k, k), and the names of the k numbers."""

    mean: Tensor
    covariance: Tensor
    names: tuple[str, ...]

    @property
    def places(self) -> Tensor:
        """(N, B, 3, 3) covariances of the positions, m^2."""
        return self.covariance[..., :3, :3]


class Markers(Bodies):
    """Points of the tool."""

    points, numbers, kind, one, many, maker = 1, 3, "points", "marker", "markers", "Measurements"

    def check_points(self, points: int) -> None:
        """See the base class."""

    def pose_lever(self) -> float:
        """See the base class."""
        what, fix = "this model was calibrated with points: it has no poses", "calibrate with measured poses"
        raise InputError.of(what, fix=f"{fix} (Measurements.from_poses), or call the model for its points")

    def at(self, old: Tensor) -> Body:
        """See the base class."""
        return FreePoints(old, torch.zeros_like(old))

    def nowhere(self, points: int, like: Tensor) -> Tensor:
        """See the base class."""
        return like.new_zeros(points, 3)

    def represented(self, data: Measurements) -> Measurements:
        """See the base class."""
        return data

    def predicted(self, model: Any, q: Any) -> Predicted:
        """See the base class."""
        mean, covariance = model.predict(q)
        return Predicted(mean, covariance, POSE_NAMES[:3])

    def prefixes(self, model: Any) -> list[str]:
        """Nothing for a single marker, ball_ for the ball."""
        if model.markers == 1:
            return [""]
        seen = model.markers - model.ball
        return [*("marker_" if seen == 1 else f"marker{k + 1}_" for k in range(seen)), *[f"{BALL}_"] * model.ball]

    def moved_words(self, points: int) -> str:
        """See the base class."""
        return "the marker" if points == 1 else "the markers"


class Frames(Bodies):
    """Measured frames, on one or several tips."""

    points, numbers, kind, one, many, maker = POINTS, 6, "poses", "frame", "poses", "Measurements.from_poses"

    def __init__(self, lever: float) -> None:
        check_lever(lever)
        self.lever: float = lever

    def check_points(self, points: int) -> None:
        """See the base class."""
        if points % POINTS:
            raise InputError.of("a model of poses", expected="three points for each", got=points)

    def pose_lever(self) -> float:
        """See the base class."""
        return self.lever

    def at(self, old: Tensor) -> Body:
        """See the base class."""
        eye = torch.eye(3, dtype=old.dtype, device=old.device)
        frames = [RigidFrame(own, self.lever, eye, torch.zeros_like(own[0])) for own in old.split(POINTS)]
        return frames[0] if len(frames) == 1 else SeveralFrames(old, tuple(frames))

    def nowhere(self, points: int, like: Tensor) -> Tensor:
        """See the base class."""
        eye = torch.eye(4, dtype=like.dtype, device=like.device)
        return mark_points(eye, self.lever).repeat(points // POINTS, 1)

    def represented(self, data: Measurements) -> Measurements:
        """See the base class."""
        if data.frames is None or data.lever == self.lever:
            return data
        return with_attributes(data, points=points_of_frames(data.frames, self.lever), lever=self.lever)

    def predicted(self, model: Any, q: Any) -> Predicted:
        """See the base class."""
        frames, covariance = map(by_frame, model.predict_poses(q))
        turns = visible_rotation_numbers(frames, "rotvec", "rad")
        return Predicted(torch.cat([frames[..., :3, 3], turns.to(frames)], 2), covariance, POSE_NAMES)

    def prefixes(self, model: Any) -> list[str]:
        """Nothing for a single frame, else TIP_."""
        frames = model.markers // POINTS
        return [""] if frames == 1 else [f"{tip}_" for tip in frame_tips(model.on, frames)]


def bodies_of(lever: float | None) -> Bodies:
    """Frames whose points are so far from their origins, m; markers without."""
    return Markers() if lever is None else Frames(lever)
