"""Rows of devices that measure no position of the tool's ball: distances, heights above planes, points in images.

Without a device the ball rests in a socket: all rows of a socket have it at the same unknown point. Sockets in one
rigid block stand at one place; distances between some of them may be known, such as 50 mm in a printed block.

A ball bar, wire or interferometer reports the distance from the ball to its fixed end. A dial gauge reports a height
along its axis; a surface that the ball touches is a plane at the height 0. A calibrated camera reports where it sees
the ball, or any other mark on the tool, in its image. Where the devices stand is not known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import number_of
from diffeo_calib.common.device import HOST, methods_outside_inference_mode
from diffeo_calib.common.errors import MeasurementError, as_written, few, listed, sentence, warn_user
from diffeo_calib.measurements import checks
from diffeo_calib.measurements.observations import joined_tables
from diffeo_calib.measurements.rows import FEWEST_PER_DEVICE, RowGroups, set_attributes, with_attributes

if TYPE_CHECKING:
    from typing_extensions import Self

MILLIMETRES = "mm", 1e3  # unit in which lengths are shown, and how many of it are a metre
FLATTERY = (
    "errors of readings are smaller than the true error: what no reading shows, such as the robot's size with devices "
    "that hold no length, is not in them; choose nothing by them"
)
ONE_DEVICE = "device"  # name of the device of all rows, where none is given


@methods_outside_inference_mode
@dataclass(frozen=True, eq=False, repr=False)
class Readings(RowGroups):
    """N joint configurations and what a device reported in each of one ball, or another mark, on the tool.

    Made by :meth:`distances`, :meth:`heights` and :meth:`images`, and by :meth:`of` for devices of your own.

    Args:
        kind: of all rows: "distance", "height", "image", or that of devices of your own, see sensors/kinds.py.
        q: (N, n) joint values, rad or m. values: (N, r) readings, m or rad; of images r = 2, tangents of angles.
        device: (N,) int64, number of the device of each row. names: of the devices.
        offset_std: standard deviation of the unknown zero of a distance, m; 0 if lengths are absolute.
        intrinsics: focal lengths fx, fy and principal point cx, cy of images, in pixels.
        std: (N, r) known standard deviations in the unit of ``values``; None where they are not known.
        joint_names, line_numbers, file_sha256, origin, payload, payload_at: as of :class:`Measurements`.
        on: name of the tip that carries the ball, for a robot with several tips.
        unit: name of the unit in which readings are shown, and how many of it are one of ``values``.
    """

    BY_ROW = ("q", "values", "std", "device", "payload", "line_numbers", "covariates")
    ALIKE = ("kind", "n", "joint_names", "offset_std", "intrinsics", "payload_at", "covariate_names", "on", "unit")
    NUMBERED, COMPARED = ("device", "names"), ("q", "values", "device")
    flattery = FLATTERY
    fewest = FEWEST_PER_DEVICE  # rows of a device from which its place is found
    blocks = ()  # known distances between devices, see :attr:`SocketReadings.blocks`

    kind: str
    q: Tensor
    values: Tensor
    device: Tensor
    names: tuple[str, ...]
    offset_std: float = 0.0
    intrinsics: tuple[float, float, float, float] = (1.0, 1.0, 0.0, 0.0)
    joint_names: tuple[str, ...] | None = None
    line_numbers: Tensor = None  # pyright: ignore[reportAssignmentType]  # filled below
    file_sha256: str | None = None
    origin: object | None = None
    std: Tensor | None = None
    payload: Tensor | None = None
    payload_at: str | None = None
    on: str | None = None
    unit: tuple[str, float] = MILLIMETRES

    def __post_init__(self) -> None:
        if self.line_numbers is None:
            set_attributes(self, line_numbers=torch.arange(len(self.q), device=HOST))

    @classmethod
    def distances(
        cls,
        q: object,
        lengths: object,
        devices: Sequence[str] | None = None,
        joint_names: Sequence[str] | None = None,
        *,
        offset_std: float = 0.0,
        std: object = None,
        doubt: bool = True,
    ) -> Readings:
        """Distances from the ball to fixed points that are not known.

        Args:
            q, devices, joint_names, doubt: as in :meth:`of`. lengths: (N,) m, or one for all rows of a ball bar.
            offset_std: standard deviation in m of a length that all readings of a device lack, as those of an
                interferometer or a wire with an unknown zero; 0 if they are absolute.
            std: known standard deviations of the lengths, m: one for all, or (N,).

        Raises:
            MeasurementError: as :meth:`of`, or a length that is not positive.
        """
        if isinstance(offset_std, bool) or not isinstance(offset_std, (int, float)) or not 0.0 <= offset_std < inf:
            fix = "pass metres, or 0 for absolute lengths"
            raise MeasurementError.of("`offset_std`", expected="0 or more", got=as_written(offset_std), fix=fix)
        table = cls.of("distance", q, lengths, devices, joint_names, std=std, doubt=doubt, name="lengths")
        low = int(table.values.argmin())
        if not offset_std and float(table.values[low]) <= 0.0:
            got, fix = f"{float(table.values[low]):g} m in row {low}", "check the column, or pass `offset_std`"
            raise MeasurementError.of("`lengths`", expected="above 0", got=got, fix=fix)
        return replace(table, offset_std=float(offset_std))

    @classmethod
    def heights(
        cls,
        q: object,
        heights: object = 0.0,
        devices: Sequence[str] | None = None,
        joint_names: Sequence[str] | None = None,
        *,
        std: object = None,
        doubt: bool = True,
    ) -> Readings:
        """Heights of the ball above planes that are not known.

        Args:
            q, devices, joint_names, std [m], doubt, errors: as in :meth:`of`. heights: (N,) m, such as those of a dial
                gauge; 0 where the ball touched, and the height of a gauge block where it touched this on the plane.
        """
        return cls.of("height", q, heights, devices, joint_names, std=std, doubt=doubt, name="heights")

    @classmethod
    def images(
        cls,
        q: object,
        pixels: object,
        devices: Sequence[str] | None = None,
        joint_names: Sequence[str] | None = None,
        *,
        focal: tuple[float, float],
        centre: tuple[float, float],
        std: object = None,
        doubt: bool = True,
    ) -> Readings:
        """Places of the ball in the images of fixed cameras, whose poses are not known.

        Args:
            q, devices, joint_names, doubt: as in :meth:`of`.
            pixels: (N, 2) column and row in the image, lens distortion removed.
            focal: focal lengths fx, fy in pixels. centre: principal point cx, cy in pixels. For tangents of angles
                in place of pixels pass (1, 1) and (0, 0).
            std: known standard deviations, pixels: one for all, (N,) or (N, 2).

        Raises:
            MeasurementError: as :meth:`of`, or focal lengths that are not positive.
        """
        f = checks.copied(focal, "focal", (2,), fix="pass (fx, fy) in pixels")
        c = checks.copied(centre, "centre", (2,), fix="pass (cx, cy) in pixels")
        if not bool((f > 0).all()):
            raise MeasurementError.of("`focal`", expected="two positive numbers", got=as_written(f.tolist()))
        table = cls.of("image", q, pixels, devices, joint_names, std=std, doubt=doubt, name="pixels", numbers=2)
        spread = None if table.std is None else table.std / f.to(table.std)
        tangents, lens = (table.values - c.to(table.values)) / f.to(table.values), (*f.tolist(), *c.tolist())
        return replace(table, values=tangents, std=spread, intrinsics=lens, unit=("px", float(f.mean())))

    @classmethod
    def of(
        cls,
        kind: str,
        q: object,
        values: object,
        devices: Sequence[str] | None = None,
        joint_names: Sequence[str] | None = None,
        *,
        unit: tuple[str, float] = MILLIMETRES,
        std: object = None,
        doubt: bool = True,
        name: str = "values",
        numbers: int = 1,
    ) -> Readings:
        """Readings of devices of any kind, which sensors/kinds.py knows or which is registered there.

        Args:
            kind: of the devices, such as "line distance"; "held tool" where two hands hold a rigid tool, six zeros a
                row, see sensors/tool_frames.py.
            q: (N, n) joint values, rad or m. values: (N,) or (N, r) readings, m or rad, or one for all rows.
            devices: (N,) name of each row's device; one for all rows by default.
            joint_names: n names, in the order of the columns of ``q``.
            unit: in which readings are shown, and how many of it are one of ``values``, such as ("mrad", 1e3).
            std: known standard deviations in the unit of ``values``: one for all, (N,) or (N, r).
            doubt: whether to warn about rows and values that look wrong, as :class:`Measurements` does.
            name: of ``values`` in messages. numbers: r.

        Raises:
            MeasurementError: wrong shapes, values that are not finite, or a deviation that is not positive.
        """
        if kind == "socket":
            raise MeasurementError.of("rows in sockets", expected="names alone", fix="pass Measurements.from_sockets")
        angles, joints = checks.joint_table(q, joint_names)
        N = len(angles)
        given = [float(values)] * N if isinstance(values, (int, float)) and not isinstance(values, bool) else values
        shapes = [(N,), (N, 1)] if numbers == 1 else [(N, numbers)]
        fix = f"pass {numbers} per row" + ", in m" * (unit == MILLIMETRES and numbers == 1)
        read = checks.copied(given, name, *shapes, fix=fix).reshape(N, numbers).to(angles.device)
        whose, names = checks.numbered([ONE_DEVICE] * N if devices is None else devices, N)
        spread = checks.deviations(std, "std", read)
        table = cls(kind, angles, read, whose.to(HOST), names, joint_names=joints, std=spread, unit=unit)
        return table.doubted(doubt)

    joined = staticmethod(joined_tables)

    @property
    def reported(self) -> Tensor:
        """(N, r) what the devices reported: m or rad, or pixels (column, row) of images."""
        if self.kind != "image":
            return self.values
        return self.values * self.values.new_tensor(self.intrinsics[:2]) + self.values.new_tensor(self.intrinsics[2:])

    @property
    def reported_std(self) -> Tensor | None:
        """(N, r) known standard deviations of these, m or pixels."""
        return None if self.std is None else self.std * self.std.new_tensor(self.intrinsics[: self.std.shape[1]])

    @property
    def shown(self) -> tuple[str, tuple[float, ...], tuple[float, ...]]:
        """Unit in which readings are shown, and what their r numbers are multiplied by and shifted by to be in it."""
        if self.kind == "image":
            return self.unit[0], self.intrinsics[:2], self.intrinsics[2:]
        return self.unit[0], (self.unit[1],) * (r := self.values.shape[1]), (0.0,) * r

    @property
    def stated(self) -> object:
        """What is said of the devices."""
        return self.names, self.offset_std

    @property
    def column_kind(self) -> object:
        """Key that is equal for tables that can be joined into one."""
        return self.kind, self.offset_std, self.intrinsics, self.unit, self.std is None

    @property
    def ball_tip(self) -> str | None:
        """Name of the tip that carries the ball; None for the only one."""
        return self.on

    @property
    def value_names(self) -> tuple[str, ...]:
        """Names of the columns of the readings: distance, displacement (of an unknown zero), height; u, v of images."""
        if self.kind == "image":
            return ("u", "v")
        name, count = "displacement" if self.offset_std else self.kind, self.values.shape[1]
        return (name,) if count == 1 else tuple(f"{name} {number + 1}" for number in range(count))

    def measured(self) -> dict[str, Any]:
        """The readings, known standard deviations as std_distance, ..., and the names of the devices as session."""
        columns: dict[str, Any] = dict(zip(self.value_names, self.reported.T, strict=True))
        if self.reported_std is not None:
            columns |= dict(zip([f"std_{name}" for name in columns], self.reported_std.T, strict=True))
        return columns | {"session": self.device_names}

    def rows(self, index: object) -> Readings:
        """See :class:`RowGroups`; the devices are those of these rows."""
        chosen = super().rows(index)
        used, numbers = chosen.device.unique(return_inverse=True)
        return with_attributes(chosen, device=numbers, names=tuple(self.names[number] for number in used.tolist()))

    def with_tips(self, on: Sequence[str] | None) -> Readings:
        """Return the same readings with their ball on this tip, one name, else MeasurementError."""
        names = checks.tip_names(on, 1)
        return with_attributes(self, on=None if names is None else names[0])


MARKER, CONTACT = "marker", "contact"  # kinds of readings of points of a tool whose poses are measured


def read_of_tool(table: Any, kind: str, values: Tensor, names: Sequence[str], std: Tensor | None = None) -> Readings:
    """Rows of a table as readings (N, 3) of points of a tool whose poses are measured, see sensors/tool_frames.py."""
    read = Readings.of(kind, table.q, values, names, table.joint_names, std=std, doubt=False, numbers=3)
    alike = ("payload", "payload_at", "covariates", "covariate_names", "line_numbers", "file_sha256", "origin")
    return with_attributes(read, **{name: getattr(table, name) for name in alike})


def as_readings(table: Any) -> list[tuple[Readings, Tensor]]:
    """Positions of markers as readings with their rows (M,): every marker of every set-up has a device of its own."""
    parts = []
    for marker, name in enumerate(table.marker_names or range(1, table.markers + 1)):
        rows = table.visible[:, marker].nonzero()[:, 0].cpu()
        part = table.rows(rows)
        of_marker = f" {name}" if table.markers > 1 else ""
        names = [f"{device or 'tracker'}{of_marker}" for device in part.device_names]
        std = None if part.std is None else part.std[:, marker]
        parts.append((read_of_tool(part, MARKER, part.points[:, marker], names, std), rows))
    return parts


# --- a ball in sockets

SEPARATOR = "/"
"""Between the name of a place and that of a socket: "front/0". A name without it is a place with one socket."""
Distances = Mapping[tuple[str, str], float]
NamedDistances = tuple[tuple[str, str, float], ...]
KIND = "socket"
FLATTERY_OF_SOCKETS = (
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
    COMPARED = ("q",)  # in one configuration the ball rests in one socket
    flattery, fewest = FLATTERY_OF_SOCKETS, 2

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
        return checks.numbers_of([*map(_place, self.names)], self.place_names)

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
        return super().stated, self.distances, self.distance_std

    def measured(self) -> dict[str, Any]:
        """The names of the sockets."""
        return {"socket": self.device_names}

    def with_sessions(self, names: object, **_: object) -> Self:
        """Return the rows; MeasurementError for several sessions: sockets of another set-up are other sockets."""
        sessions = () if names is None else checks.numbered(names, len(self))[1]
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
    each = [(f"the distance of {pair}", length) for pair, length in distances.items()]
    for what, value in [("`distance_std`", std), *each]:
        if (metres := number_of(value)) is None or not 0.0 < metres < inf:
            fix = "in m; 3e-5 for a printed block, measured with a caliper"
            raise MeasurementError.of(what, expected="a positive number in m", got=as_written(value), fix=fix)
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
        if both := [(two[0], two[1]) for two in each if len(two) == 2]:
            return both[:1] if len(each[0]) == 2 else both
    fix = f"pass two names of sockets; there are {listed(names) if names else few([])}"
    raise MeasurementError.of("a known distance", expected="names of two sockets", got=as_written(pair), fix=fix)
