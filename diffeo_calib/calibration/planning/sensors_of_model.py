"""Sensors of a model's rows, reused for planned poses: devices where the fit found them."""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.calibration.planning.board_images import board_images
from diffeo_calib.calibration.planning.sensors import DeviceReadings, InSockets, Positions, Sensor
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.sensors.devices import Devices
from diffeo_calib.sensors.kinds import known_kinds
from diffeo_calib.sensors.places import PlacedDevices

SAME_SLOPES = 0.05
"""Largest difference of slopes of a device that was recognised, relative to those of a distance."""
MOST_NUMBERS = 2
"""Of a reading; rows that report more tell coordinates."""


def sensor_of(model: CalibratedKinematics) -> tuple[Sensor, ...]:
    """Sensors that measured the rows of a model, devices of readings and sockets where the fit found them.

    Where the model does not know its devices (files of old versions, and registered models) they are read off the map,
    which keeps the slopes of its rows and the effects of its devices.
    """
    fitted, q, known = model.map, model.configurations, _known_devices(model)
    shared = fitted.noise.shared
    measured, read, resting = _rows_by_sensor(model)
    found: list[Sensor] = [Positions(whole=model.lever is not None)] if bool(measured.any()) else []
    found += [camera for own in model.placement for camera in board_images(model, own)]
    if bool(resting.any()):
        found.append(_sockets(model(q[resting]).detach()[:, -1], shared[resting, -3:]))
    moved = (shared != 0).any(1)  # (N, c) unknowns of a row
    if known:
        own = ((devices, moved[rows].any(0), _noise(model, rows)) for rows, devices in known)
        return (*found, *(DeviceReadings(None, *parts) for parts in own))
    for own in moved[read].unique(dim=0) if bool(read.any()) else ():
        rows = (moved == own).all(1) & read
        found.append(_device(model, (rows, own), _name(model, rows)))
    return tuple(found)


def without_positions(model: CalibratedKinematics) -> bool:
    """Whether no device of positions or poses measured rows of a model."""
    return not bool(_rows_by_sensor(model)[0].any())


def _rows_by_sensor(model: CalibratedKinematics) -> tuple[Tensor, Tensor, Tensor]:
    """(N,) boolean: rows of the fit that tell positions or poses, readings, and a ball in sockets, but for images."""
    fitted = model.map
    shared, visible = fitted.noise.shared, fitted.noise.visible
    of_ball = torch.full_like(visible[:, 0], model.ball)
    read = torch.zeros_like(of_ball) if fitted.slopes is None else (visible.sum(1) <= MOST_NUMBERS) & of_ball
    imaged = torch.zeros_like(read)
    for own in model.placement:
        if own.devices is not None:
            read[own.rows] = True
        if own.cameras:
            imaged[own.rows] = True
    resting = visible[:, -3:].all(1) & (shared[:, -3:] != 0).any(2).any(1) & ~read & ~imaged & of_ball
    return ~read & ~resting & ~imaged, read, resting


def _noise(model: CalibratedKinematics, rows: Tensor) -> Tensor:
    """(r, r) noise of the readings of a device by its rows (M,) of the fit, m^2."""
    noise = model.map.noise
    numbers = noise.visible[rows][0]
    return noise.covariance[rows][:, numbers][:, :, numbers].median(0).values


def _known_devices(model: CalibratedKinematics) -> list[tuple[Tensor, Devices]]:
    """Every device of readings of a model by itself, and the rows (M,) of the fit that it measured."""
    found, noise = [], model.map.noise
    for one in model.placement:
        for number in one.device.unique().tolist() if one.devices is not None else ():
            rows, kind = one.rows[one.device == number].to(noise.shared.device), known_kinds()[one.kind]
            effects = noise.shared[rows[0], noise.visible[rows[0]]]
            offset = float(effects[-1, effects[-1].nonzero()[-1]])  # of an unknown zero, as its prior has it
            prior, name = one.constants.new_tensor(kind.prior(offset)), _called(model, one, number)
            found.append((rows, kind((name,), one.constants[number, None], prior)))
    return found


def _sockets(ball: Tensor, effects: Tensor) -> InSockets:
    """The sockets of a fit by its rows: places (N, 3) of the ball, m, and effects (N, 3, c)."""
    _, which = effects.flatten(1).unique(dim=0, return_inverse=True)
    rows = [which == number for number in range(int(which.max()) + 1)]
    first = torch.stack([effects[own][0] for own in rows])
    return InSockets(None, torch.stack([ball[own].mean(0) for own in rows]), first)


def _name(model: CalibratedKinematics, rows: Tensor) -> str:
    """Name of the device that measured some rows (N,) of a fit, after its kind where another kind has the same name.

    Files of old versions hold no names.
    """
    first = int(rows.nonzero()[0, 0])
    for own in model.placement:
        for name, row in zip([own.names[number] for number in own.device.tolist()], own.rows.tolist(), strict=True):
            if row == first:
                return _called(model, own, own.names.index(name))
    return f"device of row {first}"


def _called(model: CalibratedKinematics, own: PlacedDevices, number: int) -> str:
    """Name of a device, after its kind where another kind has the same name."""
    name = own.names[number]
    return name if sum(name in other.names for other in model.placement) == 1 else f"{own.kind} {name}"


def _device(model: CalibratedKinematics, own: tuple[Tensor, Tensor], name: str) -> DeviceReadings:
    """A device of readings of a fit by its rows (N,) and its columns (c,) among the effects."""
    (rows, columns), fitted = own, model.map
    if fitted.slopes is None:
        raise InputError.of("a model of readings", expected="slopes of its rows")
    numbers, ball = fitted.noise.visible[rows][0], model(model.configurations[rows]).detach()[:, -1]
    slopes, effects = fitted.slopes[rows][:, numbers, -3:], fitted.noise.shared[rows][:, numbers][..., columns]
    for kind in known_kinds().values():
        deviations = effects.new_tensor(kind.prior(float(effects[0, -1, -1])))
        if len(deviations) != effects.shape[2]:
            continue
        constants = kind.seen_by(slopes, effects / deviations, ball)
        if constants is None:
            continue
        devices = kind((name,), constants[None], deviations)
        again = devices.observation(torch.zeros(len(slopes), dtype=torch.int64, device=slopes.device)).slope(ball)
        if again.shape == slopes.shape and float((again - slopes).abs().max()) < SAME_SLOPES:
            return DeviceReadings(None, devices, columns, _noise(model, rows))
    fix = "say by `sensor` what will measure, or write `seen_by` of your kind of device"
    raise InputError.of("the devices of this model are of a kind that a plan does not know", fix=fix)
