"""`diffeo-calib init`: propose the options of `fit` for a table and a robot as a campaign file, with reasons."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product, takewhile
from math import inf
from os.path import relpath
from pathlib import Path
from statistics import median
from typing import NamedTuple

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.cli import commanded_poses, proposals
from diffeo_calib.cli.console import say
from diffeo_calib.cli.declarations import InitOptions
from diffeo_calib.cli.guesses import (
    NAMED,
    Choice,
    JointColumns,
    Sheet,
    entries,
    guess_joints,
    guess_sheet,
    joints_without_column,
    rows_in,
    tips_of,
    with_places,
)
from diffeo_calib.cli.models import is_urdf, load_robot
from diffeo_calib.cli.options import CORNERS, Links
from diffeo_calib.cli.proposals import Source
from diffeo_calib.common.errors import DiffeoCalibError, InputError, few
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.checks import quiet
from diffeo_calib.measurements.csv.files import read_joints
from diffeo_calib.measurements.csv.lines import read_cells
from diffeo_calib.measurements.csv.sensors import CAMERA, IMAGE, PIXEL, POINT
from diffeo_calib.measurements.table_format import UNITS_PER_METRE, TableFormat
from diffeo_calib.robots.dh_file import DHFile
from diffeo_calib.robots.urdf import chains_in
from diffeo_calib.robots.urdf_elements import JointElement

CLEAR_RATIO = 5.0
"""A reading is clear if every other one's residual is larger by this."""
DOUBTFUL = 0.01
"""Share of what the rows vary, left by the best units, above which other meanings of the joints are sought."""
SMALLEST_PART = 0.1
"""Of a joint's limits that a table passes through, in the right unit."""
NOT_RAISED = 1.01
"""Ratio of residuals without and with a joint up to which the markers do not follow it."""
FLANGES = ("flange", "tool0")
"""Ends of the names of links to which tools are screwed."""
COLUMNS = ("joints", "position", "marker", "socket", "rotation", "std", "reading", "by", *NAMED)
"""Entries that name columns."""


class Arm(NamedTuple):
    """The first joints of a robot, one behind the other, that the table has columns of.

    Args:
        links: the options that name them. joints: their names. ends: the link behind each. columns: of each.
        how: these were found. lacking: joints behind them that no column is named after.
    """

    links: Links
    joints: list[str]
    ends: list[str]
    columns: list[str]
    how: str
    lacking: Sequence[str] = ()

    def first(self, count: int) -> Arm:
        """The first joints of these alone."""
        links = replace(self.links, tip=[self.ends[count - 1]])
        return Arm(links, self.joints[:count], self.ends[:count], self.columns[:count], self.how, self.lacking)


def run(given: InitOptions) -> None:
    """Propose a campaign, write it, and print it; a file that was edited is replaced with --force alone."""
    output = given.output
    if given.csv.is_dir():
        read_cells(given.csv, ",")  # says why not
    csv, joined = with_places(given.csv, given.places, output.parent)
    sheet = guess_sheet(csv)
    try:
        found = _commanded(csv, given.robot, sheet) or _of_robot(csv, given.robot or Path(), output.parent, sheet)
    except InputError as error:
        raise type(error)(f"{error} {sheet.odd}".strip()) from error
    source, names, units = found
    choices = [
        Choice("csv", relpath(given.csv, output.parent), "; ".join(["the table", *sheet.notes])),
        *joined,
        *names,
        *source.rows.entries(output.parent),
        *filter(None, [source.marker]),
        Choice("sep", "tab" if sheet.sep == "\t" else sheet.sep, f"{len(sheet.numbers)} columns are numbers with it"),
        Choice("decimal", sheet.decimal, "the same"),
        *units,
        Choice("output", csv.with_suffix(".safetensors").name, "the model"),
        Choice("report", csv.with_suffix(".html").name, "the report"),
    ]
    unused = [name for name in sheet.header if name not in _used(choices)]
    lines = [
        "# Options of `diffeo-calib fit`, proposed by `diffeo-calib init`: check every line.",
        *(choice.line() for choice in choices),
        f"# columns that are not used: {few(unused, 20)}" if unused else "# all columns are used",
    ]
    content = ("\n".join(lines) + "\n").encode()
    if output.exists() and not given.force and output.read_bytes() != content:
        fix = "name another file by -o, or add --force to replace it"
        raise InputError.of(f"'{output}' exists and holds other options", expected="a new file", fix=fix)
    write_whole(output, content)
    say(*lines)
    fill_in = ", fill in the lines that say `uncomment`" * any("uncomment" in line for line in lines)
    say(f"campaign: {output}; check it{fill_in}, then run: diffeo-calib fit {output}")


Proposal = tuple[Source, list[Choice], list[Choice]]
"""A table that is read, entries about robot and joints, and entries about units and what else is in the table."""


def _of_robot(csv: Path, robot: Path, folder: Path, sheet: Sheet) -> Proposal:
    """The proposal for a table with joint values of a robot."""
    about = "a URDF" if is_urdf(robot) else f"a DH table, {DHFile.read(robot).units}"
    about = [Choice("robot", relpath(robot, folder), about)]
    arm, why, seen, names, units = _explained(csv, robot, sheet)
    if is_urdf(robot):
        about.append(Choice("base", arm.links.base or "", "root of the URDF"))
    about += entries([arm.links], dh_convention="the convention with which it explains the rows")
    if seen.tips:
        about.append(Choice("tip", list(seen.tips), "leaves after which the columns are named"))
    elif arm.links.tip is not None:
        about.append(Choice("tip", arm.links.tip[0], why))
    read = replace(seen, table=_format(units, seen))
    if others := proposals.other_units(seen, read.table):
        remark = f"{few(others)}: the names say another unit than the robot finds in the numbers: check it"
        units = [*units, Choice("", "", remark)]
    beside = [] if any(choice.name == "rotation" for choice in units) else proposals.beside(read, sheet)
    return seen, [*about, *names], [*units, *beside]


def _commanded(csv: Path, robot: Path | None, sheet: Sheet) -> Proposal | None:
    """That for a table with poses of the machine; None where a robot is named whose joints the table has."""
    if robot is None:
        return commanded_poses.choices(csv, sheet)
    try:
        _arms(robot, sheet)
    except InputError as error:
        try:
            source, columns, units = commanded_poses.choices(csv, sheet)
        except DiffeoCalibError:
            raise error from None
        return source, [Choice("", "", f"{robot}: not used, no column is named after its joints"), *columns], units
    return None


def _format(units: list[Choice], seen: Source) -> TableFormat:
    """The format of positions and joints in these units."""
    found = {choice.name: choice.value for choice in units}
    known = {name: found.get(name.replace("_", "-")) for name in ("length", "angle", "joint_length")}
    return replace(seen.table, **known, camera_on_tool="camera-on-tool" in found and "rotation" not in found)


class Explained(NamedTuple):
    """Rows that a robot explains: its joints and why the tip is behind these, the table, its columns, and its units."""

    arm: Arm
    why: str
    seen: Source
    names: list[Choice]
    units: list[Choice]

    @classmethod
    def of(cls, csv: Path, robot: Path, sheet: Sheet, arm: Arm) -> Explained:
        """Those of some joints of a robot; InputError if it does not explain the rows."""
        leaves = [path[-1].child for path in chains_in(robot)] if is_urdf(robot) else []
        rows = rows_in(csv, sheet, arm.columns)
        tips = tips_of(rows.markers, leaves)
        chain = load_robot(robot, replace(arm.links, tip=tips or arm.links.tip))
        table = TableFormat("mm", "deg", sheet.sep, sheet.decimal)
        seen = Source(csv, chain, arm.columns, rows, table, sheet.numbers, tips)
        guessed = guess_joints(sheet.numbers, chain.joint_names) or [JointColumns(arm.columns, arm.how, ())]
        seen, names = proposals.joint_columns(seen, guessed)
        seen = proposals.measured(seen)
        units = list(_units(seen))
        if meant := [choice for choice in units if choice.name == "joints"]:
            names, units = meant, [choice for choice in units if choice.name != "joints"]
        seen = replace(seen, joints=str(names[0].value).split(",")) if names[0].sure else seen
        seen = proposals.measured(seen) if meant else seen  # the robot explains the rows only now
        return _with_tip(robot, cls(arm, "", seen, names, units))


def _explained(csv: Path, robot: Path, sheet: Sheet) -> Explained:
    """The joints, or the convention, that explain the rows; InputError if none do, or several."""
    found, refused = dict[tuple[str | None, ...], Explained](), list[InputError]()
    for arm in (arms := _arms(robot, sheet)):
        try:
            with quiet():  # `fit` warns of the right reading
                one = Explained.of(csv, robot, sheet, arm)
                found.setdefault((arm.links.dh_convention, *one.seen.robot.joint_names), one)
        except InputError as error:
            refused.append(error)
    if not found:
        lacking = next((arm.lacking for arm in arms if arm.lacking), ())
        more = f" No column is named after {few(lacking, 20)}." if lacking else ""
        raise type(refused[0])(f"{refused[0]}{more}")
    if len(found) == 1:
        return next(iter(found.values()))
    best = min(found.values(), key=lambda one: one.seen.residual(_format(one.units, one.seen)))
    alike = {key: one.seen.residual(_format(best.units, best.seen)) for key, one in found.items()}
    if not proposals.is_clear(sorted((size, "") for size in alike.values()), CLEAR_RATIO):
        got = "; ".join(f"{key[0] or few(key[1:], 9)}: {100 * size:.3g} %" for key, size in alike.items())
        fix = "say the convention in the file, by a line such as `# craig`" if best.arm.links.dh_convention else ""
        fix, expected = fix or "name the columns after the joints of the arm", "some that explain the rows far better"
        raise InputError.of(f"the joints of '{robot}'", expected=expected, got=got, fix=fix)
    return best


def _arms(robot: Path, sheet: Sheet) -> list[Arm]:
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
            guessed = guess_joints(sheet.numbers, joints[:count])
            series = bool(guessed) and guessed[0].how.startswith("numbered")
            if guessed and (2 * count > len(joints) or not series):  # a short series may be of anything
                lacking = joints_without_column(sheet.numbers, joints) if count < len(joints) else ()
                arm = Arm(options, joints[:count], ends, guessed[0].names, guessed[0].how, lacking)
                arms.append(arm if options.base is None and count == len(joints) else arm.first(count))
                break
    if not arms:
        longest = sorted((joints for _, joints, _ in whole), key=len)[:-4:-1]
        expected = " or ".join(few(joints, 20) for joints in longest if joints) or "a robot with joints"
        missing = few(joints_without_column(sheet.numbers, longest[0]), 20) if longest else "a joint"
        fix = f"no column is named after {missing}: name the columns as the joints, or q1, q2, ... in their order"
        got = few(sheet.numbers, 20)
        raise InputError.of(f"columns of the joints of '{robot}'", expected=expected, got=got, fix=fix)
    arms = [arm for arm in arms if arm.how == "named as in the URDF"] or arms
    most = max(len(arm.joints) for arm in arms)
    return list({(*arm.joints, arm.links.dh_convention): arm for arm in arms if len(arm.joints) == most}.values())


def _with_tip(robot: Path, found: Explained) -> Explained:
    """The same without joints at the end that no marker follows, and why."""
    arm, _, seen, names, units = found
    table, left_out = _format(units, seen), list[str]()
    q = read_joints(seen.csv, seen.joints, table, kinds=seen.robot.kinds)
    moved = (q.amax(0) - q.amin(0)).tolist()
    while len(arm.joints) > 1 and not seen.tips and names[0].sure:
        count = len(arm.joints) - 1
        shorter, last = arm.first(count), arm.joints[count]
        without = replace(seen, robot=load_robot(robot, shorter.links), joints=seen.joints[:count])
        if moved[count] < gates.FIXED_RANGE:
            left_out.append(f"{last} hardly moves in the table")
        else:
            # its axis may run through the marker, and a pose shows that it turns where a place does not
            an_arm_s = moved[count] > median(moved) / 2 or bool(proposals.rotations(seen))
            size, residual = seen.residual(table), without.residual(table)
            if size > proposals.LARGEST_RESIDUAL or residual > size * (1 / CLEAR_RATIO if an_arm_s else NOT_RAISED):
                break
            words = f"with {last} the nominal robot leaves {100 * size:.3g} % of what the rows vary"
            left_out.append(f"{words}, without it {100 * residual:.3g} %")
        arm, seen = shorter, without
    why = "; ".join([f"behind {arm.joints[-1]}, the last joint that moves the markers", *left_out])
    names = [names[0]._replace(value=",".join(seen.joints))] if names[0].sure else names
    units = [choice for choice in _units(seen) if choice.name != "joints"] if left_out else units
    return Explained(arm, why, seen, names, units)


def _end_behind(path: list[JointElement], joint: JointElement, paths: list[list[JointElement]]) -> str:
    """The flange, by usual names, or the link of a joint; behind joints that follow this or earlier ones."""
    place = path.index(joint)
    above = {one.name for one in path[: place + 1]}
    behind = [joint, *takewhile(lambda one: one.kind == "fixed" or one.driver in above, path[place + 1 :])]
    links = [[one.child for one in behind if one.kind != "fixed"][-1]]
    fixed = {one.child: one.parent for path in paths for one in path if one.kind == "fixed"}
    for link in links:
        links += [child for child, parent in fixed.items() if parent == link]
    return next((link for word in FLANGES for link in links if link.lower().endswith(word)), links[0])


def _units(source: Source) -> Iterator[Choice]:
    """Units, and a meaning of the joints' columns, with which the nominal robot can explain the rows."""
    no_length, boards = source.rows.without_length and all(source.robot.periodic), source.rows.of_boards
    lengths = ["mm"] if no_length else list(UNITS_PER_METRE)
    found = _left(source, lengths, [None], boards=boards)
    doubtful = found[0][0] > DOUBTFUL or not proposals.is_clear(found, CLEAR_RATIO)
    if not all(source.robot.periodic) and doubtful:
        others = sorted([*found, *_left(source, lengths, lengths, boards=boards)], key=lambda entry: entry[0])
        found = others if proposals.is_clear(others, CLEAR_RATIO) else found
    by_limits = [] if any(source.robot.periodic) else [one for one in found if one[0] < inf and _within(source, one[1])]
    found = by_limits or found  # all lengths in another unit are another size, which the rows do not show
    (best, table), *others = found
    excluded = found[-1][0] == inf
    named = [(left, table) for left, table in found if not proposals.other_units(source, table)]
    by_names = not proposals.is_clear(found, CLEAR_RATIO) and 0 < len(named) < len(found)
    if by_names := by_names and named[0][0] < CLEAR_RATIO * best:
        (best, table), *others = found = named
    clear = proposals.is_clear(found, CLEAR_RATIO)
    poses = [] if clear else list(proposals.rotation(source, camera=True))
    if best == inf and not poses:
        source.read_residual(table)  # says why
    meant = [] if poses or best < DOUBTFUL or not any(source.robot.periodic) else list(source.conventions(best))
    if poses or meant:
        yield from poses or meant
        return
    if not clear:
        raise _unclear(source, found, excluded=excluded)
    why = source.words(best, others[0][0] if others else inf)
    why += ", by the names of the columns: the numbers leave it open" * by_names
    why += ", by the limits of the joints: the numbers leave it open" * bool(by_limits)
    length, angle = ("of lengths that you add: the table holds none", why) if no_length else (why, "the same")
    camera, slides = "the same; else the board is on the tool", "the same: the slides are in another unit"
    yield from entries([table], length=length, angle=angle, joint_length=slides, camera_on_tool=camera)


def _unclear(source: Source, found: list[tuple[float, TableFormat]], *, excluded: bool) -> InputError:
    parts = [(left, (t.length, t.angle, t.joint_length, "camera on the tool" * t.camera_on_tool)) for left, t in found]
    got = "; ".join(f"{' and '.join(filter(None, words))}: {100 * left:.3g} %" for left, words in parts if left < inf)
    got += "; the units that the file states exclude others" * excluded
    sought = source.rows.markers and not (source.rows.sockets or source.rows.readings)
    fix = "no signs, zeros, coupling or units of the joints do either: " if sought else ""
    fix += "check the table's joints against the robot's, or write the file yourself; of a robot with several tips "
    fix += "the columns of each are to be named after it, such as left_x"
    what = "units with which the robot explains what the rows vary"
    return InputError.of(what, expected="one clear reading", got=f"left unexplained {got}", fix=fix)


def _within(source: Source, table: TableFormat) -> bool:
    """Whether values of joints in some units lie within the limits, in more than a small part of these."""
    low, high = source.robot.limits.unbind(1)
    q = read_joints(source.csv, source.joints, table, kinds=source.robot.kinds)
    part = (q.amax(0) - q.amin(0)) / (high - low)
    return bool(((q >= low) & (q <= high)).all()) and float(part.max()) > SMALLEST_PART


def _left(
    source: Source, lengths: list[str], slides: Sequence[str | None], *, boards: bool
) -> list[tuple[float, TableFormat]]:
    """Share of the rows that is left with units of length and angle, of slides, and with the camera on the tool."""
    angles = ("rad", "deg") if any(source.robot.periodic) else ("rad",)
    ways = product(lengths, angles, slides, (False, True) if boards else (False,))
    formats = (
        replace(source.table, length=length, angle=angle, joint_length=slide, camera_on_tool=camera)
        for length, angle, slide, camera in ways
        if slide != length
    )
    return source.residuals(formats)


def _used(choices: list[Choice]) -> set[str]:
    columns = [choice.value for choice in choices if choice.name in COLUMNS]
    columns += [str(choice.value).partition("=")[0] for choice in choices if choice.name == "robot-pose"]
    texts = [str(text) for value in columns for text in (value if isinstance(value, list) else [value])]
    corners = {IMAGE, *POINT, *PIXEL, CAMERA} if any(text.startswith(CORNERS) for text in texts) else set[str]()
    names = (name for text in texts for name in text.rpartition("=")[2].split(","))
    return corners | {name for each in names for name in re.findall(r"\{([^{}]+)\}", each) or [each]}
