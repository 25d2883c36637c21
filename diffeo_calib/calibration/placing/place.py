"""Where devices and markers are, for rows of any kinds: registration and geometric calibration, and what follows.

Rows that tell coordinates find the robot first: in the frame of their device, or in the robot's base if a ball rested in
sockets. Readings find it by themselves only where there are no such rows; else their devices are placed around it.
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
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.seen_point import with_best_seen_point
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.result import Fit, Progress
from diffeo_calib.kinematics.evaluation import evaluate
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.observation import LinearFunctionals, Part, Stacked
from diffeo_calib.measurements.visibility import check_every_marker_seen
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import Devices
from diffeo_calib.sensors.kinds import kind_of
from diffeo_calib.sensors.tables import Coordinates, OtherReadings, divided

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
        """The same with the devices where a fit puts them; arguments as of :meth:`Placement.settled`."""
        placement = self.placement.settled(fitted, fitted_map, chosen)
        sockets, own = placement.one(SocketDevices), self.coordinates
        if sockets is not None and own is not None:
            own = own._replace(table=sockets.places.placed(own.table))
        return replace(self, placement=placement, coordinates=own)

    def stage_rms(self, model: Callable[[Tensor], Tensor]) -> list[float]:
        """RMS errors, m, of registration, geometry and a model: of coordinates where there are any, else of readings."""
        stages = self.registration.geometry, self.identification.geometry
        if self.coordinates is not None:
            own = (_without_ball(stage, self.coordinates.table.markers).points for stage in stages)
            return [evaluate(stage, self.coordinates.table).rms for stage in (*own, model)]
        found, kinematics = [], (*(stage.points for stage in stages), model)
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
        q, N = self.data.q, len(self.data)
        own = None
        if self.coordinates is not None:
            on_markers = nominal.with_geometry(_without_ball(nominal.geometry, self.coordinates.table.markers))
            tool = theta[: on_markers.geometry.size], theta[nominal.geometry.size :]
            own = replace(self, placement=Placement())._coordinates(on_markers, torch.cat(tool))
        tables = [one.data for one in self.readings]
        size = max([data.values.shape[1] for data in tables] + ([own.noise_model.size] if own else []))
        bodies = own.noise_model.bodies if own else 1
        y, visible = q.new_zeros(N, bodies * size), torch.zeros(N, bodies * size, dtype=torch.bool, device=q.device)
        known, weights = q.new_zeros(N, bodies * size, bodies * size), q.new_ones(N, bodies)
        kinds, parts = torch.zeros(N, bodies, dtype=torch.int64, device=q.device), []
        if own is not None and self.coordinates is not None:
            rows, m = self.coordinates.rows, own.y.shape[1]
            eye = torch.eye(m, dtype=q.dtype, device=q.device).expand(len(rows), m, m)
            whole = torch.arange(m, device=q.device)
            parts.append(Part(rows, whole, whole, LinearFunctionals(eye, torch.zeros_like(own.y))))
            y[rows], visible[rows], weights[rows] = own.y, own.visible, own.tails.weights
            if own.noise_model.known is not None:
                known[rows] = own.noise_model.known
            if own.noise_model.kinds is not None:
                kinds[rows] = own.noise_model.kinds
        first = 0 if own is None else own.noise_model.kind_count
        ball = torch.arange(3 * nominal.geometry.markers, device=q.device)[-3:]
        for kind, one in enumerate(self.readings, first):
            place = one.rows[:, None], one.numbers
            parts.append(Part(one.rows, ball, one.numbers, one.devices.observation(one.device)))
            y[place], visible[place] = one.devices.values(one.data), True
            kinds[one.rows, 0] = kind
            if one.data.std is not None:
                metres = one.devices.metres[one.device][:, None]
                known[one.rows[:, None], one.numbers, one.numbers] = (one.data.std * metres).square()
            if own is None:
                weights[one.rows] = self.identification.tails.weights[: len(one.rows)]
        noise = NoiseModel(
            bodies,
            size,
            known if bool(known.any()) else None,
            None if own is None else _of_rows(own.noise_model.modes, self.coordinates, N),
            0.0 if own is None else own.noise_model.slack,
            visible=None if bool(visible.all()) else visible,
            kinds=kinds if int(kinds.max()) else None,
        )
        tails = replace(self.identification.tails, weights=self._row_weights(weights))
        dim = 3 * nominal.geometry.markers
        observe = Stacked(N, bodies * size, dim, parts)
        return TangentData(nominal, theta, q, y, noise, tails, observe=observe, beside=own)

    def _row_weights(self, weights: Tensor) -> Tensor:
        """Weights (N, bodies) of the rows; those of readings by themselves in the order of their tables."""
        if self.coordinates is None:
            weights = weights.clone()
            weights[torch.cat([one.rows for one in self.readings])] = self.identification.tails.weights
        return weights


def _of_rows(values: Tensor | None, own: Coordinates | None, count: int) -> Tensor | None:
    """Values (M, ...) of some rows as those of all, zero elsewhere: (N, ...)."""
    if values is None or own is None:
        return None
    found = values.new_zeros(count, *values.shape[1:])
    found[own.rows] = values
    return found


def place(robot: Tree, data: Any, progress: Progress) -> Placed:
    """Find base, markers and devices, and the geometric errors.

    Raises:
        MeasurementError: rows that cannot belong to this robot, or too few.
    """
    coordinates, readings = divided(data)
    check_readings(robot, [one.table for one in readings], alone=coordinates is None)
    if coordinates is None:
        return _by_readings(robot, data, readings, progress)
    placed = _by_coordinates(robot, data, coordinates, progress)
    return _with_readings(placed, readings) if readings else placed


def _by_coordinates(robot: Tree, data: Any, own: Coordinates, progress: Progress) -> Placed:
    """Registration and geometric calibration of rows that tell coordinates, and what they say about these rows."""
    table, count, sets = own.table, len(data), list[DeviceSet]()
    check_every_marker_seen(table)
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
