"""How a table seems to be written, and what its columns hold, by their names: what `diffeo-calib init` starts from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, permutations, product
from math import pi
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.cameras.files import read_camera
from diffeo_calib.cli.column_names import WORDS, Column, Group, column, groups, mixed_names, of_places, whole
from diffeo_calib.cli.options import CORNERS, Places
from diffeo_calib.common.errors import InputError, MeasurementError, few
from diffeo_calib.measurements.csv.cells import LARGEST_NUMBER, bad_cells, number, number_hint, numbers_in
from diffeo_calib.measurements.csv.joined import SEPARATORS, joined_file
from diffeo_calib.measurements.csv.lines import HEAD, LENGTHS, CsvLines, read_cells
from diffeo_calib.measurements.csv.sensors import CAMERA, IMAGE, PIXEL, POINT
from diffeo_calib.measurements.readings import MILLIMETRES
from diffeo_calib.measurements.table_format import SPHERICAL, SPHERICAL_UNITS, UNITS_PER_METRE, ZERO
from diffeo_calib.sensors.kinds import known_kinds

DECIMALS = (".", ",")
ROWS_LOOKED_AT = 50
SAME_SHARE = 1e-3  # of the largest number, by which digits of one place in two units differ
LENS, SOME_LENS = "FX,FY,CX,CY", "1000,1000,500,500"
"""Placeholder for the user to fill in, and the value that replaces it while the other rows are read."""

DRIFT = "a drift with it is sought, and kept where left-out rows prove it"
NAMED = {
    "session": ("session setup station anchor device plane aufstellung", "the device, or its set-up, of every row"),
    "payload": ("payload mass load nutzlast traglast carga 负载 負荷", "the known mass that the robot carried"),
    "time": ("time times timeh timestamp seconds minutes hours hour zeit zeits tiempo temps", DRIFT),
    "temperature": ("temperature temp temperaturec tempc temperatur temperatura 温度", DRIFT),
}
"""Option -> names by which a column besides the joints and what was measured is known, and what it holds."""
JOINTS = "q0", "q1"
"""First names of four numbers that are joint values, rather than a quaternion, where they stand before a place."""
PENDANTS = ("base", "shoulder", "elbow", "wrist1", "wrist2", "wrist3"), tuple("slurbt"), tuple("slerubt")
"""Names of joints on the pendants of Universal Robots and Yaskawa, from the base on."""
ROTATIONS = (
    *(("qx", "qy", "qz", "qw"), ("x", "y", "z", "w"), ("q0", "q1", "q2", "q3"), ("q1", "q2", "q3", "q4")),
    *(tuple(f"{row}{k}" for row in index for k in index) for index in ("012", "123")),  # a matrix by rows
    *(("rx", "ry", "rz"), ("x", "y", "z"), ("roll", "pitch", "yaw"), ("a", "b", "c"), ("w", "p", "r"), ("o", "a", "t")),
    *(("euler1", "euler2", "euler3"), ("alpha", "beta", "gamma"), ("phi", "theta", "psi")),
)
"""Labels of the columns of a rotation: quaternions, matrices, rotation vectors and angles, by robots' makers too."""
BY_NO_NAME = "all other columns, in their order"
ENTRIES = [[row + k for row in index for k in index] for index in ("0123", "1234")]
ENTRIES += [[str(k + first) for k in range(16)] for first in (0, 1)] + [labels[:12] for labels in ENTRIES]
"""Labels of the 16 numbers of a pose as a matrix: by row and column, without the last row too, or counted."""


@dataclass(frozen=True)
class Sheet:
    """A table as it seems to be written."""

    path: Path
    sep: str
    decimal: str
    header: tuple[str, ...]  # all columns
    numbers: tuple[str, ...]  # those that hold numbers alone
    notes: tuple[str, ...] = ()  # what the reader decided
    odd: str = ""  # which cells are no numbers in columns that seem to hold some

    @property
    def marks(self) -> dict[str, str]:
        """As options."""
        return {"sep": "tab" if self.sep == "\t" else self.sep, "decimal": self.decimal}

    @cached_property
    def cells(self) -> dict[str, list[str]]:
        """Column -> texts of all rows."""
        header, rows = read_cells(self.path, self.sep)
        return {name: [cells[k].strip() for _, cells in rows] for k, name in enumerate(header)}

    def others(self, count: int) -> list[JointColumns]:
        """So many columns of any names beside those of what was measured; of a rotation if there are too few."""
        with suppress(InputError):
            rows = rows_in(self, [])
            taken = {rows.options[name] for name in NAMED} | {name for body in rows.bodies for name in body.place}
            taken |= {name for names in guess_readings(self.numbers).values() for name in names}
            turned = taken | {name for body in rows.bodies for name in body.turn}
            for used in (turned, taken):
                names = [name for name in self.numbers if name not in used and not _counts(self.cells[name])]
                if len(names) == count:
                    return [JointColumns(names, BY_NO_NAME, ())]
        return []

    def joint_columns(self, joints: Sequence[str]) -> list[JointColumns]:
        """Series that may be the joints; constant columns, of axes that the URDF lacks, count only if needed."""
        varying = [name for name in self.numbers if len({*self.cells[name]}) > 1]
        return guess_joints(self.numbers, joints) or guess_joints(varying, joints)


def guess_sheet(path: Path) -> Sheet:
    """The separator and decimal mark with which most columns are numbers; MeasurementError says why none is right."""
    sheets, reasons = list[Sheet](), list[tuple[int, MeasurementError]]()
    for sep in SEPARATORS:
        width = 0
        try:
            file = CsvLines(path, sep)
            width, rows = len(file.header), file.rows(HEAD)[:ROWS_LOOKED_AT]
        except MeasurementError as error:
            reasons.append((width, error))
            continue
        lines, cells = zip(*rows, strict=True)
        columns = {name: texts for name, *texts in zip(file.header, *cells, strict=True) if name}
        nameless = file.header == [str(k + 1) for k in range(len(columns))]
        held = {name: texts for name, texts in columns.items() if not (nameless and _counts(texts))}
        for decimal in (mark for mark in DECIMALS if mark != sep):
            numbers, odd = list[str](), list[tuple[int, str, str]]()
            for name, texts in held.items():
                each = list(zip(lines, texts, numbers_in(texts, decimal), strict=True))
                wrong = [(line, name, text) for line, text, value in each if value is None]
                large = sum(value is not None and abs(value) >= LARGEST_NUMBER for *_, value in each)
                if not wrong and 2 * large <= len(each):  # of lost ones; dates such as 20210313... are too
                    numbers.append(name)
                elif 2 * len(wrong) < len(each) or number(wrong[0][2], decimal, grouped=True) is not None:
                    odd += wrong  # most are numbers, or they look like numbers
            why = str(bad_cells(path, odd, "a number", number_hint(odd[0][2], decimal))) if odd else ""
            sheets.append(Sheet(path, sep, decimal, tuple(columns), tuple(numbers), tuple(file.notes), why))
    most = max((len(sheet.numbers) for sheet in sheets), default=0)
    likely = [sheet for sheet in sheets if len(sheet.numbers) == most]  # columns may have different decimal marks
    best = max(likely, key=lambda way: sum(way.decimal in "".join(way.cells[k]) for k in way.numbers), default=None)
    width, reason = max(reasons, key=lambda pair: pair[0], default=(0, None))
    if reason is not None and (best is None or not best.numbers or width > 2 * len(best.numbers)):
        raise reason
    if best is None or not best.numbers:
        fix = "check that one line names the columns, and that the lines below hold numbers"
        raise MeasurementError.of(f"'{path}' is no table of numbers with any usual separator", fix=fix)
    return best


def _counts(texts: Sequence[str]) -> bool:
    """Whether a column numbers the rows, from any number on."""
    first, *others = numbers_in(texts, ".")
    return first is not None and first.is_integer() and others == [first + k for k in range(1, len(others) + 1)] != []


class JointColumns(NamedTuple):
    """Columns that may be those of the joints, in the robot's order; why; the better, the smaller the rank."""

    names: list[str]
    how: str
    rank: tuple[int, ...]

    @property
    def text(self) -> str:
        """As a value of `fit --joints`: gon and mrad as expressions in degrees and rad."""
        factors = {"gon": "0.9", "mrad": "0.001"}
        units = [(name, factors.get(column(name).unit)) for name in self.names]
        return ",".join(f"{factor}*{{{name}}}" if factor else name for name, factor in units)


def guess_joints(columns: Sequence[str], joints: Sequence[str]) -> list[JointColumns]:
    """Columns that may be those of the joints, the best first: speeds, torques and poses of the tool are none.

    Names are compared without what all have in common before or after, and as numbered series such as q1, q2, ...
    What encoders reported comes before what nothing is said of, and this before what was commanded.
    """
    if columns and all(name.isdecimal() for name in columns) and len(columns) >= len(joints) + 3:
        return [JointColumns([*columns[: len(joints)]], "the first columns: no line of the file names them", ())]
    if set(joints) <= set(columns):
        return [JointColumns(list(joints), "named as in the URDF", ())]
    candidates: dict[tuple[str, ...], JointColumns] = {}
    for labels, named, group in _named_after(columns, joints):
        names, numbered = list(group.names.values()), labels[-1].isdigit()
        missing = [k for k, label in enumerate(labels) if label not in group.names]
        rails = [name for name in columns if _is_external(name) and name not in names][: len(missing)]
        other = numbered and (group.says("tool") or group.shared & {*"xyz"} or _goes_on(columns, group))
        if other or group.says("rate", "deviation") or len(missing) > 1 or len(rails) < len(missing):
            continue
        for k in missing:
            names.insert(k, rails[0])
        if missing and numbered and sorted(names, key=columns.index)[0] != rails[0] != max(names, key=columns.index):
            names.sort(key=columns.index)  # E1 between the others: of seven axes
            missing = [names.index(rails[0])]
        said = group.says("measured") or group.shared & {"position", "pos", "qpos"}
        unlike = [k for k in missing if not _is_external(joints[k])]
        rank = group.wished, bool(numbered and not group.says("joint")), not said, len(missing), len(unlike)
        why = ", commanded" if group.wished else f", reported: '{min(said)}'" if said else ""
        why += "".join(f", {rails[0]} for {joints[k]}" for k in missing)
        candidates.setdefault(tuple(names), JointColumns(names, named + why, rank))
    return sorted(candidates.values(), key=lambda candidate: candidate.rank)


def joints_without_column(columns: Sequence[str], joints: Sequence[str]) -> list[str]:
    """The joints that no column is named after, of the naming that most columns follow."""
    closest = max(_named_after(columns, joints), key=lambda naming: len(naming[2].names), default=None)
    if closest is None:
        return list(joints)
    return [joint for joint, label in zip(joints, closest[0], strict=True) if label not in closest[2].names]


def _named_after(columns: Sequence[str], joints: Sequence[str]) -> Iterator[tuple[list[str], str, Group]]:
    """Columns with some of the labels that joints may have, all of these in the robot's order, and what they are."""
    words, n = [column(joint).words for joint in joints], len(joints)
    counts = Counter(word for parts in words for word in set(parts))
    full = ["".join(parts) for parts in words]
    bare = ["".join(word for word in parts if counts[word] < n or n == 1) for parts in words]
    alone = [next((word for word in parts if counts[word] == 1 and not word.isdigit()), "") for parts in words]
    usual = "named as in the URDF but for units, case and what all have in common"
    labels = [(usual, full)] + [(usual, own) for own in (bare, alone) if all(own) and not all(map(str.isdigit, own))]
    labels += [("named as on the robot's pendant", list(names)) for names in PENDANTS if len(names) == n]
    series = [[f"{k + first:0{width}d}" for k in range(n)] for first in (0, 1) for width in (1, 2)]
    series += [["", *digits[:-1]] for digits in series if n > 1]  # the first joint is a rail
    labels += [("numbered in the order of the URDF's joints", digits) for digits in series]
    named = [(naming, how, group) for how, naming in labels for group in groups(columns, naming)]
    mixed = Group((), (), mixed_names(columns, full, bare))
    return iter([(full, usual, mixed)] * bool(mixed.names) + named)


def _is_external(name: str) -> bool:
    return bool({*column(name).words} & WORDS["external"])


def _goes_on(columns: Sequence[str], group: Group) -> set[str]:
    """Columns of a numbered series before and after these."""
    numbers = [int(label) for label in group.names]
    around = [(*group.before, str(k), *group.after) for k in (min(numbers) - 1, max(numbers) + 1)]
    return {name for name in columns if column(name).words in around}


class Body(NamedTuple):
    """Columns of a place, and of the rotation beside it, if any."""

    place: list[str]
    turn: list[str]
    left: str = ""  # what the place is, if no device measured it
    spherical: tuple[str, ...] = ()  # how the place may be written, if it is a distance and two angles

    def written(self, way: str = "") -> str:
        """The place as a value of `fit --position`."""
        return f"{way}=" * bool(way) + ",".join(self.place)

    @property
    def words(self) -> set[str]:
        """Words of the names of the place."""
        return {word for name in self.place for word in column(name).words}


def bodies_in(columns: Sequence[str]) -> list[Body]:
    """Places, columns whose names differ by x, y and z alone, each with the rotation whose names are the most alike.

    Of several that are as much alike the nearest one. A rotation is four columns of a quaternion, nine of a matrix or
    three angles.
    """
    at = {name: offset for offset, name in enumerate(columns)}
    places = [group for group in of_places(columns) if not group.says("rate", "deviation", "turn")]
    turns = [group for labels in ROTATIONS for group in _rotations(columns, labels)]
    pairs = list[tuple[tuple[int, ...], str, list[str]]]()
    for place, (rank, group) in product(places, enumerate(turns)):
        first, turn = place.names["x"], list(group.names.values())
        unlike = (group.shared - group.says("turn", "place")) ^ ({*column(first).words} - {"x", *WORDS["place"]})
        start = min(at[name] for name in turn)
        series = turn[0] in JOINTS and start < at[first]  # of joints, rather than a quaternion
        if place.wished == group.wished and not series:
            pairs.append(((len(unlike), abs(start - at[first]), at[first], start, rank), first, turn))
    rotations = dict[str, list[str]]()
    for _, first, turn in sorted(pairs):
        if first not in rotations and not any(set(turn) & set(other) for other in rotations.values()):
            rotations[first] = turn
    bodies = list[Body]()
    for place in sorted(places, key=lambda place: at[place.names["x"]]):
        better = [twin.names["x"] for twin in places if twin.stem == place.stem and twin.rank < place.rank]
        left = f"places beside the measured ones of {better[0]}" if better else ""
        names, left = list(place.names.values()), "wished places" if place.wished else left
        bodies.append(Body(names, rotations.get(names[0], []), left))
    return bodies


def in_other_units(sheet: Sheet, bodies: Sequence[Body]) -> dict[int, str]:
    """Numbers of the places that are others in another unit of length, with fewer digits or behind them; in words."""
    less, columns = dict[int, str](), ([name for name in body.place if name in sheet.cells] for body in bodies)
    each = ([numbers_in(sheet.cells[name], sheet.decimal) for name in names] for names in columns)
    for (a, one), (b, other) in permutations(enumerate(np.array(numbers, dtype=float) for numbers in each), 2):
        for factor in {p / q for p, q in permutations(UNITS_PER_METRE.values(), 2)} if one.shape == other.shape else ():
            away = np.abs(one - factor * other)
            if np.isfinite(away).any() and np.nanmax(away) < SAME_SHARE * np.nanmax(np.abs(one)):
                less[a if (len(np.unique(one)), b) < (len(np.unique(other)), a) else b] = "places in another unit"
    return less


def _numbered(columns: Sequence[str]) -> list[Body]:
    """Series of three numbers that may be places; else the first columns of another file, which has no names."""
    each = (group for labels in ("123", "012") for group in whole(columns, labels) if not _goes_on(columns, group))
    series = [group.names.values() for group in each if not (group.wished or group.says("rate", "deviation", "turn"))]
    counted = [name for name in columns if name.isdecimal()]
    return [Body([*names], []) for names in series or [counted[:3]] * (len(counted) > 2)]


def spherical_in(sheet: Sheet, columns: Sequence[str]) -> list[Body]:
    """A place as a distance and two angles, of which the second is above the horizon or from the zenith."""
    parts = list[Column]()
    for role, units in (("distance", LENGTHS.values()), ("around", SPHERICAL_UNITS), ("vertical", SPHERICAL_UNITS)):
        fitting = (part for part in map(column, columns) if WORDS[role] & {*part.words} and part.unit in {*units, ""})
        parts += [part for part in fitting if part not in parts][:1]
    if len(parts) < 3:
        return []
    names, words, stated = [part.name for part in parts], {*parts[2].words}, {part.unit for part in parts[1:]} - {""}
    turned = numbers_in(sheet.cells[names[1]], sheet.decimal)
    large = any(abs(value) > 2 * pi for value in turned if value is not None)
    stated = stated or {*SPHERICAL_UNITS} - ({"rad"} if large else set())
    ways = [way for way in SPHERICAL if way.rpartition("_")[2] in stated]
    for role in ("elevation", "zenith"):
        ways = [way for way in ways if way.startswith(role) or not WORDS[role] & words]
    return [Body(names, [], spherical=tuple(ways))]


def _rotations(columns: Sequence[str], labels: Sequence[str]) -> Iterator[Group]:
    """Columns that differ by the labels of a rotation and hold one: no series of joints, no place, no speed."""
    following = [f"q{len(labels) + int(labels[0][1])}"] if labels[0] in JOINTS else []
    marks = {"r", "m", "t"} if labels[0] in ("00", "11") else {"r"}
    for group in whole(columns, labels):
        longer = any(other[:2] == group[:2] for other in groups(columns, following))
        plain = labels[0] in ("x", "00", "11") and not (group.says("turn") or group.shared & marks)
        if not (longer or plain or group.says("rate", "deviation")):
            yield group


def guess_readings(columns: Sequence[str]) -> dict[str, list[str]]:
    """Texts of `fit --reading` of all kinds of devices, by the names of their columns; these columns."""
    readings, described = dict[str, list[str]](), [column(name) for name in reversed(columns)]
    for kind in known_kinds().values():
        numbers = [""] if kind.numbers_each == 1 else [f"{k + 1}" for k in range(kind.numbers_each)]
        units = {*LENGTHS.values()} if kind.unit == MILLIMETRES else {kind.unit[0]}
        there = {entry.plain: entry.name for entry in described if not entry.unit or entry.unit in units}
        for word, usual in kind.columns().items():
            each = ([f"{column(name).plain}{number}" for number in numbers] for name in usual)
            chosen = next(([there[name] for name in names] for names in each if set(names) <= set(there)), None)
            if chosen is not None and chosen not in readings.values():
                readings[f"{word}={','.join(chosen)}"] = chosen
    pixels = [*whole(columns, "uv"), *(axes for axes in whole(columns, "xy") if axes.says("pixel"))]
    names = [[*axes.names.values()] for axes in pixels if not axes.says("rate", "deviation")]  # no currents of phases
    return readings | {f"image={','.join(pair)},{LENS}": pair for pair in names[:1]}


def guess_deviations(columns: Sequence[str], triples: Sequence[Sequence[str]]) -> list[str] | None:
    """Columns whose names are those of the positions but for a word such as std, in their order; None if one lacks."""

    def without(entry: Column, *roles: str) -> str:
        return "".join(word for word in entry.words if not any(word in WORDS[role] for role in roles))

    deviations = [entry for entry in map(column, columns) if {*entry.words} & WORDS["deviation"]]
    by_name = {without(entry, "deviation"): entry.name for entry in deviations}
    by_name |= {without(entry, "deviation", "measured"): entry.name for entry in deviations}
    wanted = [column(name) for triple in triples for name in triple]
    names = [by_name.get(entry.plain) or by_name.get(without(entry, "measured")) for entry in wanted]
    return None if None in names else [name for name in names if name is not None]


# --- what was measured ---


USUAL_SIZES = (640, 480), (1280, 720), (1280, 960), (1920, 1080), (2048, 1536), (2592, 1944), (4096, 3072), (8192, 8192)
BELOW = (12, 13, 14)  # places of the zeros below a rotation, of a matrix by rows


class RowColumns(NamedTuple):
    """Columns of what was measured, by their names."""

    bodies: list[Body]  # of positions or poses
    options: dict[str, Any]  # of `fit`, that name them and the device, the payload, time, temperature
    why: dict[str, str]  # their reasons
    left: list[str]  # columns that are not used, and why


def rows_in(sheet: Sheet, joints: list[str]) -> RowColumns:
    """The probable contents of a table beside its joints."""
    by_name = {name.lower(): name for name in sheet.header}
    sockets = [by_name[name] for name in ("place", "socket") if name in by_name and "socket" in by_name]
    with_gaps = sheet.header if sockets else sheet.numbers  # rows in sockets have no positions
    places = bodies_in([name for name in with_gaps if name not in joints])
    left = [f"{few(body.place)}: {body.left}" for body in places if body.left]
    others = [name for name in sheet.numbers if name not in joints]
    nameless = all(name.isdecimal() for name in sheet.header) and len(others) > 2
    bodies = [Body(others[:3], [])] if nameless else [body for body in places if not body.left]
    bodies = bodies or matrices_in(sheet, others)[:1] or spherical_in(sheet, others)
    if {f"{axis}{k}" for axis in "uv" for k in "1234"} <= {column(name).plain for name in others}:
        what, got = f"corners in '{sheet.path}'", "u1, v1, u2, v2, ... in a line"
        expected = f"a line for each, with {few([IMAGE, *POINT, *PIXEL])}"
        raise InputError.of(what, expected=expected, got=got, fix="split the lines, as `images` writes them")
    if not bodies and len(joints) == 2:  # a machine in a plane, and what was measured in it
        flat = [group for group in whole(others, "xy") if not (group.wished or group.says("rate", "deviation"))]
        bodies = [Body([*group.names.values(), ZERO], []) for group in flat]
    corners = _corners_in(sheet) if {IMAGE, *POINT, *PIXEL} <= {*sheet.cells} else []
    devices = guess_readings([name for name in others if not corners or name not in (*POINT, *PIXEL)])
    readings = [*corners, *devices]
    if bodies or sockets or len(readings) > 1:  # beside other kinds of rows, or one another, some cells are empty
        there = (text for text, names in devices.items() if all("" in sheet.cells[name] for name in names))
        readings = [*corners, *there]
    bodies = bodies or ([] if sockets or readings else _numbered(others))
    less = in_other_units(sheet, bodies)
    left += [f"{few(bodies[k].place)}: {words}" for k, words in less.items()]
    bodies = [body for k, body in enumerate(bodies) if k not in less]
    if not bodies and not sockets and not readings:  # one column of names that repeat, such as A1, B2
        texts = [name for name in sheet.header if name not in joints and name not in sheet.numbers]
        named = [name for name in texts if 1 < len({*sheet.cells[name]}) <= len(sheet.cells[name]) / 2]
        sockets = named * (len(named) == 1)
    if not bodies and not sockets and not readings:
        common = next((name for name in sheet.header if name not in joints), "COLUMN")
        fix = f"if they are in another file: --places FILE --by {common}; without a tracker: columns `place` and "
        fix += "`socket` of a ball, or of a device, such as `distance`, `wire` or `height`; see `fit --help`, --reading"
        expected = "three columns of numbers named x, y and z, alone or behind a separator, such as left_x"
        got = "; ".join(left) or few(sheet.numbers, 20) or "no other columns"
        raise InputError.of(f"positions in '{sheet.path}'", expected=expected, got=got, fix=fix)
    options: dict[str, Any] = {"position": [body.written() for body in bodies] or None, "reading": readings or None}
    options["socket"] = ",".join(sockets) or None
    why = {"position": f"{len(bodies)} marker(s), by their names", "reading": _of_readings(readings)}
    why["socket"] = "by their names; a ball on the tool rested in this socket of a block there"
    texts = {"session": [] if sockets and not readings else [name for name in sheet.header if name not in joints]}
    for option, (words, what) in NAMED.items():
        named = [name for name in texts.get(option, others) if column(name).plain in words.split()]
        options[option] = next(iter(named), None)
        why[option] = f"by its name: {what}"
    if bodies:
        why["session"] += "; add `remounted = true` if it stayed and the markers were mounted anew"
    return RowColumns(bodies, options, why, [f"{text}; not used" for text in left])


def _of_readings(texts: Sequence[str]) -> str:
    why = "by names; `displacement` is a distance with an unknown zero"
    if any(text.endswith(LENS) for text in texts):
        why += f"; replace {LENS} by the camera's focal lengths and principal point in pixels"
    if any(text.startswith(CORNERS) for text in texts):
        sizes = "width and height of the images are the least usual size that holds all corners"
        why += f"; {'the lens is that of the file beside the table' if texts[0].endswith('.yaml') else sizes}"
    return why


def marker_of_lines(sheet: Sheet, joints: Sequence[str]) -> str | None:
    """The column whose texts tell apart the lines of each pose, if the first of them alone holds joint values."""
    values = zip(*(sheet.cells.get(name, ()) for name in joints), strict=False)
    poses = list(accumulate(any(cells) for cells in values))
    for name, texts in sheet.cells.items():
        named = 1 < len({*texts}) <= gates.MOST_MARKERS and "" not in texts
        if named and poses and poses[0] > 0 and poses[-1] < len(poses) == len({*zip(poses, texts, strict=True)}):
            return name
    return None


def matrices_in(sheet: Sheet, columns: Sequence[str]) -> list[Body]:
    """Poses that are written as 16 or 12 numbers by rows or columns."""
    bodies = list[Body]()
    for labels in ENTRIES:
        used = {name for body in bodies for name in (*body.place, *body.turn)}
        for group in whole([name for name in columns if name not in used], labels):
            if group.wished or _goes_on(columns, group):
                continue
            names, counted = list(group.names.values()), len(labels[0]) < 2
            below = [cell for k in BELOW if counted for cell in sheet.cells[names[k]]]
            by_rows = all(number(cell, sheet.decimal) == 0 for cell in below)
            entries = [names[4 * row : 4 * row + 4] if by_rows else names[row::4] for row in range(3)]
            turn = [name for row in entries for name in row[:3]]
            bodies.append(Body([row[3] for row in entries], turn))
    return bodies


def _corners_in(sheet: Sheet) -> list[str]:
    """The files of the cameras beside the table, as `images` writes them, else a usual size that holds all corners."""
    csv = sheet.path
    files = [csv.parent / f"{name}.yaml" for name in dict.fromkeys(sheet.cells.get(CAMERA, ())) if name]
    if len(files) > 1 and all(file.is_file() for file in files):
        return [f"{CORNERS}{file}" for file in files]
    sidecar, cameras = csv.with_suffix(".yaml"), list[Path]()
    for file in [sidecar] if sidecar.is_file() else csv.parent.glob("*.yaml"):
        with suppress(InputError):  # no camera
            read_camera(file)
            cameras.append(file)
    if len(files) < 2 and len(cameras) == 1:
        return [f"{CORNERS}{cameras[0]}"]
    width, height = (max(number(cell, sheet.decimal) or 0.0 for cell in sheet.cells[name]) for name in PIXEL)
    size = next((size for size in USUAL_SIZES if width < size[0] and height < size[1]), USUAL_SIZES[-1])
    return [f"{CORNERS}{','.join(map(str, size))}"]


def with_places(csv: Path, given: Places) -> tuple[Path, str]:
    """The table, joined with that of the measured places if there is one; and the common column."""
    if given.places is None:
        return csv, ""
    joints, places = guess_sheet(csv), guess_sheet(given.places)
    common = {name: len({*own} & {*places.cells[name]}) for name, own in joints.cells.items() if name in places.cells}
    if not common:  # columns that name the same rows
        each = product(joints.cells.items(), places.cells.items())
        pairs = [f"{key}={other}" for (key, names), (other, others) in each if sorted(names) == sorted({*others})]
        common = dict.fromkeys(pairs if len(pairs) == 1 else [], 1)
    if given.by is None and not common:
        got = " and ".join(few(part.header, 12) for part in (joints, places))
        fix = "add the number of the pose, or name two: --by COLUMN=OTHER"
        raise InputError.of("--places without --by", expected="a column of both files", got=got, fix=fix)
    by = given.by or max(common, key=lambda name: common[name])
    return joined_file(csv, given.places, by, joints.sep, joints.decimal, several=True), by
