"""Every kind of device, by the kind of its readings: the only place that knows them all.

A kind of your own is a subclass of :class:`Devices`, given to :func:`register`: see scripts/examples/laser_line.py and
inclinometer.py. The command line knows it if a package that is installed names its module as an entry point of
``diffeo_calib.sensors``; tables then have ``--reading KIND=COLUMN,...``, and ``init`` finds these by their names.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import entry_points
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, listed, sentence, warn_user
from diffeo_calib.measurements.readings import Readings
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
