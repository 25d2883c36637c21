"""Every kind of device, by the kind of its readings: the only place that knows them all.

A kind of your own is a subclass of :class:`Devices`, given to :func:`register`: see scripts/examples/laser_line.py and
inclinometer.py. The command line knows it if a package that is installed names its module as an entry point of
``diffeo_calib.sensors``; tables then have ``--reading KIND=COLUMN,...``, and ``init`` finds these by their names.

The two ways in which rows tell of a robot: coordinates of points on the tool, and readings of the ball.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import entry_points
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, few, listed, sentence, warn_user
from diffeo_calib.measurements.observations import Observations
from diffeo_calib.measurements.poses import POINTS, kind_of_points, points_of_frames
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.board_camera import BoardCameras
from diffeo_calib.sensors.devices import Devices, Extrinsics, Shown
from diffeo_calib.sensors.height import Planes
from diffeo_calib.sensors.image import Cameras
from diffeo_calib.sensors.known_drift import KnownDrift
from diffeo_calib.sensors.range import FixedPoints
from diffeo_calib.sensors.set_ups import MeasuringFrames, MountedFrames, MountedMarkers
from diffeo_calib.sensors.tool_frames import Contacts, HeldTools, SocketPlaces, Trackers

KINDS: dict[str, type[Devices]] = {
    kind.kind: kind for kind in (FixedPoints, Planes, Cameras, HeldTools, Trackers, Contacts, SocketPlaces)
}
WITHOUT_READINGS: dict[str, type[Extrinsics]] = {
    kind.kind: kind for kind in (MeasuringFrames, MountedMarkers, MountedFrames, BoardCameras, KnownDrift)
}


def register(kind: type[Devices]) -> type[Devices]:
    """Make a kind of device known, a concrete subclass of :class:`Devices`; can decorate its class.

    Raises:
        InputError: no such subclass, or the name of another kind.
    """
    whole = isinstance(kind, type) and issubclass(kind, Devices) and not kind.__abstractmethods__
    usual = whole and getattr(kind.prior, "__func__", None) is Devices.prior.__func__
    if not whole or (usual and not hasattr(kind, "increments_each")):
        expected = "a subclass of Devices with all of its methods"
        raise InputError.of("a kind of device", expected=expected, got=repr(kind))
    if KINDS.get(kind.kind, kind).__qualname__ != kind.__qualname__:
        fix = "choose another `kind`"
        raise InputError.of(f"the kind {kind.kind!r}", got="the name of a kind that is known", fix=fix)
    KINDS[kind.kind] = kind
    return kind


@cache
def known_kinds() -> dict[str, type[Devices]]:
    """All kinds by their names, those of installed packages too."""
    for entry in entry_points(group="diffeo_calib.sensors"):
        entry.load()
    return KINDS


def kind_of(data: Readings) -> type[Devices]:
    """The kind of the devices of some readings; MeasurementError for one that nobody registered."""
    if data.kind not in known_kinds():
        fix = "register its class with `diffeo_calib.sensors.kinds.register`"
        raise MeasurementError.of("the kind of readings", expected=listed(list(KINDS)), got=repr(data.kind), fix=fix)
    return KINDS[data.kind]


@dataclass(frozen=True, eq=False)
class Unregistered(Extrinsics):
    """Devices of a kind that nobody registered in this session."""

    read_kind: str = ""

    @property
    def kind(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The kind that the file says."""
        return self.read_kind

    def carried(self, T: Tensor, before: Tensor, after: Tensor, markers: Tensor) -> Tensor:
        fix = "import the module that registers it, and load the model again"
        raise InputError.of(f"devices of the kind {self.kind!r} in a model", got="a kind not registered", fix=fix)


ENTRIES = ("kind", "names", "constants", "deviations", "rows", "device")


def stored_devices(entry: Any, rows: int) -> Extrinsics:
    """Devices of any kind, of one that nobody registered too: the inverse of :meth:`Extrinsics.stored`.

    Args:
        entry: of a file. rows: how many the fit of its model has.

    Raises:
        InputError: entries that do not fit together.

    Warns:
        DiffeoCalibWarning: devices of a kind that nobody registered.
    """
    if not isinstance(entry, dict) or set(entry) - {"shown"} != set(ENTRIES):
        raise InputError.of("the entry placement", expected=sorted(ENTRIES), got=sorted(entry))
    if not isinstance(entry["kind"], str):
        raise InputError.of("the kind of the devices of a model", expected="a text", got=entry["kind"])
    names = tuple(map(str, entry["names"]))
    deviations = torch.tensor(entry["deviations"], dtype=torch.float64, device=HOST).view(len(names), -1)
    constants = as_tensor(entry["constants"], "placement", (len(names), "c"))
    numbers, device = (torch.tensor(entry[name], dtype=torch.int64, device=HOST) for name in ("rows", "device"))
    inside = bool(((numbers >= 0) & (numbers < rows)).all() & ((device >= 0) & (device < len(names))).all())
    if len(numbers) != len(device) or not inside:
        raise InputError.of("the rows of the devices of a model", expected=f"numbers below {rows}")
    sensor: Any = {**known_kinds(), **WITHOUT_READINGS}.get(entry["kind"])
    differs = sensor is not None and sensor.reads and deviations.shape[1] != sensor.increments_each
    if sensor is None or differs:
        sensor = partial(Unregistered, read_kind=entry["kind"])
        what = f"the model has {len(names)} devices of the kind {entry['kind']!r}, which is not registered here"
        what += f" with {deviations.shape[1]} increments" * differs
        fix = "import the module that registers it (`diffeo_calib.sensors.kinds.register`) and load the model again, "
        warn_user(sentence(f"{what}: their readings are not predicted", fix=fix + "or install its package"))
    return sensor(names, constants, deviations, numbers, device, _shown(entry.get("shown")))


def _shown(entry: Any) -> Shown | None:
    """How readings of a model are shown, by its file."""
    if entry is None:
        return None
    try:
        unit, scale, zero = entry
        return str(unit), tuple(map(float, scale)), tuple(map(float, zero))
    except (TypeError, ValueError):
        expected = "a unit, factors and zeros"
        raise InputError.of("how readings of a model are shown", expected=expected, got=repr(entry)) from None


ORDER = {"position": 0, "pose": 0, "socket": 1}


class Rows(NamedTuple):
    """A table of one kind, and its row numbers (M,) in the whole."""

    table: Any
    rows: Tensor


Coordinates = OtherReadings = Rows  # rows that tell coordinates, of positions and poses; readings of one kind


def rows_of_one_kind(data: Any) -> list[Rows]:
    """The rows of any table by kind: measured positions or poses, then a ball in sockets, then readings."""
    parts = map(Rows, data.parts, data.index)
    return sorted(parts, key=lambda part: ORDER.get(part.table.kind, len(ORDER)))


def divided(data: Any) -> tuple[Coordinates | None, list[OtherReadings]]:
    """The rows of any table that tell coordinates, as one table, and its readings by kind."""
    parts = list(zip(data.parts, data.index, strict=True))
    own = [Coordinates(table, rows) for table, rows in parts if isinstance(table, Measurements)]
    return next(iter(own), None), [OtherReadings(table, rows) for table, rows in parts if isinstance(table, Readings)]


def with_markers(table: Measurements, markers: int, lever: float | None = None) -> Measurements:
    """Rows that tell coordinates, with this many markers, the last one a ball that they hide.

    Poses are then represented by points at the distance ``lever``, m, if it is given.
    """
    if table.frames is not None and lever is not None:
        table = with_attributes(table, points=points_of_frames(table.frames, lever), lever=lever)
    return table.with_markers(markers)


def check_markers(model: Any, coordinates: Coordinates | None, readings: Sequence[OtherReadings], other: str) -> None:
    """Raise InputError for rows that show other markers than a calibrated model; ``other``: what to do about these."""
    markers, lever, ball = model.nominal.geometry.markers, model.lever, model.ball
    table = None if coordinates is None else coordinates.table
    frames = [part.table.kind for part in readings if sees_frame(part.table)]
    if lever is None and frames:
        raise InputError.of(f"{frames[0]}s", expected="a model of poses", got="one of markers", fix=other)
    balls = len(frames) < len(readings)
    if lever is not None and balls:
        fix = "measure poses again, or calibrate again with all rows"
        raise InputError.of("the new rows", expected="poses", got="rows that show a ball", fix=fix)
    if table is None:
        return
    same = (table.lever is None) == (lever is None)
    if not same or table.markers not in {markers, markers - ball}:
        kinds = [kind_of_points(*pair) for pair in ((markers, lever), (table.markers, table.lever))]
        raise InputError.of("the new rows", expected=kinds[0], got=kinds[1], fix=other)


def measured_positions(data: Any) -> Measurements | None:
    """The rows of any table whose positions or poses a device measured; None without any."""
    positions = divided(data)[0]
    return None if positions is None else positions.table


def with_points(data: Measurements, model: Any) -> Measurements:
    """Measured positions with all points of a model: a ball that no device shows is hidden."""
    return data.with_markers(model.markers) if model.ball else data


def with_positions(data: Any, change: Callable[[Any], Any]) -> Any:
    """Any table with a change of its rows whose positions or poses a device measured; the other ones stay."""
    parts = [part if part.without_device else change(part) for part in data.parts]
    return Observations(parts, data.index) if len(parts) > 1 else parts[0]


def device_coordinates(coordinates: int, *, ball: bool, free: bool) -> int:
    """How many of a model's coordinates a device of positions sees: not those of a ball beside other markers."""
    return coordinates - 3 if ball and not free and coordinates > 3 else coordinates


def ball_tip(readings: Sequence[OtherReadings], usual: str) -> str:
    """Name of the tip that carries the ball; the usual one where no table names it."""
    return next((tip for table, _ in readings if (tip := table.ball_tip) is not None), usual)


SMALLEST_LEVER_M, LARGEST_LEVER_M = 0.01, 3.0
"""Distances of the points of a pose with which positions and turns of a robot's tool both count."""


def sees_frame(table: Any) -> bool:
    """Whether rows are readings of a frame of the tool, not of a ball."""
    return isinstance(table, Readings) and kind_of(table).seen_points > 1


def check_poses(data: Any) -> None:
    """Raise MeasurementError for poses beside rows with a ball, whose poses no model knows, and for odd levers.

    Readings of frames need poses beside them.
    """
    for lever in (getattr(part, "lever", None) for part in data.parts):
        if lever is not None and not SMALLEST_LEVER_M <= lever <= LARGEST_LEVER_M:
            expected = f"{1e3 * SMALLEST_LEVER_M:g} to {1e3 * LARGEST_LEVER_M:g} mm, about the size of the tool"
            fix = "pass it in m (on the command line in the unit of lengths), or leave it out"
            raise MeasurementError.of("`lever`", expected=expected, got=f"{1e3 * lever:g} mm", fix=fix)
    kinds = dict.fromkeys(part.kind for part in data.parts if not sees_frame(part))
    frames = dict.fromkeys(part.kind for part in data.parts if sees_frame(part))
    if frames and "pose" not in kinds:
        fix = "measure poses too, which tell where the frame is on the tool and how large the robot is"
        raise MeasurementError.of(f"{few(list(frames))}s", expected="rows beside measured poses", got="none", fix=fix)
    most = max((kind_of(part).seen_points for part in data.parts if sees_frame(part)), default=0)
    shown = sum(part.markers for part in data.parts if part.kind == "pose")
    if most > shown:
        expected, got = f"poses of {most // POINTS} frames beside them", shown // POINTS
        raise MeasurementError.of(f"{few(list(frames))}s", expected=expected, got=got, fix="measure all of them")
    if "pose" in kinds and len(kinds) > 1:
        got = " and ".join(f"{kind}s" for kind in kinds)
        fix = "give the positions of the poses alone (leave their rotation out)"
        raise MeasurementError.of("poses in a table of several kinds", expected="positions", got=got, fix=fix)
