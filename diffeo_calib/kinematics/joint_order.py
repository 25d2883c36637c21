"""Measurements whose joints and tips are named must fit the robot."""

from __future__ import annotations

from diffeo_calib.common.errors import InputError, MeasurementError, listed
from diffeo_calib.measurements.pose_frames import POINTS
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree


def check_joint_order(robot: Tree, data: Measurements | Readings) -> None:
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
        body = "markers" if data.lever is None else "poses"
        what, fix = f"the measurements' {body} are on other tips than the model's", f"put the {body} in its order"
        raise MeasurementError.of(
            what, expected=listed(_by_body(own, data)), got=listed(_by_body(data.on, data)), fix=fix
        )


def _by_body(on: tuple[str, ...], data: Measurements) -> tuple[str, ...]:
    """The tips of markers, or of measured frames."""
    return on if data.lever is None else on[::POINTS]


def check_kind(lever: float | None, data: Measurements) -> None:
    """Raise InputError if poses were measured and the model is one of points (``lever`` None), or the other way round.

    Three markers are not a pose, although both are three points.
    """
    if (lever is None) == (data.poses is None):
        return
    kinds = ("points", "poses")
    raise InputError.of(
        f"the model was calibrated with {kinds[lever is not None]}",
        expected=f"measured {kinds[lever is not None]}",
        got=kinds[data.poses is not None],
        fix="name the columns of the rotation too" if data.poses is None else "leave the rotation out",
    )


def marker_tips(robot: Tree, data: Measurements) -> tuple[str, ...]:
    """Names of the tips that carry the markers, one for each point of the measurements.

    Raises:
        MeasurementError: a tip that the robot does not have, or a robot with several tips and measurements that do not
            say on which of them their markers are.
    """
    if data.on is not None and not set(data.on) <= set(robot.tips):
        body = "marker" if data.lever is None else "frame"
        what, fix = f"`on`: the tips of robot '{robot.name}'", f"name the tip of every {body}"
        raise MeasurementError.of(
            what, expected=f"names among {listed(robot.tips)}", got=listed(_by_body(data.on, data)), fix=fix
        )
    if data.on is not None or len(robot.tips) == 1:
        return data.on or (robot.tips[0],) * data.markers
    if data.lever is not None:
        what = f"robot '{robot.name}' has {len(robot.tips)} tips, and the measurements do not say whose poses they are"
        raise MeasurementError.of(what, fix="pass Measurements.from_poses(..., on=[...]) with the tip of every frame")
    what = f"robot '{robot.name}' has {len(robot.tips)} tips ({listed(robot.tips)})"
    fix = "pass Measurements(..., on=[...]) with the tip of every marker"
    raise MeasurementError.of(f"{what}, and the measurements do not say on which of them their markers are", fix=fix)
