"""Devices in unknown places: what their rows share, and what a fit says about them.

What is not known of a device is an error that all its rows share, with a prior: noise R = blockdiag(R_i) + Z Z^T, whose
columns Z are the effects of shifts c ~ N(0, I). After the fit their posterior is

    c = Z^T R^-1 (y - h(k1)),    cov(c) = (1 + Z^T (G + blockdiag(R_i))^-1 Z)^-1.

In several set-ups the device, the robot's foot, or markers have moved between some rows and others. Every session has a
measuring frame, or markers, that differ from those of the largest session, the reference. They are found with a
geometric calibration, all rows are brought to the reference, and what is left of the differences is fitted with
everything else: shifts and turns of each frame and shifts of every marker, as noise with a prior that rows share.

Slow drift of device and arm with a column, such as time or temperature: between its smallest and largest value the
measuring frame shifts and turns, lengths grow, and every joint offset changes, by unknowns u with a wide prior: row i
differs from the model by a_i B_i u with a_i from -1/2 to 1/2, so that the model holds for the middle of the column.
They stay in the fit where they predict rows that are left out better, see diagnostics/hypotheses.py.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.plausibility import refuse_mistakes
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register_inliers, registered_geometry, spread
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, sentence, warn_user
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.result import Fit, Progress
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.measurements.rows import NO_SOCKET
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import marker_tips
from diffeo_calib.sensors.devices import Extrinsics, Hypothesis
from diffeo_calib.sensors.kinds import Coordinates, OtherReadings
from diffeo_calib.sensors.known_drift import OFFSETS, KnownDrift
from diffeo_calib.sensors.set_ups import MeasuringFrames, MountedMarkers, SetUps, frame_slopes, sessions_of, set_up_kind

S = TypeVar("S", bound="DeviceSet")
T = TypeVar("T")


class Seen(Protocol):
    """N rows around a map, as sets of devices see them: of a calibration around k0, new ones around an old model."""

    @property
    def nominal(self) -> GeometryMap: ...  # k0
    @property
    def y(self) -> Tensor: ...  # (N, R) m
    @property
    def points(self) -> Tensor: ...  # (N, 3 P) of the map, m
    @property
    def slopes(self) -> Tensor: ...  # (N, R, 3 P) of what was measured
    @property
    def by_tool(self) -> Tensor: ...  # (N, R, 3 P) derivatives by the places of the points on their tips


class OtherRows(NamedTuple):
    """Rows of devices that are known, as they were measured."""

    data: Any  # all of them
    coordinates: Coordinates | None  # those that tell coordinates
    aligned: Coordinates | None  # the same in the frame of the model
    readings: list[OtherReadings]  # the others, by kind
    centre: Tensor  # (3,) the middle of the rows with which the devices were found, m


class Settled(NamedTuple):
    """Result of a fit for the shifts of one set of devices."""

    shifts: Tensor  # (c,) their posterior mean
    covariance: Tensor  # (c, c)
    fitted: FittedMap  # the map, its covariances without rigid motions if no device holds the frame
    # (3,) the middle of the rows, m, in the frame of the devices, from which transform (4, 4) leads to that of the
    # model
    centre: Tensor
    transform: Tensor
    known: SetUps | None = None  # what the old model knew of the tool in each set-up; None of a calibration


@dataclass(frozen=True, eq=False)
class DeviceSet(ABC):
    """Devices of one kind in a calibration."""

    size_advice: ClassVar[str] = ""
    """What would make the robot's size better known; nothing where these devices have a size of their own."""
    # where they are, and their rows; before a fit the deviations of their increments are those of the prior
    devices: Extrinsics

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the devices."""
        return self.devices.names

    @property
    def rows(self) -> Tensor:
        """(M,) numbers of the rows that they measured."""
        return self.devices.rows

    @property
    def device(self) -> Tensor:
        """(M,) which of them did."""
        return self.devices.device

    def by_row(self, count: int) -> Tensor:
        """(N,) numbers of the devices of all rows, -1 for rows of none."""
        numbers = torch.full((count,), NO_SOCKET, dtype=torch.int64, device=HOST)
        numbers[self.rows] = self.device
        return numbers

    def of_rows(self: S, rows: Tensor) -> S:
        """Renumber the rows: ``rows`` (M,) are their numbers in a larger table."""
        return self.measuring(rows[self.rows], self.device)

    def measuring(self: S, rows: Tensor, device: Tensor) -> S:
        """Give the devices other rows (M,), each measured by one of them."""
        return replace(self, devices=replace(self.devices, rows=rows, device=device))

    @abstractmethod
    def effects(self, data: Seen) -> Tensor:
        """Uncertainty of the devices, as effects of unit variance that rows share: (N, R, c), m."""

    def settled(self: S, fit: Settled) -> S:
        """The devices where a fit puts them."""
        return self

    @abstractmethod
    def with_rows(self: S, other: OtherRows) -> S:
        """Replace the rows of the devices; MeasurementError for other devices."""

    def warn_of_weakness(self, model: CalibratedKinematics) -> None:  # noqa: B027
        """Warn (DiffeoCalibWarning) of what these devices leave open in a model, and of what would show it."""

    def hypotheses(self, data: Seen) -> Iterable[Hypothesis]:
        """What of these devices may change during the measurements, or be wrong, with effects (N, R, U) on all rows."""
        return ()

    @property
    def bodies(self) -> Mapping[str, str]:
        """Better names of what stands, and of what is on the tool, than those of diagnostics/hypotheses.py."""
        return {}

    def elsewhere(self, row: int, points: Tensor, devices: Placement) -> Elsewhere:
        """A row of the table at other points (M, P, 3) of the model, m, as far as these of all devices measured it."""
        return Elsewhere(torch.ones(len(points), dtype=torch.bool, device=points.device), points.new_zeros(0, 3))

    def sentences(self) -> list[str]:
        """Where the devices are."""
        return self.devices.sentences()

    def entry(self) -> dict[str, Any]:
        """Where the devices are, for programs, in m and rad."""
        return {}


class Placement(tuple[DeviceSet, ...]):
    """The devices of a calibration, a set of each kind."""

    def one(self, kind: type[S]) -> S | None:
        """The first set of a kind; None without one."""
        return next((part for part in self if isinstance(part, kind)), None)

    def hypotheses(self, data: Seen, about: str) -> list[Hypothesis]:
        """Hypotheses about a subject of :class:`Hypothesis`: what devices are said to hold, or what may change."""
        return [hypothesis for part in self for hypothesis in part.hypotheses(data) if hypothesis.about == about]

    @property
    def bodies(self) -> Mapping[str, str]:
        """See :attr:`DeviceSet.bodies`."""
        return {name: words for part in self for name, words in part.bodies.items()}

    def shared(self, data: Seen) -> Tensor:
        """Effects of all devices, side by side: (N, R, c)."""
        return torch.cat([data.y.new_zeros(*data.y.shape, 0), *(part.effects(data) for part in self)], 2)

    def settled(self, fitted: Fit, around: FittedMap, data: Seen, transform: Tensor, **known: Any) -> Placement:
        """Move the devices to where a fit puts them; its last shifts are theirs."""
        sets, shifts, sizes = list[DeviceSet](), fitted.shifts, [devices.effects(data).shape[2] for devices in self]
        centre = data.points.unflatten(1, (-1, 3)).mean((0, 1))
        first, numbers = len(around.geodesic.spec.prior_variance), torch.arange(len(shifts), device=shifts.device)
        whole = around.parameter_covariance(first + numbers) if len(shifts) else shifts[:, None]  # after those of k0
        for devices, part in zip(self, numbers[len(shifts) - sum(sizes) :].split(sizes), strict=True):
            covariance = whole[part[:, None], part]
            sets.append(devices.settled(Settled(shifts[part], covariance, around, centre, transform, **known)))
        return Placement(sets)

    def aligned(self, data: T) -> T:
        """Measured positions in the frame of the model; unchanged where one set-up measured all."""
        for part in self:
            data = part.devices.aligned(data)
        return data

    def sentences(self) -> list[str]:
        return [line for part in self for line in part.sentences()]

    def entry(self) -> dict[str, Any]:
        entries: dict[str, Any] = {}
        for name, entry in (item for part in self for item in part.entry().items()):
            before = entries.get(name, {})  # of devices of another kind
            entries[name] = entry | {key: before[key] | entry[key] for key in before}
        return entries

    def placed(self) -> tuple[Extrinsics, ...]:
        """What a model keeps of all devices."""
        return tuple(part.devices for part in self if part.names)


class Elsewhere(NamedTuple):
    """A row as some devices would measure it at M other configurations."""

    there: Tensor  # (M,) boolean, where they can
    places: Tensor  # (D, 3) in the measuring frame, m, to which it has to bring the ball; none for anywhere
    changed: Callable[[Any], Any] = lambda copies: copies  # of a table, copies of the row at these joint values


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
