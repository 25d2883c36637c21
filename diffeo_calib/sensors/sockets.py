"""Places of sockets in which a ball on the tool rests, and errors of rows in them: a spread within each."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.measurements.bodies import triple
from diffeo_calib.measurements.sockets import NO_SOCKET, Sockets
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.devices import Devices, Extrinsics

IN_SOCKET_M = 0.02
"""Largest distance of the ball from the place of a socket, stated roughly, at which it counts as resting there."""


@dataclass(frozen=True, eq=False)
class SocketPlaces(Devices):
    """Sockets, in which a ball shows nothing but that it is there: constants are their places (3), m."""

    kind, reads, stated_as = "socket", False, "X,Y,Z"
    size_fix = "pass a known distance between two sockets"
    numbers_each, increments_each = 3, 3

    @classmethod
    def start(cls, values: Tensor, bodies: Tensor) -> Tensor:
        return (bodies - values).mean(0)

    @staticmethod
    def read(constants: Tensor, body: Tensor) -> Tensor:
        return body - constants

    @classmethod
    def stated(cls, numbers: Tensor) -> Tensor:
        return numbers

    @property
    def places(self) -> Tensor:
        return self.constants

    def sees(self, points: Tensor, device: Tensor) -> Tensor:
        return (points - self.constants[device]).norm(dim=1) < IN_SOCKET_M

    @classmethod
    def around(cls, ball: Tensor, data: Measurements) -> SocketPlaces:
        """The middles of balls (N, 3), m; a single row deviates as those of others do."""
        socket, known = sockets_of(data)
        numbers = socket.unique()
        own = [ball[socket == number] for number in numbers]
        middles = torch.stack([rows.mean(0) for rows in own])
        spreads = [rows.var(0) for rows in own if len(rows) > 1]
        single = torch.stack(spreads).mean(0).sqrt() if spreads else torch.full_like(middles[0], PLACES.found_m_rad)
        each = [rows.std(0) / len(rows) ** 0.5 if len(rows) > 1 else single for rows in own]
        return cls(tuple(known.names[number] for number in numbers.tolist()), middles, torch.stack(each))

    def same_set(self, other: Extrinsics) -> bool:
        """Sockets are all of one set."""
        return self.kind == other.kind

    def carried(self, T: Tensor, before: Tensor, after: Tensor, markers: Tensor) -> Tensor:
        return self.constants @ T[:3, :3].mT + T[:3, 3]

    def where(self, number: int) -> str:
        return f"{triple(1e3 * self.constants[number])} mm"

    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        return f"socket '{self.names[number]}': {self.where(number)} in {frame}"


def sockets_of(data: Measurements) -> tuple[Tensor, Sockets]:
    """(N,) numbers of the sockets of rows, and these; MeasurementError for rows without any."""
    return data.socket_numbers.to(data.points.device), data.known_sockets


@dataclass(frozen=True)
class DistanceError:
    """A known distance between two sockets, and the distance between the middles of predicted positions.

    Args:
        first, second: names of the sockets. known, found: distances, m.
    """

    first: str
    second: str
    known: float
    found: float

    @property
    def error(self) -> float:
        """Found minus known, m."""
        return self.found - self.known


def socket_errors(predicted: Tensor, socket: Tensor, sockets: Sockets) -> tuple[Tensor, tuple[DistanceError, ...]]:
    """Compare predicted positions (N, 3), m, of rows in sockets (N,) with one another: the middle is their mean.

    Returns:
        (N, 3) from the predicted position of each row to the middle of its socket, m; NaN without one, and of a row
        that is alone in its socket, whose middle it is. Known distances between sockets that both have rows.
    """
    inside = socket != NO_SOCKET
    own = socket[inside]
    count = torch.bincount(own, minlength=len(sockets.names)).to(predicted)
    middles = predicted.new_zeros(len(sockets.names), 3).index_add(0, own, predicted[inside]) / count[:, None]
    seen = (count > 0).tolist()
    distances = tuple(
        DistanceError(sockets.names[a], sockets.names[b], known, float((middles[a] - middles[b]).norm()))
        for a, b, known in sockets.distances
        if seen[a] and seen[b]
    )
    judged = inside & (count > 1)[socket]
    return (middles[socket] - predicted).masked_fill(~judged[:, None], torch.nan), distances
