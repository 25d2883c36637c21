"""Where devices stand beside a model: measuring frames of set-ups, and devices of readings, placed on judged rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError, sentence, warn_user
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.sensors.devices import Devices, Extrinsics, check_devices
from diffeo_calib.sensors.kinds import kind_of
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
    """Join devices of each kind."""
    found = dict[str, Any]()
    for own in devices:
        found[own.kind] = found[own.kind].beside(own) if own.kind in found else own
    return found


def known_devices(model: object) -> dict[str, Any]:
    """The devices that a model knows, by kind; none for other kinematics."""
    return joined(getattr(model, "placement", None) or ())


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
    """Place the devices of rows that a user passes.

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
