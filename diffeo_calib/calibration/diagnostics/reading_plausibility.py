"""Readings of distances, heights or images that cannot be right, or that leave something open."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, MeasurementError, few, sentence, warn_user
from diffeo_calib.kinematics.reading_devices import Devices, Planes, check_devices
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.robots.tree import Tree


@dataclass(frozen=True)
class ReadingLimits:
    """When readings are refused or warned about.

    Args:
        fewest_rows: below which single numbers say too little: a robot of six joints has some thirty geometric errors.
        flat: smallest singular value of the planes' normals, relative to the largest, from which directions differ.
        parallel: sine of the angle between planes below which they are parallel.
        unseen: motion of a reading, relative to that of a coordinate of the ball, below which it does not show a joint.
        tilted: motion of the readings per unit of the ball's offset, by turns of the tool, below which its place is not
            determined along that direction.
        size_share: share of the expected error from which the robot's size is warned about.
        zero_warned, zero_refused: factors by which a free zero of distances lowers the noise that the geometric
            calibration leaves, from which the zero is warned about, and the readings refused. Simulated arms: 0.9 to
            1.1 with the right zero, 1.3 to 1.6 with one that is 3 mm off, 2.9 to 5.2 with 10 mm; of a real UR10
            or Franka 0.6 to 1.1, 0.6 to 1.1, and 0.8 to 1.5.
    """

    fewest_rows: int = 40
    flat: float = 0.2
    parallel: float = 0.1
    unseen: float = 0.05
    tilted: float = 0.05
    size_share: float = 0.8
    zero_warned: float = 1.25
    zero_refused: float = 2.0


LIMITS = ReadingLimits()


def check_zero(noise: float, free_noise: float, offsets: dict[str, float]) -> None:
    """Refuse, or warn about, lengths whose zero seems to be another one than the device's.

    Args:
        noise: that the geometric calibration leaves, m. free_noise: with a free zero of every device.
        offsets: their lengths that all readings have too much, m, by name of the device.

    Raises:
        MeasurementError: a free zero explains the readings far better.
    """
    factor = noise / free_noise
    if factor < LIMITS.zero_warned:
        return
    listed = few([f"{1e3 * offset:+.1f} mm at '{name}'" for name, offset in offsets.items()])
    what = f"the distances seem to count from another zero: with a free one, {listed}, geometry explains them "
    what += f"{factor:.2g} times better"
    fix = "check the device's zero, the column and its unit, or give lengths from an unknown zero (`--reading "
    fix += "displacement=COLUMN`, in Python `offset_std=`)"
    if factor < LIMITS.zero_refused:
        warn_user(sentence(what, fix=fix))
        return
    raise MeasurementError.of(what, fix=fix)


def check_readings(robot: object, readings: object) -> None:
    """Refuse arguments of another kind, other joints, and too few rows.

    Raises:
        InputError, MeasurementError: see above.
    """
    for given, name, kind in ((robot, "robot", Tree), (readings, "readings", Readings)):
        if not isinstance(given, kind):
            raise InputError.of(f"`{name}`", expected=kind.__name__, got=type(given).__name__)
    if not isinstance(robot, Tree) or not isinstance(readings, Readings):
        return
    if readings.q.shape[1] != robot.n:
        expected, got = f"{robot.n} joints of {robot.name}", readings.q.shape[1]
        raise MeasurementError.of("`readings`", expected=expected, got=got, fix="pass one column per active joint")
    if len(robot.tips) > 1:
        fix = "load the robot with the one tip that carries the ball"
        raise InputError.of("`robot` of readings", expected="one tip", got=few(robot.tips), fix=fix)
    if readings.joint_names is not None and tuple(readings.joint_names) != tuple(robot.joint_names):
        expected, got = few(robot.joint_names), few(readings.joint_names)
        raise MeasurementError.of("the joints of `readings`", expected=expected, got=got, fix="order them so")
    if len(readings) < LIMITS.fewest_rows:
        fix = "measure more rows, better 150, or hold out fewer of them (--holdout)"
        expected = f"at least {LIMITS.fewest_rows} rows"
        raise MeasurementError.of("`readings`", expected=expected, got=len(readings), fix=fix)
    check_devices(readings)


def warn_of_what_is_open(readings: Readings, devices: Devices, shown: dict[str, float], tilt: Tensor) -> None:
    """Warn of directions of the ball and joints that no reading shows.

    Args:
        readings: the rows. devices: where they see them.
        shown: joint -> motion of the readings with it, relative to that of a coordinate of the ball.
        tilt: (3,) motions of the readings per unit of the ball's offset, by turns of the tool alone.
    """
    if isinstance(devices, Planes):
        _warn_of_planes(devices)
    if float(tilt.min()) < LIMITS.tilted:
        what = "the tool is hardly tilted: where the ball is on it, along one direction, is not determined"
        warn_user(sentence(what, fix="tilt the tool by 20 degrees or more, to several sides"))
    unseen = [name for name, share in shown.items() if share < LIMITS.unseen]
    if unseen:
        what = f"the readings hardly change with {few(unseen)}: errors of such joints are not determined"
        warn_user(sentence(what, fix="add devices that see these joints turn"))


def warn_of_size(readings: Readings, size: float, share: float, expected: float) -> None:
    """Warn where most of the error that the model expects is the robot's size.

    Args:
        readings: the rows. size: relative deviation of the size. share: of the expected error. expected: this, m.
    """
    if share < LIMITS.size_share:
        return
    what = (
        f"the readings hold too little length: the robot's size is known to {100 * size:.2f} % (one standard "
        f"deviation), which is {100 * share:.0f} % of the expected error of {1e3 * expected:.2f} mm and rests on the "
        "robot's description"
    )
    fixes = {
        "height": "touch a gauge block of known height on the same planes too and give its height",
        "image": "trust angles and shapes only, or measure distances, which hold lengths",
        "distance": "measure longer and more different distances, or with a known zero",
    }
    warn_user(sentence(what, fix=fixes[readings.kind]))


def _warn_of_planes(planes: Planes) -> None:
    normals = planes.constants[:, :3]
    every = len(normals), len(normals), 3
    across = torch.linalg.cross(normals[:, None].expand(every), normals[None].expand(every))
    alike = [
        f"'{planes.names[a]}' and '{planes.names[b]}'"
        for a, b in (across.norm(dim=2) < LIMITS.parallel).triu(1).nonzero().tolist()
    ]
    spread = torch.linalg.svdvals(normals)
    if len(normals) >= 3 and float(spread[-1]) >= LIMITS.flat * float(spread[0]):
        return
    parallel = f" ({few(alike)} are parallel)" * bool(alike)
    what = f"no plane faces some directions{parallel}: errors of the ball along them are not measured"
    warn_user(sentence(what, fix="add planes in other directions, best three at right angles"))
