"""Sensors of a model's rows, reused for planned poses: devices where the fit found them.

Images of a board, as what will measure planned poses: where the camera sees it, and what an image there would tell.

An image tells the pose of the board in the camera with an error of its own, far larger along the line of sight, and one
that all images share, of lens and board (cameras/images.py). Both depend on the pose. The arm is not seen: it may hide
the board.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.calibration.planning.candidates import ranges_around
from diffeo_calib.calibration.planning.sensors import (
    DeviceReadings,
    Options,
    Positions,
    Scene,
    Sensor,
    Where,
)
from diffeo_calib.cameras.images import UNKNOWNS, Camera, expected, sees
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.device_readings import FittedDevice
from diffeo_calib.kinematics.hand_eye import SetUp
from diffeo_calib.measurements.poses import camera_jacobian, inverse_poses, mark_jacobian, poses_from_marks
from diffeo_calib.sensors.board_camera import BoardCamera
from diffeo_calib.sensors.places import PlacedDevices
from diffeo_calib.sensors.set_ups import TRANSFORMS

SMALLEST_REST_M = 1e-6


@dataclass(frozen=True, eq=False)
class BoardImages(Sensor):
    """Images of the board by one camera of a fit."""

    name: str = ""  # of the camera
    # lens, board and what its images showed
    seen: BoardCamera = None  # pyright: ignore[reportAssignmentType]  # always given
    lever: float = 0.0  # of the model's poses, m
    set_up: SetUp = None  # pyright: ignore[reportAssignmentType]  # where it is
    # (14, c0) of the shifts of the fit on lens and board; None where these are new shifts, as beside a registration
    effects: Tensor | None = None
    rest: Tensor | None = None  # (9, 9) noise of a pose beyond that of its corners, m^2

    @property
    def camera(self) -> Camera:
        """Lens and board."""
        return self.seen.camera

    def boards(self, points: Tensor) -> Tensor:
        """Poses (M, 4, 4) of the board in the camera's frame by the model's points (M, 9), m."""
        poses = self.set_up.view(poses_from_marks(points.unflatten(1, (3, 3)), self.lever))
        return inverse_poses(poses) if self.seen.on_tool else poses

    def where(self, model: CalibratedKinematics) -> Where:
        """See :class:`Sensor`; by the rigid kinematics, which is quick, and not far beyond the joints of the fit."""
        ranges = ranges_around(model.robot, model.configurations)
        return Where(lambda q: sees(self.camera, self.boards(model.geometry.points(q).flatten(1))), ranges)

    def tells(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Covariances (O, 9, 9), m^2, of images of points (O, 9), m, and effects (O, 9, 14) of lens and board."""
        boards = self.boards(points)
        covariance, effects = expected(self.camera, boards)
        if self.seen.on_tool:
            M = self.set_up.mount
            tool, seen = inverse_poses(M @ boards), boards[:, :3, 3] @ M[:3, :3].mT + M[:3, 3]
            slopes = -camera_jacobian(tool, self.lever, seen) @ torch.block_diag(*[M[:3, :3]] * 2)
        else:
            slopes = mark_jacobian(poses_from_marks(points.unflatten(1, (3, 3)), self.lever), self.lever)
            slopes = slopes @ torch.block_diag(*[self.set_up.transform[:3, :3].mT] * 2)
        return slopes @ covariance @ slopes.mT, slopes @ effects

    def options(self, scene: Scene) -> Options:
        """See :class:`Sensor`: where the camera sees the board."""
        rows = sees(self.camera, self.boards(scene.points)).nonzero()[:, 0]
        points = scene.points[rows]
        eye = torch.eye(9, dtype=points.dtype, device=points.device)
        if self.camera.view is None:  # of earlier versions
            noise, shared = scene.noise[rows], points.new_zeros(len(rows), 9, scene.shifts)
        else:
            noise, by_lens = self.tells(points)
            noise = noise + (SMALLEST_REST_M**2 * eye if self.rest is None else self.rest)
            shared = by_lens @ (self.camera.root if self.effects is None else self.effects)
            shared = self._new(scene, shared) if self.effects is None else shared
        if self.set_up.columns is not None and scene.shifts:
            shared = shared.index_add(2, self.set_up.columns.nonzero()[:, 0], self.set_up.shifted(points))
        noise = noise if self.std is None else self.std**2 * eye.expand_as(noise)
        return Options(rows, eye.expand(len(rows), 9, 9), shared, noise, torch.zeros_like(rows), (self.name,))


def board_images(model: CalibratedKinematics, placed: PlacedDevices) -> list[Sensor]:
    """Those of the cameras of a fit; none of other devices."""
    each = enumerate(placed.devices.cameras.items())
    return [_of_camera(model, name, seen, placed.rows[placed.device == k]) for k, (name, seen) in each]


def _of_camera(model: CalibratedKinematics, name: str, seen: BoardCamera, rows: Tensor) -> BoardImages:
    """One camera, where it stood last; ``rows`` (M,) of the fit that it measured."""
    noise, (session, stood) = model.map.noise, _last_session(model, rows, name)
    set_up = SetUp.of(model, session)
    found = BoardImages(None, name, seen, model.bodies.pose_lever(), set_up)
    if seen.camera.view is None or model.registration is not None:
        return found
    points = model(model.configurations[stood]).detach().flatten(1)
    known, by_lens = found.tells(points)
    if not len(stood) or not bool(by_lens.isfinite().all()):  # it was seen from other places since
        return found
    of_fit = noise.shared[stood][:, :9].clone()
    if set_up.columns is not None:
        of_fit[..., set_up.columns] = 0.0
    effects = torch.linalg.lstsq(by_lens.flatten(0, 1), of_fit.flatten(0, 1), driver="gelsd").solution
    beyond = (noise.covariance[stood][:, :9, :9] - known).median(0).values
    values, axes = torch.linalg.eigh(0.5 * (beyond + beyond.mT))
    rest = (axes * values.clamp(min=SMALLEST_REST_M**2)) @ axes.mT
    return BoardImages(None, found.name, seen, found.lever, set_up, effects, rest)


def _last_session(model: CalibratedKinematics, rows: Tensor, camera: str) -> tuple[str | None, Tensor]:
    """Name of the session of the last of a camera's rows (M,), and those of it.

    Where no row says it, that of its last set-up, by a recalibration; None in the place of a registration.
    """
    sets = [own for own in model.placement if own.kind in TRANSFORMS] if model.registration is None else []
    for own in sets:
        here = torch.isin(own.rows, rows)
        if bool(here.any()):
            number = int(own.device[here][own.rows[here].argmax()])
            return own.names[number], rows[torch.isin(rows, own.rows[own.device == number])]
    names = (name for own in sets for name in reversed(own.names) if name.partition("/")[0] == camera)
    return next(names, None), rows


def sensor_of(model: CalibratedKinematics) -> tuple[Sensor, ...]:
    """Sensors that measured the rows of a model, devices of readings and sockets where the fit found them.

    Raises:
        InputError: files of early versions, which do not say where devices of readings are.
    """
    found: list[Sensor] = [] if without_positions(model) else [Positions(whole=model.lever is not None)]
    for own in model.placement:
        found += board_images(model, own)
    found += _devices(model)
    if not found:
        fix = "say by `sensor` what will measure"
        raise InputError.of("the file of this model does not say which devices measured its rows", fix=fix)
    return tuple(found)


def without_positions(model: CalibratedKinematics) -> bool:
    """Whether no device of positions or poses measured rows of a model, where its devices say which rows they did.

    The device of rows that a recalibration added is not known: images among them share the errors of lens and board.
    """
    if model.own_frame:
        return True
    shared = model.map.noise.shared
    other = torch.zeros(len(shared), dtype=torch.bool, device=shared.device)
    for own in model.placement:
        if own.devices.seen_points or own.devices.cameras:
            other[own.rows] = True
        if own.devices.cameras:
            other |= (shared != 0).any(1).sum(1) >= len(UNKNOWNS)
    return bool(other.all())


def _devices(model: CalibratedKinematics) -> Iterator[DeviceReadings]:
    """Every device of readings and socket of a model; of one that measured no row only its rough place is known."""
    for one in model.placement:
        for number, word in enumerate(one.names if one.devices.seen_points else ()):
            several = sum(word in other.names for other in model.placement) > 1
            fitted = FittedDevice.of(model.map, one, number)
            devices, offset = fitted.devices, float(fitted.devices.deviations[0, -1])
            prior = devices.constants.new_tensor(devices.prior(offset))
            known = devices.deviations if fitted.columns is None else prior[None]
            named = replace(devices, names=(f"{one.kind} {word}" if several else word,), deviations=known)
            yield DeviceReadings(None, named, fitted)
