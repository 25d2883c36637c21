"""Where sockets are before the exact fit: registration and geometric calibration of rows with a ball in sockets.

Ball and sockets are found in the measuring frame: the robot's base, or that of the device that measured other rows. The
rows of a socket then have its place as their measured position, and what is not known about it is an error that they
share, with a wide prior; known distances between sockets, linearised where these are, narrow it. Places are found again
with the geometric errors.

Without a device no row says where the robot's base is: base and error twist of the first joint are held.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.plausibility import check_deviations, check_identification, registered
from diffeo_calib.calibration.diagnostics.socket_plausibility import (
    check_registration,
    check_sockets,
    warn_of_other_robot,
    warn_of_wrong_sockets,
)
from diffeo_calib.calibration.identification.identification import Identification, identify
from diffeo_calib.calibration.identification.socket_registration import (
    SocketRegistration,
    register_sockets,
    socket_means,
)
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, sentence, warn_user
from diffeo_calib.measurements.frozen import with_attributes
from diffeo_calib.measurements.sockets import NO_SOCKET, Sockets, with_sockets_of_rows
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree

PLACE_DEVIATION_M = 0.1
"""Prior standard deviation of a socket around the place where it was found: wide."""
ALIKE = 0.05
"""Deviation of a block's distance from one place to another, relative to that of the distance itself."""
SIZE_SHARE = 0.005
"""Difference of known distances from those of a robot that they do not scale, as a share, that is warned about."""
ROUNDS = 2
"""Geometric calibrations, after each of which the sockets are placed again."""


@dataclass(frozen=True, eq=False)
class SocketPlaces:
    """Where sockets are in the measuring frame, before the exact fit.

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
        for known in sockets.blocks:
            U = positions.new_zeros(len(known), *positions.shape)
            errors = positions.new_zeros(len(known))
            for number, (first, second, length) in enumerate(known):
                away = positions[second] - positions[first]
                U[number, second] = away / away.norm()
                U[number, first] = -U[number, second]
                errors[number] = length - float(away.norm())
            U = U.flatten(1)
            own = torch.eye(len(known), dtype=U.dtype, device=U.device) * ALIKE**2
            weighed = torch.linalg.solve((1.0 + own) * (sockets.distance_std or 1.0) ** 2, U).mT
            precision = precision + weighed @ U
            push = push + weighed @ errors
        factor = torch.linalg.cholesky(precision)
        root = torch.linalg.solve_triangular(factor, eye, upper=False).mT
        return cls(sockets, positions + (root @ (root.mT @ push)).view(-1, 3), root)

    def placed(self, data: Measurements) -> Measurements:
        """The rows with the places of their sockets as measured positions of the ball."""
        rows, points = _resting(data), data.points.clone()
        points[rows, -1] = self.positions[_socket(data)[rows]]
        return with_attributes(data, points=points)

    def shared(self, data: Measurements) -> Tensor:
        """What is not known of the places, as noise that rows share: (N, 3 P, 3 S) effects of unit variance [m]."""
        rows, own = _resting(data), self.root.view(len(self.positions), 3, -1)
        effects = own.new_zeros(len(data), 3 * data.markers, own.shape[2])
        effects[rows, -3:] = own[_socket(data)[rows]]
        return effects


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
    device = None if data.without_device else data.device_rows()
    start = None if device is None else registered(robot, device)
    resting = data.socket_rows()
    found = register_sockets(robot if start is None else start.geometry, resting.q, _socket(resting))
    check_registration(robot, resting, found)
    registration = found.identification if start is None else _together(start, found.identification, data)
    identification, places = geometry_by_sockets(data, found.positions, registration)
    if device is not None and start is not None:
        check_identification(device, replace(identification, geometry=_without_ball(identification.geometry)))
        check_deviations(device, start)
        warn_of_other_robot(robot, device, start, found)
    _warn_of_size(data, found, registration)
    warn_of_wrong_sockets(resting, _ball(identification.geometry, resting))
    return places, places.placed(data), (registration, identification)


def _together(device: Identification, ball: Identification, data: Measurements) -> Identification:
    """The registration of markers that a device saw, with the ball as one more marker."""
    geometry = device.geometry
    whole = geometry.with_tool(torch.cat([geometry.tool, ball.geometry.tool]), (*geometry.on, geometry.on[-1]))
    covariance = geometry.tool.new_zeros(whole.size, whole.size)
    covariance[:-3, :-3], covariance[-3:, -3:] = device.covariance, ball.covariance[-3:, -3:]
    return replace(
        device,
        geometry=whole,
        covariance=covariance,
        status=f"{device.status[:-1]}; {ball.status}",
        theta=geometry.tool.new_zeros(whole.size),
        tails=Tails.none(len(data), whole.markers, device=geometry.tool.device),
    )


def _without_ball(geometry: Geometry) -> Geometry:
    """The geometry of the markers that a device saw."""
    return geometry.with_tool(geometry.tool[:-1], geometry.on[:-1])


def _ball(geometry: Geometry, data: Measurements) -> Tensor:
    """Places (N, 3) of the ball, m."""
    return geometry.points(data.q)[:, -1]


def geometry_by_sockets(
    data: Measurements, positions: Tensor, registration: Identification
) -> tuple[Identification, SocketPlaces]:
    """Geometric calibration, and the places of the sockets around it.

    Args:
        data: rows with sockets. positions: (S, 3) of the registration [m].
    """
    geometry, resting = registration.geometry, data.socket_rows()
    held = held_parameters(geometry) if data.without_device else ()
    places = SocketPlaces.around(_known(data), positions)
    for _ in range(ROUNDS):
        placed, shared = places.placed(data), places.shared(data).unflatten(1, (-1, 3))
        found = identify(geometry, placed.q, placed.points, shared=shared, held=held)
        places = SocketPlaces.around(_known(data), socket_means(_ball(found.geometry, resting), _socket(resting)))
    return found, places


def _warn_of_size(data: Measurements, found: SocketRegistration, registration: Identification) -> None:
    """Warn of distances that would scale the robot: an error of the caliper becomes one of every link."""
    sockets, resting = _known(data), data.socket_rows()
    if not sockets.distances:
        return
    unknown = with_attributes(data, sockets=Sockets(sockets.names))
    geometry = geometry_by_sockets(unknown, found.positions, registration)[0].geometry
    middles = socket_means(_ball(geometry, resting), _socket(resting))
    if data.without_device:
        source, effect = "the robot's description says", "the fit makes the whole robot {:.1f} % {}"
        fix = "measure the distance again: links are seldom that wrong"
    else:
        source, effect = "the measured positions say", "the block is {:.1f} % {} than these say"
        fix = "measure the distance again, and check the unit of the positions and the scale of the device"
    for known in sockets.blocks:
        seen = sum(float((middles[a] - middles[b]).norm()) for a, b, _ in known) / len(known)
        length = known[0][2]
        if abs(seen - length) > SIZE_SHARE * length + 3 * (sockets.distance_std or 0.0):
            first, second = (f"'{sockets.names[number]}'" for number in known[0][:2])
            what = (
                f"{source} {1e3 * seen:.2f} mm for the known {1e3 * length:.2f} mm of {first} and "
                f"{second}{' (mean over places)' * (len(known) > 1)}: "
                + effect.format(abs(100 * (length / seen - 1)), "longer" if length > seen else "shorter")
            )
            warn_user(sentence(what, fix=fix))


def _known(data: Measurements) -> Sockets:
    if data.sockets is None:
        raise InputError.of("the rows have no sockets", fix="pass Measurements.from_sockets(...)")
    return data.sockets


def _socket(data: Measurements) -> Tensor:
    if data.socket is None:
        raise InputError.of("the rows have no sockets", fix="pass Measurements.from_sockets(...)")
    return data.socket.to(HOST)


def _resting(data: Measurements) -> Tensor:
    """(N,) boolean: the rows whose ball rested in a socket."""
    return _socket(data) != NO_SOCKET
