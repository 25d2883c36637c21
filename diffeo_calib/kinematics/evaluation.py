"""Errors of any kinematics on measurements: of positions, and of orientations where poses were measured.

For calibrated models also: which rows took part in the fit, and whose joint values are outside the ranges of the fit or
in another unit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import inf, pi
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.checks import ANGLE_MISTAKES, LARGEST_JOINT_ANGLE_RAD
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.coordinates import (
    Beside,
    Places,
    check_joint_order,
    check_payload_link,
    check_shown,
    known_devices,
    sensor_of,
)
from diffeo_calib.sensors.errors import Evaluations
from diffeo_calib.sensors.kinds import measured_positions, rows_of_one_kind, with_points
from diffeo_calib.sensors.known_drift import KnownDrift

SAME_CONFIGURATION = 1e-9
"""Largest difference [rad or m] between the joint values of one row in two files, which comes from rounding."""
REPEATED = 1e-3
"""Distance [rad or m] within which rows repeat a configuration: robots do, and so do copies with fewer digits."""
TELLING_ROWS, TELLING_MOTION = 10, 0.25
"""Rows, and their median range of a joint relative to the fit's, from which they move as those of the fit."""
ROWS_AT_ONCE = 1024
RANGE_MARGIN = 0.25  # rows may lie outside the joint range of the fit by this fraction of the range


def joints_outside_range(model: Any, q: object) -> Tensor:
    """Which joint values lie outside the range of the joint in the fit by more than a quarter of that range.

    Whole turns of a revolute joint do not count: its range is the shortest arc that holds the values of the fit.

    Args:
        model: the calibrated model. q: (N, n) joint configurations, rad or m.

    Returns:
        (N, n) boolean. ``joints_outside_range(model, q).any(1)`` are the rows whose errors are not known.

    Raises:
        InputError: not a calibrated model, wrong shape, or values that are not finite.
    """
    fitted = fitted_configurations(model)
    values: Tensor = model.robot.joint_values(q).detach()  # pyright: ignore[reportArgumentType]
    low, high = fitted.amin(0), fitted.amax(0)
    margin = RANGE_MARGIN * (high - low) + SAME_CONFIGURATION
    outside = (values < low - margin) | (values > high + margin)
    turning = torch.tensor(model.robot.periodic, dtype=torch.bool, device=values.device)
    turning = turning & (values.abs() < LARGEST_JOINT_ANGLE_RAD)  # else they are degrees
    turns = (fitted % (2 * pi)).sort(0).values
    gaps, last = (torch.cat([turns[1:], turns[:1] + 2 * pi]) - turns).max(0)
    first = turns.gather(0, (last + 1)[None] % len(turns))[0]
    arc = 2 * pi - gaps
    margin = RANGE_MARGIN * arc + SAME_CONFIGURATION
    return torch.where(turning, (values - first + margin) % (2 * pi) > arc + 2 * margin, outside)


def fitted_configurations(model: object) -> Tensor:
    """(N, n) configurations that a model was fitted to."""
    configurations = getattr(model, "configurations", None)
    if not isinstance(configurations, Tensor):
        raise InputError.of("`model`", expected="a calibrated model of a robot", got=type(model).__name__)
    return configurations


def repeats(q: Tensor, others: Tensor, within: float = SAME_CONFIGURATION) -> Tensor:
    """(N,) boolean: which configurations (N, n) are also among others (M, n)."""
    others = others.to(q)
    near = [(torch.cdist(block, others, p=inf) < within).any(1) for block in q.split(ROWS_AT_ONCE)]
    return torch.cat(near)


def repeated_lines(model: Any, q: Tensor) -> list[str]:
    """A sentence if configurations (N, n) are those of the fit: they say little about other poses."""
    count = int(repeats(q, fitted_configurations(model), REPEATED).sum())
    what = f"{count} of {len(q)} rows repeat joint values of the fit: errors at other poses are larger, and copies of"
    return [f"{what} its rows, also with fewer digits, tell nothing new"] * bool(count)


def refuse_other_angles(model: Any, q: object) -> None:
    """Raise MeasurementError for joint values that are those of the fit in the other unit of angles alone.

    All of them are then within the joint ranges of the fit, and as they are none is. A warning if some are, but they
    hardly move. Degrees are larger than what an axis can turn in radians: smaller values would be in any range around
    zero.

    Args:
        model: the calibrated model. q: (N, n) joint configurations, rad or m.
    """
    values: Tensor = model.robot.joint_values(q).detach()  # pyright: ignore[reportArgumentType]
    fitted, turning = model.configurations, torch.tensor(model.robot.periodic, dtype=torch.bool, device=values.device)
    if not (len(values) and bool(turning.any())):
        return
    too_far = float(values[:, turning].abs().max()) > LARGEST_JOINT_ANGLE_RAD
    moved = (values.amax(0) - values.amin(0)) / (fitted.amax(0) - fitted.amin(0)).clamp(min=SAME_CONFIGURATION)
    all_outside = bool(joints_outside_range(model, values).any(1).all())
    for factor, fix in ANGLE_MISTAKES:
        meant = torch.where(turning, factor * values, values)
        if (factor < 1.0 and not too_far) or bool(joints_outside_range(model, meant).any()):
            continue
        moves = len(values) >= TELLING_ROWS and float(factor * moved[turning].median()) > TELLING_MOTION
        if all_outside or (factor > 1.0 and moves):
            expected, got = "the joint ranges of the fit", "values that are in them in the other unit of angles"
            text = sentence("the joint values", expected=expected, got=got, fix=fix)
            if all_outside:
                raise MeasurementError(text)
            warn_user(text)


def warn_outside_range(model: Any, q: object) -> None:
    """Warn of configurations (N, n) outside the joint ranges of the fit: how many rows, and which joints."""
    outside = joints_outside_range(model, q)
    if bool(outside.any()):
        names = [name for name, out in zip(model.robot.joint_names, outside.any(0).tolist(), strict=True) if out]
        rows = f"{int(outside.any(1).sum())} of {len(outside)} rows"
        what = f"{rows} are outside the joint range of the fit ({', '.join(names)})"
        fix = "trust them less than their standard deviations say, or measure there too"
        warn_user(sentence(what, fix=fix))


def check_same_robot(model: Any, data: Any) -> None:
    """Refuse rows of other joints than a model's, in another order or unit of angles, or of a payload elsewhere.

    Raises InputError: joints in another order. MeasurementError: angles in another unit.
    """
    check_joint_order(model.robot, data)
    check_payload_link(model.nominal.load.link, data)
    refuse_other_angles(model, data.q)
    for table, _ in rows_of_one_kind(data):
        sensor_of(table).check_angles(table, model)


def residuals(kinematics: Callable[[Tensor], Tensor], places: Places, data: Any) -> Evaluations:
    """Measured minus predicted values of every row, kind by kind, each in the unit of its device.

    Kinematics and errors as of :func:`evaluate`; places of the devices as :func:`place` finds them.
    """
    errors = [
        (sensor_of(table).errors(table, predicted_at(kinematics, table), places), rows)
        for table, rows in rows_of_one_kind(data)
    ]
    return Evaluations.of(errors, places.found, places.numbers)


def check_rows(kinematics: Callable[[Tensor], Tensor], data: Any) -> None:
    """Refuse what is no table, rows of other joints, tips and kinds than those of a model, and rows without errors."""
    if not isinstance(data, RowGroups):
        expected = "dc.Measurements, dc.Readings or Observations"
        raise InputError.of("`data`", expected=expected, got=type(data).__name__)
    check_shown(data)
    if isinstance(kinematics, CalibratedKinematics):
        check_same_robot(kinematics, data)
        for table, _ in rows_of_one_kind(data):
            sensor_of(table).check(table, kinematics)


def place(kinematics: Callable[[Tensor], Tensor], data: Any, *, every_session: bool = False) -> Places:
    """Place what a model does not know on the rows of a table: frames of set-ups, devices of readings.

    Rows of a single set-up are placed only with ``every_session``; by default they are in the model's frame.

    Raises:
        InputError: rows that a model cannot be compared with, or joints in another order.
        MeasurementError: too few rows of a set-up or device, or readings that no place of it explains.
    """
    check_rows(kinematics, data)
    model = kinematics if isinstance(kinematics, CalibratedKinematics) else None
    flags = {"unplaced": model is not None and model.own_frame, "every_session": every_session}
    turns, parts = None if model is None else model.turns, rows_of_one_kind(data)
    beside = Beside(partial(predicted_at, kinematics), known_devices(kinematics), turns, **flags)
    cameras = {kind: devices for kind, devices in beside.known.items() if devices.cameras}
    places = Places(cameras, ball=len(parts) > 1 if model is None else model.ball)
    for table, _ in parts:
        places = places.beside(sensor_of(table).place(table, beside))
    drift = KnownDrift.of(kinematics)
    sentences = [f"{places.numbers} numbers in all were found from the rows that are judged"] * (places.numbers > 0)
    sentences += [] if drift is None else drift.in_rows(data)
    return replace(places, found=(*places.found, *sentences))


def placement_sentences(model: object) -> list[str]:
    """Where the devices are that a model knows, with deviations; none for other kinematics."""
    drift = KnownDrift.of(model)
    lines = [line for devices in getattr(model, "placement", None) or () for line in devices.sentences()]
    return lines if drift is None else [*lines, *drift.of_joints()]


def at_payloads(kinematics: Callable[[Tensor], Tensor], data: Any) -> Callable[[Tensor], Tensor]:
    """Kinematics at some rows, each under its payload; those that are no calibrated models know no payload and stay."""
    return kinematics.at_payloads(data.payload) if isinstance(kinematics, CalibratedKinematics) else kinematics


def predicted_at(kinematics: Callable[[Tensor], Tensor], data: Any) -> Tensor:
    """(N, P, 3) markers of kinematics under the payloads of the rows, and where a drift moved them, m."""
    loaded, drift = at_payloads(kinematics, data), KnownDrift.of(kinematics)
    return loaded(data.q).detach() if drift is None else drift.points(loaded, data)


def rows_used_in_fit(model: CalibratedKinematics, q: object) -> Tensor:
    """Which configurations (N, n), rad or m, the model was fitted to, up to the rounding of files: (N,) boolean.

    Raises:
        InputError: not a calibrated model, wrong shape, or values that are not finite.
    """
    return repeats(model.robot.joint_values(q).detach(), fitted_configurations(model))  # pyright: ignore[reportArgumentType]


def unseen(model: CalibratedKinematics, q: Tensor) -> Tensor:
    """(N,) which configurations took no part in the fit, nor in a registration."""
    used = rows_used_in_fit(model, q)
    return ~(used if model.registration is None else used | repeats(q, model.registration.q)).to(HOST)


def rows_of_other_frames(model: CalibratedKinematics, q: Tensor) -> int:
    """How many of the configurations (N, n) were fitted in another session than that of the model's measuring frame.

    All rows of a registered model are in other frames, and models of old files do not know: none is counted.
    """
    if model.registration is not None:
        return 0
    rows = [devices.rows[devices.elsewhere.to(HOST)[devices.device]].to(q.device) for devices in model.placement]
    elsewhere = model.configurations[torch.cat(rows)] if rows else model.configurations[:0]
    return int(repeats(q, elsewhere).sum())


def positions_of(model: CalibratedKinematics, places: Places, data: Any) -> Measurements | None:
    """The measured positions of a table in the frame of a model, with its markers; None if none was measured.

    A drift that the model knows is undone.
    """
    positions, drift = measured_positions(data), KnownDrift.of(model)
    if positions is None:
        return None
    positions = places.aligned(positions)
    return with_points(positions if drift is None else drift.undone(positions), model)
