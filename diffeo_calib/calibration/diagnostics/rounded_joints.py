"""Joint values with few digits: what their rounding does to the positions."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any

from torch import Tensor

from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import MOST_NAMES, few, sentence, warn_user
from diffeo_calib.common.quantiles import chi2_median
from diffeo_calib.robots.tree import Tree


@dataclass(frozen=True)
class RoundingLimits:
    """When joint values count as rounded, and when that is reported.

    Args:
        digits: most digits after the decimal point of a column that is looked at.
        remainder: largest distance from a multiple of the last digit, as a part of it.
        fewest_values: different values of a column that are needed.
        least: part of the remaining error from which rounding is reported. most: multiple of it beyond which it cannot
            have happened: the values were commanded with few digits, and reached.
    """

    digits: int = 5
    remainder: float = 1e-3
    fewest_values: int = 8
    least: float = 0.5
    most: float = 1.5


LIMITS = RoundingLimits()


def quantum(values: Tensor, *, turning: bool, limits: RoundingLimits = LIMITS) -> tuple[float, str] | None:
    """The step in which a joint's values (N,) were written, rad or m, and the step in words; None if they were not.

    Steps are powers of ten, whole or half, in rad, deg, m or mm.
    """
    if len(values.unique()) < limits.fewest_values:
        return None
    units = (("rad", 1.0), ("degrees", pi / 180)) if turning else (("m", 1.0), ("mm", 1e-3))
    steps = [
        (step * size, f"{step:g} {unit}")
        for unit, size in units
        for digits in range(limits.digits + 1)
        for step in (10.0**-digits, 5 * 10.0 ** -(digits + 1))
    ]
    for size, words in sorted(steps, reverse=True):
        multiples = values / size
        if float((multiples - multiples.round()).abs().max()) < limits.remainder:
            return size, words
    return None


def warn_of_rounding(
    robot: Tree,
    data: Any,
    tangent: TangentData,
    left_out: LeaveOneOut,
    limits: RoundingLimits = LIMITS,
) -> None:
    """Warn if the joint values have so few digits that their rounding explains much of the remaining error.

    Args:
        robot: n joints. data: N rows. tangent: the same around the geometric calibration.
        left_out: leave-one-out errors.
        limits: when rounding is found and reported.

    Warns:
        DiffeoCalibWarning: the step, the joints, the position error that it causes, and what remains.
    """
    found = {}
    for k, name in enumerate(robot.joint_names):
        step = quantum(data.q[:, k], turning=robot.periodic[k], limits=limits)
        if step is not None:
            found[k] = (name, *step)
    if not found:
        return
    variances, bodies = tangent.x.new_zeros(robot.n), tangent.noise_model.bodies
    for k, (_, size, _) in found.items():
        variances[k] = size**2 / 12  # of a uniform distribution
    points = bodies if tangent.noise_model.modes is None else tangent.y.shape[1] // 3
    caused = float((tangent.jacobian.square() @ variances).unflatten(1, (points, -1)).sum(-1).mean().sqrt())
    seen = left_out.errors.unflatten(1, (points, -1))
    squares = seen.square().nansum(-1)[~seen.isnan().all(-1)]
    size = seen.shape[2]
    remaining = float((size * squares.median() / chi2_median(size)).sqrt())
    if not limits.least * remaining < caused < limits.most * remaining:
        return
    steps = sorted({words for _, _, words in found.values()})
    which = few([name for name, _, _ in found.values()], MOST_NAMES)
    text = sentence(
        f"the values of {which} are rounded to {' and '.join(steps)}",
        expected="readings with more digits",
        got=f"{1e3 * caused:.2g} mm RMS of position error from this rounding, {1e3 * remaining:.2g} mm remain in all",
        fix="write more digits of the joint values, unless the robot was commanded to exactly these",
    )
    warn_user(text)
