"""Values of mimic joints: an affine function of the active joints' values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from diffeo_calib.common.errors import RobotError
from diffeo_calib.robots.joint import Joint


def coupling(
    moving: Sequence[Joint], drivers: Sequence[Joint], fixed: Sequence[str], robot: str, between: str
) -> tuple[Tensor, Tensor]:
    """Values of all moving joints by those of the active ones.

    Args:
        moving: the n_all joints that move something. drivers: joints that drive some of these and move nothing else.
        fixed: names of fixed joints. robot: which robot it is, for messages. between: links where its joints are.

    Returns:
        Matrix (n_all, n) and vector (n_all,), rad or m; the n active joints are those of ``moving`` and ``drivers``
        that mimic none.

    Raises:
        RobotError: a joint that mimics a fixed joint or one that is not there, or joints that mimic one another in a
            circle.
    """
    every = [*moving, *drivers]
    active = [joint.name for joint in every if joint.mimic is None]
    units = torch.eye(len(active) + 1, dtype=torch.float64, device="cpu")  # a column per active joint, one of constants
    rows = dict(zip(active, units, strict=False))
    waiting = {joint.name: joint.mimic for joint in every if joint.mimic is not None}
    names = {joint.name for joint in every}
    for name, mimic in waiting.items():
        for driver in mimic:
            if driver not in names:
                raise _no_driver(name, driver, robot, between, fixed=driver in fixed)
    constants = {joint.name: joint.mimic_offset * units[-1] for joint in every}
    while waiting:
        ready = [name for name, mimic in waiting.items() if all(driver in rows for driver in mimic)]
        if not ready:
            what = f"joints of {robot} mimic each other in a circle: {' -> '.join(_circle(waiting))}"
            raise RobotError.of(what, fix="make one of them active")
        for name in ready:
            mimic = waiting.pop(name)
            rows[name] = sum((slope * rows[driver] for driver, slope in mimic.items()), constants[name])
    table = torch.stack([rows[joint.name] for joint in moving])
    return table[:, :-1].contiguous(), table[:, -1].contiguous()


def _no_driver(name: str, driver: str, robot: str, between: str, *, fixed: bool) -> RobotError:
    """The error of a joint that mimics one that does not move, or that is not there."""
    what = f"joint '{name}' of {robot} mimics '{driver}'"
    if fixed:
        fix = f"make '{name}' fixed as well, or let it mimic a moving joint"
        return RobotError.of(f"{what}, which is fixed", fix=fix)
    fix = "choose a base and a tip with that joint between them, correct its name, or make the joint active"
    return RobotError.of(f"{what}, which is not a joint between {between}", fix=fix)


def _circle(waiting: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Names of joints in one circle, closed by the first; every joint of ``waiting`` mimics another one of them."""
    path = [next(iter(waiting))]
    while True:
        driver = next(name for name in waiting[path[-1]] if name in waiting)
        if driver in path:
            return [*path[path.index(driver) :], driver]
        path.append(driver)
