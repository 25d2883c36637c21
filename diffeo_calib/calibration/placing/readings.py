"""Ball, devices and geometric errors from readings, by maximum a posteriori with heavy tails.

Without measured positions the robot's base is the measuring frame: no reading says where it stands. Base and error
twist of the first joint are held, the devices are unknown.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.moved_devices import Cause
from diffeo_calib.calibration.diagnostics.socket_plausibility import warn_of_size
from diffeo_calib.calibration.expected_errors import ExpectedError
from diffeo_calib.calibration.identification.identification import (
    LIMITS,
    Identification,
    Prior,
    held_parameters,
    in_mm,
    least_squares_of,
    weighed_fits,
)
from diffeo_calib.calibration.placing.placement import DeviceSet, OtherRows, SeenRows, Settled
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, as_written, sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.sensors.devices import Devices, Effect, check_devices
from diffeo_calib.sensors.kinds import kind_of
from diffeo_calib.sensors.places import PlacedDevices, fitting_devices, sensor_key
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
        """Increments of all devices."""
        return self.devices.freedom

    @property
    def device(self) -> Tensor:
        """(M,) number of each row's device."""
        return self.devices.numbers(self.data)

    def _seen(self, data: SeenRows) -> Tensor:
        """(M, 3 k) coordinates of what the devices see, m."""
        return self.devices.points_of(data.points[self.rows].unflatten(1, (-1, 3)))

    def effects(self, data: SeenRows) -> Tensor:
        """See :class:`DeviceSet`."""
        own = self.devices.shared(self._seen(data), self.device)
        found = own.new_zeros(*data.y.shape, own.shape[2])
        found[self.rows[:, None], self.numbers] = own
        return found

    def changes(self, data: SeenRows) -> Iterator[Cause]:
        """See :class:`DeviceSet`: every device moved, or its zero was set anew."""
        yield from self._causes(data, self.devices.changes(self._seen(data), self.device))

    def doubts(self, data: SeenRows) -> Iterator[Cause]:
        """See :class:`DeviceSet`."""
        yield from self._causes(data, self.devices.doubts(self._seen(data), self.device))

    def _causes(self, data: SeenRows, found: Iterable[Effect]) -> Iterator[Cause]:
        """Effects (M, r, U) on the rows of these devices as effects on all rows."""
        for effect in found:
            whole = effect.motion.new_zeros(*data.y.shape, effect.motion.shape[2])
            whole[self.rows[:, None], self.numbers] = effect.motion
            yield Cause(effect.name, whole, effect.unit, effect.fix)

    def settled(self, found: Settled) -> ReadingDevices:
        """See :class:`DeviceSet`."""
        devices, shape = self.devices, (len(self.devices.names), -1)
        moved = devices.moved(found.shifts.view(shape) * devices.deviations)
        known = found.covariance.diagonal().clamp(min=0).sqrt().view(shape) * devices.deviations
        return replace(self, devices=moved, known=known)

    def with_rows(self, other: OtherRows) -> ReadingDevices:
        """See :class:`DeviceSet`."""
        own = next(one for one in other.readings if sensor_key(one.table) == sensor_key(self.data))
        self.devices.numbers(own.table)  # refuses other devices
        return replace(self, data=own.table, rows=own.rows)

    def warn_of_weakness(self, model: CalibratedKinematics) -> None:
        """Warn if most of the expected error is the robot's size."""
        if model.map.workspace is not None:
            expected = ExpectedError.of(model)
            warn_of_size(self.devices.size_fix, expected.size, expected.size_share, expected.workspace)

    def sentences(self) -> list[str]:
        """See :class:`DeviceSet`."""
        known = torch.zeros_like(self.devices.constants) if self.known is None else self.known
        return [self.devices.sentence(number, own, self.frame) for number, own in enumerate(known)]

    def placed(self) -> PlacedDevices:
        """See :class:`DeviceSet`."""
        prior = self.devices.deviations.expand(len(self.devices.names), -1)
        deviations = prior if self.known is None else self.known
        own = self.devices.names, self.devices.constants, deviations, self.rows, self.device
        return PlacedDevices(self.devices.kind, *own, self.data.shown)

    def entry(self) -> dict[str, object]:
        """See :class:`DeviceSet`."""
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


def identify_readings(
    bare: Geometry, tables: Sequence[Readings], *, rigid: bool = False, ball: Tensor | None = None
) -> FoundReadings:
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
    scale = _deviations(bare)
    still = scale.clone()
    still[bare.slices["joints"]] = 0.0
    poses = [bare.marker_poses(data.q)[:, 0] for data in tables]
    for data, T in zip(tables, poses, strict=True):
        kind_of(data).check_unit(data, T[:, :3, :3], T[:, :3, 3])
    found = _rough_fits(bare, tables, still, _starts(bare.tool[0], tables, poses), poses)
    if found and min(one[0] for one in found)[0] > LARGEST_SHARE * bare.chain.reach:  # one kind is lost: place it anew
        balls = [rows.geometry.absorb(rough.theta).tool[0] for _, rough, rows in found]
        again = [(ball, _around(ball, tables, poses)) for ball in balls]
        found += _rough_fits(bare, tables, still, again, poses)
    if not found:
        raise MeasurementError.of(UNEXPLAINED, fix=CHECK)
    worst, rough, rows = min(found, key=lambda one: one[0])
    doubted = [kind_of(data).doubts_unit(data, own) for data, own in zip(tables, rough.errors, strict=True)]
    if any(doubted) or worst[0] > LARGEST_SHARE * bare.chain.reach:
        _doubt(bare, tables, still, poses, worst)
    rms = _rms(rough.errors)
    start = rows.geometry.absorb(rough.theta)
    registration = Identification(start, rms, rms, *_nothing(start), Prior(), Tails.none(rows.count, 1))
    rows = rows._replace(geometry=start, poses=poses if rigid else None)
    return _estimate(rows, rough.devices, still if rigid else scale, registration)


def _rough_fits(
    bare: Geometry,
    tables: Sequence[Readings],
    scale: Tensor,
    starts: Sequence[tuple[Tensor, list[Devices]]],
    poses: Sequence[Tensor],
) -> list[tuple[tuple[float, str], _Fit, _Rows]]:
    """Ball and devices from each start that leads anywhere, and how well the worst device fits."""
    found = []
    for ball, devices in starts:
        rows = _Rows(bare.with_tool(ball[None]), tuple(tables), poses)
        with suppress(InputError):  # the start has the ball at a fixed point or behind a camera
            rough = _solve(rows, devices, scale, ball.new_full((rows.count,), ROUGH_M), robust=True)
            found.append((_of_worst_device(tables, rough.errors), rough, rows))
    return found


def _nothing(geometry: Geometry) -> tuple[Tensor, int, str, Tensor]:
    """Covariance, iterations, status and theta of a registration that says nothing about them."""
    zero = geometry.tool.new_zeros(geometry.size)
    return torch.outer(zero, zero), 0, "ball and devices found.", zero


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


def devices_around(geometry: Geometry, tables: Sequence[Readings]) -> tuple[Devices, ...]:
    """The devices of readings around a robot, for each table."""
    return tuple(fitting_devices(own, geometry.points(own.q)) for own in tables)


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
) -> tuple[DeviceSet, ...]:
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
    devices = [own if free is None else free for own, free in zip(found.registered, freed, strict=True)]
    geometry = found.registration.geometry
    return _estimate(_Rows(geometry, tuple(tables)), devices, _deviations(geometry), found.registration)


def _starts(usual: Tensor, tables: Sequence[Readings], poses: Sequence[Tensor]) -> list[tuple[Tensor, list[Devices]]]:
    """Balls (3,) in the tip's frame, m, and devices: in closed form by each device, and with the ball where it was."""
    found = [(usual, _around(usual, tables, poses))]
    for place, (data, T) in enumerate(zip(tables, poses, strict=True)):
        rows = [data.device == number for number in range(len(data.names))]
        kind = kind_of(data)
        alone = [kind.alone(data.rows(own), T[own, :3, :3], T[own, :3, 3]) for own in rows]
        each = [one for one in alone if one is not None]
        found += [(ball, _around(ball, tables, poses)) for ball, _ in each if float(ball.norm()) < LONGEST_TOOL_M]
        if len(each) == len(rows):
            middle = torch.stack([ball for ball, _ in each]).median(0).values
            devices = _around(middle, tables, poses)
            devices[place] = kind.of(data, torch.stack([constants for _, constants in each]))
            found.append((middle, devices))
    return found


def _around(ball: Tensor, tables: Sequence[Readings], poses: Sequence[Tensor]) -> list[Devices]:
    """The devices in closed form for a ball (3,) in the tip's frame, m."""
    points = [(T[:, :3, :3] @ ball[:, None])[..., 0] + T[:, :3, 3] for T in poses]
    return [kind_of(data).at(data, z) for data, z in zip(tables, points, strict=True)]


def _deviations(geometry: Geometry) -> Tensor:
    """Prior deviations (K,) of the errors, zero for those that readings cannot show."""
    prior = Prior().deviations(geometry)
    prior[list(held_parameters(geometry))] = 0.0
    return prior


def _freedoms(tables: Sequence[Readings]) -> int | Tensor:
    """Numbers of each row."""
    sizes = [data.values.shape[1] for data in tables]
    if len(set(sizes)) == 1:
        return sizes[0]
    own = [
        torch.full((len(data), 1), size, dtype=torch.int64, device=HOST)
        for data, size in zip(tables, sizes, strict=True)
    ]
    return torch.cat(own)


def _estimate(rows: _Rows, registered: Sequence[Devices], scale: Tensor, registration: Identification) -> FoundReadings:
    """Errors, devices, tails and noise level together."""
    start = max(registration.rms, LIMITS.smallest_noise_m), Tails.none(rows.count, 1, device=scale.device)
    numbers = sum(data.values.numel() for data in rows.tables)
    fit, tails, level = weighed_fits(
        lambda sigma: _solve(rows, registered, scale, sigma[:, 0]), start, _freedoms(rows.tables), numbers
    )
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
    return FoundReadings(registration, identification, tuple(registered), fit.devices)


def _rms(errors: Sequence[Tensor]) -> float:
    """Root mean square of all numbers, m."""
    return float(torch.cat([own.flatten() for own in errors]).square().mean().sqrt())


class _Rows(NamedTuple):
    """Readings of several kinds, and the geometry that explains them.

    Args:
        geometry: with one marker, the ball. tables: readings.
        poses: (M, 4, 4) of the tip at the rows of every table where errors of joints stay zero, so that only the ball
            moves; None where they may not.
    """

    geometry: Geometry
    tables: tuple[Readings, ...]
    poses: Sequence[Tensor] | None = None

    @property
    def count(self) -> int:
        return sum(map(len, self.tables))

    def _balls(self, theta: Tensor) -> list[Tensor]:
        """The ball (M, 3) at the rows of every table, m."""
        if self.poses is None:
            return [self.geometry.points(data.q, theta)[:, 0] for data in self.tables]
        ball = self.geometry.tool[0] + theta[self.geometry.slices["tool"]]
        return [T[:, :3, :3] @ ball + T[:, :3, 3] for T in self.poses]

    def _by_errors(self, theta: Tensor, free: Tensor) -> list[Tensor]:
        """Derivatives (M, 3, f) of these by some errors."""
        if self.poses is None:
            return [self.geometry.sensitivities(data.q, theta)[:, 0][..., free] for data in self.tables]
        return [T[:, :3, :3] for T in self.poses]

    def errors(self, theta: Tensor, devices: Sequence[Devices]) -> list[Tensor]:
        """Predicted minus measured readings (M, r) of every table, m."""
        each = zip(self.tables, devices, self._balls(theta), strict=True)
        return [-own.errors(data, ball) for data, own, ball in each]

    def slopes(self, theta: Tensor, devices: Sequence[Devices], free: Tensor, scale: Tensor) -> list[Tensor]:
        """Derivatives (M, r, f + all increments) of these, in units of the prior deviations, by the free errors."""
        sizes = [own.freedom for own in devices]
        found, each = [], zip(self.tables, devices, self._balls(theta), self._by_errors(theta, free), strict=True)
        for place, (data, own, ball, by_errors) in enumerate(each):
            device = own.numbers(data)
            by_theta = own.observation(device).slope(ball) @ (by_errors * scale[free])
            before, after = sum(sizes[:place]), sum(sizes[place + 1 :])
            shared = torch.nn.functional.pad(own.shared(ball, device), (before, after))
            found.append(torch.cat([by_theta, shared], 2))
        return found


class _Fit(NamedTuple):
    """theta (K,), the devices, errors (M, r) of the rows of every table, m, and leverage (N, 1) of all rows."""

    theta: Tensor
    devices: tuple[Devices, ...]
    errors: list[Tensor]
    leverage: Tensor

    @property
    def squares(self) -> Tensor:
        """(N, 1) m^2."""
        return torch.cat([errors.square().sum(1, keepdim=True) for errors in self.errors])


def _solve(rows: _Rows, devices: Sequence[Devices], scale: Tensor, sigma: Tensor, *, robust: bool = False) -> _Fit:
    """Fit theta = scale u and the devices' increments, in units of their deviations, by least squares."""
    free, sizes = scale.nonzero()[:, 0], [own.freedom for own in devices]
    K = len(free)
    weights = [1.0 / own[:, None] for own in sigma.split([len(data) for data in rows.tables])]

    def moved(u: Tensor) -> tuple[Tensor, tuple[Devices, ...]]:
        pairs = zip(devices, u[K:].split(sizes), strict=True)
        theta = torch.zeros_like(scale).index_copy(0, free, scale[free] * u[:K])
        return theta, tuple(own.moved(s.view(len(own.names), -1) * own.deviations) for own, s in pairs)

    def errors(u: Tensor) -> Tensor:
        return torch.cat([(w * e).flatten() for w, e in zip(weights, rows.errors(*moved(u)), strict=True)])

    start = scale.new_zeros(K + sum(sizes))

    def slopes(u: Tensor) -> Tensor:
        pairs = zip(weights, rows.slopes(*moved(u), free, scale), strict=True)
        return torch.cat([(w[..., None] * s).flatten(0, 1) for w, s in pairs])

    loss = "soft_l1" if robust else "linear"
    found = least_squares_of(errors, slopes, start, max_nfev=STARTS_STEPS, loss=loss)
    theta, there = moved(found.u)
    left = rows.errors(theta, there)
    parts = zip(found.leverage.split([e.numel() for e in left]), left, strict=True)
    leverage = torch.cat([own.view(e.shape).sum(1, keepdim=True) for own, e in parts])
    return _Fit(theta, there, left, leverage)


def _of_worst_device(tables: Sequence[Readings], errors: Sequence[Tensor]) -> tuple[float, str]:
    """The largest median residual of a device's readings, m, and its name: one wrong plane of three shows in it."""
    return max(
        (float(own.norm(dim=1)[data.device == number].median()), name)
        for data, own in zip(tables, errors, strict=True)
        for number, name in enumerate(data.names)
    )


def _doubt(
    bare: Geometry, tables: Sequence[Readings], scale: Tensor, poses: Sequence[Tensor], worst: tuple[float, str]
) -> None:
    """Raise MeasurementError for readings that fit in mm or m, in place of the other unit; warn if they do not.

    Args:
        bare, tables, scale, poses: see :func:`_rough_fits`. worst: median residual, m, of the device where it is
            largest, and its name.
    """
    (median, device), most = worst, LARGEST_SHARE * bare.chain.reach
    said = {
        "expected": f"residuals well below {1e3 * most:.0f} mm with the robot's description",
        "got": f"a median of {1e3 * median:.3g} mm at {as_written(device)}",
    }
    for factor, words in ((1e3, "small"), (1e-3, "large")):
        other = [replace(own, values=factor * own.values) if own.unit[0] == "mm" else own for own in tables]
        found = _rough_fits(bare, other, scale, _starts(bare.tool[0], other, poses), poses)
        if found and min(one[0] for one in found)[0] < min(most, FAR_BETTER * median):
            fix = f"they seem to be 1000 times too {words}: check the units of the readings (mm or m)"
            raise MeasurementError.of(UNEXPLAINED, **said, fix=fix)
    if median > most:
        warn_user(sentence(UNEXPLAINED, **said, fix=CHECK))
