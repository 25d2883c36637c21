"""`diffeo-calib init`: propose the options of `fit` for a table and a robot as a campaign file, with reasons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from statistics import median

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.cli.column_names import Column, column
from diffeo_calib.cli.commanded_poses import commanded
from diffeo_calib.cli.console import say
from diffeo_calib.cli.declarations import InitOptions
from diffeo_calib.cli.guesses import JointColumns, Sheet, guess_sheet, joints_without_column, rows_in, with_places
from diffeo_calib.cli.models import is_urdf, load_robot
from diffeo_calib.cli.options import Links
from diffeo_calib.cli.proposals import (
    CLEAR_RATIO,
    LARGEST_RESIDUAL,
    Source,
    is_clear,
    percent,
    ranked,
    source_of,
    with_deviations,
    with_distances,
    with_joint_columns,
    with_measured,
    with_rotation,
    with_units,
)
from diffeo_calib.common.errors import DiffeoCalibError, InputError, few
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.checks import quiet
from diffeo_calib.robots.dh_file import DHFile
from diffeo_calib.robots.urdf import chains_in
from diffeo_calib.robots.urdf_elements import JointElement

NOT_RAISED = 1.01  # ratio of residuals without and with a joint up to which the markers do not follow it
SIDES = {"l": "left", "r": "right"}
FLANGES = ("flange", "tool0")  # ends of the names of links to which tools are screwed


def run(given: InitOptions) -> None:
    """Propose a campaign, write it, and print it; a file that was edited is replaced with --force alone."""
    output = given.output
    csv, by = with_places(given.csv, given)
    sheet = guess_sheet(csv)
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


def _commanded(robot: Path | None, sheet: Sheet) -> Source | None:
    """The table as poses of the machine; None where a robot is named whose joints the table has."""
    if robot is None:
        return commanded(sheet)
    try:
        _arms(robot, sheet)
    except InputError as error:
        try:
            source = commanded(sheet)
        except DiffeoCalibError:
            raise error from None
        return source.remarking(f"{robot}: not used, no column is named after its joints")
    return None


def _of_robot(robot: Path, sheet: Sheet) -> Source:
    """The table as values of the joints, or in the convention, that explain the rows; InputError unless one does."""
    sources, refused = dict[tuple[str | None, ...], Source](), list[InputError]()
    for arm in (arms := _arms(robot, sheet)):
        try:
            with quiet():  # `fit` warns of the right reading
                source = _read(robot, sheet, arm)
                sources.setdefault((arm.links.dh_convention, *source.robot.joint_names), source)
        except InputError as error:
            refused.append(error)
    if not sources:
        lacking = next((arm.lacking for arm in arms if arm.lacking), ())
        more = f" No column is named after {few(lacking, 20)}." if lacking else ""
        raise type(refused[0])(f"{refused[0]}{more}")
    best, *_ = several = ranked(sources.values())
    if len(several) > 1 and not is_clear(several):
        got = "; ".join(f"{key[0] or few(key[1:], 9)}: {percent(source.left)}" for key, source in sources.items())
        convention = any(key[0] for key in sources)
        fix = "say the convention in the file, by a line such as `# craig`" if convention else ""
        fix, expected = fix or "name the columns after the joints of the arm", "some that explain the rows far better"
        raise InputError.of(f"the joints of '{robot}'", expected=expected, got=got, fix=fix)
    if others := best.other_units():
        remark = f"{few(others)}: the names say another unit than the robot finds in the numbers: check it"
        best = best.remarking(remark)
    best = with_distances(best)
    if best.bodies and not best.options.rotation:
        best = with_deviations(with_rotation(best))
    return best.into({"robot": "a URDF" if is_urdf(robot) else f"a DH table, {DHFile.read(robot).units}"})


def _read(robot: Path, sheet: Sheet, arm: Arm) -> Source:
    """The table as values of these joints; InputError if the robot does not explain the rows."""
    rows = rows_in(sheet, arm.columns.names)
    tips = _tips_named(chains_in(robot) if is_urdf(robot) else [], [column(body.place[0]) for body in rows.bodies])
    chain = load_robot(robot, replace(arm.links, tip=tips or arm.links.tip))
    options = {"robot": robot, **vars(arm.links), "tip": tips or None, "length": "mm", "angle": "deg"}
    source = source_of(sheet, chain, rows, **options)
    guessed = sheet.joint_columns(chain.joint_names) or [arm.columns]
    source = with_units(with_measured(with_joint_columns(source, guessed)))
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


def _with_tip(robot: Path, source: Source, arm: Arm) -> Source:
    """Drop joints at the end that no marker follows, and say why the tip is there."""
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
            raised = 1 / CLEAR_RATIO if an_arm_s else NOT_RAISED
            if source.left > LARGEST_RESIDUAL or without.left > raised * source.left:
                break
            words = f"with {last} the nominal robot leaves {percent(source.left)} of what the rows vary"
            left_out.append(f"{words}, without it {percent(without.left)}")
        arm, source = shorter, without
    source = with_units(source) if left_out else source
    left_out += [f"no column is named after {few(arm.lacking)}"] * bool(arm.lacking)
    why = "; ".join([f"behind {arm.joints[-1]}, the last joint that moves the markers", *left_out])
    return source.into({"tip": why}, tip=arm.links.tip)


@dataclass(frozen=True)
class Arm:
    """The first joints of a robot, one behind the other, that the table has columns of."""

    links: Links  # the options that name them
    joints: list[str]  # their names
    ends: list[str]  # the link behind each
    columns: JointColumns  # of each
    lacking: tuple[str, ...] = ()  # joints behind them that no column is named after

    def first(self, count: int) -> Arm:
        """The first joints of these alone."""
        links = replace(self.links, tip=[self.ends[count - 1]])
        return replace(self, links=links, joints=self.joints[:count], ends=self.ends[:count])


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
            guessed = sheet.joint_columns(joints[:count])
            series = bool(guessed) and guessed[0].how.startswith("numbered")
            if guessed and (2 * count > len(joints) or not series):  # a short series may be of anything
                lacking = joints[count:] if series else joints_without_column(sheet.numbers, joints)
                arm = Arm(options, joints[:count], ends, guessed[0], tuple(lacking if count < len(joints) else ()))
                arms.append(arm if options.base is None and count == len(joints) else arm.first(count))
                break
    if not arms:
        longest = sorted((joints for _, joints, _ in whole), key=len)[:-4:-1]
        expected = " or ".join(dict.fromkeys(few(joints, 20) for joints in longest if joints)) or "a robot with joints"
        missing = few(joints_without_column(sheet.numbers, longest[0]), 20) if longest else "a joint"
        fix = f"no column is named after {missing}" if missing else "numbered columns are more than the joints"
        fix += ": name the columns as the joints, or q1, q2, ... in their order"
        raise InputError.of(
            f"columns of the joints of '{robot}'", expected=expected, got=few(sheet.numbers, 20), fix=fix
        )
    arms = [arm for arm in arms if arm.columns.how == "named as in the URDF"] or arms
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
    return next((link for word in FLANGES for link in links if link.lower().endswith(word)), links[0])
