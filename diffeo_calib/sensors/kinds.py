"""Every kind of device, by the kind of its readings: the only place that knows them all.

A kind of your own is a subclass of :class:`Devices`, given to :func:`register`: see scripts/examples/laser_line.py and
inclinometer.py. The command line knows it if a package that is installed names its module as an entry point of
``diffeo_calib.sensors``; tables then have ``--reading KIND=COLUMN,...``, and ``init`` finds these by their names.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points

from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError, listed, sentence, warn_user
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.sensors.board_camera import BoardCameras
from diffeo_calib.sensors.devices import Devices, Extrinsics
from diffeo_calib.sensors.height import Planes
from diffeo_calib.sensors.image import Cameras
from diffeo_calib.sensors.known_drift import KnownDrift
from diffeo_calib.sensors.range import FixedPoints
from diffeo_calib.sensors.set_ups import MeasuringFrames, MountedFrames, MountedMarkers
from diffeo_calib.sensors.sockets import SocketPlaces
from diffeo_calib.sensors.tool_frames import Contacts, HeldTools, Trackers

KINDS: dict[str, type[Devices]] = {
    kind.kind: kind for kind in (FixedPoints, Planes, Cameras, HeldTools, Trackers, Contacts)
}
WITHOUT_READINGS: dict[str, type[Extrinsics]] = {
    kind.kind: kind for kind in (MeasuringFrames, MountedMarkers, MountedFrames, SocketPlaces, BoardCameras, KnownDrift)
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
    for found in entry_points(group="diffeo_calib.sensors"):
        found.load()
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
        """As the file says it."""
        return self.read_kind

    def warn_if_unknown(self) -> None:
        what = f"the model has {len(self.names)} devices of the kind {self.kind!r}, which is not registered here"
        fix = (
            "import the module that registers it (`diffeo_calib.sensors.kinds.register`) and load the model again, or "
        )
        fix += "install its package"
        warn_user(sentence(f"{what}: their readings are not predicted", fix=fix))

    def carried(self, T: Tensor, before: Tensor, after: Tensor, markers: Tensor) -> Tensor:
        fix = "import the module that registers it, and load the model again"
        raise InputError.of(f"devices of the kind {self.kind!r} in a model", got="a kind not registered", fix=fix)


def extrinsics(kind: str, names: tuple[str, ...], constants: Tensor, deviations: Tensor) -> Extrinsics:
    """Devices of any kind, of one that nobody registered too; see :class:`Extrinsics`."""
    found = {**known_kinds(), **WITHOUT_READINGS}.get(kind)
    return Unregistered(names, constants, deviations, kind) if found is None else found(names, constants, deviations)
