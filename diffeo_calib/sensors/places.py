"""Where devices stand beside a model: measuring frames of set-ups, and devices of readings, placed on judged rows.

Where the devices of a calibration were found: what a model keeps of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, sentence, warn_user
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.sensors.devices import Devices, Extrinsics, check_devices
from diffeo_calib.sensors.kinds import extrinsics, kind_of
from diffeo_calib.sensors.set_ups import SetUps, mounted_kind

BALL_IS_THE_MARKER = (
    "the model was calibrated without a measuring device: the frame of these positions was found from them, 6 numbers, "
    "as if the marker were the ball; if it is another one, register the model first (`model.registered`, "
    "evaluate --free both)"
)


@dataclass(frozen=True)
class Places:
    """Devices beside a model."""

    # by kind: set-ups of measured positions, where these are in other frames, and devices of readings
    devices: Mapping[str, Any] = field(default_factory=dict)
    ball: bool = False  # whether the last marker is a ball that no device of positions measures
    found: tuple[str, ...] = ()  # what was found from the rows that are judged, in sentences
    numbers: int = 0  # how many numbers that took

    def aligned(self, data: Any) -> Any:
        """Measured positions in the frame of the model."""
        for own in self.devices.values():
            data = own.aligned(data)
        return data

    def beside(self, other: Places) -> Places:
        """Both of them."""
        devices, found = joined([*self.devices.values(), *other.devices.values()]), (*self.found, *other.found)
        return Places(devices, self.ball or other.ball, found, self.numbers + other.numbers)


def joined(devices: Iterable[Extrinsics]) -> dict[str, Any]:
    """All devices of each kind."""
    found = dict[str, Any]()
    for own in devices:
        found[own.kind] = found[own.kind].beside(own) if own.kind in found else own
    return found


def known_devices(model: object) -> dict[str, Any]:
    """The devices that a model knows, by kind; none for other kinematics."""
    return joined(own.devices for own in getattr(model, "placement", None) or ())


def mounted_of(model: Any) -> SetUps:
    """What is on the tool in every set-up that a calibrated model knows, for rows that were mounted anew."""
    return mounted_kind(model.lever).among(known_devices(model), model.turns)


LARGEST_SHARE = 0.5
"""Median residual of readings of the rows that are judged, relative to the RMS distance of what they see from its
middle: wrong rows or units, not a robot that errs."""
CHECK_READINGS = "check the columns of the readings, their unit, and which device each row names"


def fitting_devices(data: Readings, points: Tensor) -> Devices:
    """The devices where they fit readings best, for known points (N, P, 3) of the tool, m."""
    kind = kind_of(data)
    seen = kind.points_of(points)
    return kind.at(data, seen).refined(data, seen)


def placed(data: Readings, points: Tensor) -> Devices:
    """The same for rows that a user passes.

    Raises:
        MeasurementError: too few rows of a device. Warns: readings that no place of it explains.
    """
    check_devices(data)
    what, fix = "no place of the devices explains the readings", CHECK_READINGS
    try:
        found = fitting_devices(data, points)
    except InputError as error:  # the ball at a fixed point or behind a camera
        raise MeasurementError.of(f"{what} ({error})", fix=fix) from None
    seen = found.points_of(points)
    error = float(found.errors(data, seen).square().sum(1).median().sqrt())
    most = LARGEST_SHARE * float((seen - seen.mean(0)).square().sum(1).mean().sqrt())
    if error > most:
        expected = f"residuals well below {1e3 * most:.0f} mm for points that far apart"
        warn_user(sentence(what, expected=expected, got=f"a median of {1e3 * error:.3g} mm", fix=fix))
    return found


Shown = tuple[str, tuple[float, ...], tuple[float, ...]]
"""Unit in which r numbers are shown, and what they are multiplied by and shifted by to be in it."""
ENTRIES = ("kind", "names", "constants", "deviations", "rows", "device")


def _nothing() -> Tensor:
    return torch.zeros(0, dtype=torch.int64, device=HOST)


@dataclass(frozen=True, eq=False)
class PlacedDevices:
    """Devices of one kind in the frame of a model, and the rows of its fit that they measured."""

    devices: Extrinsics  # where they are
    rows: Tensor = field(default_factory=_nothing)  # (M,) int64, rows of the fit that they measured; by default none
    device: Tensor = field(default_factory=_nothing)  # (M,) int64, which of them did
    shown: Shown | None = None  # how their readings are shown; None for other kinds, and in files of old versions

    @property
    def kind(self) -> str:
        """Of the devices, see sensors/kinds.py."""
        return self.devices.kind

    @property
    def names(self) -> tuple[str, ...]:
        """Of the devices."""
        return self.devices.names

    def beside(self, other: PlacedDevices) -> PlacedDevices:
        """These, and those of the same kind with other names."""
        devices, known = self.devices.beside(other.devices), set(self.names)
        new = [number for number, name in enumerate(other.names) if name not in known]
        place = torch.full((len(other.names),), -1, dtype=torch.int64, device=HOST)
        place[new] = torch.arange(len(self.names), len(devices.names), device=HOST)
        device = place[other.device]
        rows = torch.cat([self.rows, other.rows[device >= 0]])
        return PlacedDevices(devices, rows, torch.cat([self.device, device[device >= 0]]), self.shown or other.shown)

    @property
    def rows_elsewhere(self) -> Tensor:
        """(K,) rows of the fit that were measured in another set-up than the model's, whose frame it has."""
        return self.rows[self.devices.elsewhere[self.device.to(self.devices.constants.device)].to(self.rows.device)]

    def entry(self) -> dict[str, Any]:
        """For a file, in m and rad."""
        own = self.devices
        values = {"constants": own.constants, "deviations": own.deviations, "rows": self.rows, "device": self.device}
        found = {"kind": own.kind, "names": own.names} | {name: value.tolist() for name, value in values.items()}
        return found | ({} if self.shown is None else {"shown": self.shown})

    @classmethod
    def from_entry(cls, entry: Any, rows: int) -> PlacedDevices:
        """The inverse of :meth:`entry`, for a fit with this number of rows.

        Raises:
            InputError: entries that do not fit together.
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
        devices = extrinsics(entry["kind"], names, constants, deviations)
        return cls(devices, numbers, device, _shown(entry.get("shown")))


def _shown(entry: Any) -> Shown | None:
    """The inverse of the entry of :attr:`PlacedDevices.shown`."""
    if entry is None:
        return None
    try:
        unit, scale, zero = entry
        return str(unit), tuple(map(float, scale)), tuple(map(float, zero))
    except (TypeError, ValueError):
        expected = "a unit, factors and zeros"
        raise InputError.of("how readings of a model are shown", expected=expected, got=repr(entry)) from None
