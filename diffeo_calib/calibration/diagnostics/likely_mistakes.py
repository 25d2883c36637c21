"""Other readings of a table: each usual mistake is undone and the robot registered again.

The reading with which the measurements fit far better, and as well as those of any robot, is reported. Mistakes in
tables and conventions are judged by the registration alone, whose few unknowns cannot compensate for them.

Row i measured at lag k belongs to the joints k lines below its own, for instance because one of two logs lost a line. A
lag fits where the prediction of those joints is near the measured points. Every row scores up to one, the better its
lag fits and the worse all others do; the run of rows with the largest sum is out of step if it exceeds the price of its
ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from difflib import SequenceMatcher
from itertools import combinations, permutations, product
from math import degrees, inf
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.conventions import Convention, conventions
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.identification.registration import (
    CONSISTENT,
    can_register,
    largest_distances,
    registered_geometry,
    spread,
)
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import LONGEST_NAME, DiffeoCalibError, MeasurementError, sentence, shown, warn_user
from diffeo_calib.common.quantiles import known, largest_known
from diffeo_calib.measurements.checks import ANGLE_MISTAKES
from diffeo_calib.measurements.csv.columns import Columns, JointExpressions, PoseColumns
from diffeo_calib.measurements.csv.tables import numeric_table, rereadings, with_coordinate
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import UNITS_PER_METRE
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree, robot_from_config
from diffeo_calib.robots.urdf import moving_joints_below, read_urdf
from diffeo_calib.sensors.coordinates import marker_tips

GROSS_MEDIANS, KEPT_ROWS, TRIMMINGS = 3.0, 0.75, 2
"""Distance, in medians, beyond which the rows that are the farthest off may spoil a registration: it is repeated with
the share of rows that are closest, at most so often."""
MOST_COLUMNS = 4  # most that are tried in the place of another one: every try is a registration


class Reading(NamedTuple):
    """Measurements as they might have been meant.

    Args:
        robot: the chain. q: (N, n) rad or m. points: (N, P, 3) m. on: tips of the markers; by default the first.
        words: what was changed. option: the option that reads the table so, where readings differ by it alone.
        partial: whether it explains a part of the measurements only, and counts if nothing else explains them.
    """

    robot: Tree
    q: Tensor
    points: Tensor
    on: tuple[str, ...] = ()
    words: str = ""
    option: str = ""
    partial: bool = False

    @classmethod
    def of(cls, robot: Tree, data: Measurements) -> Reading:
        """Measurements as they are."""
        return cls(robot, data.q, data.points, data.on or ())


Judge = Callable[[Reading], tuple[float, float]]
"""What the median residual of a reading is, m, and how far its points are spread, m."""
Group = Callable[[Reading, Measurements], Iterator[Reading]]
"""Other readings of measurements, from these as they were read."""


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
    robot: Tree, data: Measurements, typical: float, said: Mapping[str, str], otherwise: str = "", **search: Any
) -> None:
    """Refuse measurements that a mistake explains, see :func:`likely_mistake`; else warn and advise ``otherwise``.

    ``said``: what is wrong, as of :func:`sentence`.
    """
    if mistake := likely_mistake(robot, data, typical, **search):
        raise MeasurementError.of(**said, fix=mistake)
    if otherwise:
        warn_user(sentence(**said, fix=otherwise))


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
    as_read, good = Reading.of(robot, data), list[tuple[bool, float, float, Reading]]()
    now = typical / max(judge(as_read)[1], 1e-12)
    limit = min(gates.OTHER_READING_LEFT * now, gates.RIGHT_READING)
    decisive = gates.DECISIVE_READING * min(now, 1.0)
    for group in groups or EVERY_GROUP:
        for reading in group(as_read, data):
            residual, size = judge(reading)
            share = residual / max(size, 1e-12)
            if share < limit:
                good.append((reading.partial, share, residual, reading))
            if share < decisive and group is not other_rotations:
                break  # conventions may be hard to tell apart: all of them are tried
        if any(partial or share < decisive for partial, share, _, _ in good):
            break
    if not good:
        return ""
    _, least, best, reading = min(good, key=lambda entry: entry[:2])
    words = reading.words
    if reading.option:
        near = sorted((share, other.option) for _, share, _, other in good if other.option)
        options = [option for share, option in near if share < gates.READINGS_TOLD_APART * least]
        words = f"the rotations seem to be written with {' or '.join(options)}"
        words += ", which these rows do not tell apart" * (len(options) > 1)
    return f"{words} (the median residual falls from {1e3 * typical:.3g} to {1e3 * best:.3g} mm)"


# --- other readings ---------------------------------------------------------------------------------------------------


def other_points(as_read: Reading, data: Measurements) -> Iterator[Reading]:
    """Points in another unit, in a frame of the other hand, of exchanged tips; they or a joint of other rows."""
    robot, bodies = as_read.robot, data.points.unflatten(1, (data.origins.shape[1], -1))
    for factor, size in _units_of_length():
        points = (bodies + (factor - 1.0) * data.origins[:, :, None]).flatten(1, 2)  # a pose stays as large
        words = f"the positions seem to be {size}: check their unit (`length`)"
        words += ", and that of the commanded ones (`joint_length`)" * is_cartesian(robot)
        yield as_read._replace(points=points, words=words)
    ways = ("late", "after", slice(1, None), slice(-1)), ("early", "before", slice(-1), slice(1, None))
    for late, after, own_rows, others in ways:
        there = as_read._replace(q=data.q[others], points=data.points[own_rows])
        yield there._replace(words=f"the points seem to be one row too {late}: pair every configuration with its own")
        for joint, name in enumerate(robot.joint_names):
            q = data.q[own_rows].clone()
            q[:, joint] = data.q[others, joint]
            words = f"the values of {name} seem to be those of the row {after}: pair them with their own rows"
            yield there._replace(q=q, words=words)
    words = "the frame of the measurements seems to be left-handed: exchange two position columns, or change a sign"
    for mirrored in data.bodies.mirrored(data):
        yield as_read._replace(points=mirrored, words=words)
    for one, other in combinations(robot.tips, 2):
        exchanged = {one: other, other: one}
        words = f"the markers on '{one}' and '{other}' seem to be exchanged: check which columns belong to which tip"
        yield as_read._replace(words=words, on=tuple(exchanged.get(tip, tip) for tip in as_read.on))


def other_rotations(as_read: Reading, data: Measurements) -> Iterator[Reading]:
    """Measured poses whose rotations are read in other ways, or whose poses are inverted."""
    return (as_read._replace(**changes) for changes in rereadings(data))


def other_units(as_read: Reading, _: Measurements, *, slides: bool = True) -> Iterator[Reading]:
    """Joint values in other units of angles, and of lengths if ``slides``."""
    periodic, q = as_read.robot.periodic, as_read.q
    turning = torch.tensor(periodic, dtype=torch.bool, device=q.device)
    for factor, words in ANGLE_MISTAKES if any(periodic) else ():
        yield as_read._replace(q=torch.where(turning, factor * q, q), words=words)
    for factor, size in _units_of_length() if slides and not all(periodic) else ():
        words = f"the values of prismatic joints seem to be {size}: check their unit (`joint_length`)"
        yield as_read._replace(q=torch.where(turning, q, factor * q), words=words)


def _units_of_length() -> Iterator[tuple[float, str]]:
    """Factors that turn one unit of length into another, and how large values then are."""
    for factor in sorted({unit / other for unit, other in permutations(UNITS_PER_METRE.values(), 2)}):
        yield factor, f"{max(factor, 1 / factor):.4g} times too {'small' if factor > 1.0 else 'large'}"


def other_mimics(as_read: Reading, _: Measurements) -> Iterator[Reading]:
    """Joints that follow others the other way round, twice or half as far, or not at all."""
    robot, config = as_read.robot, as_read.robot.to_config()
    for place, joint in enumerate(robot.joints):
        for factor in (-1.0, 0.5, 2.0, 0.0) if joint.mimic else ():
            mimic = {name: factor * value for name, value in (joint.mimic or {}).items()}
            joints = [*robot.joints[:place], replace(joint, mimic=mimic), *robot.joints[place + 1 :]]
            other = robot_from_config(config | {"joints": [each.to_config() for each in joints]}, robot.source)
            words = f"joint '{joint.name}' seems to follow with {factor:g} times its multiplier"
            yield as_read._replace(robot=other, words=f"{words}: check it in the robot's description")


def longer_chains(as_read: Reading, data: Measurements) -> Iterator[Reading]:
    """Chains with joints below the given tip, for which the table has columns whose values vary."""
    robot, (columns, table) = as_read.robot, numeric_table(data)
    if columns is None or robot.source is None or len(robot.tips) > 1:
        return
    spare, content = _spare(columns, table), robot.source.encode("utf-8", "surrogateescape")
    for joint, child in moving_joints_below(content, robot.tips):
        try:
            longer = read_urdf(content, robot.base, child, Path("URDF"))
        except DiffeoCalibError:
            continue  # a joint that cannot be part of a chain
        added = [name for name in longer.joint_names if name not in robot.joint_names]
        if longer.joint_names[: robot.n] != robot.joint_names or not {joint, *added} <= {*spare}:
            continue
        pairs = zip(added, longer.periodic[robot.n :], strict=True)
        more = torch.stack([_joint_values(columns, spare[name], turns) for name, turns in pairs], 1).to(data.q.device)
        if bool((more.amax(0) - more.amin(0) > gates.FIXED_RANGE).all()):
            what = f"the table has a column for joint '{joint}', which is below the tip '{robot.tip}'"
            words = f"{what}: choose '{child}' or a link below it as the tip"
            yield Reading(longer, torch.cat([data.q, more], dim=1), data.points, words=words)


def other_columns(as_read: Reading, data: Measurements) -> Iterator[Reading]:
    """One column of the joints or of the position replaced by one of similar name that was not read."""
    columns, table = numeric_table(data)
    if columns is None:
        return
    spare, joints = _spare(columns, table), as_read.robot.joint_names
    for k, (joint, text) in enumerate(zip(joints, columns.joints.texts, strict=True)):
        for name in _similar([joint, text], spare):
            q = data.q.clone()
            q[:, k] = _joint_values(columns, spare[name], as_read.robot.periodic[k]).to(q.device)
            words = f"column '{shown(name)}' fits as {joint} in place of '{shown(text)}': check the joint columns"
            yield as_read._replace(q=q, words=words)
    for marker, triple in enumerate([] if columns.table.spherical else columns.table.triples):
        for axis, text in enumerate(triple):
            for name in _similar([text], spare):
                points = with_coordinate(data, marker, axis, spare[name] / columns.table.per_metre)
                words = f"column '{shown(name)}' fits in place of '{shown(text)}': check the position columns"
                yield as_read._replace(points=points, words=words)


def _spare(columns: Columns, table: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The columns that were not read and that are not constant."""
    used = set(columns.names)
    return {name: values for name, values in table.items() if name not in used and float(values.std()) > 0}


def _similar(names: Sequence[str], spare: Mapping[str, Tensor]) -> list[str]:
    """The columns whose names are the most similar to some of these names."""
    short = [name for name in spare if len(name) <= LONGEST_NAME]
    closeness = {name: max(SequenceMatcher(None, wanted, name).ratio() for wanted in names) for name in short}
    return sorted(short, key=lambda name: -closeness[name])[:MOST_COLUMNS]


def _joint_values(columns: Columns, values: Tensor, turns: bool) -> Tensor:
    """Values of a joint in the units of the file -> rad or m."""
    if not turns:
        return values / columns.table.joints_per_metre
    return values.deg2rad() if columns.table.angle == "deg" else values


def other_conventions(as_read: Reading, data: Measurements, judge: Judge = registered) -> Iterator[Reading]:
    """Joint values, or commanded poses, in another convention."""
    columns, table = numeric_table(data)
    if is_cartesian(as_read.robot):
        if columns is not None and isinstance(columns.joints, PoseColumns):
            for machine, q, text in columns.joints.reread(table, columns.table.joints_per_metre):
                yield as_read._replace(robot=machine, q=q, words=f"the commanded poses fit with {text}")
        return
    fitting = conventions_of(as_read.robot, data, "rad" if columns is None else columns.table.angle, judge)
    for best in fitting[:1]:
        yield as_read._replace(q=data.q @ best.matrix.mT + best.offset, words=_convention_words(fitting, columns))


EVERY_GROUP = other_points, other_rotations, other_units, other_mimics, longer_chains, other_columns, other_conventions


def conventions_of(robot: Tree, data: Measurements, angle: str, judge: Judge = registered) -> list[Convention]:
    """What joint values mean whose rows the robot does not explain, see :func:`conventions`."""

    def left(q: Tensor) -> float:
        residual, size = judge(Reading.of(robot, data)._replace(q=q))
        return residual / max(size, 1e-12)

    return conventions(robot, data, left, degrees(1.0) if angle == "deg" else 1.0)


def _convention_words(fitting: Sequence[Convention], columns: Columns | None) -> str:
    """Advice on conventions of a table, or of joint values in SI, which rows do not tell apart."""
    names, units, what = fitting[0].robot.joint_names, ("deg", 1e3), ", in degrees and mm,"
    if columns is not None:
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
    as_read = Reading.of(robot, data)
    longer = [(registered(reading)[0], reading.words) for reading in longer_chains(as_read, data)]
    best, words = min(longer, default=(inf, ""))
    if longer and best < gates.JOINT_BELOW_TIP * (residual := registered(as_read)[0]):
        got = f"a median residual that falls from {1e3 * residual:.3g} to {1e3 * best:.3g} mm with it"
        warn_user(sentence("a joint below the tip seems to move the markers", got=got, fix=words))


# --- rows out of step with their joints -------------------------------------------------------------------------------


class Step(NamedTuple):
    """Consecutive rows whose measured values belong to the joints of other lines.

    Args:
        first, last: lines of the first and the last row. lag: number of lines to their joints, downwards.
        to_the_end: whether the table ends with these rows. rows: how many are known to fit there.
    """

    first: int
    last: int
    lag: int
    to_the_end: bool
    rows: int

    def sentence(self, before: str = "") -> str:
        """What is wrong, after some words, and what to do: ``from line 32 on the measured values belong to ...``."""
        where = f"from line {self.first} on" if self.to_the_end else f"in lines {self.first} to {self.last}"
        count = f"{abs(self.lag)} line{'s' * (abs(self.lag) > 1)} {'above' if self.lag < 0 else 'below'}"
        return sentence(
            f"{before}{where} the measured values belong to the joints {count}",
            got=f"{self.rows} rows that fit there, and not at their own joints",
            fix="pair every configuration with its own measured values: was a line lost or doubled there?",
        )


def out_of_step(predicted: Tensor, measured: Tensor, line_numbers: Tensor, typical: float) -> list[Step]:
    """Runs of rows whose measured values belong to the joints of other lines, in the order of their lines.

    Args:
        predicted: (N, P, 3) markers at the joints of every row, m. measured: (N, P, 3) m, NaN where hidden.
        line_numbers: (N,) distinct numbers; rows may be missing.
        typical: typical distance of rows that are right, m.
    """
    order = line_numbers.argsort()
    lines, predicted, measured = line_numbers[order], predicted[order], measured[order]
    distances = measured.new_full((2 * gates.LARGEST_LAG + 1, len(lines)), torch.nan)  # to the joints at every lag
    for number, each in enumerate(distances):
        rows, others = _paired(lines, number - gates.LARGEST_LAG)
        each[rows] = largest_known((predicted[others] - measured[rows]).norm(dim=-1))
    costs = (distances / (gates.LAG_NEAR * typical)).square().clamp(max=1.0).nan_to_num(1.0)
    paired, steps = distances[gates.LARGEST_LAG], list[Step]()
    least, second = costs.topk(2, dim=0, largest=False).values
    scores = torch.where(costs == least, second, least) - costs - gates.LAG_MISFIT * (costs == 1.0) * ~distances.isnan()
    scores[gates.LARGEST_LAG] = -1.0
    while True:
        runs = [(*best_run(each), number) for number, each in enumerate(scores)]
        ends = [gates.LAG_CHANGE_COST * ((start > 0) + (end < len(lines))) for _, start, end, _ in runs]
        gain, start, end, number = max((run[0] - end, *run[1:]) for run, end in zip(runs, ends, strict=True))
        if gain <= 0.0:
            return sorted(steps)
        there, scores[:, start:end] = distances[number, start:end], -float(len(lines))
        fits = there <= gates.LAG_NEAR * typical
        moved = int((fits & (paired[start:end] > gates.LAG_GROSS * typical)).sum())
        if moved >= gates.LAG_ROWS and int(fits.sum()) >= gates.LAG_SHARE * int((~there.isnan()).sum()):
            ends_of_run, lag = (int(lines[start]), int(lines[end - 1])), number - gates.LARGEST_LAG
            steps.append(Step(*ends_of_run, lag, end == len(lines), moved))


def best_run(scores: Tensor) -> tuple[float, int, int]:
    """Largest sum of scores (N,) that follow one another, the first and last + 1 of these; zeros at the ends count."""
    sums = torch.cat([scores.new_zeros(1), scores.cumsum(0)])
    rises = sums - sums.cummin(0).values
    end = int((rises == rises.max()).nonzero()[-1])
    return float(rises[end]), int(sums[: end + 1].argmin()), end


def _paired(line_numbers: Tensor, lag: int) -> tuple[Tensor, Tensor]:
    """Rows of which the row ``lag`` lines below is in the table too, and the numbers of these, by ascending lines."""
    wanted = line_numbers + lag
    at = torch.searchsorted(line_numbers, wanted).clamp(max=len(line_numbers) - 1)
    rows = (line_numbers[at] == wanted).nonzero()[:, 0]
    return rows, at[rows]


def check_row_order(robot: Tree, data: Measurements, registration: Identification) -> None:
    """Refuse measured values that are out of step with the joints from some line on.

    A table that is out of step from its first line to its last is left to :func:`likely_mistake`. Where the whole table
    fits nowhere, consecutive rows that are consistent by themselves say where the joints of the others are.

    Raises:
        MeasurementError: with the line, and where the right joints are.
    """
    away, geometry = largest_distances(registration.geometry, data), registration.geometry
    typical = float(away.median())
    if typical > CONSISTENT * spread(data.points):
        geometry, typical = next(_consistent(robot, data), (geometry, 0.0))
    elif int((away > gates.LAG_GROSS * typical).sum()) < gates.LAG_ROWS:
        return
    steps = out_of_step(geometry.points(data.q), data.points, data.line_numbers, typical) if typical > 0.0 else []
    near = largest_distances(geometry, data) <= gates.LAG_GROSS * typical
    if steps and int(near.sum()) >= gates.WINDOW_ROWS and can_register(data.points[near]):  # all that fit say more
        geometry = registered_geometry(robot, data.q[near], data.points[near], marker_tips(robot, data))
        typical = float(largest_distances(geometry, data)[near].median())
        steps = out_of_step(geometry.points(data.q), data.points, data.line_numbers, typical)
    if steps and not (steps[0].to_the_end and steps[0].first == int(data.line_numbers.min())):
        raise MeasurementError(steps[0].sentence("the measurements do not fit this robot: "))


def _consistent(robot: Tree, data: Measurements) -> Iterator[tuple[Geometry, float]]:
    """Registrations of consecutive rows at some lag that are consistent, and their median distances, m."""
    limit, order = CONSISTENT * spread(data.points), data.line_numbers.argsort().to(data.q.device)
    windows = [rows for parts in gates.WINDOW_PARTS for rows in order.tensor_split(parts)]
    for lag, rows in product(gates.WINDOW_LAGS, windows):
        here, other = _paired(data.line_numbers[rows], lag)
        q, points = data.q[rows][other], data.points[rows][here]
        if len(here) >= gates.WINDOW_ROWS and can_register(points):
            geometry = registered_geometry(robot, q, points, marker_tips(robot, data))
            typical = float(largest_known((geometry.points(q) - points).norm(dim=-1)).median())
            if typical <= limit:
                yield geometry, typical
