"""What `diffeo-calib init` proposes beyond joints and positions: rotations and standard deviations, if they fit."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

from diffeo_calib.calibration.diagnostics.likely_mistakes import LIMITS, residual_of, residuals_by_convention
from diffeo_calib.calibration.identification.socket_registration import register_sockets
from diffeo_calib.calibration.placing.readings import identify_readings
from diffeo_calib.common.errors import DiffeoCalibError, few
from diffeo_calib.measurements.csv.cells import read_cells
from diffeo_calib.measurements.csv.files import read_observations, read_table
from diffeo_calib.measurements.csv.guess import Sheet, guess_deviations, guess_rotation
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
class Source:
    """A table whose joints, positions and units are known."""

    csv: Path
    robot: Tree
    joints: list[str]
    markers: list[list[str]]
    table: TableFormat
    numbers: tuple[str, ...]
    sockets: tuple[str, ...] = ()
    reading: ReadingColumns | None = None

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
