"""What will measure planned poses: a tracker, or devices in new places, and what each would show of a model's points.

A measurement at x shows, to first order, A z(x) + D c + noise: A the slope of what is reported by the coordinates z of
the model's points, c ~ N(0, I) what is not known about the devices.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.hyperparameters import PLACE_DEVIATION
from diffeo_calib.common.checks import as_tensor, check_number
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.re_registration.registered_map import frame_slopes
from diffeo_calib.sensors.devices import PLACE_DEVIATION_M, Devices
from diffeo_calib.sensors.kinds import KINDS

IN_SOCKET_M = 0.02
"""Largest distance of the ball from the stated place of a socket: the place is stated roughly."""
SAME_SOCKET_M = 0.005
"""Distance below which two rows of a fit rested in one socket."""
MOST_NUMBERS = 2
"""Of a reading; rows that report more tell coordinates."""


class Scene(NamedTuple):
    """M configurations as a robot or model has them.

    Args:
        points: (M, m) coordinates of the markers, m.
        noise: (M, m, m) covariance of one measurement of them, m^2.
        base: (4, 4) the robot's base in their frame, m.
        averaged: (r, m) the origins of measured poses; None for markers.
        ball: whether the last marker is a ball whose position no device measured.
        free: whether nothing says where the robot stands in the frame of a measuring device.
    """

    points: Tensor
    noise: Tensor
    base: Tensor
    averaged: Tensor | None = None
    ball: bool = False
    free: bool = False

    @property
    def last(self) -> Tensor:
        """(3, m) the ball: the last marker, or the origin of the last measured pose."""
        if self.averaged is not None:
            return self.averaged[-3:]
        return torch.eye(self.points.shape[1], dtype=self.points.dtype, device=self.points.device)[-3:]


class Options(NamedTuple):
    """Measurements that can be made: O of them.

    Args:
        rows: (O,) numbers of the configurations. slopes: (O, r, m) A. shared: (O, r, c) D. noise: (O, r, r), m^2.
        device: (O,) numbers of the devices. names: of the devices.
    """

    rows: Tensor
    slopes: Tensor
    shared: Tensor
    noise: Tensor
    device: Tensor
    names: tuple[str, ...]

    @classmethod
    def joined(cls, parts: Sequence[Options]) -> Options:
        """All of them; what some do not report is noise of 1 m that nothing moves."""
        r, c = max(part.slopes.shape[1] for part in parts), sum(part.shared.shape[2] for part in parts)
        found, before, devices, names = [], 0, 0, tuple[str, ...]()
        for part in parts:
            rows, (more, own) = len(part.rows), (r - part.slopes.shape[1], part.shared.shape[2])
            shared = torch.nn.functional.pad(part.shared, (before, c - before - own, 0, more))
            noise = torch.nn.functional.pad(part.noise, (0, more, 0, more))
            absent = torch.arange(r, device=noise.device)[None, r - more :].expand(rows, -1)
            noise[torch.arange(rows, device=noise.device)[:, None], absent, absent] = 1.0
            slopes = torch.nn.functional.pad(part.slopes, (0, 0, 0, more))
            found.append((part.rows, slopes, shared, noise, part.device + devices))
            before, devices, names = before + own, devices + len(part.names), names + part.names
        return cls(*(torch.cat(values) for values in zip(*found, strict=True)), names)

    def some(self, index: Tensor) -> Options:
        """Some of them."""
        return Options(*(part[index] for part in self[:5]), self.names)


@dataclass(frozen=True)
class Sensor(ABC):
    """What will measure the planned poses; see the constructors :meth:`positions` to :meth:`sockets`.

    Places are in the robot's base frame, m, and need not be exact: the plan takes them as unknown by 0.1 m.

    Args:
        std: standard deviation of what one row shows, the robot's repeatability included, m at the point; by default
            that of the model's rows.
    """

    std: float | None = None

    def __post_init__(self) -> None:
        if self.std is not None:
            check_number(self.std, "`std` of a sensor, in m", above=0.0)

    @staticmethod
    def positions(std: float | None = None) -> Sensor:
        """A tracker that measures positions of the markers."""
        return Positions(std)

    @staticmethod
    def poses(std: float | None = None) -> Sensor:
        """A device that measures poses, for models of poses."""
        return Positions(std, whole=True)

    @staticmethod
    def distances(points: object, std: float | None = None, *, offset_std: float = 0.0) -> Sensor:
        """Distances of the ball from fixed points (D, 3), m; ``offset_std``: of an unknown zero, m."""
        return DeviceReadings.of("distance", points, std, offset_std)

    @staticmethod
    def heights(planes: object, std: float | None = None) -> Sensor:
        """Heights of the ball above planes (D, 4): normal, and distance from the base along it, m."""
        return DeviceReadings.of("height", planes, std)

    @staticmethod
    def images(cameras: object, std: float | None = None) -> Sensor:
        """The ball in images of cameras (D, 6): place, and a point that each looks at, m."""
        return DeviceReadings.of("image", cameras, std)

    @staticmethod
    def sockets(places: object, std: float | None = None) -> Sensor:
        """The ball in sockets at places (D, 3), m; only configurations that bring it there can be measured."""
        return InSockets(std, as_tensor(places, "places", ("D", 3), fix="pass x, y, z of every socket, in m"))

    @abstractmethod
    def options(self, scene: Scene) -> Options:
        """The measurements that can be made at some configurations."""

    @property
    def places(self) -> Tensor | None:
        """(D, 3) places in the robot's base frame to which the ball must be brought, m; None if anywhere will do."""
        return None

    @property
    def of_positions(self) -> bool:
        """Whether errors of held-out rows are errors of positions."""
        return False

    def _noise(self, scene: Scene, rows: Tensor, slopes: Tensor) -> Tensor:
        """Covariance (O, r, r) of what rows show, m^2."""
        if self.std is None:
            return slopes @ scene.noise[rows] @ slopes.mT
        eye = torch.eye(slopes.shape[1], dtype=slopes.dtype, device=slopes.device)
        return (self.std**2 * eye).expand(len(rows), -1, -1)


@dataclass(frozen=True)
class Positions(Sensor):
    """Positions of the markers, or poses.

    Args:
        whole: whether poses of frames are measured, or their origins.
    """

    whole: bool = False

    def options(self, scene: Scene) -> Options:
        """At every configuration. Where nothing says where the robot stands, the place of the device is unknown."""
        N, m = scene.points.shape
        if self.whole and scene.averaged is None:
            fix = "mark the tool by three points or a frame: a single point shows no turn about itself"
            raise InputError.of("poses of a robot that is known by markers", expected="measured frames", fix=fix)
        slopes = torch.eye(m, dtype=scene.points.dtype, device=scene.points.device)
        if scene.averaged is not None and not self.whole:
            slopes = scene.averaged
        elif scene.ball and not scene.free and m > 3:  # devices see the other markers
            slopes = slopes[:-3]
        slopes = slopes.expand(N, -1, -1)
        shared = slopes.new_zeros(N, m, 0)
        if scene.free:
            points = scene.points.view(N, -1, 3)
            shared = PLACE_DEVIATION * frame_slopes(points, points.mean((0, 1)))
        rows = torch.arange(N, device=slopes.device)
        noise = self._noise(scene, rows, slopes)
        name = "poses" if self.whole else "positions"
        return Options(rows, slopes, slopes @ shared, noise, torch.zeros_like(rows), (name,))

    @property
    def of_positions(self) -> bool:
        """Of markers or origins."""
        return True


@dataclass(frozen=True)
class DeviceReadings(Sensor):
    """Readings of the ball, of one kind.

    Args:
        devices: where they are. in_base: in the robot's base frame, or in the frame of the model's positions.
    """

    devices: Devices = None  # pyright: ignore[reportAssignmentType]  # always given
    in_base: bool = True

    @classmethod
    def of(cls, kind: str, numbers: object, std: float | None, offset_std: float = 0.0) -> DeviceReadings:
        """Devices that a user describes, see :attr:`Devices.stated_as`."""
        own = KINDS[kind]
        count = own.stated_as.count(",") + 1
        given = as_tensor(numbers, f"devices of {kind}s", ("D", count), fix=f"pass {own.stated_as} of each, in m")
        constants = own.stated(given)
        if not bool(constants.isfinite().all()):
            expected = f"{own.stated_as} with a direction"
            raise InputError.of(f"devices of {kind}s", expected=expected, got=as_written(given.tolist()))
        names = tuple(f"{kind} {number}" for number in range(1, len(given) + 1))
        return cls(std, own(names, constants, constants.new_tensor(own.prior(offset_std))))

    def options(self, scene: Scene) -> Options:
        """Every device at the configurations in which it sees the ball."""
        base = scene.base if self.in_base else torch.eye(4, dtype=torch.float64, device=scene.points.device)
        points = ((scene.points @ scene.last.mT) - base[:3, 3]) @ base[:3, :3]
        count = len(self.devices.names)
        rows = torch.arange(len(points), device=points.device).repeat_interleave(count)
        device = torch.arange(count, device=points.device).repeat(len(points))
        seen = self.devices.sees(points[rows], device)
        rows, device = rows[seen], device[seen]
        slopes = self.devices.observation(device).slope(points[rows]) @ base[:3, :3].mT @ scene.last
        shared = self.devices.shared(points[rows], device)
        return Options(rows, slopes, shared, self._noise(scene, rows, slopes), device, self.devices.names)


@dataclass(frozen=True)
class InSockets(Sensor):
    """The ball in sockets.

    Args:
        at: (D, 3) their places, m. in_base: in the robot's base frame, or in the frame of the model's positions.
    """

    at: Tensor = None  # pyright: ignore[reportAssignmentType]  # always given
    in_base: bool = True

    @property
    def places(self) -> Tensor | None:
        """See :attr:`Sensor.places`."""
        return self.at

    def options(self, scene: Scene) -> Options:
        """Every configuration that brings the ball to a socket."""
        places = self.at.to(scene.points)
        if self.in_base:
            places = places @ scene.base[:3, :3].mT + scene.base[:3, 3]
        near = torch.cdist(scene.points @ scene.last.mT, places)
        rows = (near.amin(1) < IN_SOCKET_M).nonzero()[:, 0]
        device = near[rows].argmin(1)
        slopes = scene.last.expand(len(rows), -1, -1)
        whose = torch.nn.functional.one_hot(device, len(places)).to(slopes)
        eye = PLACE_DEVIATION_M * torch.eye(3, dtype=slopes.dtype, device=slopes.device)
        shared = (whose[:, None, :, None] * eye[None, :, None]).flatten(2)
        names = tuple(f"socket {number}" for number in range(1, len(places) + 1))
        return Options(rows, slopes, shared, self._noise(scene, rows, slopes), device, names)


def sensor_of(model: CalibratedKinematics) -> tuple[Sensor, ...]:
    """What the rows of a model were measured with, found anew: devices of readings and sockets in unknown places.

    Read off the map, which keeps the slopes of its rows and the effects of its devices.
    """
    if not model.ball:
        return (Positions(whole=model.lever is not None),)
    with_device = [] if model.map.workspace is not None else [Positions(whole=model.lever is not None)]
    if model.map.slopes is None:
        return (*with_device, InSockets(None, _sockets(model), in_base=False))
    return (*with_device, *_readings(model))


def _sockets(model: CalibratedKinematics) -> Tensor:
    """(D, 3) places of the sockets of a fit: where the ball comes to rest more than once, m."""
    own = model.map.noise.visible[:, -3:].all(1)
    left, found = model(model.configurations).detach()[own, -1], []
    while len(left):
        near = (left - left[0]).norm(dim=1) < SAME_SOCKET_M
        if int(near.sum()) > 1:
            found.append(left[near].mean(0))
        left = left[~near]
    return torch.stack(found)


def _readings(model: CalibratedKinematics) -> list[DeviceReadings]:
    """The devices of readings of a fit, one by one."""
    fitted, found = model.map, []
    if fitted.slopes is None:
        return found
    ball, visible = model(model.configurations).detach()[:, -1], fitted.noise.visible
    device = (fitted.noise.shared != 0).any(1)  # (N, c) whose unknowns change a row
    device[visible.sum(1) > MOST_NUMBERS] = False  # coordinates
    for own in device[device.any(1)].unique(dim=0):
        rows = (device == own).all(1)
        numbers = visible[rows][0].nonzero()[:, 0]
        kind = next(kind for kind in KINDS.values() if len(kind.prior()) == int(own.sum()))
        slopes = fitted.slopes[rows][:, numbers, -3:]
        deviation = float(fitted.noise.shared[rows][:, numbers][..., own][0, -1, -1])
        constants = kind.stated(kind.seen_by(slopes, ball[rows])[None])
        deviations = constants.new_tensor(kind.prior(deviation))
        devices = kind((f"{kind.kind} {len(found) + 1}",), constants, deviations)
        found.append(DeviceReadings(None, devices, in_base=False))
    return found
