"""Campaigns in several set-ups: the device, or the robot's foot, has moved between some rows and others, or markers.

Every session has a measuring frame, or markers, that differ from those of the largest session, the reference. They are
found with a geometric calibration, all rows are brought to the reference, and what is left of the differences is fitted
with everything else: shifts and turns of each frame and shifts of every marker, as noise with a prior that rows share.

Slow drift of device and arm with a column, such as time or temperature: between its smallest and largest value the
measuring frame shifts and turns, lengths grow, and every joint offset changes, by unknowns u with a wide prior: row i
differs from the model by a_i B_i u with a_i from -1/2 to 1/2, so that the model holds for the middle of the column.
They stay in the fit where they predict rows that are left out better, see diagnostics/hypotheses.py.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.plausibility import refuse_mistakes
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register_inliers, registered_geometry, spread
from diffeo_calib.calibration.placing.placement import DeviceSet, OtherRows, Seen, Settled
from diffeo_calib.common.errors import MeasurementError, sentence, warn_user
from diffeo_calib.fitting.result import Progress
from diffeo_calib.measurements.rows import NO_SOCKET
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import marker_tips
from diffeo_calib.sensors.known_drift import OFFSETS, KnownDrift
from diffeo_calib.sensors.set_ups import MeasuringFrames, MountedMarkers, SetUps, frame_slopes, sessions_of, set_up_kind
from diffeo_calib.sensors.tables import Coordinates

ROUNDS = 3
TOLD_APART = 0.5  # ratio of median residuals below which one account of what differs between sessions is clearly better


@dataclass(frozen=True, eq=False)
class Sessions(DeviceSet):
    """Difference between sessions: measuring frames, or what is on the tool."""

    devices: SetUps
    reference: int  # the one whose frame and markers are those of the model
    markers: int  # P that a device saw, the first ones of the geometry
    centre: Tensor | None = None  # (3,) about which frames turn, m; by default the middle of the rows

    @classmethod
    def of_table(cls, robot: Tree, coordinates: Coordinates, progress: Progress) -> tuple[list[Sessions], Measurements]:
        """The sessions of rows, and these as those of one; none for one session.

        Raises:
            MeasurementError: a session with too few rows, or rows that do not fit the robot.
        """
        table = coordinates.table
        if len(table.present_sessions) < 2:
            return [], table
        progress("sessions", 0, 1)
        sessions, median = cls.find(robot, table, set_up_kind(table))
        with suppress(MeasurementError):
            other = MeasuringFrames if table.remounted else MountedMarkers
            ratio = cls.find(robot, table, other)[1] / median if table.lever is None else 1.0
            if ratio < TOLD_APART:
                moved = ("markers were mounted anew", "device was moved")[table.remounted]
                words = f"the sessions fit {1 / ratio:.2g} times better if between them the {moved} and all else stayed"
                option = "leave out" if table.remounted else "add"
                fix = f"{option} --remounted (in Python `remounted=True` of `with_sessions`) if that is so"
                warn_user(sentence(words, fix=fix))
        return [sessions.of_rows(coordinates.rows)], sessions.devices.aligned(table)

    @classmethod
    def find(cls, robot: Tree, data: Measurements, kind: type[SetUps]) -> tuple[Sessions, float]:
        """What differs, by geometric calibrations, and the median distance of the session that fits worst, m.

        Raises:
            MeasurementError: a session with too few rows, or rows that do not fit the robot.
        """
        geometry = register_inliers(robot, data.largest_session())[0].geometry
        for _ in range(ROUNDS):  # a better geometry gives better places
            sessions = cls.around(data, kind, geometry, geometry.points(data.q))
            together = sessions.devices.aligned(data)
            start = registered_geometry(robot, data.q, together.points, marker_tips(robot, data))
            geometry = identify(start, data.q, together.points).geometry
        away = (geometry.points(data.q) - together.points).norm(dim=2)
        each = [(sessions.rows[sessions.device == number], name) for number, name in enumerate(sessions.names)]
        median, worst = max((float(away[rows].nanmedian()), number) for number, (rows, _) in enumerate(each))
        rows, name = each[worst]
        alone = data.rows(rows).with_sessions(None)
        if median > gates.GEOMETRIC_RESIDUAL * spread(alone.points):
            try:
                refuse_mistakes(robot, alone)
            except MeasurementError as error:
                raise MeasurementError(f"session '{name}': {error}") from error
        return sessions, median

    @classmethod
    def around(cls, data: Measurements, kind: type[SetUps], geometry: Geometry, points: Tensor) -> Sessions:
        """The sessions of rows whose points (N, P, 3) are known in the frame of the largest one, m."""
        names, session = sessions_of(data)
        reference = int(torch.bincount(session[session != NO_SOCKET], minlength=len(names)).argmax())
        set_ups = kind.of(points, data, geometry.marker_turns)
        rows = (session != NO_SOCKET).nonzero()[:, 0]
        return cls(set_ups.with_reference(reference), reference, data.markers).measuring(rows, session[rows])

    @staticmethod
    def beside(positions: Coordinates, geometry: Geometry, points: Tensor) -> tuple[list[Sessions], Coordinates]:
        """The sessions of new rows, and these as of the largest one; none for one session.

        Args:
            positions: rows of a table.
            geometry: of the robot in the frame of the largest session. points: (M, P, 3) their points there, m.
        """
        if len(positions.table.present_sessions) < 2:
            return [], positions
        sessions = Sessions.around(positions.table, set_up_kind(positions.table), geometry, points)
        return [sessions.of_rows(positions.rows)], positions._replace(table=sessions.devices.aligned(positions.table))

    @property
    def transforms(self) -> Tensor:
        """(S, 4, 4) from the frame of the reference to that of each session, or on the tool, m."""
        return self.devices.constants.unflatten(1, (4, 4))

    @property
    def others(self) -> list[int]:
        """Numbers of the sessions but the reference."""
        return [number for number in range(len(self.names)) if number != self.reference]

    def increments(self, points: Tensor, by_tool: Tensor, centre: Tensor, session: Tensor, slopes: Tensor) -> Tensor:
        """What the sessions but the reference leave open, (N, R, k (S - 1)): see :meth:`SetUps.increments`.

        Args:
            session: (N,) numbers of the rows' sessions.
        """
        steps = self.devices.increments(points, slopes, by_tool, centre)
        session = session.to(points.device)
        return torch.cat([steps * (session == number)[:, None, None] for number in self.others], dim=2)

    def effects(self, data: Seen) -> Tensor:
        places, by_tool = data.points.unflatten(1, (-1, 3)), data.by_tool[..., : 3 * self.markers]
        centre = places.mean((0, 1)) if self.centre is None else self.centre
        return self.increments(places, by_tool, centre, self.by_row(len(data.y)), data.slopes)

    def settled(self, fit: Settled) -> Sessions:
        steps, k = fit.shifts.view(len(self.others), -1), self.devices.deviations.shape[1]
        std = fit.covariance.diagonal().clamp(min=0).sqrt().view_as(steps) if k else steps[:, :0]
        moved = self.devices.moved(self.others, steps, std, fit.centre, fit.transform)
        return replace(self, devices=moved if fit.known is None else moved.after(fit.known))

    def entry(self) -> dict[str, object]:
        return {self.devices.key: self.devices.entry()}

    def with_rows(self, other: OtherRows) -> Sessions:
        rows = number = self.rows[:0]
        if other.coordinates is not None:
            number = self.devices.numbers(other.coordinates.table)
            rows, number = other.coordinates.rows[number != NO_SOCKET], number[number != NO_SOCKET]
        return replace(self, centre=other.centre).measuring(rows, number)


FRAME_M_RAD, GROWTH, OFFSET_RAD_M = 1e-3, 3e-4, 1e-3
"""Prior standard deviations over the whole range: of the frame's shift and turn, of lengths, and of joint offsets."""


@dataclass(frozen=True, eq=False)
class Drift(DeviceSet):
    """Drift of rows with K columns."""

    devices: KnownDrift  # what was found, or zero before a fit
    data: Any  # the rows
    # (3,) about which the frame turns and lengths grow, m; by default the middle of the rows
    centre: Tensor | None = None

    @classmethod
    def of_table(cls, data: Any, chain: Tree) -> list[DeviceSet]:
        """A drift with every column of a table that is not constant; none without any."""
        values = data.covariates
        if values is None or not bool((values.amax(0) > values.amin(0)).all()):
            return []
        joints = tuple(zip(chain.joint_names, chain.periodic, strict=True))
        nothing = values.new_zeros(values.shape[1], OFFSETS + len(joints))
        ends = values.amin(0), values.amax(0), *values.new_zeros(3, len(nothing))
        constants = torch.cat([torch.stack(ends, 1), nothing], 1)
        return [cls(KnownDrift(data.covariate_names, constants, nothing, joints=joints), data)]

    def effects(self, data: Seen) -> Tensor:
        places = data.points.unflatten(1, (-1, 3))
        centre = places.mean((0, 1)) if self.centre is None else self.centre
        away = (places - centre).flatten(1)[..., None]
        offsets = data.nominal.jacobian(self.data.q, data.y.new_zeros(data.nominal.parameters))
        whole = data.slopes @ (torch.cat([frame_slopes(places, centre), away, offsets], 2) * self.units)
        return (whole[:, :, None] * self.devices.ramp(self.data)[:, None, :, None]).flatten(2)

    @property
    def units(self) -> Tensor:
        """(7 + n,) prior standard deviations of the unknowns."""
        units = [FRAME_M_RAD] * 6 + [GROWTH] + [OFFSET_RAD_M] * len(self.devices.joints)
        return self.devices.constants.new_tensor(units)

    def settled(self, fit: Settled) -> Drift:
        shifts = self.units * fit.shifts.view(len(self.names), -1)
        deviations = self.units * fit.covariance.diagonal().sqrt().view(len(self.names), -1)
        constants = torch.cat([self.devices.constants[:, :2], fit.centre.expand(len(shifts), 3), shifts], 1)
        return replace(
            self, devices=replace(self.devices, constants=constants, deviations=deviations), centre=fit.centre
        )

    def with_rows(self, other: OtherRows) -> Drift:
        return replace(self, data=other.data, centre=other.centre)

    def sentences(self) -> list[str]:
        """How much drifted with each column, of what is known well."""
        return list(self.devices.of_joints())

    def entry(self) -> dict[str, object]:
        """Unknowns in m and rad over the range of every column."""
        return {"drift": dict(zip(self.names, self.devices.sizes.tolist(), strict=True))}
