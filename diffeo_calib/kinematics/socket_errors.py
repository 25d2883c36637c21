"""Errors of any kinematics on rows whose ball rested in sockets: spread within sockets, distances between them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.rows import NO_SOCKET
from diffeo_calib.measurements.sockets import Sockets
from diffeo_calib.measurements.table import Measurements


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


@dataclass(frozen=True, eq=False)
class SocketErrors:
    """Spread and distances of predicted positions.

    Args:
        away: (N, 3) from the predicted position of each row to the middle of its socket, m; NaN without one.
        distances: those whose sockets both have rows.
    """

    away: Tensor
    distances: tuple[DistanceError, ...]


def socket_errors(predicted: Tensor, socket: Tensor, sockets: Sockets) -> SocketErrors:
    """Compare predicted positions (N, 3), m, of rows in sockets (N,) with one another: the middle is their mean."""
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
    away = (middles[socket] - predicted).masked_fill(~inside[:, None], torch.nan)
    return SocketErrors(away, distances)


def with_markers_of(model: CalibratedKinematics, data: Measurements) -> Measurements:
    """The measurements with the markers of a model of both kinds of rows: those of one kind hide the other ones.

    Raises:
        InputError: rows in sockets, and a model of a marker: a ball in sockets is not what a tracker saw.
    """
    if data.sockets is not None and not model.ball:
        fix = "calibrate with rows in sockets; the marker of the model is not where the ball is"
        got = "one that was calibrated with measured positions"
        raise InputError.of("rows with a ball in sockets", expected="a model of such rows", got=got, fix=fix)
    if data.markers != model.markers and model.ball:
        if data.sockets is None and data.poses is None and data.markers == model.markers - 1:
            return data.with_hidden_ball()
        if data.sockets is not None and data.markers == 1:
            return data.with_hidden_markers(model.markers - 1)
    return data
