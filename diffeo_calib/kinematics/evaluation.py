"""Errors of any kinematics on measurements: of positions, and of orientations where poses were measured.

For calibrated models also: which rows took part in the fit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.joint_ranges import check_same_robot, fitted_configurations, repeats
from diffeo_calib.measurements.rows import RowGroups
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.coordinates import Beside, Places, check_shown, known_devices, sensor_of
from diffeo_calib.sensors.errors import Evaluations
from diffeo_calib.sensors.known_drift import KnownDrift
from diffeo_calib.sensors.tables import measured_positions, rows_of_one_kind, with_points


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
