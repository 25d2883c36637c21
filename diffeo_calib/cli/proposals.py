"""Proposals of `diffeo-calib init` beyond joints and positions: rotations and standard deviations, if they fit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from math import inf, log
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates, likely_mistakes
from diffeo_calib.calibration.diagnostics.plausibility import marker_column, unmeasured_markers
from diffeo_calib.calibration.identification.registration import register, register_sockets, spread
from diffeo_calib.calibration.placing.readings import identify_readings
from diffeo_calib.cli.column_names import column
from diffeo_calib.cli.guesses import (
    LENS,
    SOME_LENS,
    Choice,
    JointColumns,
    RowColumns,
    Sheet,
    entries,
    guess_deviations,
    guess_rotation,
)
from diffeo_calib.cli.options import Rows
from diffeo_calib.cli.tables import readings_columns
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import DiffeoCalibError, MeasurementError, few
from diffeo_calib.measurements.checks import LARGEST_JOINT_ANGLE_RAD, quiet
from diffeo_calib.measurements.csv.files import read_observations
from diffeo_calib.measurements.csv.joints import JointExpressions
from diffeo_calib.measurements.csv.lines import read_cells
from diffeo_calib.measurements.csv.sensors import SocketColumns
from diffeo_calib.measurements.poses import ALL_CONVENTIONS, numbers_of
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import UNITS_PER_METRE, TableFormat
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.tables import check_poses, divided, measured_positions

BALL_SEARCH = {"maxfev": 150, "initial_simplex": [[0.0] * 3, [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]]}
"""Of the ball on the tool by images, m."""
FEWEST_IMAGES = 8
"""Rows of a camera from which a projection, 11 numbers, can be contradicted."""
LARGEST_RESIDUAL = 0.1
"""Median residual, as a share of the spread, above which no reading is right."""
UNITS = (*UNITS_PER_METRE,), ("rad", "deg")
MOST_LENGTHS = 2
"""Units of length, by the size of the robot, with which meanings of the joints are sought."""
SMALLEST_SPREAD_M = 1e-9
"""Of points that never move."""
LARGEST_DEVIATION = 0.01
"""Median standard deviation of a measured position, m, above which a column holds something else."""


def beside(source: Source, sheet: Sheet) -> Iterator[Choice]:
    """Rotations, standard deviations and distances of sockets."""
    if source.rows.sockets:
        yield from distances(source.csv, sheet, source.rows.sockets[-1], source.table.length)
    if source.rows.markers:
        yield from rotation(source)
        yield from deviations(source)


def marker(source: Source) -> Choice | None:
    """The column that names the marker of each row, if the nominal robot explains the rows by several alone."""
    alone = len(source.rows.markers) == 1 and not (source.rows.sockets or source.rows.readings)
    for _, _, data in source.in_units() if alone else ():
        with quiet(), suppress(DiffeoCalibError):
            found = marker_column(register(source.robot, data.q, data.points).geometry, data)
            if found is not None:
                return Choice("marker", found[0], f"names the marker of each row: {found[1]}")
    return None


@dataclass(frozen=True)
class Source:
    """A table whose joints, positions and units are known."""

    csv: Path
    robot: Tree
    joints: Any
    rows: RowColumns
    table: TableFormat
    numbers: tuple[str, ...]
    tips: Sequence[str] = ()
    marker: Choice | None = None

    def read(self, table: TableFormat) -> Any:
        """The rows in another format, of any kinds."""
        rows, session = self.rows, self.rows.named.get("session")
        options = Rows(session=session, camera_on_tool=table.camera_on_tool)
        table = replace(
            table,
            joints=self.joints,
            kinds=self.robot.kinds,
            position=rows.markers or None,
            sockets=SocketColumns(tuple(rows.sockets)) if rows.sockets else None,
            readings=readings_columns([text.replace(LENS, SOME_LENS) for text in rows.readings], options),
            session=session if rows.markers else None,
            marker=None if self.marker is None else str(self.marker.value),
            camera_on_tool=table.camera_on_tool and not rows.of_boards,  # it is said of the corners
        )
        data: Any = read_observations(self.csv, table, duplicates="keep")
        data = data.with_joint_names(self.robot.joint_names)
        return data.with_tips(self.tips) if self.tips else data

    def residual(self, table: TableFormat) -> float:
        """Median residual of the nominal robot in another format, as a share of the spread over all rows.

        Of positions of the largest set-up, else of the ball in its socket, of readings or of a camera's image. In a
        wrong unit the residual alone may be small too. Infinite if the table cannot be read so.
        """
        with quiet(), suppress(DiffeoCalibError):
            return self.read_residual(table)
        return inf

    def residuals(self, formats: Iterable[TableFormat]) -> list[tuple[float, TableFormat]]:
        """In every format; the smallest first."""
        return sorted(((self.residual(table), table) for table in formats), key=lambda found: found[0])

    def read_residual(self, table: TableFormat) -> float:
        """The same; DiffeoCalibError says why a table cannot be read so, or calibrates nothing."""
        data = self.read(table)
        positions = measured_positions(data)
        if positions is None or table.rotation is not None:
            check_poses(data)
        if positions is not None:
            own = positions.largest_session()
            if (left := likely_mistakes.residual_of(self.robot, own)) == inf:
                what, expected = f"{len(own)} row(s) of '{self.csv}'", "enough for base and markers, at several places"
                raise MeasurementError.of(what, expected=expected, fix="measure more rows")
            return left / max(spread(own.points), SMALLEST_SPREAD_M)
        own, readings = divided(data)
        if own is not None:
            return _in_sockets(self.robot, own.table)
        tables = [one.table for one in readings]
        lengths = [one for one in tables if one.kind != "image"]
        if not lengths:
            return max(_in_images(self.robot, one) for one in tables)
        size = float(torch.cat([one.reported.flatten() for one in lengths]).square().mean().sqrt())
        rms = identify_readings(Geometry.nominal(self.robot), lengths, rigid=True)[0].rms
        return rms / max(size, SMALLEST_SPREAD_M)

    def conventions(self, best: float) -> Iterator[Choice]:
        """Units and `joints` with which the robot explains positions; nothing if there are none.

        Args:
            best: share that the best units leave with the columns as they are.
        """
        if self.rows.sockets or self.rows.readings:
            return
        turning = torch.tensor(self.robot.periodic, dtype=torch.bool, device=HOST)
        likely = list[tuple[float, str, str, Measurements]]()
        for length, angle, own in self.in_units():
            if length in (entry[1] for entry in likely):
                continue
            small = float(own.q[:, turning].abs().max()) < LARGEST_JOINT_ANGLE_RAD
            moved = spread(self.robot.tip_poses(own.q)[:, :1, :3, 3]), spread(own.points)
            if (angle == "deg" or small) and min(moved) > 0.0:
                likely.append((abs(log(moved[0] / moved[1])), length, angle, own))
        for _, length, angle, data in sorted(likely, key=lambda entry: entry[0])[:MOST_LENGTHS]:
            found = likely_mistakes.conventions_of(self.robot, data, angle)
            joints, units = JointExpressions.of(self.joints), (angle, UNITS_PER_METRE[length])
            for one in found:
                own = one.of_columns(joints.matrix, joints.offset, *units)
                text = ",".join(own.texts(joints.columns, *units))
                why = f"the nominal robot then leaves {100 * one.left:.2g} % of what the rows vary, with the columns "
                why += f"as they are {100 * best:.3g} %"
                why += "; these rows do not tell which: uncomment one" * (len(found) > 1)
                yield Choice("joints", text, why, sure=len(found) == 1)
            if found:
                table = replace(self.table, length=length, angle=angle)
                yield from entries([table], length="with these joints", angle="the same")
                return

    def in_units(self) -> Iterator[tuple[str, str, Measurements]]:
        """Units of length and angle, and the positions of the largest set-up in these, unless the file says others."""
        for length, angle in product(*UNITS):
            found = None
            with quiet(), suppress(DiffeoCalibError):
                found = measured_positions(self.read(replace(self.table, length=length, angle=angle)))
            if found is not None:
                yield length, angle, found.largest_session()

    def words(self, best: float, others: float) -> str:
        """Residuals with the best units, and the smallest with other units."""
        what = "the nominal robot spreads the ball in a socket, relative to all rows, by"
        what = "images of the nominal robot differ, relative to all rows, by" if self.rows.readings else what
        what = what if self.rows.without_length else "the nominal robot leaves, of what the rows vary,"
        than = f"in other units at least {100 * others:.3g} %" if others < inf else "the table contradicts other units"
        return f"{what} {100 * best:.2g} %, {than}"


def _in_sockets(robot: Tree, data: Measurements) -> float:
    """Median distance of the ball from the middle of its socket, as a share of its spread over all rows."""
    if data.socket is None:
        return inf
    found = register_sockets(robot, data.q, data.socket)
    seen = found.positions[data.socket]
    spread = float((seen - seen.mean(0)).norm(dim=1).median())
    return float(found.distances.median()) / spread if spread > 0.0 else inf


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


def joint_columns(source: Source, found: Sequence[JointColumns]) -> tuple[Source, list[Choice]]:
    """The columns of the joints, and why: of those that names do not tell apart those that the nominal robot explains.

    Where it does not tell them apart either, a remark for each asks the user.
    """
    best, equal, clear = found[0], [one for one in found if one.rank == found[0].rank], [(1.0, found[0])]
    for length in UNITS_PER_METRE if len(equal) > 1 else ():
        tables = [replace(source.table, length=length, angle=angle) for angle in ("rad", "deg")]
        tried = [(replace(source, joints=one.names).residuals(tables)[0][0], one) for one in equal]
        (least, own), (second, _), *_ = sorted(tried, key=lambda entry: entry[0])
        clear.append((second / least if 0 < least < LARGEST_RESIDUAL else 1.0, own))
    ratio, taken = max(clear, key=lambda entry: entry[0])
    if len(equal) > 1 and ratio < gates.READINGS_TOLD_APART:
        why = "uncomment the right line"
        lines = [Choice("joints", ",".join(one.names), f"{why}: {one.how}", sure=False) for one in equal]
        return replace(source, joints=best.names), lines
    why = taken.how + f"; the nominal robot explains them {ratio:.3g} times better" * (len(equal) > 1)
    for one in (one for one in found[:4] if one is not taken):
        why += f"; not {one.names[0]} to {one.names[-1]}" + " (commanded)" * bool(one.rank and one.rank[0])
    return replace(source, joints=taken.names), [Choice("joints", ",".join(taken.names), why)]


def measured(source: Source) -> Source:
    """The same with the column of its markers, if any.

    Without markers that are copies, or that the nominal robot explains in some units and others not.
    """
    found, several = dict[int, str](), len(source.rows.markers) > 1
    for _, _, positions in source.in_units() if several else ():
        every = unmeasured_markers(source.robot, positions)
        found = found or {marker: words for marker, words, proved in every if proved}
    rows, kept = source.rows, [k for k in range(len(source.rows.markers)) if k not in found]
    left = [f"{few(rows.markers[k])}: {words} (counted from 0)" for k, words in found.items()]
    rows = replace(rows, markers=[rows.markers[k] for k in kept], left=[*rows.left, *left])
    seen = replace(source, rows=rows, tips=[source.tips[k] for k in kept] if source.tips else source.tips)
    return replace(seen, marker=seen.marker or marker(seen))


def other_units(source: Source, table: TableFormat) -> list[str]:
    """Columns of joints and positions whose names say other units."""
    turning = [name for name, turns in zip(source.joints, source.robot.periodic, strict=True) if turns]
    places = [name for triple in source.rows.markers for name in triple]
    pairs = *product(turning, (table.angle,)), *product(places, (table.length,))
    return [name for name, unit in pairs if column(name).unit not in ("", unit)]


def is_clear(found: Sequence[tuple[float, Any]], ratio: float) -> bool:
    """Whether the first of some residuals is small, and every other one larger by this ratio."""
    (best, _), *others = found
    return best < LARGEST_RESIDUAL and all(value >= ratio * best for value, _ in others)


def rotations(source: Source) -> list[tuple[Sequence[str], str]]:
    """The columns of a rotation of each marker, by their names, and what these usually mean."""
    if source.rows.matrix:
        return [(source.rows.matrix, "a matrix")]
    used = {*source.joints, *(name for triple in source.rows.markers for name in triple)}
    others = [name for name in source.numbers if name not in used]
    guessed = [guess_rotation(others, marker) for marker in source.rows.markers]
    return [one for one in guessed if one is not None]


def rotation(source: Source, *, camera: bool = False) -> Iterator[Choice]:
    """A rotation: the convention with which the nominal robot explains the poses clearly better than with all others.

    With ``camera`` in any units too, as poses of a fixed board in the frame of a camera on the tool. Nothing if there
    are no columns of a rotation; a remark, but for a camera, if no convention is clearly better.
    """
    found, table = rotations(source), source.table
    if not found or source.marker is not None:
        return
    each, names = [list(own) for own, _ in found], list(dict.fromkeys(name for own, _ in found for name in own))
    own_body = len(source.rows.markers) == max(len(source.tips), 1) == len(each) and len(names) == sum(map(len, each))
    conventions = [name for name in ALL_CONVENTIONS if numbers_of(name) == len(each[0])] if own_body else []
    turns = product(conventions, ("deg", "rad") if len(each[0]) == 3 else (None,))
    units = product(UNITS_PER_METRE, ("rad", "deg")) if camera else [(table.length, table.angle)]
    known = replace(table, rotation=each[0] if len(each) == 1 else each, camera_on_tool=camera)
    ways = [(*unit, *turn) for unit, turn in product(units, turns)]
    clear = source.residuals(replace(known, length=a, angle=b, convention=c, rotation_angle=d) for a, b, c, d in ways)
    if not clear or not is_clear(clear, gates.READINGS_TOLD_APART):
        what = "rotations of no convention that is clearly better than others"
        what = what if own_body else "rotations, but not one for each marker"
        usual = " or ".join(dict.fromkeys(words for _, words in found))
        if not camera:
            yield Choice("", "", f"{few(names, 9)}: {what}; not used; such names usually mean {usual}")
        return
    (best, table), *worse = clear
    why = f"the nominal robot leaves, of what the rows vary, {100 * best:.2g} %"
    why += f", read in any other way at least {100 * worse[0][0]:.3g} %" if worse and worse[0][0] < inf else ""
    written = [",".join(own) for own in each]
    if camera:
        seen = "the nominal robot explains poses of a fixed board alone, seen from the tool"
        yield from entries([table], length=why, angle="the same", camera_on_tool=seen)
    without = "without these three lines positions alone are calibrated"
    yield Choice("rotation", written[0] if len(written) == 1 else written, f"by their names; {without}")
    yield from entries([table], convention=why, rotation_angle="the same")


def deviations(source: Source) -> Iterator[Choice]:
    """Standard deviations of the positions, or a remark why there are none."""
    names = guess_deviations(source.numbers, source.rows.markers)
    if names is None:
        return
    found = None
    with quiet(), suppress(DiffeoCalibError):
        found = measured_positions(source.read(replace(source.table, std=names)))
    if found is None or found.std is None or (typical := float(found.std.nanmedian())) > LARGEST_DEVIATION:
        yield Choice("", "", f"{few(names)}: no standard deviations of positions, or not all positive; not used")
        return
    why = f"by their names; median {1e3 * typical:.2g} mm, noise beyond these is estimated"
    yield Choice("std", ",".join(names), why)


def distances(csv: Path, sheet: Sheet, column: str, unit: str) -> Iterator[Choice]:
    """Options about known distances between sockets, for the user to complete: no table holds them."""
    header, rows = read_cells(csv, sheet.sep)
    place = header.index(column)
    names = list(dict.fromkeys(cells[place].strip() for _, cells in rows if cells[place].strip()))
    if len(names) < 2:
        yield Choice("", "", "there is one socket alone, and no distance to know: the URDF gives the robot's size")
        return
    length, deviation = (f"{metres * UNITS_PER_METRE[unit]:g}" for metres in (0.05, 3e-5))
    why = f"measure it, in {unit}, and uncomment: it gives the robot its size"
    yield Choice("distance", [f"{names[0]},{names[1]}={length}"], why, sure=False)
    yield Choice("", "", f"distance-std = {deviation}  # how well it is known, in {unit}: so well with a caliper")
