"""Ball, devices and geometric errors from readings, by maximum a posteriori with heavy tails.

Without measured positions the robot's base is the measuring frame: no reading says where it stands. Base and error
twist of the first joint are held, the devices are unknown.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.socket_plausibility import warn_of_size
from diffeo_calib.calibration.expected_errors import ExpectedError
from diffeo_calib.calibration.identification.identification import (
    LIMITS,
    Fit,
    Identification,
    Prior,
    ReadRows,
    Rows,
    held_parameters,
    in_mm,
    solve,
    weighed_fits,
)
from diffeo_calib.calibration.placing.placement import DeviceSet, OtherRows, Seen, Settled
from diffeo_calib.common.errors import InputError, MeasurementError, as_written, sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.process.tails import Tails
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.sensors.devices import Devices, Hypothesis, check_devices
from diffeo_calib.sensors.kinds import kind_of
from diffeo_calib.sensors.places import PlacedDevices
from diffeo_calib.sensors.tables import OtherReadings

ROUGH_M = 2e-3
"""Errors of a robot before its calibration, to compare starts."""
STARTS_STEPS = 200
LONGEST_TOOL_M = 1.0
UNEXPLAINED = "no place of ball and devices explains the readings"
CHECK = "check the units of the readings (mm or m) and of the joints (deg or rad), the order of the joints, "
CHECK += "and which device each row names; or measure more rows with each device"
LARGEST_SHARE, FAR_BETTER = 0.02, 0.2
"""Median residual, relative to the robot's reach, that belongs to a robot; part of it that the right unit leaves."""


@dataclass(frozen=True, eq=False)
class ReadingDevices(DeviceSet):
    """The devices of readings of one kind.

    Args:
        data: the readings. devices: where their devices are.
        rows: (M,) numbers of the rows among those of the calibration. numbers: (r,) where their r numbers stand there.
        frame: the frame of their places, in words.
        known: (D, k) standard deviations of the devices' increments after a fit, m or rad; None before.
    """

    data: Readings
    devices: Devices
    rows: Tensor
    numbers: Tensor
    frame: str = "the robot's base"
    known: Tensor | None = None

    @property
    def size(self) -> int:
        return self.devices.freedom

    @property
    def device(self) -> Tensor:
        """(M,) number of each row's device."""
        return self.devices.numbers(self.data)

    def _seen(self, data: Seen) -> Tensor:
        """(M, 3 k) coordinates of what the devices see, m."""
        return self.devices.points_of(data.points[self.rows].unflatten(1, (-1, 3)))

    def _of_all_rows(self, effects: Tensor, data: Seen) -> Tensor:
        """Effects (M, r, U) on the own rows as those on all (N, R, U)."""
        found = effects.new_zeros(*data.y.shape, effects.shape[2])
        found[self.rows[:, None], self.numbers] = effects
        return found

    def effects(self, data: Seen) -> Tensor:
        return self._of_all_rows(self.devices.shared(self._seen(data), self.device), data)

    def hypotheses(self, data: Seen) -> Iterator[Hypothesis]:
        for one in self.devices.hypotheses(self._seen(data), self.device):
            yield one._replace(effects=self._of_all_rows(one.effects, data))

    def settled(self, found: Settled) -> ReadingDevices:
        devices, shape = self.devices, (len(self.devices.names), -1)
        moved = devices.moved(found.shifts.view(shape) * devices.deviations)
        known = found.covariance.diagonal().clamp(min=0).sqrt().view(shape) * devices.deviations
        return replace(self, devices=moved, known=known)

    def with_rows(self, other: OtherRows) -> ReadingDevices:
        own = next(one for one in other.readings if one.table.column_kind == self.data.column_kind)
        self.devices.numbers(own.table)  # refuses other devices
        return replace(self, data=own.table, rows=own.rows)

    def warn_of_weakness(self, model: CalibratedKinematics) -> None:
        """Warn if most of the expected error is the robot's size."""
        if model.map.workspace is not None:
            expected = ExpectedError.of(model)
            warn_of_size(self.devices.size_fix, expected.size, expected.size_share, expected.workspace)

    def sentences(self) -> list[str]:
        known = torch.zeros_like(self.devices.constants) if self.known is None else self.known
        return [self.devices.sentence(number, own, self.frame) for number, own in enumerate(known)]

    def placed(self) -> PlacedDevices:
        prior = self.devices.deviations.expand(len(self.devices.names), -1)
        deviations = prior if self.known is None else self.known
        own = self.devices.names, self.devices.constants, deviations, self.rows, self.device
        return PlacedDevices(self.devices.kind, *own, self.data.shown)

    def entry(self) -> dict[str, object]:
        constants = dict(zip(self.devices.names, self.devices.constants.tolist(), strict=True))
        found: dict[str, object] = {"constants": constants}
        if self.known is not None:
            found["deviations"] = dict(zip(self.devices.names, self.known.tolist(), strict=True))
        return {"devices": found}


@dataclass(frozen=True, eq=False)
class FoundReadings:
    """Ball, devices and geometric errors.

    Args:
        registration: ball and devices with errors of joints zero; its geometry has the ball as marker.
        identification: with errors of joints.
        registered, devices: the devices of every table of readings at these two stages.
    """

    registration: Identification
    identification: Identification
    registered: tuple[Devices, ...]
    devices: tuple[Devices, ...]


def identify_readings(bare: Geometry, tables: Sequence[Readings], *, rigid: bool = False) -> FoundReadings:
    """Find ball, devices and geometric errors.

    Args:
        bare: the robot with one marker, the ball, which is searched for from there. tables: readings, each of one kind.
        rigid: whether errors of joints stay zero.

    Raises:
        MeasurementError: readings that no place of ball and devices explains but in another unit, or for which none
            is found.

    Warns:
        DiffeoCalibWarning: readings that no place of ball and devices explains in either unit.
    """
    held, joints = held_parameters(bare, adrift=True), range(bare.size)[bare.slices["joints"]]
    root, still = Prior().root(bare, held), Prior().root(bare, [*held, *joints])
    poses = [bare.marker_poses(data.q) for data in tables]
    found = _rough_fits(bare, still, _starts(bare.tool[0], tables, poses), poses)
    if found and min(one[0] for one in found)[0] > LARGEST_SHARE * bare.chain.reach:  # one kind is lost: place it anew
        balls = [rows.geometry.absorb(rough.theta).tool[0] for _, rough, rows in found]
        again = [(ball, _around(ball, tables, poses)) for ball in balls]
        found += _rough_fits(bare, still, again, poses)
    if not found:
        raise MeasurementError.of(UNEXPLAINED, fix=CHECK)
    worst, rough, rows = min(found, key=lambda one: one[0])
    each = zip(tables, rough.errors, strict=True)
    doubted = [kind_of(data).doubts_unit(data, own[:, 0]) for data, own in each]
    if any(doubted) or worst[0] > LARGEST_SHARE * bare.chain.reach:
        _doubt(bare, tables, still, poses, worst)
    rms, start = _rms(rough.errors), rows.geometry.absorb(rough.theta)
    nothing, tails = torch.zeros_like(rough.covariance), Tails.none(sum(map(len, tables)), 1)
    status = "ball and devices found."
    registration = Identification(start, rms, rms, nothing, 0, status, nothing[0], Prior(), tails)
    rows = Rows(start, _moved(rows, rough.shifts), rows.tips if rigid else None)
    return _estimate(rows, still if rigid else root, registration)


def _rough_fits(
    bare: Geometry, root: Tensor, starts: Sequence[tuple[Tensor, list[ReadRows]]], poses: Sequence[Tensor]
) -> list[tuple[tuple[float, str], Fit, Rows]]:
    """Ball and devices from each start that leads anywhere, after the largest median residual of a device and its name.

    One wrong plane of three shows in it, m.
    """
    found = []
    for ball, parts in starts:
        rows = Rows(bare.with_tool(ball[None]), tuple(parts), poses)
        sigma = ball.new_full((sum(len(own.q) for own in parts), 1), ROUGH_M)
        with suppress(InputError):  # the start has the ball at a fixed point or behind a camera
            rough = solve(rows, sigma, root, max_nfev=STARTS_STEPS, loss="soft_l1")
            worst = max(
                (float(own[:, 0].norm(dim=1)[data.device == number].median()), name)
                for (data, _), own in zip(parts, rough.errors, strict=True)
                for number, name in enumerate(data.names)
            )
            found.append((worst, rough, rows))
    return found


def with_ball_of(
    readings: Sequence[Readings], table: Measurements, stages: tuple[Identification, Identification]
) -> tuple[Identification, Identification]:
    """Stages of rows that tell coordinates, with the ball of readings if these alone show it."""
    readings = [own for own in readings if kind_of(own).seen_points == 1]
    if not readings or table.sockets is not None:
        return stages
    geometry, tip = stages[1].geometry, readings[0].on
    bare = geometry.with_tool(geometry.tool[:1] * 0.0, geometry.on[-1:] if tip is None else (tip,))
    ball = identify_readings(bare, readings, rigid=True).identification
    return stages[0].with_ball(ball), stages[1].with_ball(ball)


def ball_of(readings: Sequence[Readings], geometry: Geometry, tip: str) -> Tensor | None:
    """(3,) the ball of readings in the frame of a tip of a known robot, m; None without readings of a ball."""
    for one in readings:
        check_devices(one)
    readings = [own for own in readings if kind_of(own).seen_points == 1]
    if not readings:
        return None
    bare = geometry.with_tool(geometry.tool[-1:], (tip,))
    return identify_readings(bare, readings, rigid=True).identification.geometry.tool[0]


def reading_sets(
    readings: Sequence[OtherReadings], devices: Sequence[Devices], beside: Measurements | None = None
) -> tuple[ReadingDevices, ...]:
    """Sets of devices and the rows that they measured; ``beside``: rows of the same robot that tell coordinates."""
    frame = "the robot's base" if beside is None or beside.without_device else "the measuring frame"
    return tuple(
        ReadingDevices(table, own, rows, torch.arange(table.values.shape[1], device=rows.device), frame)
        for (table, rows), own in zip(readings, devices, strict=True)
    )


def with_freed_devices(tables: Sequence[Readings], found: FoundReadings) -> FoundReadings | None:
    """The same with what was said to be known of the devices left open; None if there is nothing."""
    freed = [devices.freed() for devices in found.registered]
    if all(devices is None for devices in freed):
        return None
    each, geometry = zip(tables, found.registered, freed, strict=True), found.registration.geometry
    parts = tuple(ReadRows(data, own if free is None else free) for data, own, free in each)
    root = Prior().root(geometry, held_parameters(geometry, adrift=True))
    return _estimate(Rows(geometry, parts), root, found.registration)


def _starts(usual: Tensor, tables: Sequence[Readings], poses: Sequence[Tensor]) -> list[tuple[Tensor, list[ReadRows]]]:
    """Balls (3,) in the tip's frame, m, and devices: in closed form by each device, and with the ball where it was."""
    found = [(usual, _around(usual, tables, poses))]
    for place, (data, T) in enumerate(zip(tables, poses, strict=True)):
        rows = [data.device == number for number in range(len(data.names))]
        kind = kind_of(data)
        alone = [kind.alone(data.rows(own), T[own, 0, :3, :3], T[own, 0, :3, 3]) for own in rows]
        each = [one for one in alone if one is not None]
        found += [(ball, _around(ball, tables, poses)) for ball, _ in each if float(ball.norm()) < LONGEST_TOOL_M]
        if len(each) == len(rows):
            middle = torch.stack([ball for ball, _ in each]).median(0).values
            parts = _around(middle, tables, poses)
            parts[place] = ReadRows(data, kind.of(data, torch.stack([constants for _, constants in each])))
            found.append((middle, parts))
    return found


def _around(ball: Tensor, tables: Sequence[Readings], poses: Sequence[Tensor]) -> list[ReadRows]:
    """The devices in closed form for a ball (3,) in the tip's frame, m."""
    points = [T[:, 0, :3, :3] @ ball + T[:, 0, :3, 3] for T in poses]
    return [ReadRows(data, kind_of(data).at(data, z)) for data, z in zip(tables, points, strict=True)]


def _estimate(rows: Rows, root: Tensor, registration: Identification) -> FoundReadings:
    """Errors, devices, tails and noise level together."""
    count = sum(len(own.q) for own in rows.parts)
    start = max(registration.rms, LIMITS.smallest_noise_m), Tails.none(count, 1, device=root.device)
    fit, tails, level = weighed_fits(lambda sigma: solve(rows, sigma, root, max_nfev=STARTS_STEPS), start)
    rms = _rms(fit.errors)
    identification = replace(
        registration,
        geometry=rows.geometry.absorb(fit.theta),
        theta=fit.theta,
        noise=level,
        rms=rms,
        tails=tails,
        status=f"{in_mm(rms, level, 'estimated')}.",
    )
    each = [
        tuple(own.devices for own in parts if isinstance(own, ReadRows))
        for parts in (rows.parts, _moved(rows, fit.shifts))
    ]
    return FoundReadings(registration, identification, *each)


def _rms(errors: Sequence[Tensor]) -> float:
    """Root mean square of all numbers, m."""
    return float(torch.cat([own.flatten() for own in errors]).square().mean().sqrt())


def _moved(rows: Rows, shifts: Tensor) -> tuple[ReadRows, ...]:
    """All rows with their devices after shifts."""
    each = zip(rows.parts, rows.split(shifts), strict=True)
    return tuple(own._replace(devices=own.moved(some)) for own, some in each if isinstance(own, ReadRows))


def _doubt(
    bare: Geometry, tables: Sequence[Readings], root: Tensor, poses: Sequence[Tensor], worst: tuple[float, str]
) -> None:
    """Raise MeasurementError for readings that fit in mm or m, in place of the other unit; warn if they do not.

    Args:
        bare, tables, root, poses: see :func:`_rough_fits`. worst: median residual, m, of the device where it is
            largest, and its name.
    """
    (median, device), most = worst, LARGEST_SHARE * bare.chain.reach
    said = {
        "expected": f"residuals well below {1e3 * most:.0f} mm with the robot's description",
        "got": f"a median of {1e3 * median:.3g} mm at {as_written(device)}",
    }
    for factor, words in ((1e3, "small"), (1e-3, "large")):
        other = [replace(own, values=factor * own.values) if own.unit[0] == "mm" else own for own in tables]
        found = _rough_fits(bare, root, _starts(bare.tool[0], other, poses), poses)
        if found and min(one[0] for one in found)[0] < min(most, FAR_BETTER * median):
            fix = f"they seem to be 1000 times too {words}: check the units of the readings (mm or m)"
            raise MeasurementError.of(UNEXPLAINED, **said, fix=fix)
    if median > most:
        warn_user(sentence(UNEXPLAINED, **said, fix=CHECK))
