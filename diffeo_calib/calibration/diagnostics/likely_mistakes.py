"""Likely mistakes in measurements that do not fit a robot: each usual one is undone and the robot registered again.

The mistake without which the measurements fit far better, and as well as those of any robot, is reported. All of them
concern tables and conventions, and are judged by the registration alone, whose few unknowns cannot compensate for
them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import SequenceMatcher
from itertools import combinations, permutations
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.conventions import Convention, Seen, conventions, frame_projector
from diffeo_calib.calibration.identification.registration import can_register, register, spread
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
from diffeo_calib.measurements.checks import ANGLE_MISTAKES, angle_mistake
from diffeo_calib.measurements.csv import rotations
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.joints import JointExpressions, PoseColumns
from diffeo_calib.measurements.csv.tables import TableOrigin
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import UNITS_PER_METRE
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import moving_joints_below, read_urdf

UNMOVED_JOINT_RANGE = 1e-3
"""Range of a joint, rad or m, below which it never moved."""
GROSS_MEDIANS, KEPT_ROWS, TRIMMINGS = 3.0, 0.75, 2
"""Distance, in medians, beyond which the rows that are the farthest off may spoil a registration: it is repeated with
the share of rows that are closest, at most so often."""
MOST_COLUMNS = 4
"""Most columns that are tried in the place of another one: every try is a registration."""


@dataclass(frozen=True)
class Reading:
    """Measurements as they might have been meant.

    Args:
        robot: the chain. q: (N, n) rad or m. points: (N, P, 3) m.
        words: what was changed.
        option: the option that reads the table so, where readings differ by one option alone; else empty.
        partial: whether it explains a part of the measurements only, and is used if nothing else explains them.
        on: tips of the markers; the robot's first tip by default.
    """

    robot: Tree
    q: Tensor
    points: Tensor
    words: str = ""
    option: str = ""
    partial: bool = False
    on: tuple[str, ...] = ()

    @classmethod
    def of(cls, robot: Tree, data: Measurements) -> Reading:
        """Measurements as they are."""
        return cls(robot, data.q, data.points, on=data.on or ())


def other_rotations(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Measured poses whose rotations are read in other ways, or whose poses are inverted."""
    for one in rotations.other_rotations(data):
        yield Reading(robot, data.q, *one[:3], one.partial, one.on)


def other_columns(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """One column of the joints or of the position replaced by one of similar name that was not read."""
    columns, table = rotations.numeric_table(data)
    if columns is None:
        return
    spare, as_read = _spare(columns, table), Reading.of(robot, data)
    for k, (joint, own) in enumerate(zip(robot.joint_names, columns.joints.texts, strict=True)):
        for name in _similar([joint, own], spare):
            q = data.q.clone()
            q[:, k] = _joint_values(columns, spare[name], slides=not robot.periodic[k]).to(q.device)
            words = f"column '{shown(name)}' fits as {joint} in place of '{shown(own)}': check the joint columns"
            yield replace(as_read, q=q, words=words)
    for marker, triple in enumerate(columns.triples):
        for axis, own in enumerate(triple):
            for name in _similar([own], spare):
                points = rotations.with_coordinate(data, marker, axis, spare[name] / columns.table.per_metre)
                words = f"column '{shown(name)}' fits in place of '{shown(own)}': check the position columns"
                yield replace(as_read, points=points, words=words)


def longer_chains(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """The same with joints below the given tip, for which the table has columns whose values vary."""
    columns, table = rotations.numeric_table(data)
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
        values = [
            _joint_values(columns, spare[name], slides=not longer.periodic[robot.n + k]) for k, name in enumerate(added)
        ]
        q = torch.cat([data.q, torch.stack(values, dim=1).to(data.q.device)], dim=1)
        if not bool((q[:, robot.n :].amax(0) - q[:, robot.n :].amin(0) > UNMOVED_JOINT_RANGE).all()):
            continue
        what = f"the table has a column for joint '{joint}', which is below the tip '{robot.tip}'"
        yield Reading(longer, q, data.points, f"{what}: choose '{child}' or a link below it as the tip")


def _spare(columns: Columns, table: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The columns that were not read and that are not constant."""
    used = set(columns.names)
    return {name: values for name, values in table.items() if name not in used and float(values.std()) > 0}


def _similar(names: Sequence[str], spare: Mapping[str, Tensor]) -> list[str]:
    """The columns whose names are the most similar to some of these names."""
    short = [name for name in spare if len(name) <= LONGEST_NAME]
    closeness = {name: max(SequenceMatcher(None, own, name).ratio() for own in names) for name in short}
    return sorted(short, key=lambda name: -closeness[name])[:MOST_COLUMNS]


def _joint_values(columns: Columns, values: Tensor, *, slides: bool) -> Tensor:
    """Values of a joint in the units of the file -> rad or m."""
    if slides:
        return values / columns.table.joints_per_metre
    return values.deg2rad() if columns.table.angle == "deg" else values


NO_MISTAKE_FOUND = (
    "check the angle unit, the order of the joints, the tip link or DH convention, "
    "and that rows pair joints with their own points"
)


def likely_mistake(robot: Tree, data: Measurements, typical: float) -> str:
    """Advice on measurements that no registration explains.

    Args:
        robot: n joints. data: N rows. typical: median residual of the measurements as they are, m.

    Returns:
        a phrase: the mistake that explains them; empty if there is none.
    """
    good: list[tuple[float, Reading]] = []
    for group in (_other_points, other_rotations, _other_units, longer_chains, other_columns, _conventions):
        for reading in group(robot, data):
            residual = _residual(reading)
            if residual < min(gates.OTHER_READING_LEFT * typical, gates.RIGHT_READING * spread(reading.points)):
                good.append((residual, reading))
            if residual < gates.DECISIVE_READING * typical and group is not other_rotations:
                break  # conventions may be hard to tell apart: all of them are tried
        if any(residual < gates.DECISIVE_READING * typical or reading.partial for residual, reading in good):
            break
    return _advice(good, typical) if good else ""


def refuse_or_warn(what: str, *, expected: str, got: str, mistake: str, otherwise: str | None = None) -> None:
    """Refuse measurements that a mistake explains; else warn of them and advise ``otherwise``, if that is given."""
    if mistake:
        raise MeasurementError.of(what, expected=expected, got=got, fix=mistake)
    if otherwise is not None:
        warn_user(sentence(what, expected=expected, got=got, fix=otherwise))


def residual_of(robot: Tree, data: Measurements) -> float:
    """Median residual of a registration of the measurements as they are, m; infinite if the rows are too few."""
    return _residual(Reading.of(robot, data))


def marker_column(geometry: Geometry, data: Measurements) -> tuple[str, str] | None:
    """A column that was not read, and why it names which of several markers a row shows; None without one.

    Rows of another marker than that of the geometry are off by a constant in the frame of its tip.
    """
    if data.markers > 1 or not isinstance(data.origin, TableOrigin) or bool(data.points.isnan().any()):
        return None
    error, columns = (data.points - geometry.points(data.q))[:, 0].cpu(), data.origin.columns
    in_tip = (geometry.marker_poses(data.q)[:, 0, :3, :3].cpu().mT @ error[:, :, None])[:, :, 0]
    for column, texts in data.origin.texts(data.line_numbers).items():
        names = list(dict.fromkeys(texts))
        if not 1 < len(names) <= gates.MOST_MARKERS or column in {*columns.names, columns.table.session}:
            continue
        rows = torch.tensor([[text == name for name in names] for text in texts], dtype=error.dtype, device=HOST)
        if float(rows.sum(0).min()) < gates.MARKER_ROWS or "" in names:
            continue
        means = [rows.mT @ own / rows.sum(0)[:, None] for own in (in_tip, error)]
        left = [float((own - rows @ mean).norm()) for own, mean in zip((in_tip, error), means, strict=True)]
        alone, freedom = float(in_tip.norm()), ((len(texts) - 1) / (len(texts) - len(names))) ** 0.5
        if left[0] * freedom < gates.MARKERS_LEFT * min(alone, left[1] * freedom):
            jump, per_row = 1e3 * float(torch.cdist(means[0], means[0]).max()), 1e3 / len(texts) ** 0.5
            words = f"{len(names)} values between which the points jump by {jump:.3g} mm on the tool (RMS error "
            return column, f"{words}{alone * per_row:.3g} mm, and {left[0] * per_row:.3g} mm without these jumps)"
    return None


def warn_of_joints_below_tip(robot: Tree, data: Measurements) -> None:
    """Warn if a joint below the given tip moves the markers, judged by its column in the table.

    Columns of joints that do not move the markers, such as those of a gripper, explain nothing: no warning.
    """
    longer = [(_residual(one), one) for one in longer_chains(robot, data)]
    if not longer:
        return
    (best, reading), own = min(longer, key=lambda entry: entry[0]), residual_of(robot, data)
    if best < gates.JOINT_BELOW_TIP * own:
        got = f"a median residual that falls from {1e3 * own:.3g} to {1e3 * best:.3g} mm with it"
        warn_user(sentence("a joint below the tip seems to move the markers", got=got, fix=reading.words))


def _advice(good: list[tuple[float, Reading]], typical: float) -> str:
    """The best reading in words, with those that these rows do not tell apart from it."""
    whole = [entry for entry in good if not entry[1].partial] or good
    best, reading = min(whole, key=lambda entry: entry[0])
    words, doubt = reading.words, ""
    if reading.option:
        near = sorted(entry for entry in ((r, one.option) for r, one in whole) if entry[1])
        options = [option for residual, option in near if residual < gates.READINGS_TOLD_APART * best]
        words = f"the rotations seem to be written with {' or '.join(options)}"
        doubt = ", which these rows do not tell apart" if len(options) > 1 else ""
    return f"{words}{doubt} (the median residual falls from {1e3 * typical:.3g} to {1e3 * best:.3g} mm)"


def _residual(reading: Reading) -> float:
    """Median distance after registration of a random subset of the rows, m; infinite if that cannot be done.

    Gross rows are left out of the registration, a few rounds long those that are the farthest off (P. Rousseeuw,
    K. Van Driessen, "Computing LTS regression for large data sets", 2006).
    """
    q, points = reading.q, reading.points
    rows = torch.randperm(len(q), generator=seeded(0), device=HOST)[: gates.REGISTERED_ROWS]
    if len(known(points)) < 2 * (6 + 3 * points.shape[1]) or not can_register(points[rows]):
        return torch.inf
    q, points = q[rows], points[rows]
    typical, kept = torch.inf, torch.ones(len(q), dtype=torch.bool, device=q.device)
    for _ in range(1 + TRIMMINGS):
        try:
            geometry = register(reading.robot, q[kept], points[kept], reading.on).geometry
        except DiffeoCalibError:
            break
        off = (geometry.points(q) - points).norm(dim=-1)
        typical, worst = min(typical, float(off.nanmedian())), off.nan_to_num(0.0).amax(1)
        if float(worst.max()) <= GROSS_MEDIANS * typical:
            break
        kept = worst <= worst.quantile(KEPT_ROWS)
    return typical


def _other_points(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Points in another unit, of the row before or after, in a frame of the other hand, or of exchanged tips."""
    own, bodies = Reading.of(robot, data), data.points.unflatten(1, (data.origins.shape[1], -1))
    for factor in sorted({one / other for one, other in permutations(UNITS_PER_METRE.values(), 2)}):
        times, size = (factor, "small") if factor > 1.0 else (1 / factor, "large")
        points = (bodies + (factor - 1.0) * data.origins[:, :, None]).flatten(1, 2)  # a pose stays as large
        words = f"the positions seem to be {times:.4g} times too {size}: check their unit (`length`)"
        yield replace(own, points=points, words=words)
    words = "the points seem to be one row too {}: pair every configuration with its own"
    yield replace(own, q=data.q[:-1], points=data.points[1:], words=words.format("late"))
    yield replace(own, q=data.q[1:], points=data.points[:-1], words=words.format("early"))
    words = "the frame of the measurements seems to be left-handed: exchange two position columns, or change a sign"
    for mirrored in data.bodies.mirrored(data):
        yield replace(own, points=mirrored, words=words)
    for one, other in combinations(robot.tips, 2):
        exchanged = {one: other, other: one}
        words = f"the markers on '{one}' and '{other}' seem to be exchanged: check which columns belong to which tip"
        yield replace(own, words=words, on=tuple(exchanged.get(tip, tip) for tip in own.on))


def _other_units(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Joint values in other units."""
    own = Reading.of(robot, data)
    return (replace(own, q=q, words=words) for q, words in corrections_of_units(robot, data.q))


def corrections_of_angles(robot: Tree, q: Tensor) -> Iterator[tuple[Tensor, str]]:
    """Joint values (N, n) in another unit of angles, with the mistake that it undoes."""
    turning = torch.tensor(robot.periodic, dtype=torch.bool, device=q.device)
    for factor, words in ANGLE_MISTAKES if any(robot.periodic) else ():
        yield torch.where(turning, factor * q, q), angle_mistake(words)


def corrections_of_units(robot: Tree, q: Tensor) -> Iterator[tuple[Tensor, str]]:
    """Joint values (N, n) in other units of angles and lengths, with the mistake that each undoes."""
    turning = torch.tensor(robot.periodic, dtype=torch.bool, device=q.device)
    yield from corrections_of_angles(robot, q)
    for factor, words in ((1e-3, "large"), (1e3, "small")) if not all(robot.periodic) else ():
        text = f"the values of prismatic joints seem to be 1000 times too {words}: check their unit (`joint_length`)"
        yield torch.where(turning, q, factor * q), text


def convention_words(found: Sequence[Convention], columns: Columns | None) -> str:
    """Advice on conventions of a table, or of joint values in SI, which rows do not tell apart."""
    if columns is None:
        names, units, what = found[0].robot.joint_names, ("deg", 1e3), ", in degrees and mm,"
    else:
        names, units, what = columns.joints.columns, (columns.table.angle, columns.table.joints_per_metre), ""
        read = JointExpressions.of(columns.joints.texts)
        found = [own.of_columns(read.matrix, read.offset, *units) for own in found]
    texts = [f"joints='{','.join(own.texts(names, *units))}'" for own in found]
    doubt = ", which these rows do not tell apart" if len(texts) > 1 else ""
    return f"the rows fit{what} with {' or '.join(texts)}{doubt}"


def _conventions(robot: Tree, data: Measurements) -> Iterator[Reading]:
    """Joint values, or commanded poses, in another convention."""
    (columns, table), own = rotations.numeric_table(data), Reading.of(robot, data)
    if is_cartesian(robot):
        pose = None if columns is None else columns.joints
        if columns is None or not isinstance(pose, PoseColumns):
            return
        for machine, q, text in pose.reread(table, columns.table.joints_per_metre):
            yield replace(own, robot=machine, q=q, words=f"the commanded poses fit with {text}")
        return
    found = conventions_of(robot, data, "rad" if columns is None else columns.table.angle)
    for one in found[:1]:
        q = data.q @ one.matrix.mT + one.offset
        yield replace(own, q=q, words=convention_words(found, columns))


def conventions_of(robot: Tree, data: Measurements, angle: str) -> list[Convention]:
    """What joint values mean whose rows the robot does not explain, see :func:`conventions`."""
    marker = int(data.visible.sum(0).argmax())
    rows = data.visible[:, marker].nonzero()[:, 0]
    own, places = Reading.of(robot, data), data.points[rows, marker]
    tip = robot.tips.index(data.on[marker]) if data.on else 0

    def judge(q: Tensor) -> float:
        return _residual(replace(own, q=q)) / spread(data.points)

    def projector(chosen: Tensor) -> Tensor:
        return frame_projector(places[chosen])

    return conventions(robot, data.q, Seen(tip, rows, projector, angle, judge))
