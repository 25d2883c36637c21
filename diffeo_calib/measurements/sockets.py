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
"""Between the name of a place and that of a socket: "front/0". A name without it is a place with one socket."""
Distances = Mapping[tuple[str, str], float]
NamedDistances = tuple[tuple[str, str, float], ...]
KIND = "socket"
FLATTERY = (
    "the spread within sockets is smaller than the true error: it contains neither errors that all rows of a socket "
    "share nor the robot's size, so that absolute errors are 2 to 6 times as large; do not compare models by it"
)


@methods_outside_inference_mode
@dataclass(frozen=True, eq=False, repr=False)
class SocketReadings(Readings):
    """N joint configurations in which the ball rested in sockets: a row reads that it is there, three zeros.

    Made by :meth:`Measurements.from_sockets`.

    Args:
        distances: known distances [m] of two sockets by their names, also of sockets that no row shows.
        distance_std: their standard deviation [m]; None without distances. The distance of two sockets of a block has
            one error at all places. Other arguments are those of :class:`Readings`; devices are sockets.
    """

    ALIKE = (*Readings.ALIKE, "distances", "distance_std")
    flattery = FLATTERY

    distances: NamedDistances = ()
    distance_std: float | None = None

    @property
    def lengths(self) -> list[tuple[int, int, float]]:
        """Known distances [m] between sockets of these rows, by their numbers."""
        number = {name: number for number, name in enumerate(self.names)}
        return [(number[a], number[b], length) for a, b, length in self.distances if {a, b} <= number.keys()]

    @property
    def blocks(self) -> list[list[tuple[int, int, float]]]:
        """Known distances by block: those of the same sockets at several places, which have one error in common."""
        blocks: dict[tuple[object, ...], list[tuple[int, int, float]]] = {}
        for first, second, length in self.lengths:
            pair = sorted(self.names[number] for number in (first, second))
            if _place(pair[0]) == _place(pair[1]):
                pair = [name.rpartition(SEPARATOR)[2] for name in pair]
            blocks.setdefault((*pair, length), []).append((first, second, length))
        return list(blocks.values())

    @property
    def place_names(self) -> tuple[str, ...]:
        """Names of the places, in the order of their first socket."""
        return tuple(dict.fromkeys(map(_place, self.names)))

    @property
    def place(self) -> Tensor:
        """(S,) int64, the place of each socket."""
        return numbers_of([*map(_place, self.names)], self.place_names)

    @property
    def socket_numbers(self) -> Tensor:
        """(N,) int64, number of each row's socket."""
        return self.device

    @property
    def places(self) -> Tensor:
        """(N,) int64, number of the place of each row's socket."""
        return self.place[self.device]

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


def checked_distances(names: tuple[str, ...], distances: Distances | None, std: object) -> NamedDistances:
    """Known distances [m] between sockets of these names, see :meth:`Measurements.from_sockets`."""
    if distances is not None and not isinstance(distances, Mapping):
        fix = 'pass {("0", "1"): 0.05} for sockets that are 50 mm apart'
        raise MeasurementError.of("`distances`", expected="a dictionary", got=as_written(distances), fix=fix)
    if not distances:
        if std is not None:
            raise MeasurementError.of("`distance_std` without `distances`", fix="pass the distances, or leave it out")
        return ()
    lengths: dict[tuple[str, str], float] = {}
    for what, value in {
        "`distance_std`": std,
        **{f"the distance of {pair}": d for pair, d in distances.items()},
    }.items():
        if (metres := number_of(value)) is None or not 0.0 < metres < inf:
            fix = "pass metres: known to 3e-5 in a printed block, measured with a caliper"
            raise MeasurementError.of(what, expected="metres above 0", got=as_written(value), fix=fix)
    for pair, length in distances.items():
        for both in _pairs(names, pair):
            if lengths.setdefault(both, float(length)) != length:
                got, what = f"{lengths[both]:g} and {length:g} m", f"the distance of {' and '.join(both)}"
                raise MeasurementError.of(what, expected="one value", got=got)
    return tuple((*both, length) for both, length in lengths.items())


def _place(name: str) -> str:
    return name.rpartition(SEPARATOR)[0] or name


def _pairs(names: tuple[str, ...], pair: object) -> list[tuple[str, str]]:
    """The two sockets that a pair of names means, in the order of ``names``; one pair per place for names at each."""
    given = tuple(str(name).strip() for name in pair) if isinstance(pair, (tuple, list)) else ()
    if len(given) == 2 and given[0] != given[1]:
        places = ["", *(f"{place}{SEPARATOR}" for place in dict.fromkeys(map(_place, names)))]
        each = [[name for name in names if name in (place + given[0], place + given[1])] for place in places]
        if both := [(pair[0], pair[1]) for pair in each if len(pair) == 2]:
            return both[:1] if len(each[0]) == 2 else both
    fix = f"pass two names of sockets; there are {listed(names) if names else few([])}"
    raise MeasurementError.of("a known distance", expected="names of two sockets", got=as_written(pair), fix=fix)
