"""Where the markers sit on the flange, as unknowns of a registration: free points, or rigid frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.measurements.pose_frames import POINTS
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.se3 import rotation, skew


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


def body(old: Tensor, lever: float | None) -> Body:
    """A body at its old places (P, 3); if a lever is given, of rigid frames with three points each."""
    if lever is None:
        return FreePoints(old, torch.zeros_like(old))
    eye = torch.eye(3, dtype=old.dtype, device=old.device)
    frames = [RigidFrame(own, lever, eye, torch.zeros_like(own[0])) for own in old.split(POINTS)]
    return frames[0] if len(frames) == 1 else SeveralFrames(old, tuple(frames))
