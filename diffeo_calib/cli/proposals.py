"""What `diffeo-calib init` proposes beyond joints and positions: rotations and standard deviations, if they fit."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import inf
from pathlib import Path
from typing import Any

from diffeo_calib.calibration.diagnostics.likely_mistakes import LIMITS, residual_of
from diffeo_calib.calibration.identification.registration import register_sockets
from diffeo_calib.calibration.placing.readings import identify_readings
from diffeo_calib.common.errors import DiffeoCalibError, InputError, MeasurementError, few
from diffeo_calib.measurements.csv.cells import number, read_cells
from diffeo_calib.measurements.csv.files import read_observations, read_table
from diffeo_calib.measurements.csv.rotations import EULER
from diffeo_calib.measurements.csv.sensors import ReadingColumns, SocketColumns, TableColumns
from diffeo_calib.measurements.poses import numbers_of
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.range import UNKNOWN_ZERO_M

SEPARATORS = (",", ";", "\t", "|", " ")
DECIMALS = (".", ",")
ROWS = 50
"""Rows that are looked at."""
NOT_MEASURED = ("std", "sigma", "dev", "err", "goal", "target", "command", "cmd", "nominal", "desired", "plan")
"""Parts of the names of columns that hold deviations or wishes, not measured places."""
TURNS = ("rot", "euler", "quat", "ang")
"""Parts of the names of columns that hold rotations."""
UNITS = re.compile(r"[_ ]*[\[(]?(?:rad|deg|degrees?|mm|m)[\])]?$", re.IGNORECASE)
"""Units that follow the name of a column."""


PLACE = re.compile(r"(?<![a-z])[tpm]$", re.IGNORECASE)
"""A letter before x, y, z that says what they are: translation, position, measured."""
READINGS = {
    "distance": ("distance", "dist", "range", "bar"),
    "displacement": ("displacement", "wire", "draw_wire", "interferometer"),
    "height": ("height", "gauge", "dial", "dial_gauge", "indicator"),
}
"""Names of columns by the word of `fit --reading`."""
SESSIONS = ("session", "setup", "set_up", "station", "anchor", "device", "plane")
PAYLOADS = ("payload", "mass", "load", "payload_kg", "mass_kg", "load_kg")
ROTATIONS = (
    ("qx", "qy", "qz", "qw"),
    ("quat_x", "quat_y", "quat_z", "quat_w"),
    tuple(f"r{row}{column}" for row in "123" for column in "123"),
    tuple(f"r{row}{column}" for row in "012" for column in "012"),
    ("rx", "ry", "rz"),
    ("rot_x", "rot_y", "rot_z"),
    ("rotvec_x", "rotvec_y", "rotvec_z"),
    ("roll", "pitch", "yaw"),
    ("euler1", "euler2", "euler3"),
)
"""Ends of the names of rotation columns."""
DEVIATIONS = re.compile(r"(std_?dev|stdev|std|sigma|dev)")


@dataclass(frozen=True)
class Sheet:
    """A table as it seems to be written.

    Args:
        sep, decimal: between cells, and in numbers. header: all columns. numbers: those that hold numbers alone.
        rows: how many rows were looked at.
    """

    sep: str
    decimal: str
    header: tuple[str, ...]
    numbers: tuple[str, ...]
    rows: int


def guess_sheet(path: Path) -> Sheet:
    """The separator and decimal mark with which most columns are numbers.

    Raises:
        MeasurementError: with none of them the file is a table of numbers.
    """
    found: list[Sheet] = []
    for sep in SEPARATORS:
        try:
            header, lines = read_cells(path, sep)
        except MeasurementError:
            continue
        rows = [cells for _, cells in lines[:ROWS]]
        for decimal in DECIMALS:
            if decimal == sep:
                continue
            columns = [k for k in range(len(header)) if all(number(row[k], decimal) is not None for row in rows)]
            found.append(Sheet(sep, decimal, tuple(header), tuple(header[k] for k in columns), len(rows)))
    best = max(found, key=lambda sheet: len(sheet.numbers), default=None)
    if best is None or not best.numbers:
        fix = "check that the file has one header line, and the same number of cells in every line"
        raise MeasurementError.of(f"'{path}' is no table of numbers with any usual separator", fix=fix)
    return best


def guess_joints(columns: Sequence[str], joints: Sequence[str]) -> tuple[list[str], str] | None:
    """Columns of the joints in the robot's order, and why; None if no reading of the names gives them all.

    Names are compared as they are, without case, units and signs, and then as numbered series such as q1, q2, ...
    """
    for how, plain in (("named as in the URDF", str), ("named as in the URDF but for units and case", _bare)):
        known = {plain(column): column for column in columns}
        if len(known) == len(columns) and all(plain(joint) in known for joint in joints):
            return [known[plain(joint)] for joint in joints], how
    series: dict[str, dict[int, str]] = {}
    for column in columns:
        parts = re.fullmatch(r"(.*?)(\d+)(\D*)", column)
        if parts is not None:
            series.setdefault(f"{parts[1]}#{parts[3]}".lower(), {})[int(parts[2])] = column
    for numbered in series.values():
        for first in (0, 1):
            wanted = range(first, first + len(joints))
            if len(numbered) == len(joints) and set(numbered) == set(wanted):
                return [numbered[k] for k in wanted], "numbered in the order of the URDF's joints"
    return None


def guess_positions(columns: Sequence[str]) -> list[list[str]]:
    """Triples of columns whose names differ by x, y and z alone, in their order; no deviations, no targets."""
    found: dict[str, dict[str, str]] = {}
    no_place = (*NOT_MEASURED, *TURNS)
    for column in [name for name in columns if not any(word in name.lower() for word in no_place)]:
        for place in [k for k, letter in enumerate(column.lower()) if letter in "xyz"]:
            around = column[:place], column[place + 1 :]
            before, after = PLACE.sub("", around[0]), around[1]
            if not any(text and text[edge].isalpha() for text, edge in ((before, -1), (after, 0))):
                found.setdefault("#".join(around).lower(), {})[column[place].lower()] = column
    return [[triple[axis] for axis in "xyz"] for triple in found.values() if set(triple) == set("xyz")]


def guess_sockets(header: Sequence[str]) -> list[str] | None:
    """The columns place and socket, or socket alone, that name where a ball rested; None without a socket."""
    known = {name.lower(): name for name in header}
    return [known[name] for name in ("place", "socket") if name in known] if "socket" in known else None


def guess_reading(columns: Sequence[str]) -> tuple[str, str] | None:
    """Word of `fit --reading` and the column of a device that measures one number, by its name; None without any."""
    for word, known in READINGS.items():
        for name in columns:
            if UNITS.sub("", name).lower() in known:
                return word, name
    return None


def guess_column(header: Sequence[str], words: Sequence[str]) -> str | None:
    """The first column that has one of these names, but for case and units; None without one."""
    return next((name for name in header if UNITS.sub("", name).lower() in words), None)


def guess_rotation(columns: Sequence[str], position: Sequence[str]) -> list[str] | None:
    """Columns of a rotation by their names: four of a quaternion, nine of a matrix or three angles; None without any.

    Of several, those whose names begin as the position's do.
    """
    names = [name for name in columns if not any(word in name.lower() for word in NOT_MEASURED)]
    found: list[tuple[str, list[str]]] = []
    for words in ROTATIONS:
        by_prefix: dict[str, dict[str, str]] = {}
        for name in names:
            bare = UNITS.sub("", name).lower()
            word = next((word for word in words if bare.endswith(word)), None)
            if word is not None:
                by_prefix.setdefault(bare.removesuffix(word), {})[word] = name
        found += [
            (before, [own[word] for word in words]) for before, own in by_prefix.items() if len(own) == len(words)
        ]
    start = position[0].lower()
    return min(found, key=lambda entry: not start.startswith(entry[0]), default=(None, None))[1]


def guess_deviations(columns: Sequence[str], triples: Sequence[Sequence[str]]) -> list[str] | None:
    """Columns whose names are those of the positions but for a word such as std, in their order; None if one lacks."""
    known: dict[str, str] = {}
    for column in columns:
        bare = DEVIATIONS.sub("", UNITS.sub("", column).lower())
        if bare != UNITS.sub("", column).lower():
            known[re.sub(r"[^a-z0-9]", "", bare)] = column
    wanted = [_bare(name) for triple in triples for name in triple]
    return [known[name] for name in wanted] if all(name in known for name in wanted) else None


def _bare(name: str) -> str:
    """A name without unit, case and signs."""
    return re.sub(r"[^a-z0-9]", "", UNITS.sub("", name).lower())


Entry = tuple[str, str | list[str] | bool, str]
"""An option, its value, and why."""
ALL_CONVENTIONS = ("rotvec", "quat_xyzw", "quat_wxyz", "matrix", *EULER)
"""Those of rotations that are tried."""
LARGEST_RESIDUAL = 0.1
"""Median residual of a registration, m, or without positions as a share, above which no reading is right."""
LARGEST_DEVIATION = 0.01
"""Median standard deviation of a measured position, m, above which a column holds something else."""


@dataclass(frozen=True)
class RowColumns:
    """Columns of what was measured, by their names.

    Args:
        markers: of positions. sockets: of place and socket. reading: word of `fit --reading` and column. session: of
            the device or its set-up. payload: of the mass carried.
    """

    markers: list[list[str]]
    sockets: list[str]
    reading: tuple[str, str] | None
    session: str | None
    payload: str | None

    @property
    def without_length(self) -> bool:
        """Whether no column is a length."""
        return not self.markers and self.reading is None

    def entries(self) -> Iterator[Entry]:
        """(option, value, why) of each."""
        if self.markers:
            names = [",".join(triple) for triple in self.markers]
            yield "position", names, f"{len(names)} marker(s), by their names"
        if self.sockets:
            yield "socket", self.sockets, "by their names; a ball on the tool rested in this socket of a block there"
        if self.reading is not None:
            yield "reading", "=".join(self.reading), "by its name; `displacement` is a distance with an unknown zero"
        if self.session is not None:
            yield "session", self.session, "by its name: the device, or its set-up, of every row"
        if self.payload is not None:
            yield "payload", self.payload, "by its name: the known mass that the robot carried"


def rows_in(csv: Path, sheet: Sheet, joints: list[str]) -> RowColumns:
    """What a table seems to hold beside its joints."""
    sockets = guess_sockets(sheet.header) or []
    with_gaps = sheet.header if sockets else sheet.numbers  # rows in sockets have no positions
    markers = [triple for triple in guess_positions(with_gaps) if not set(triple) & set(joints)]
    others = [name for name in sheet.numbers if name not in joints]
    reading = None if markers or sockets else guess_reading(others)
    if not markers and not sockets and reading is None:
        expected = "three columns of numbers named x, y and z, alone or behind a separator, such as left_x"
        fix = "without a tracker: a ball in sockets has columns `place` and `socket`, which `init` knows, a device a "
        fix += 'column such as `distance`, `wire` or `height`; all options are in the README, "Without a tracker"'
        raise InputError.of(f"positions in '{csv}'", expected=expected, got=few(sheet.numbers, 20), fix=fix)
    named = [name for name in sheet.header if name not in joints]
    session = None if sockets else guess_column(named, SESSIONS)
    return RowColumns(markers, sockets, reading, session, guess_column(others, PAYLOADS))


def tips_of(markers: Sequence[Sequence[str]], leaves: Sequence[str]) -> list[str]:
    """The leaf after which the columns of each marker are named, such as left_x after left; none unless several are."""
    known = {leaf.lower(): leaf for leaf in leaves}
    found = [known.get(re.sub(r"[_\-. ]?[xX]$", "", triple[0]).lower()) for triple in markers]
    tips = [tip for tip in found if tip is not None]
    return tips if len(tips) == len(markers) and len(set(tips)) > 1 else []


def beside(source: Source, sheet: Sheet) -> Iterator[Entry]:
    """(option, value, why) of rotations, standard deviations and distances of sockets."""
    if source.reading is not None:
        yield "", "", "beside readings no rotations and deviations were looked for"
    elif source.sockets:
        lines = distance_lines(source.csv, sheet, source.sockets[-1], source.table.length)
        yield from (("", "", line) for line in lines)
    else:
        yield from rotation(source)
        yield from deviations(source)


@dataclass(frozen=True)
class Source:
    """A table whose joints, positions and units are known."""

    csv: Path
    robot: Tree
    joints: list[str]
    rows: RowColumns
    table: TableFormat
    numbers: tuple[str, ...]
    tips: Sequence[str] = ()

    @property
    def markers(self) -> list[list[str]]:
        """Columns of the markers."""
        return self.rows.markers

    @property
    def sockets(self) -> tuple[str, ...]:
        """Columns of place and socket."""
        return tuple(self.rows.sockets)

    @property
    def reading(self) -> ReadingColumns | None:
        """Columns of a device that measures one number."""
        return None if self.rows.reading is None else reading_columns(self.rows.reading, self.rows.session)

    def read(self, table: TableFormat) -> Measurements | None:
        """The measurements in another format; None if they cannot be read so."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                data = read_table(self.csv, self.joints, self.markers, table, duplicates="keep", kinds=self.robot.kinds)
            except DiffeoCalibError:
                return None
        data = data.with_joint_names(self.robot.joint_names)
        return data.with_tips(self.tips) if self.tips else data

    def residual(self, table: TableFormat) -> float:
        """Median residual of the nominal robot in another format, in the unit of :meth:`words`.

        Of positions in m. Without any that of the ball in its socket, as a share of its spread over all rows, which is
        small too where angles are read as too small. Infinite if the table cannot be read so.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                if self.reading is not None:
                    return self._of_readings(table, self.reading)
                return self._positions(table) if self.markers else self._in_sockets(table)
            except DiffeoCalibError:
                return inf

    def size(self, residual: float) -> str:
        """A residual with its unit."""
        return f"{1e3 * residual:.3g} mm" if self.markers or self.reading else f"{100 * residual:.3g} %"

    def words(self, best: float, others: float) -> str:
        """What residuals say for the best units, and the least of those in other units."""
        what = "the nominal robot spreads the ball in a socket, relative to all rows, by"
        what = "median residual of the nominal robot" if self.markers or self.reading else what
        return f"{what} {self.size(best)}, in other units at least {self.size(others)}"

    def _positions(self, table: TableFormat) -> float:
        if not self.sockets:
            data = self.read(table)
            return inf if data is None else residual_of(self.robot, data)
        return residual_of(self.robot, self._with_sockets(table, self.markers).device_rows())

    def _of_readings(self, table: TableFormat, reading: ReadingColumns) -> float:
        """That of ball and devices around the nominal robot, from closed-form starts."""
        columns = TableColumns(self.joints, readings=(reading,), kinds=self.robot.kinds)
        data: Any = read_observations(self.csv, columns, table, duplicates="keep")
        found = identify_readings(Geometry.nominal(self.robot), [data], rigid=True)
        return found.registration.rms

    def _in_sockets(self, table: TableFormat) -> float:
        data = self._with_sockets(table, None)
        if data.socket is None:
            return inf
        found = register_sockets(self.robot, data.q, data.socket)
        seen = found.positions[data.socket]
        spread = float((seen - seen.mean(0)).norm(dim=1).median())
        return float(found.distances.median()) / spread if spread > 0.0 else inf

    def _with_sockets(self, table: TableFormat, markers: list[list[str]] | None) -> Measurements:
        columns = TableColumns(self.joints, markers, SocketColumns(self.sockets), kinds=self.robot.kinds)
        data = read_observations(self.csv, columns, table, duplicates="keep")
        return data.with_joint_names(self.robot.joint_names)


def reading_columns(reading: tuple[str, str], device: str | None) -> ReadingColumns:
    """The columns of a reading: word of `fit --reading` and column; ``device``: that names the device of a row."""
    word, column = reading
    if word == "displacement":
        return ReadingColumns("distance", (column,), device, UNKNOWN_ZERO_M)
    return ReadingColumns("height" if word == "height" else "distance", (column,), device)


def rotation(source: Source) -> Iterator[Entry]:
    """(option, value, why) of a rotation: the convention with which the nominal robot explains the poses best.

    Nothing if there are no such columns, or no convention is clearly better than all others; then a last entry whose
    option is empty says so.
    """
    found = [guess_rotation(source.numbers, marker) for marker in source.markers]
    each = [names for names in found if names is not None and not set(names) & set(source.joints)]
    alone = len(source.markers) == 1 or len({name for own in each for name in own}) == sum(map(len, each))
    if not each or len(each) < len(found) or not alone or len(found) != max(len(source.tips), 1):
        return
    names = [name for own in each for name in own]
    units = ("deg", "rad") if len(each[0]) == 3 else (None,)
    columns = each[0] if len(each) == 1 else each
    conventions = [name for name in ALL_CONVENTIONS if numbers_of(name) == len(each[0])]
    residuals: dict[tuple[str, str | None], float] = {}
    for convention, unit in product(conventions, units):
        data = source.read(replace(source.table, rotation=columns, convention=convention, rotation_angle=unit))
        if data is not None:
            residuals[convention, unit] = residual_of(source.robot, data)
    (convention, unit), best = min(
        residuals.items(), key=lambda entry: entry[1], default=(("", None), LARGEST_RESIDUAL)
    )
    others = [value for reading, value in residuals.items() if reading != (convention, unit)]
    if best >= LARGEST_RESIDUAL or any(value < LIMITS.told_apart * best for value in others):
        yield "", "", f"{few(names)}: rotations of no convention that is clearly better than others; not used"
        return
    than = f", with any other convention or unit at least {1e3 * min(others):.3g} mm" if others else ""
    written = [",".join(own) for own in each]
    why = "by their names; without these three lines positions alone are calibrated"
    yield "rotation", written[0] if len(written) == 1 else written, why
    yield "convention", convention, f"median residual of the nominal robot {1e3 * best:.3g} mm{than}"
    if unit is not None:
        yield "rotation-angle", unit, "the same"


def camera(source: Source, sheet: Sheet) -> Iterator[Entry]:
    """(option, value, why) of units and rotations that make the rows poses of a board seen by a camera on the tool.

    Nothing if there are no columns of a rotation, or no reading is clearly better than all others.
    """
    names = guess_rotation(source.numbers, source.markers[0]) if len(source.markers) == 1 else None
    if names is None or set(names) & set(source.joints):
        return
    conventions = [name for name in ALL_CONVENTIONS if numbers_of(name) == len(names)]
    turns = ("deg", "rad") if len(names) == 3 else (None,)
    residuals: dict[tuple[str, str, str, str | None], float] = {}
    for length, angle, convention, unit in product(("m", "mm"), ("rad", "deg"), conventions, turns):
        plain = TableFormat(length, angle, sheet.sep, sheet.decimal, names, convention, unit, camera_on_tool=True)
        data = source.read(plain)
        if data is not None:
            residuals[length, angle, convention, unit] = residual_of(source.robot, data)
    if not residuals:
        return
    (length, angle, convention, unit), best = min(residuals.items(), key=lambda entry: entry[1])
    others = sorted(residuals.values())[1:2]
    if best >= LARGEST_RESIDUAL or any(value < LIMITS.told_apart * best for value in others):
        return
    than = f", read in any other way at least {1e3 * others[0]:.3g} mm" if others else ""
    yield "length", length, f"median residual of the nominal robot {1e3 * best:.3g} mm{than}"
    yield "angle", angle, "the same"
    yield "rotation", ",".join(names), "by their names: poses of a fixed board in the frame of a camera on the tool"
    yield "convention", convention, "the same"
    if unit is not None:
        yield "rotation-angle", unit, "the same"
    yield "camera-on-tool", True, "the nominal robot explains the inverse poses alone"


def deviations(source: Source) -> Iterator[Entry]:
    """(option, value, why) of standard deviations of the positions; an empty option says why there are none."""
    names = guess_deviations(source.numbers, source.markers)
    if names is None:
        return
    data = source.read(replace(source.table, std=names))
    if data is None or data.std is None or float(data.std.nanmedian()) > LARGEST_DEVIATION:
        yield "", "", f"{few(names)}: no standard deviations of positions, or not all positive; not used"
        return
    typical = 1e3 * float(data.std.nanmedian())
    yield "std", ",".join(names), f"by their names; median {typical:.2g} mm, noise beyond these is estimated"


def distance_lines(csv: Path, sheet: Sheet, column: str, unit: str) -> Iterator[str]:
    """Options about known distances between sockets as lines for the user to complete: no table holds them."""
    header, rows = read_cells(csv, sheet.sep)
    place = header.index(column)
    names = list(dict.fromkeys(cells[place].strip() for _, cells in rows if cells[place].strip()))
    if len(names) < 2:
        yield "there is one socket alone, and no distance to know: the URDF gives the robot's size"
        return
    length, deviation = ("0.05", "0.00003") if unit == "m" else ("50", "0.03")
    pair = f"{names[0]},{names[1]}={length}"
    yield f'distance = ["{pair}"]  # measure it, in {unit}, and uncomment: it gives the robot its size'
    yield f"distance-std = {deviation}  # how well it is known, in {unit}: so well with a caliper"
