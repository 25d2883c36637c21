"""Likely mistakes in measurements that do not fit a robot: each usual one is undone and the robot registered again.

The mistake without which the measurements fit far better, and as well as those of any robot, is reported. All of them
concern tables and conventions, and are judged by the registration alone, whose few unknowns cannot compensate for
them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import SequenceMatcher
from itertools import combinations, permutations
from math import degrees, inf
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.conventions import Convention, conventions
from diffeo_calib.calibration.identification.registration import can_register, registered_geometry, spread
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import (
    LONGEST_NAME,
    DiffeoCalibError,
    InputError,
    MeasurementError,
    sentence,
    shown,
    warn_user,
)
from diffeo_calib.common.quantiles import known
from diffeo_calib.measurements.checks import ANGLE_MISTAKES
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.joints import JointExpressions, PoseColumns
from diffeo_calib.measurements.csv.tables import numeric_table, rereadings, with_coordinate
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import UNITS_PER_METRE
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.tree import Tree, robot_from_config
from diffeo_calib.robots.urdf import moving_joints_below, read_urdf

GROSS_MEDIANS, KEPT_ROWS, TRIMMINGS = 3.0, 0.75, 2
"""Distance, in medians, beyond which the rows that are the farthest off may spoil a registration: it is repeated with
the share of rows that are closest, at most so often."""
MOST_COLUMNS = 4
"""Most columns that are tried in the place of another one: every try is a registration."""
NO_MISTAKE_FOUND = (
    "check the angle unit, the order of the joints, the tip link or DH convention, "
    "and that rows pair joints with their own points"
)


@dataclass(frozen=True)
class Reading:
    """Measurements as they might have been meant."""

    robot: Tree  # the chain
    q: Tensor  # (N, n) rad or m
    points: Tensor  # (N, P, 3) m
    words: str = ""  # what was changed
    option: str = ""  # the option that reads the table so, where readings differ by one option alone; else empty
    # whether it explains a part of the measurements only, and is used if nothing else explains them
    partial: bool = False
    on: tuple[str, ...] = ()  # tips of the markers; the robot's first tip by default

    @classmethod
    def of(cls, robot: Tree, data: Measurements) -> Reading:
        """Measurements as they are."""
        return cls(robot, data.q, data.points, on=data.on or ())


Judge = Callable[[Reading], tuple[float, float]]
"""What the median residual of a reading is, m, and how far its points are spread, m."""
Group = Callable[[Tree, Measurements], Iterator[Reading]]


def registered(reading: Reading) -> tuple[float, float]:
    """Median distance after registration of a random subset of the rows, m, infinite if that cannot be done; spread.

    Two rounds at most register again without the quarter of the rows that is farthest off, as long as a row is gross
    (P. Rousseeuw, K. Van Driessen, "Computing LTS regression for large data sets", 2006).
    """
    q, points = reading.q, reading.points
    rows = torch.randperm(len(q), generator=seeded(0), device=HOST)[: gates.REGISTERED_ROWS]
    if len(known(points)) < 2 * (6 + 3 * points.shape[1]) or not can_register(points[rows]):
        return inf, 1.0
    q, points, typical = q[rows], points[rows], inf
    kept = torch.ones(len(q), dtype=torch.bool, device=q.device)
    for _ in range(1 + TRIMMINGS):
        try:
            geometry = registered_geometry(reading.robot, q[kept], points[kept], reading.on)
        except DiffeoCalibError:
            break
        off = (geometry.points(q) - points).norm(dim=-1)
        typical, worst = min(typical, float(off.nanmedian())), off.nan_to_num(0.0).amax(1)
        if float(worst.max()) <= GROSS_MEDIANS * typical:
            break
        kept = worst <= worst.quantile(KEPT_ROWS)
    return typical, spread(reading.points) if typical < inf else 1.0


def residual_of(robot: Tree, data: Measurements) -> float:
    """Median residual of a registration of the measurements as they are, m; infinite if the rows are too few."""
    return registered(Reading.of(robot, data))[0]


def check_fit(
    robot: Tree,
    data: Measurements,
    typical: float,
    what: str,
    *,
    expected: str,
    got: str,
    otherwise: str | None = None,
    **search: Any,
) -> None:
    """Refuse measurements that a mistake explains, see :func:`likely_mistake`; else warn and advise ``otherwise``."""
    mistake = likely_mistake(robot, data, typical, **search)
    if mistake:
        raise MeasurementError.of(what, expected=expected, got=got, fix=mistake)
    if otherwise is not None:
        warn_user(sentence(what, expected=expected, got=got, fix=otherwise))


def likely_mistake(
    robot: Tree, data: Measurements, typical: float, groups: Sequence[Group] = (), judge: Judge = registered
) -> str:
    """Advice on measurements that no registration explains.

    Args:
        robot: n joints. data: N rows. typical: median residual of the measurements as they are, m.
        groups: other readings to try, all by default. judge: of each.

    Returns:
        a phrase: the mistake that explains them; empty if there is none.
    """
    good, now = list[tuple[float, float, Reading]](), typical / max(judge(Reading.of(robot, data))[1], 1e-12)
    limit = min(gates.OTHER_READING_LEFT * now, gates.RIGHT_READING)
    decisive = gates.DECISIVE_READING * min(now, 1.0)
    for group in groups or EVERY_GROUP:
        for reading in group(robot, data):
            residual, size = judge(reading)
            share = residual / max(size, 1e-12)
            if share < limit:
                good.append((share, residual, reading))
            if share < decisive and group is not other_rotations:
                break  # conventions may be hard to tell apart: all of them are tried
        if any(share < decisive or reading.partial for share, _, reading in good):
            break
    if not good:
        return ""
    whole = [entry for entry in good if not entry[2].partial] or good
    share, best, reading = min(whole, key=lambda entry: entry[0])
    words, near = reading.words, sorted((part, other.option) for part, _, other in whole if other.option)
    if reading.option:
        options = [option for part, option in near if part < gates.READINGS_TOLD_APART * share]
        words = f"the rotations seem to be written with {' or '.join(options)}"
        words += ", which these rows do not tell apart" * (len(options) > 1)
    return f"{words} (the median residual falls from {1e3 * typical:.3g} to {1e3 * best:.3g} mm)"


# --- other readings ---------------------------------------------------------------------------------------------------


def other_points(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Points in another unit, in a frame of the other hand, of exchanged tips; they or a joint of other rows."""
    as_read, bodies = Reading.of(robot, data), data.points.unflatten(1, (data.origins.shape[1], -1))
    for factor, times, size in _units_of_length():
        points = (bodies + (factor - 1.0) * data.origins[:, :, None]).flatten(1, 2)  # a pose stays as large
        words = f"the positions seem to be {times:.4g} times too {size}: check their unit (`length`)"
        words += ", and that of the commanded ones (`joint_length`)" * is_cartesian(robot)
        yield replace(as_read, points=points, words=words)
    words = "the points seem to be one row too {}: pair every configuration with its own"
    yield replace(as_read, q=data.q[:-1], points=data.points[1:], words=words.format("late"))
    yield replace(as_read, q=data.q[1:], points=data.points[:-1], words=words.format("early"))
    for joint, name in enumerate(robot.joint_names):
        for which, own_rows, others in (("after", slice(1, None), slice(-1)), ("before", slice(-1), slice(1, None))):
            q, words = data.q[own_rows].clone(), f"the values of {name} seem to be those of the row {which}"
            q[:, joint] = data.q[others, joint]
            yield replace(as_read, q=q, points=data.points[own_rows], words=f"{words}: pair them with their own rows")
    words = "the frame of the measurements seems to be left-handed: exchange two position columns, or change a sign"
    for mirrored in data.bodies.mirrored(data):
        yield replace(as_read, points=mirrored, words=words)
    for one, other in combinations(robot.tips, 2):
        exchanged = {one: other, other: one}
        words = f"the markers on '{one}' and '{other}' seem to be exchanged: check which columns belong to which tip"
        yield replace(as_read, words=words, on=tuple(exchanged.get(tip, tip) for tip in as_read.on))


def other_rotations(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Measured poses whose rotations are read in other ways, or whose poses are inverted."""
    return (replace(Reading.of(robot, data), **changes) for changes in rereadings(data))


def other_units(robot: Tree, data: Measurements, *, slides: bool = True) -> Iterator[Reading]:
    """Joint values in other units of angles, and of lengths if ``slides``."""
    as_read, turning = Reading.of(robot, data), torch.tensor(robot.periodic, dtype=torch.bool, device=data.q.device)
    for factor, words in ANGLE_MISTAKES if any(robot.periodic) else ():
        yield replace(as_read, q=torch.where(turning, factor * data.q, data.q), words=words)
    for factor, times, words in _units_of_length() if slides and not all(robot.periodic) else ():
        text = f"the values of prismatic joints seem to be {times:.4g} times too {words}: check their unit"
        yield replace(as_read, q=torch.where(turning, data.q, factor * data.q), words=f"{text} (`joint_length`)")


def other_mimics(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Joints that follow others the other way round, twice or half as far, or not at all."""
    as_read, config = Reading.of(robot, data), robot.to_config()
    for place, joint in enumerate(robot.joints):
        for factor in (-1.0, 0.5, 2.0, 0.0) if joint.mimic else ():
            mimic = {name: factor * value for name, value in (joint.mimic or {}).items()}
            joints = [*robot.joints[:place], replace(joint, mimic=mimic), *robot.joints[place + 1 :]]
            other = robot_from_config(config | {"joints": [each.to_config() for each in joints]}, robot.source)
            words = f"joint '{joint.name}' seems to follow with {factor:g} times its multiplier"
            yield replace(as_read, robot=other, words=f"{words}: check it in the robot's description")


def _units_of_length() -> Iterator[tuple[float, float, str]]:
    """Factors that turn one unit of length into another, and by how many times values then are too small or large."""
    for factor in sorted({unit / other for unit, other in permutations(UNITS_PER_METRE.values(), 2)}):
        yield (factor, factor, "small") if factor > 1.0 else (factor, 1 / factor, "large")


def longer_chains(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Chains with joints below the given tip, for which the table has columns whose values vary."""
    columns, table = numeric_table(data)
    if columns is None or robot.source is None or len(robot.tips) > 1:
        return
    spare, content = _spare(columns, table), robot.source.encode("utf-8", "surrogateescape")
    for joint, child in moving_joints_below(content, robot.tips):
        if joint not in spare:
            continue
        try:
            longer = read_urdf(content, robot.base, child, Path("URDF"))
        except InputError:
            continue  # a joint that cannot be part of a chain
        added = [name for name in longer.joint_names if name not in robot.joint_names]
        if longer.joint_names[: robot.n] != robot.joint_names or not all(name in spare for name in added):
            continue
        slides = [not turns for turns in longer.periodic[robot.n :]]
        values = [_joint_values(columns, spare[name], slides=slide) for name, slide in zip(added, slides, strict=True)]
        more = torch.stack(values, dim=1).to(data.q.device)
        if bool((more.amax(0) - more.amin(0) > gates.FIXED_RANGE).all()):
            what = f"the table has a column for joint '{joint}', which is below the tip '{robot.tip}'"
            words = f"{what}: choose '{child}' or a link below it as the tip"
            yield Reading(longer, torch.cat([data.q, more], dim=1), data.points, words)


def other_columns(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """One column of the joints or of the position replaced by one of similar name that was not read."""
    columns, table = numeric_table(data)
    if columns is None:
        return
    spare, as_read = _spare(columns, table), Reading.of(robot, data)
    for k, (joint, text) in enumerate(zip(robot.joint_names, columns.joints.texts, strict=True)):
        for name in _similar([joint, text], spare):
            q = data.q.clone()
            q[:, k] = _joint_values(columns, spare[name], slides=not robot.periodic[k]).to(q.device)
            words = f"column '{shown(name)}' fits as {joint} in place of '{shown(text)}': check the joint columns"
            yield replace(as_read, q=q, words=words)
    for marker, triple in enumerate([] if columns.table.spherical else columns.table.triples):
        for axis, text in enumerate(triple):
            for name in _similar([text], spare):
                points = with_coordinate(data, marker, axis, spare[name] / columns.table.per_metre)
                words = f"column '{shown(name)}' fits in place of '{shown(text)}': check the position columns"
                yield replace(as_read, points=points, words=words)


def _spare(columns: Columns, table: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The columns that were not read and that are not constant."""
    used = set(columns.names)
    return {name: values for name, values in table.items() if name not in used and float(values.std()) > 0}


def _similar(names: Sequence[str], spare: Mapping[str, Tensor]) -> list[str]:
    """The columns whose names are the most similar to some of these names."""
    short = [name for name in spare if len(name) <= LONGEST_NAME]
    closeness = {name: max(SequenceMatcher(None, wanted, name).ratio() for wanted in names) for name in short}
    return sorted(short, key=lambda name: -closeness[name])[:MOST_COLUMNS]


def _joint_values(columns: Columns, values: Tensor, *, slides: bool) -> Tensor:
    """Values of a joint in the units of the file -> rad or m."""
    if slides:
        return values / columns.table.joints_per_metre
    return values.deg2rad() if columns.table.angle == "deg" else values


def other_conventions(robot: Tree, data: Measurements, judge: Judge = registered) -> Iterator[Reading]:
    """Joint values, or commanded poses, in another convention."""
    (columns, table), as_read = numeric_table(data), Reading.of(robot, data)
    pose = None if columns is None else columns.joints
    if is_cartesian(robot):
        if columns is not None and isinstance(pose, PoseColumns):
            for machine, q, text in pose.reread(table, columns.table.joints_per_metre):
                yield replace(as_read, robot=machine, q=q, words=f"the commanded poses fit with {text}")
        return
    fitting = conventions_of(robot, data, "rad" if columns is None else columns.table.angle, judge)
    for best in fitting[:1]:
        yield replace(as_read, q=data.q @ best.matrix.mT + best.offset, words=_convention_words(fitting, columns))


EVERY_GROUP = (
    other_points,
    other_rotations,
    other_units,
    other_mimics,
    longer_chains,
    other_columns,
    other_conventions,
)


def conventions_of(robot: Tree, data: Measurements, angle: str, judge: Judge = registered) -> list[Convention]:
    """What joint values mean whose rows the robot does not explain, see :func:`conventions`."""
    as_read = Reading.of(robot, data)

    def left(q: Tensor) -> float:
        residual, size = judge(replace(as_read, q=q))
        return residual / max(size, 1e-12)

    return conventions(robot, data, left, degrees(1.0) if angle == "deg" else 1.0)


def _convention_words(fitting: Sequence[Convention], columns: Columns | None) -> str:
    """Advice on conventions of a table, or of joint values in SI, which rows do not tell apart."""
    if columns is None:
        names, units, what = fitting[0].robot.joint_names, ("deg", 1e3), ", in degrees and mm,"
    else:
        names, units, what = columns.joints.columns, (columns.table.angle, columns.table.joints_per_metre), ""
        read = JointExpressions.of(columns.joints.texts)
        fitting = [convention.of_columns(read.matrix, read.offset, *units) for convention in fitting]
    texts = [f"joints='{','.join(convention.texts(names, *units))}'" for convention in fitting]
    doubt = ", which these rows do not tell apart" if len(texts) > 1 else ""
    return f"the rows fit{what} with {' or '.join(texts)}{doubt}"


def warn_of_joints_below_tip(robot: Tree, data: Measurements) -> None:
    """Warn if a joint below the given tip moves the markers, judged by its column in the table.

    Columns of joints that do not move the markers, such as those of a gripper, explain nothing: no warning.
    """
    longer = [(registered(candidate)[0], candidate) for candidate in longer_chains(robot, data)]
    if not longer:
        return
    (best, reading), residual = min(longer, key=lambda entry: entry[0]), residual_of(robot, data)
    if best < gates.JOINT_BELOW_TIP * residual:
        got = f"a median residual that falls from {1e3 * residual:.3g} to {1e3 * best:.3g} mm with it"
        warn_user(sentence("a joint below the tip seems to move the markers", got=got, fix=reading.words))
