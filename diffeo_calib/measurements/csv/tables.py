"""Tables of joint values and measurements, all of whose rows are checked together."""

from __future__ import annotations

import math
import shlex
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError, few, shown, warn_user
from diffeo_calib.measurements.csv.cells import LARGEST_NUMBER, bad_cells, find_columns, number_hint, numbers_in
from diffeo_calib.measurements.csv.columns import POSITIONS, Body, Column, Columns, PoseColumns
from diffeo_calib.measurements.csv.lines import ANGLES, CsvLines, Lines, stated_unit
from diffeo_calib.measurements.poses import (
    POINTS,
    inverse_poses,
    points_of_frames,
    readings_of,
    rotation_matrices,
    transforms_of_frames,
)
from diffeo_calib.measurements.table_format import ANGLE_UNITS, UNITS_PER_METRE, ZERO, flat_names, options_of


@dataclass(frozen=True)
class TableOrigin:
    """A table in a file, which of its columns were read, and how."""

    path: Path
    columns: Columns
    sha256: str

    @property
    def options(self) -> str:
        """The options with which the command line reads this table, as a shell would take them."""
        joints, table = self.columns.joints, self.columns.table
        if isinstance(joints, PoseColumns):
            return shlex.join(["--robot-pose", joints.text, *options_of(replace(table, joints=()))])
        return shlex.join(options_of(replace(table, joints=joints.texts)))

    def numeric_columns(self, line_numbers: Tensor, *, gaps: bool = False) -> dict[str, Tensor]:
        """All columns whose cells in these lines (N,) are numbers, each (N,) in the units of the file.

        With ``gaps`` some cells may be empty or not a number, and are NaN then.
        """
        columns = {}
        for name, cells in self.texts(line_numbers).items():
            values = numbers_in(cells, self.columns.table.decimal)
            there = [value for value in values if not gaps or value is None or not math.isnan(value)]
            if there and all(value is not None and math.isfinite(value) for value in there):
                columns[name] = torch.tensor(values, dtype=torch.float64, device=HOST)
        return columns

    def texts(self, line_numbers: Tensor) -> dict[str, list[str]]:
        """The cells of all columns in these lines (N,); empty if the file has changed since, or is gone."""
        if not self.path.is_file():
            return {}
        try:
            file = CsvLines(self.path, self.columns.table.sep, self.columns.names)
            rows = dict(file.rows()) if file.sha256 == self.sha256 else {}
            wanted = [rows[line] for line in line_numbers.tolist()]
        except (MeasurementError, KeyError):
            return {}
        return dict(zip(file.header, map(list, zip(*wanted, strict=True)), strict=True))


FEW_ROWS = 2000  # rows among which those of a marker that was not seen are looked for
MUCH_FARTHER = 3.0
"""Times the largest distance of a row from its nearest one: so far is a single 0, 0, 0 where it is no position."""


class FileRows(NamedTuple):
    """Rows of a file."""

    path: Path  # the file
    columns: Columns  # its columns
    raw: Tensor  # (N, c) numbers in these, in its units
    texts: Mapping[str, Sequence[str]]  # its columns of texts
    lines: Sequence[int]  # their numbers in the file
    sha256: str  # of the file, as of :class:`CsvLines`

    def of(self, rows: Tensor) -> FileRows:
        """The rows with these numbers (M,), or those that a mask (N,) chooses."""
        chosen = torch.arange(len(self.lines), device=HOST)[rows].tolist()
        texts = {name: [cells[row] for row in chosen] for name, cells in self.texts.items()}
        return self._replace(raw=self.raw[rows], texts=texts, lines=[self.lines[row] for row in chosen])

    @property
    def q(self) -> Tensor:
        """(N, n) joint values, rad or m."""
        joints = self.columns.joints
        return joints.values(self.raw[:, : len(joints.columns)]) / self.columns.per_joint

    def numbers(self, some: Sequence[Column]) -> Tensor:
        """(N, k) numbers of some columns, in SI."""
        read = self.columns.read(some)
        return self.raw[:, self.columns.places(read)] / self.raw.new_tensor([column.per_si for column in read])

    @property
    def beside(self) -> dict[str, Tensor]:
        """(N,) payloads, times and temperatures, of those that are named."""
        names = {name: column.strip() for name, column in self.columns.table.beside.items()}
        by_name = {column.name: column for column in self.columns.numbers}
        return {name: self.numbers([by_name[column]])[:, 0] for name, column in names.items()}

    def filled(self, column: str) -> Tensor:
        """(N,) boolean, which rows have a text in a column."""
        return torch.tensor([bool(text) for text in self.texts[column]], dtype=torch.bool, device=HOST)

    def named(self, column: str, expected: str, fix: str = "fill it in") -> Sequence[str]:
        """The texts of a column; MeasurementError for empty ones, which says what is expected and what to do."""
        empty = [line for line, text in zip(self.lines, self.texts[column], strict=True) if not text]
        if empty:
            raise bad_cells(self.path, [(line, column, "") for line in empty], expected, fix)
        return self.texts[column]

    def devices(self, column: str | None, expected: str, fix: str = "fill it in") -> Sequence[str] | None:
        """Names of devices or set-ups; None without a column, or where other kinds of rows alone fill it."""
        if column is None or (self.columns.all_hidden and not any(self.texts[column])):
            return None
        return self.named(column, expected, fix)


def read_table(path: Path, columns: Columns, *, zeros: bool = True) -> FileRows:
    """All rows of a file.

    Args:
        columns: which columns it has, and their units; the text "nan" is empty.
        zeros: whether markers that are at 0, 0, 0 far from other rows are hidden there, lines without joint values are
            left out, and columns may have the other decimal mark.
        MeasurementError: any mistake in the file; standard deviations that are not positive, negative payloads.

    Warns:
        DiffeoCalibWarning: values that look as if they were in another unit; what the file holds beside rows of
            numbers; rows that are left out because no marker was seen.
    """
    texts = columns.texts
    needed = [name for name, needed in texts.items() if needed]
    file = CsvLines(path, columns.table.sep, [*columns.names, *needed])
    named = [name for name in texts if name in needed or name in file.header]
    in_a_plane = ZERO not in file.header and any(names[2] == ZERO for names in columns.table.triples)
    columns = replace(columns, numbers=tuple(one for one in columns.numbers if not (in_a_plane and one.name == ZERO)))
    places = find_columns(path, file.header, [*columns.names, *named], file.sep)
    some, marker = file.rows(), columns.table.marker
    if columns.table.triples and zeros:
        names = file.header.index(marker.partition("=")[0]) if marker is not None else None
        some = _with_joints(path, some, places[: len(columns.joints.columns)], names)
    lines, rows = zip(*some, strict=True)
    cells = [[row[place] for row in rows] for place in places]
    file.units |= {file.header[place]: "deg" for place, own in zip(places, cells, strict=True) if "°" in "".join(own)}
    _check_units(file, columns)
    words = [["" if text.lower() == "nan" else text for text in column] for column in cells[len(columns.names) :]]
    numbers, notes = _numbers(path, columns, lines, cells[: len(columns.names)], whole=zeros)
    for column, values in zip(columns.numbers, numbers[:, len(columns.joints.columns) :].T, strict=True):
        check = column.check
        wrong = [] if check is None else (values < 0 if check.zero else values <= 0).nonzero()[:, 0].tolist()
        if check is not None and wrong:
            bad = [(lines[row], column.name, f"{float(values[row]):g}") for row in wrong]
            raise bad_cells(path, bad, check.expected, check.fix)
    read = [*columns.names, *named, *(text for column in words for text in column)]
    notes = [note for note in file.notes if not (note.startswith("text in") and "".join(read).isascii())] + notes
    for text in ["; ".join(notes)] * bool(notes) + columns.unlikely_units(numbers):
        warn_user(f"file '{path}': {text}")
    for body in columns.hideable:
        if bool(numbers[:, columns.places(body.values)].isnan().all()):
            what = f"file '{path}', columns {few([column.name for column in body.values])}: empty in all lines"
            raise MeasurementError.of(what, expected=f"some line that {body.word}", fix="leave them out")
    markers = columns.hideable[: len(columns.table.triples)]
    for body in markers if zeros else ():
        _hide_marks(path, columns, numbers, lines, body)
    whole = FileRows(path, columns, numbers, dict(zip(named, words, strict=True)), lines, file.sha256)
    if not markers or columns.all_hidden:
        return whole
    visible = ~torch.stack([numbers[:, columns.places(body.values)].isnan().all(1) for body in markers]).all(0)
    if gone := [lines[row] for row in (~visible).nonzero()[:, 0].tolist()]:
        warn_user(f"file '{path}': no marker was seen in line {few(gone)}: {len(gone)} row(s) left out")
    return whole.of(visible)


def _with_joints(path: Path, rows: Lines, places: Sequence[int], names: int | None) -> Lines:
    """Lines with joint values: those without any are left out, or have those above where a column names the marker.

    Not where the marker was named since: the joint values of that pose are missing.
    """
    empty = {line for line, cells in rows if not any(cells[place] for place in places)}
    if not empty or len(empty) == len(rows):
        return rows
    if names is None:
        warn_user(f"file '{path}': no joint values in line {few(sorted(empty))}: {len(empty)} row(s) left out")
        return [(line, cells) for line, cells in rows if line not in empty]
    above, filled, named = dict[int, str](), list[tuple[int, list[str]]](), set[str]()
    for line, cells in rows:
        if line not in empty:
            above, named = {place: cells[place] for place in places}, set()
        elif cells[names] in named:
            above = {}
        named.add(cells[names])
        filled.append((line, [above.get(place, cell) for place, cell in enumerate(cells)]))
    return filled


def _numbers(
    path: Path, columns: Columns, lines: Sequence[int], cells: Sequence[Sequence[str]], *, whole: bool
) -> tuple[Tensor, list[str]]:
    """Numbers (N, c) of the cells of each column, NaN where a marker is hidden, and what was taken as empty.

    ``whole``: whether no rows will be added.
    MeasurementError for other cells without a number.
    """
    names, decimal, hideable = columns.names, columns.table.decimal, columns.hideable
    parsed = [numbers_in(column, decimal, whole=whole) for column in cells]
    if any(None in column for column in parsed):
        rows = zip(lines, zip(*cells, strict=True), zip(*parsed, strict=True), strict=True)
        bad = [(line, names[k], texts[k]) for line, texts, read in rows for k, cell in enumerate(read) if cell is None]
        raise bad_cells(path, bad, "a number", number_hint(bad[0][2], decimal))
    numbers = torch.tensor(parsed, dtype=torch.float64, device=HOST).T
    empty, large = numbers.isnan(), numbers.abs() >= LARGEST_NUMBER
    needed, shows = torch.zeros_like(empty), torch.zeros_like(empty[:, 0])
    theirs = torch.zeros_like(empty[:1])
    for body in hideable:
        values, every = columns.places(body.values), columns.places(body.columns)
        here = ~(empty[:, values].all(1) | large[:, values].all(1))
        needed[:, every] |= here[:, None]
        theirs[:, every] = True
        shows |= here
    excused = theirs & ~needed
    if hideable and not columns.all_hidden:
        excused[:, len(columns.joints.columns) :] |= ~shows[:, None]  # the row is left out
    gaps = empty | large
    wrong: list[tuple[int, int]] = (gaps & ~excused).nonzero().tolist()
    if wrong:
        hint = " (all cells of a hidden marker or frame are empty)" * bool(hideable)
        huge = bool((large & ~numbers.isinf() & ~excused).any())
        expected = f"a number below {LARGEST_NUMBER:g} in size" if huge else "a finite number"
        bad = [(lines[row], names[k], cells[k][row]) for row, k in wrong]
        raise bad_cells(path, bad, expected, f"remove or repair these lines{hint}")
    words = defaultdict[str, list[int]](list)
    hidden: list[tuple[int, int]] = gaps.nonzero().tolist()
    for row, k in hidden:
        if cells[k][row].lower() not in ("", "nan"):
            words[cells[k][row]].append(lines[row])
    said = " and ".join(f"'{shown(text)}' ({len(at)})" for text, at in words.items())
    at = few(sorted({line for group in words.values() for line in group}))
    notes = [f"cells that hold {said} are taken as empty (line {at})"] * bool(words)
    return numbers.masked_fill(gaps, math.nan), notes


def _hide_marks(path: Path, columns: Columns, numbers: Tensor, lines: Sequence[int], body: Body) -> None:
    """Write NaN where a marker is at 0, 0, 0, or thrice at -9999, far from all rows: a device does not see it then.

    One row at 0, 0, 0 may be the frame's origin, or the first pose: all others must be farther from it than from one
    another. Another number must stand in rows of several configurations.
    """
    at = columns.places([column for column in body.of(POSITIONS) if column.unit == columns.table.length])
    points, q = numbers[:, at], numbers[:, : len(columns.joints.columns)]
    alike = (points == points[:, :1]).all(1) & ((points[:, 0] == 0.0) | (len(at) > 1))  # a distance alone may repeat
    for mark in points[alike, 0].unique().tolist():
        lost = alike & (points[:, 0] == mark)
        others = points[~lost & points.isfinite().all(1)] - mark
        some, single = others[:FEW_ROWS].unique(dim=0), len(q[lost].unique(dim=0)) == 1
        if len(some) < 2 or (single and mark != 0.0):
            continue
        apart = torch.cdist(some, some).fill_diagonal_(math.inf).amin(1)
        limit = MUCH_FARTHER * apart.amax() if single or mark != 0.0 else apart.median()
        if bool(others.norm(dim=1).amin() > limit):
            for place in columns.places(body.columns):
                numbers[lost, place] = math.nan
            names, said = few([columns.names[k] for k in at]), ", ".join([f"{mark:g}"] * len(at))
            where = few([lines[row] for row in lost.nonzero()[:, 0].tolist()])
            warn_user(f"file '{path}': {names} are {said} in line {where}, far from other rows: taken as not seen")


def _check_units(file: CsvLines, columns: Columns) -> None:
    """Raise MeasurementError where the file states another unit of a wanted column than it is read with."""
    table = columns.table
    joints = zip(columns.joints.texts, columns.prismatic.tolist(), columns.joints.plain.tolist(), strict=True)
    units = [(name, table.joint_unit if slide else table.angle) for name, slide, plain in joints if plain]
    read: dict[str, Any] = dict(units)
    read |= {column.name: column.unit for column in columns.numbers if column.unit}
    stated = {name: stated_unit(name, file.units) for name in read}
    if not columns.kinds_known:  # the joints may be prismatic
        stated |= {name: None for name, _ in units if stated[name] not in ANGLES}
    wrong = [name for name, unit in read.items() if isinstance(unit, str) and stated[name] not in (None, unit)]
    for name in sorted(wrong, key=lambda name: stated[name] in (*UNITS_PER_METRE, *ANGLE_UNITS)):  # cm, inch first
        what, expected = f"file '{file.path}', column '{shown(name)}'", f"{read[name]}, as stated"
        raise MeasurementError.of(
            what, expected=expected, got=f"{stated[name]} in the file", fix="state the unit of the file, or convert it"
        )


# --- other ways to read a table

INVERTED = (
    "the poses seem to be those of the measuring frame, seen from the tool: if a camera on the tool sees a board, "
    "pass camera_on_tool=True (--camera-on-tool), else give the poses of the tool in the measuring frame"
)
NOT_INVERTED = (
    "the poses seem to be those of the camera in the board's frame already, or those of a board on the tool that a "
    "fixed camera sees: leave camera_on_tool (--camera-on-tool) out"
)


def rereadings(data: Any) -> Iterator[dict[str, Any]]:
    """Measured poses whose rotations are read in other ways, or whose poses are inverted; none without poses.

    Each as its ``points`` (N, P, 3), m, words about it and, where one option alone differs, the ``option`` that reads
    the table so; and their tips ``on``; ``partial`` where positions alone are explained.
    """
    if data.frames is None or data.lever is None:
        return
    lever, on, seen_from_tool = data.lever, data.on or (), data.board is not None
    convert = inverse_poses if seen_from_tool else torch.clone  # there and back
    written = convert(data.frames)

    def reread(frames: Tensor, words: str, option: str = "") -> dict[str, Any]:
        return {"points": points_of_frames(convert(frames), lever), "words": words, "option": option, "on": on}

    turns, places = written[..., :3, :3], written[..., :3, 3]
    yield reread(inverse_poses(written), NOT_INVERTED if seen_from_tool else INVERTED)
    words = "the rotations alone seem to be inverted (transposed): give those that belong to the positions"
    yield reread(transforms_of_frames(turns.mT, places), words)
    for rotations, words, option in _rewritten(data):
        yield reread(transforms_of_frames(rotations.to(places.device), places), words, option)
    if not seen_from_tool:  # else the place of the camera follows from its rotation
        words = "the positions alone fit: check the convention and the unit of the rotation columns"
        yield {"points": places, "words": words, "on": on[::POINTS], "partial": True}


def with_coordinate(data: Any, marker: int, axis: int, values: Tensor) -> Tensor:
    """The points (N, P, 3) with other values (N,) of one coordinate of a marker, or of a pose's origin, m."""
    points, values = data.points.clone(), values.to(data.points.device)
    if data.frames is None:
        points[:, marker, axis] = values.where(~points[:, marker, axis].isnan(), torch.nan)
        return points
    convert = inverse_poses if data.board is not None else torch.clone
    written = convert(data.frames)
    written[:, marker, axis, 3] = values
    return points_of_frames(convert(written), data.lever)


def numeric_table(data: Any) -> tuple[Columns | None, Mapping[str, Tensor]]:
    """How measurements were read, and all numeric columns of their file; None without it, or of rows of many lines."""
    if not isinstance(data.origin, TableOrigin) or data.origin.columns.table.marker is not None:
        return None, {}
    table = data.origin.numeric_columns(data.line_numbers)
    return (data.origin.columns, table) if table else (None, {})


def _rewritten(data: Any) -> Iterator[tuple[Tensor, str, str]]:
    """Rotations (N, T, 3, 3) read in other ways, with words, and the option that reads them so."""
    columns, table = numeric_table(data)
    names = () if columns is None else flat_names(columns.table.rotation)
    if columns is None or columns.table.convention is None or not all(name in table for name in names):
        return
    convention, frames = columns.table.convention, len(columns.table.triples)
    flat = torch.stack([table[name] for name in names], dim=1).view(len(data) * frames, -1)
    unit = columns.table.rotation_angle if flat.shape[1] == 3 else "rad"  # others have none
    for other, angle, rotations in readings_of(flat):
        if (other == convention) != (angle == unit):
            option = f"rotation_angle='{angle}'" if other == convention else f"convention='{other}'"
            yield rotations.unflatten(0, (-1, frames)), "", option
    for order in list(permutations(range(3)))[1:-1] if flat.shape[1] == 3 else ():  # the last is a convention by itself
        words = f"the rotation columns seem to be in the order {shown(','.join(names[k] for k in order))}"
        yield (
            rotation_matrices(flat[:, list(order)], convention, angle=unit or "rad").unflatten(0, (-1, frames)),
            words,
            "",
        )
