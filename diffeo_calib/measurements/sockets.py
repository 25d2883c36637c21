"""Rows without a measuring device: a ball on the tool rests in a socket, whose place is not known.

All rows of a socket have their ball at the same unknown point. Sockets in one rigid block stand at one place; distances
between some of them may be known, such as 50 mm in a printed block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any, TypeVar

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, as_written, few, listed
from diffeo_calib.measurements.frozen import with_attributes

T = TypeVar("T")
SEPARATOR = "/"
"""Between the name of a place and that of a socket: "front/0"."""
Distances = Mapping[tuple[str, str], float]


@dataclass(frozen=True)
class Sockets:
    """The sockets that hold the ball in some rows of a table.

    Args:
        names: S names, such as "front/0": that of the place, a slash, that of the socket at this place. A name without
            a slash is a place with one socket.
        distances: known distances, as numbers of two sockets and their distance [m].
        distance_std: their standard deviation [m]; None without distances.
    """

    names: tuple[str, ...]
    distances: tuple[tuple[int, int, float], ...] = ()
    distance_std: float | None = None

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
    given = [] if isinstance(names, str) else list(names)
    if len(given) != rows:
        got = as_written(names) if isinstance(names, str) else len(given)
        raise MeasurementError.of("`sockets`", expected=f"{rows} names, one per row", got=got)
    texts = [str(name).strip() for name in given]
    unnamed = [row for row, text in enumerate(texts) if not text]
    if unnamed:
        what = f"`sockets`: {len(unnamed)} row(s) have no name, the first is row {unnamed[0]}"
        raise MeasurementError.of(what, fix="name the socket of every row")
    known = tuple(dict.fromkeys(texts))
    numbers = {name: number for number, name in enumerate(known)}
    own = torch.tensor([numbers[text] for text in texts], dtype=torch.int64, device=HOST)
    return own, Sockets(known, *_checked_distances(known, distances, distance_std))


def with_sockets_of_rows(data: T) -> T:
    """The same rows without the sockets that hold the ball in none of them, and without distances to these."""
    table: Any = data
    used, numbers = table.socket.unique(return_inverse=True)
    new = {old: number for number, old in enumerate(used.tolist())}
    names = tuple(table.sockets.names[old] for old in new)
    distances = tuple((new[a], new[b], d) for a, b, d in table.sockets.distances if a in new and b in new)
    return with_attributes(data, socket=numbers, sockets=Sockets(names, distances, table.sockets.distance_std))


def socket_texts(data: Any) -> dict[str, bytes]:
    """What identifies the sockets of rows, for a checksum of the table; nothing for measured positions."""
    if data.socket is None or data.sockets is None:
        return {}
    rows = [data.sockets.names[number] for number in data.socket.tolist()]
    known = data.sockets.distances, data.sockets.distance_std
    return {"sockets": repr((rows, known)).encode()}


def require_positions(data: Any, what: str, fix: str = "") -> None:
    """Raise MeasurementError for rows without measured positions.

    Args:
        data: the measurements. what: what needs positions, for the message. fix: what to do instead.
    """
    if data.sockets is not None:
        got = "rows with a ball in sockets, whose places are not measured"
        raise MeasurementError.of(what, expected="measured positions", got=got, fix=fix)


def _place(name: str) -> str:
    return name.rpartition(SEPARATOR)[0] or name


def _checked_distances(
    names: tuple[str, ...], distances: Distances | None, std: float | None
) -> tuple[tuple[tuple[int, int, float], ...], float | None]:
    """Numbers of two sockets with their distance [m], and the standard deviation [m]."""
    if not distances:
        if std is not None:
            raise MeasurementError.of("`distance_std` without `distances`", fix="pass the distances, or leave it out")
        return (), None
    if not isinstance(std, (int, float)) or not 0.0 < std < inf:
        fix = "pass how well the distances are known, such as 3e-5 for a printed block that was measured with a caliper"
        raise MeasurementError.of("`distance_std`", expected="a positive number in m", got=as_written(std), fix=fix)
    found: dict[tuple[int, int], float] = {}
    for pair, length in distances.items():
        if not isinstance(length, (int, float)) or not 0.0 < length < inf or not isfinite(length):
            raise MeasurementError.of(f"the distance of {pair}", expected="metres above 0", got=as_written(length))
        for both in _pairs(names, pair):
            if found.setdefault(both, float(length)) != float(length):
                where = " and ".join(names[number] for number in both)
                got = f"{found[both]:g} and {length:g} m"
                raise MeasurementError.of(f"the distance of {where}", expected="one value", got=got)
    return tuple((*both, length) for both, length in found.items()), float(std)


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
