"""Rows without a measuring device: a ball on the tool rests in a socket, whose place is not known.

All rows of a socket have their ball at the same unknown point. Sockets in one rigid block stand at one place; distances
between some of them may be known, such as 50 mm in a printed block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, TypeVar

import torch
from torch import Tensor

from diffeo_calib.common.checks import number_of
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, as_written, few, listed
from diffeo_calib.measurements.frozen import with_attributes
from diffeo_calib.measurements.row_names import row_names

T = TypeVar("T")
SEPARATOR = "/"
"""Between the name of a place and that of a socket: "front/0"."""
Distances = Mapping[tuple[str, str], float]
NO_SOCKET = -1
"""Number of the socket of rows whose positions a device measured."""


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
        known = self.place_names
        return torch.tensor([known.index(_place(name)) for name in self.names], dtype=torch.int64, device=HOST)


def socket_numbers(
    names: Sequence[str], rows: int, distances: Distances | None, distance_std: float | None
) -> tuple[Tensor, Sockets]:
    """Numbers (N,) of the sockets of rows, and these in order of first appearance.

    Arguments and errors are those of :meth:`Measurements.from_sockets`.
    """
    texts = row_names(names, rows, "`sockets`")
    known = tuple(dict.fromkeys(texts))
    numbers = {name: number for number, name in enumerate(known)}
    own = torch.tensor([numbers[text] for text in texts], dtype=torch.int64, device=HOST)
    return own, Sockets(known, *_checked_distances(known, distances, distance_std))


def with_sockets_of_rows(data: T) -> T:
    """The same rows without the sockets that hold the ball in none of them, and without distances to these."""
    table: Any = data
    rest = table.socket != NO_SOCKET
    used, inverse = table.socket[rest].unique(return_inverse=True)
    numbers = torch.full_like(table.socket, NO_SOCKET).masked_scatter(rest, inverse)
    new = {old: number for number, old in enumerate(used.tolist())}
    names = tuple(table.sockets.names[old] for old in new)
    distances = tuple((new[a], new[b], d) for a, b, d in table.sockets.distances if a in new and b in new)
    return with_attributes(data, socket=numbers, sockets=Sockets(names, distances, table.sockets.distance_std))


def sockets_of(data: Any) -> tuple[Tensor, Sockets]:
    """(N,) numbers of the sockets of rows, -1 for none, and the sockets; MeasurementError for rows without any."""
    if data.socket is None or data.sockets is None:
        raise MeasurementError.of("the rows have no sockets", fix="pass Measurements.from_sockets(...)")
    return data.socket.to(HOST), data.sockets


def other_socket(data: Any, row: int, predicted: Tensor, near: float) -> str | None:
    """Why a row in a socket is far from it, in words; None for rows in no socket.

    Args:
        data: N rows, sockets at their places. predicted: (N, P, 3) m. near: distance of another socket that fits, m.
    """
    if int(data.socket_numbers[row]) == NO_SOCKET:
        return None
    away = (predicted[row, -1] - data.points[:, -1]).norm(dim=-1).nan_to_num(torch.inf)
    nearest = int(away.argmin())
    if float(away[nearest]) > near:
        return "far from where the other rows of its socket predict it"
    return f"fits socket '{data.sockets.names[int(data.socket[nearest])]}': named after a wrong one?"


def row_sockets(data: Any) -> list[str]:
    """Name of the socket of each row, empty where a device measured."""
    return ["" if number == NO_SOCKET else data.sockets.names[number] for number in data.socket.tolist()]


def socket_texts(data: Any) -> dict[str, bytes]:
    """What identifies the sockets of rows, for a checksum of the table; nothing without sockets."""
    if data.socket is None or data.sockets is None:
        return {}
    rows = row_sockets(data)
    known = data.sockets.distances, data.sockets.distance_std
    return {"sockets": repr((rows, known)).encode()}


def require_positions(data: Any, what: str, fix: str = "") -> None:
    """Raise MeasurementError for rows without measured positions.

    Args:
        data: the measurements. what: what needs positions, for the message. fix: what to do instead.
    """
    if data.sockets is not None:
        got = "rows with a ball in sockets, whose places are not measured"
        fix = fix if data.without_device else "pass the rows with measured positions alone: data.device_rows()"
        raise MeasurementError.of(what, expected="measured positions", got=got, fix=fix)


def _place(name: str) -> str:
    return name.rpartition(SEPARATOR)[0] or name


def _checked_distances(
    names: tuple[str, ...], distances: Distances | None, std: float | None
) -> tuple[tuple[tuple[int, int, float], ...], float | None]:
    """Numbers of two sockets with their distance [m], and the standard deviation [m]."""
    if distances is not None and not isinstance(distances, Mapping):
        fix = 'pass {("0", "1"): 0.05} for sockets that are 50 mm apart'
        raise MeasurementError.of("`distances`", expected="a dictionary", got=as_written(distances), fix=fix)
    if not distances:
        if std is not None:
            raise MeasurementError.of("`distance_std` without `distances`", fix="pass the distances, or leave it out")
        return (), None
    deviation = number_of(std)
    if deviation is None or not 0.0 < deviation < inf:
        fix = "pass how well the distances are known, such as 3e-5 for a printed block that was measured with a caliper"
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
    return tuple((*both, length) for both, length in found.items()), deviation


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
