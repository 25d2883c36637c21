"""Ways to read a table, each with what it leaves unexplained: `diffeo-calib init` proposes the best, if it is clear.

A way is options of `fit`, with which it reads the table. A step of `init` makes ways that differ in some of these
(columns, units, conventions, meanings of joints), ranks them by what they leave, and takes the first where all others
leave far more; else it asks the user, or says why the table tells nothing.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from math import inf, log
from os.path import relpath
from pathlib import Path
from typing import Any

import torch

from diffeo_calib.calibration.diagnostics import gates, likely_mistakes
from diffeo_calib.calibration.diagnostics.plausibility import marker_column, unmeasured_markers
from diffeo_calib.calibration.identification.registration import register_sockets, registered_geometry, spread
from diffeo_calib.calibration.placing.readings import images_error, resting_rows, rough_error
from diffeo_calib.cli import guesses
from diffeo_calib.cli.column_names import column
from diffeo_calib.cli.declarations import REASONS, FitOptions
from diffeo_calib.cli.options import CORNERS
from diffeo_calib.cli.tables import MeasuredTable, described
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import DiffeoCalibError, InputError, MeasurementError, few
from diffeo_calib.measurements.checks import LARGEST_JOINT_ANGLE_RAD, quiet
from diffeo_calib.measurements.csv.columns import JointExpressions
from diffeo_calib.measurements.csv.sensors import CAMERA, IMAGE, PIXEL, POINT
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import ALL_CONVENTIONS, BESIDE, UNITS_PER_METRE, numbers_of
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.kinds import check_poses, measured_positions

CLEAR_RATIO = 5.0  # a way is clear if every other one leaves more by this factor
LARGEST_RESIDUAL = 0.1  # median residual, as a share of the spread, above which no way is right
MOST_SESSIONS = 6
DOUBTFUL = 0.01
"""Share of what the rows vary, left by the best units, above which other meanings of the joints are sought."""
SMALLEST_PART = 0.1  # of a joint's limits that a table passes through, in the right unit
MOST_LENGTHS = 2  # units of length, by the size of the robot, with which meanings of the joints are sought
LARGEST_TURN_DEG = 3600.0  # joint values beyond ten turns are no degrees
SAME_JOINTS = 1e-4  # rad or m, by which digits of joint values in two units differ
SMALLEST_SPREAD_M = 1e-9  # of points that never move
LARGEST_DEVIATION = 0.01
"""Median standard deviation of a measured position, m, above which a column holds something else."""
UNITS = "length", "angle", "joint_length", "camera_on_tool"
"""Options that :meth:`Source.in_units` tries, beside how a place is a distance and two angles."""
COLUMNS = "joints", "robot_pose", "position", "marker", "socket", "rotation", "std", "reading", "by", *guesses.NAMED
"""Options that name columns."""


@dataclass(frozen=True)
class Source:
    """One way to read a table, with the reasons for its options."""

    sheet: guesses.Sheet  # the table
    robot: Tree  # whose joints it has, or a machine with its poses
    bodies: Sequence[guesses.Body]  # columns of the places that were measured
    options: FitOptions  # with which `fit` reads it so
    why: Mapping[str, str]  # option -> its reason
    asked: Mapping[str, Mapping[Any, str]] = field(default_factory=dict)  # option -> values to choose from, and reasons
    remarks: tuple[str, ...] = ()

    def into(self, why: Mapping[str, str] | None = None, **options: Any) -> Source:
        """Read the table with other options; what is decided is asked no more."""
        asked = {name: values for name, values in self.asked.items() if name not in options}
        return replace(self, options=replace(self.options, **options), why={**self.why, **(why or {})}, asked=asked)

    def remarking(self, *remarks: str) -> Source:
        """Add remarks."""
        return replace(self, remarks=(*self.remarks, *remarks))

    def asking(self, name: str, values: Mapping[Any, str]) -> Source:
        """Leave an option to the user; of a single value too."""
        return replace(self, asked={**self.asked, name: values})

    def lines(self, folder: Path) -> Iterator[str]:
        """The options but for defaults as entries of a campaign in a folder; comments where the user is to decide."""
        for option in sorted(FitOptions.all(), key=lambda entry: entry.field != "csv"):
            name, value = option.field, getattr(self.options, option.field)
            values = self.asked.get(name, {} if value in (None, option.default) else {"": self.why.get(name, "")})
            for other, why in values.items():
                text = json.dumps(other or _in_folder(name, value, folder), ensure_ascii=False, default=str)
                yield f"{'# ' * (name in self.asked)}{name.replace('_', '-')} = {text}{'  # ' * bool(why)}{why}"
        yield from (f"# {remark}" for remark in self.remarks)

    @property
    def columns(self) -> set[str]:
        """Names that its options hold, of columns and others."""
        used = {IMAGE, *POINT, *PIXEL, CAMERA} if self.options.images else set[str]()
        values = [getattr(self.options, name) for name in COLUMNS] + [[*choices] for choices in self.asked.values()]
        texts = (text for value in values for text in (value if isinstance(value, list) else [value or ""]))
        return used.union(*(re.split("[=,{}]", str(text)) for text in texts))

    @cached_property
    def data(self) -> Any:
        """The rows, of any kinds."""
        reading = [text.replace(guesses.LENS, guesses.SOME_LENS) for text in self.options.reading or ()]
        given = replace(self.options, reading=reading, **dict.fromkeys(BESIDE))
        table = MeasuredTable(self.sheet.path, described(given), "keep")
        return table.rows(self.robot, given.tip or self.robot.tips)

    @cached_property
    def left(self) -> float:
        """Median residual of the nominal robot, as a share of the spread over all rows; infinite if unreadable."""
        with quiet(), suppress(DiffeoCalibError):
            return self.share()
        return inf

    def share(self) -> float:
        """The same; DiffeoCalibError says why the table cannot be read so, or calibrates nothing.

        Of positions of the largest set-up, else of the ball in its socket, of readings or of a camera's image. In a
        wrong unit the residual alone may be small too.
        """
        positions = measured_positions(self.data)
        if positions is None or self.options.rotation:
            check_poses(self.data)
        if positions is not None:
            session = positions.largest_session()
            if (left := likely_mistakes.residual_of(self.robot, session)) == inf:
                what, expected = f"{len(session)} row(s) of '{self.sheet.path}'", "enough for base and markers"
                raise MeasurementError.of(what, expected=expected, fix="measure more rows, at several places")
            return left / max(spread(session.points), SMALLEST_SPREAD_M)
        tables = self.data.parts
        for resting in resting_rows(tables):
            rests = register_sockets(Geometry.nominal(self.robot), resting.q, resting.device)
            ball = rests.positions[resting.device]
            around = float((ball - ball.mean(0)).norm(dim=1).median())
            return float(rests.distances.median()) / around if around > 0.0 else inf
        lengths = [table for table in tables if table.kind != "image"]
        if not lengths:
            return max(images_error(self.robot, table) for table in tables)
        size = float(torch.cat([table.reported.flatten() for table in lengths]).square().mean().sqrt())
        return rough_error(Geometry.nominal(self.robot), lengths) / max(size, SMALLEST_SPREAD_M)

    @property
    def without_length(self) -> bool:
        """Whether no column is a length."""
        return not self.bodies and all(text.endswith(guesses.LENS) for text in self.options.reading or ())

    @property
    def joints(self) -> list[str]:
        """Columns or expressions of the joints."""
        return (self.options.joints or "").split(",")

    @cached_property
    def units(self) -> list[Source]:
        """Ways in all units, the one that leaves the least first."""
        return ranked(self.in_units())

    def positions(self) -> Iterator[tuple[Source, Measurements]]:
        """Ways in all units that can be read, with the positions of the largest set-up; none where there are none."""
        for way in self.units if self.bodies else ():
            measured = None
            with quiet(), suppress(DiffeoCalibError):
                measured = measured_positions(way.data)
            if measured is not None:
                yield way, measured.largest_session()

    def in_units(self, *, slides: bool = False) -> Iterator[Source]:
        """Ways in units of length and angle, and with a camera on the tool; ``slides`` in another unit than lengths."""
        periodic = self.robot.periodic
        lengths = ["mm"] if self.without_length and all(periodic) else list(UNITS_PER_METRE)
        angles = ("rad", "deg") if any(periodic) else ("rad",)
        ways = next((body.spherical for body in self.bodies if body.spherical), ("",))
        places = [[body.written(way) for body in self.bodies] or None for way in ways]
        strokes = [unit for unit in lengths if unit != "um"]  # in which one would stand still
        each = product(lengths, angles, strokes if slides else [None], (False, True)[: 1 + self.options.images], places)
        for length, angle, slide, camera, position in each:
            if slide != length:
                values = zip(UNITS, (length, angle, slide, camera), strict=True)
                yield self.into(**dict(values), position=position)

    def other_units(self) -> list[str]:
        """Columns of joints and positions whose names say other units."""
        turning = [name for name, turns in zip(self.joints, self.robot.periodic, strict=True) if turns]
        lengths = 1 if any(body.spherical for body in self.bodies) else None  # the others are angles
        places = [name for body in self.bodies for name in body.place[:lengths]]
        pairs = *product(turning, (self.options.angle,)), *product(places, (self.options.length,))
        return [name for name, unit in pairs if column(name).unit not in ("", unit)]


def source_of(sheet: guesses.Sheet, robot: Tree, rows: guesses.RowColumns, /, **options: Any) -> Source:
    """The table of a robot, what was measured, and other options."""
    output, report = (Path(sheet.path.stem + end) for end in (".safetensors", ".html"))
    options |= {**sheet.marks, **rows.options, "csv": sheet.path, "output": output, "report": report}
    why = {**REASONS, **rows.why, "csv": "; ".join(["the table", *sheet.notes])}
    why["sep"] = f"{len(sheet.numbers)} columns are numbers with it"
    return Source(sheet, robot, rows.bodies, FitOptions(**options), why, remarks=tuple(rows.left))


def _in_folder(name: str, value: Any, folder: Path) -> Any:
    """A value as it is written: files are relative to the folder; of one in a list that is no position alone."""
    if isinstance(value, list):
        texts = [_in_folder(name, part, folder) for part in value]
        return texts if len(texts) > 1 or name == "position" else texts[0]
    if str(value).startswith(CORNERS) and str(value).endswith(".yaml"):
        return CORNERS + relpath(str(value).removeprefix(CORNERS), folder)
    return relpath(value, folder) if isinstance(value, Path) and name not in ("output", "report") else value


def ranked(ways: Iterable[Source]) -> list[Source]:
    """Ways to read a table, the one that leaves the least first."""
    return sorted(ways, key=lambda way: way.left)


def is_clear(ways: Sequence[Source], ratio: float = CLEAR_RATIO) -> bool:
    """Whether the first way leaves little, and every other one more by this factor."""
    best, *others = ways
    return best.left < LARGEST_RESIDUAL and all(best.left < other.left >= ratio * best.left for other in others)


def percent(share: float, digits: int = 3) -> str:
    """A share in words."""
    return f"{100 * share:.{digits}g} %"


def reason(best: Source, *others: Source) -> str:
    """Why a way is taken, and not others."""
    what = "the nominal robot leaves, of what the rows vary,"
    if best.without_length and best.options.reading:
        what = "images of the nominal robot differ, relative to all rows, by"
    elif best.without_length:
        what = "the nominal robot spreads the ball in a socket, relative to all rows, by"
    least = min((other.left for other in others), default=inf)
    than = f"read in any other way at least {percent(least)}" if least < inf else "the table contradicts any other way"
    return f"{what} {percent(best.left, 2)}{f', {than}' * bool(others)}"


# --- what one search each decides -------------------------------------------------------------------------------------


def with_joint_columns(source: Source, series: Sequence[guesses.JointColumns]) -> Source:
    """The columns of the joints: of those that names do not tell apart those that the nominal robot explains.

    Where it does not tell them apart either, each is a line that the user may choose.
    """
    how = {entry.text: entry.how for entry in series}
    equal, why = [entry.text for entry in series if entry.rank == series[0].rank], ""
    source = source.into(joints=equal[0])
    if len(equal) > 1:
        ways = ranked(way for names in equal for way in source.into(joints=names).in_units())
        best, second = ways[0], next(other for other in ways if other.options.joints != ways[0].options.joints)
        alike = best.options.angle != second.options.angle and inf not in (best.left, second.left)
        alike = alike and torch.allclose(best.data.q, second.data.q, atol=SAME_JOINTS)
        if not alike and not is_clear([best, second], gates.READINGS_TOLD_APART):
            return source.asking("joints", {names: f"uncomment the right line: {how[names]}" for names in equal})
        source, why = source.into(joints=best.options.joints), f"; {reason(best, second)}"
    for entry in (entry for entry in series[:4] if entry.text != source.options.joints):
        why += f"; not {entry.names[0]} to {entry.names[-1]}" + " (commanded)" * bool(entry.rank and entry.rank[0])
    return source.into({"joints": how[source.options.joints or ""] + why})


def with_measured(source: Source) -> Source:
    """Without markers that are copies, or that the nominal robot explains in some units and others not.

    With the column that names the marker of each row, if the nominal robot explains the rows by several alone, or some
    lines have no joint values.
    """
    if names := guesses.marker_of_lines(source.sheet, source.joints):
        why = "names the marker of each line: the first line alone of every pose holds its joint values"
        return source.into({"marker": why}, marker=names)
    several, tips = len(source.bodies) > 1, source.options.tip or ()
    of_each = (unmeasured_markers(source.robot, rows) for _, rows in source.positions() if several)
    proved = ({marker: words for marker, words, sure in every if sure} for every in of_each)
    copies = next(filter(None, proved), dict[int, str]())
    if several and not copies and len(tips) < 2:  # perhaps in units of their own
        alone = [replace(source, bodies=[own]).into(position=[own.written("")]).units[0].left for own in source.bodies]
        far = max(alone)
        for k, left in enumerate(alone) if gates.DIGITS_SHARE < far < LARGEST_RESIDUAL else ():
            if left < min(gates.FOLLOWED * far, gates.NOMINAL_SHARE):
                copies[k] = f"the nominal robot leaves {percent(left)} of them, and {percent(far)} of others: computed"
    if copies:
        kept = [k for k in range(len(source.bodies)) if k not in copies]
        left = [f"{few(source.bodies[k].place)}: {words} (counted from 0); not used" for k, words in copies.items()]
        source = replace(source, bodies=[source.bodies[k] for k in kept]).remarking(*left)
        why = f"{len(kept)} marker(s), by their names"
        source = source.into({"position": why}, position=[body.written() for body in source.bodies])
        source = source.into(tip=[tips[k] for k in kept]) if len(tips) > 1 else source
    others = source.options.socket or source.options.reading or source.options.marker
    alone = len(source.bodies) == 1 and not others
    ways = list(source.positions()) if alone else []
    for _, data in ways[:1] if is_clear(source.units) else ways:
        with quiet(), suppress(DiffeoCalibError):
            mixed = marker_column(registered_geometry(source.robot, data.q, data.points), data)
            if mixed is not None:
                return source.into({"marker": f"names the marker of each row: {mixed[1]}"}, marker=mixed[0])
    return source


def with_units(source: Source, *, seeks: bool = True) -> Source:
    """In units, and with a meaning of the joints' columns, with which the nominal robot explains the rows.

    Args:
        seeks: whether other meanings are sought, which takes long, where the columns as they are explain too little.

    Raises:
        InputError: none of them, or several. MeasurementError: rows that calibrate nothing.
    """
    periodic, why, ways = source.robot.periodic, "", source.units
    if not all(periodic) and (ways[0].left > DOUBTFUL or not is_clear(ways)):
        others = ranked([*ways, *source.in_units(slides=True)])
        ways = others if is_clear(others) else ways
    if ways[0].left >= DOUBTFUL and (moved := _in_sessions(source)) is not None:
        return with_units(moved)
    if not all(periodic) and not is_clear(ways):  # slides and places in another unit are another size of the machine
        slides = ~torch.tensor(periodic, dtype=torch.bool, device=HOST)
        low, high = source.robot.limits[slides].unbind(1)
        values = [(way, way.data.q[:, slides]) for way in ways if way.left < min(DOUBTFUL, CLEAR_RATIO * ways[0].left)]
        inside = [(way, q.amax(0) - q.amin(0)) for way, q in values if bool(((q >= low) & (q <= high)).all())]
        if chosen := [way for way, moved in inside if float((moved / (high - low)).max()) > SMALLEST_PART]:
            ways, why = chosen, ", by the limits of the joints: the numbers leave it open"
    excluded, named = ways[-1].left == inf, [way for way in ways if not way.other_units()]
    if not is_clear(ways) and 0 < len(named) < len(ways) and named[0].left < CLEAR_RATIO * ways[0].left:
        ways, why = named, ", by the names of the columns: the numbers leave it open" + why
    best, clear = ways[0], is_clear(ways)
    near = [way for way in ways if way.left < CLEAR_RATIO * best.left]
    lengths = {way.options.length or "": "the robot explains the rows in each: uncomment the unit" for way in near}
    if not clear and best.left < DOUBTFUL and len(lengths) == len(near) and all(periodic):  # axes through one point
        return best.into({"angle": reason(best)}).asking("length", lengths)
    if not clear and (turned := with_rotation(source, camera=True)) is not source:
        return turned
    if best.left == inf:
        best.share()  # says why
    doubtful = best.left >= DOUBTFUL and any(periodic)
    if doubtful and not seeks:
        raise InputError("the robot does not explain the joints as they are.")
    if doubtful and (meant := _with_meanings(best)) is not best:
        return meant
    if not clear:
        raise _unclear(ways, excluded=excluded)
    why = reason(*ways) + why
    if source.without_length and all(periodic):
        return best.into({"length": "of lengths that you add: the table holds none", "angle": why})
    return best.into({"length": why})


def _in_sessions(source: Source) -> Source | None:
    """With a column of texts as the set-ups of the device, in each of which the robot explains the rows."""
    cells = source.sheet.cells if source.bodies and source.options.session is None else {}
    texts = (name for name in cells if name not in (*source.sheet.numbers, *source.joints))
    for name in (name for name in texts if 1 < len({*cells[name]}) <= MOST_SESSIONS):
        way = source.into({"session": "in each of its set-ups the robot explains the rows, not in all"}, session=name)
        if way.units[0].left < DOUBTFUL:
            return way
    return None


def _unclear(ways: Sequence[Source], *, excluded: bool) -> InputError:
    """None of the ranked ways in units is right, or several are; with what may be the reason."""
    parts = [way for way in ways if way.left < inf]

    def words(way: Source) -> str:
        written = (way.options.position or [""])[0].rpartition("=")[0]
        values = [getattr(way.options, name) for name in ("length", "angle", "joint_length")]
        return " and ".join(filter(None, [*values, written, "camera on the tool" * way.options.camera_on_tool]))

    got = "; ".join(f"{words(way)}: {percent(way.left)}" for way in parts)
    got += "; the units that the file states exclude others" * excluded
    fix = ""
    if ways[0].bodies and not (ways[0].options.socket or ways[0].options.reading):
        fix = "no signs, zeros, coupling or units of the joints do either: "
    fix += "check the table's joints against the robot's, or write the file yourself; of a robot with several tips "
    fix += "the columns of each are to be named after it, such as left_x"
    for way in (source for source in parts if source.options.angle == "deg"):
        largest = zip(way.joints, way.robot.periodic, way.data.q.abs().amax(0).rad2deg().tolist(), strict=True)
        if far := {name: most for name, turns, most in largest if turns and most > LARGEST_TURN_DEG}:
            got = f"up to {max(far.values()):.4g} in {few([*far])}: no angles, but pulses or ticks of encoders"
            fix = f'write joints = "360/COUNTS*{{{next(iter(far))}}},..." with the counts per turn of each axis, as '
            fix += "the controller states them, negative where it counts the other way"
            return InputError.of("columns of the joints", expected="rad or deg", got=got, fix=fix)
    for way, data in _of_one_size(ways[0]):
        mistakes = [group for group in likely_mistakes.EVERY_GROUP if group is not likely_mistakes.other_conventions]
        fix = likely_mistakes.likely_mistake(way.robot, data, way.left * spread(data.points), mistakes) or fix
        third = len(data) // 3
        for name, rows in (("first", range(third)), ("last", range(len(data) - third, len(data)))):
            part = data.rows(list(rows))
            left = likely_mistakes.residual_of(way.robot, part) / max(spread(part.points), SMALLEST_SPREAD_M)
            if left < DOUBTFUL:
                got += f"; the {name} {third} rows alone, {way.options.length} and {way.options.angle}: {percent(left)}"
                fix = "if the device moved between rows, name its set-ups in a column, `session`"
    what = "units with which the robot explains what the rows vary"
    return InputError.of(what, expected="one clear reading", got=f"left unexplained {got}", fix=fix)


def _of_one_size(source: Source) -> list[tuple[Source, Measurements]]:
    """Ways in units in which robot and positions are of one size, the likeliest first."""
    turning = torch.tensor(source.robot.periodic, dtype=torch.bool, device=HOST)
    likely = dict[str, tuple[float, Source, Measurements]]()
    for way, data in sorted(source.positions(), key=lambda pair: pair[0].options.angle != "rad"):
        small = bool((data.q[:, turning].abs() < LARGEST_JOINT_ANGLE_RAD).all())
        moved = spread(source.robot.tip_poses(data.q)[:, :1, :3, 3]), spread(data.points)
        if (way.options.angle == "deg" or small) and min(moved) > 0.0:
            likely.setdefault(way.options.length or "", (abs(log(moved[0] / moved[1])), way, data))
    return [(way, data) for _, way, data in sorted(likely.values(), key=lambda entry: entry[0])[:MOST_LENGTHS]]


def _with_meanings(best: Source) -> Source:
    """With units and `joints` with which the robot explains positions; in the best units as they are if there are none.
    Of several places each alone too: the robot's own may be beside the measured ones.
    """
    if best.options.socket or best.options.reading:
        return best
    several = len(best.bodies) > 1 and len(best.options.tip or ()) < 2
    alone = [replace(best, bodies=[own]).into(position=[own.written()]) for own in best.bodies if several]
    for way, data in (pair for part in (best, *alone) for pair in _of_one_size(part)):
        units = way.options.angle or "", UNITS_PER_METRE[way.options.length or ""]
        meanings, joints = likely_mistakes.conventions_of(best.robot, data, units[0]), JointExpressions.of(best.joints)
        if not meanings:
            continue
        meant, more = dict[str, str](), "; these rows do not tell which: uncomment one" * (len(meanings) > 1)
        for meaning in meanings:
            text = ",".join(meaning.of_columns(joints.matrix, joints.offset, *units).texts(joints.columns, *units))
            why = f"the nominal robot then leaves {percent(meaning.left, 2)} of what the rows vary, with the columns "
            meant[text] = f"{why}as they are {percent(best.left)}{more}"
        places = (best if len(way.bodies) < len(best.bodies) else way).options.position
        whole = replace(way, bodies=best.bodies).into({"length": "with these joints"}, position=places)
        text = next(iter(meant))
        for points in data.bodies.mirrored(data):  # of a robot with a plane of symmetry the signs of axes do the same
            reading = likely_mistakes.Reading.of(way.robot, data)._replace(points=points)
            if (left := likely_mistakes.registered(reading)[0] / spread(points)) < DOUBTFUL:
                why = f"in a left-handed frame, which leaves {percent(left)}: exchange two columns of the places too"
                meant = {best.options.joints or "": f"{why}; uncomment one"} | meant
        explained = with_measured(whole.into({"joints": meant[text]}, joints=text))  # only now
        return explained.asking("joints", meant) if len(meant) > 1 else explained
    return best


def with_rotation(source: Source, *, camera: bool = False) -> Source:
    """In the convention with which the nominal robot explains the poses clearly better than with all others.

    With ``camera`` in any units too, as poses of a fixed board in the frame of a camera on the tool. The same if there
    are no columns of a rotation; with a remark, but for a camera, if no convention is clearly better.
    """
    bodies = source.bodies
    turned = [body for body in bodies if body.turn]
    if not turned or source.options.marker is not None:
        return source
    numbers = len(turned[0].turn)
    own_body = len(bodies) == max(len(source.options.tip or ()), 1) == len(turned)
    conventions = [name for name in ALL_CONVENTIONS if numbers_of(name) == numbers] if own_body else []
    if numbers == 4 and all(column(body.turn[3]).words[-1].endswith("w") for body in turned):
        conventions = ["quat_xyzw"]  # so the names say
    turns = list(product(conventions, ("deg", "rad") if numbers == 3 else (None,)))
    given = {"rotation": [",".join(body.turn) for body in turned], "camera_on_tool": camera}
    units = source.in_units() if camera else [source]
    ways = ranked(way.into(**given, convention=c, rotation_angle=d) for way in units for c, d in turns)
    if not ways or not is_clear(ways, gates.READINGS_TOLD_APART):
        what = "rotations of no convention that is clearly better than others"
        what = what if own_body else "rotations, but not one for each marker"
        names = [name for body in turned for name in body.turn]
        remark = f"{few(names, 9)}: {what}; not used"
        return source if camera else source.remarking(remark)
    why = {"convention": reason(*ways)}
    if camera:
        why["length"] = why["convention"]
        why["camera_on_tool"] = "the nominal robot explains poses of a fixed board alone, seen from the tool"
    return ways[0].into(why)


def with_deviations(source: Source) -> Source:
    """With standard deviations of the positions, or a remark why there are none."""
    names = guesses.guess_deviations(source.sheet.numbers, [body.place for body in source.bodies])
    if names is None:
        return source
    weighted, measured = source.into(std=",".join(names)), None
    with quiet(), suppress(DiffeoCalibError):
        measured = measured_positions(weighted.data)
    if measured is None or measured.std is None or (typical := float(measured.std.nanmedian())) > LARGEST_DEVIATION:
        return source.remarking(f"{few(names)}: no standard deviations of positions, or not all positive; not used")
    why = f"by their names; median {1e3 * typical:.2g} mm, noise beyond these is estimated"
    return weighted.into({"std": why})


def with_distances(source: Source) -> Source:
    """With known distances between the sockets that a column names, for the user to complete: no table holds them."""
    if source.options.socket is None:
        return source
    sockets, unit = source.options.socket.rpartition(",")[2], source.options.length or ""
    names = list(dict.fromkeys(filter(None, source.sheet.cells[sockets])))
    if len(names) < 2:
        return source.remarking("there is one socket alone, and no distance to know: the URDF gives the robot's size")
    length, deviation = (f"{metres * UNITS_PER_METRE[unit]:g}" for metres in (0.05, 3e-5))
    why = f"measure it, in {unit}, and uncomment: it gives the robot its size"
    source = source.asking("distance", {f"{names[0]},{names[1]}={length}": why})
    return source.asking("distance_std", {float(deviation): f"how well it is known, in {unit}: so well with a caliper"})
