"""Measurements whose joints and tips are named must fit the robot."""

from __future__ import annotations

from diffeo_calib.common.errors import InputError, MeasurementError, listed
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree


def check_joint_order(robot: Tree, data: Measurements) -> None:
    """Raise InputError if the measurements name the robot's joints in another order, or only some of them."""
    names = data.joint_names or robot.joint_names
    if names != robot.joint_names and set(names) & set(robot.joint_names):
        raise InputError.of(
            f"the measurements' joints are not those of robot '{robot.name}'",
            expected=listed(robot.joint_names),
            got=listed(names),
            fix="put the columns in the robot's order",
        )


def check_tips(own: tuple[str, ...], data: Measurements) -> None:
    """Raise MeasurementError if the measurements say that their markers are on other tips than those of a model.

    Args:
        own: tips of the model's markers. data: markers whose tips are not named are those of the model, in its order.
    """
    if data.on is not None and data.on != own:
        what, fix = "the measurements' markers are on other tips than the model's", "put the markers in its order"
        raise MeasurementError.of(what, expected=listed(own), got=listed(data.on), fix=fix)


def marker_tips(robot: Tree, data: Measurements) -> tuple[str, ...]:
    """Names of the tips that carry the markers, one for each point of the measurements.

    Raises:
        MeasurementError: a tip that the robot does not have, or a robot with several tips and measurements that do not
            say on which of them their markers are.
    """
    if data.on is not None and not set(data.on) <= set(robot.tips):
        what, fix = f"`on`: the tips of robot '{robot.name}'", "name the tip of every marker"
        raise MeasurementError.of(what, expected=f"names among {listed(robot.tips)}", got=listed(data.on), fix=fix)
    if data.on is not None or len(robot.tips) == 1:
        return data.on or (robot.tips[0],) * data.markers
    if data.lever is not None:
        what = f"robot '{robot.name}' has {len(robot.tips)} tips, and the measurements are poses of one frame"
        fix = "load the robot with one tip, and the others as `load`; or pass three points of every pose as markers"
        raise MeasurementError.of(what, fix=fix)
    what = f"robot '{robot.name}' has {len(robot.tips)} tips ({listed(robot.tips)})"
    fix = "pass Measurements(..., on=[...]) with the tip of every marker"
    raise MeasurementError.of(f"{what}, and the measurements do not say on which of them their markers are", fix=fix)
