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
from diffeo_calib.kinematics.device_readings import FittedDevice
from diffeo_calib.sensors.sockets import SocketPlaces


def sensor_of(model: CalibratedKinematics) -> tuple[Sensor, ...]:
    """Sensors that measured the rows of a model, devices of readings and sockets where the fit found them.

    Raises:
        InputError: files of early versions, which do not say where devices of readings are.
    """
    found: list[Sensor] = [] if without_positions(model) else [Positions(whole=model.lever is not None)]
    for own in model.placement:
        found += board_images(model, own)
        if own.kind == SocketPlaces.kind and len(own.rows):
            found.append(_sockets(model, own.rows, own.device))
    found += _devices(model)
    if not found:
        fix = "say by `sensor` what will measure"
        raise InputError.of("the file of this model does not say which devices measured its rows", fix=fix)
    return tuple(found)


def without_positions(model: CalibratedKinematics) -> bool:
    """Whether no device of positions or poses measured rows of a model, where its devices say which rows they did.

    The device of rows that a recalibration added is not known: images among them share the errors of lens and board.
    """
    if model.own_frame:
        return True
    shared = model.map.noise.shared
    other = torch.zeros(len(shared), dtype=torch.bool, device=shared.device)
    for own in model.placement:
        if own.devices.reads or own.devices.cameras or own.kind == SocketPlaces.kind:
            other[own.rows] = True
        if own.devices.cameras:
            other |= (shared != 0).any(1).sum(1) >= len(UNKNOWNS)
    return bool(other.all())


def _sockets(model: CalibratedKinematics, rows: Tensor, socket: Tensor) -> InSockets:
    """Those in which rows (M,) of the fit rested, at the middles of their rows; ``socket`` (M,) of each."""
    ball, effects = model(model.configurations[rows]).detach()[:, -1], model.map.noise.shared[rows, -3:]
    each = [socket == number for number in socket.unique()]
    places = torch.stack([ball[own].mean(0) for own in each])
    return InSockets(None, places, torch.stack([effects[own][0] for own in each]))


def _devices(model: CalibratedKinematics) -> Iterator[DeviceReadings]:
    """Every device of readings of a model by itself; of one that measured no row only its rough place is known."""
    for one in model.placement:
        for number, word in enumerate(one.names if one.devices.reads else ()):
            several = sum(word in other.names for other in model.placement) > 1
            fitted = FittedDevice.of(model.map, one, number)
            devices, offset = fitted.devices, float(fitted.devices.deviations[0, -1])
            prior = devices.constants.new_tensor(devices.prior(offset))
            known = devices.deviations if fitted.columns is None else prior[None]
            named = replace(devices, names=(f"{one.kind} {word}" if several else word,), deviations=known)
            yield DeviceReadings(None, named, fitted)
