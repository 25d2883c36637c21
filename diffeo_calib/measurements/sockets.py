"""Readings without a measuring device: a ball on the tool rests in a socket, whose place is not known.

All rows of a socket have their ball at the same unknown point. Sockets in one rigid block stand at one place; distances
between some of them may be known, such as 50 mm in a printed block.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import number_of
from diffeo_calib.common.device import methods_outside_inference_mode
from diffeo_calib.common.errors import MeasurementError, as_written, few, listed, sentence, warn_user
from diffeo_calib.measurements.checks import numbered, numbers_of
from diffeo_calib.measurements.readings import CONTACT, Readings, read_of_tool

if TYPE_CHECKING:
    from typing_extensions import Self

SEPARATOR = "/"
"""Between the name of a place and that of a socket: "front/0"."""
Distances = Mapping[tuple[str, str], float]
KIND = "socket"
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
        lengths: dict[tuple[int, int], float] = {}
        for pair, length in distances.items():
            metres = number_of(length)
            if metres is None or not 0.0 < metres < inf:
                raise MeasurementError.of(f"the distance of {pair}", expected="metres above 0", got=as_written(length))
            for both in _pairs(names, pair):
                if lengths.setdefault(both, metres) != metres:
                    where = " and ".join(names[number] for number in both)
                    got = f"{lengths[both]:g} and {length:g} m"
                    raise MeasurementError.of(f"the distance of {where}", expected="one value", got=got)
        return cls(names, tuple((*both, length) for both, length in lengths.items()), deviation)

    @property
    def blocks(self) -> list[tuple[tuple[int, int, float], ...]]:
        """Known distances by block: those of the same sockets at several places, which have one error in common."""
        blocks: dict[tuple[str, str, float], list[tuple[int, int, float]]] = {}
        for first, second, length in self.distances:
            pair = sorted(self.names[number] for number in (first, second))
            if _place(pair[0]) == _place(pair[1]):
                pair = [name.rpartition(SEPARATOR)[2] for name in pair]
            blocks.setdefault((pair[0], pair[1], length), []).append((first, second, length))
        return [tuple(block) for block in blocks.values()]

    @property
    def place_names(self) -> tuple[str, ...]:
        """Names of the places, in the order of their first socket."""
        return tuple(dict.fromkeys(_place(name) for name in self.names))

    @property
    def place(self) -> Tensor:
        """(S,) int64, the place of each socket."""
        return numbers_of([_place(name) for name in self.names], self.place_names)


@methods_outside_inference_mode
@dataclass(frozen=True, eq=False, repr=False)
class SocketReadings(Readings):
    """N joint configurations in which the ball rested in sockets: a row reads that it is there, three zeros.

    Made by :meth:`Measurements.from_sockets`.

    Args:
        distances: known distances [m] of two sockets by their names, also of sockets that no row shows.
        distance_std: see :class:`Sockets`. Other arguments are those of :class:`Readings`; devices are sockets.
    """

    ALIKE = (*Readings.ALIKE, "distances", "distance_std")
    flattery, fewest = FLATTERY, 2

    distances: tuple[tuple[str, str, float], ...] = ()
    distance_std: float | None = None

    @property
    def sockets(self) -> Sockets:
        """The sockets of these rows, and known distances between them."""
        number = {name: number for number, name in enumerate(self.names)}
        lengths = ((number[a], number[b], away) for a, b, away in self.distances if {a, b} <= number.keys())
        return Sockets(self.names, tuple(lengths), self.distance_std)

    @property
    def blocks(self) -> list[tuple[tuple[int, int, float], ...]]:
        """See :class:`Sockets`."""
        return self.sockets.blocks

    @property
    def socket_numbers(self) -> Tensor:
        """(N,) int64, number of each row's socket."""
        return self.device

    @property
    def places(self) -> Tensor:
        """(N,) int64, number of the place of each row's socket."""
        return self.sockets.place[self.device]

    @property
    def points(self) -> Tensor:
        """(N, 1, 3) NaN: no position was measured."""
        return torch.full_like(self.values, torch.nan)[:, None]

    @property
    def stated(self) -> object:
        """See :class:`Readings`."""
        return super().stated, self.distances, self.distance_std

    def __repr__(self) -> str:
        return f"SocketReadings({len(self)} rows in {len(self.names)} socket{'s' * (len(self.names) != 1)})"

    def measured(self) -> dict[str, Any]:
        """The names of the sockets."""
        return {"socket": self.device_names}

    @property
    def compared(self) -> Tensor:
        """See :class:`RowGroups`: in one configuration the ball rests in one socket."""
        return self.q

    def with_sessions(self, names: object, **_: object) -> Self:
        """The same rows; MeasurementError for several sessions: sockets of another set-up are other sockets."""
        sessions = () if names is None else numbered(names, len(self))[1]
        if len(sessions) > 1:
            fix = "give the sockets of each session names of their own, and leave the sessions out"
            raise MeasurementError.of("rows with sockets", expected="no sessions", got=few(sessions), fix=fix)
        return self

    def explained(self) -> tuple[Tensor, Tensor, str | None]:
        """See :meth:`Measurements.explained`: every socket is at one place."""
        return *self.index, torch.nn.functional.one_hot(self.device).to(self.values), self.on

    def beside_images(self) -> list[tuple[Any, Tensor]]:
        """See :class:`RowGroups`: contacts of a point of the tool; distances of sockets are not used."""
        if self.distances:
            fix = "calibrate without the images to use them"
            warn_user(sentence("known distances between sockets are not used beside images of a board", fix=fix))
        return [(read_of_tool(self, CONTACT, self.values, self.device_names), *self.index)]


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
        here = [[numbers.get(f"{place}{SEPARATOR}{socket}") for socket in given] for place in places]
        both = [(min(a, b), max(a, b)) for a, b in here if a is not None and b is not None]
        if both:
            return both
    fix = f"pass two names of sockets; there are {listed(names) if names else few([])}"
    raise MeasurementError.of("a known distance", expected="names of two sockets", got=as_written(pair), fix=fix)
