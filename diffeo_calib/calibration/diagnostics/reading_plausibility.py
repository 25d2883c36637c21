"""Readings of distances, heights or images that cannot be right, or that leave something open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError, few, sentence, warn_user
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import Devices, check_devices


@dataclass(frozen=True)
class ReadingLimits:
    """When readings are refused or warned about.

    Args:
        fewest_rows: below which single numbers say too little: a robot of six joints has some thirty geometric errors.
        unseen: motion of a reading, relative to that of a coordinate of the ball, below which it does not show a joint.
        tilted: motion of the readings per unit of the ball's offset, by turns of the tool, below which its place is not
            determined along that direction.
        size_share: share of the expected error from which the robot's size is warned about.
    """

    fewest_rows: int = 40
    unseen: float = 0.05
    tilted: float = 0.05
    size_share: float = 0.8


LIMITS = ReadingLimits()


def check_readings(robot: Tree, tables: Sequence[Readings], *, alone: bool) -> None:
    """Refuse another tip than the robot has, and too few rows.

    Args:
        robot: n joints. tables: readings of one kind each. alone: whether no other rows tell of the robot.
    """
    if not tables:
        return
    tip = tables[0].on
    if tip is None and len(robot.tips) > 1:
        fix = "name the tip that carries the ball (`with_tips`), or load the robot with that one"
        raise InputError.of("readings of a robot with several tips", expected="one", got=few(robot.tips), fix=fix)
    if tip is not None and tip not in robot.tips:
        raise InputError.of("the tip of the readings", expected=few(robot.tips), got=tip)
    count = sum(map(len, tables))
    if alone and count < LIMITS.fewest_rows:
        fix = "measure more rows, better 150, or hold out fewer of them (--holdout)"
        expected = f"at least {LIMITS.fewest_rows} rows"
        raise MeasurementError.of("`readings`", expected=expected, got=count, fix=fix)
    for table in tables:
        check_devices(table)


def warn_of_what_is_open(devices: Sequence[Devices], shown: dict[str, float], tilt: Tensor) -> None:
    """Warn of directions of the ball and joints that no reading shows.

    Args:
        devices: where readings were found to come from.
        shown: joint -> motion of the readings with it, relative to that of a coordinate of the ball.
        tilt: (3,) motions of the readings per unit of the ball's offset, by turns of the tool alone.
    """
    for own in devices:
        for what, fix in own.open_sentences():
            warn_user(sentence(what, fix=fix))
    if float(tilt.min()) < LIMITS.tilted:
        what = "the tool is hardly tilted: where the ball is on it, along one direction, is not determined"
        warn_user(sentence(what, fix="tilt the tool by 20 degrees or more, to several sides"))
    unseen = [name for name, share in shown.items() if share < LIMITS.unseen]
    if unseen:
        what = f"the readings hardly change with {few(unseen)}: errors of such joints are not determined"
        warn_user(sentence(what, fix="add devices that see these joints turn"))


def warn_of_size(fix: str, size: float, share: float, expected: float) -> None:
    """Warn where most of the error that the model expects is the robot's size.

    Args:
        fix: what to do. size: relative deviation of the size. share: of the expected error. expected: this, m.
    """
    if share < LIMITS.size_share:
        return
    what = (
        f"the readings hold too little length: the robot's size is known to {100 * size:.2f} % (one standard "
        f"deviation), which is {100 * share:.0f} % of the expected error of {1e3 * expected:.2f} mm and rests on the "
        "robot's description"
    )
    warn_user(sentence(what, fix=fix))
