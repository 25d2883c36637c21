"""Rows of each kind beside a model: what it must know to be compared with them, what is placed on them, their errors.

A device measures positions or poses in its own frame, which may have to be found; a ball rests in sockets, whose
middles are found; other devices report readings. :func:`sensor_of` knows the kind of a table, nobody else asks for it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, few, listed, sentence, warn_user
from diffeo_calib.measurements.checks import ANGLE_MISTAKES, rare_names
from diffeo_calib.measurements.readings import KIND, Readings, SocketReadings
from diffeo_calib.measurements.rows import NO_SOCKET
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import Devices, Extrinsics, check_devices
from diffeo_calib.sensors.errors import READINGS, SPREAD, Evaluation, Evaluations, socket_errors
from diffeo_calib.sensors.kinds import Coordinates, kind_of, with_positions
from diffeo_calib.sensors.set_ups import ROWS, SetUps, Turns, check_same_markers, mounted_kind, set_up_kind

KNOWN_DEVIATION = 1e-8  # prior deviations of increments below this, m or rad, are those of numbers that are known
NUMBERS_OF_A_SOCKET = 3
REMAINING_SPREAD, SMALLEST_MOTION_M = 0.2, 1e-9
"""Largest part of the spread within sockets, relative to the tip's motion, that remains where a mistake is undone."""
LARGEST_MEDIAN_M = 5e-3  # of readings around a calibrated robot: with larger errors it is another robot or another ball


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
        for part in sorted(self.devices.values(), key=lambda part: not part.cameras):  # frames are of what these see
            data = part.aligned(data)
        return data

    def beside(self, other: Places) -> Places:
        """Both of them."""
        devices, sentences = joined([*self.devices.values(), *other.devices.values()]), (*self.found, *other.found)
        return Places(devices, self.ball or other.ball, sentences, self.numbers + other.numbers)


def joined(devices: Iterable[Extrinsics]) -> dict[str, Any]:
    """Join devices of each kind."""
    kinds = dict[str, Any]()
    for part in devices:
        kinds[part.kind] = kinds[part.kind].beside(part) if part.kind in kinds else part
    return kinds


def known_devices(model: object) -> dict[str, Any]:
    """The devices that a model knows, by kind; none for other kinematics."""
    return joined(getattr(model, "placement", None) or ())


def mounted_of(model: Any) -> SetUps:
    """What is on the tool in every set-up that a calibrated model knows, for rows that were mounted anew."""
    return mounted_kind(model.lever).among(known_devices(model), model.turns)


def with_earlier_cameras(data: Any, model: Any) -> Any:
    """New rows with what a calibrated model knows of the cameras that saw their boards."""
    cameras = {name: one.camera for devices in model.placement for name, one in devices.cameras.items()}
    return with_positions(data, lambda part: part.with_earlier(cameras)) if cameras else data


LARGEST_SHARE = 0.5
"""Median residual of readings of the rows that are judged, relative to the RMS distance of what they see from its
middle: wrong rows or units, not a robot that errs."""
CHECK_READINGS = "check the columns of the readings, their unit, and which device each row names"


def fitting_devices(data: Readings, points: Tensor) -> Devices:
    """The devices where they fit readings best, for known points (N, P, 3) of the tool, m."""
    kind = kind_of(data)
    shown = kind.points_of(points)
    return kind.at(data, shown).refined(data, shown)


def placed(data: Readings, points: Tensor) -> Devices:
    """Place the devices of rows that a user passes.

    Raises:
        MeasurementError: too few rows of a device. Warns: readings that no place of it explains.
    """
    check_devices(data)
    what, fix = "no place of the devices explains the readings", CHECK_READINGS
    try:
        devices = fitting_devices(data, points)
    except InputError as error:  # the ball at a fixed point or behind a camera
        raise MeasurementError.of(f"{what} ({error})", fix=fix) from None
    shown = devices.points_of(points)
    error = float(devices.errors(data, shown).square().sum(1).median().sqrt())
    most = LARGEST_SHARE * float((shown - shown.mean(0)).square().sum(1).mean().sqrt())
    if error > most:
        expected = f"residuals well below {1e3 * most:.0f} mm for points that far apart"
        warn_user(sentence(what, expected=expected, got=f"a median of {1e3 * error:.3g} mm", fix=fix))
    return devices


@dataclass(frozen=True)
class Beside:
    """Kinematics that rows are compared with."""

    # a table -> (N, P, 3) points of the tool under the payloads of its rows, m, the ball last
    points: Callable[[Any], Tensor]
    known: Mapping[str, Any]  # devices whose places are known, by kind
    turns: Turns | None = None  # of its tips; None for kinematics that do not tell
    # whether positions are in another frame than that of the kinematics, which no device has seen
    unplaced: bool = False
    every_session: bool = False  # whether the frame of a single set-up is to be found too


class Sensor(ABC):
    """Rows of one kind beside a model."""

    options = ""
    """More options that say how a table of such rows is read."""

    @abstractmethod
    def check(self, data: Any, model: Any) -> None:
        """Raise InputError or MeasurementError for rows that a model cannot be compared with."""

    def rare(self, data: Any) -> list[str]:
        """Names of places with too few rows to say anything, in words."""
        return []

    def check_angles(self, data: Any, model: Any) -> None:  # noqa: B027
        """Raise MeasurementError for rows that fit a model far better with joint values in another unit of angles."""

    @abstractmethod
    def place(self, data: Any, beside: Beside) -> Places:
        """Place what the kinematics do not know on these rows."""

    @abstractmethod
    def errors(self, data: Any, points: Tensor, places: Places) -> Evaluation:
        """Measured minus predicted values, for points (N, P, 3) of the tool, m."""

    @abstractmethod
    def settled(self, data: Any, points: Tensor, turns: Turns) -> tuple[Extrinsics, ...]:
        """The devices around points (N, P, 3) of a model, m, with what these rows leave open about them.

        ``turns`` of the tips that carry the points: see :class:`SetUps`.
        """


class Positions(Sensor):
    """Positions of markers in the frame of a device."""

    fix = "name the columns of the rotation too"

    def check(self, data: Measurements, model: Any) -> None:
        """Return the kind of bodies, on the same tips; three markers are not a pose, although both are three points."""
        fitted, bodies = model.bodies, data.bodies
        if fitted.kind != bodies.kind:
            what = f"the model was calibrated with {fitted.kind}"
            raise InputError.of(what, expected=f"measured {fitted.kind}", got=bodies.kind, fix=self.fix)
        check_tips(data, model.on[: data.markers if model.ball else None])

    def place(self, data: Measurements, beside: Beside) -> Places:
        """The frames of set-ups: those that the model knows stay, the others are found.

        The rows of a single unknown set-up are those of a model that knows none, unless no device shares its frame.
        """
        data = Places({kind: each for kind, each in beside.known.items() if each.cameras}).aligned(data)
        old = set_up_kind(data).among(beside.known, beside.turns)
        if beside.unplaced and not data.remounted:
            data = data.with_sessions([name or ROWS for name in data.device_names])
        names = dict.fromkeys(name for name in data.device_names if name)
        frames, new = old.only(names), [name for name in names if name not in old.names]
        sought = data.remounted or len(names) > 1 or beside.every_session or beside.unplaced
        if not new or not (sought or old.names):
            return Places(joined([frames] if frames.names else []))
        rows = of_devices(data, new)
        set_ups = type(old).of(beside.points(rows), rows, beside.turns)
        frames = frames.beside(set_ups)
        said = [BALL_IS_THE_MARKER] if frames.names == (ROWS,) else set_ups.found_sentences()
        return Places(joined([frames]), found=tuple(said), numbers=set_ups.fitted_numbers)

    def errors(self, data: Measurements, points: Tensor, places: Places) -> Evaluation:
        names, data = data.device_names, places.aligned(data)
        points = points[:, :-1] if places.ball and points.shape[1] == data.markers + 1 else points
        check_same_markers(points, data.points)
        whole = Evaluation(data.points[..., 0], line_numbers=data.line_numbers, devices=names, kind=data.kind)
        return self._errors(whole, data, points)

    def _errors(self, whole: Evaluation, data: Measurements, points: Tensor) -> Evaluation:
        away = data.points - points
        return replace(whole, errors=away.norm(dim=-1), away=away)

    def settled(self, data: Measurements, points: Tensor, turns: Turns) -> tuple[Extrinsics, ...]:
        """The frames of the set-ups that rows name, or their markers; those of the only one are those of the model."""
        names = data.present_sessions
        if len(names) < 2:
            if not names or (data.remounted and data.lever is not None):  # a camera that the model knows stays
                return ()
            none = torch.zeros(1, 3 * data.markers * data.remounted, dtype=torch.float64, device=HOST)
            here = none if data.remounted else torch.eye(4, dtype=none.dtype, device=HOST).view(1, 16)
            return (set_up_kind(data)(names, here, none),)
        return (set_up_kind(data).of(points, data, turns),)


class Poses(Positions):
    """Poses of frames on the tool in the frame of a device."""

    options, fix = ", `convention` and `rotation_angle`", "leave the rotation out"

    def _errors(self, whole: Evaluation, data: Measurements, points: Tensor) -> Evaluation:
        away, turns = data.bodies.errors(data, points).split(3, dim=-1)
        angles = turns.norm(dim=-1)
        angles = angles[:, 0] if angles.shape[1] == 1 else angles
        return replace(whole, errors=away.norm(dim=-1), angles=angles, away=away, turns=turns)


class OtherDevices(Sensor):
    """Readings of the ball, or of a frame of the tool, by other devices."""

    advice = "check the unit of the readings (--length), their columns (--reading), and the device of every row"
    advice += " (`device`, --session)"
    """What to check if errors are no calibrated robot's."""

    def check(self, data: Readings, model: Any) -> None:
        """They tell of the ball alone, or of the frame of measured poses."""
        if kind_of(data).seen_points > 1:
            model.bodies.pose_lever()
            needed, held = (points // model.bodies.points for points in (kind_of(data).seen_points, model.markers))
            if needed > held:
                raise InputError.of(f"{data.kind}s", expected=f"a model of poses of {needed} frames", got=held)
            return
        check_ball(model, "readings of a ball", "such readings", "readings")

    def place(self, data: Readings, beside: Beside) -> Places:
        old = beside.known.get(data.kind)
        if old is not None and set(data.names) <= set(old.names):
            return Places(joined([old]))
        names = tuple(name for name in data.names if old is None or name not in old.names)
        rows = of_devices(data, names)
        devices = placed(rows, beside.points(rows))
        free = int((devices.deviations > KNOWN_DEVIATION).sum())
        words = few([f"'{name}'" for name in names])
        sentence = f"the places of the devices of {data.kind}s were found from these rows: {words}"
        return Places(joined([devices] if old is None else [old, devices]), found=(sentence,), numbers=free)

    def errors(self, data: Readings, points: Tensor, places: Places) -> Evaluation:
        devices = places.devices.get(data.kind)
        if devices is None:
            fix = "pass rows of the devices of the calibration"
            raise MeasurementError.of("`data`", expected="readings of the calibration", got=f"{data.kind}s", fix=fix)
        return self.in_unit(data, devices, self.away(data, points, places))

    def away(self, data: Readings, points: Tensor, places: Places) -> Tensor:
        """Measured minus predicted readings (N, r), m."""
        devices = places.devices[data.kind]
        return devices.errors(data, devices.points_of(points))

    def in_unit(self, data: Readings, devices: Devices, errors: Tensor) -> Evaluation:
        """Errors (N, r), m, in the unit of the device."""
        unit, per_unit = ("m", 1e-3) if data.unit[0] == "mm" else (data.unit[0], 1.0)
        away = per_unit * devices.in_unit(data, errors)
        size, names, lines = away.norm(dim=1, keepdim=True), data.device_names, data.line_numbers
        return Evaluation(size, None, away[:, None], lines, what=READINGS, kind=data.kind, unit=unit, devices=names)

    def settled(self, data: Readings, points: Tensor, turns: Turns) -> tuple[Extrinsics, ...]:
        """The devices, with the standard deviations of their increments."""
        devices = self.around(data, points)
        shown = devices.points_of(points)
        median = float(devices.errors(data, shown).norm(dim=1).median())
        if median > LARGEST_MEDIAN_M:
            fix = "recalibrate, which finds another ball; or check the rows"
            expected, got = f"at most {1e3 * LARGEST_MEDIAN_M:g} mm at the ball", f"{1e3 * median:.3g} mm"
            raise MeasurementError.of(
                "median error of readings at the best places", expected=expected, got=got, fix=fix
            )
        return (replace(devices, deviations=devices.open_deviations(data, shown)),)

    def around(self, data: Any, points: Tensor) -> Devices:
        """The devices where rows put them, that tell enough, see :func:`placed`."""
        return placed(data, points)


class Contacts(OtherDevices):
    """A ball in sockets, whose middles are found from any rows."""

    advice = "check the joint values, and the socket of every row (--socket)"

    def check(self, data: SocketReadings, model: Any) -> None:
        check_ball(model, "rows with a ball in sockets", "rows", "rows in sockets")
        if data.on is not None and data.on != model.on[-1]:
            fix = "name the tip of the model's ball (`with_tips`)"
            raise MeasurementError.of("the ball's tip", expected=f"'{model.on[-1]}'", got=f"'{data.on}'", fix=fix)

    def rare(self, data: SocketReadings) -> list[str]:
        return rare_names(data.device_names, data.line_numbers.tolist(), 2)

    def check_angles(self, data: SocketReadings, model: Any) -> None:
        """By the spread within sockets, relative to the motion of the tip, with which it shrinks."""
        if not model.ball:
            return
        turning = torch.tensor(model.robot.periodic, dtype=torch.bool, device=data.q.device)

        def share(q: Tensor) -> float:
            tips = model.robot.tip_poses(q)[..., 0, :3, 3]
            motion = float((tips - tips.mean(0)).square().sum(1).mean().sqrt())
            away = socket_errors(model(q).detach()[:, -1], data.device.to(q.device), data)[0].norm(dim=1)
            return float(away.nanmedian()) / max(motion, SMALLEST_MOTION_M)

        spread = share(data.q)
        for factor, fix in ANGLE_MISTAKES:
            other = share(torch.where(turning, factor * data.q, data.q))
            if other < REMAINING_SPREAD * spread:
                expected = f"a spread within sockets of {1e2 * other:.2g} % of the tip's motion, as in the other unit"
                raise MeasurementError.of("the joint values", expected=expected, got=f"{1e2 * spread:.2g} %", fix=fix)

    def place(self, data: SocketReadings, beside: Beside) -> Places:
        """The middles of the sockets, which :meth:`errors` finds."""
        count, lone = len(data.names), self.rare(data)
        texts = [f"the middles of {count} sockets were found from these rows"]
        if lone:
            what = f"{len(lone)} of {len(data)} rows show no error: they are alone in their socket, so its middle"
            texts.append(f"{what}: {few(lone)}")
        return Places(found=tuple(texts), numbers=NUMBERS_OF_A_SOCKET * count)

    def errors(self, data: SocketReadings, points: Tensor, places: Places) -> Evaluation:
        """Spread within sockets, and errors of known distances."""
        away, distances = socket_errors(points[:, -1], data.device.to(points.device), data)
        return replace(self._spread(data, away), distances=distances)

    def away(self, data: SocketReadings, points: Tensor, places: Places) -> Tensor:
        return socket_errors(points[:, -1], data.device.to(points.device), data)[0]

    def in_unit(self, data: SocketReadings, devices: Devices, errors: Tensor) -> Evaluation:
        return self._spread(data, errors.masked_fill(alone(data.device).to(errors.device)[:, None], torch.nan))

    def _spread(self, data: SocketReadings, away: Tensor) -> Evaluation:
        size, lines = away.norm(dim=1, keepdim=True), data.line_numbers
        return Evaluation(size, None, away[:, None], lines, what=SPREAD, kind=data.kind, devices=data.device_names)

    def around(self, data: SocketReadings, points: Tensor) -> Devices:
        return fitting_devices(data, points)


def of_devices(data: Any, names: Collection[str]) -> Any:
    """The rows of a table of the devices or set-ups of these names."""
    return data.rows([number for number, name in enumerate(data.device_names) if name in names])


SENSORS: dict[str, Sensor] = {"position": Positions(), "pose": Poses(), KIND: Contacts()}


def errors_of_kinds(errors: Tensor, coordinates: Coordinates | None, readings: Sequence[Any]) -> Evaluations:
    """Errors of rows of any kinds, laid out by coordinates and readings, kind by kind and in their own units.

    Args:
        errors: (N, R) m, NaN where nothing was measured; those of poses are of the points that represent each.
        coordinates: rows that tell coordinates, which are their first numbers.
        readings: sets of devices of readings, with their rows and where their numbers stand.
    """
    parts = list[tuple[Evaluation, Tensor]]()
    if coordinates is not None:
        sizes, table = errors[coordinates.rows].unflatten(1, (-1, 3)).norm(dim=2), coordinates.table
        parts.append((Evaluation(sizes, line_numbers=table.line_numbers, kind=table.kind), coordinates.rows))
    for part in readings:
        numbers = errors[part.rows[:, None], part.numbers]
        parts.append((sensor_of(part.data).in_unit(part.data, part.devices, numbers), part.rows))
    return Evaluations.of(parts)


def alone(socket: Tensor) -> Tensor:
    """(N,) boolean: rows in sockets of these numbers (N,) whose socket no other row shows."""
    return (torch.bincount(socket) == 1)[socket]


def check_shown(data: Any) -> None:
    """Raise MeasurementError for rows of any kinds that are all alone in their sockets: they show no error."""
    socket = data.socket_numbers
    if bool((socket != NO_SOCKET).all()) and bool(alone(socket).all()):
        got = f"{len(data)} rows, each of them alone in its socket, whose middle it is"
        fix = "rest in every socket at least twice, in different poses"
        raise MeasurementError.of("`data`", expected="rows that show an error", got=got, fix=fix)


def sensor_of(data: Any) -> Any:
    """The kind of a table of one kind of rows."""
    return SENSORS.get(data.kind, OtherDevices())


def check_ball(model: Any, what: str, of: str, needed: str) -> None:
    """Raise InputError for a model without a ball."""
    if not model.ball:
        fix = f"calibrate with {needed}; the marker of the model is not where the ball is"
        got = "one that was calibrated with measured positions"
        raise InputError.of(what, expected=f"a model of {of}", got=got, fix=fix)


def check_tips(data: Measurements, tips: tuple[str, ...]) -> None:
    """Raise MeasurementError if the measurements say that their points are on other tips than these of a model.

    Points whose tips are not named are those of the model, in its order.
    """
    if data.on is not None and data.on != tips:
        bodies = data.bodies
        what = f"the measurements' {bodies.many} are on other tips than the model's"
        expected, got = (listed(on[:: bodies.points]) for on in (tips, data.on))
        raise MeasurementError.of(what, expected=expected, got=got, fix=f"put the {bodies.many} in its order")


def marker_tips(robot: Tree, data: Measurements) -> tuple[str, ...]:
    """Names of the tips that carry the markers, one for each point of the measurements.

    Raises:
        MeasurementError: a tip that the robot does not have, or a robot with several tips and measurements that do not
            say on which of them their markers are.
    """
    bodies, body = data.bodies, "marker" if data.lever is None else "frame"
    if data.on is not None and not set(data.on) <= set(robot.tips):
        what, fix = f"`on`: the tips of robot '{robot.name}'", f"name the tip of every {body}"
        got = listed(data.on[:: bodies.points])
        raise MeasurementError.of(what, expected=f"names among {listed(robot.tips)}", got=got, fix=fix)
    if data.on is None and len(robot.tips) > 1:
        what = f"robot '{robot.name}' has {len(robot.tips)} tips ({listed(robot.tips)})"
        fix = f"pass Measurements{'.from_poses' * (data.lever is not None)}(..., on=[...]) with the tip of every {body}"
        what += f", and the measurements do not say on which of them their {bodies.many} are"
        raise MeasurementError.of(what, fix=fix)
    return data.on or (robot.tip,) * data.markers


def check_joint_order(robot: Tree, data: Any) -> None:
    """Raise InputError if the measurements name the robot's joints in another order, or only some of them."""
    names = data.joint_names or robot.joint_names
    if names != robot.joint_names and set(names) & set(robot.joint_names):
        what = f"the measurements' joints are not those of robot '{robot.name}'"
        fix = joint_name_fix(robot, names)
        raise InputError.of(what, expected=listed(robot.joint_names), got=listed(names), fix=fix)


def check_payload_link(link: str, data: Any) -> None:
    """Raise MeasurementError for payloads at another link than that of a model's fit; "" for a model without."""
    place = None if data.payload is None else data.payload_at
    if link and place is not None and place != link:
        fix = "leave these rows out, or calibrate with the payload there"
        raise MeasurementError.of("the payload of the measurements", expected=f"at '{link}'", got=f"'{place}'", fix=fix)


def joint_name_fix(robot: Tree, names: Sequence[str]) -> str:
    """What to do about joints of other names than the robot's, or in another order."""
    if set(names) == set(robot.joint_names):
        return "put the columns in the robot's order"
    return (
        "if they are the robot's joints in order, read the table with the robot and its columns "
        "(`read_measurements(file, robot, ..., joints=[...])`), rename the columns, or name the joints of a DH table "
        "after them (`from_dh(..., names=[...])`)"
    )
