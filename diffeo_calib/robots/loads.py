"""Robots with a further place of weight, such as the centre of mass of what the tool carries."""

from __future__ import annotations

import torch

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import RobotError, listed
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.tree import Ends, Tree


def with_load(robot: Tree, name: str, place: object, on: str | None = None) -> Tree:
    """The same robot with a weight beside the links of its description, for the place of a payload.

    It is a branch that only weighs, as `load` of :func:`load_urdf`: exports that know serial robots only refuse it.

    Args:
        robot: the robot. name: of the new place, for :meth:`Measurements.with_payload`.
        place: (3,) in the frame of a tip, m.
        on: name of that tip; the only one by default.

    Raises:
        RobotError: a name that is taken, or an unknown tip.
        InputError: no three numbers.
    """
    tip = robot.tip if on is None else on
    if tip not in robot.ends:
        raise RobotError.of("`on`", expected=listed(list(robot.ends)), got=tip, fix="name the tip that carries it")
    if name in robot.ends:
        raise RobotError.of("`name` of the load", expected="a new name", got=name)
    origin = torch.eye(4, dtype=torch.float64, device=HOST)
    origin[:3, 3] = as_tensor(place, "place", (3,))
    loads = {load: robot.ends[load] for load in robot.loads} | {name: len(robot.joints)}
    ends = Ends({own: robot.ends[own] for own in robot.tips}, loads, robot.ground)
    joints, parents = [*robot.joints, Joint(f"{name} (load)", "fixed", origin)], [*robot.parents, robot.ends[tip]]
    return Tree(robot.name, robot.base, joints, parents, ends, drivers=robot.drivers, source=robot.source)
