"""Sockets of a ball, and what else shows a tool whose poses are measured: a tracker's marker, the robot's other hand.

With the measured pose T of the tool, a point p that is fixed to it, and a device in the place B that is not known,

    y = B T p (marker),        0 = T p - c (contact in a socket at c).

A tracker holds lengths, as a printed board does; contacts do not. A rigid tool that two hands hold at once does not let
them move to each other, whatever the joints do: with their poses T_1, T_2 and the transform X between them,

    X^-1 T_1^-1 T_2 = 1,

whose shift and turn, times the lever of measured poses, are readings of value zero: rows without a device.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.maps.observation import FromPlaces, Observation
from diffeo_calib.measurements.bodies import triple
from diffeo_calib.measurements.poses import POINTS
from diffeo_calib.measurements.readings import KIND
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.robots.placement import PLACES, place
from diffeo_calib.robots.se3 import nearest_rotations
from diffeo_calib.sensors.devices import Devices, Extrinsics, least_squares, moved_pose

ALIKE = 0.05  # deviation of a block's distance from one place to another, relative to that of the distance itself
IN_SOCKET_M = 0.02
"""Largest distance of the ball from the place of a socket, stated roughly, at which it counts as resting there."""


@dataclass(frozen=True, eq=False)
class Trackers(Devices):
    """Trackers: constants are the rows (12) of the transform B to their frames, and the marker (3) on the tool, m."""

    kind = "marker"
    size_fix = "measure longer moves"
    seen_points, numbers_each, increments_each = 3, 3, 9

    @staticmethod
    def read(constants: Tensor, body: Tensor) -> Tensor:
        B, marker = constants[:12].view(3, 4), constants[12:]
        return B[:, :3] @ (body[:3, :3] @ marker + body[:3, 3]) + B[:, 3]

    @staticmethod
    def changed(constants: Tensor, increments: Tensor) -> Tensor:
        return torch.cat([moved_pose(constants[:12], increments[:6]), constants[12:] + increments[6:]])

    @classmethod
    def start(cls, values: Tensor, bodies: Tensor) -> Tensor:
        """The place of a robot whose tip has these poses."""
        fit = place(bodies[:, None], values[:, None])
        return torch.cat([fit.base[:3].flatten(), fit.tool[0]])

    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        marker, std = 1e3 * self.constants[number, 12:], 1e3 * deviations[6:]
        place = f"{triple(marker)} +- {triple(std)} mm in the measured frame"
        return f"marker of '{self.names[number]}': {place}; lengths are its own and the board's"


@dataclass(frozen=True, eq=False)
class SocketPlaces(Devices):
    """Sockets, in which a ball shows nothing but that it is there: constants are their places (3), m.

    Args:
        before: square root (3 D, 3 D) of the covariance of the places before the rows, m, where it is not diagonal.
    """

    kind, reads, stated_as = KIND, False, "X,Y,Z"
    size_fix = "pass a known distance between two sockets"
    numbers_each, increments_each = 3, 3
    before: tuple[Tensor, ...] = ()

    @classmethod
    def of(cls, data: Any, constants: Tensor) -> SocketPlaces:
        """Around places (D, 3), m, where the known distances, linearised there, make them most probable."""
        D, std = len(constants), PLACES.found_m_rad
        one_hot, wide = (torch.eye(k, dtype=constants.dtype, device=constants.device) for k in (D, 3 * D))
        equations = [torch.nn.functional.pad(wide / std, (0, 1))]
        for block in data.blocks:
            first, second, lengths = (list(each) for each in zip(*block, strict=True))
            away = constants[second] - constants[first]
            U = (one_hot[second] - one_hot[first])[:, :, None] * torch.nn.functional.normalize(away)[:, None]
            matrix = torch.cat([U.flatten(1), (away.new_tensor(lengths) - away.norm(dim=1))[:, None]], 1)
            noise = (1.0 + ALIKE**2 * matrix.new_ones(len(matrix)).diag()) * data.distance_std**2
            equations.append(torch.linalg.solve_triangular(torch.linalg.cholesky(noise), matrix, upper=False))
        R = torch.linalg.qr(torch.cat(equations), mode="r").R[: 3 * D]
        root = torch.linalg.inv(R[:, :-1])
        places = constants + (root @ R[:, -1]).view(-1, 3)
        return cls(data.names, places, torch.full_like(places, std), before=(root,))

    @classmethod
    def start(cls, values: Tensor, bodies: Tensor) -> Tensor:
        return (bodies - values).median(0).values  # a mean would lie far from all rows if one is of another socket

    @staticmethod
    def read(constants: Tensor, body: Tensor) -> Tensor:
        return body - constants

    @classmethod
    def columns(cls) -> Mapping[str, Sequence[str]]:
        """None: the names of sockets are no readings."""
        return {}

    @property
    def root(self) -> Tensor:
        return self.before[0] if self.before else super().root

    def by_increments(self, points: Tensor, device: Tensor) -> Tensor:
        return -torch.eye(3, dtype=points.dtype, device=points.device).expand(len(points), 3, 3)

    def only(self, names: Collection[str]) -> SocketPlaces:
        return replace(super().only(names), before=())

    def observation(self, device: Tensor) -> Observation:
        return FromPlaces(self.constants[device])

    @classmethod
    def stated(cls, numbers: Tensor) -> Tensor:
        return numbers

    @property
    def places(self) -> Tensor:
        return self.constants

    def sees(self, points: Tensor, device: Tensor) -> Tensor:
        return (points - self.constants[device]).norm(dim=1) < IN_SOCKET_M

    def same_set(self, other: Extrinsics) -> bool:
        """Sockets are all of one set."""
        return self.kind == other.kind

    def carried(self, T: Tensor, before: Tensor, after: Tensor, markers: Tensor) -> Tensor:
        return self.constants @ T[:3, :3].mT + T[:3, 3]

    def where(self, number: int) -> str:
        return f"{triple(1e3 * self.constants[number])} mm"

    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        place = f"{triple(1e3 * self.constants[number])} +- {triple(1e3 * deviations)} mm in {frame}"
        return f"socket '{self.names[number]}': {place}"


@dataclass(frozen=True, eq=False)
class Contacts(Devices):
    """Sockets: constants are the place (3) of each, and the ball (3) on the tool, m, by its own rows."""

    kind = "contact"
    size_fix = "measure poses too: contacts hold no lengths"
    seen_points, numbers_each, increments_each = 3, 3, 6

    @staticmethod
    def read(constants: Tensor, body: Tensor) -> Tensor:
        return body[:3, :3] @ constants[3:] + body[:3, 3] - constants[:3]

    @staticmethod
    def turned(values: Tensor, T: Tensor) -> Tensor:
        return values @ T[:3, :3].mT

    @classmethod
    def start(cls, values: Tensor, bodies: Tensor) -> Tensor:
        eye = torch.eye(3, dtype=values.dtype, device=values.device).expand(len(bodies), 3, 3)
        columns = torch.cat([eye, -bodies[:, :3, :3]], 2).flatten(0, 1)
        return least_squares(columns, (bodies[:, :3, 3] - values).flatten())

    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        place, ball = (triple(1e3 * part) for part in self.constants[number].split(3))
        std = 1e3 * float(deviations[:3].norm())
        what = f"socket '{self.names[number]}': {place} +- {std:.3f} mm in {frame}"
        return f"{what}, the ball at {ball} mm in the measured frame"


@dataclass(frozen=True, eq=False)
class HeldTools(Devices):
    """Tools: constants are the rows (12) of the transform from the second hand to the first."""

    kind = "held tool"
    size_fix = "measure poses too: a held tool holds no lengths"
    seen_points, numbers_each, increments_each = 2 * POINTS, 6, 6

    @staticmethod
    def read(constants: Tensor, body: Tensor) -> Tensor:
        """Shift and, to first order, turn of the second hand from where the tool would have it, m."""
        left, right, held = body[0], body[1], constants.view(3, 4)
        R = left[:3, :3].mT @ right[:3, :3]
        shift = left[:3, :3].mT @ (right[:3, 3] - left[:3, 3]) - held[:, 3]
        turned = held[:, :3].mT @ R
        skewed = turned - turned.mT
        return torch.cat(
            [held[:, :3].mT @ shift, 0.5 * LEVER * torch.stack([skewed[2, 1], skewed[0, 2], skewed[1, 0]])]
        )

    @staticmethod
    def changed(constants: Tensor, increments: Tensor) -> Tensor:
        """Shifted and turned in the first hand's frame."""
        return moved_pose(constants, increments)

    @classmethod
    def start(cls, values: Tensor, bodies: Tensor) -> Tensor:
        """The mean of T_1^-1 T_2."""
        left, right = bodies[:, 0], bodies[:, 1]
        R = nearest_rotations((left[:, :3, :3].mT @ right[:, :3, :3]).mean(0))
        shift = (left[:, :3, :3].mT @ (right[:, :3, 3:] - left[:, :3, 3:])).mean(0)
        return torch.cat([R, shift], 1).flatten()

    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        place = triple(1e3 * self.constants[number].view(3, 4)[:, 3])
        shift, turn = 1e3 * float(deviations[:3].norm()), 1e3 * float(deviations[3:].norm())
        what = f"held tool '{self.names[number]}': the second hand at {place} +- {shift:.3f} mm"
        return f"{what}, +- {turn:.2f} mrad in the frame of the first"
