"""Errors of any kinematics on readings of devices, which are placed where these fit best."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.joint_order import check_joint_order
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.sensors.devices import Devices, check_devices
from diffeo_calib.sensors.kinds import kind_of


def placed(kinematics: Callable[[Tensor], Tensor], data: Readings) -> Devices:
    """The devices where they fit some readings best, if the kinematics of the ball are right.

    Args:
        kinematics: (N, n) joint values -> (N, 1, 3) places of the ball, m. data: readings.

    Raises:
        InputError: a model of something else than the ball on one tool, or joints in another order.
        MeasurementError: too few rows of a device, or readings that no place of it explains.
    """
    if isinstance(kinematics, CalibratedKinematics):
        check_joint_order(kinematics.robot, data)
        if not kinematics.ball:
            fix = "calibrate with readings; the marker of the model is not where the ball is"
            got = "one that was calibrated with measured positions"
            raise InputError.of("readings of a ball", expected="a model of such readings", got=got, fix=fix)
    check_devices(data)
    points = kinematics(data.q).detach()[:, -1]  # the ball
    try:
        return kind_of(data).at(data, points).refined(data, points)
    except InputError as error:  # the ball at a fixed point or behind a camera
        fix = "check the columns of the readings, their unit, and which device each row names"
        raise MeasurementError.of(f"no place of the devices explains the readings ({error})", fix=fix) from None
