"""Measurements whose joints are named as the robot's must be in the robot's order."""

from __future__ import annotations

from diffeo_calib.common.errors import InputError, listed
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.chain import Chain


def check_joint_order(robot: Chain, data: Measurements) -> None:
    """Raise InputError if the measurements name the robot's joints in another order, or only some of them."""
    names = data.joint_names or robot.joint_names
    if names != robot.joint_names and set(names) & set(robot.joint_names):
        raise InputError.of(
            f"the measurements' joints are not those of robot '{robot.name}'",
            expected=listed(robot.joint_names),
            got=listed(names),
            fix="put the columns in the robot's order",
        )
