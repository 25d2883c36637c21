"""Sensors of a model's rows, reused for planned poses: devices where the fit found them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from diffeo_calib.calibration.planning.board_images import board_images
from diffeo_calib.calibration.planning.sensors import DeviceReadings, InSockets, Positions, Sensor
from diffeo_calib.cameras.images import UNKNOWNS
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.sensors.devices import Devices
from diffeo_calib.sensors.kinds import known_kinds

SAME_SLOPES = 0.05
"""Largest difference of slopes of a device that was recognised, relative to those of a distance."""
MOST_NUMBERS = 2
"""Of a reading; rows that report more tell coordinates."""


def sensor_of(model: CalibratedKinematics) -> tuple[Sensor, ...]:
    """Sensors that measured the rows of a model, devices of readings and sockets where the fit found them.

    Raises:
        InputError: files of early versions, which do not say where devices of readings are.
    """
    q, shared, known = model.configurations, model.map.noise.shared, list(_known_devices(model))
    measured, read, resting = _rows_by_sensor(model)
    unknown = bool(read.any()) and not known
    if unknown and model.registration is None:
        fix = "say by `sensor` what will measure"
        raise InputError.of("the file of this model does not say which devices measured its rows", fix=fix)
    found: list[Sensor] = [Positions(whole=model.lever is not None)] if bool(measured.any()) or unknown else []
    found += [camera for own in model.placement for camera in board_images(model, own)]
    if bool(resting.any()):
        ball, effects = model(q[resting]).detach()[:, -1], shared[resting, -3:]
        _, which = effects.flatten(1).unique(dim=0, return_inverse=True)
        rows = [which == number for number in range(int(which.max()) + 1)]
        first = torch.stack([effects[own][0] for own in rows])
        found.append(InSockets(None, torch.stack([ball[own].mean(0) for own in rows]), first))
    return (*found, *known)


def without_positions(model: CalibratedKinematics) -> bool:
    """Whether no device of positions or poses measured rows of a model."""
    return not bool(_rows_by_sensor(model)[0].any())


def _rows_by_sensor(model: CalibratedKinematics) -> tuple[Tensor, Tensor, Tensor]:
    """(N,) boolean: rows of the fit that tell positions or poses, readings, and a ball in sockets, but for images.

    The device of rows that a recalibration added is not known: images among them share the errors of lens and board.
    """
    fitted = model.map
    shared, visible = fitted.noise.shared, fitted.noise.visible
    of_ball, count = torch.full_like(visible[:, 0], model.ball), visible.sum(1)
    read = (count <= MOST_NUMBERS) & of_ball if fitted.slopes is not None else torch.zeros_like(of_ball)
    body = 3 * fitted.m // len(model.bodies.averaging(fitted.new_noise))  # numbers of a marker, or of a pose
    read |= count % body != 0
    imaged = torch.zeros_like(read)
    for own in model.placement:
        if own.devices is not None:
            read[own.rows] = True
        if own.cameras:
            imaged[own.rows] = True
            imaged |= (shared != 0).any(1).sum(1) >= len(UNKNOWNS)
    resting = visible[:, -3:].all(1) & (shared[:, -3:] != 0).any(2).any(1) & ~read & ~imaged & of_ball
    return ~read & ~resting & ~imaged, read & ~imaged, resting


def _known_devices(model: CalibratedKinematics) -> Iterator[DeviceReadings]:
    """Every device of readings of a model by itself; of one that measured no row only its rough place is known."""
    noise, taken = model.map.noise, list[Tensor]()
    moved = (noise.shared != 0).any(1)  # (N, c) unknowns of a row
    for one in model.placement:
        for number, word in enumerate(one.names if one.devices is not None else ()):
            kind, several = known_kinds()[one.kind], sum(word in other.names for other in model.placement) > 1
            rows = one.rows[one.device == number].to(noise.shared.device)
            name = f"{one.kind} {word}" if several else word
            device = kind((name,), one.constants[number, None], one.constants.new_tensor(kind.prior()))
            rows = rows if len(rows) else _unnamed_rows(model, device, taken)
            if not len(rows):
                yield DeviceReadings(None, device, around=True)
                continue
            taken.append(rows)
            numbers = noise.visible[rows[0]]
            effects, own = noise.shared[rows[0], numbers], noise.covariance[rows][:, numbers][:, :, numbers]
            offset = float(effects[-1, effects[-1].nonzero()[-1]])  # of an unknown zero, as its prior has it
            device = replace(device, deviations=one.constants.new_tensor(kind.prior(offset)))
            columns = moved[rows].any(0)
            mine = model.map.registration is None and int(columns.sum()) == len(device.deviations)  # no set-up's
            yield DeviceReadings(None, device, columns if mine else None, own.median(0).values, around=not mine)


def _unnamed_rows(model: CalibratedKinematics, device: Devices, taken: list[Tensor]) -> Tensor:
    """(M,) rows of the fit that a device measured by their slopes, but for some that are taken; mostly of one kind.

    A recalibrated or registered model does not know the devices of its rows.
    """
    fitted, none = model.map, model.map.noise.shared.new_zeros(0).long()
    if fitted.slopes is None:
        return none
    moved, visible = (fitted.noise.shared != 0).any(1), fitted.noise.visible
    read, width = _rows_by_sensor(model)[1], 3 * device.seen_points
    for rows in taken:
        read[rows] = False
    unknowns = {len(device.prior(std)) for std in (0.0, 1.0)}
    for own in moved[read].unique(dim=0) if bool(read.any()) else ():
        rows = ((moved == own).all(1) & read).nonzero()[:, 0]
        slopes = fitted.slopes[rows][:, visible[rows[0]], -width:]
        again = device.observation(torch.zeros_like(rows)).slope(fitted.fitted_points[rows, -width:])
        same = again.shape == slopes.shape and float((again - slopes).abs().max()) < SAME_SLOPES
        if same and int(own.sum()) in unknowns:
            return rows
    return none
