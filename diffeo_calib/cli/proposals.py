"""What `diffeo-calib init` proposes beyond joints and positions: rotations and standard deviations, if they fit."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

from diffeo_calib.calibration.diagnostics.likely_mistakes import LIMITS, residual_of, residuals_by_convention
from diffeo_calib.calibration.identification.registration import register_sockets
from diffeo_calib.calibration.placing.readings import identify_readings
from diffeo_calib.common.errors import DiffeoCalibError, InputError, few
from diffeo_calib.measurements.csv.cells import read_cells
from diffeo_calib.measurements.csv.files import read_observations, read_table
from diffeo_calib.measurements.csv.guess import (
    PAYLOADS,
    SESSIONS,
    Sheet,
    guess_column,
    guess_deviations,
    guess_positions,
    guess_reading,
    guess_rotation,
    guess_sockets,
)
from diffeo_calib.measurements.csv.sensors import ReadingColumns, SocketColumns, TableColumns
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.range import UNKNOWN_ZERO_M

CONVENTION_OF_COUNT = {3: "xyz", 4: "quat_xyzw", 9: "matrix"}
"""Number of rotation columns -> the convention that is tried first."""
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

    def entries(self) -> Iterator[tuple[str, str | list[str], str]]:
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


def beside(source: Source, sheet: Sheet) -> Iterator[tuple[str, str, str]]:
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
        return data.with_joint_names(self.robot.joint_names)

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


def rotation(source: Source) -> Iterator[tuple[str, str, str]]:
    """(option, value, why) of a rotation: the convention with which the nominal robot explains the poses best.

    Nothing if there are no such columns, or no convention is clearly better than all others; then a last entry whose
    option is empty says so.
    """
    names = guess_rotation(source.numbers, source.markers[0]) if len(source.markers) == 1 else None
    if names is None or set(names) & set(source.joints):
        return
    units = ("deg", "rad") if len(names) == 3 else (None,)
    residuals: dict[tuple[str, str | None], float] = {}
    for unit in units:
        first = CONVENTION_OF_COUNT[len(names)]
        data = source.read(replace(source.table, rotation=names, convention=first, rotation_angle=unit))
        if data is not None:
            found = residuals_by_convention(source.robot, data)
            residuals |= {(convention, unit): residual for convention, residual in found.items()}
    (convention, unit), best = min(
        residuals.items(), key=lambda entry: entry[1], default=(("", None), LARGEST_RESIDUAL)
    )
    others = [value for reading, value in residuals.items() if reading != (convention, unit)]
    if best >= LARGEST_RESIDUAL or any(value < LIMITS.told_apart * best for value in others):
        yield "", "", f"{few(names)}: rotations of no convention that is clearly better than others; not used"
        return
    than = f", with any other convention or unit at least {1e3 * min(others):.3g} mm" if others else ""
    yield "rotation", ",".join(names), "by their names; without these three lines positions alone are calibrated"
    yield "convention", convention, f"median residual of the nominal robot {1e3 * best:.3g} mm{than}"
    if unit is not None:
        yield "rotation-angle", unit, "the same"


def deviations(source: Source) -> Iterator[tuple[str, str, str]]:
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
