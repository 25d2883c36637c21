"""Where the devices of a calibration were found: what a model keeps of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError
from diffeo_calib.sensors.board_camera import CAMERA, BoardCamera
from diffeo_calib.sensors.devices import Devices, numbers_text
from diffeo_calib.sensors.kinds import known_kinds

SESSION, SOCKET = "session", "socket"
"""Kinds besides those of readings: measuring frames, (D, 16) transforms from the model's, and (D, 3) places, m."""
MODEL_FRAME = "the frame of the model"
ENTRIES = ("kind", "names", "constants", "deviations", "rows", "device")


@dataclass(frozen=True, eq=False)
class PlacedDevices:
    """Devices of one kind in the frame of a model.

    Args:
        kind: "session", "socket", or that of readings.
        names: D names. constants: (D, c). deviations: (D, k) standard deviations of their increments, m or rad.
        rows: (M,) int64, rows of the fit that they measured. device: (M,) int64, which of them did.
    """

    kind: str
    names: tuple[str, ...]
    constants: Tensor
    deviations: Tensor
    rows: Tensor
    device: Tensor

    @classmethod
    def outside(cls, kind: str, names: tuple[str, ...], constants: Tensor, deviations: Tensor) -> PlacedDevices:
        """Devices that measured no row of the fit."""
        nothing = torch.zeros(0, dtype=torch.int64, device=HOST)
        return cls(kind, names, constants, deviations, nothing, nothing)

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
        )

    @property
    def devices(self) -> Devices | None:
        """As devices of readings; None for other kinds, and for those that nobody registered."""
        if self.kind not in known_kinds():
            return None
        return known_kinds()[self.kind](self.names, self.constants, self.deviations.amax(0))

    @property
    def camera(self) -> BoardCamera | None:
        """As the camera that saw a board; None for other kinds."""
        return BoardCamera.of(self.constants[0]) if self.kind == CAMERA else None

    def sentences(self) -> list[str]:
        """Where each of them is in the frame of the model, with standard deviations; lens and board of a camera."""
        if self.kind == CAMERA:
            return [] if self.camera is None else list(self.camera.sentences())
        devices = self.devices
        if devices is not None:
            return [devices.sentence(number, own, MODEL_FRAME) for number, own in enumerate(self.deviations)]
        places = (
            self.constants[:, 3:12:4] if self.kind == SESSION else self.constants[:, :3]
        )  # of transforms, row by row
        return [
            f"{self.kind} '{name}': {numbers_text((1e3 * place).tolist())} mm in {MODEL_FRAME}"
            for name, place in zip(self.names, places, strict=True)
        ]

    def entry(self) -> dict[str, Any]:
        """For a file, in m and rad."""
        found = {name: getattr(self, name) for name in ENTRIES}
        return {name: value.tolist() if isinstance(value, Tensor) else value for name, value in found.items()}

    @classmethod
    def from_entry(cls, entry: Any, rows: int) -> PlacedDevices:
        """The inverse of :meth:`entry`, for a fit of so many rows.

        Raises:
            InputError: entries that do not fit together.
        """
        if not isinstance(entry, dict) or set(entry) != set(ENTRIES):
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
        return cls(entry["kind"], names, constants, deviations, numbers, device)
