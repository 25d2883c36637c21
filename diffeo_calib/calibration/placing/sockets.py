"""Sockets: how a ball in them shows a robot by itself or beside a device, and what a fit says about their places.

Ball and sockets are found in closed form, in the measuring frame: the robot's base, or that of the device that measured
other rows. Known distances between sockets, linearised where these are, belong to what is known of their places before
the rows; places are found again with the geometric errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import ChosenScales
from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.open_directions import warn_of_flat_places
from diffeo_calib.calibration.diagnostics.outliers import Outlier, excluded
from diffeo_calib.calibration.diagnostics.plausibility import (
    check_readings,
    check_socket_registration,
    check_sockets,
    warn_of_other_robot,
    warn_of_wrong_sockets,
)
from diffeo_calib.calibration.expected_errors import workspace_deviation
from diffeo_calib.calibration.identification.identification import Identification, Prior, ReadRows, Rows, described
from diffeo_calib.calibration.identification.registration import register_sockets, socket_means
from diffeo_calib.calibration.placing.placement import Elsewhere, Placement, Seen, Settled
from diffeo_calib.calibration.placing.readings import ROBOT_BASE, ReadingDevices, ball_of_readings, register_readings
from diffeo_calib.common.errors import sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.readings import KIND, SEPARATOR, Readings, SocketReadings
from diffeo_calib.measurements.rows import NO_SOCKET, with_attributes
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.linear_rows import LinearRows
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import fitting_devices
from diffeo_calib.sensors.devices import VALUE, Devices, Hypothesis
from diffeo_calib.sensors.errors import socket_errors
from diffeo_calib.sensors.set_ups import frame_slopes
from diffeo_calib.sensors.tables import OtherReadings
from diffeo_calib.sensors.tool_frames import IN_SOCKET_M, SocketPlaces

FEWEST_BESIDE = 2
"""Rows of a socket besides one that are needed to judge it."""


@dataclass(frozen=True)
class PlaceErrors:
    """A place as predicted by the model without its rows, scales kept."""

    place: str  # its name
    rows: int  # their number
    spread: float  # root mean square distance of the ball from the middle of its socket, m: consistency, no accuracy
    distance_errors: tuple[float, ...]  # found minus known distances of its sockets, m


@dataclass(frozen=True, eq=False)
class SocketDevices(ReadingDevices):
    """The sockets of a calibration, in the measuring frame: that of the device, or the robot's base without one."""

    devices: SocketPlaces
    data: SocketReadings
    left_out: tuple[PlaceErrors, ...] = ()  # every place, predicted by all other rows

    @property
    def sockets(self) -> SocketReadings:
        """Their names and known distances."""
        return with_attributes(self.data, names=self.names)

    @property
    def positions(self) -> Tensor:
        """(S, 3) most probable places, m."""
        return self.devices.constants

    @classmethod
    def found(cls, devices: Devices, data: Any, frame: str) -> ReadingDevices:
        """Known distances are linearised anew there."""
        return cls(SocketPlaces.of(data, devices.constants), data, frame)

    def reason(self, ball: Tensor, small: float) -> str:
        return other_socket(ball, self.positions, self.names, small)

    def elsewhere(self, row: int, points: Tensor, devices: Placement) -> Elsewhere:
        if not bool((self.rows == row).any()):
            return super().elsewhere(row, points, devices)
        away, nearest = torch.cdist(points[:, -1], self.positions.to(points)).min(1)
        there = {"device": nearest, "names": self.names}
        return Elsewhere(away < IN_SOCKET_M, self.positions, lambda copies: with_attributes(copies, **there))

    def hypotheses(self, data: Seen) -> Iterator[Hypothesis]:
        fix = "measure the distance again, and check the unit of the positions and the scale of the device"
        for block in self.sockets.blocks:
            effects = data.points.new_zeros(*data.points.shape, 1)
            for first, second, _ in block:
                along = self.positions[second] - self.positions[first]
                for number, sign in ((first, -0.5), (second, 0.5)):
                    effects[self.rows[self.device == number], -3:, 0] = sign * along / along.norm()
            first, second, length = block[0]
            pair = [self.names[number] for number in (first, second)]
            if len(block) > 1:  # at several places
                pair = [name.rpartition(SEPARATOR)[2] for name in pair]
            name = f"the distance of '{pair[0]}' and '{pair[1]}' ({1e3 * length:.2f} mm)"
            yield Hypothesis(name, data.slopes @ effects, ("mm", 1e-3), fix, about=VALUE)

    def settled(self, fit: Settled) -> SocketDevices:
        root, moved = self.devices.root, self.devices.shifted(fit.shifts)
        if fit.fitted.workspace is not None:  # no device tells where all of them are
            B = frame_slopes(moved.constants[None], moved.constants.mean(0))[0]  # (3 S, 6)
            root = root - B @ (torch.linalg.pinv(B) @ root)
        std = (root @ fit.covariance @ root.mT).diagonal().clamp(min=0).sqrt().view(-1, 3)
        left_out = () if fit.chosen is None else self._left_out(fit.chosen)
        devices = replace(moved, deviations=std, before=())
        return replace(self, devices=devices, left_out=left_out)

    def _left_out(self, chosen: ChosenScales) -> tuple[PlaceErrors, ...]:
        """Every place as predicted by all other rows: with A its block of (G + R)^-1, its errors are A^-1 mu.

        What the others tell about shifts that they share with it, those of a distance, is no prediction of the model.
        """
        data, sockets, places = chosen.data, self.sockets, []
        process = data.process(chosen.selection.scales)
        numbers, shared = process.numbers, process.numbers.of_table(data.shared)
        socket = self.by_row(len(data.y))
        place = torch.where(socket == NO_SOCKET, NO_SOCKET, sockets.place[socket])
        for number, name in enumerate(sockets.place_names):
            index = (place[numbers.owner] == number).nonzero()[:, 0]
            rows = (place == number).nonzero()[:, 0]
            errors = process.left_out(place.new_full(numbers.cells.shape, -1).index_fill(0, index, 0))[0][index]
            others = process.mu - process.inverse[:, index] @ errors  # K^-1 y without the place
            errors = errors + shared[index] @ (shared.T @ others)
            predicted = self.positions[socket[rows]] - errors.view(-1, 3)
            away, distances = socket_errors(predicted, socket[rows], sockets)
            spread = float(away.square().sum(1).mean().sqrt())
            places.append(PlaceErrors(name, len(rows), spread, tuple(distance.error for distance in distances)))
        return tuple(places)

    def warn_of_weakness(self, model: CalibratedKinematics) -> None:
        """Warn of sockets near a plane if one place away from it would make the expected error smaller."""
        place, socket = self.sockets.place, self.by_row(len(model.configurations))
        if model.map.workspace is not None:
            warn_of_flat_places(model.map, self.positions, socket, place, workspace_deviation(model.map))

    @property
    def left_out_spread(self) -> float:
        """Root mean square distance from the middle of its socket over the rows of all places, each left out, m."""
        rows = sum(place.rows for place in self.left_out)
        return (sum(place.rows * place.spread**2 for place in self.left_out) / rows) ** 0.5

    def entry(self) -> dict[str, object]:
        """Positions by name, and spread of places left out, for programs; in m."""
        positions = dict(zip(self.names, self.positions.tolist(), strict=True))
        return {"sockets": {"positions_m": positions, "left_out_spread_m": self.left_out_spread}}

    def sentences(self) -> list[str]:
        """Places of the sockets, how well they are predicted, and what that does not show."""
        among = "among the sockets " * (self.frame == ROBOT_BASE)
        each = zip(self.names, 1e3 * self.positions, 1e3 * self.devices.deviations, strict=True)
        lines = [
            f"socket '{name}': {_listed(place)} mm in {self.frame}, deviations {among}{_listed(deviation)} mm"
            for name, place, deviation in each
        ]
        for left in self.left_out:
            errors = ", ".join(f"{1e3 * error:+.3f}" for error in left.distance_errors)
            text = f", distance {errors} mm" * bool(errors)
            lines.append(f"place '{left.place}' left out: spread {1e3 * left.spread:.4f} mm{text} ({left.rows} rows)")
        return [*lines, f"spread within sockets, each place left out: {1e3 * self.left_out_spread:.4f} mm"]


def _listed(values: Tensor) -> str:
    return ", ".join(f"{value:.3f}" for value in values.tolist())


def other_socket(ball: Tensor, positions: Tensor, names: Sequence[str], small: float) -> str:
    """Why a ball (3,) is far from its socket: it may be in another one of places (S, 3), at most ``small`` m away."""
    away = (ball - positions).norm(dim=1)
    nearest = int(away.argmin())
    if float(away[nearest]) > small:
        return "far from where the other rows of its socket predict it"
    return f"fits socket '{names[nearest]}': named after a wrong one?"


SETS: Mapping[str, type[ReadingDevices]] = {KIND: SocketDevices}
"""Sets of devices of readings but :class:`ReadingDevices`."""


def reading_sets(
    readings: Sequence[OtherReadings], devices: Sequence[Devices], frame: str = ROBOT_BASE
) -> tuple[ReadingDevices, ...]:
    """Sets of devices and the rows that they measured; ``frame``: that of the devices, in words."""
    each = zip(readings, devices, strict=True)
    sets = ((SETS.get(table.kind, ReadingDevices).found(own, table, frame), table, rows) for (table, rows), own in each)
    return tuple(part.measuring(rows, part.devices.numbers(table)) for part, table, rows in sets)


def resting_rows(tables: Sequence[Any]) -> SocketReadings | None:
    """The rows in sockets among tables of one kind each; None without any."""
    return next((table for table in tables if table.kind == KIND), None)


def ball_of(readings: Sequence[Readings], geometry: Geometry, tip: str) -> Geometry | None:
    """A known robot with the ball of readings on a tip as its only marker; None without readings of a ball."""
    if (resting := resting_rows(readings)) is None:
        return ball_of_readings(readings, geometry, tip)
    bare = geometry.with_tool(geometry.tool[-1:], (tip,))
    return register_sockets(bare, resting.q, resting.device).geometry


def check_rows(robot: Tree, tables: Sequence[Readings], *, alone: bool) -> None:
    """Refuse readings on another tip than the robot has, and too few; ``alone``: no other rows tell of the robot."""
    check_readings(robot, [own for own in tables if own.kind != KIND], alone=alone and resting_rows(tables) is None)
    if (resting := resting_rows(tables)) is not None:
        check_sockets(robot, resting)


def register_ball(robot: Tree, tables: Sequence[Readings], tip: tuple[str, ...]) -> Identification:
    """Ball and devices by readings alone, with errors of joints zero: in closed form where the ball rested in sockets.

    Raises:
        MeasurementError: rows that cannot belong to this robot, or known distances that are not its own.

    Warns:
        DiffeoCalibWarning: a tool that never tilts, no known distance, readings that no places explain.
    """
    bare, resting = Geometry.nominal(robot, 1, tip), resting_rows(tables)
    if resting is None:
        return register_readings(bare, tables)
    if not resting.lengths:
        what = "no distance between sockets is known: the size of the robot rests on its description"
        warn_user(sentence(what, fix="pass one: a printed block with two sockets and a caliper are enough"))
    start = register_sockets(robot, resting.q, resting.device)
    check_socket_registration(robot, resting, start)
    devices = [fitting_devices(table, start.geometry.points(table.q)) for table in tables]
    return described(Rows(start.geometry, tuple(map(ReadRows, tables, devices))), adrift=True)


def prior_of(tables: Sequence[Readings]) -> Prior | None:
    """Of the joints' errors by readings alone; None to estimate it, as rows in sockets allow."""
    return Prior() if resting_rows(tables) is None else None


def check_beside(robot: Tree, device: Measurements, start: Identification, tables: Sequence[Readings]) -> None:
    """Check rows in sockets beside measured positions; ``start``: the registration of these."""
    if (resting := resting_rows(tables)) is not None:
        fit = register_sockets(start.geometry, resting.q, resting.device)
        check_socket_registration(robot, resting, fit, start.geometry)
        warn_of_other_robot(robot, device, start, fit)


def warn_of_wrong_names(tables: Sequence[Readings], geometry: Geometry) -> None:
    """Warn of rows that fit another socket than their own by a geometric calibration; refuse them if they are many."""
    if (resting := resting_rows(tables)) is not None:
        warn_of_wrong_sockets(resting, geometry.points(resting.q)[:, -1])


def contradicted_in_sockets(model: CalibratedKinematics, data: Any) -> list[Outlier]:
    """Rows whose ball the model excludes from the middle of their socket, the worst first.

    Each is judged as the model and the other rows of its socket predict it: where the socket is, is an error with a
    wide prior that its rows share. The median distance says in which unit the model's deviations are to be taken: they
    hold for errors elsewhere, and the rows of a socket share most of these.

    Args:
        model: of rows in sockets. data: rows of any kinds that took no part in its fit; those of other kinds are left
            out.
    """
    resting = resting_rows(data.parts)
    if resting is None:
        return []
    fitted, socket, N = model.map, resting.device.to(resting.q.device), len(resting)
    predicted = fitted(resting.q).detach()[:, -3:]
    middles, eye = socket_means(predicted, socket), torch.eye(3, dtype=predicted.dtype, device=predicted.device)
    rests = torch.nn.functional.one_hot(socket).to(predicted)
    judged = rests.sum(0)[socket] > FEWEST_BESIDE
    if not bool(judged.any()):
        return []
    last = torch.nn.functional.pad(eye, (fitted.m - 3, 0)).expand(N, -1, -1)
    spread = fitted.conditional.covariance_between(fitted.geodesic.linearise(resting.q).projected(last))
    places = torch.kron(PLACES.found_m_rad * rests, eye).view(N, 3, -1)
    wide = torch.eye(places.shape[2], dtype=places.dtype, device=places.device)
    noise, every = fitted.new_noise[-3:, -3:].expand(N, -1, -1), torch.ones_like(predicted, dtype=torch.bool)
    rows = LinearRows(middles[socket] - predicted, places, spread, noise, every, wide, wide[0] * 0.0, wide * 0.0)
    squares = rows.left_out_squares.masked_fill(~judged, torch.nan)
    bad = excluded(squares, torch.full_like(squares, 3.0), least=0.0)
    outliers, sizes, names = list[Outlier](), rows.left_out.norm(dim=1), resting.row_names
    for row in bad.nonzero()[:, 0].tolist():
        small = gates.REMAINING_ERROR * float((predicted[row] - middles[socket[row]]).norm())
        reason = other_socket(predicted[row], middles, resting.names, small)
        outliers.append(Outlier(row, None, int(resting.line_numbers[row]), names[row], float(sizes[row]), None, reason))
    return sorted(outliers, key=lambda outlier: -outlier.distance)
