"""Where devices and markers are, for rows of any kinds: registration and geometric calibration, and what follows.

Rows that tell coordinates find the robot first: in the frame of their device, or in the robot's base if a ball rested
in sockets. Readings find it by themselves only where there are no such rows; else their devices are placed around it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import ChosenScales
from diffeo_calib.calibration.diagnostics.campaign import warn_of_open_directions
from diffeo_calib.calibration.diagnostics.likely_mistakes import warn_of_joints_below_tip
from diffeo_calib.calibration.diagnostics.plausibility import (
    check_deviations,
    check_identification,
    registered,
)
from diffeo_calib.calibration.diagnostics.reading_plausibility import check_readings
from diffeo_calib.calibration.diagnostics.socket_plausibility import check_no_sessions
from diffeo_calib.calibration.identification.identification import Identification, identify
from diffeo_calib.calibration.payload_rows import payload_of_rows
from diffeo_calib.calibration.placing.placement import DeviceSet, Placement
from diffeo_calib.calibration.placing.readings import (
    ReadingDevices,
    held_parameters,
    identify_readings,
    with_freed_devices,
)
from diffeo_calib.calibration.placing.sessions import SessionFrames
from diffeo_calib.calibration.placing.sockets import SocketDevices, stages_by_sockets, with_ball
from diffeo_calib.calibration.placing.stacking import Told, stacked
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.seen_point import with_best_seen_point
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.result import Fit, Progress
from diffeo_calib.kinematics.evaluation import residuals
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.places import Places
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import Devices
from diffeo_calib.sensors.kinds import kind_of
from diffeo_calib.sensors.tables import Coordinates, OtherReadings, check_poses, divided

LOG = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Placed:
    """Rows of any kinds beside a geometric calibration, everything in the frame of the model.

    Args:
        data: the table. coordinates: its rows that tell coordinates, in that frame, sockets at their places.
        placement: the devices.
        registration: base and markers, or ball and devices. identification: the geometric calibration.
        registered, identified: the devices of readings at the registration and after the geometric calibration, in the
            order of their sets.
    """

    data: Any
    coordinates: Coordinates | None
    placement: Placement
    registration: Identification
    identification: Identification
    registered: tuple[Devices, ...] = ()
    identified: tuple[Devices, ...] = ()

    @property
    def readings(self) -> list[ReadingDevices]:
        """The devices of readings and their rows."""
        return [own for own in self.placement if isinstance(own, ReadingDevices)]

    @property
    def free(self) -> bool:
        """Whether no device says where the robot stands."""
        return self.coordinates is None or self.coordinates.table.without_device

    @property
    def lever(self) -> float | None:
        """Distance of the points of measured poses from their origins, m; None without poses."""
        return None if self.coordinates is None else self.coordinates.table.lever

    @property
    def ball(self) -> bool:
        """Whether no device measures positions of the last marker."""
        return self.free or bool(self.readings) or self.placement.one(SocketDevices) is not None

    @property
    def positions(self) -> Tensor | None:
        """(M,) numbers of the rows whose positions a device measured; None where all rows are of one kind."""
        if self.free or self.coordinates is None:
            return None
        table, rows = self.coordinates
        if table.places is None:
            return None if len(rows) == len(self.data) else rows
        return rows[table.places < 0]

    def settled(self, fitted: Fit, fitted_map: FittedMap, chosen: ChosenScales) -> Placed:
        """The same with the devices where a fit puts them, and with all markers of the model.

        Arguments as of :meth:`Placement.settled`.
        """
        placement = self.placement.settled(fitted, fitted_map, chosen)
        sockets, own = placement.one(SocketDevices), self.coordinates
        if own is not None and sockets is not None:
            own = own._replace(table=sockets.places.placed(own.table))
        elif own is not None and self.readings:
            own = own._replace(table=own.table.with_hidden_ball())
        return replace(self, placement=placement, coordinates=own)

    def stage_rms(self, model: Callable[[Tensor], Tensor]) -> list[float]:
        """RMS errors, m, of registration, geometry and a model: of coordinates if there are any, else of readings."""
        kinematics = self.registration.geometry.points, self.identification.geometry.points, model
        if self.coordinates is not None:
            places = Places(ball=self.ball)
            return [residuals(stage, places, self.coordinates.table).main.rms for stage in kinematics]
        found = []
        for stage, devices in zip(kinematics, self.devices_by_stage, strict=True):
            pairs = zip(devices, self.readings, strict=True)
            errors = [own.errors(one.data, stage(one.data.q).detach()[:, -1]) for own, one in pairs]
            found.append(float(torch.cat([own.flatten() for own in errors]).square().mean().sqrt()))
        return found

    @property
    def devices_by_stage(self) -> list[tuple[Devices, ...]]:
        """The devices of readings at the registration, after the geometric calibration, and now."""
        return [self.registered, self.identified, tuple(own.devices for own in self.readings)]

    def tangent_data(self) -> TangentData:
        """The rows around the geometric calibration, weighted by its residuals."""
        geometry, theta = self.registration.geometry, self.identification.theta
        payload = payload_of_rows(geometry.chain, self.data)
        nominal = GeometryMap(geometry, elastic=True, payload=payload)
        theta = torch.cat([theta, theta.new_zeros(nominal.parameters - geometry.size)])
        data = self._stacked(nominal, theta) if self.readings else self._coordinates(nominal, theta)
        held = held_parameters(geometry) if self.free else ()
        return replace(data, shared=self.placement.shared(data), held=held)

    def _coordinates(self, nominal: GeometryMap, theta: Tensor) -> TangentData:
        """Rows that tell the coordinates of all markers."""
        if self.coordinates is None:
            raise AssertionError("a table has rows")
        table, found = self.coordinates.table, self.identification
        noise = NoiseModel.of(with_best_seen_point(table, found), found.noise)
        seen, predicted = table.points.flatten(1), nominal(table.q, theta)
        y = torch.where(seen.isnan(), predicted, seen)  # hidden markers: any value would do
        return TangentData(nominal, theta, table.q, y, noise, noise.body_tails(found.tails))

    def _stacked(self, nominal: GeometryMap, theta: Tensor) -> TangentData:
        """Rows of several kinds, or of readings: the numbers of every row, those of its first body first."""
        own, told, dim = None, None, 3 * nominal.geometry.markers
        if self.coordinates is not None:
            on_markers = nominal.with_geometry(_without_ball(nominal.geometry, self.coordinates.table.markers))
            tool = theta[: on_markers.geometry.size], theta[nominal.geometry.size :]
            own = self._coordinates(on_markers.rows(self.coordinates.rows), torch.cat(tool))
            told = Told(self.coordinates.rows, own.y, own.noise_model)
        rows = stacked(self.data.q, told, self.readings, dim)
        tails = replace(self.identification.tails, weights=self._row_weights(own, rows.noise_model.bodies))
        at = nominal, theta, self.data.q
        return TangentData(*at, rows.y, rows.noise_model, tails, observe=rows.observe, beside=own)

    def _row_weights(self, own: TangentData | None, bodies: int) -> Tensor:
        """Weights (N, bodies) of the rows: of those that tell coordinates, or of readings by themselves."""
        weights = self.data.q.new_ones(len(self.data), bodies)
        if own is not None and self.coordinates is not None:
            weights[self.coordinates.rows] = own.tails.weights
        else:
            weights[torch.cat([one.rows for one in self.readings])] = self.identification.tails.weights
        return weights


def place(robot: Tree, data: Any, progress: Progress) -> Placed:
    """Find base, markers and devices, and the geometric errors.

    Raises:
        MeasurementError: rows that cannot belong to this robot, or too few.
    """
    check_poses(data)
    coordinates, readings = divided(data)
    check_readings(robot, [one.table for one in readings], alone=coordinates is None)
    if coordinates is None:
        return _by_readings(robot, data, readings, progress)
    placed = _by_coordinates(robot, data, coordinates, progress)
    return _with_readings(placed, readings) if readings else placed


def _by_coordinates(robot: Tree, data: Any, own: Coordinates, progress: Progress) -> Placed:
    """Registration and geometric calibration of rows that tell coordinates, and what they say about these rows."""
    table, count, sets = own.table, len(data), list[DeviceSet]()
    table.check_every_marker_seen()
    if len(table.session_names) > 1:
        check_no_sessions(table)
        progress("sessions", 0, 1)
        seen = torch.arange(count, device=HOST)[own.rows] if table.socket is None else own.rows[table.socket < 0]
        frames = SessionFrames.find(robot, table.device_rows())
        sets.append(frames.of_rows(seen, count))
        table = frames.aligned(table)
    progress("registration", 0, 1)
    LOG.info("calibrating %s with %r", robot.name, table)
    if table.sockets is not None:
        places, table, stages = stages_by_sockets(robot, table)
        LOG.info("ball and sockets found, %s", stages[0].status)
        sets.append(SocketDevices.of_rows(places, table, own.rows, count))
    else:
        registration = registered(robot, table)
        LOG.info("registration: base and markers found, RMS %.4f mm", 1e3 * registration.rms)
        progress("geometry", 0, 1)
        stages = registration, identify(registration.geometry, table.q, table.points)
        check_identification(table, stages[1])
        check_deviations(table, registration)
    LOG.info("geometry: RMS %.4f mm", 1e3 * stages[1].rms)
    warn_of_joints_below_tip(robot, table)
    warn_of_open_directions(robot, table, stages[0])
    return Placed(data, Coordinates(table, own.rows), Placement(tuple(sets)), *stages)


def _by_readings(robot: Tree, data: Any, readings: list[OtherReadings], progress: Progress) -> Placed:
    """Ball, devices and geometric errors by readings alone."""
    progress("geometry", 0, 1)
    LOG.info("calibrating %s with %r", robot.name, data)
    tables = [one.table for one in readings]
    bare = Geometry.nominal(robot, 1, () if tables[0].on is None else (tables[0].on,))
    found = identify_readings(bare, tables)
    LOG.info("registration RMS %.4f mm, geometry %.4f mm", 1e3 * found.registration.rms, 1e3 * found.identification.rms)
    freed = with_freed_devices(tables, found)
    if freed is not None:
        for devices in freed.devices:
            devices.check_freed(found.identification.noise, freed.identification.noise)
    sets = _sets(readings, found.devices, "the robot's base")
    return Placed(
        data, None, Placement(sets), found.registration, found.identification, found.registered, found.devices
    )


def _with_readings(placed: Placed, readings: list[OtherReadings]) -> Placed:
    """The devices of readings around a robot that other rows have found."""
    tables, stages = [one.table for one in readings], (placed.registration, placed.identification)
    if placed.coordinates is None:
        raise AssertionError("readings alone are placed by themselves")
    with_sockets = placed.coordinates.table.sockets is not None
    if not with_sockets:
        found = identify_readings(_ball_alone(stages[1].geometry, tables[0].on), tables, rigid=True)
        stages = tuple(with_ball(stage, found.identification) for stage in stages)
    frame = "the robot's base" if placed.free else "the measuring frame"
    at = [[_devices(table, stage.geometry) for table in tables] for stage in stages]
    sets = _sets(readings, at[1], frame)
    return replace(
        placed,
        placement=Placement((*placed.placement, *sets)),
        registration=stages[0],
        identification=stages[1],
        registered=tuple(at[0]),
        identified=tuple(at[1]),
    )


def _devices(table: Any, geometry: Geometry) -> Devices:
    """The devices of readings of the last marker of a robot."""
    points = geometry.points(table.q)[:, -1]
    return kind_of(table).at(table, points).refined(table, points)


def _sets(readings: list[OtherReadings], devices: Any, frame: str) -> tuple[ReadingDevices, ...]:
    pairs = zip(readings, devices, strict=True)
    return tuple(
        ReadingDevices(table, own, rows, torch.arange(table.values.shape[1], device=rows.device), frame)
        for (table, rows), own in pairs
    )


def _ball_alone(geometry: Geometry, tip: str | None) -> Geometry:
    """The same robot with a ball in place of its markers."""
    return geometry.with_tool(geometry.tool[:1] * 0.0, geometry.on[-1:] if tip is None else (tip,))


def _without_ball(geometry: Geometry, markers: int) -> Geometry:
    """The same robot with its first markers only."""
    return geometry.with_tool(geometry.tool[:markers], geometry.on[:markers])
