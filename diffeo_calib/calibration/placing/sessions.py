"""Campaigns in several set-ups: the device, or the robot's foot, has moved between some rows and others.

Every session has its own measuring frame, T_s from that of the largest session (the reference) to its own. The frames
are found with a geometric calibration, all rows are brought into the frame of the reference, and what is left of the
differences is fitted with everything else: each session but the reference has six shifts and turns of its frame and
three shifts of every marker (a tool that was mounted again), which its rows share, as noise with a prior.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register, register_inliers
from diffeo_calib.calibration.placing.placement import DeviceSet, OtherLabel, OtherRows, SeenRows, Settled
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, few, listed
from diffeo_calib.fitting.result import Progress
from diffeo_calib.kinematics.re_registration.registered_map import frame_slopes
from diffeo_calib.measurements.rows import NO_SOCKET
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.se3 import rotation
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import marker_tips
from diffeo_calib.sensors.places import SESSION, PlacedDevices, check_rows_of_sessions, robust_fit
from diffeo_calib.sensors.tables import Coordinates, measured_rows

ROUNDS = 3


@dataclass(frozen=True, eq=False)
class SessionFrames(DeviceSet):
    """Where the measuring frames of the sessions are.

    Args:
        names: of the sessions.
        reference: the one whose frame is that of the model.
        transforms: (S, 4, 4) from the frame of the reference to that of each session [m].
        session: (N,) number of the session of each row of a calibration, -1 for rows of none.
        markers: P that a device saw, the first ones of the geometry.
        centre: (3,) about which frames turn, m; by default the middle of the rows.
    """

    names: tuple[str, ...]
    reference: int
    transforms: Tensor
    session: Tensor
    markers: int
    centre: Tensor | None = None

    @classmethod
    def of_table(
        cls, robot: Tree, own: Coordinates, count: int, progress: Progress
    ) -> tuple[list[DeviceSet], Measurements]:
        """The frames of the sessions of a table of ``count`` rows, and the rows in one frame; none for one session.

        Raises:
            MeasurementError: a session with too few rows, rows that do not fit the robot, or sessions without a device.
        """
        table = own.table
        if len(table.session_names) < 2:
            return [], table
        if table.without_device:
            fix = "give the sockets of each session names of their own, and leave the sessions out"
            got = few(table.session_names)
            raise MeasurementError.of("rows with sockets", expected="no sessions", got=got, fix=fix)
        progress("sessions", 0, 1)
        frames = cls.find(robot, table.device_rows())
        return [frames.of_rows(own.rows[table.socket_numbers < 0], count)], frames.aligned(table)

    @classmethod
    def find(cls, robot: Tree, data: Measurements) -> SessionFrames:
        """Find the frames by geometric calibrations.

        Raises:
            MeasurementError: a session with too few rows, or rows that do not fit the robot.
        """
        session, names = _sessions(data)
        reference = reference_of(data)
        geometry = register_inliers(robot, data.rows(session == reference))[0].geometry
        found = cls.around(data, geometry.points(data.q), reference)
        for _ in range(ROUNDS - 1):  # a better geometry gives better frames
            together = found.aligned(data)
            start = register(robot, together.q, together.points, marker_tips(robot, data))
            geometry = identify(start.geometry, together.q, together.points).geometry
            transforms = _frames(geometry.points(data.q), data, session, len(names), reference)
            found = replace(found, transforms=transforms)
        return found

    @classmethod
    def around(cls, data: Measurements, seen: Tensor, reference: int) -> SessionFrames:
        """The frames of rows whose points (N, P, 3) are known in the frame of the reference, m."""
        session, names = _sessions(data)
        transforms = _frames(seen, data, session, len(names), reference)
        return cls(names, reference, transforms, session, data.markers)

    @classmethod
    def beside(
        cls, own: Coordinates, device: Coordinates, seen: Tensor, count: int
    ) -> tuple[list[DeviceSet], Coordinates]:
        """The frames of new rows, and these in the frame of the largest session; none for one session.

        Args:
            own: rows of a table of ``count`` rows. device: those of them that a device measured.
            seen: (M, P, 3) their points as they are known in the frame of the largest session, m.
        """
        if len(device.table.session_names) < 2:
            return [], own
        frames = cls.around(device.table, seen, reference_of(device.table))
        to_reference = torch.eye(4, dtype=seen.dtype, device=HOST).repeat(len(own.table), 1, 1)
        to_reference[device.rows] = torch.linalg.inv(frames.transforms)[frames.session]
        moved = own._replace(table=own.table.in_frames(to_reference))
        return [frames.of_rows(own.rows[device.rows], count)], moved

    def aligned(self, data: Any) -> Any:
        """The rows of all sessions in the frame of the reference.

        Raises:
            MeasurementError: a session that is not known.
        """
        return data.in_frames(torch.linalg.inv(self.transforms)[self.numbers(data)])

    def groups(self) -> list[tuple[str, Tensor]]:
        """See :class:`DeviceSet`."""
        return [(f"session '{name}'", (self.session == k).nonzero()[:, 0]) for k, name in enumerate(self.names)]

    def labels(self, own: Coordinates, seen: Tensor) -> Iterator[OtherLabel]:
        """See :class:`DeviceSet`."""
        session, points, count = self.session[own.rows], own.table.points, self.markers
        for number, name in enumerate(self.names):
            T = torch.linalg.inv(self.transforms[number]) @ self.transforms[session]
            away = points[:, :count] @ T[:, :3, :3].mT + T[:, None, :3, 3] - seen[:, :count]
            applies = (session != number) & (session != NO_SOCKET)
            yield OtherLabel(f"session '{name}'", applies, away.norm(dim=-1).nanmean(1))

    @property
    def others(self) -> list[int]:
        """Numbers of the sessions but the reference."""
        return [number for number in range(len(self.names)) if number != self.reference]

    @property
    def size(self) -> int:
        """Six of each frame, and three of each marker in each session but the reference."""
        return len(self.others) * (6 + 3 * self.markers)

    def effects(self, data: SeenRows) -> Tensor:
        """See :class:`DeviceSet`: what is left of the differences between the frames, and markers mounted again."""
        places, tool = data.points.unflatten(1, (-1, 3)), data.nominal.geometry.slices["tool"]
        frame = PLACES.session_m_rad * frame_slopes(places, places.mean((0, 1)) if self.centre is None else self.centre)
        frame = frame if data.slopes is None else data.slopes @ frame
        markers = slice(tool.start, tool.start + 3 * self.markers)
        effects = torch.cat([frame, PLACES.remounted_m * data.sensitivities[..., markers]], dim=2)
        session = self.session.to(effects.device)
        return torch.cat([effects * (session == number)[:, None, None] for number in self.others], dim=2)

    def with_rows(self, other: OtherRows) -> SessionFrames:
        """See :class:`DeviceSet`."""
        session = torch.full((other.count,), NO_SOCKET, dtype=torch.int64, device=HOST)
        device = None if other.coordinates is None else measured_rows(other.coordinates.table)
        if other.coordinates is not None and device is not None:
            session[other.coordinates.rows[device.rows]] = self.numbers(device.table)
        return replace(self, session=session, centre=other.centre)

    def numbers(self, data: Any) -> Tensor:
        """(N,) number here of each row's session; MeasurementError for a session that is not known."""
        own, names = _sessions(data)
        unknown = [names[number] for number in own.unique().tolist() if names[number] not in self.names]
        if unknown:
            fix = "register the model with rows of the new set-up"
            raise MeasurementError.of(f"the sessions {unknown}", expected=f"some of {listed(self.names)}", fix=fix)
        known = [self.names.index(name) if name in self.names else NO_SOCKET for name in names]
        return torch.tensor(known, dtype=torch.int64, device=HOST)[own]

    def settled(self, found: Settled) -> SessionFrames:
        """See :class:`DeviceSet`."""
        transforms, others = self.transforms.clone(), self.others
        centre = found.chosen.data.points.unflatten(1, (-1, 3)).mean((0, 1))
        for number, own in zip(others, found.shifts.view(len(others), -1), strict=True):
            step = torch.eye(4, dtype=centre.dtype, device=centre.device)
            step[:3, :3] = rotation(PLACES.session_m_rad * own[3:6])
            step[:3, 3] = centre + PLACES.session_m_rad * own[:3] - step[:3, :3] @ centre
            transforms[number] = transforms[number] @ step
        return replace(self, transforms=transforms)

    def placed(self) -> PlacedDevices:
        """See :class:`DeviceSet`."""
        rows = (self.session != NO_SOCKET).nonzero()[:, 0]
        nothing = self.transforms.new_zeros(len(self.names), 0)
        return PlacedDevices(SESSION, self.names, self.transforms.flatten(1), nothing, rows, self.session[rows])

    def entry(self) -> dict[str, object]:
        """See :class:`DeviceSet`."""
        return {"sessions": dict(zip(self.names, self.transforms.tolist(), strict=True))}

    def of_rows(self, rows: Tensor, count: int) -> SessionFrames:
        """The same for ``count`` rows of a calibration, of which these (M,) have sessions."""
        session = torch.full((count,), NO_SOCKET, dtype=torch.int64, device=HOST)
        session[rows] = self.session
        return replace(self, session=session)

    def sentences(self) -> list[str]:
        """How far every other session's frame is from that of the reference."""
        lines = []
        for name, T in zip(self.names, self.transforms, strict=True):
            if name != self.names[self.reference]:
                turn = float(torch.arccos(((T[:3, :3].trace() - 1) / 2).clamp(-1, 1)))
                shift = 1e3 * float(T[:3, 3].norm())
                lines.append(
                    f"session '{name}': its frame is {shift:.4g} mm and {1e3 * turn:.4g} mrad away from that of"
                )
                lines[-1] += f" '{self.names[self.reference]}', the model's"
        return lines


def reference_of(data: Measurements) -> int:
    """Number of the largest session; MeasurementError for a session with too few rows."""
    session, names = _sessions(data)
    check_rows_of_sessions(session, names)
    return int(torch.bincount(session, minlength=len(names)).argmax())


def _sessions(data: Measurements) -> tuple[Tensor, tuple[str, ...]]:
    if data.session is None:
        raise MeasurementError.of("the measurements have no sessions", fix="pass data.with_sessions(names)")
    return data.session, data.session_names


def _frames(seen: Tensor, data: Measurements, session: Tensor, count: int, reference: int) -> Tensor:
    """Rigid fits of every session's rows to the robot in the frame of the reference, without gross outliers."""
    found = torch.eye(4, dtype=data.points.dtype, device=HOST).repeat(count, 1, 1)
    for number in range(count):
        if number != reference:
            own = session == number
            found[number] = robust_fit(seen[own], data.points[own])
    return found
