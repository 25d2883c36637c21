"""Sensors for planned poses: a tracker, or devices in new places, and what each would show of a model's points.

A measurement at x shows, to first order, A z(x) + D c + noise: A the slope of what is reported by the coordinates z of
the model's points, c ~ N(0, I) what is not known about the devices.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.planning.candidates import Criterion
from diffeo_calib.common.checks import as_tensor, check_number
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.device_readings import FittedDevice
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.regression.conditional import Conditional, without_rigid_motions
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.sensors.devices import Devices
from diffeo_calib.sensors.kinds import WITHOUT_READINGS, known_kinds
from diffeo_calib.sensors.set_ups import frame_slopes


class Scene(NamedTuple):
    """M configurations as a robot or model has them, and what is known there before the first measurement."""

    known: Conditional  # the conditional
    at: Linearisation  # the configurations
    first: int  # number of the first new column
    points: Tensor  # (M, m) coordinates of the markers, m
    noise: Tensor  # (M, m, m) covariance of one measurement of them, m^2
    base: Tensor  # (4, 4) the robot's base in their frame, m
    averaged: Tensor  # (r, m) the markers, or the origins of measured poses
    seen: int  # the first coordinates, of points that a device of positions sees
    free: bool = False  # whether nothing says where the robot stands in the frame of a measuring device
    shifts: int = 0  # number c0 of the shifts that rows of the fit shared

    @property
    def motions(self) -> list[int]:
        """Numbers of the columns by motions of the base."""
        return list(self.at.spec.nominal.places[:6])

    def without_motions(self, known: Conditional, targets: Tensor) -> Conditional:
        """Without the rigid motion that fits the errors at the targets best, where such motions are no errors."""
        return without_rigid_motions(known, self.at.rows(targets), self.motions) if self.free else known

    def along(self, blocks: Tensor) -> Tensor:
        """Covariances of the markers, or of the origins of poses, from those of the points: (M, m, m) -> (M, r, r)."""
        return self.averaged @ blocks @ self.averaged.mT

    @property
    def last(self) -> Tensor:
        """(3, m) the ball: the last marker, or the origin of the last measured pose."""
        return self.averaged[-3:]

    def seen_by(self, devices: Devices) -> Tensor:
        """(3 k, m) what devices of readings see: the ball, or the points of the last measured pose."""
        whole = torch.eye(self.points.shape[1], dtype=self.points.dtype, device=self.points.device)
        return self.last if devices.seen_points == 1 else whole[-3 * devices.seen_points :]

    @property
    def framed(self) -> bool:
        """Whether the points represent frames."""
        return len(self.averaged) < self.points.shape[1]


class Where(NamedTuple):
    """Configurations that can be measured: arguments of :func:`candidates`."""

    keep: Criterion
    ranges: dict[str, tuple[float, float]]


class Options(NamedTuple):
    """Measurements that can be made: O of them."""

    rows: Tensor  # (O,) numbers of the configurations
    slopes: Tensor  # (O, r, m) A
    shared: Tensor  # (O, r, c) D, the c0 shifts of the fit first
    noise: Tensor  # (O, r, r), m^2
    device: Tensor  # (O,) numbers of the devices
    names: tuple[str, ...]  # of the devices

    @classmethod
    def joined(cls, parts: Sequence[Options], shifts: int) -> Options:
        """All of them; what some do not report is noise of 1 m that nothing moves. ``shifts``: c0."""
        r, c = max(part.slopes.shape[1] for part in parts), sum(part.shared.shape[2] - shifts for part in parts)
        found, before, devices, names = [], 0, 0, tuple[str, ...]()
        for part in parts:
            rows, (more, own) = len(part.rows), (r - part.slopes.shape[1], part.shared.shape[2] - shifts)
            added = torch.nn.functional.pad(part.shared[..., shifts:], (before, c - before - own))
            shared = torch.nn.functional.pad(torch.cat([part.shared[..., :shifts], added], 2), (0, 0, 0, more))
            noise = torch.nn.functional.pad(part.noise, (0, more, 0, more))
            absent = torch.arange(r, device=noise.device)[None, r - more :].expand(rows, -1)
            noise[torch.arange(rows, device=noise.device)[:, None], absent, absent] = 1.0
            slopes = torch.nn.functional.pad(part.slopes, (0, 0, 0, more))
            found.append((part.rows, slopes, shared, noise, part.device + devices))
            before, devices, names = before + own, devices + len(part.names), names + part.names
        return cls._make([*(torch.cat(values) for values in zip(*found, strict=True)), names])

    def linearised(self, scene: Scene) -> Linearisation:
        """What they report, with columns by the shifts of the fit, and by new ones."""
        told = scene.at.rows(self.rows).projected(self.slopes)
        told = told.with_columns(self.shared[..., : scene.shifts], len(scene.at.spec.prior_variance))
        return told.with_columns(self.shared[..., scene.shifts :], scene.first)

    def some(self, index: Tensor) -> Options:
        """Some of them."""
        return Options._make([*(part[index] for part in self[:5]), self.names])


@dataclass(frozen=True)
class Sensor(ABC):
    """Sensors for planned poses; see the constructors :meth:`positions` to :meth:`sockets`.

    Places are in the robot's base frame, m, and need not be exact: the plan takes them as unknown by 0.1 m.

    Args:
        std: standard deviation of what one row shows, the robot's repeatability included, m at the point; by default
            that of the model's rows.
    """

    std: float | None = None
    of_positions: ClassVar[bool] = False
    """Whether errors of held-out rows are errors of positions."""

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
        return DeviceReadings.of("socket", places, std)

    @abstractmethod
    def options(self, scene: Scene) -> Options:
        """The measurements that can be made at some configurations."""

    def places_in(self, base: Tensor) -> Tensor | None:
        """(D, 3) places in the robot's base to which the ball must be brought, m; None if anywhere will do.

        Args:
            base: (4, 4) the base in the frame of the model's positions, m.
        """
        return None

    def where(self, model: CalibratedKinematics) -> Where | None:
        """Where it can measure, for :func:`candidates`; None if nothing is known of that before.

        Args:
            model: of the fit that the sensor belongs to.
        """
        return None

    def sentences(self) -> list[str]:
        """Where devices with names are, new ones in the robot's base, those of a fit in the frame of its positions."""
        return []

    @property
    def of_frames(self) -> bool:
        """Whether it measures frames, not markers."""
        return False

    @staticmethod
    def _new(scene: Scene, shared: Tensor) -> Tensor:
        """Effects (O, r, c) of new shifts after none of those of the fit: (O, r, c0 + c)."""
        return torch.nn.functional.pad(shared, (scene.shifts, 0))

    def beside_others(self) -> Sensor:
        """The same for a model whose rows no device of positions measured, for which it is a new one."""
        return self

    def _noise(self, scene: Scene, rows: Tensor, slopes: Tensor) -> Tensor:
        """Covariance (O, r, r) of what rows show, m^2."""
        if self.std is None:
            return slopes @ scene.noise[rows] @ slopes.mT
        eye = torch.eye(slopes.shape[1], dtype=slopes.dtype, device=slopes.device)
        return (self.std**2 * eye).expand(len(rows), -1, -1)


@dataclass(frozen=True)
class Positions(Sensor):
    """Positions of the markers, or poses."""

    whole: bool = False  # whether poses of frames are measured, or their origins
    new: bool = False  # whether by a device of no row of the model
    of_positions: ClassVar[bool] = True

    def beside_others(self) -> Sensor:
        """See :meth:`Sensor.beside_others`."""
        return replace(self, new=True)

    @property
    def of_frames(self) -> bool:
        """Poses."""
        return self.whole

    def options(self, scene: Scene) -> Options:
        """At every configuration. The place of a new device is unknown, and where nothing says where the robot is."""
        N, m = scene.points.shape
        if self.whole and not scene.framed:
            fix = "mark the tool by three points or a frame: a single point shows no turn about itself"
            raise InputError.of("poses of a robot that is known by markers", expected="measured frames", fix=fix)
        every = torch.eye(m, dtype=scene.points.dtype, device=scene.points.device)
        slopes = (every if self.whole else scene.averaged[: scene.seen]).expand(N, -1, -1)
        shared = slopes.new_zeros(N, m, 0)
        if scene.free or self.new:
            points = scene.points.view(N, -1, 3)
            shared = PLACES.found_m_rad * frame_slopes(points, points.mean((0, 1)))
        rows = torch.arange(N, device=slopes.device)
        noise = self._noise(scene, rows, slopes)
        name = "poses" if self.whole else "positions"
        return Options(rows, slopes, self._new(scene, slopes @ shared), noise, torch.zeros_like(rows), (name,))


@dataclass(frozen=True)
class DeviceReadings(Sensor):
    """Readings of the ball, of one kind."""

    # where they are, in the robot's base frame
    devices: Devices = None  # pyright: ignore[reportAssignmentType]  # always given
    # what a fit knows of the only one, which is in the frame of the model's positions; None for new devices
    fitted: FittedDevice | None = None

    @classmethod
    def of(cls, kind: str, numbers: object, std: float | None, offset_std: float = 0.0) -> DeviceReadings:
        """Devices that a user describes, see :attr:`Devices.stated_as`."""
        own: Any = {**known_kinds(), **WITHOUT_READINGS}[kind]
        count = own.stated_as.count(",") + 1
        given = as_tensor(numbers, f"devices of {kind}s", ("D", count), fix=f"pass {own.stated_as} of each, in m")
        constants = own.stated(given)
        if not bool(constants.isfinite().all()):
            expected = f"{own.stated_as} with a direction"
            raise InputError.of(f"devices of {kind}s", expected=expected, got=as_written(given.tolist()))
        names = tuple(f"{kind} {number}" for number in range(1, len(given) + 1))
        prior = constants.new_tensor(own.prior(offset_std)).expand(len(names), -1)
        return cls(std, own(names, constants, prior))

    def sentences(self) -> list[str]:
        """One for each."""
        return [f"{name}: {self.devices.where(number)}" for number, name in enumerate(self.devices.names)]

    def places_in(self, base: Tensor) -> Tensor | None:
        """See :meth:`Sensor.places_in`."""
        places = self.devices.places
        return places if places is None or self.fitted is None else (places - base[:3, 3]) @ base[:3, :3]

    def options(self, scene: Scene) -> Options:
        """Every device at the configurations in which it sees the tool."""
        columns = None if self.fitted is None else self.fitted.columns
        base = scene.base if self.fitted is None else torch.eye(4, dtype=scene.base.dtype, device=scene.base.device)
        last = scene.seen_by(self.devices)
        points = (scene.points @ last.mT).unflatten(1, (-1, 3)) - base[:3, 3]
        points, turn = (points @ base[:3, :3]).flatten(1), torch.block_diag(*[base[:3, :3].mT] * points.shape[1])
        count = len(self.devices.names)
        rows = torch.arange(len(points), device=points.device).repeat_interleave(count)
        device = torch.arange(count, device=points.device).repeat(len(points))
        seen = self.devices.sees(points[rows], device)
        rows, device = rows[seen], device[seen]
        slopes = self.devices.observation(device).slope(points[rows]) @ turn @ last
        if self.fitted is None or columns is None:
            shared = self._new(scene, self.devices.shared(points[rows], device))
        else:
            shared = slopes.new_zeros(*slopes.shape[:2], scene.shifts)
            shared[..., columns] = self.fitted.by_increments(points[rows]) @ self.fitted.root
        return Options(rows, slopes, shared, self._noise(scene, rows, slopes), device, self.devices.names)

    def _noise(self, scene: Scene, rows: Tensor, slopes: Tensor) -> Tensor:
        """Covariance (O, r, r) of readings, m^2."""
        if self.std is None and self.fitted is not None and self.fitted.noise is not None:
            return self.fitted.noise.expand(len(rows), -1, -1)
        return super()._noise(scene, rows, slopes)
