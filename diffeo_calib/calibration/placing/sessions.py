"""Campaigns in several set-ups: the device, or the robot's foot, has moved between some rows and others, or markers.

Every session has its own measuring frame, T_s from that of the largest session (the reference) to its own. The frames
are found with a geometric calibration, all rows are brought into the frame of the reference, and what is left of the
differences is fitted with everything else: each session but the reference has six shifts and turns of its frame and
three shifts of every marker (a tool that was mounted again), which its rows share, as noise with a prior. Where the
device stayed, and the markers alone were mounted anew, their shifts are found in place of the frames.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register, register_inliers
from diffeo_calib.calibration.placing.placement import (
    DeviceSet,
    OtherLabel,
    OtherRows,
    SeenRows,
    Settled,
    SettledAgain,
)
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, few, listed, sentence, warn_user
from diffeo_calib.fitting.result import Progress
from diffeo_calib.measurements.rows import NO_SOCKET
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import PLACES
from diffeo_calib.robots.se3 import frame_slopes, rotation
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import marker_tips
from diffeo_calib.sensors.mounted import Mounted, View, mounted_kind, sessions_of
from diffeo_calib.sensors.places import SESSION, PlacedDevices, place_sessions
from diffeo_calib.sensors.tables import Coordinates, measured_rows

if TYPE_CHECKING:
    from typing_extensions import Self

ROUNDS = 3
TOLD_APART = 0.5
"""Ratio of median residuals below which one account of what differs between sessions is clearly better."""


@dataclass(frozen=True, eq=False)
class Sessions(DeviceSet):
    """Difference between sessions: measuring frames, or where markers sit.

    Args:
        names: of the sessions.
        reference: the one whose frame and markers are those of the model.
        session: (N,) number of the session of each row of a calibration, -1 for rows of none.
        markers: P that a device saw, the first ones of the geometry.
    """

    names: tuple[str, ...]
    reference: int
    session: Tensor
    markers: int

    @classmethod
    def of_table(
        cls, robot: Tree, own: Coordinates, count: int, progress: Progress
    ) -> tuple[list[Sessions], Measurements]:
        """The sessions of a table of ``count`` rows, and the rows as those of one; none for one session.

        Raises:
            MeasurementError: a session with too few rows, rows that do not fit the robot, or sessions without a device.
        """
        table = own.table
        if len(table.present_sessions) < 2:
            return [], table
        if table.without_device:
            fix = "give the sockets of each session names of their own, and leave the sessions out"
            got = few(table.present_sessions)
            raise MeasurementError.of("rows with sockets", expected="no sessions", got=got, fix=fix)
        progress("sessions", 0, 1)
        rows = table.device_rows()
        found = (Mountings if rows.remounted else SessionFrames).find(robot, rows)
        if rows.lever is None:
            _doubt(robot, rows, found)
        return [found.of_rows(own.rows[table.socket_numbers < 0], count)], found.aligned(table)

    @classmethod
    def find(cls, robot: Tree, data: Measurements) -> Self:
        """Find what differs by geometric calibrations.

        Raises:
            MeasurementError: a session with too few rows, or rows that do not fit the robot.
        """
        session, reference = sessions_of(data)[1], reference_of(data)
        geometry = register_inliers(robot, data.rows(session == reference))[0].geometry
        found = cls.around(data, geometry, reference)
        for _ in range(ROUNDS - 1):  # a better geometry gives better places
            together = found.aligned(data)
            start = register(robot, together.q, together.points, marker_tips(robot, data))
            geometry = identify(start.geometry, together.q, together.points).geometry
            found = cls.around(data, geometry, reference)
        return found

    @classmethod
    @abstractmethod
    def around(cls, data: Measurements, geometry: Geometry, reference: int) -> Self:
        """The sessions of rows around a robot in the frame of the reference."""

    @staticmethod
    def beside(
        own: Coordinates, device: Coordinates, geometry: Geometry, seen: Tensor, count: int
    ) -> tuple[list[DeviceSet], Coordinates]:
        """The sessions of new rows, and these as of the largest one; none for one session.

        Args:
            own: rows of a table of ``count`` rows. device: those of them that a device measured.
            geometry: of the robot in the frame of the largest session. seen: (M, P, 3) their points there, m.
        """
        if len(device.table.present_sessions) < 2:
            return [], own
        reference = reference_of(device.table)
        if device.table.remounted:
            found: Sessions = Mountings.of_points(device.table, geometry, seen, reference)
        else:
            found = SessionFrames.of_points(device.table, seen, reference)
        found = found.of_rows(device.rows, len(own.table))
        return [found.of_rows(own.rows, count)], own._replace(table=found.aligned(own.table))

    @abstractmethod
    def aligned(self, data: Any) -> Any:
        """The rows of all sessions as those of the reference.

        Raises:
            MeasurementError: a session that is not known.
        """

    def groups(self) -> list[tuple[str, Tensor]]:
        """See :class:`DeviceSet`."""
        return [(f"session '{name}'", (self.session == k).nonzero()[:, 0]) for k, name in enumerate(self.names)]

    @property
    def others(self) -> list[int]:
        """Numbers of the sessions but the reference."""
        return [number for number in range(len(self.names)) if number != self.reference]

    def of_each(self, effects: Tensor) -> Tensor:
        """Effects (N, R, c) as those of every session but the reference by itself: (N, R, c (S - 1))."""
        session = self.session.to(effects.device)
        return torch.cat([effects * (session == number)[:, None, None] for number in self.others], dim=2)

    def own_places(self, data: Measurements, by_tool: Tensor, rows: Tensor) -> Tensor:
        """Derivatives (M, 3 P, c) of points by the places of sessions, of each but one.

        Args:
            data: M rows. by_tool: (M, 3 P, 3 P) their derivatives by points on the tool. rows: their numbers.
        """
        slopes, session = self.place_slopes(data, by_tool), self.session.to(rows.device)[rows]
        return torch.cat([slopes * (session == number)[:, None, None] for number in self.others], 2)

    @abstractmethod
    def place_slopes(self, data: Measurements, by_tool: Tensor) -> Tensor:
        """(M, 3 P, k) of one session; arguments as of :meth:`own_places`."""

    def by_markers(self, data: SeenRows) -> Tensor:
        """(N, R, 3 P) effects of markers that were mounted again."""
        tool = data.nominal.geometry.slices["tool"]
        return PLACES.remounted_m * data.sensitivities[..., tool.start : tool.start + 3 * self.markers]

    def with_rows(self, other: OtherRows) -> Self:
        """See :class:`DeviceSet`."""
        session = torch.full((other.count,), NO_SOCKET, dtype=torch.int64, device=HOST)
        device = None if other.coordinates is None else measured_rows(other.coordinates.table)
        if other.coordinates is not None and device is not None:
            session[other.coordinates.rows[device.rows]] = self.numbers(device.table)
        return replace(self, session=session)

    def numbers(self, data: Any) -> Tensor:
        """(N,) number here of each row's session, -1 for none; MeasurementError for a session that is not known."""
        if data.session is None:
            raise MeasurementError.of("the measurements have no sessions", fix="pass data.with_sessions(names)")
        names = data.device_names
        unknown = [name for name in dict.fromkeys(names) if name and name not in self.names]
        if unknown:
            fix = "register the model with rows of the new set-up"
            raise MeasurementError.of(f"the sessions {unknown}", expected=f"some of {listed(self.names)}", fix=fix)
        known = [self.names.index(name) if name else NO_SOCKET for name in names]
        return torch.tensor(known, dtype=torch.int64, device=HOST)

    def of_rows(self, rows: Tensor, count: int) -> Self:
        """The same for ``count`` rows of a calibration, of which these (M,) have sessions."""
        session = torch.full((count,), NO_SOCKET, dtype=torch.int64, device=HOST)
        session[rows] = self.session
        return replace(self, session=session)


@dataclass(frozen=True, eq=False)
class SessionFrames(Sessions):
    """Where the measuring frames of the sessions are.

    Args:
        transforms: (S, 4, 4) from the frame of the reference to that of each session [m].
        centre: (3,) about which frames turn, m; by default the middle of the rows.
        same_tool: whether nothing on the tool was mounted again, as between cameras that see the same board.
    """

    transforms: Tensor
    centre: Tensor | None = None
    same_tool: bool = False

    @classmethod
    def around(cls, data: Measurements, geometry: Geometry, reference: int) -> SessionFrames:
        """See :class:`Sessions`."""
        return cls.of_points(data, geometry.points(data.q), reference)

    @classmethod
    def of_points(cls, data: Measurements, seen: Tensor, reference: int) -> SessionFrames:
        """The frames of rows whose points (N, P, 3) are known in the frame of the reference, m."""
        names, session = sessions_of(data)
        transforms = place_sessions(seen, data).transforms
        transforms[reference] = torch.eye(4, dtype=transforms.dtype, device=HOST)
        return cls(names, reference, session, data.markers, transforms, same_tool=data.same_tool)

    def aligned(self, data: Any) -> Any:
        """See :class:`Sessions`."""
        here = torch.eye(4, dtype=self.transforms.dtype, device=HOST)[None]  # of rows of no session
        return data.in_frames(torch.cat([torch.linalg.inv(self.transforms), here])[self.numbers(data)])

    def place_slopes(self, data: Measurements, by_tool: Tensor) -> Tensor:
        """See :class:`Sessions`."""
        return frame_slopes(data.points, data.points.mean((0, 1)))

    @property
    def size(self) -> int:
        """Six of each frame, and three of each marker that may have moved, in each session but the reference."""
        return len(self.others) * (6 + 3 * self.markers * (not self.same_tool))

    def effects(self, data: SeenRows) -> Tensor:
        """See :class:`DeviceSet`: what is left of the differences between the frames, and markers mounted again."""
        places = data.points.unflatten(1, (-1, 3))
        frame = PLACES.session_m_rad * frame_slopes(places, places.mean((0, 1)) if self.centre is None else self.centre)
        frame = frame if data.slopes is None else data.slopes @ frame
        return self.of_each(frame if self.same_tool else torch.cat([frame, self.by_markers(data)], dim=2))

    def with_rows(self, other: OtherRows) -> SessionFrames:
        """See :class:`DeviceSet`."""
        return replace(super().with_rows(other), centre=other.centre)

    def settled(self, found: Settled) -> SessionFrames:
        """See :class:`DeviceSet`."""
        centre = found.chosen.data.points.unflatten(1, (-1, 3)).mean((0, 1))
        return self._stepped(found.shifts, centre, torch.eye(4, dtype=centre.dtype, device=centre.device))

    def _stepped(self, shifts: Tensor, centre: Tensor, T: Tensor) -> SessionFrames:
        """After shifts (c,) about a centre (3,) in a frame, from which T (4, 4) leads to that of the reference, m."""
        transforms, others = self.transforms.clone(), self.others
        for number, own in zip(others, shifts.view(len(others), -1), strict=True):
            step = torch.eye(4, dtype=centre.dtype, device=centre.device)
            step[:3, :3] = rotation(PLACES.session_m_rad * own[3:6])
            step[:3, 3] = centre + PLACES.session_m_rad * own[:3] - step[:3, :3] @ centre
            transforms[number] = transforms[number] @ T @ step @ torch.linalg.inv(T)
        return replace(self, transforms=transforms)

    def placed_again(self, found: SettledAgain) -> PlacedDevices:
        """See :class:`DeviceSet`."""
        own = self._stepped(found.shifts, found.centre, found.transform).placed()
        return replace(own, rows=own.rows + found.first)

    def views(self) -> dict[str, View]:
        """See :class:`DeviceSet`."""
        return {name: lambda poses, T=T: T @ poses for name, T in zip(self.names, self.transforms, strict=True)}

    def labels(self, own: Coordinates, seen: Tensor) -> Iterator[OtherLabel]:
        """See :class:`DeviceSet`."""
        session, points, count = self.session[own.rows], own.table.points, self.markers
        for number, name in enumerate(self.names):
            T = torch.linalg.inv(self.transforms[number]) @ self.transforms[session]
            away = points[:, :count] @ T[:, :3, :3].mT + T[:, None, :3, 3] - seen[:, :count]
            applies = (session != number) & (session != NO_SOCKET)
            yield OtherLabel(f"session '{name}'", applies, away.norm(dim=-1).nanmean(1))

    def placed(self) -> PlacedDevices:
        """See :class:`DeviceSet`."""
        rows = (self.session != NO_SOCKET).nonzero()[:, 0]
        nothing = self.transforms.new_zeros(len(self.names), 0)
        return PlacedDevices(SESSION, self.names, self.transforms.flatten(1), nothing, rows, self.session[rows])

    def entry(self) -> dict[str, object]:
        """See :class:`DeviceSet`."""
        return {"sessions": dict(zip(self.names, self.transforms.tolist(), strict=True))}

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


@dataclass(frozen=True, eq=False)
class Mountings(Sessions):
    """What is on the tool in each session of one measuring frame: markers mounted anew, or several cameras.

    Args:
        mounted: the sessions and their markers or frames.
    """

    mounted: Mounted

    @classmethod
    def around(cls, data: Measurements, geometry: Geometry, reference: int) -> Mountings:
        """See :class:`Sessions`."""
        return cls.of_points(data, geometry, geometry.points(data.q), reference)

    @classmethod
    def of_points(cls, data: Measurements, geometry: Geometry, seen: Tensor, reference: int) -> Mountings:
        """What is on the tool in rows whose points (N, P, 3) are known with the tool of the reference, m."""
        found = mounted_kind(data).of(seen, data, lambda q: geometry.marker_poses(q)[..., :3, :3])
        return cls(found.names, reference, sessions_of(data)[1], data.markers, found.with_reference(reference))

    def aligned(self, data: Any) -> Any:
        """See :class:`Sessions`."""
        self.numbers(data)
        return self.mounted.aligned(data)

    def place_slopes(self, data: Measurements, by_tool: Tensor) -> Tensor:
        """See :class:`Sessions`."""
        return by_tool

    @property
    def size(self) -> int:
        """Numbers of each session but the reference."""
        return len(self.others) * self.mounted.deviations.shape[1]

    def effects(self, data: SeenRows) -> Tensor:
        """See :class:`DeviceSet`: what is left of the places on the tool."""
        tool, slopes = data.nominal.geometry.slices["tool"], data.slopes
        by_tool = data.sensitivities[..., tool.start : tool.start + 3 * self.markers]
        return self.of_each(self.mounted.increments(data.points.unflatten(1, (-1, 3)), slopes, by_tool))

    def settled(self, found: Settled) -> Mountings:
        """See :class:`DeviceSet`."""
        steps = found.shifts.view(len(self.others), -1)
        return replace(self, mounted=self.mounted.moved(self.others, steps, found.covariance))

    def placed_again(self, found: SettledAgain) -> PlacedDevices:
        """See :class:`DeviceSet`."""
        steps = found.shifts.view(len(self.others), -1)
        mounted = self.mounted.moved(self.others, steps, found.covariance).after(found.known)
        own = replace(self, mounted=mounted).placed()
        return replace(own, rows=own.rows + found.first)

    def views(self) -> dict[str, View]:
        """See :class:`DeviceSet`."""
        return dict(zip(self.names, self.mounted.views(), strict=True))

    def placed(self) -> PlacedDevices:
        """See :class:`DeviceSet`."""
        rows = (self.session != NO_SOCKET).nonzero()[:, 0]
        values = self.mounted.constants, self.mounted.deviations
        return PlacedDevices(self.mounted.kind, self.names, *values, rows, self.session[rows])

    def entry(self) -> dict[str, object]:
        """See :class:`DeviceSet`."""
        each = self.mounted.constants.unflatten(1, self.mounted.shape).tolist()
        return {"mountings": dict(zip(self.names, each, strict=True))}

    def sentences(self) -> list[str]:
        """Where those of every other session are, from those of the reference."""
        return self.mounted.sentences_of_each()


def _doubt(robot: Tree, data: Measurements, found: Sessions) -> None:
    """Warn where rows fit far better if the markers were mounted anew and the device stayed, or the other way round."""
    with suppress(MeasurementError):
        other = (SessionFrames if data.remounted else Mountings).find(robot, data)
        ratio = _largest_median(robot, data, other) / _largest_median(robot, data, found)
        if ratio < TOLD_APART:
            moved = ("markers were mounted anew", "device"), ("device was moved", "markers")
            what, stayed = moved[data.remounted]
            words = f"the sessions fit {1 / ratio:.2g} times better if the {what} between them and the {stayed} stayed"
            option = "leave out" if data.remounted else "add"
            fix = f"{option} --remounted (in Python `remounted=True` of `with_sessions`) if that is so"
            warn_user(sentence(words, fix=fix))


def _largest_median(robot: Tree, data: Measurements, sessions: Sessions) -> float:
    """Median distance of a session's rows from the geometric calibration of all, m: that of the worst session."""
    points = sessions.aligned(data).points
    start = register(robot, data.q, points, marker_tips(robot, data))
    away = (identify(start.geometry, data.q, points).geometry.points(data.q) - points).norm(dim=2)
    numbers = sessions.numbers(data)
    return max(float(away[numbers == number].nanmedian()) for number in numbers.unique().tolist())


def reference_of(data: Measurements) -> int:
    """Number of the largest session; MeasurementError for a session with too few rows."""
    names, session = sessions_of(data)
    return int(torch.bincount(session[session != NO_SOCKET], minlength=len(names)).argmax())
