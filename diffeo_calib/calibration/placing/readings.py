"""Ball, devices and sockets of readings: where they are, what rows say about them, and how a fit starts from them.

A ball in sockets is found in closed form, other devices around places of the ball on its tip that are tried. All are
found again with the geometric errors, by maximum a posteriori with heavy tails. Without measured positions the robot's
base is the measuring frame: base and error twist of the first joint are held, the devices are unknown. Known distances
between sockets, linearised where these are, belong to what is known of their places before the rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import inf
from operator import itemgetter
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.plausibility import check_socket_registration
from diffeo_calib.calibration.expected_errors import ExpectedError
from diffeo_calib.calibration.identification.identification import (
    Identification,
    KindRows,
    Prior,
    Rows,
    body_squares,
    described,
    solve,
)
from diffeo_calib.calibration.identification.registration import register_sockets
from diffeo_calib.calibration.placing.placement import DeviceSet, Elsewhere, OtherRows, Placement, Seen, Settled
from diffeo_calib.cameras.images import projection
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError, MeasurementError, as_written, sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.readings import KIND, SEPARATOR, Readings, SocketReadings
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import fitting_devices
from diffeo_calib.sensors.devices import VALUE, Devices, Hypothesis, check_devices
from diffeo_calib.sensors.kinds import OtherReadings, kind_of
from diffeo_calib.sensors.set_ups import frame_slopes
from diffeo_calib.sensors.tool_frames import IN_SOCKET_M, SocketPlaces


@dataclass(frozen=True, eq=False)
class ReadingDevices(DeviceSet):
    """The devices of readings of one kind."""

    devices: Devices
    data: Readings

    @property
    def numbers(self) -> Tensor:
        """(r,) where their r numbers stand in these rows."""
        return torch.arange(self.data.values.shape[1], device=self.rows.device)

    def _seen(self, data: Seen) -> Tensor:
        """(M, 3 k) coordinates of what the devices see, m."""
        return self.devices.points_of(data.points[self.rows].unflatten(1, (-1, 3)))

    def _of_all_rows(self, effects: Tensor, data: Seen) -> Tensor:
        """Effects (M, r, U) on the own rows as those on all (N, R, U)."""
        whole = effects.new_zeros(*data.y.shape, effects.shape[2])
        whole[self.rows[:, None], self.numbers] = effects
        return whole

    def effects(self, data: Seen) -> Tensor:
        return self._of_all_rows(self.devices.shared(self._seen(data), self.device), data)

    def hypotheses(self, data: Seen) -> Iterator[Hypothesis]:
        for hypothesis in self.devices.hypotheses(self._seen(data), self.device):
            yield hypothesis._replace(effects=self._of_all_rows(hypothesis.effects, data))

    def settled(self, fit: Settled) -> ReadingDevices:
        root, moved = self.devices.root, self.devices.shifted(fit.shifts)
        std = (root @ fit.covariance @ root.mT).diagonal().clamp(min=0).sqrt()
        return replace(self, devices=replace(moved, deviations=std.view_as(moved.deviations)))

    def with_rows(self, other: OtherRows) -> ReadingDevices:
        readings = next(part for part in other.readings if part.table.column_kind == self.data.column_kind)
        return replace(self, data=readings.table).measuring(readings.rows, self.devices.numbers(readings.table))

    def warn_of_weakness(self, model: CalibratedKinematics) -> None:
        """Warn if most of the expected error is the robot's size."""
        if model.map.workspace is None or (error := ExpectedError.of(model)).size_share < gates.SIZE_SHARE:
            return
        what = (
            f"the readings hold too little length: the robot's size is known to {100 * error.size:.2f} % (one standard "
            f"deviation), which is {100 * error.size_share:.0f} % of the expected error of {1e3 * error.workspace:.2f} "
            "mm and rests on the robot's description"
        )
        warn_user(sentence(what, fix=self.devices.size_fix))

    def entry(self) -> dict[str, object]:
        values = {"constants": self.devices.constants, "deviations": self.devices.deviations}
        entries = {what: dict(zip(self.names, each.tolist(), strict=True)) for what, each in values.items()}
        return {"devices": entries}


@dataclass(frozen=True, eq=False)
class SocketDevices(ReadingDevices):
    """The sockets of a calibration."""

    devices: SocketPlaces
    data: SocketReadings

    @property
    def sockets(self) -> SocketReadings:
        """Their names and known distances."""
        return with_attributes(self.data, names=self.names)

    @property
    def positions(self) -> Tensor:
        """(S, 3) most probable places, m."""
        return self.devices.constants

    def elsewhere(self, row: int, points: Tensor, devices: Placement) -> Elsewhere:
        if not bool((self.rows == row).any()):
            return super().elsewhere(row, points, devices)
        away, nearest = torch.cdist(points[:, -1], self.positions.to(points)).min(1)
        there = {"device": nearest, "names": self.names}
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

    def settled(self, fit: Settled) -> SocketDevices:
        moved, root = self.devices.shifted(fit.shifts).constants, self.devices.root
        if fit.fitted.workspace is not None:  # no device tells where all of them are
            B = frame_slopes(moved[None], moved.mean(0))[0]
            root = root - B @ (torch.linalg.pinv(B) @ root)
        std = (root @ fit.covariance @ root.mT).diagonal().clamp(min=0).sqrt().view_as(moved)
        return replace(self, devices=replace(self.devices, constants=moved, deviations=std, before=()))

    def warn_of_weakness(self, model: CalibratedKinematics) -> None:
        """Nothing: sockets without a known distance are warned of at the start."""

    def entry(self) -> dict[str, object]:
        """Positions by name, for programs, in m."""
        return {"sockets": {"positions_m": dict(zip(self.names, self.positions.tolist(), strict=True))}}


def reading_sets(readings: Sequence[OtherReadings], devices: Sequence[Devices]) -> tuple[ReadingDevices, ...]:
    """Sets of devices and their rows, with what is known of them before a fit, around places where they were found."""
    sets = list[ReadingDevices]()
    for (table, rows), old in zip(readings, devices, strict=True):
        around = type(old).of(table, old.constants)
        kind = SocketDevices if table.kind == KIND else ReadingDevices
        sets.append(kind(around, table).measuring(rows, around.numbers(table)))
    return tuple(sets)


# --- where a fit starts -----------------------------------------------------------------------------------------------

ROUGH_M = 2e-3  # errors of a robot before its calibration, to compare starts
STARTS_STEPS, COMPARED = 200, 1e-3  # most steps; change of the cost by which those end that are only compared
BALLS_TRIED, BALL_SPREAD_M = 24, 0.15
"""Places of the ball on the tool that are tried where no start leads anywhere, and their standard deviation."""
UNEXPLAINED = "no place of ball and devices explains the readings"
CHECK = "check the units of the readings (mm or m) and of the joints (deg or rad), the order of the joints, "
CHECK += "and which device each row names; or measure more rows with each device"
LARGEST_SHARE, DOUBTED_SHARE, FAR_BETTER = 0.02, 0.002, 0.2
"""Median residuals, relative to the robot's reach, that belong to a robot, and from which the other unit is tried; the
part that the right unit leaves."""
BALL_SEARCH = {"maxfev": 150, "initial_simplex": [[0.0] * 3, [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]]}
"""Of the ball on the tool by images of unknown cameras, m."""
FEWEST_IMAGES = 8  # rows of a camera from which a projection, 11 numbers, can be contradicted


def resting_rows(tables: Sequence[Any]) -> list[SocketReadings]:
    """The rows in sockets among tables of one kind each, at most one table."""
    return [table for table in tables if table.kind == KIND]


def register_ball(robot: Tree, tables: Sequence[Readings]) -> Identification:
    """Ball and devices by readings alone, with errors of joints zero: in closed form where the ball rested in sockets.

    Raises:
        MeasurementError: rows that cannot belong to this robot, or that fit it far better in another unit.

    Warns:
        DiffeoCalibWarning: no known distance between sockets, rows that no places explain.
    """
    tip = tables[0].on
    bare = Geometry.nominal(robot, 1, () if tip is None else (tip,))
    for resting in resting_rows(tables):
        if not resting.distances:
            what = "no distance between sockets is known: the size of the robot rests on its description"
            warn_user(sentence(what, fix="pass one: a printed block with two sockets and a caliper are enough"))
        start = register_sockets(bare, resting.q, resting.device)
        check_socket_registration(robot, resting, start)
        devices = [fitting_devices(table, start.geometry.points(table.q)) for table in tables]
        return described(Rows(start.geometry, tuple(map(KindRows.read, tables, devices))), adrift=True)
    return register_readings(bare, tables)


def ball_of(readings: Sequence[Readings], geometry: Geometry, tip: str) -> Geometry | None:
    """A known robot with the ball of readings on a tip as its only marker; None without readings of a ball."""
    bare = geometry.with_tool(geometry.tool[-1:], (tip,))
    for resting in resting_rows(readings):
        return register_sockets(bare, resting.q, resting.device).geometry
    for data in readings:
        check_devices(data)
    balls = [table for table in readings if kind_of(table).seen_points == 1]
    return register_readings(bare, balls).geometry if balls else None


def register_readings(bare: Geometry, tables: Sequence[Readings]) -> Identification:
    """Find ball and devices with errors of joints zero, the ball as marker of the geometry.

    Args:
        bare: the robot with one marker, the ball, which is searched for from there. tables: readings, each of one kind.

    Raises:
        MeasurementError: readings that no place of ball and devices explains but in another unit, or for which none
            is found.

    Warns:
        DiffeoCalibWarning: readings that no place of ball and devices explains in either unit.
    """
    reach = bare.chain.reach
    most, fits = LARGEST_SHARE * reach, _rough_fits(bare, tables, bare.tool[:1])
    for factor, words in ((1e3, "small"), (1e-3, "large")) if fits and fits[0].worst > DOUBTED_SHARE * reach else ():
        other = [replace(part, values=factor * part.values) if part.unit[0] == "mm" else part for part in tables]
        there = _rough_fits(bare, other, bare.tool[:1])
        if there and there[0].worst < min(most, FAR_BETTER * fits[0].worst):
            fix = f"they seem to be 1000 times too {words}: check the units of the readings (mm or m)"
            raise MeasurementError.of(UNEXPLAINED, got=fits[0].text, fix=fix)
    if not fits or fits[0].worst > most:
        balls = BALL_SPREAD_M * torch.randn(BALLS_TRIED, 3, dtype=torch.float64, generator=seeded(0), device=HOST)
        fits = sorted([*fits, *_rough_fits(bare, tables, balls)], key=itemgetter(0))
    if not fits:
        raise MeasurementError.of(UNEXPLAINED, fix=CHECK)
    if fits[0].worst > most:
        expected = f"residuals well below {1e3 * most:.0f} mm with the robot's description"
        warn_user(sentence(UNEXPLAINED, expected=expected, got=fits[0].text, fix=CHECK))
    return described(fits[0].rows, [fits[0].noise] * len(tables), adrift=True)


def rough_error(bare: Geometry, tables: Sequence[Readings]) -> float:
    """RMS error of the readings from the start of :func:`register_readings`, m; infinite where none leads on."""
    fits = _rough_fits(bare, tables, bare.tool[:1], ftol=COMPARED)
    return fits[0].noise if fits else inf


def images_error(robot: Tree, data: Readings) -> float:
    """Median distance of images from projections of the tool, as a share of their spread.

    The ball on the tool is sought; lens and place of each camera are those of the best projection P, linear in its 12
    numbers: P z ~ (u, v, 1). Infinite for too few rows of a camera.
    """
    from scipy.optimize import minimize  # noqa: PLC0415  # slow to import

    poses = robot(data.q)
    rows = [data.device == device for device in range(len(data.names))]
    if min(int(mask.sum()) for mask in rows) < FEWEST_IMAGES:
        return inf

    def share(ball: Any) -> float:
        at = poses[:, :3, :3] @ poses.new_tensor(ball) + poses[:, :3, 3]
        return max(_projection_error(at[mask], data.reported[mask]) for mask in rows)

    return float(minimize(share, [0.0] * 3, method="Nelder-Mead", options=BALL_SEARCH).fun)


def _projection_error(points: Tensor, image: Tensor) -> float:
    """Median distance of images (N, 2) from the best projection of points (N, 3), as a share of their spread."""
    at, pixels = (points - points.mean(0)) / points.std(), (image - image.mean(0)) / image.std()
    P = projection(pixels, at)
    shown = at @ P[:, :3].mT + P[:, 3]
    return float((shown[:, :2] / shown[:, 2:] - pixels).norm(dim=1).median() / pixels.norm(dim=1).median())


class RoughFit(NamedTuple):
    """Ball and devices from one start."""

    worst: float  # the largest median residual of a device, m: one wrong plane of three shows in it
    device: str  # its name
    rows: Rows
    noise: float  # RMS error of all readings, m

    @property
    def text(self) -> str:
        """What a message says of it."""
        return f"a median of {1e3 * self.worst:.3g} mm at {as_written(self.device)}"


def _rough_fits(bare: Geometry, tables: Sequence[Readings], balls: Tensor, **how: float) -> list[RoughFit]:
    """From each ball (B, 3) in the tip's frame, m, that leads anywhere, the best first; ``how``: options of scipy."""
    fits = list[RoughFit]()
    for ball in balls:
        with suppress(InputError):  # the start has the ball at a fixed point or behind a camera
            fits.append(_rough_fit(bare, tables, ball, how))
    fits.sort(key=itemgetter(0))
    for best in fits[:1]:  # a device may be lost where the ball was far away: all anew around the ball that was found
        with suppress(InputError):
            fits.append(_rough_fit(bare, tables, best.rows.geometry.tool[0], how))
    return sorted(fits, key=itemgetter(0))


def _rough_fit(bare: Geometry, tables: Sequence[Readings], ball: Tensor, how: Mapping[str, float]) -> RoughFit:
    """Ball and devices, from these in closed form around a ball (3,), errors of joints zero."""
    geometry = bare.with_tool(ball[None])
    devices = [kind_of(data).at(data, geometry.points(data.q)[:, 0]) for data in tables]
    rows = Rows(geometry, tuple(map(KindRows.read, tables, devices)))
    sigma = torch.full((sum(map(len, tables)),), ROUGH_M, dtype=torch.float64, device=HOST)
    root = Prior().root(geometry, range(geometry.slices["tool"].start))
    fit = solve(rows, sigma, root, max_nfev=STARTS_STEPS, loss="soft_l1", **how)
    worst = max(
        (float(errors[data.device == number].norm(dim=2).median()), name)
        for data, errors in zip(tables, fit.errors, strict=True)
        for number, name in enumerate(data.names)
    )
    each = zip(rows.parts, fit.shifts.split(rows.freedom), strict=True)
    moved = [device for part, some in each for device in part.devices(some)]
    rows = Rows(geometry.absorb(fit.theta), tuple(map(KindRows.read, tables, moved)))
    return RoughFit(*worst, rows, float(body_squares(fit.errors).sum() / sum(map(torch.numel, fit.errors))) ** 0.5)
