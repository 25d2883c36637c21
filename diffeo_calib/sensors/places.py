"""Where devices stand beside a model: measuring frames of set-ups, and devices of readings, placed on judged rows.

Where the devices of a calibration were found: what a model keeps of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, sentence, warn_user
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.sensors.board_camera import CAMERA, BoardCamera, camera_sentences
from diffeo_calib.sensors.devices import Devices, check_devices, numbers_text
from diffeo_calib.sensors.kinds import kind_of, known_kinds
from diffeo_calib.sensors.set_ups import KINDS, MOUNTING, SESSION, SetUps

BALL_IS_THE_MARKER = (
    "the model was calibrated without a measuring device: the frame of these positions was found from them, 6 numbers, "
    "as if the marker were the ball; if it is another one, register the model first (`model.registered`, "
    "evaluate --free both)"
)


@dataclass(frozen=True)
class Places:
    """Devices beside a model.

    Args:
        frames: of the set-ups of measured positions; None where these are in the frame of the model.
        devices: those of readings, see :attr:`Readings.column_kind`.
        ball: whether the last marker is a ball that no device of positions measures.
        found: what was found from the rows that are judged, in sentences. numbers: how many numbers that took.
    """

    frames: Any = None
    devices: Mapping[object, Devices] = field(default_factory=dict)
    ball: bool = False
    found: tuple[str, ...] = ()
    numbers: int = 0

    def aligned(self, data: Any) -> Any:
        """Measured positions in the frame of the model."""
        return data if self.frames is None else self.frames.aligned(data)

    def beside(self, other: Places) -> Places:
        """Both of them."""
        devices, found = {**self.devices, **other.devices}, (*self.found, *other.found)
        frames, ball = self.frames or other.frames, self.ball or other.ball
        return Places(frames, devices, ball, found, self.numbers + other.numbers)


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


SOCKET, DRIFT = "socket", "drift"
"""Kinds besides those of readings: measuring frames, (D, 16) transforms from the model's, (D, 3) places, m, markers
that were mounted anew, (D, 3 P) shifts from the model's in the frames of their tips, m, frames on the tool, (D, 16)
transforms from theirs to that of the model's tool, and columns with which something drifts, see `KnownDrift`."""
WITHOUT_READINGS = *KINDS, SOCKET, DRIFT, CAMERA
MODEL_FRAME = "the frame of the model"
ENTRIES = ("kind", "names", "constants", "deviations", "rows", "device")
Shown = tuple[str, tuple[float, ...], tuple[float, ...]]
"""Unit in which r numbers are shown, and what they are multiplied by and shifted by to be in it."""


@dataclass(frozen=True, eq=False)
class PlacedDevices:
    """Devices of one kind in the frame of a model.

    Args:
        kind: "session", "socket", "mounting", "mounted frame", "drift", or that of readings.
        names: D names. constants: (D, c). deviations: (D, k) standard deviations of their increments, m or rad.
        rows: (M,) int64, rows of the fit that they measured. device: (M,) int64, which of them did.
        shown: how their readings are shown; None for other kinds, and in files of old versions.
    """

    kind: str
    names: tuple[str, ...]
    constants: Tensor
    deviations: Tensor
    rows: Tensor
    device: Tensor
    shown: Shown | None = None

    @classmethod
    def outside(
        cls, kind: str, names: tuple[str, ...], constants: Tensor, deviations: Tensor, shown: Shown | None = None
    ) -> PlacedDevices:
        """Devices that measured no row of the fit."""
        nothing = torch.zeros(0, dtype=torch.int64, device=HOST)
        return cls(kind, names, constants, deviations, nothing, nothing, shown)

    @classmethod
    def of_model_alone(cls, names: tuple[str, ...], mounted: int) -> PlacedDevices:
        """The only set-up, whose frame, or markers that were mounted anew (0: none were), are those of the model."""
        none = torch.zeros(1, 3 * mounted, dtype=torch.float64, device=HOST)
        if mounted:
            return cls.outside(MOUNTING, names, none, none)
        return cls.outside(SESSION, names, torch.eye(4, dtype=torch.float64, device=HOST).view(1, 16), none)

    def beside(self, other: PlacedDevices) -> PlacedDevices:
        """These, and those of the same kind with other names."""
        kept = [number for number, name in enumerate(other.names) if name not in self.names]
        known = {number: len(self.names) + place for place, number in enumerate(kept)}
        rows = torch.tensor([number in known for number in other.device.tolist()], dtype=torch.bool, device=HOST)
        device = [known[number] for number in other.device[rows].tolist()]
        return PlacedDevices(
            self.kind,
            (*self.names, *(other.names[number] for number in kept)),
            torch.cat([self.constants, other.constants[kept]]),
            torch.cat([self.deviations, other.deviations[kept]]),
            torch.cat([self.rows, other.rows[rows]]),
            torch.cat([self.device, torch.tensor(device, dtype=torch.int64, device=HOST)]),
            self.shown or other.shown,
        )

    def same_set(self, other: PlacedDevices) -> bool:
        """Whether others are of one set with these: of the same kind, and under the same names if readings are."""
        return self.kind == other.kind and (self.devices is None or bool(set(self.names) & set(other.names)))

    @property
    def of_model(self) -> bool:
        """Whether this is one set-up alone, whose frame and markers are those of the model."""
        return self.kind in KINDS and len(self.names) == 1

    @property
    def set_ups(self) -> SetUps | None:
        """As set-ups; None for other kinds."""
        return KINDS[self.kind](self.names, self.constants, self.deviations) if self.kind in KINDS else None

    @property
    def rows_elsewhere(self) -> Tensor:
        """(K,) rows of the fit that were measured in another set-up than the model's, whose frame it has."""
        if self.set_ups is None:
            return self.rows[:0]
        return self.rows[self.set_ups.elsewhere[self.device.to(self.constants.device)].to(self.rows.device)]

    def carried(self, T: Tensor, before: Tensor, after: Tensor, markers: Tensor) -> PlacedDevices:
        """The same devices beside another model: those of readings read of its points what they read before.

        Args:
            T: (4, 4) from the old frame to the new one, m.
            before, after: (N, P, 3) points of the old and the new model at the rows of the fit, m.
            markers: (P, 3) old places of the markers from the new ones, in the frames of their tips, m.
        """
        if self.set_ups is not None:
            return replace(self, constants=self.set_ups.carried(T, before, after, markers))
        if self.kind == SOCKET:
            return replace(self, constants=self.constants @ T[:3, :3].mT + T[:3, 3])
        if self.unknown:
            fix = "import the module that registers it"
            raise InputError.of(f"devices of the kind {self.kind!r} in a model", got="a kind not registered", fix=fix)
        if self.devices is None:
            return self
        each = [_carried(self.devices, number, before, after) for number in range(len(self.names))]
        return replace(self, constants=torch.stack(each))

    @property
    def devices(self) -> Devices | None:
        """As devices of readings; None for other kinds, and for those that nobody registered."""
        if self.kind not in known_kinds():
            return None
        return known_kinds()[self.kind](self.names, self.constants, self.deviations.amax(0))

    @property
    def unknown(self) -> bool:
        """Whether these are devices of a kind that nobody registered in this session."""
        return self.kind not in (*WITHOUT_READINGS, *known_kinds())

    def warn_if_unknown(self) -> None:
        """Warn of devices that cannot be used, and say what to do."""
        if self.unknown:
            what = f"the model has {len(self.names)} devices of the kind {self.kind!r}, which is not registered here"
            fix = "import the module that registers it (`diffeo_calib.sensors.kinds.register`), or install its package"
            warn_user(sentence(f"{what}: their readings are not predicted", fix=fix))

    @property
    def cameras(self) -> dict[str, BoardCamera]:
        """As the cameras that saw a board, by their names; none for other kinds."""
        each = zip(self.names, map(BoardCamera.of, self.constants if self.kind == CAMERA else ()), strict=False)
        return {name: own for name, own in each if own is not None}

    def sentences(self) -> list[str]:
        """Where each of them is in the frame of the model, with standard deviations; lens and board of a camera."""
        if self.kind == CAMERA:
            return list(camera_sentences(self.cameras))
        devices = self.devices
        if devices is not None:
            return [devices.sentence(number, own, MODEL_FRAME) for number, own in enumerate(self.deviations)]
        if self.kind == DRIFT:  # which names the robot's joints
            return []
        if self.set_ups is not None:
            return self.set_ups.sentences()
        return [
            f"{self.kind} '{name}': {numbers_text((1e3 * place).tolist())} mm in {MODEL_FRAME}"
            for name, place in zip(self.names, self.constants[:, :3], strict=True)
        ]

    def entry(self) -> dict[str, Any]:
        """For a file, in m and rad."""
        found = {name: getattr(self, name) for name in ENTRIES} | ({} if self.shown is None else {"shown": self.shown})
        return {name: value.tolist() if isinstance(value, Tensor) else value for name, value in found.items()}

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
        return cls(entry["kind"], names, constants, deviations, numbers, device, _shown(entry.get("shown")))


def _carried(devices: Devices, number: int, before: Tensor, after: Tensor) -> Tensor:
    """Constants (c,) of the device that reads of points (N, P, 3) what another one reads of others, m."""
    old, new = devices.points_of(before), devices.points_of(after)
    sees = devices.sees(old, torch.full((len(old),), number, dtype=torch.int64, device=HOST))
    old, new = old[sees], new[sees]
    own = torch.zeros(len(old), dtype=torch.int64, device=HOST)
    values = devices.observation(own + number).value(old) / devices.metres[number]
    read = Readings(devices.kind, old[:, :1], values, own, devices.names[number : number + 1])
    start = replace(devices, names=read.names, constants=devices.start(values, devices.bodies(new))[None])
    return start.refined(read, new).constants[0]


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
