"""Where devices and markers are, for rows of any kinds: registration and geometric calibration, and what follows.

Rows that tell coordinates find the robot first, in the frame of their device. Readings find it by themselves only where
there are no such rows; else their devices are placed around it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import ChosenScales
from diffeo_calib.calibration.diagnostics.hypotheses import variation
from diffeo_calib.calibration.diagnostics.likely_mistakes import warn_of_joints_below_tip
from diffeo_calib.calibration.diagnostics.open_directions import warn_of_open_directions
from diffeo_calib.calibration.diagnostics.plausibility import (
    check_identification,
    check_readings,
    check_socket_registration,
    registered,
    warn_of_wrong_sockets,
)
from diffeo_calib.calibration.identification.identification import (
    Identification,
    KindRows,
    Prior,
    Rows,
    described,
    estimated,
    held_parameters,
    identify,
)
from diffeo_calib.calibration.identification.registration import register_sockets
from diffeo_calib.calibration.placing.lens import BoardSize, LensAndBoard
from diffeo_calib.calibration.placing.placement import Drift, Elsewhere, OtherRows, Placement, Sessions
from diffeo_calib.calibration.placing.readings import ReadingDevices, ball_of, reading_sets, register_ball, resting_rows
from diffeo_calib.calibration.scales.noise_model import NoiseModel, with_best_seen_point
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import sentence, warn_user
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.result import Fit, Progress
from diffeo_calib.kinematics.evaluation import residuals
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.observation import Part, Stacked
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.tails import Tails
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.payload import Payload
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import Places, errors_of_kinds, fitting_devices
from diffeo_calib.sensors.devices import ROW
from diffeo_calib.sensors.errors import Evaluations, shown_unit
from diffeo_calib.sensors.kinds import Coordinates, ball_tip, check_poses, divided, sees_frame, with_markers


class Told(NamedTuple):
    """Rows that tell the coordinates of the first markers: their numbers (M,), values (M, m), m, and noise."""

    rows: Tensor
    y: Tensor
    noise_model: NoiseModel


def stacked(
    q: Tensor, told: Told | None, readings: Sequence[ReadingDevices], dim: int
) -> tuple[Tensor, NoiseModel, Stacked]:
    """Rows that tell coordinates, and readings of the last marker, in one layout.

    Args:
        q: (N, n) configurations of all rows. told: the rows that tell coordinates. readings: devices and their rows.
        dim: coordinates m of the points of a row.

    Returns:
        What they report (N, R), m, zero where absent, how they were measured, and what that is of the points.
    """
    N, size = len(q), max([part.data.values.shape[1] for part in readings] + ([told.noise_model.size] if told else []))
    bodies = told.noise_model.bodies if told else 1
    y, visible = q.new_zeros(N, bodies * size), torch.zeros(N, bodies * size, dtype=torch.bool, device=q.device)
    covariance = q.new_zeros(N, bodies * size, bodies * size)
    kinds, parts = torch.zeros(N, bodies, dtype=torch.int64, device=q.device), []
    first, modes, slack = 0, covariance.new_zeros(N, 0, size, 6), 0.0
    if told is not None:
        rows = told.rows
        parts.append(Part.of_coordinates(rows, told.y.shape[1]))
        y[rows], visible[rows], covariance[rows] = told.y, told.noise_model.visible, told.noise_model.known
        kinds[rows], first, slack = told.noise_model.kinds, told.noise_model.kind_count, told.noise_model.slack
        modes = covariance.new_zeros(N, *told.noise_model.modes.shape[1:])
        modes[rows] = told.noise_model.modes
    every = torch.arange(dim, device=q.device)
    for kind, part in enumerate(readings, first):
        place, columns = (part.rows[:, None], part.numbers), every[-3 * part.devices.seen_points :]
        parts.append(Part(part.rows, columns, part.numbers, part.devices.observation(part.device)))
        y[place], visible[place] = part.devices.values(part.data), True
        kinds[part.rows, 0] = kind
        if modes.shape[1]:
            modes[part.rows[:, None], 0, part.numbers, part.numbers] = 1.0
        if part.data.std is not None:
            metres = part.devices.metres[part.device][:, None]
            covariance[part.rows[:, None], part.numbers, part.numbers] = (part.data.std * metres).square()
    return y, NoiseModel(visible, kinds, covariance, modes, slack), Stacked(N, bodies * size, dim, parts)


LOG = logging.getLogger(__name__)
MOST_SAGS = 5000  # unknowns of gravity sag, of which there are 4.5 n^2 of n joints: matrices of so many take 200 MB


@dataclass(frozen=True, eq=False)
class Placed:
    """Rows of any kinds beside a geometric calibration, everything in the frame of the model."""

    data: Any  # the table
    coordinates: Coordinates | None  # its rows that tell coordinates, in that frame
    placement: Placement  # the devices
    registration: Identification  # base and markers, or ball and devices
    # the geometric calibration. Both have the devices of readings as they were then, in the order of their sets
    identification: Identification

    @property
    def readings(self) -> list[ReadingDevices]:
        """The devices of readings and their rows."""
        return [part for part in self.placement if isinstance(part, ReadingDevices)]

    @property
    def free(self) -> bool:
        """Whether no device says where the robot stands."""
        return self.coordinates is None

    @property
    def lever(self) -> float | None:
        """Distance of the points of measured poses from their origins, m; None without poses."""
        return None if self.coordinates is None else self.coordinates.table.lever

    @property
    def ball(self) -> bool:
        """Whether no device measures positions of the last marker."""
        return self.free or (self.lever is None and bool(self.readings))

    def by_kind(self, errors: Tensor) -> Evaluations:
        """Errors (N, R) of the numbers of the rows, m, NaN where nothing was measured, in the unit of each kind."""
        return errors_of_kinds(errors, self.coordinates, self.readings)

    def shown(self, row: Any) -> tuple[str, float]:
        """Unit in which errors of a row, a table of its own, are shown, and how many of it are a metre at the tool."""
        for part in self.readings:
            if part.data.kind == row.kind:
                return row.unit[0], float(part.devices.in_unit(row, torch.ones_like(row.values))[0, 0])
        return shown_unit("m")

    def elsewhere(self, row: int, q: Tensor) -> list[Elsewhere]:
        """A row at other configurations q (M, n), as far as the devices of each set measured it."""
        points = self.identification.geometry.points(q)
        return [devices.elsewhere(row, points, self.placement) for devices in self.placement]

    def settled(self, fitted: Fit, fitted_map: FittedMap, chosen: ChosenScales) -> Placed:
        """Move the devices to where a fit puts them, and with all markers of the model."""
        here = torch.eye(4, dtype=chosen.data.y.dtype, device=chosen.data.y.device)
        placement = self.placement.settled(fitted, fitted_map, chosen.data, here)
        aligned = self.coordinates
        if aligned is not None:
            aligned = aligned._replace(table=with_markers(aligned.table, self.registration.geometry.markers))
        return replace(self, placement=placement, coordinates=aligned)

    def stage_rms(self, model: Callable[[Tensor], Tensor]) -> list[float | None]:
        """RMS errors, m, of registration, geometry and a model in measured positions; None without any."""
        kinematics = self.registration.geometry.points, self.identification.geometry.points, model
        if self.coordinates is None:
            return [None] * len(kinematics)
        table, first = self.coordinates.table, Places(ball=self.ball)
        last = Places({kind.devices.kind: kind.devices for kind in self.placement if kind.devices.cameras}, self.ball)
        return [
            residuals(stage, places, table).positions_rms
            for stage, places in zip(kinematics, (first, first, last), strict=True)
        ]

    def tangent_data(self, opened: Tensor | None = None) -> TangentData:
        """The rows around the geometric calibration, weighted by its residuals; with effects (N, R, U) of unknowns."""
        geometry, theta = self.registration.geometry, self.identification.theta
        payload = Payload.of_rows(geometry.chain, self.data.payload, self.data.payload_at)
        sags = sum(compliance.size for compliance in geometry.chain.arrays.compliances)
        elastic = bool(payload) or (sags <= MOST_SAGS and not is_cartesian(geometry.chain))
        if not elastic and sags > MOST_SAGS:
            what = f"gravity sag of {geometry.chain.n} joints is left out of the model"
            warn_user(sentence(what, expected=f"at most {MOST_SAGS} unknowns of it", got=sags))
        nominal = GeometryMap(geometry, elastic=elastic, payload=payload)
        theta = torch.cat([theta, theta.new_zeros(nominal.parameters - geometry.size)])
        data = self._rows(nominal, theta)
        held = held_parameters(geometry, adrift=self.free)
        shared = [self.placement.shared(data)] if opened is None else [opened, self.placement.shared(data)]
        return replace(data, shared=torch.cat(shared, 2), held=held, adrift=self.free)

    def drifting(self) -> Placed | None:
        """Add what may drift with columns of the table; None without such columns."""
        drift = Drift.of_table(self.data, self.registration.geometry.chain)
        return replace(self, placement=Placement((*self.placement, *drift))) if drift else None

    def widened(self, data: TangentData, scales: Hyperparameters) -> tuple[Placed, str] | None:
        """Count what differs from row to row as their noise, in a sentence; None if nothing clearly does."""
        noise = variation(data, scales, self.placement.hypotheses(data, ROW))
        if noise is None or self.coordinates is None:
            return None
        table = self.coordinates.table.with_own_focal_lengths(noise[0])
        sets = (part.widened(table) if isinstance(part, LensAndBoard) else part for part in self.placement)
        return replace(self, coordinates=self.coordinates._replace(table=table), placement=Placement(sets)), noise[1]

    def beside(self, data: Any, like: TangentData) -> tuple[Placed, TangentData]:
        """Other rows of the same devices, and around the same linearisation with all weights 1.

        Raises:
            MeasurementError: rows of another device.
        """
        (coordinates, readings), aligned = divided(data), None
        if coordinates is not None:
            aligned = coordinates._replace(table=self.placement.aligned(coordinates.table))
        centre = like.points.unflatten(1, (-1, 3)).mean((0, 1))
        other = OtherRows(data, coordinates, aligned, readings, centre)
        placement = Placement(part.with_rows(other) for part in self.placement)
        fit, counts = self.identification, [len(part.rows) for part in readings]
        counts = counts if coordinates is None else [len(coordinates.rows), *counts]
        weights = [w.new_ones(count, w.shape[1]) for w, count in zip(fit.weights, counts, strict=True)]
        fit = replace(fit, weights=tuple(weights), freedom=inf)
        placed = replace(self, data=data, coordinates=aligned, placement=placement, identification=fit)
        rows = placed._rows(like.nominal.under(data.payload), like.theta)
        rows = replace(rows, held=like.held, adrift=like.adrift)
        return placed, replace(rows, shared=placement.shared(rows))

    def _rows(self, nominal: GeometryMap, theta: Tensor) -> TangentData:
        """Rows of several kinds, or of readings: the numbers of every row, those of its first body first."""
        positions, rows, fit = None, None, self.identification
        weights, weighed = [*fit.weights], [devices.rows for devices in self.readings]
        if self.coordinates is not None:
            positions = self._coordinates(nominal, theta, self.coordinates)
            if len(positions.x) == len(self.data):
                return positions
            weights[0], weighed = positions.tails.weights, [self.coordinates.rows, *weighed]
            rows = Told(self.coordinates.rows, positions.y, positions.noise_model)
        y, noise, observe = stacked(self.data.q, rows, self.readings, 3 * nominal.geometry.markers)
        every = self.data.q.new_ones(len(self.data), noise.bodies)
        for some, each in zip(weighed, weights, strict=True):
            every[some, : each.shape[1]] = each
        numbers = y, noise, Tails(fit.freedom, every)
        return TangentData(nominal, theta, self.data.q, *numbers, observe=observe, beside=positions)

    def _coordinates(self, nominal: GeometryMap, theta: Tensor, aligned: Coordinates) -> TangentData:
        """Rows that tell coordinates, of the markers that they show."""
        (table, rows), geometry, fit = aligned, nominal.geometry, self.identification
        on_markers = nominal.with_geometry(
            geometry.with_tool(geometry.tool[: table.markers], geometry.on[: table.markers])
        )
        theta = torch.cat([theta[: on_markers.geometry.size], theta[geometry.size :]])
        nominal, noise = on_markers.rows(rows), NoiseModel.of(with_best_seen_point(table, fit), fit.noise)
        measured, predicted = table.points.flatten(1), nominal(table.q, theta)
        y = torch.where(measured.isnan(), predicted, measured)  # hidden markers: any value would do
        worst = fit.tails.weights.unflatten(1, (noise.bodies, -1)).amin(2)  # a pose is as wrong as its worst point
        return TangentData(nominal, theta, table.q, y, noise, replace(fit.tails, weights=worst))


def place(robot: Tree, data: Any, progress: Progress) -> Placed:
    """Find base, markers and devices, and the geometric errors.

    Raises:
        MeasurementError: rows that cannot belong to this robot, or too few.
    """
    check_poses(data)
    coordinates, readings = divided(data)
    tables = [part.table for part in readings]
    check_readings(robot, tables, alone=coordinates is None)
    LOG.info("calibrating %s with %r", robot.name, data)
    if coordinates is None:
        progress("geometry", 0, 1)
        registration = register_ball(robot, tables)
        rows = Rows(registration.geometry, tuple(map(KindRows.read, tables, registration.devices)))
        prior = None if resting_rows(tables) else Prior()  # readings alone do not tell it
        fit = _fitted(rows, tables, registration, prior, adrift=True)
        if any(free := [devices.freed() for devices in registration.devices]):  # what was said to be known is tested
            each = zip(tables, registration.devices, free, strict=True)
            parts = tuple(KindRows.read(data, opened or stated) for data, stated, opened in each)
            again = estimated(replace(rows, parts=parts), held_parameters(rows.geometry, adrift=True), prior)
            for devices in again.devices:
                devices.check_freed(fit.noise, again.noise)
        return Placed(data, None, Placement(reading_sets(readings, fit.devices)), registration, fit)
    coordinates.table.check_every_marker_seen()
    sessions, table = Sessions.of_table(robot, coordinates, progress)
    progress("registration", 0, 1)
    registration = registered(robot, table)
    for resting in resting_rows(tables):
        own = register_sockets(registration.geometry, resting.q, resting.device)
        check_socket_registration(robot, resting, own, (registration.geometry, table))
    warn_of_joints_below_tip(robot, table)
    warn_of_open_directions(robot, table, registration)
    geometry, ball = registration.geometry, None
    if not all(map(sees_frame, tables)):
        fitted = identify(geometry, table.q, table.points).geometry  # a nominal robot may miss its ball by centimetres
        ball = ball_of(tables, fitted, ball_tip(readings, geometry.on[-1]))
        if ball is not None:
            geometry = geometry.with_tool(torch.cat([geometry.tool, ball.tool]), (*geometry.on, *ball.on))
    devices = tuple(fitting_devices(other, geometry.points(other.q)) for other in tables)
    rows = Rows(geometry, (KindRows.positions(table.q, table.points), *map(KindRows.read, tables, devices)))
    if ball is not None:
        registration = described(rows, [registration.noise])
    registration = replace(registration, devices=devices)
    progress("geometry", 0, 1)
    fit = _fitted(rows, tables, registration)
    model, count = fit.geometry, table.markers  # without a ball, which a device does not see
    check_identification(table, replace(fit, geometry=model.with_tool(model.tool[:count], model.on[:count])))
    cameras = LensAndBoard.of_table(table, coordinates.rows, registration, sessions)
    cameras += BoardSize.of_table(table, coordinates.rows) if is_cartesian(robot) else []
    placement = Placement((*sessions, *cameras, *reading_sets(readings, fit.devices)))
    return Placed(data, coordinates._replace(table=table), placement, registration, fit)


def _fitted(
    rows: Rows, tables: Sequence[Any], start: Identification, prior: Prior | None = None, *, adrift: bool = False
) -> Identification:
    """The geometric calibration; tables of readings and their registration."""
    fit = estimated(rows, held_parameters(rows.geometry, adrift=adrift), prior)
    for resting in resting_rows(tables):
        warn_of_wrong_sockets(resting, fit.geometry.points(resting.q)[:, -1])
    LOG.info("registration: RMS %.4f mm; geometry: RMS %.4f mm", 1e3 * start.rms, 1e3 * fit.rms)
    return fit
