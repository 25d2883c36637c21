"""Lines of a table in a text file, read and written: its encoding, its header, and what is no row.

What is unmistakable is read and noted: lines before the header, comments, a row of units, no header at all.
"""

from __future__ import annotations

import codecs
import csv
import hashlib
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import chain, combinations, islice, takewhile, zip_longest
from math import isfinite, isnan, prod
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from diffeo_calib.common.errors import MeasurementError, few, listed
from diffeo_calib.common.files import WholeFile, decoded
from diffeo_calib.measurements.csv.cells import MARKS, as_text, csv_text, names_of, number, repeated
from diffeo_calib.measurements.table_format import ZERO, TableFormat

Lines = list[tuple[int, list[str]]]  # line number in the file and cells of every line that is not blank

Cells = Sequence[Sequence[float | str]]
Column = Sequence[str] | Sequence[float]

HEAD = 200  # lines among which the header is
NO_TABLES = {".json", ".yaml", ".yml", ".xml", ".ls", ".src", ".mod", ".jbi"}  # the last four: programs of robots
AT_ONCE = 1 << 13  # bytes by which a file is judged
WIDE = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE
COMMENTS = "#", "%", "//"
DAMAGED = re.compile(r"#[A-Z/0]+[!?]")
"""Cells such as #VALUE! and #DIV/0!, with which spreadsheets say that a formula failed: no comments."""
LENGTHS = {name: name for name in ("m", "mm", "cm", "um", "inch")}
LENGTHS |= {"µm": "um", "in": "inch", "毫米": "mm", "厘米": "cm", "米": "m"}
ANGLES = {name: name for name in ("rad", "mrad", "deg", "gon")}
ANGLES |= {"radians": "rad", "弧度": "rad", "°": "deg", "degree": "deg", "degrees": "deg", "度": "deg"}
UNITS = LENGTHS | ANGLES  # units as they are written, and their names
LIST = re.compile(r"(?:[\w.]+\((?:'\w', *)?)?([\[(].*[\])])(?:, *dtype=[\w.]+)?\)?", re.DOTALL)
"""A list in one cell, as Python, NumPy and ROS write it: [0.1, 0.2], (0.1, 0.2), [0.1 0.2], array('d', [0.1, 0.2])."""
UNQUOTED = r"(?m)(^|{0})[ \t]*([\[(][-+\d.][^\[\]()\n]*[\])])[ \t]*(?={0}|\r?$)"
"""A list between separators, which its own commas are not."""
STATISTICS = re.compile(
    r"(?:(mean|average|avg|mittel|moyenne|media|std|st\.? ?dev|standard ?(?=abw|dev|err)|rmse?)s?|(?:median|sigma|σ|min"
    r"|max|range|spannweite|count|anzahl|sum|ecart|écart)\w*)[.:]?([ _]?(abw|dev|value|wert|error)\w*\.?)?:?",
    re.IGNORECASE,
)
"""Words before the statistics of columns, below the rows; a mean or a deviation is among them."""
OTHERS = re.compile(r"[mu]?s|sec|min|h|k?g|nm?|°?c|k|v|px|pixels?|%|-|none")


class CsvLines:
    """A table in a text file; blank lines are skipped.

    Args:
        path: the file, which is read once. sep: one character between cells.
        wanted: names of columns, by which the header is known.

    Attributes:
        header: the names of the columns; by position, "1", "2", ..., where no line names them.
        units: by name of column, of a row of units below the header.
        notes: what was decided, in words; after :meth:`rows` also which lines between them were skipped.
        sha256: of the file.

    Raises MeasurementError: a file that cannot be read, is empty, no text or no valid CSV.
    """

    def __init__(self, path: Path, sep: str, wanted: Sequence[str] = ()) -> None:
        self.path, self.sep = path, sep
        self.header, self.units, self.notes = list[str](), dict[str, str](), list[str]()
        self._aligned, self._commented = False, True
        self._last, self._extra = 0, 0  # line before the rows, and empty cells at the end of rows
        self._text, notes, self.sha256 = _text(path, sep)
        if sep != " " and re.search(r"[\[(][-+\d.]", self._text[:AT_ONCE]) and '"' not in self._text:
            self._text = re.sub(UNQUOTED.format(re.escape(sep)), r'\1"\2"', self._text)
        self._lists = dict[int, tuple[int, ...]]()  # shapes of the lists that columns hold
        self._lists = _lists(lines := list(islice(self._cells(), HEAD)))
        lines = list(islice(self._cells(), HEAD)) if self._lists else lines
        each = list(zip_longest(*(cells for _, cells in lines), fillvalue=None))
        if sep == " " and any(None in cells or not any(cells) for cells in each):  # columns that spaces align
            self._aligned = True
            lines = list(islice(self._cells(), HEAD))
        if not any(any(cells) for _, cells in lines):
            what, fix = f"file '{path}' is empty", "check that it was exported completely"
            raise MeasurementError.of(what, expected="a header and rows of numbers", fix=fix)
        self.notes += notes
        self._find_header(lines, {*wanted} - {ZERO})

    def rows(self, most: int | None = None) -> Lines:
        """The lines below the header, of the first ``most`` if given.

        Raises:
            MeasurementError: no row, or lines of different lengths.
        """
        below = list(islice((line for line in self._cells() if line[0] > self._last), most))
        expected, named = len(self.header), self._last > 0  # not where columns are counted
        kept = [
            (line, cells)
            for line, cells in below
            if any(cells)
            and not (named and cells[:expected] == self.header)
            and not (self._commented and _is_comment(cells))
        ]
        first = [next(filter(None, cells)) for _, cells in kept]
        last = [match for match in takewhile(bool, map(STATISTICS.fullmatch, reversed(first))) if match]
        once = all(first.count(match[0]) == 1 for match in last)  # no name of a marker, or word of all rows
        if once and len(last) < len(kept) and any(match[1] for match in last):
            kept = kept[: len(kept) - len(last)]
        sizes = expected, expected + self._extra
        bad = [(line, len(cells)) for line, cells in kept if len(cells) not in sizes or any(cells[expected:])]
        if bad:
            what, got = f"file '{self.path}', line {few([line for line, _ in bad])}", f"{bad[0][1]}; quote separators"
            raise MeasurementError.of(what, expected=f"{expected} cells as in the header", got=got)
        if not kept:
            what, fix = f"file '{self.path}' has a header but no rows", "check that it was exported completely"
            raise MeasurementError.of(what, expected="at least one row of numbers", fix=fix)
        if skipped := sorted({line for line, _ in below} - {line for line, _ in kept}):
            what = "comments, names, statistics or nothing"
            self.notes.append(f"{len(skipped)} line(s) with {what} skipped (line {few(skipped)})")
        return [(line, cells[:expected]) for line, cells in kept]

    def _cells(self) -> Iterator[tuple[int, list[str]]]:
        """Line number and stripped cells of every line that is not blank."""
        line, text = 0, io.StringIO(self._text, newline="")
        texts = (re.sub(" +", " ", raw.strip(" ")) for raw in text) if self._aligned else text
        reader = csv.reader(texts, delimiter=self.sep, strict=True, skipinitialspace=self.sep != " ")
        try:
            for cells in reader:
                first, line = line + 1, reader.line_num  # a quoted cell may span lines
                stripped = [cell.strip() for cell in cells]
                if self._lists:
                    stripped = [part for k, cell in enumerate(stripped) for part in _parts(cell, self._lists.get(k))]
                if len(stripped) > 1 or any(stripped):
                    yield first, stripped
        except csv.Error as error:
            what = f"file '{self.path}', line {line + 1}: not valid CSV ({error})"
            raise MeasurementError.of(what, fix="repair the quotes of this line") from error

    def _find_header(self, lines: Lines, wanted: set[str]) -> None:
        """Find the header as most rows of numbers, and the wanted names, among the first lines have it.

        It is the first line with a name for every cell of the rows, or two lines together; if it lacks a wanted name,
        the last line before the rows that has them all.
        """
        counts = [_numbers(cells) for _, cells in lines]
        comments = [_is_comment(cells) for _, cells in lines]
        marked = [comment for count, comment in zip(counts, comments, strict=True) if count]
        if marked and all(marked):
            self._commented, comments = False, [False] * len(lines)  # rows whose first cell is such as "#12"
        counts = [0 if comment else count for count, comment in zip(counts, comments, strict=True)]
        sizes = [len(cells) for count, (_, cells) in zip(counts, lines, strict=True) if count]
        width = max(sizes, key=sizes.count, default=0)
        rows = [k for k, (_, cells) in enumerate(lines) if counts[k] and len(cells) == width]
        usual = sorted(counts[k] for k in rows)[len(rows) // 2] if rows else 0
        start = next((k for k in rows if 2 * counts[k] > usual), len(lines))
        filled = max((place + 1 for k in rows for place, cell in enumerate(lines[k][1]) if cell), default=0)
        place, header = _named(lines, comments, start, range(filled, width + 1))
        counted = [str(k + 1) for k in range(filled)]
        for k, (_, cells) in enumerate(lines[: max(start, 1)] if not wanted <= {*header} else []):
            for names in (cells, _uncommented(cells, width)):
                if wanted <= {*names}:
                    place, header = k, names
        if place < 0 < start and not wanted <= {*counted} and not comments[start - 1] and any(lines[start - 1][1]):
            place, header = start - 1, lines[start - 1][1]
        while place < 0 and start - 1 in rows:
            start -= 1  # few numbers, but no line names the columns
        skipped = [line for line, _ in lines[: start if place < 0 else place]]
        if skipped:
            self.notes.append(f"line {few(skipped)} before the {'rows' if place < 0 else 'header'} skipped")
        if place < 0:
            header, place = counted, start - 1
            self.notes.append(f"no header line: columns are named by their places, 1 to {filled}")
        while header and not header[-1]:
            header = header[:-1]
        below = next((lines[k] for k in range(place + 1, len(lines)) if not comments[k]), (0, [""]))
        self._last = lines[place][0] if place >= 0 else 0
        if _is_units(below[1]):
            self.notes.append(f"line {below[0]} holds units")
            self._last, self.units = below[0], dict(zip(header, map(unit_of, below[1]), strict=False))
        self.header, self._extra = header, max(width - len(header), 0)


def _text(path: Path, sep: str) -> tuple[str, list[str], str]:
    """The text of a file, what was decided about it, its SHA-256; MeasurementError if it is none, or no table."""
    try:
        with path.open("rb") as file:
            data = file.read(AT_ONCE)  # tells a device without an end
            variables = path.suffix.lower() == ".mat" and path.is_file()
            whole = b"\0" not in data or data.startswith((*WIDE, *MARKS)) or variables
            data += file.read() if whole else b""
    except IsADirectoryError as error:
        fix = f"of images of a board run `diffeo-calib images '{path}' JOINTS.csv ...`, and pass its table"
        raise MeasurementError.of(f"'{path}' is a folder", expected="a table", fix=fix) from error
    except FileNotFoundError as error:
        fix = f"check the name and the folder (searched from '{Path.cwd()}')"
        raise MeasurementError.of(f"file '{path}' does not exist", fix=fix) from error
    except OSError as error:
        what = f"file '{path}' cannot be read ({error.strerror})"
        raise MeasurementError.of(what, fix="pass the name of a readable file") from error
    sha256 = hashlib.sha256(data).hexdigest()
    if data.startswith(WIDE):
        return data.decode("utf-16", "replace"), ["text in utf-16, not UTF-8"], sha256
    if (sheet := as_text(path, data, sep)) is not None:
        return *sheet, sha256
    if path.suffix.lower() in NO_TABLES:
        what, fix = f"'{path}' is no table", "write one: a line with the names of the columns, then a line for each row"
        raise MeasurementError.of(what, expected="CSV, a spreadsheet, arrays or JSON records", got=path.suffix, fix=fix)
    if b"\0" in data:
        what, fix = f"file '{path}' is no text but binary", "export the table as CSV"
        raise MeasurementError.of(what, expected="a CSV file", fix=fix)
    text, page = decoded(data)
    return text, [f"text in {page}, not UTF-8"] * bool(page), sha256


class TextTable(NamedTuple):
    """A table as text: names of its columns, and the lines below, blank ones left out."""

    header: list[str]
    rows: Lines

    def column(self, name: str) -> list[str]:
        """The cells of a column."""
        place = self.header.index(name)
        return [cells[place] for _, cells in self.rows]

    def without(self, names: Sequence[str]) -> TextTable:
        """Drop some columns."""
        kept = [k for k, name in enumerate(self.header) if name not in names]
        rows = [(line, [cells[k] for k in kept]) for line, cells in self.rows]
        return TextTable([self.header[k] for k in kept], rows)

    def check_free(self, names: Sequence[str]) -> None:
        """Raise MeasurementError if a column that is to be added to a program is there already."""
        taken = [name for name in names if name in self.header]
        if taken:
            what = f"the program already has the column(s) {listed(taken)}, which the output adds"
            raise MeasurementError.of(what, fix="rename or remove them, unless the program has been corrected already")


def read_cells(path: Path, sep: str, wanted: Sequence[str] = ()) -> TextTable:
    """Read a table as text, whose header is known by names of wanted columns; errors as of :class:`CsvLines`."""
    file = CsvLines(path, sep, wanted)
    return TextTable(file.header, file.rows())


def _named(lines: Lines, comments: Sequence[bool], start: int, sizes: Sequence[int]) -> tuple[int, list[str]]:
    """Place and cells of the line that names the columns of the rows from ``start`` on; -1 if none does."""
    before = [(k, cells) for k, (_, cells) in enumerate(lines[:start]) if any(cells) and not comments[k]]
    if start == len(lines):
        first = next(k for k, (_, cells) in enumerate(lines) if any(cells))
        return before[0] if before else (first, _uncommented(lines[first][1], 0))
    words = [
        (k, cells)
        for k, cells in before
        if len(cells) in sizes
        and sum(map(bool, cells)) > (len(cells) > 1)  # no title in the first cell alone
        and not _is_units(cells)
        and (_counted(cells) or not any(map(_value, cells)))
    ]
    for k, cells in words:
        if all(cells[: sizes[0]]) and not repeated(cells[: sizes[0]]):
            return k, cells
    if words:
        return words[-1][0], _joined([cells for _, cells in words])
    if before and before[-1][0] == start - 1 and len(before[-1][1]) > 1 and not _is_units(before[-1][1]):
        return before[-1]
    for k in reversed(range(start)):
        names = _uncommented(lines[k][1], sizes[0])
        if len(names) in sizes and len(names) > 1 and not repeated(names) and not any(map(_value, names)):
            return k, names
    return -1, []


def _joined(names: list[list[str]]) -> list[str]:
    """The names of the last of some lines; those that repeat, or count, with the names above, such as "marker_X"."""
    *above, header = names
    twice = {name for name in repeated(header) if name} | {*filter(str.isdecimal, header)}
    for line in above:
        for k in range(1, len(line)):
            line[k] = line[k] or line[k - 1]  # a name stands above the first of its columns alone
    for chosen in (*combinations(above, 1), *combinations(above, 2)):
        each = zip(*chosen, header, strict=False)
        joined = ["_".join(cells) if cells[-1] in twice else cells[-1] for cells in each]
        if twice and not any(repeated(joined)):
            return joined
    return header


def _items(text: str) -> list[str]:
    """The items of a list in one cell; none of another cell, or where commas may be decimal marks."""
    matched = LIST.fullmatch(text)
    if matched and "." not in text and re.search(r"\d,\d", text) and re.search(r"\d *;|\d +[-+\d]", text):
        return []
    return re.findall(r"[^\s,;\[\]()'\"]+", re.sub(r"\w+\.\w+\(([^()]*)\)", r"\1", matched[1])) if matched else []


def _lists(lines: Lines) -> dict[int, tuple[int, ...]]:
    """Shapes of the lists that most lines hold in a place."""
    shapes = dict[int, tuple[int, ...]]()
    for place in range(max((len(cells) for _, cells in lines), default=0)):
        texts = [cells[place] for _, cells in lines if len(cells) > place and cells[place]]
        counts = [len(_items(text)) for text in texts]
        count = max(filter(None, counts), key=counts.count, default=0)
        if count > 1 and 2 * counts.count(count) >= len(counts):  # a line of names, and at least one row
            rows = max(texts[counts.index(count)].count("[") - 1, 1)
            shapes[place] = (rows, count // rows) if rows > 1 and count % rows == 0 else (count,)
    return shapes


def _parts(cell: str, shape: tuple[int, ...] | None) -> list[str]:
    """The cells of columns that one column of lists stands for: their names, or what a list holds."""
    if shape is None:
        return [cell]
    items, count = _items(cell), prod(shape)
    if cell and not items and not isnan(number(cell, ".") or 0.0):
        return [*names_of(cell, shape)]
    return items if len(items) == count else [cell] * count if not items else [cell, *[""] * (count - 1)]


def unit_of(text: str) -> str:
    """The unit that a text is, in small letters without brackets; empty if it is none."""
    bare = text.lower().replace("\u03bc", "µ").strip("[](){}<> ")
    return bare if bare in UNITS or OTHERS.fullmatch(bare) else ""


def stated_unit(column: str, units: Mapping[str, str]) -> str | None:
    """The unit of length or angle in brackets after the name of a column, or in a row of units; None without any."""
    bracket = re.search(r"[\[(][^\[(]*[\])]$", column)
    return UNITS.get(units.get(column) or (unit_of(bracket[0]) if bracket else ""))


def _is_units(cells: Sequence[str]) -> bool:
    return all(map(unit_of, filter(None, cells))) and any(unit_of(cell) not in ("", "-", "none") for cell in cells)


def _is_comment(cells: Sequence[str]) -> bool:
    return cells[0].startswith(COMMENTS) and number(cells[0], ".") is None and not DAMAGED.fullmatch(cells[0])


def _uncommented(cells: list[str], width: int) -> list[str]:
    """A comment without its mark, and the cell that it fills."""
    first = cells[0].lstrip("#%/ ") if _is_comment(cells) else cells[0]
    return cells[1:] if not first and len(cells) > width > 0 else [first or cells[0], *cells[1:]]


@lru_cache(maxsize=1 << 14)  # `init` reads a table in many units
def _value(text: str) -> bool:
    values = (number(text, decimal) for decimal in ".,")
    return any(value is not None and not isnan(value) for value in values)


def _numbers(cells: Sequence[str]) -> int:
    """How many cells are numbers; 0 where they are less than half of those that are filled, or count the columns."""
    filled = [cell for cell in cells if number(cell, ".") is None or _value(cell)]
    count = sum(map(_value, filled))
    return 0 if _counted(cells) or 2 * count < len(filled) else count


def _counted(cells: Sequence[str]) -> bool:
    """Whether the numbers among some cells count joints or columns."""
    numbers = [cell for cell in cells if _value(cell)]
    return len(numbers) > 3 and numbers in ([str(k + first) for k in range(len(numbers))] for first in (0, 1))


def write_rows(path: str | PathLike[str], names: Sequence[str], blocks: Iterable[Cells], table: TableFormat) -> None:
    """Write rows (B, columns) whose numbers are already in the units of the file; InputError if that fails.

    Texts are written as they are, NaN becomes an empty cell.
    """

    def cell(value: str | float) -> str:
        if isinstance(value, str):
            return value
        return repr(value).replace(".", table.decimal) if isfinite(value) else ""

    with WholeFile(path) as file:
        for block in chain([[names]], blocks):
            file.write(csv_text((map(cell, row) for row in block), table.sep, "\r\n").encode())


def write_columns(path: Path, sheet: TextTable, cells: Mapping[str, Column], table: TableFormat) -> None:
    """Write a table with other and more columns; overwrites.

    ``cells``: name -> texts, or numbers in the units of the file, of which NaN is an empty cell.
    """
    added = {name: column for name, column in cells.items() if name not in sheet.header}
    kept = [cells.get(name, [row[k] for _, row in sheet.rows]) for k, name in enumerate(sheet.header)]
    write_rows(path, [*sheet.header, *added], [list(zip(*kept, *added.values(), strict=True))], table)
