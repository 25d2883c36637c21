"""Rows without a measuring device: a ball on the tool rests in a socket, whose place is not known.

All rows of a socket have their ball at the same unknown point. Sockets in one rigid block stand at one place; distances
between some of them may be known, such as 50 mm in a printed block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import number_of
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, as_written, few, listed
from diffeo_calib.measurements.checks import numbers_of, texts_of
from diffeo_calib.measurements.rows import NO_SOCKET, RowGroups, with_attributes

if TYPE_CHECKING:
    from typing_extensions import Self

SEPARATOR = "/"
"""Between the name of a place and that of a socket: "front/0"."""
Distances = Mapping[tuple[str, str], float]
ONE_SESSION: dict[str, object] = {"session": None, "session_names": (), "remounted": False}
BALL = "ball"
"""Name of the last marker, if the other ones have names."""
FLATTERY = (
    "the spread within sockets is smaller than the true error: it contains neither errors that all rows of a socket "
    "share nor the robot's size, so that absolute errors are 2 to 6 times as large; do not compare models by it"
)


@dataclass(frozen=True)
class Sockets:
    """The sockets that hold the ball in some rows of a table.

    Args:
        names: S names, such as "front/0": that of the place, a slash, that of the socket at this place. A name without
            a slash is a place with one socket.
        distances: known distances, as numbers of two sockets and their distance [m].
        distance_std: their standard deviation [m]; None without distances. The distance of two sockets of a block has
            one error at all places.
    """

    names: tuple[str, ...]
    distances: tuple[tuple[int, int, float], ...] = ()
    distance_std: float | None = None

    @classmethod
    def of(cls, names: tuple[str, ...], distances: Distances | None, std: float | None) -> Sockets:
        """Sockets with known distances [m], see :meth:`Measurements.from_sockets`."""
        if distances is not None and not isinstance(distances, Mapping):
            fix = 'pass {("0", "1"): 0.05} for sockets that are 50 mm apart'
            raise MeasurementError.of("`distances`", expected="a dictionary", got=as_written(distances), fix=fix)
        if not distances:
            if std is not None:
                what, fix = "`distance_std` without `distances`", "pass the distances, or leave it out"
                raise MeasurementError.of(what, fix=fix)
            return cls(names)
        deviation = number_of(std)
        if deviation is None or not 0.0 < deviation < inf:
            fix = "pass how well the distances are known, such as 3e-5 for a printed block, measured with a caliper"
            raise MeasurementError.of("`distance_std`", expected="a positive number in m", got=as_written(std), fix=fix)
        found: dict[tuple[int, int], float] = {}
        for pair, length in distances.items():
            metres = number_of(length)
            if metres is None or not 0.0 < metres < inf:
                raise MeasurementError.of(f"the distance of {pair}", expected="metres above 0", got=as_written(length))
            for both in _pairs(names, pair):
                if found.setdefault(both, metres) != metres:
                    where = " and ".join(names[number] for number in both)
                    got = f"{found[both]:g} and {length:g} m"
                    raise MeasurementError.of(f"the distance of {where}", expected="one value", got=got)
        return cls(names, tuple((*both, length) for both, length in found.items()), deviation)

    @property
    def blocks(self) -> list[tuple[tuple[int, int, float], ...]]:
        """Known distances by block: those of the same sockets at several places, which have one error in common."""
        found: dict[tuple[str, str, float], list[tuple[int, int, float]]] = {}
        for first, second, length in self.distances:
            pair = sorted(self.names[number] for number in (first, second))
            if _place(pair[0]) == _place(pair[1]):
                pair = [name.rpartition(SEPARATOR)[2] for name in pair]
            found.setdefault((pair[0], pair[1], length), []).append((first, second, length))
        return [tuple(known) for known in found.values()]

    @property
    def place_names(self) -> tuple[str, ...]:
        """Names of the places, in the order of their first socket."""
        return tuple(dict.fromkeys(_place(name) for name in self.names))

    @property
    def place(self) -> Tensor:
        """(S,) int64, the place of each socket."""
        return numbers_of([_place(name) for name in self.names], self.place_names)


class SocketTable(RowGroups):
    """Rows of markers whose last one may be a ball that rested in sockets.

    In a table of both kinds of rows the ball is hidden where a device measured, and the other markers where it rested.

    Attributes:
        socket: (N,) int64, where the ball rested, -1 if a device measured. sockets: names and distances.
    """

    flattery = FLATTERY

    points: Tensor
    frames: Any
    poses: Tensor | None = None
    lever: float | None = None
    board: Tensor | None = None
    std: Tensor | None = None
    rotation_std: Tensor | None = None
    marker_names: tuple[str, ...] | None = None
    on: tuple[str, ...] | None = None
    session: Tensor | None = None
    session_names: tuple[str, ...] = ()
    remounted: bool = False
    socket: Tensor | None = None
    sockets: Sockets | None = None

    @property
    def markers(self) -> int:
        """Number of markers P; 3 for every pose of a row, because three points represent a pose."""
        return self.points.shape[1]

    @property
    def without_device(self) -> bool:
        """Whether no position was measured: the ball of every row rested in a socket."""
        return self.socket is not None and bool((self.socket != NO_SOCKET).all())

    @property
    def ball_tip(self) -> str | None:
        """Name of the tip that carries the ball in sockets; None without one."""
        return None if self.sockets is None or self.on is None else self.on[-1]

    @property
    def socket_numbers(self) -> Tensor:
        """(N,) int64, number of each row's socket, -1 for other rows."""
        return super().socket_numbers if self.socket is None else self.socket

    @property
    def places(self) -> Tensor:
        """(N,) int64, number of the place of each row's socket, -1 where a device measured."""
        if self.socket is None or self.sockets is None:
            return self.socket_numbers
        return torch.where(self.socket == NO_SOCKET, NO_SOCKET, self.sockets.place[self.socket])

    @property
    def row_sockets(self) -> list[str]:
        """(N,) name of the socket of each row, "" where a device measured."""
        return texts_of(self.socket, () if self.sockets is None else self.sockets.names, len(self))

    @property
    def known_sockets(self) -> Sockets:
        """The sockets; MeasurementError for rows without any."""
        if self.sockets is None:
            raise MeasurementError.of("the rows have no sockets", fix="pass Measurements.from_sockets(...)")
        return self.sockets

    def other_socket(self, row: int, predicted: Tensor, near: float) -> str | None:
        """Why a row in a socket is far from its place, in words; None for rows in no socket.

        ``predicted`` (N, P, 3), m, ``points`` being the places of the sockets, of which another fits if ``near``, m.
        """
        if int(self.socket_numbers[row]) == NO_SOCKET:
            return None
        away = (predicted[row, -1] - self.points[:, -1]).norm(dim=-1).nan_to_num(torch.inf)
        nearest = int(away.argmin())
        if float(away[nearest]) > near:
            return "far from where the other rows of its socket predict it"
        return f"fits socket '{self.row_sockets[nearest]}': named after a wrong one?"

    def device_rows(self) -> Self:
        """The rows whose positions a device measured, without the ball; the table itself if it has no sockets."""
        if self.socket is None:
            return self
        rows = self.rows(self.socket == NO_SOCKET)
        names = {name: own and own[:-1] for name, own in (("marker_names", rows.marker_names), ("on", rows.on))}
        std = None if rows.std is None else rows.std[:, :-1]
        return with_attributes(rows, socket=None, sockets=None, points=rows.points[:, :-1], std=std, **names)

    def socket_rows(self) -> Self:
        """The rows whose ball rested in sockets, with the ball alone; MeasurementError if there are none."""
        if len(self.known_sockets.names) and self.without_device and self.markers == 1:
            return self
        rows = self.rows(self.socket_numbers != NO_SOCKET)
        changes = {"points": rows.points[:, -1:], "marker_names": None, "on": None, "std": None}
        return with_attributes(rows, **changes, session=None, session_names=())

    def with_sockets_of_rows(self) -> Self:
        """The same rows without the sockets that hold the ball in none of them, and without distances to these."""
        if self.socket is None or self.sockets is None:
            return self
        rest = self.socket != NO_SOCKET
        used, inverse = self.socket[rest].unique(return_inverse=True)
        numbers = torch.full_like(self.socket, NO_SOCKET).masked_scatter(rest, inverse)
        new = {old: number for number, old in enumerate(used.tolist())}
        names = tuple(self.sockets.names[old] for old in new)
        distances = tuple((new[a], new[b], d) for a, b, d in self.sockets.distances if a in new and b in new)
        return with_attributes(self, socket=numbers, sockets=Sockets(names, distances, self.sockets.distance_std))

    def with_markers(self, count: int) -> Self:
        """The rows with this many markers, the ball last: those that rows of one kind do not show are hidden."""
        if self.sockets is not None:
            lacking = count - 1 if self.markers == 1 else 0
            changes: dict[str, object] = {"marker_names": None, "on": None} if lacking else {}
            return with_attributes(self, points=_padded(self.points, lacking, 0), **changes)
        if self.markers != count - 1:
            return self
        names = self.marker_names and (*self.marker_names, BALL)
        changes = {"marker_names": names, "on": self.on and (*self.on, self.on[-1])}
        std = None if self.std is None else _padded(self.std, 0, 1)
        return with_attributes(self, points=_padded(self.points, 0, 1), std=std, **changes)

    @classmethod
    def of_one_layout(cls, tables: Sequence[Self]) -> Sequence[Self]:
        """Positions and rows in sockets with the same markers, the ball as the last one."""
        device = [table for table in tables if table.sockets is None]
        known = [table for table in tables if table.sockets is not None]
        if not known or (not device and len({table.markers for table in tables}) == 1):
            return super().of_one_layout(tables)
        most = max(known, key=lambda table: table.markers)
        both = device[0].with_markers(device[0].markers + 1) if device else most
        found = []
        for table in tables:
            none = torch.full((len(table),), NO_SOCKET, dtype=torch.int64, device=HOST)
            shown = table.with_markers(both.markers if table.sockets is not None else table.markers + 1)
            changes: dict[str, object] = {}
            if table.sockets is None:
                changes = {"socket": none, "sockets": known[0].sockets}
            elif table.markers == 1:
                changes = {"marker_names": both.marker_names, "on": both.on, "remounted": both.remounted}
                changes |= {} if both.std is None else {"std": torch.full_like(shown.points, torch.nan)}
                changes |= {} if both.session is None else {"session": none, "session_names": both.session_names}
            found.append(with_attributes(shown, **changes))
        return super().of_one_layout(found)


def _padded(values: Tensor, before: int, after: int) -> Tensor:
    """Values (N, P, 3) with hidden markers before and after."""
    return torch.nn.functional.pad(values, (0, 0, before, after), value=torch.nan)


def _place(name: str) -> str:
    return name.rpartition(SEPARATOR)[0] or name


def _pairs(names: tuple[str, ...], pair: object) -> list[tuple[int, int]]:
    """Numbers of the two sockets that a pair of names means, the smaller one first; one pair per place for sockets."""
    given = tuple(str(name).strip() for name in pair) if isinstance(pair, (tuple, list)) else ()
    numbers = {name: number for number, name in enumerate(names)}
    if len(given) == 2 and given[0] != given[1]:
        if set(given) <= set(numbers):
            return [(min(numbers[g] for g in given), max(numbers[g] for g in given))]
        places = dict.fromkeys(_place(name) for name in names)
        here = [[numbers.get(f"{place}{SEPARATOR}{one}") for one in given] for place in places]
        both = [(min(a, b), max(a, b)) for a, b in here if a is not None and b is not None]
        if both:
            return both
    fix = f"pass two names of sockets; there are {listed(names) if names else few([])}"
    raise MeasurementError.of("a known distance", expected="names of two sockets", got=as_written(pair), fix=fix)
