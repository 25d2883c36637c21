"""Ways to read a table, each with what it leaves unexplained: `diffeo-calib init` proposes the best, if it is clear.

A search of `init` makes ways (columns, units, conventions, meanings of joints), puts the one that leaves the least
first, and takes it where all others leave far more; else it asks the user, or says why the table tells nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import inf, log
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates, likely_mistakes
from diffeo_calib.calibration.diagnostics.plausibility import marker_column, unmeasured_markers
from diffeo_calib.calibration.identification.registration import register, register_sockets, spread
from diffeo_calib.calibration.placing.readings import rough_error
from diffeo_calib.calibration.placing.sockets import resting_rows
from diffeo_calib.cli.column_names import WORDS, Column, column
from diffeo_calib.cli.guesses import (
    LENS,
    SOME_LENS,
    Choice,
    JointColumns,
    RowColumns,
    Sheet,
    entries,
    marker_of_lines,
)
from diffeo_calib.cli.options import Rows
from diffeo_calib.cli.tables import readings_columns
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import DiffeoCalibError, InputError, MeasurementError, few
from diffeo_calib.measurements.checks import LARGEST_JOINT_ANGLE_RAD, quiet
from diffeo_calib.measurements.csv.files import read_observations
from diffeo_calib.measurements.csv.joints import JointExpressions
from diffeo_calib.measurements.csv.sensors import SocketColumns
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import ALL_CONVENTIONS, UNITS_PER_METRE, TableFormat, numbers_of
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.tables import check_poses, measured_positions

CLEAR_RATIO = 5.0
"""A way is clear if every other one leaves more by this factor."""
LARGEST_RESIDUAL = 0.1
"""Median residual, as a share of the spread, above which no way is right."""
DOUBTFUL = 0.01
"""Share of what the rows vary, left by the best units, above which other meanings of the joints are sought."""
SMALLEST_PART = 0.1
"""Of a joint's limits that a table passes through, in the right unit."""
BALL_SEARCH = {"maxfev": 150, "initial_simplex": [[0.0] * 3, [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]]}
"""Of the ball on the tool by images, m."""
FEWEST_IMAGES = 8
"""Rows of a camera from which a projection, 11 numbers, can be contradicted."""
MOST_LENGTHS = 2
"""Units of length, by the size of the robot, with which meanings of the joints are sought."""
LARGEST_TURN_DEG = 3600.0
"""Joint values beyond ten turns are no degrees."""
SMALLEST_SPREAD_M = 1e-9
"""Of points that never move."""
LARGEST_DEVIATION = 0.01
"""Median standard deviation of a measured position, m, above which a column holds something else."""


@dataclass(frozen=True)
class Source:
    """One way to read a table."""

    sheet: Sheet  # the table
    robot: Tree  # whose ``joints`` columns it has, or a machine with its poses
    joints: Any
    rows: RowColumns  # what was measured
    table: TableFormat  # the format; joints and rows are entered when it is read
    tips: Sequence[str] = ()  # of the markers, where several are
    said: tuple[Choice, ...] = ()  # entries of the campaign that were decided so far

    def into(self, **formats: Any) -> Source:
        """Read the table in another format."""
        return replace(self, table=replace(self.table, **formats))

    def saying(self, *choices: Choice) -> Source:
        """Add entries, in place of those of the same names."""
        names = {choice.name for choice in choices if choice.name}
        return replace(self, said=(*(one for one in self.said if one.name not in names), *choices))

    def value(self, name: str) -> Any:
        """The value of an entry; None where there is none that is sure."""
        return next((choice.value for choice in self.said if choice.name == name and choice.sure), None)

    @cached_property
    def data(self) -> Any:
        """The rows, of any kinds."""
        rows, session = self.rows, self.rows.named.get("session")
        options = Rows(session=session, camera_on_tool=self.table.camera_on_tool)
        table = replace(
            self.table,
            joints=self.joints,
            kinds=self.robot.kinds,
            position=rows.markers or None,
            sockets=SocketColumns(tuple(rows.sockets)) if rows.sockets else None,
            readings=readings_columns([text.replace(LENS, SOME_LENS) for text in rows.readings], options),
            session=session if rows.markers else None,
            marker=self.value("marker"),
            camera_on_tool=self.table.camera_on_tool and not rows.of_boards,  # it is said of the corners
        )
        data: Any = read_observations(self.sheet.path, table, duplicates="keep")
        data = data.with_joint_names(self.robot.joint_names)
        return data.with_tips(self.tips) if self.tips else data

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
        if positions is None or self.table.rotation is not None:
            check_poses(self.data)
        if positions is not None:
            own = positions.largest_session()
            if (left := likely_mistakes.residual_of(self.robot, own)) == inf:
                what, expected = (
                    f"{len(own)} row(s) of '{self.sheet.path}'",
                    "enough for base and markers, at several places",
                )
                raise MeasurementError.of(what, expected=expected, fix="measure more rows")
            return left / max(spread(own.points), SMALLEST_SPREAD_M)
        tables = self.data.parts
        if (resting := resting_rows(tables)) is not None:
            rests = register_sockets(self.robot, resting.q, resting.device)
            ball = rests.positions[resting.device]
            around = float((ball - ball.mean(0)).norm(dim=1).median())
            return float(rests.distances.median()) / around if around > 0.0 else inf
        lengths = [one for one in tables if one.kind != "image"]
        if not lengths:
            return max(_in_images(self.robot, one) for one in tables)
        size = float(torch.cat([one.reported.flatten() for one in lengths]).square().mean().sqrt())
        return rough_error(Geometry.nominal(self.robot), lengths) / max(size, SMALLEST_SPREAD_M)

    def positions(self) -> Iterator[tuple[Source, Measurements]]:
        """Ways in all units that can be read, with the positions of the largest set-up; none where there are none."""
        for one in self.in_units() if self.rows.markers else ():
            found = None
            with quiet(), suppress(DiffeoCalibError):
                found = measured_positions(one.data)
            if found is not None:
                yield one, found.largest_session()

    def in_units(self, *, slides: bool = False) -> Iterator[Source]:
        """Ways in units of length and angle, and with a camera on the tool; ``slides`` in another unit than lengths."""
        no_length = self.rows.without_length and all(self.robot.periodic)
        lengths = ["mm"] if no_length else list(UNITS_PER_METRE)
        angles = ("rad", "deg") if any(self.robot.periodic) else ("rad",)
        cameras = (False, True) if self.rows.of_boards else (False,)
        ways = next((own.spherical for own in self.rows.bodies if own.spherical), (None,))
        own = product(lengths, angles, lengths if slides else [None], cameras, ways)
        for length, angle, slide, camera, way in own:
            if slide != length:
                units = {"length": length, "angle": angle, "joint_length": slide}
                yield self.into(**units, camera_on_tool=camera, spherical=way)

    def other_units(self) -> list[str]:
        """Columns of joints and positions whose names say other units."""
        turning = [name for name, turns in zip(self.joints, self.robot.periodic, strict=True) if turns]
        lengths = 1 if self.table.spherical else None  # the others are angles
        places = [name for triple in self.rows.markers for name in triple[:lengths]]
        pairs = *product(turning, (self.table.angle,)), *product(places, (self.table.length,))
        return [name for name, unit in pairs if column(name).unit not in ("", unit)]


def ranked(ways: Iterable[Source]) -> list[Source]:
    """Ways to read a table, the one that leaves the least first."""
    return sorted(ways, key=lambda one: one.left)


def is_clear(found: Sequence[Source], ratio: float = CLEAR_RATIO) -> bool:
    """Whether the first way leaves little, and every other one more by this factor."""
    best, *others = found
    return best.left < LARGEST_RESIDUAL and all(one.left >= ratio * best.left for one in others)


def percent(share: float, digits: int = 3) -> str:
    """A share in words."""
    return f"{100 * share:.{digits}g} %"


def _in_images(robot: Tree, data: Readings) -> float:
    """Median distance of images from projections of the tool, as a share of their spread.

    The ball on the tool is sought; lens and place of each camera are those of the best projection P, linear in its 12
    numbers: P z ~ (u, v, 1).
    """
    from scipy.optimize import minimize  # noqa: PLC0415  # slow to import

    poses = robot(data.q)
    rows = [data.device == device for device in range(len(data.names))]
    if min(int(own.sum()) for own in rows) < FEWEST_IMAGES:
        return inf

    def share(ball: Any) -> float:
        at = poses[:, :3, :3] @ poses.new_tensor(ball) + poses[:, :3, 3]
        return max(_projection_error(at[own], data.reported[own]) for own in rows)

    return float(minimize(share, [0.0] * 3, method="Nelder-Mead", options=BALL_SEARCH).fun)


def _projection_error(points: Tensor, image: Tensor) -> float:
    """Median distance of images (N, 2) from the best projection of points (N, 3), as a share of their spread."""
    at = torch.cat([(points - points.mean(0)) / points.std(), torch.ones_like(points[:, :1])], 1)
    seen = (image - image.mean(0)) / image.std()
    matrix = [torch.cat([at * (k == 0), at * (k == 1), -seen[:, k : k + 1] * at], 1) for k in range(2)]
    shown = at @ torch.linalg.svd(torch.cat(matrix), full_matrices=False).Vh[-1].view(3, 4).mT
    return float((shown[:, :2] / shown[:, 2:] - seen).norm(dim=1).median() / seen.norm(dim=1).median())


# --- what one search each decides -------------------------------------------------------------------------------------


def with_joint_columns(source: Source, found: Sequence[JointColumns]) -> Source:
    """The columns of the joints: of those that names do not tell apart those that the nominal robot explains.

    Where it does not tell them apart either, a remark for each asks the user.
    """
    equal, taken, why = [one for one in found if one.rank == found[0].rank], found[0], ""
    if len(equal) > 1:
        ways = [min(own.left for own in replace(source, joints=one.names).in_units()) for one in equal]
        (least, best), (second, _), *_ = sorted(zip(ways, range(len(ways)), strict=True))
        if not 0 < least < LARGEST_RESIDUAL or second < gates.READINGS_TOLD_APART * least:
            why = "uncomment the right line"
            lines = (Choice("joints", ",".join(one.names), f"{why}: {one.how}", sure=False) for one in equal)
            return replace(source, joints=taken.names).saying(*lines)
        taken, why = equal[best], f"; the nominal robot explains them {second / least:.3g} times better"
    for one in (one for one in found[:4] if one is not taken):
        why += f"; not {one.names[0]} to {one.names[-1]}" + " (commanded)" * bool(one.rank and one.rank[0])
    return replace(source, joints=taken.names).saying(Choice("joints", ",".join(taken.names), taken.how + why))


def with_measured(source: Source) -> Source:
    """Without markers that are copies, or that the nominal robot explains in some units and others not.

    With the column that names the marker of each row, if the nominal robot explains the rows by several alone, or some
    lines have no joint values.
    """
    if names := marker_of_lines(source.sheet, source.joints):
        why = "names the marker of each line: the first line alone of every pose holds its joint values"
        return source.saying(Choice("marker", names, why))
    rows, found = source.rows, dict[int, str]()
    for _, data in source.positions() if len(rows.bodies) > 1 else ():
        every = unmeasured_markers(source.robot, data)
        found = found or {marker: words for marker, words, proved in every if proved}
    if not found and len(rows.bodies) > 1 and not source.tips:  # perhaps in units of their own
        each = (replace(source, rows=replace(rows, bodies=[own])) for own in rows.bodies)
        alone = [min(one.left for one in own.in_units()) for own in each]
        far = max(alone)
        for k, left in enumerate(alone) if gates.DIGITS_SHARE < far < LARGEST_RESIDUAL else ():
            if left < min(gates.FOLLOWED * far, gates.NOMINAL_SHARE):
                found[k] = f"the nominal robot leaves {percent(left)} of them, and {percent(far)} of others: computed"
    kept = [k for k in range(len(rows.bodies)) if k not in found]
    left = [f"{few(rows.markers[k])}: {words} (counted from 0)" for k, words in found.items()]
    rows = replace(rows, bodies=[rows.bodies[k] for k in kept], left=[*rows.left, *left])
    source = replace(source, rows=rows, tips=[source.tips[k] for k in kept] if source.tips else source.tips)
    alone = len(rows.bodies) == 1 and not (rows.sockets or rows.readings or source.value("marker"))
    for _, data in source.positions() if alone else ():
        with quiet(), suppress(DiffeoCalibError):
            several = marker_column(register(source.robot, data.q, data.points).geometry, data)
            if several is not None:
                why = f"names the marker of each row: {several[1]}"
                return source.saying(Choice("marker", several[0], why))
    return source


def with_units(source: Source) -> Source:
    """In units, and with a meaning of the joints' columns, with which the nominal robot explains the rows.

    Raises:
        InputError: none of them, or several. MeasurementError: rows that calibrate nothing.
    """
    periodic, why = source.robot.periodic, ""
    found = ranked(source.in_units())
    if not all(periodic) and (found[0].left > DOUBTFUL or not is_clear(found)):
        others = ranked([*found, *source.in_units(slides=True)])
        found = others if is_clear(others) else found
    if not any(periodic):  # all lengths in another unit are another size, which the rows do not show
        low, high = source.robot.limits.unbind(1)
        values = [(one, one.data.q) for one in found if one.left < inf]
        inside = [(one, q.amax(0) - q.amin(0)) for one, q in values if bool(((q >= low) & (q <= high)).all())]
        if chosen := [one for one, moved in inside if float((moved / (high - low)).max()) > SMALLEST_PART]:
            found, why = chosen, ", by the limits of the joints: the numbers leave it open"
    excluded, named = found[-1].left == inf, [one for one in found if not one.other_units()]
    if not is_clear(found) and 0 < len(named) < len(found) and named[0].left < CLEAR_RATIO * found[0].left:
        found, why = named, ", by the names of the columns: the numbers leave it open" + why
    best, clear = found[0], is_clear(found)
    if not clear and (seen := with_rotation(source, camera=True)) is not source:
        return seen
    if best.left == inf:
        best.share()  # says why
    if best.left >= DOUBTFUL and any(periodic) and (meant := _with_meanings(best)) is not best:
        return meant
    if not clear:
        raise _unclear(found, excluded=excluded)
    what = "the nominal robot leaves, of what the rows vary,"
    if source.rows.without_length and source.rows.readings:
        what = "images of the nominal robot differ, relative to all rows, by"
    elif source.rows.without_length:
        what = "the nominal robot spreads the ball in a socket, relative to all rows, by"
    others = found[1].left if len(found) > 1 else inf
    than = f"in other units at least {percent(others)}" if others < inf else "the table contradicts other units"
    why = f"{what} {percent(best.left, 2)}, {than}{why}"
    no_length = source.rows.without_length and all(periodic)
    length, angle = ("of lengths that you add: the table holds none", why) if no_length else (why, "the same")
    others = {"joint_length": "the same: the slides are in another unit"}
    others["camera_on_tool"] = "the same; else the board is on the tool"
    return best.saying(*entries([best.table], length=length, angle=angle, **others))


def _unclear(found: Sequence[Source], *, excluded: bool) -> InputError:
    parts = [(one.left, one.table) for one in found if one.left < inf]
    words = (
        (t.length, t.angle, t.joint_length, t.spherical, "camera on the tool" * t.camera_on_tool) for _, t in parts
    )
    each = zip((" and ".join(filter(None, own)) for own in words), parts, strict=True)
    got = "; ".join(f"{own}: {percent(left)}" for own, (left, _) in each)
    got += "; the units that the file states exclude others" * excluded
    rows, fix = found[0].rows, ""
    if rows.markers and not (rows.sockets or rows.readings):
        fix = "no signs, zeros, coupling or units of the joints do either: "
    fix += "check the table's joints against the robot's, or write the file yourself; of a robot with several tips "
    fix += "the columns of each are to be named after it, such as left_x"
    for one in (own for own in found if own.table.angle == "deg" and own.left < inf):
        largest = zip(one.joints, one.robot.periodic, one.data.q.abs().amax(0).rad2deg().tolist(), strict=True)
        if far := {name: most for name, turns, most in largest if turns and most > LARGEST_TURN_DEG}:
            got = f"up to {max(far.values()):.4g} in {few([*far])}: no angles, but pulses or ticks of encoders"
            fix = f'write joints = "360/COUNTS*{{{next(iter(far))}}},..." with the counts per turn of each axis, as '
            fix += "the controller states them, negative where it counts the other way"
            return InputError.of("columns of the joints", expected="rad or deg", got=got, fix=fix)
    for one, own in _of_one_size(found[0]):
        fix = likely_mistakes.likely_mistake(one.robot, own, one.left * spread(own.points)) or fix
        third = len(own) // 3
        for name, rows in (("first", range(third)), ("last", range(len(own) - third, len(own)))):
            part = own.rows(list(rows))
            left = likely_mistakes.residual_of(one.robot, part) / max(spread(part.points), SMALLEST_SPREAD_M)
            if left < DOUBTFUL:
                got += f"; the {name} {third} rows alone, {one.table.length} and {one.table.angle}: {percent(left)}"
                fix = "if the device moved between rows, name its set-ups in a column, `session`"
    what = "units with which the robot explains what the rows vary"
    return InputError.of(what, expected="one clear reading", got=f"left unexplained {got}", fix=fix)


def _of_one_size(source: Source) -> list[tuple[Source, Measurements]]:
    """Ways in units in which robot and positions are of one size, the likeliest first."""
    turning = torch.tensor(source.robot.periodic, dtype=torch.bool, device=HOST)
    likely = dict[str, tuple[float, Source, Measurements]]()
    for one, own in source.positions():
        small = bool((own.q[:, turning].abs() < LARGEST_JOINT_ANGLE_RAD).all())
        moved = spread(source.robot.tip_poses(own.q)[:, :1, :3, 3]), spread(own.points)
        if (one.table.angle == "deg" or small) and min(moved) > 0.0:
            likely.setdefault(one.table.length, (abs(log(moved[0] / moved[1])), one, own))
    return [(one, own) for _, one, own in sorted(likely.values(), key=lambda entry: entry[0])[:MOST_LENGTHS]]


def _with_meanings(best: Source) -> Source:
    """With the units and the `joints` with which the robot explains positions; the same if there are none.

    Args:
        best: in the best units with the columns as they are.
    """
    if best.rows.sockets or best.rows.readings:
        return best
    for one, data in _of_one_size(best):
        units = one.table.angle, UNITS_PER_METRE[one.table.length]
        found, joints = likely_mistakes.conventions_of(best.robot, data, units[0]), JointExpressions.of(best.joints)
        if not found:
            continue
        said, more = list[Choice](), "; these rows do not tell which: uncomment one" * (len(found) > 1)
        for meaning in found:
            own = meaning.of_columns(joints.matrix, joints.offset, *units)
            why = f"the nominal robot then leaves {percent(meaning.left, 2)} of what the rows vary, with the columns "
            why += f"as they are {percent(best.left)}{more}"
            said.append(Choice("joints", ",".join(own.texts(joints.columns, *units)), why, sure=len(found) == 1))
        said += entries([one.table], length="with these joints", angle="the same")
        names = str(said[0].value).split(",") if said[0].sure else best.joints
        return with_measured(replace(one, joints=names).saying(*said))  # the robot explains the rows only now
    return best


def with_rotation(source: Source, *, camera: bool = False) -> Source:
    """In the convention with which the nominal robot explains the poses clearly better than with all others.

    With ``camera`` in any units too, as poses of a fixed board in the frame of a camera on the tool. The same if there
    are no columns of a rotation; with a remark, but for a camera, if no convention is clearly better.
    """
    bodies = source.rows.bodies
    found = [own for own in bodies if own.turn]
    if not found or source.value("marker") is not None:
        return source
    each = [own.turn for own in found]
    own_body = len(bodies) == max(len(source.tips), 1) == len(each)
    conventions = [name for name in ALL_CONVENTIONS if numbers_of(name) == len(each[0])] if own_body else []
    turns = list(product(conventions, ("deg", "rad") if len(each[0]) == 3 else (None,)))
    units = source.in_units() if camera else [source]
    known = {"rotation": each[0] if len(each) == 1 else each, "camera_on_tool": camera}
    ways = ranked(one.into(**known, convention=c, rotation_angle=d) for one in units for c, d in turns)
    if not ways or not is_clear(ways, gates.READINGS_TOLD_APART):
        what = "rotations of no convention that is clearly better than others"
        what = what if own_body else "rotations, but not one for each marker"
        usual, names = " or ".join(dict.fromkeys(own.usual for own in found)), [name for own in each for name in own]
        remark = Choice("", "", f"{few(names, 9)}: {what}; not used; such names usually mean {usual}")
        return source if camera else source.saying(remark)
    best, *worse = ways
    why = f"the nominal robot leaves, of what the rows vary, {percent(best.left, 2)}"
    why += f", read in any other way at least {percent(worse[0].left)}" if worse and worse[0].left < inf else ""
    written = [",".join(own) for own in each]
    units = {"length": why, "angle": "the same"} if camera else {}
    units |= {"camera_on_tool": "the nominal robot explains poses of a fixed board alone, seen from the tool"}
    alone = "by their names; without these three lines positions alone are calibrated"
    turned = Choice("rotation", written[0] if len(written) == 1 else written, alone)
    turn = entries([best.table], convention=why, rotation_angle="the same")
    return best.saying(*entries([best.table], **units), turned, *turn)


def guess_deviations(columns: Sequence[str], triples: Sequence[Sequence[str]]) -> list[str] | None:
    """Columns whose names are those of the positions but for a word such as std, in their order; None if one lacks."""
    deviations = [one for one in map(column, columns) if {*one.words} & WORDS["deviation"]]
    known = {_without(one, WORDS["deviation"]): one.name for one in deviations}
    known |= {_without(one, WORDS["deviation"] | WORDS["measured"]): one.name for one in deviations}
    wanted = [column(name) for triple in triples for name in triple]
    found = [known.get(one.plain) or known.get(_without(one, WORDS["measured"])) for one in wanted]
    return None if None in found else [name for name in found if name is not None]


def _without(one: Column, words: frozenset[str]) -> str:
    return "".join(word for word in one.words if word not in words)


def with_deviations(source: Source) -> Source:
    """With standard deviations of the positions, or a remark why there are none."""
    names = guess_deviations(source.sheet.numbers, source.rows.markers)
    if names is None:
        return source
    found = None
    with quiet(), suppress(DiffeoCalibError):
        found = measured_positions(source.into(std=names).data)
    if found is None or found.std is None or (typical := float(found.std.nanmedian())) > LARGEST_DEVIATION:
        remark = f"{few(names)}: no standard deviations of positions, or not all positive; not used"
        return source.saying(Choice("", "", remark))
    why = f"by their names; median {1e3 * typical:.2g} mm, noise beyond these is estimated"
    return source.saying(Choice("std", ",".join(names), why))


def with_distances(source: Source, sockets: str) -> Source:
    """With known distances between the sockets that a column names, for the user to complete: no table holds them."""
    names, unit = list(dict.fromkeys(filter(None, source.sheet.cells[sockets]))), source.table.length
    if len(names) < 2:
        remark = "there is one socket alone, and no distance to know: the URDF gives the robot's size"
        return source.saying(Choice("", "", remark))
    length, deviation = (f"{metres * UNITS_PER_METRE[unit]:g}" for metres in (0.05, 3e-5))
    why = f"measure it, in {unit}, and uncomment: it gives the robot its size"
    remark = f"distance-std = {deviation}  # how well it is known, in {unit}: so well with a caliper"
    asked = Choice("distance", [f"{names[0]},{names[1]}={length}"], why, sure=False)
    return source.saying(asked, Choice("", "", remark))
