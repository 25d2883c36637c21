"""Sensors for planned poses: a tracker, devices in new places, or those of a model where its fit found them.

A measurement at x shows, to first order, A z(x) + D c + noise: A the slope of what is reported by the coordinates z of
the model's points, c ~ N(0, I) what is not known about the devices: new unknowns, or shifts that rows of a fit share.

An image of a board tells the pose of the board in the camera with an error of its own, far larger along the line of
sight, and one that all images share, of lens and board (cameras/images.py). Both depend on the pose. The arm is not
seen: it may hide the board.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from diffeo_calib.calibration.planning.candidates import ranges_around
from diffeo_calib.calibration.planning.scene import Scene, View, without_positions
from diffeo_calib.cameras.images import expected, sees
from diffeo_calib.common.checks import as_tensor, check_number
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.device_readings import FittedDevice
from diffeo_calib.kinematics.hand_eye import SetUp
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.measurements.poses import inverse_poses, pose_jacobian, poses_from_marks
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.board_camera import BoardCamera
from diffeo_calib.sensors.kinds import known_kinds
from diffeo_calib.sensors.set_ups import TRANSFORMS, frame_slopes

NEW = -1  # number of an unknown that the scene does not have
SMALLEST_REST_M = 1e-6


class DeviceRows(NamedTuple):
    """Measurements of one device at O configurations of a view."""

    device: str
    rows: Tensor  # (O,) numbers of the configurations
    slopes: Tensor  # (O, r, m) A
    effects: Tensor  # (O, r, k) D
    columns: Tensor  # (k,) numbers of these unknowns among those of the scene, or NEW
    noise: Tensor  # (O, r, r) m^2


class Options(NamedTuple):
    """Measurements by several devices: O of them."""

    rows: Tensor  # (O,) numbers of the configurations
    at: Linearisation  # what they report, with columns by all unknowns
    noise: Tensor  # (O, r, r) m^2
    devices: list[str]  # O names

    @classmethod
    def of(cls, scene: Scene, view: View, parts: Sequence[DeviceRows]) -> Options:
        """Join rows of all sensors; what some do not report is noise of 1 m that nothing moves."""
        r, first, ats, noises = max(part.slopes.shape[1] for part in parts), scene.columns, [], []
        width = first + sum(int((part.columns == NEW).sum()) for part in parts)
        for part in parts:
            new, (count, size) = part.columns == NEW, part.slopes.shape[:2]
            columns = torch.where(new, first - 1 + new.cumsum(0), part.columns)
            first += int(new.sum())
            if count:
                at = view.at.rows(part.rows).projected(pad(part.slopes, (0, 0, 0, r - size)))
                S = pad(at.sensitivity, (0, width - at.sensitivity.shape[2]))
                S[:, :size].index_add_(2, columns, part.effects)
                ats.append(replace(at, sensitivity=S))
                noises.append(torch.eye(r, dtype=S.dtype, device=S.device).repeat(count, 1, 1))
                noises[-1][:, :size, :size] = part.noise
        rows, names = torch.cat([part.rows for part in parts]), [part.device for part in parts for _ in part.rows]
        return cls(rows, Linearisation.joined(ats), torch.cat(noises), names)


@dataclass(frozen=True)
class Sensor(ABC):
    """Sensors for planned poses; see the constructors :meth:`positions` to :meth:`sockets`.

    Places are in the robot's base frame, m, and need not be exact: the plan takes them as unknown by 0.1 m.

    Args:
        std: standard deviation of what one row shows, the robot's repeatability included, m at the point; by default
            that of the model's rows.
    """

    std: float | None = None
    of_frames: bool = False  # whether it measures frames, not markers or their origins
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
        return Positions(std, of_frames=True)

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
    def measured(self, scene: Scene, view: View) -> Iterator[DeviceRows]:
        """What each of its devices can measure of a view."""

    def reached(self, base: Tensor) -> dict[str, Any]:
        """Where it can measure, as arguments of :func:`candidates`; none if that is not known before, or anywhere.

        Args:
            base: (4, 4) the robot's base in the frame of the model's positions, m.
        """
        return {}

    def sentences(self) -> list[str]:
        """Where devices with names are, new ones in the robot's base, those of a fit in the frame of its positions."""
        return []

    def _noise(self, usual: Tensor) -> Tensor:
        """Covariance (O, r, r) of what rows show, the usual one by default, m^2."""
        if self.std is None:
            return usual
        return self.std**2 * torch.eye(usual.shape[1], dtype=usual.dtype, device=usual.device).expand_as(usual)


@dataclass(frozen=True)
class Positions(Sensor):
    """Positions of the markers, or poses."""

    of_positions: ClassVar[bool] = True

    def measured(self, scene: Scene, view: View) -> Iterator[DeviceRows]:
        """At every configuration. The place of the device is unknown where it is new, or nothing shows the robot's."""
        if self.of_frames and not scene.framed:
            fix = "mark the tool by three points or a frame: a single point shows no turn about itself"
            raise InputError.of("poses of a robot that is known by markers", expected="measured frames", fix=fix)
        every = torch.eye(view.points.shape[1], dtype=view.points.dtype, device=view.points.device)
        A = (every if self.of_frames else scene.averaged[: scene.seen]).expand(len(view.points), -1, -1)
        points, numbers = view.points.unflatten(1, (-1, 3)), 6 * (scene.free or scene.unplaced)
        moved = A @ (PLACES.found_m_rad * frame_slopes(points, points.mean((0, 1))))[..., :numbers]
        rows, name = torch.arange(len(points), device=A.device), "poses" if self.of_frames else "positions"
        noise, columns = self._noise(A @ view.noise @ A.mT), rows.new_full((numbers,), NEW)
        yield DeviceRows(name, rows, A, moved, columns, noise)


@dataclass(frozen=True)
class DeviceReadings(Sensor):
    """Readings of the ball, or of a frame, of one kind.

    Args:
        devices: each by its name, new ones with the deviations of their prior.
        new: whether they are in the robot's base frame, not in that of the model's positions.
    """

    devices: Mapping[str, FittedDevice] = field(default_factory=dict)
    new: bool = True

    @classmethod
    def of(cls, kind: str, numbers: object, std: float | None, offset_std: float = 0.0) -> DeviceReadings:
        """Devices that a user describes, see :attr:`Devices.stated_as`."""
        family: Any = known_kinds()[kind]
        count = family.stated_as.count(",") + 1
        given = as_tensor(numbers, f"devices of {kind}s", ("D", count), fix=f"pass {family.stated_as} of each, in m")
        constants = family.stated(given)
        if not bool(constants.isfinite().all()):
            expected = f"{family.stated_as} with a direction"
            raise InputError.of(f"devices of {kind}s", expected=expected, got=as_written(given.tolist()))
        names, prior = (
            [f"{kind} {number}" for number in range(1, len(given) + 1)],
            given.new_tensor(family.prior(offset_std)),
        )
        devices = (family((name,), each[None], prior[None]) for name, each in zip(names, constants, strict=True))
        return cls(std, devices={device.names[0]: FittedDevice(device, torch.diag(prior)) for device in devices})

    def sentences(self) -> list[str]:
        """One for each."""
        return [f"{name}: {device.devices.where(0)}" for name, device in self.devices.items()]

    def reached(self, base: Tensor) -> dict[str, Any]:
        """Where the ball must be brought."""
        held = torch.cat([device.devices.places for device in self.devices.values()])
        held = held if self.new else (held - base[:3, 3]) @ base[:3, :3]
        return {"places": held} if len(held) else {}

    def measured(self, scene: Scene, view: View) -> Iterator[DeviceRows]:
        """Every device at the configurations in which it sees the tool: the ball, or the last measured frames."""
        base = scene.base if self.new else torch.eye(4, dtype=scene.base.dtype, device=scene.base.device)
        whole = torch.eye(view.points.shape[1], dtype=base.dtype, device=base.device)
        for name, device in self.devices.items():
            count = device.devices.seen_points
            last = scene.averaged[-3:] if count == 1 else whole[-3 * count :]
            points = (((view.points @ last.mT).unflatten(1, (-1, 3)) - base[:3, 3]) @ base[:3, :3]).flatten(1)
            number = torch.zeros(len(points), dtype=torch.int64, device=points.device)
            rows = device.devices.sees(points, number).nonzero()[:, 0]
            points, to_seen = points[rows], torch.block_diag(*[base[:3, :3].mT] * count) @ last
            A = device.devices.observation(number[rows]).slope(points) @ to_seen
            usual = A @ view.noise[rows] @ A.mT if device.noise is None else device.noise.expand(len(rows), -1, -1)
            columns = rows.new_full((device.root.shape[1],), NEW)
            if device.columns is not None:
                columns = len(view.at.spec.prior_variance) + device.columns.nonzero()[:, 0]
            effects = device.by_increments(points) @ device.root
            yield DeviceRows(name, rows, A, effects, columns, self._noise(usual))


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardImages(Sensor):
    """Images of the board by one camera of a fit, where it stood last."""

    model: CalibratedKinematics
    name: str  # of the camera
    camera: BoardCamera  # lens, board and what its images showed
    set_up: SetUp  # of its last session
    rows: Tensor  # (M,) of the fit in that session

    @classmethod
    def last(cls, model: CalibratedKinematics, name: str, camera: BoardCamera, rows: Tensor) -> BoardImages:
        """Of a camera that measured these rows (M,) of the fit, in its last session.

        Where no row says it, in its last set-up, by a recalibration; in the model's place where it was registered.
        """
        sets = [group for group in model.placement if group.kind in TRANSFORMS and model.registration is None]
        session = next((word for group in sets for word in reversed(group.names) if word.split("/")[0] == name), None)
        for group in sets:
            here = torch.isin(group.rows, rows)
            if bool(here.any()):
                number = int(group.device[here][group.rows[here].argmax()])
                session, rows = group.names[number], rows[torch.isin(rows, group.rows[group.device == number])]
                break
        return cls(model=model, name=name, camera=camera, set_up=SetUp.of(model, session), rows=rows)

    @cached_property
    def lens(self) -> tuple[Tensor, Tensor, Tensor]:
        """What unknowns of unit variance do to lens and board (14, c), their columns (c,), and further noise (9, 9).

        The unknowns are the shifts of the fit; new ones beside a registration, and for images that its poses do not
        explain. The noise is that of a pose beyond that of its corners, m^2.
        """
        fitted, rows, root = self.model.map, self.rows, self.camera.camera.root
        little = SMALLEST_REST_M**2 * torch.eye(9, dtype=root.dtype, device=root.device)
        new = root, torch.full_like(root[0], NEW, dtype=torch.int64), little
        if self.model.registration is not None or not len(rows):
            return new
        of_corners, by_lens = self.tells(self.model(self.model.configurations[rows]).detach().flatten(1))
        if not bool(by_lens.isfinite().all()):  # it was seen from other places since
            return new
        of_fit = fitted.noise.shared[rows][:, :9].clone()
        of_fit[..., self.set_up.columns] = 0.0
        effects = torch.linalg.lstsq(by_lens.flatten(0, 1), of_fit.flatten(0, 1), driver="gelsd").solution
        beyond = (fitted.noise.covariance[rows][:, :9, :9] - of_corners).median(0).values
        values, axes = torch.linalg.eigh(0.5 * (beyond + beyond.mT))
        first = len(fitted.geodesic.spec.prior_variance)
        columns = first + torch.arange(effects.shape[1], device=effects.device)
        return effects, columns, (axes * values.clamp(min=SMALLEST_REST_M**2)) @ axes.mT

    def boards(self, points: Tensor) -> Tensor:
        """Poses (M, 4, 4) of the board in the camera's frame by the model's points (M, 9), m."""
        poses = self.set_up.view(poses_from_marks(points.unflatten(1, (3, 3)), self.model.bodies.pose_lever()))
        return inverse_poses(poses) if self.camera.on_tool else poses

    def reached(self, base: Tensor) -> dict[str, Any]:
        """By the rigid kinematics, which is quick, and not far beyond the joints of the fit."""
        camera, geometry = self.camera.camera, self.model.geometry
        ranges = ranges_around(self.model.robot, self.model.configurations)
        return {"keep": lambda q: sees(camera, self.boards(geometry.points(q).flatten(1))), "ranges": ranges}

    def tells(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Covariances (O, 9, 9), m^2, of images of points (O, 9), m, and effects (O, 9, 14) of lens and board."""
        boards, lever = self.boards(points), self.model.bodies.pose_lever()
        covariance, effects = expected(self.camera.camera, boards)
        tool, turn, board = poses_from_marks(points.unflatten(1, (3, 3)), lever), self.set_up.transform[:3, :3].mT, None
        if self.camera.on_tool:
            M = self.set_up.mount
            turn, board = M[:3, :3], boards[:, :3, 3] @ M[:3, :3].mT + M[:3, 3]
            tool = inverse_poses(M @ boards)
        slopes = pose_jacobian(tool[:, None], lever, board)[:, 0] @ torch.block_diag(turn, turn)
        return slopes @ covariance @ slopes.mT, slopes @ effects

    def measured(self, scene: Scene, view: View) -> Iterator[DeviceRows]:
        """Where the camera sees the board."""
        camera, first = self.camera.camera, len(view.at.spec.prior_variance)
        rows = sees(camera, self.boards(view.points)).nonzero()[:, 0]
        points, noise = view.points[rows], view.noise[rows]
        effects = [self.set_up.shifted(points)]
        columns = [first + self.set_up.columns.nonzero()[:, 0]]
        if camera.view is not None:  # which files of earlier versions do not have
            (root, by_lens, rest), (noise, slopes) = self.lens, self.tells(points)
            noise, effects, columns = noise + rest, [slopes @ root, *effects], [by_lens, *columns]
        every = torch.eye(9, dtype=points.dtype, device=points.device).expand(len(rows), 9, 9)
        yield DeviceRows(self.name, rows, every, torch.cat(effects, 2), torch.cat(columns), self._noise(noise))


def sensor_of(model: CalibratedKinematics) -> tuple[Sensor, ...]:
    """Sensors that measured the rows of a model, cameras, devices of readings and sockets where the fit found them.

    Raises:
        InputError: files of early versions, which do not say where devices of readings are.
    """
    sensors: list[Sensor] = [] if without_positions(model) else [Positions(of_frames=model.lever is not None)]
    for group in model.placement:
        for k, (name, camera) in enumerate(group.cameras.items()):
            sensors.append(BoardImages.last(model, name, camera, group.rows[group.device == k]))
    words = [word for group in model.placement for word in group.names]
    for group in model.placement:
        for number, word in enumerate(group.names if group.seen_points else ()):
            name = f"{group.kind} {word}" if words.count(word) > 1 else word
            sensors.append(DeviceReadings(devices={name: FittedDevice.of(model.map, group, number)}, new=False))
    if not sensors:
        fix = "say by `sensor` what will measure"
        raise InputError.of("the file of this model does not say which devices measured its rows", fix=fix)
    return tuple(sensors)


def sensors_for(given: Tree | CalibratedKinematics, sensor: object = None) -> tuple[Sensor, ...]:
    """Sensors: the argument of :func:`plan`, or what it stands for."""
    if sensor is None:
        return sensor_of(given) if isinstance(given, CalibratedKinematics) else (Positions(),)
    several: tuple[Any, ...] = tuple(sensor) if isinstance(sensor, Sequence) else (sensor,)
    if not several or not all(isinstance(each, Sensor) for each in several):
        fix = "pass dc.Sensor.positions(), dc.Sensor.distances(points), ..."
        raise InputError.of("`sensor`", expected="a dc.Sensor or several", got=as_written(sensor), fix=fix)
    return several
