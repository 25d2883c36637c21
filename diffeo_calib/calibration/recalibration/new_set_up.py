"""New rows of any kinds beside an old model: where devices and markers are now.

Where a device measured coordinates, it says where the robot stands: the frame of the device (of the largest session) is
found by a registration. Sockets and the devices of readings stand around the robot that the model knows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.socket_plausibility import check_no_sessions
from diffeo_calib.calibration.identification.socket_registration import register_sockets
from diffeo_calib.calibration.placing.readings import identify_readings
from diffeo_calib.calibration.placing.sessions import SessionFrames
from diffeo_calib.calibration.recalibration.added_ball import with_ball
from diffeo_calib.calibration.recalibration.checks import check_kinds, check_place, check_size
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.joint_order import check_joint_order
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.payload import check_masses, check_payloads
from diffeo_calib.kinematics.re_registration.register_again import FoundPlace, find_place
from diffeo_calib.kinematics.re_registration.registered_map import RegisteredMap, Registration
from diffeo_calib.kinematics.re_registration.session import with_lever
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.devices import check_devices
from diffeo_calib.sensors.tables import (
    Coordinates,
    OtherReadings,
    ball_tip,
    divided,
    measured_rows,
    with_markers,
)

BALL_DEVIATION_M = 0.1
"""Prior standard deviation of a ball that the old model does not know around the place where the rows put it: wide."""


@dataclass(frozen=True, eq=False)
class Before:
    """The old map in its own frame, and the new rows.

    Args:
        fitted: the old map, with the ball of the new rows. nominal: its nominal map.
        data: the new rows. coordinates: those that tell coordinates, with the markers of the map, in the frame of the
            largest set-up. readings: the others.
        place: where device and markers were found; None where no device measured coordinates.
        sessions: frames of the set-ups, if there are several.
        ball: (3,) where the new rows by themselves put the ball on its tip, m; None without one.
        new_ball: whether the old model does not know it.
    """

    fitted: FittedMap
    nominal: GeometryMap
    data: Any
    coordinates: Coordinates | None
    readings: list[OtherReadings]
    place: FoundPlace | None
    sessions: SessionFrames | None
    ball: Tensor | None
    new_ball: bool

    @property
    def registration(self) -> Registration | None:
        """Of the device that measured coordinates."""
        return None if self.place is None else self.place.registration

    @property
    def transform(self) -> Tensor:
        """(4, 4) from the frame of the map to that of the new rows, m."""
        found = self.registration
        return torch.eye(4, dtype=self.data.q.dtype, device=HOST) if found is None else found.transform

    @property
    def at_rows(self) -> GeometryMap:
        """The nominal map under the payloads of the new rows."""
        return laden(self.nominal, self.data)

    @property
    def own_markers(self) -> Tensor:
        """(P, 3) the markers of the map, in the frames of their tips, m."""
        theta = self.fitted.deformation.momenta.theta
        return self.nominal.geometry.tool + theta[self.nominal.geometry.slices["tool"]].view(-1, 3)

    @property
    def seen_before(self) -> Tensor:
        """(P,) boolean: the markers that new rows show and that old rows showed."""
        seen = torch.zeros(self.nominal.geometry.markers, dtype=torch.bool, device=HOST)
        if self.coordinates is not None:
            seen |= ~self.coordinates.table.points.isnan().any(2).all(0)
        seen[-1] |= self.ball is not None
        seen[-1] &= not self.new_ball
        return seen


def laden(nominal: GeometryMap, data: Any) -> GeometryMap:
    """A nominal map at rows, each under its payload."""
    if data.payload is None or nominal.payload is None:
        return nominal
    return nominal.with_payload(nominal.payload.weighing(data.payload))


def place_again(model: CalibratedKinematics, new: Any) -> Before:
    """Find where device and markers are now.

    Raises:
        InputError: joints in another order, or markers that the model cannot be compared with.
        MeasurementError: too few rows, or rows of another size than the robot's.
    """
    new = new.to(HOST)
    _check_robot(model, new)
    own, readings = divided(new)
    check_kinds(model, own, readings)
    old = (model.map.fitted if isinstance(model.map, RegisteredMap) else model.map).to(HOST)
    nominal = robot_map(old)
    ball = _ball(old, nominal, own, readings)
    new_ball = ball is not None and not knows_ball(model)
    if ball is not None and new_ball:
        old = with_ball(old, nominal, ball, ball_tip(own, readings, nominal.geometry.on[-1]), BALL_DEVIATION_M)
        nominal = robot_map(old)
    table = None if own is None else with_markers(own.table, nominal.geometry.markers)
    table = with_lever(table, model.lever) if table is not None and model.lever is not None else table
    place = sessions = None
    if table is not None and not table.without_device:
        check_no_sessions(table)
        place, sessions, table = _in_one_frame(old, nominal, model.lever, table)
    if own is not None and table is not None:
        own = Coordinates(table, own.rows)
    return Before(old, nominal, new, own, readings, place, sessions, ball, new_ball)


def knows_ball(model: CalibratedKinematics) -> bool:
    """Whether the last marker of the fit is a ball whose position no device measured."""
    fitted = model.map.fitted if isinstance(model.map, RegisteredMap) else model.map
    return model.ball or fitted.workspace is not None


def robot_map(fitted: FittedMap) -> GeometryMap:
    """The nominal map of a robot's fitted map."""
    nominal = fitted.geodesic.spec.nominal
    if not isinstance(nominal, GeometryMap):
        raise InputError.of("the map of a robot model", expected="a GeometryMap", got=type(nominal).__name__)
    return nominal


def _check_robot(model: CalibratedKinematics, new: Any) -> None:
    check_joint_order(model.robot, new)
    model.robot.joint_values(new.q)
    check_payloads(model.payload, new)
    if new.payload is not None:
        check_masses(model.nominal, new.payload)


def _in_one_frame(
    old: FittedMap, nominal: GeometryMap, lever: float | None, table: Measurements
) -> tuple[FoundPlace, SessionFrames | None, Measurements]:
    """Where the device of the largest session is, the other frames, and the rows in the frame of that session."""
    device, measured = measured_rows(table)
    predicted = old.geodesic.with_nominal(laden(nominal, device))(device.q).detach().unflatten(1, (-1, 3))
    if len(device.session_names) < 2 or device.session is None:
        check_size(predicted, device.points)
        place = find_place(old, nominal, lever, device)
        check_place(place.registration)
        return place, None, table
    session = device.session
    reference = int(torch.bincount(session, minlength=len(device.session_names)).argmax())
    largest = device.rows(session == reference).with_sessions(None)
    check_size(predicted[session == reference], largest.points)
    place = find_place(old, nominal, lever, largest)
    check_place(place.registration)
    T = place.registration.transform
    seen = predicted @ T[:3, :3].mT + T[:3, 3]
    frames = SessionFrames.around(device, seen, reference)
    aligned = frames.aligned(device)
    points = table.points.clone()
    points[measured] = aligned.points
    changes: dict[str, object] = {"points": points}
    if table.frames is not None and aligned.frames is not None:
        changes["frames"] = aligned.frames
    return place, frames.of_rows(measured, len(table)), with_attributes(table, **changes)


def _ball(
    old: FittedMap, nominal: GeometryMap, own: Coordinates | None, readings: list[OtherReadings]
) -> Tensor | None:
    """(3,) where new rows put a ball on its tip, if the joints are as the old map says without deformation, m."""
    theta = nominal.split(old.deformation.momenta.theta)[0]
    geometry = nominal.geometry.absorb(theta)
    if own is not None and own.table.sockets is not None:
        resting = own.table.with_sockets_of_rows().socket_rows()
        return register_sockets(geometry, resting.q, resting.socket).identification.geometry.tool[0]
    if not readings:
        return None
    for one in readings:
        check_devices(one.table)
    bare = geometry.with_tool(geometry.tool[:1] * 0.0, (ball_tip(own, readings, nominal.geometry.on[-1]),))
    found = identify_readings(bare, [one.table for one in readings], rigid=True)
    return found.identification.geometry.tool[0]
