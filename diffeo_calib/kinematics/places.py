"""Where devices stand beside a model: those that it knows, and those that are placed on the rows that are judged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError, few
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.joint_order import check_joint_order
from diffeo_calib.kinematics.laden_rows import at_payloads
from diffeo_calib.kinematics.session_places import place_sessions
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.devices import Devices, check_devices
from diffeo_calib.sensors.kinds import kind_of
from diffeo_calib.sensors.tables import divided

T = TypeVar("T")
KNOWN_DEVIATION = 1e-8
"""Prior deviations of increments below this, m or rad, are those of numbers that are known."""
NUMBERS_OF_A_SOCKET = 3
ROWS = "these rows"
"""Name of the set-up of rows that name none."""
BALL_IS_THE_MARKER = (
    "the model was calibrated without a measuring device: the frame of these positions was found from them, 6 numbers, "
    "as if the marker were the ball; if it is another one, register the model first (`model.registered`, evaluate "
    "--register)"
)


class Frames(Protocol):
    """Measuring frames of set-ups."""

    def aligned(self, data: T) -> T:
        """The rows in the frame of the model."""
        ...


@dataclass(frozen=True, eq=False)
class Places:
    """Devices beside a model.

    Args:
        frames: of the set-ups of measured positions; None where these are in the frame of the model.
        devices: those of readings, see :func:`sensor_key`.
        ball: whether the last marker is a ball that no device of positions measures.
        found: what was found from the rows that are judged, in sentences. numbers: how many numbers that took.
    """

    frames: Frames | None = None
    devices: Mapping[object, Devices] = field(default_factory=dict)
    ball: bool = False
    found: tuple[str, ...] = ()
    numbers: int = 0

    def aligned(self, data: T) -> T:
        """Measured positions in the frame of the model."""
        return data if self.frames is None else self.frames.aligned(data)


def sensor_key(data: Readings) -> object:
    """What readings of the same kind of devices have in common."""
    return data.kind, data.offset_std, data.intrinsics


def devices_of(model: object) -> dict[str, Devices]:
    """The devices of readings whose places a model knows, by kind; none for other kinematics."""
    sets = getattr(model, "placement", None) or ()
    known = [own if isinstance(own, Devices) else getattr(own, "devices", None) for own in sets]
    return {own.kind: own for own in known if isinstance(own, Devices)}


def placement_sentences(model: object) -> list[str]:
    """Where the devices are that a model knows, with deviations; none for other kinematics."""
    return [line for own in getattr(model, "placement", None) or () for line in own.sentences()]


def place(kinematics: Callable[[Tensor], Tensor], data: Any, *, every_session: bool = False) -> Places:
    """Place what a model does not know on the rows of a table: frames of set-ups, devices of readings.

    Args:
        kinematics: (N, n) joint values -> (N, P, 3) markers, m, the ball last. data: rows of any kinds.
        every_session: whether the rows of a single set-up are placed too; by default they are in the model's frame.

    Raises:
        InputError: readings and a model of something else than the ball on one tool, or joints in another order.
        MeasurementError: too few rows of a set-up or device, or readings that no place of it explains.
    """
    own, readings = divided(data)
    sentences, numbers, frames, devices = list[str](), 0, None, {}
    if own is not None and not own.table.without_device:
        frames = _frames(kinematics, own.table.device_rows(), every_session=every_session)
    if frames is not None:
        numbers += frames.fitted_numbers
        sentences += [BALL_IS_THE_MARKER] if frames.names == (ROWS,) else frames.sentences()
    if own is not None and own.table.socket_numbers is not None:
        resting = int(own.table.socket_numbers.unique().ge(0).sum())
        numbers += NUMBERS_OF_A_SOCKET * resting
        sentences += [f"the middles of {resting} sockets were found from these rows"] * (resting > 0)
    for table, _ in readings:
        devices[sensor_key(table)], found = _devices(kinematics, table)
        numbers += found
        names = few([f"'{name}'" for name in table.names])
        sentences += [f"the places of the devices of {table.kind}s were found from these rows: {names}"] * (found > 0)
    several = len(readings) + (own is not None) > 1 or (own is not None and own.table.kind == "mixture")
    ball = kinematics.ball if isinstance(kinematics, CalibratedKinematics) else several
    if numbers:
        sentences.append(f"{numbers} numbers in all were found from the rows that are judged")
    return Places(frames, devices, ball, tuple(sentences), numbers)


def _frames(kinematics: Callable[[Tensor], Tensor], data: Measurements, *, every_session: bool) -> Any:
    """Places of the set-ups that must be found; None without."""
    names = {name for name in data.device_names if name}
    if len(names) > 1 or (every_session and names):
        return place_sessions(kinematics, data)
    free = isinstance(kinematics, CalibratedKinematics) and kinematics.map.workspace is not None
    if not free or kinematics.registration is not None:
        return None
    return place_sessions(kinematics, data if names else data.with_sessions([ROWS] * len(data)))


def _devices(kinematics: Callable[[Tensor], Tensor], data: Readings) -> tuple[Devices, int]:
    """The devices of readings, and how many of their numbers were found from these rows."""
    known = devices_of(kinematics).get(data.kind)
    if known is not None and set(data.names) <= set(known.names):
        return known, 0
    found = placed(kinematics, data)
    free = int((found.deviations > KNOWN_DEVIATION).sum())
    return found, free * len(found.names)


def placed(kinematics: Callable[[Tensor], Tensor], data: Readings) -> Devices:
    """The devices where they fit some readings best, if the kinematics of the ball are right.

    Args:
        kinematics: (N, n) joint values -> (N, P, 3) places of the ball, the last marker, m. data: readings.

    Raises:
        InputError: a model of something else than the ball on one tool, or joints in another order.
        MeasurementError: too few rows of a device, or readings that no place of it explains.
    """
    if isinstance(kinematics, CalibratedKinematics):
        check_joint_order(kinematics.robot, data)
        if not kinematics.ball:
            fix = "calibrate with readings; the marker of the model is not where the ball is"
            got = "one that was calibrated with measured positions"
            raise InputError.of("readings of a ball", expected="a model of such readings", got=got, fix=fix)
    check_devices(data)
    points = at_payloads(kinematics, data)(data.q).detach()[:, -1]  # the ball
    try:
        return kind_of(data).at(data, points).refined(data, points)
    except InputError as error:  # the ball at a fixed point or behind a camera
        fix = "check the columns of the readings, their unit, and which device each row names"
        raise MeasurementError.of(f"no place of the devices explains the readings ({error})", fix=fix) from None
