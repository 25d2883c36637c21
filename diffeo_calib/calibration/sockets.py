"""Calibration without a measuring device: a ball on the tool rests in sockets whose places are not known.

Ball and sockets are found in the robot's base, which is the measuring frame. The rows of a socket then have its place
as their measured position, and what is not known about it is an error that they share, with a wide prior; known
distances between sockets, linearised where these are, narrow it. Places are found again with the geometric errors.

No row says where the robot's base is. Base and error twist of the first joint are held; rigid motions that remain in
the fields say nothing about the robot, and are taken out of all covariances (regression/rigid_motions.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import ChosenScales
from diffeo_calib.calibration.diagnostics.socket_plausibility import (
    check_registration,
    check_sockets,
    warn_of_wrong_sockets,
)
from diffeo_calib.calibration.identification.identification import Identification, identify
from diffeo_calib.calibration.identification.socket_registration import register_sockets, socket_means
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.re_registration.registered_map import frame_slopes
from diffeo_calib.kinematics.socket_errors import socket_errors
from diffeo_calib.measurements.frozen import with_attributes
from diffeo_calib.measurements.sockets import Sockets, with_sockets_of_rows
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.choose import condition_for_covariances
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree

PLACE_DEVIATION_M = 0.1
"""Prior standard deviation of a socket around the place where it was found: wide."""
WORKSPACE_ROWS = 100
"""Random configurations in the joint ranges of the rows, over which rigid motions are left out."""
FLATTERY = (
    "the spread within sockets flatters: errors that all rows of a socket share, and the robot's size, do not show in "
    "it, so that absolute errors are 2 to 6 times as large; choose nothing by it"
)
ROUNDS = 2
"""Geometric calibrations, after each of which the sockets are placed again."""


@dataclass(frozen=True, eq=False)
class SocketPlaces:
    """Where sockets are in the robot's base, before the exact fit.

    Args:
        sockets: their names and known distances.
        positions: (S, 3) most probable places, m.
        root: (3 S, 3 S) square root of the covariance of the places, m.
    """

    sockets: Sockets
    positions: Tensor
    root: Tensor

    @classmethod
    def around(cls, sockets: Sockets, positions: Tensor) -> SocketPlaces:
        """Wide around positions (S, 3), and with the known distances linearised there [m]."""
        eye = torch.eye(positions.numel(), dtype=positions.dtype, device=positions.device)
        precision = eye / PLACE_DEVIATION_M**2
        push = torch.zeros_like(positions).flatten()
        for first, second, length in sockets.distances:
            away = positions[second] - positions[first]
            row = torch.zeros_like(positions)
            row[second] = away / away.norm()
            row[first] = -row[second]
            row = row.flatten() / (sockets.distance_std or 1.0)
            precision = precision + torch.outer(row, row)
            push = push + row * (length - float(away.norm())) / (sockets.distance_std or 1.0)
        factor = torch.linalg.cholesky(precision)
        root = torch.linalg.solve_triangular(factor, eye, upper=False).mT
        return cls(sockets, positions + (root @ (root.mT @ push)).view(-1, 3), root)

    def placed(self, data: Measurements) -> Measurements:
        """The rows with the places of their sockets as measured positions."""
        return with_attributes(data, points=self.positions[_socket(data)][:, None])

    def shared(self, data: Measurements) -> Tensor:
        """What is not known of the places, as noise that rows share: (N, 3, 3 S) effects of unit variance [m]."""
        return self.root.view(len(self.positions), 3, -1)[_socket(data)]


@dataclass(frozen=True)
class PlaceErrors:
    """A place as predicted by the model without its rows, scales kept.

    Args:
        place: its name. rows: their number.
        spread: root mean square distance of the ball from the middle of its socket, m: consistency, no accuracy.
        distance_errors: found minus known distances of its sockets, m.
    """

    place: str
    rows: int
    spread: float
    distance_errors: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class FoundSockets:
    """The sockets after a calibration, in the robot's base.

    Args:
        names: S names. positions: (S, 3) m.
        covariance: (3 S, 3 S) of the positions, without rigid motions of all of them, m^2.
        left_out: every place, predicted by the others.
        workspace_deviation: root mean square distance, m, that the model expects between its positions and the true
            ones over the joint ranges of the rows, after the best rigid motion.
    """

    names: tuple[str, ...]
    positions: Tensor
    covariance: Tensor
    left_out: tuple[PlaceErrors, ...]
    workspace_deviation: float

    @property
    def deviations(self) -> Tensor:
        """(S, 3) standard deviations of the coordinates, m."""
        return self.covariance.diagonal().clamp(min=0).sqrt().view(-1, 3)

    @property
    def left_out_spread(self) -> float:
        """Root mean square distance from the middle of its socket over the rows of all places, each left out, m."""
        rows = sum(one.rows for one in self.left_out)
        return (sum(one.rows * one.spread**2 for one in self.left_out) / rows) ** 0.5

    def entry(self) -> dict[str, object]:
        """Positions by name, spread of places left out, and expected absolute error, for programs; all in m."""
        positions = dict(zip(self.names, self.positions.tolist(), strict=True))
        spread = self.left_out_spread
        return {"positions_m": positions, "left_out_spread_m": spread, "expected_error_m": self.workspace_deviation}

    def sentences(self) -> list[str]:
        """Places of the sockets, how well they are predicted, and what that does not show."""
        lines = [
            f"socket '{name}': {', '.join(f'{1e3 * v:.3f}' for v in place)} mm in the robot's base, deviations "
            f"among the sockets {', '.join(f'{1e3 * v:.3f}' for v in deviation)} mm"
            for name, place, deviation in zip(
                self.names, self.positions.tolist(), self.deviations.tolist(), strict=True
            )
        ]
        for one in self.left_out:
            errors = ", ".join(f"{1e3 * error:+.3f}" for error in one.distance_errors)
            known = f", distance {errors} mm" * bool(errors)
            lines.append(f"place '{one.place}' left out: spread {1e3 * one.spread:.4f} mm{known} ({one.rows} rows)")
        lines.append(
            f"spread within sockets, each place left out: {1e3 * self.left_out_spread:.4f} mm; expected absolute error "
            f"over the joint ranges of the rows, after a rigid fit: {1e3 * self.workspace_deviation:.3f} mm"
        )
        return [*lines, FLATTERY]


def held_parameters(geometry: Geometry) -> tuple[int, ...]:
    """Numbers of the parameters that sockets cannot tell apart from where the robot stands."""
    base, joints = geometry.slices["base"], geometry.slices["joints"]
    return (*range(base.start, base.stop), *range(joints.start, joints.start + 6))


def stages_by_sockets(
    robot: Tree, data: Measurements
) -> tuple[SocketPlaces, Measurements, tuple[Identification, Identification]]:
    """Where the sockets are, the rows placed there, and registration and geometric calibration.

    Raises:
        MeasurementError: too few rows, rows that are in no socket, known distances that are not those of the robot.

    Warns:
        DiffeoCalibWarning: a tool that never tilts, rows in a wrong socket, no known distance.
    """
    data = with_sockets_of_rows(data)
    check_sockets(robot, data)
    found = register_sockets(robot, data.q, _socket(data))
    check_registration(robot, data, found)
    identification, places = geometry_by_sockets(data, found.positions, found.identification)
    warn_of_wrong_sockets(data, identification)
    return places, places.placed(data), (found.identification, identification)


def geometry_by_sockets(
    data: Measurements, positions: Tensor, registration: Identification
) -> tuple[Identification, SocketPlaces]:
    """Geometric calibration, and the places of the sockets around it.

    Args:
        data: rows with sockets. positions: (S, 3) of the registration [m].
    """
    geometry = registration.geometry
    held = held_parameters(geometry)
    places = SocketPlaces.around(_known(data), positions)
    for _ in range(ROUNDS):
        placed, shared = places.placed(data), places.shared(data)[:, None]
        found = identify(geometry, placed.q, placed.points, shared=shared, held=held)
        places = SocketPlaces.around(_known(data), socket_means(found.geometry.points(data.q)[:, 0], _socket(data)))
    return found, places


def found_sockets(fitted: FittedMap, placed: Measurements, places: SocketPlaces, chosen: ChosenScales) -> FoundSockets:
    """The sockets with what the fit says about them.

    Args:
        fitted: the map, without rigid motions. placed: its rows, as :meth:`SocketPlaces.placed` gives them.
        places: where the sockets were before. chosen: scales, and the rows with their weights.
    """
    noise = fitted.noise
    errors = (placed.points - fitted(placed.q).detach().unflatten(1, (-1, 3))).flatten(1)
    shifts = torch.einsum("nmc,nm->c", noise.shared, noise.solve(errors))
    positions = places.positions - (places.root @ shifts).view(-1, 3)
    B = frame_slopes(positions[None], positions.mean(0))[0]  # (3 S, 6)
    root = places.root - B @ (torch.linalg.pinv(B) @ places.root)
    # (1 + Z^T (G + R_i)^-1 Z)^-1: 1 - Z^T (G + R)^-1 Z would lose all digits, so wide is their prior
    alone = condition_for_covariances(fitted.geodesic.linearise(fitted.data), noise.own)
    known = torch.einsum("nmc,nmk->ck", noise.shared, alone.solve(noise.shared))
    known = known + torch.eye(len(known), dtype=known.dtype, device=known.device)
    covariance = root @ torch.linalg.solve(known, root.mT)
    spread = workspace_deviation(fitted)
    return FoundSockets(places.sockets.names, positions, covariance, _left_out(placed, chosen), spread)


def workspace_deviation(fitted: FittedMap) -> float:
    """Root mean square distance, m, between modelled and true positions that the model expects over its workspace."""
    if fitted.workspace is None:
        raise InputError.of("the map has no workspace", fix="calibrate with sockets")
    covariance = fitted.posterior(fitted.workspace, noise=False)[1]
    return float(covariance.diagonal(dim1=1, dim2=2).sum(1).mean().sqrt())


def without_rigid_motions(fitted: FittedMap) -> FittedMap:
    """The same map whose covariances leave out rigid motions over the joint ranges of its rows."""
    low, high = fitted.x.amin(0), fitted.x.amax(0)
    shape = WORKSPACE_ROWS, len(low)
    draws = torch.rand(shape, dtype=torch.float64, generator=seeded(0), device=HOST).to(low)
    return FittedMap(fitted.deformation, fitted.noise, fitted.data, fitted.new_noise, low + (high - low) * draws)


def _left_out(placed: Measurements, chosen: ChosenScales) -> tuple[PlaceErrors, ...]:
    """Every place as predicted by the rows of the others: with A its block of (G + R)^-1, its errors are A^-1 mu."""
    sockets, socket = _known(placed), _socket(placed)
    data, found = chosen.data, []
    dense = data.factorised(chosen.selection.scales)
    inverse, mu = torch.cholesky_inverse(dense.factor), dense.mu(data.target)
    coordinates = torch.arange(mu.numel(), device=mu.device).view(mu.shape)
    for number, name in enumerate(sockets.place_names):
        rows = (sockets.place[socket] == number).nonzero()[:, 0]
        index = coordinates[rows].flatten()
        errors = torch.linalg.solve(inverse[index][:, index], mu[rows].flatten()).view(-1, 3)
        predicted = placed.points[rows, 0] - errors
        found.append(PlaceErrors(name, len(rows), *_spread(predicted, socket[rows], sockets)))
    return tuple(found)


def _spread(predicted: Tensor, socket: Tensor, sockets: Sockets) -> tuple[float, tuple[float, ...]]:
    """Spread of predicted positions (N, 3) within sockets, and errors of the known distances, m."""
    errors = socket_errors(predicted, socket, sockets)
    return float(errors.away.square().sum(-1).mean().sqrt()), tuple(one.error for one in errors.distances)


def _known(data: Measurements) -> Sockets:
    if data.sockets is None:
        raise InputError.of("the rows have no sockets", fix="pass Measurements.from_sockets(...)")
    return data.sockets


def _socket(data: Measurements) -> Tensor:
    if data.socket is None:
        raise InputError.of("the rows have no sockets", fix="pass Measurements.from_sockets(...)")
    return data.socket.to(HOST)
