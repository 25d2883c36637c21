"""Likely mistakes in measurements that do not fit a robot: each usual one is undone and the robot registered again.

The mistake whose correction explains the measurements far better is reported. All of them concern tables and
conventions. They are judged by the registration alone, whose few unknowns cannot compensate for them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, product
from math import pi

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.other_readings import (
    Reading,
    longer_chains,
    other_columns,
    other_rotations,
)
from diffeo_calib.calibration.identification.registration import can_register, register
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import sentence, warn_user
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree


@dataclass(frozen=True)
class MistakeLimits:
    """When a mistake counts as found.

    Args:
        remaining: largest part of the residual that may remain after its correction.
        decisive: part of the residual below which no other mistake is tried.
        rows: largest number of rows that are registered.
        below_tip: part of the residual that a joint below the tip must leave to be warned about; a joint that does not
            move the markers leaves more than all of it.
        told_apart: residual, as a multiple of the best one, from which a reading of rotations counts as worse. The best
            residual is the robot's own error e; a wrong reading adds its w to it, sqrt(e^2 + w^2).
    """

    remaining: float = 0.2
    decisive: float = 0.02
    rows: int = 60
    below_tip: float = 0.8
    told_apart: float = 3.0


LIMITS = MistakeLimits()
RIGHT_ANGLES = ((pi / 2, "90"), (-pi / 2, "-90"), (pi, "180"))
"""Usual joint offsets of another convention [rad, deg]."""
NO_MISTAKE_FOUND = (
    "check the angle unit, the order of the joints, the tip link or DH convention, "
    "and that rows pair joints with their own points"
)


def likely_mistake(robot: Tree, data: Measurements, typical: float) -> str:
    """Advice on measurements that no registration explains.

    Args:
        robot: n joints. data: N rows. typical: median residual of the measurements as they are, m.

    Returns:
        a phrase: the mistake that explains them, if there is one, else what to check.
    """
    good: list[tuple[float, Reading]] = []
    for group in (_shifted, _mirrored, _other_tips, other_rotations, _other_joints, longer_chains, other_columns):
        for reading in group(robot, data):
            residual = _residual(reading)
            if residual < LIMITS.remaining * typical:
                good.append((residual, reading))
            if residual < LIMITS.decisive * typical and group is not other_rotations:
                break  # conventions may be hard to tell apart: all of them are tried
        if any(residual < LIMITS.decisive * typical or reading.partial for residual, reading in good):
            break
    return _advice(good, typical) if good else NO_MISTAKE_FOUND


def residual_of(robot: Tree, data: Measurements) -> float:
    """Median residual of a registration of the measurements as they are, m; infinite if the rows are too few."""
    return _residual(Reading(robot, data.q, data.points, "", on=data.on or ()))


def residuals_by_convention(robot: Tree, data: Measurements) -> dict[str, float]:
    """Convention of the rotation columns -> median residual of a registration of the poses read so, m."""
    own = data.origin.columns.table.convention if isinstance(data.origin, TableOrigin) else None
    found = {} if own is None else {own: residual_of(robot, data)}
    for reading in other_rotations(robot, data):
        name, _, convention = reading.option.partition("=")
        if name == "convention":
            found[convention.strip("'")] = _residual(reading)
    return found


def warn_of_joints_below_tip(robot: Tree, data: Measurements) -> None:
    """Warn if a joint below the given tip moves the markers, judged by its column in the table.

    Columns of joints that do not move the markers, such as those of a gripper, explain nothing: no warning.
    """
    longer = [(_residual(one), one) for one in longer_chains(robot, data)]
    if not longer:
        return
    (best, reading), own = min(longer, key=lambda entry: entry[0]), residual_of(robot, data)
    if best < LIMITS.below_tip * own:
        got = f"a median residual that falls from {1e3 * own:.3g} to {1e3 * best:.3g} mm with it"
        warn_user(sentence("a joint below the tip seems to move the markers", got=got, fix=reading.words))


def _advice(good: list[tuple[float, Reading]], typical: float) -> str:
    """The best reading in words, with those that these rows do not tell apart from it."""
    whole = [entry for entry in good if not entry[1].partial] or good
    best, reading = min(whole, key=lambda entry: entry[0])
    words, doubt = reading.words, ""
    if reading.option:
        near = sorted(entry for entry in ((r, one.option) for r, one in whole) if entry[1])
        options = [option for residual, option in near if residual < LIMITS.told_apart * best]
        words = f"the rotations seem to be written with {' or '.join(options)}"
        doubt = ", which these rows do not tell apart" if len(options) > 1 else ""
    return f"{words}{doubt} (the median residual falls from {1e3 * typical:.3g} to {1e3 * best:.3g} mm)"


def _residual(reading: Reading) -> float:
    """Median distance after registration of a random subset of the rows, m; infinite if the rows are too few."""
    q, points = reading.q, reading.points
    rows = torch.randperm(len(q), generator=seeded(0), device=HOST)[: LIMITS.rows]
    if len(q) < 2 * (2 + reading.robot.n) or not can_register(points[rows]):
        return torch.inf
    geometry = register(reading.robot, q[rows], points[rows], reading.on).geometry
    return float((geometry.points(q[rows]) - points[rows]).norm(dim=-1).nanmedian())


def _shifted(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Points that belong to the row before or after."""
    pair = "pair every configuration with its own"
    words, on = f"the points seem to be one row too {{}}: {pair}", data.on or ()
    yield Reading(robot, data.q[:-1], data.points[1:], words.format("late"), on=on)
    yield Reading(robot, data.q[1:], data.points[:-1], words.format("early"), on=on)


def _mirrored(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Points in a frame of the other hand."""
    if data.poses is None:
        mirrored = torch.cat([data.points[..., :2], -data.points[..., 2:]], dim=-1)
        words = "the frame of the measurements seems to be left-handed: exchange two position columns, or change a sign"
        yield Reading(robot, data.q, mirrored, words, on=data.on or ())


def _other_tips(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Markers of two tips exchanged, such as those of the left and of the right hand."""
    for one, other in combinations(robot.tips, 2):
        exchanged = {one: other, other: one}
        words = f"the markers on '{one}' and '{other}' seem to be exchanged: check which columns belong to which tip"
        yield Reading(robot, data.q, data.points, words, on=tuple(exchanged.get(tip, tip) for tip in data.on or ()))


def _other_joints(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Joint values with one mistake undone."""
    for q, words in _corrections_of_joints(robot, data):
        yield Reading(robot, q, data.points, words, on=data.on or ())


def _corrections_of_joints(robot: Tree, data: Measurements) -> Iterator[tuple[Tensor, str]]:
    names, turning = robot.joint_names, torch.tensor(robot.periodic, dtype=torch.bool, device=data.q.device)
    for factor, words in ((pi / 180, "degrees: convert them to radians"), (180 / pi, "radians that were converted")):
        q = torch.where(turning, factor * data.q, data.q)
        yield q, f"the joint values seem to be {words}; check the angle unit"
    for factor, words in ((1e-3, "large"), (1e3, "small")) if not all(robot.periodic) else ():
        q = torch.where(turning, data.q, factor * data.q)
        yield q, f"the values of prismatic joints seem to be 1000 times too {words}: check their unit (`joint_length`)"
    for k, name in enumerate(names):
        q = data.q.clone()
        q[:, k] *= -1
        yield q, f"{name} seems to count the other way: change the sign of its column, or of its axis"
    for a, b in combinations(range(len(names)), 2):
        q = data.q.clone()
        q[:, [a, b]] = data.q[:, [b, a]]
        yield q, f"the columns of {names[a]} and {names[b]} seem to be exchanged: check the order of the joints"
    # Last: half a turn of one joint may look like another one that counts the other way.
    for k, (offset, degrees) in product(range(len(names)), RIGHT_ANGLES):
        if robot.periodic[k]:
            q = data.q.clone()
            q[:, k] += offset
            yield q, f"{names[k]} seems to have another offset: its values fit with {degrees} degrees added"
