"""`diffeo-calib init`: propose the options of `fit` as a campaign file, with reasons, for a table and a robot.

Or for a table with poses or places of a machine in place of joint values.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product, takewhile
from math import ceil, inf, nan
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.identification.registration import spread
from diffeo_calib.cli import guesses, proposals
from diffeo_calib.cli.column_names import WORDS, Column, column, whole
from diffeo_calib.cli.console import say
from diffeo_calib.cli.declarations import InitOptions
from diffeo_calib.cli.models import is_urdf, load_robot
from diffeo_calib.cli.options import Links, Rows, Units
from diffeo_calib.cli.tables import table_format
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import DiffeoCalibError, InputError, few
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.checks import quiet
from diffeo_calib.measurements.csv.cells import numbers_in
from diffeo_calib.measurements.csv.columns import PoseColumns
from diffeo_calib.measurements.csv.files import read_poses
from diffeo_calib.measurements.poses import readings_of
from diffeo_calib.measurements.table_format import UNITS_PER_METRE, ZERO
from diffeo_calib.robots.cartesian import cartesian
from diffeo_calib.robots.dh_file import DHFile
from diffeo_calib.robots.urdf import chains_in
from diffeo_calib.robots.urdf_elements import JointElement
from diffeo_calib.sensors.kinds import measured_positions

NUMBERED = "0123456", "1234567", "012345", "123456"
"""Poses of the tool as a series: a place, then a quaternion, a rotation vector or angles."""
SURELY_METRES, LARGEST_IN_METRES = 2.0, 20.0
"""Numbers below the first are metres, above the second millimetres; between them a machine may be small or large."""
UNUSUAL_LENGTHS = ("", ""), ("cm", ""), ("inch", ""), ("", "cm"), ("", "inch")
"""Units of the machine's places and of those measured, tried until one explains the rows; empty: by their size."""
MOST_ROWS, STEPS = 40, (1, 3)  # rows whose motions are compared, and how many rows each of these spans
MOST_WAYS, FEW_WAYS = 60, 6
"""Ways to read the rows that are tried with a registration; if half of so many are right, no rotation is sure."""
TURNED = "robot_pose", "angle", "convention", "rotation_angle", "camera_on_tool"
GOOD_MOTIONS = 0.75  # share of the motions that are compared: those that agree best
ALIKE, EXACT = 6.0, 1e-6
"""Ways that leave more than so many times what the best one leaves are wrong; and shares that are as good as none."""


class Reading(NamedTuple):
    """One way to read the machine's rotation, or the measured one."""

    convention: str = ""
    angle: str = "rad"


def poses_in(sheet: guesses.Sheet) -> list[guesses.Body]:
    """Places with their rotations, and poses as 6, 7, 12 or 16 numbers, in the order of columns."""
    bodies = guesses.bodies_in(sheet.numbers)
    used = {name for body in bodies for name in (*body.place, *body.turn)}
    others = [name for name in sheet.numbers if name not in used]
    bodies += guesses.matrices_in(sheet, others)
    flat = [xy for xy in whole(others, "xy") if xy.wished and not xy.says("rate", "deviation")]
    bodies += [guesses.Body([*xy.names.values()], []) for xy in flat]
    for labels in NUMBERED:
        taken = {name for body in bodies for name in (*body.place, *body.turn)}
        for group in whole([name for name in others if name not in taken], labels):
            names = list(group.names.values())
            if group.says("tool") and not group.says("rate", "deviation"):
                bodies.append(guesses.Body(names[:3], names[3:]))
    return sorted(bodies, key=lambda body: sheet.header.index(body.place[0]))


def machine_of(bodies: Sequence[guesses.Body]) -> guesses.Body:
    """Columns of the machine: by words of the names, reported ones before wished ones; else the first."""
    seen = WORDS["seen"] - {"target"}  # beside it, what is only said to be measured is the machine's
    others = any(body.words & seen for body in bodies)

    def rank(body: guesses.Body) -> int:
        if others and body.words & WORDS["measured"] and not body.words & seen:
            return 3
        if body.words & WORDS["machine"]:
            return 2 + bool(body.words & WORDS["measured"])
        return bool(body.words & (WORDS["wished"] - {"target"})) - len(body.words & (WORDS["seen"] | WORDS["measured"]))

    return max(bodies, key=rank)


def commanded(sheet: guesses.Sheet) -> proposals.Source:
    """The table as poses of a machine; InputError without poses, places that were measured, or a clear way to read."""
    bodies = poses_in(sheet)
    if not bodies:
        expected = "a ROBOT whose joints the table has columns of, or columns of the poses of a machine"
        what, got = f"'{sheet.path}' without a robot's description", few(sheet.header, 20)
        raise InputError.of(what, expected=expected, got=got)
    machine = machine_of(bodies)
    used = [*machine.place, *machine.turn]
    others = tuple(name for name in sheet.numbers if name not in used)
    rows = guesses.rows_in(replace(sheet, numbers=others), used)
    if rows.bodies and rows.bodies[0].turn:  # poses of one frame
        body, *others = rows.bodies
        rows.left.extend(f"{few(extra.place)}: beside the pose of {few(body.place)}; not used" for extra in others)
        rows = rows._replace(bodies=[body], options={**rows.options, "position": [body.written()]})
    tried = list[list[proposals.Source]]()
    for lengths in UNUSUAL_LENGTHS:
        tried.append(proposals.ranked(_ways(sheet, machine, rows, lengths=lengths)))
        if tried[-1] and tried[-1][0].left <= proposals.LARGEST_RESIDUAL:
            break
    ways = min(tried, key=lambda ranking: ranking[0].left if ranking else inf)
    if ways and ways[0].left == inf:
        ways[0].share()  # says why
    if not ways or ways[0].left > proposals.LARGEST_RESIDUAL:
        got = f"{proposals.percent(ways[0].left)} of what the rows vary unexplained" if ways else "no way to read them"
        what = f"poses of the machine in {few(used, 16)}"
        fix = "check that the rows belong together, or write the campaign file yourself; for joints name the robot"
        if not machine.turn:  # by two axes, in columns of any names
            fix += "; if the machine turns too, a function makes its poses: "
            fix += f"fit --robot-pose {','.join(used)},...=FILE.py:NAME"
        raise InputError.of(what, expected="a convention and units that explain the rows", got=got, fix=fix)
    best, *_ = alike = [way for way in ways if _as_good(way, ways[0])]
    why = proposals.reason(best, *(way for way in ways if way not in alike))
    by_size, whose = "the size of the numbers", _lengths(machine.place, _numbers(sheet, machine.place))
    why = {"robot_pose": f"{why}; by their names, in place of joint values", "angle": why, "convention": why}
    why |= {"length": by_size, "joint_length": by_size}
    why |= {"rotation": "beside the columns of its place", "camera_on_tool": "what stands is seen from the flange"}
    best = best.into(why)
    if len(whose) > 1 and best.options.joint_length is None:
        more = f"{by_size}; which machine it is, they do not tell"
        best = best.asking("length", dict.fromkeys(whose, more))
    unsure = 2 * len(alike) >= len(ways) >= MOST_WAYS
    for name in TURNED:
        values = dict.fromkeys(getattr(way.options, name) for way in alike)
        if len(values) > 1 or unsure:
            best = best.asking(name, {value: best.why[name] for value in values if value})
    return best


def _as_good(way: proposals.Source, best: proposals.Source) -> bool:
    """Whether the rows do not tell a way from the best one: who saw whom changes what a residual is a share of."""

    def metres(source: proposals.Source) -> float:
        positions = measured_positions(source.data)
        return source.left * (1.0 if positions is None else spread(positions.largest_session().points))

    factor, explains = gates.READINGS_TOLD_APART, way.left <= proposals.LARGEST_RESIDUAL
    return way.left <= factor * best.left or (explains and metres(way) < factor * metres(best))


def _ways(
    sheet: guesses.Sheet, machine: guesses.Body, rows: guesses.RowColumns, *, lengths: tuple[str, str]
) -> Iterator[proposals.Source]:
    """The likeliest ways to read the table; lengths of the machine and of what was measured are empty where sought."""
    place, turn, *_ = rows.bodies[0] if rows.bodies else guesses.Body([], [])
    groups = machine.place, machine.turn, place, turn
    numbers = _numbers(sheet, [name for names in groups for name in names])
    if not len(numbers):
        return
    commanded_at, commanded_turn, seen_at, seen_turn = numbers.split([len(names) for names in groups], 1)
    length = lengths[0] or _lengths(machine.place, commanded_at)[0]
    other = lengths[1] or (_lengths(place, seen_at)[0] if place else length)
    each = (commanded_turn, seen_turn)
    own, seen = ({Reading(name, unit): turns for name, unit, turns in readings_of(numbers)} for numbers in each)
    if own and seen:
        metres = [values / UNITS_PER_METRE[unit] for values, unit in ((commanded_at, length), (seen_at, other))]
        ways = _alike((metres[0], own), (metres[1], seen))
    else:
        ways = list(product(own or [Reading()], seen or [Reading()], (False, True)[: 1 + Rows(**rows.options).images]))
    units = {"length": other, "joint_length": None if length == other else length}
    for commanded, measured, camera in ways[:FEW_WAYS] if any(lengths) else ways:
        pose = PoseColumns((*machine.place, *machine.turn), commanded.convention).text
        given: dict[str, Any] = {**units, "angle": commanded.angle, "robot_pose": pose}
        more: dict[str, Any] = {"camera_on_tool": camera}
        if turn:
            unit = measured.angle if len(turn) == 3 else None
            more |= {"rotation": [",".join(turn)], "convention": measured.convention, "rotation_angle": unit}
        with quiet(), suppress(DiffeoCalibError):
            robot = cartesian(read_poses(sheet.path, table_format(Units(**given, **sheet.marks)))[1])
            yield proposals.source_of(sheet, robot, rows, **given, **more)


def _numbers(sheet: guesses.Sheet, names: Sequence[str]) -> Tensor:
    """Columns as they are (N, c), of the rows without an empty cell among them."""
    flat = [ZERO] * len(sheet.cells[sheet.header[0]])  # places in a plane
    columns = [numbers_in(sheet.cells.get(name, flat), sheet.decimal) for name in names]
    values = [[nan if value is None else value for value in series] for series in columns]
    numbers = torch.tensor(values, dtype=torch.float64, device=HOST)
    return numbers[:, numbers.isfinite().all(0)].T


def _lengths(names: Sequence[str], values: Tensor) -> tuple[str, ...]:
    """Units of lengths that places may have, by their names, else by the size of the numbers; the likeliest first."""
    named = {column(name).unit for name in names} - {""}
    if others := named - {*UNITS_PER_METRE}:
        what, expected = f"{few(names)} in {few(sorted(others))}", few([*UNITS_PER_METRE])
        raise InputError.of(what, expected=expected, fix="convert them")
    if len(named) == 1:
        return (named.pop(),)
    largest = float(values.abs().max()) if values.numel() else 0.0
    return ("mm",) if largest > LARGEST_IN_METRES else ("m",) if largest < SURELY_METRES else ("m", "mm")


def _alike(
    commanded: tuple[Tensor, dict[Reading, Tensor]], target: tuple[Tensor, dict[Reading, Tensor]]
) -> list[tuple[Reading, Reading, bool]]:
    """Ways to read the rotations of both bodies, and whether what stands was seen from the flange, the likeliest first.

    Motions of the flange between rows, A, and of what was seen, B, are conjugate, A X = X B: their angles and their
    shifts along the axes are the same (H. H. Chen, "A screw motion approach to uniqueness analysis of head-eye
    geometry", 1991). So are those of the inverse: who saw whom is for the rows to tell.
    commanded: places (N, 3), m, and rotations (N, 3, 3) by reading. target: of the other body.
    """
    some = slice(None, None, -(-len(commanded[0]) // MOST_ROWS))
    bodies = [(place[some], torch.stack([*turns.values()])[:, some]) for place, turns in (commanded, target)]
    size = max(float((place - place.mean(0)).norm(dim=1).mean()) for place, _ in bodies) or 1.0
    flange, others = (_screws(*body, size) for body in bodies)
    whole = flange.abs().mean(1)[:, None] + others.abs().mean(1)  # small where radians are read as degrees
    away = (flange[:, None] - others).abs().sort(dim=2).values  # the worst may be of gross rows
    left = (away[:, :, : ceil(GOOD_MOTIONS * away.shape[2])].mean(2) / whole.clamp(min=EXACT)).flatten().tolist()
    pairs = sorted(zip(left, product(commanded[1], target[1]), strict=True), key=lambda entry: entry[0])
    alike = [pair for misfit, pair in pairs if misfit <= ALIKE * max(pairs[0][0], EXACT)][: MOST_WAYS // 2]
    return [(*pair, camera) for pair in alike for camera in (False, True)]


def _screws(places: Tensor, R: Tensor, size: float) -> Tensor:
    """Angles, rad, and shifts along the axes times sines, over a size, of motions between rows: (c readings, 2 K)."""
    motions = list[Tensor]()
    for step in STEPS:
        turns = R.mT @ R.roll(-step, 1)
        shifts = (R.mT @ (places.roll(-step, 0) - places)[..., None])[..., 0]
        skew = turns - turns.mT
        axes = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], 2)
        trace = turns.diagonal(dim1=2, dim2=3).sum(2)
        motions += [torch.atan2(axes.norm(dim=2), trace - 1), (axes * shifts).sum(2) / (2 * size)]
    return torch.cat(motions, 1)


NOT_RAISED = 1.01  # ratio of residuals without and with a joint up to which the markers do not follow it
SIDES = {"l": "left", "r": "right"}
FLANGES = ("flange", "tool0", "ee", "eef")  # what names of links say to which tools are screwed, the surest first


def run(given: InitOptions) -> None:
    """Propose a campaign, write it, and print it; a file that was edited is replaced with --force alone."""
    output = given.output
    csv, by = guesses.with_places(given.csv, given)
    sheet = guesses.guess_sheet(csv)
    try:
        source = _commanded(given.robot, sheet) or _of_robot(given.robot or Path(), sheet)
    except InputError as error:
        raise type(error)(f"{error} {sheet.odd}".strip()) from error
    with quiet():
        copies = len(source.data.copies())
    source = source.into({"by": getattr(csv, "sentence", "")}, csv=given.csv, places=given.places, by=by or None)
    if copies:
        exactly = f"{copies} line(s) repeat others exactly; real repeats differ"
        source = source.into({"duplicates": exactly}, duplicates="drop")
    unused = few([name for name in sheet.header if name not in source.columns], 20)
    unused = f"columns that are not used: {unused}" if unused else "all columns are used"
    lines = [
        "# Options of `diffeo-calib fit`, proposed by `diffeo-calib init`: check every line.",
        *source.remarking(unused, *filter(None, [sheet.odd])).lines(output.parent),
    ]
    content = ("\n".join(lines) + "\n").encode()
    if output.is_file() and not given.force and output.read_bytes() != content:
        fix = "name another file by -o, or add --force to replace it"
        raise InputError.of(f"'{output}' exists and holds other options", expected="a new file", fix=fix)
    write_whole(output, content)
    say(*lines)
    fill_in = ", fill in the lines that say `uncomment`" * any("uncomment" in line for line in lines)
    say(f"campaign: {output}; check it{fill_in}, then run: diffeo-calib fit {output}")


def _commanded(robot: Path | None, sheet: guesses.Sheet) -> proposals.Source | None:
    """The table as poses of the machine; None where a robot is named whose joints the table has."""
    if robot is None:
        return commanded(sheet)
    refused = None
    try:
        if any(arm.columns.how != guesses.BY_NO_NAME for arm in _arms(robot, sheet)):
            return None
    except InputError as error:
        refused = error
    try:
        source = commanded(sheet)
    except DiffeoCalibError:
        if refused is None:
            return None
        raise refused from None
    return source.remarking(f"{robot}: not used, no column is named after its joints")


def _of_robot(robot: Path, sheet: guesses.Sheet) -> proposals.Source:
    """The table as values of the joints, or in the convention, that explain the rows; InputError unless one does."""
    sources, arms = dict[tuple[str | None, ...], proposals.Source](), _arms(robot, sheet)
    refused = list[InputError]()
    for seeks in (False, True)[len(arms) < 2 :]:  # first all as they are
        for arm in [] if sources else arms:
            try:
                with quiet():  # `fit` warns of the right reading
                    source = _read(robot, sheet, arm, seeks=seeks)
                    sources.setdefault((arm.links.dh_convention, *source.robot.joint_names), source)
            except InputError as error:
                refused.append(error)
    if not sources:
        arm = next((arm for arm in arms if arm.lacking), None)
        more = "" if arm is None else f" No column is named after {few(arm.lacking, 20)}."
        if arm is not None and arm.columns.how.startswith("numbered"):
            count, most = len(arm.joints), len(arm.joints) + len(arm.lacking)
            more = f" {count} numbered columns do not say which of {most} joints they are: name them after the joints."
        raise type(refused[-len(arms)])(f"{refused[-len(arms)]}{more}")
    best, *_ = several = proposals.ranked(sources.values())
    if len(several) > 1 and not proposals.is_clear(several):
        got = "; ".join(
            f"{key[0] or few(key[1:], 9)}: {proposals.percent(source.left)}" for key, source in sources.items()
        )
        convention = any(key[0] for key in sources)
        fix = "say the convention in the file, by a line such as `# craig`" if convention else ""
        fix, expected = fix or "name the columns after the joints of the arm", "some that explain the rows far better"
        raise InputError.of(f"the joints of '{robot}'", expected=expected, got=got, fix=fix)
    if others := best.other_units():
        remark = f"{few(others)}: the names say another unit than the robot finds in the numbers: check it"
        best = best.remarking(remark)
    best = proposals.with_distances(best)
    if best.bodies and not best.options.rotation:
        best = proposals.with_deviations(proposals.with_rotation(best))
    return best.into({"robot": "a URDF" if is_urdf(robot) else f"a DH table, {DHFile.read(robot).units}"})


def _read(robot: Path, sheet: guesses.Sheet, arm: Arm, *, seeks: bool) -> proposals.Source:
    """The table as values of these joints; InputError if the robot does not explain the rows."""
    rows = guesses.rows_in(sheet, arm.columns.names)
    tips = _tips_named(chains_in(robot) if is_urdf(robot) else [], [column(body.place[0]) for body in rows.bodies])
    chain = load_robot(robot, replace(arm.links, tip=tips or arm.links.tip))
    options = {"robot": robot, **vars(arm.links), "tip": tips or None, "length": "mm", "angle": "deg"}
    source = proposals.source_of(sheet, chain, rows, **options)
    guessed = sheet.joint_columns(chain.joint_names) or [arm.columns]
    source = proposals.with_measured(proposals.with_joint_columns(source, guessed))
    source = proposals.with_units(source, seeks=seeks)
    return source if tips else _with_tip(robot, source, arm)


def _tips_named(paths: Sequence[list[JointElement]], markers: Sequence[Column]) -> list[str]:
    """The leaf that the columns of each marker are named after, or by a word that no other arm has; none if one lacks.

    Fingers of a gripper are no arms: each has a joint or none of its own.
    """
    words = {path[-1].child: {SIDES.get(word, word) for word in column(path[-1].child).words} for path in paths}
    counts = Counter(word for group in words.values() for word in group)
    uses = Counter(joint.name for path in paths for joint in path if joint.kind != "fixed")
    arms = [path[-1].child for path in paths if sum(uses[joint.name] == 1 for joint in path) > 1]
    tips = list[str]()
    for marker in markers:
        said = {SIDES.get(word, word) for word in marker.words}
        alike = [leaf for leaf in arms if any(counts[word] == 1 for word in words[leaf] & said)]
        tips += ([leaf for leaf in words if column(leaf).plain == marker.plain.removesuffix("x")] or alike)[:1]
    return tips if len(tips) == len(markers) and len(set(tips)) > 1 else []


def _with_tip(robot: Path, source: proposals.Source, arm: Arm) -> proposals.Source:
    left_out = list[str]()
    moved = (source.data.q.amax(0) - source.data.q.amin(0)).tolist()
    while len(arm.joints) > 1 and "joints" not in source.asked:
        count = len(arm.joints) - 1
        shorter, last = arm.first(count), arm.joints[count]
        without = replace(source, robot=load_robot(robot, shorter.links)).into(joints=",".join(source.joints[:count]))
        if moved[count] < gates.FIXED_RANGE:
            left_out.append(f"{last} hardly moves in the table")
        else:
            # its axis may run through the marker, and a pose shows that it turns where a place does not
            an_arm_s = moved[count] > median(moved) / 2 or any(body.turn for body in source.bodies)
            raised = 1 / proposals.CLEAR_RATIO if an_arm_s else NOT_RAISED
            if source.left > proposals.LARGEST_RESIDUAL or without.left > raised * source.left:
                break
            words = f"with {last} the nominal robot leaves {proposals.percent(source.left)} of what the rows vary"
            left_out.append(f"{words}, without it {proposals.percent(without.left)}")
        arm, source = shorter, without
    source = proposals.with_units(source) if left_out else source
    left_out += [f"no column is named after {few(arm.lacking)}"] * bool(arm.lacking)
    tip = (arm.links.tip or [""])[0]
    flange = f": {tip} is the flange, by its name" * any(_says(tip, word) for word in FLANGES)
    why = "; ".join([f"behind {arm.joints[-1]}, the last joint that moves the markers{flange}", *left_out])
    return source.into({"tip": why}, tip=arm.links.tip)


@dataclass(frozen=True)
class Arm:
    """The first joints of a robot, one behind the other, that the table has columns of."""

    links: Links  # the options that name them
    joints: list[str]  # their names
    ends: list[str]  # the link behind each
    columns: guesses.JointColumns  # of each
    lacking: tuple[str, ...] = ()  # joints behind them that no column is named after

    def first(self, count: int) -> Arm:
        """The first joints of these alone."""
        links = replace(self.links, tip=[self.ends[count - 1]])
        return replace(self, links=links, joints=self.joints[:count], ends=self.ends[:count])


def _arms(robot: Path, sheet: guesses.Sheet) -> list[Arm]:
    """As many joints of a robot as the table has columns of; of a DH table in the conventions that it may have."""
    whole = list[tuple[Links, list[str], list[str]]]()
    if is_urdf(robot):
        for path in (paths := chains_in(robot)):
            moving = [joint for joint in path if joint.kind != "fixed" and joint.driver is None]
            ends = [_end_behind(path, joint, paths) for joint in moving]
            whole.append((Links(base=path[0].parent), [joint.name for joint in moving], ends))
    else:
        table = DHFile.read(robot)
        ways = [None] if table.convention else ("standard", "craig")
        whole += [(Links(dh_convention=way), table.names, table.names) for way in ways]
    arms = list[Arm]()
    for options, joints, ends in whole:
        for count in range(len(joints), 0, -1):
            guessed = sheet.joint_columns(joints[:count])
            series = bool(guessed) and guessed[0].how.startswith("numbered")
            if guessed and (2 * count > len(joints) or not series):  # a short series may be of anything
                lacking = joints[count:] if series else guesses.joints_without_column(sheet.numbers, joints)
                arm = Arm(options, joints[:count], ends, guessed[0], tuple(lacking if count < len(joints) else ()))
                arms.append(arm if options.base is None and count == len(joints) else arm.first(count))
                break
    if all(len(arm.joints) <= len(arm.lacking) for arm in arms):
        every = [(*each, sheet.others(len(each[1]))) for each in whole]
        unnamed = [Arm(options, joints, ends, others[0]) for options, joints, ends, others in every if others]
        arms = [arm if arm.links.base is None else arm.first(len(arm.joints)) for arm in unnamed] or arms
    if not arms:
        longest = sorted((joints for _, joints, _ in whole), key=len)[:-4:-1]
        expected = " or ".join(dict.fromkeys(few(joints, 20) for joints in longest if joints)) or "a robot with joints"
        missing = few(guesses.joints_without_column(sheet.numbers, longest[0]), 20) if longest else "a joint"
        fix = f"no column is named after {missing}" if missing else "numbered columns are more than the joints"
        fix += ": name the columns as the joints, or q1, q2, ... in their order"
        raise InputError.of(
            f"columns of the joints of '{robot}'", expected=expected, got=few(sheet.numbers, 20), fix=fix
        )
    arms = [arm for arm in arms if arm.columns.how == "named as in the URDF"] or arms
    words = [{SIDES.get(word, word) for name in arm.joints for word in column(name).words} for arm in arms]
    said = [{SIDES.get(word, word) for name in arm.columns.names for word in column(name).words} for arm in arms]
    both = set[str].intersection(*words)
    arms = [arm for arm, named, names in zip(arms, words, said, strict=True) if (named - both) & names] or arms
    most = max(len(arm.joints) for arm in arms)
    return list({(*arm.joints, arm.links.dh_convention): arm for arm in arms if len(arm.joints) == most}.values())


def _end_behind(path: list[JointElement], joint: JointElement, paths: list[list[JointElement]]) -> str:
    """The flange, by usual names, or the link of a joint; behind joints that follow this or earlier ones."""
    place = path.index(joint)
    above = {element.name for element in path[: place + 1]}
    behind = [joint, *takewhile(lambda element: element.kind == "fixed" or element.driver in above, path[place + 1 :])]
    links = [[element.child for element in behind if element.kind != "fixed"][-1]]
    fixed = {element.child: element.parent for path in paths for element in path if element.kind == "fixed"}
    for link in links:
        links += [child for child, parent in fixed.items() if parent == link]
    named = ([link for link in links if _says(link, word)] for word in FLANGES)
    return next((flanges[0] for flanges in named if len(flanges) == 1), links[0])


def _says(link: str, word: str) -> bool:
    return word in column(link).words or (len(word) > len("eef") and link.lower().endswith(word))
