"""Sockets: where they are before the exact fit, and what it says about them.

Ball and sockets are found in the measuring frame: the robot's base, or that of the device that measured other rows. The
rows of a socket then have its place as their measured position, and what is not known about it is an error that they
share, with a wide prior; known distances between sockets, linearised where these are, narrow it. Places are found again
with the geometric errors.

Without a device no row says where the robot's base is: base and error twist of the first joint are held.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import ChosenScales
from diffeo_calib.calibration.diagnostics.open_directions import warn_of_flat_places
from diffeo_calib.calibration.diagnostics.outliers import Outlier, excluded, found_outliers
from diffeo_calib.calibration.diagnostics.plausibility import (
    check_socket_registration,
    check_sockets,
    registered,
    warn_of_other_robot,
    warn_of_wrong_sockets,
)
from diffeo_calib.calibration.expected_errors import workspace_deviation
from diffeo_calib.calibration.identification.identification import (
    Identification,
    MeasuredPoints,
    Rows,
    described,
    with_ball,
)
from diffeo_calib.calibration.identification.registration import (
    register_sockets,
    socket_means,
)
from diffeo_calib.calibration.placing.placement import DeviceSet, Elsewhere, OtherRows, Placement, Seen, Settled
from diffeo_calib.common.errors import MeasurementError, few, sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.checks import numbers_of
from diffeo_calib.measurements.rows import NO_SOCKET, with_attributes
from diffeo_calib.measurements.sockets import SEPARATOR, Sockets
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.linear_rows import LinearRows
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import VALUE, Hypothesis
from diffeo_calib.sensors.errors import socket_errors
from diffeo_calib.sensors.set_ups import frame_slopes
from diffeo_calib.sensors.tool_frames import IN_SOCKET_M, SocketPlaces

ALIKE = 0.05
"""Deviation of a block's distance from one place to another, relative to that of the distance itself."""
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
class SocketDevices(DeviceSet):
    """The sockets of a calibration, in the measuring frame: that of the device, or the robot's base without one."""

    devices: SocketPlaces
    sockets: Sockets  # their names and known distances
    root: Tensor  # (3 S, 3 S) square root of the covariance of their places before the fit, m
    by_device: bool  # whether a device measured other rows
    # (3 S, 3 S) of the positions, m^2; after a fit without a device without rigid motions of all of them
    covariance: Tensor
    left_out: tuple[PlaceErrors, ...] = ()  # every place, predicted by all other rows

    @classmethod
    def around(cls, data: Measurements, positions: Tensor) -> SocketDevices:
        """The sockets of a table, wide around positions (S, 3), and with the known distances linearised there [m]."""
        sockets, S = data.known_sockets, len(positions)
        wide, one_hot = (torch.eye(size, dtype=positions.dtype, device=positions.device) for size in (3 * S, S))
        equations = [torch.nn.functional.pad(wide / PLACES.found_m_rad, (0, 1))]
        for known in sockets.blocks:
            first, second, lengths = (list(each) for each in zip(*known, strict=True))
            away = positions[second] - positions[first]
            U = (one_hot[second] - one_hot[first])[:, :, None] * torch.nn.functional.normalize(away)[:, None]
            own = torch.cat([U.flatten(1), (away.new_tensor(lengths) - away.norm(dim=1))[:, None]], 1)
            noise = (1.0 + ALIKE**2 * own.new_ones(len(own)).diag()) * (sockets.distance_std or 1.0) ** 2
            equations.append(torch.linalg.solve_triangular(torch.linalg.cholesky(noise), own, upper=False))
        R = torch.linalg.qr(torch.cat(equations), mode="r").R[: 3 * S]
        root = torch.linalg.solve_triangular(R[:, :-1], wide, upper=True)
        places, rows = positions + (root @ R[:, -1]).view(-1, 3), (data.socket_numbers != NO_SOCKET).nonzero()[:, 0]
        covariance = root @ root.mT
        devices = SocketPlaces(sockets.names, places, _deviations(covariance), rows, data.socket_numbers[rows])
        return cls(devices, sockets, root, not data.without_device, covariance)

    @classmethod
    def around_model(cls, table: Measurements, rows: Tensor, seen: Tensor) -> list[SocketDevices]:
        """The sockets around a model that is known; nothing without sockets.

        Args:
            table: M rows. rows: (M,) their numbers in a table of N. seen: (N, 3 P) points of the model, m.
        """
        if table.sockets is None:
            return []
        socket = table.socket_numbers
        resting = socket != NO_SOCKET
        return [cls.around(table, socket_means(seen[rows][resting, -3:], socket[resting])).of_rows(rows)]

    @property
    def positions(self) -> Tensor:
        """(S, 3) most probable places, m."""
        return self.devices.constants

    def shared(self, count: int, coordinates: int) -> Tensor:
        """Uncertainty of the places, as errors of the last marker that ``count`` rows share: (N, 3 P, 3 S), m."""
        own = self.root.view(len(self.positions), 3, -1)
        effects = own.new_zeros(count, coordinates, own.shape[2])
        effects[self.rows, -3:] = own[self.device]
        return effects

    def found(self, data: Measurements, stage: Identification) -> SocketDevices:
        """Move the sockets to the places that a geometric calibration found; its first shifts are theirs."""
        resting = data.socket_rows()
        warn_of_wrong_sockets(resting, stage.geometry.points(resting.q)[:, -1])
        return SocketDevices.around(data, self.positions + (self.root @ stage.shifts[0]).view(-1, 3))

    def at_places(self, table: Measurements) -> Measurements:
        """The places of their sockets as measured positions of the ball."""
        table = self.named(table)
        rows, points = table.socket_numbers != NO_SOCKET, table.points.clone()
        points[rows, -1] = self.positions[table.socket_numbers[rows]]
        return with_attributes(table, points=points)

    def elsewhere(self, row: int, points: Tensor, devices: Placement) -> Elsewhere:
        if not bool((self.rows == row).any()):
            return super().elsewhere(row, points, devices)
        away, nearest = torch.cdist(points[:, -1], self.positions.to(points)).min(1)
        there = {"socket": nearest, "sockets": self.sockets}
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

    def effects(self, data: Seen) -> Tensor:
        return data.slopes @ self.shared(*data.points.shape)

    def settled(self, found: Settled) -> SocketDevices:
        root, positions = self.root, self.positions - (self.root @ found.shifts).view(-1, 3)
        if found.fitted.workspace is not None:
            B = frame_slopes(positions[None], positions.mean(0))[0]  # (3 S, 6)
            root = root - B @ (torch.linalg.pinv(B) @ root)
        covariance = root @ found.covariance @ root.mT
        devices = replace(self.devices, constants=positions, deviations=_deviations(covariance))
        left_out = () if found.chosen is None else self._left_out(found.chosen)
        return replace(self, devices=devices, covariance=covariance, left_out=left_out)

    def with_rows(self, other: OtherRows) -> SocketDevices:
        rows = socket = self.rows[:0]
        if other.coordinates is not None:
            socket = self.named(other.coordinates.table).socket_numbers
            rows, socket = other.coordinates.rows[socket != NO_SOCKET], socket[socket != NO_SOCKET]
        return self.measuring(rows, socket)

    def named(self, table: Measurements) -> Measurements:
        """The rows of a table with these sockets; MeasurementError for others."""
        unknown = sorted(set(table.row_sockets) - {*self.names, ""})
        if unknown:
            raise MeasurementError.of("rows in sockets", expected=few(self.names), got=few(unknown))
        return with_attributes(table, socket=numbers_of(table.row_sockets, self.names), sockets=self.sockets)

    def _left_out(self, chosen: ChosenScales) -> tuple[PlaceErrors, ...]:
        """Every place as predicted by all other rows: with A its block of (G + R)^-1, its errors are A^-1 mu.

        What the others tell about shifts that they share with it, those of a distance, is no prediction of the model.
        """
        data, sockets, found = chosen.data, self.sockets, []
        process = data.process(chosen.selection.scales)
        numbers, shared = process.numbers, process.numbers.of_table(data.shared)
        socket = self.by_row(len(data.y))
        place = torch.where(socket == NO_SOCKET, NO_SOCKET, sockets.place[socket])
        ball = numbers.cells % numbers.shape[1] >= numbers.shape[1] - 3
        for number, name in enumerate(sockets.place_names):
            index = (ball & (place[numbers.owner] == number)).nonzero()[:, 0]
            rows = (place == number).nonzero()[:, 0]
            errors = process.left_out(place.new_full(numbers.cells.shape, -1).index_fill(0, index, 0))[0][index]
            others = process.mu - process.inverse[:, index] @ errors  # K^-1 y without the place
            errors = errors + shared[index] @ (shared.T @ others)
            predicted = data.y[rows, -3:] - errors.view(-1, 3)
            away, distances = socket_errors(predicted, socket[rows], sockets)
            spread = float(away.square().sum(1).mean().sqrt())
            found.append(PlaceErrors(name, len(rows), spread, tuple(one.error for one in distances)))
        return tuple(found)

    def warn_of_weakness(self, model: CalibratedKinematics) -> None:
        """Warn of sockets near a plane if one place away from it would make the expected error smaller."""
        place, socket = self.sockets.place, self.by_row(len(model.configurations))
        if model.map.workspace is not None:
            warn_of_flat_places(model.map, self.positions, socket, place, workspace_deviation(model.map))

    @property
    def left_out_spread(self) -> float:
        """Root mean square distance from the middle of its socket over the rows of all places, each left out, m."""
        rows = sum(one.rows for one in self.left_out)
        return (sum(one.rows * one.spread**2 for one in self.left_out) / rows) ** 0.5

    def entry(self) -> dict[str, object]:
        """Positions by name, and spread of places left out, for programs; in m."""
        positions = dict(zip(self.names, self.positions.tolist(), strict=True))
        return {"sockets": {"positions_m": positions, "left_out_spread_m": self.left_out_spread}}

    def sentences(self) -> list[str]:
        """Places of the sockets, how well they are predicted, and what that does not show."""
        frame = "the measuring frame" if self.by_device else "the robot's base"
        among = "" if self.by_device else "among the sockets "
        each = zip(self.names, 1e3 * self.positions, 1e3 * self.devices.deviations, strict=True)
        lines = [
            f"socket '{name}': {_listed(place)} mm in {frame}, deviations {among}{_listed(deviation)} mm"
            for name, place, deviation in each
        ]
        for one in self.left_out:
            errors = ", ".join(f"{1e3 * error:+.3f}" for error in one.distance_errors)
            known = f", distance {errors} mm" * bool(errors)
            lines.append(f"place '{one.place}' left out: spread {1e3 * one.spread:.4f} mm{known} ({one.rows} rows)")
        return [*lines, f"spread within sockets, each place left out: {1e3 * self.left_out_spread:.4f} mm"]


def _deviations(covariance: Tensor) -> Tensor:
    return covariance.diagonal().clamp(min=0).sqrt().view(-1, 3)


def _listed(values: Tensor) -> str:
    return ", ".join(f"{value:.3f}" for value in values.tolist())


def register_coordinates(robot: Tree, data: Measurements) -> tuple[Identification, list[SocketDevices]]:
    """Base and markers of rows that tell coordinates in one measuring frame, and the sockets.

    Raises:
        MeasurementError: rows that cannot belong to this robot, too few, or known distances that are not those of the
            robot.

    Warns:
        DiffeoCalibWarning: a tool that never tilts, no known distance, rows in sockets that are not of the robot that a
            device measured.
    """
    if data.sockets is None:
        return registered(robot, data), []
    data = data.with_sockets_of_rows()
    check_sockets(robot, data)
    start = None if data.without_device else registered(robot, data.device_rows())
    if start is None and not data.known_sockets.distances:
        what = "no distance between sockets is known: the size of the robot rests on its description"
        warn_user(sentence(what, fix="pass one: a printed block with two sockets and a caliper are enough"))
    around, resting = None if start is None else start.geometry, data.socket_rows()
    found = register_sockets(around or robot, resting.q, resting.socket_numbers)
    check_socket_registration(robot, resting, found, around)
    places = SocketDevices.around(data, found.positions)
    placed, shared = places.at_places(data), places.shared(len(data), 3 * data.markers).unflatten(1, (-1, 3))
    ball = MeasuredPoints.of(*(values[places.rows] for values in (placed.q, placed.points, shared)))
    if start is None:
        return described(Rows(found.geometry, (ball,)), adrift=True), [places]
    device = data.device_rows()
    warn_of_other_robot(robot, device, start, found)
    rows = Rows(with_ball(start.geometry, found.geometry), (MeasuredPoints.of(device.q, device.points), ball))
    return described(rows, [start.noise]), [places]


def ball_in_sockets(data: Measurements, geometry: Geometry) -> Tensor | None:
    """(3,) the ball of rows in sockets in the frame of its tip of a known robot, m; None without such rows."""
    if data.sockets is None:
        return None
    resting = data.with_sockets_of_rows().socket_rows()
    return register_sockets(geometry, resting.q, resting.socket_numbers).geometry.tool[0]


def contradicted_in_sockets(model: CalibratedKinematics, data: Measurements) -> list[Outlier]:
    """Rows whose ball the model excludes from the middle of their socket, the worst first.

    Each is judged as the model and the other rows of its socket predict it: where the socket is, is an error with a
    wide prior that its rows share. The median distance says in which unit the model's deviations are to be taken: they
    hold for errors elsewhere, and the rows of a socket share most of these.

    Args:
        model: of rows in sockets. data: rows in sockets that took no part in its fit; rows of other kinds are left out.
    """
    if not bool((data.places >= 0).any()):
        return []
    resting = data.socket_rows().with_sockets_of_rows()
    seen, socket, N = model.map, resting.socket_numbers.to(resting.q.device), len(resting)
    predicted = seen(resting.q).detach()[:, -3:]
    middles, eye = socket_means(predicted, socket)[socket], torch.eye(3, dtype=predicted.dtype, device=predicted.device)
    rests = torch.nn.functional.one_hot(socket).to(predicted)
    judged = rests.sum(0)[socket] > FEWEST_BESIDE
    if not bool(judged.any()):
        return []
    last = torch.nn.functional.pad(eye, (seen.m - 3, 0)).expand(N, -1, -1)
    own = seen.conditional.covariance_between(seen.geodesic.linearise(resting.q).projected(last))
    places = torch.kron(PLACES.found_m_rad * rests, eye).view(N, 3, -1)
    wide = torch.eye(places.shape[2], dtype=places.dtype, device=places.device)
    noise, every = seen.new_noise[-3:, -3:].expand(N, -1, -1), torch.ones_like(predicted, dtype=torch.bool)
    rows = LinearRows(middles - predicted, places, own, noise, every, wide, wide[0] * 0.0, wide * 0.0)
    squares = rows.left_out_squares.masked_fill(~judged, torch.nan)
    bad = torch.zeros(N, model.markers, dtype=torch.bool, device=own.device)
    bad[:, -1] = excluded(squares, torch.full_like(squares, 3.0), least=0.0)
    distances = rows.left_out.norm(dim=1)[:, None].expand(-1, model.markers)
    placed = with_attributes(resting, points=middles[:, None])
    return found_outliers(model, placed.with_markers(model.markers), bad, distances)
