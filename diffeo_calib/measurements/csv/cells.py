"""Lines and columns of a CSV file, in blocks. Every mistake is one error that names the file, the line and the column.

This module knows neither units nor robots. Only the wanted columns are read as numbers; other columns may hold
anything.
"""

from __future__ import annotations

import csv
import difflib
import math
import os
import re
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, NamedTuple, TextIO

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import LONGEST_NAME, MOST_NAMES, MeasurementError, few, listed, shown

if TYPE_CHECKING:
    from typing_extensions import Self

Lines = list[tuple[int, list[str]]]
"""Line number in the file and cells of every line that is not blank."""

LONGEST_LINE = 1 << 24
"""Characters; a file with longer lines is no table, and a device may have no line ends at all."""


class CsvLines:
    """A CSV file (UTF-8, one header line, blank lines skipped), used as a context.

    Args:
        path: the file. What can be read only once, such as a pipe, is copied first.
        sep: one character between cells.

    Attributes:
        header: the cells of the first line that is not blank.

    Raises:
        MeasurementError: a file that cannot be opened or read, is no text or no valid CSV, or has no row; on entering
            or while it is read.
    """

    header: list[str]

    def __init__(self, path: Path, sep: str) -> None:
        self.path, self.sep = path, sep
        self._stack = ExitStack()
        self._file: TextIO

    def __enter__(self) -> Self:
        with self._stack as stack:  # closed if the header cannot be read
            self._file = stack.enter_context(self._open())
            if not self._file.seekable():
                copy = stack.enter_context(tempfile.TemporaryFile("w+", encoding="utf-8", newline=""))
                with self._read():
                    copy.writelines(self._texts())
                self._file = copy
            header = next(self._cells(), None)
            if header is None:
                what, fix = f"file '{self.path}' is empty", "check that it was exported completely"
                raise MeasurementError.of(what, expected="a header and rows of numbers", fix=fix)
            self.header = header[1]
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, _value: object, _trace: TracebackType | None) -> None:
        self._stack.close()

    @property
    def progress(self) -> float:
        """Fraction of the file that has been read."""
        size = os.fstat(self._file.fileno()).st_size
        return min(self._file.buffer.tell() / size, 1.0) if size else 0.0

    def blocks(self, rows: int) -> Iterator[Lines]:
        """The lines below the header, up to ``rows`` at once, from the first one at every call."""
        lines, count = islice(self._cells(), 1, None), 0
        while block := list(islice(lines, rows)):
            count += len(block)
            yield block
        if not count:
            what, fix = f"file '{self.path}' has a header but no rows", "check that it was exported completely"
            raise MeasurementError.of(what, expected="at least one row of numbers", fix=fix)

    def _open(self) -> TextIO:
        path = self.path
        try:
            return path.open(encoding="utf-8-sig", newline="")
        except FileNotFoundError as error:
            fix = f"check the name and the folder (searched from '{Path.cwd()}')"
            raise MeasurementError.of(f"file '{path}' does not exist", fix=fix) from error
        except IsADirectoryError as error:
            fix = f"of images of a board run `diffeo-calib images '{path}' JOINTS.csv ...` first, and pass its table"
            raise MeasurementError.of(f"'{path}' is a folder", expected="a table", fix=fix) from error
        except OSError as error:
            fix = "pass the name of a readable file"
            raise MeasurementError.of(f"file '{path}' cannot be opened ({error.strerror})", fix=fix) from error

    def _cells(self) -> Iterator[tuple[int, list[str]]]:
        """Line number and stripped cells of every line that is not blank."""
        line = 0
        reader = csv.reader(self._texts(), delimiter=self.sep, strict=True, skipinitialspace=self.sep != " ")
        try:
            with self._read():
                for cells in reader:
                    first, line = line + 1, reader.line_num  # a quoted cell may span lines
                    stripped = [cell.strip() for cell in cells]
                    if len(stripped) > 1 or any(stripped):
                        yield first, stripped
        except csv.Error as error:
            what = f"file '{self.path}', line {line + 1}: not valid CSV ({error})"
            raise MeasurementError.of(what, fix="repair the quotes of this line") from error

    @contextmanager
    def _read(self) -> Iterator[None]:
        try:
            yield
        except UnicodeDecodeError as error:
            fix = "save the table as CSV with UTF-8 encoding (a spreadsheet file cannot be read)"
            what = f"file '{self.path}' is not UTF-8 text"
            raise MeasurementError.of(what, expected="a CSV file", fix=fix) from error
        except OSError as error:
            what = f"file '{self.path}' cannot be read to its end ({error.strerror})"
            raise MeasurementError.of(what, fix="copy it to another disk first") from error

    def _texts(self) -> Iterator[str]:
        """The lines of the file as text, from the first one if it can be read again."""
        if self._file.seekable():
            self._file.seek(0)
        number = 0
        while text := self._file.readline(LONGEST_LINE):
            number += 1
            if len(text) == LONGEST_LINE:
                what = f"file '{self.path}', line {number} has more than {LONGEST_LINE} characters"
                raise MeasurementError.of(what, fix="pass a table with one configuration per line")
            yield text


_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_MISSING = re.compile(r"|[+-]?(nan|inf|infinity)|n/?a|null|none", re.IGNORECASE)
_EMPTY = re.compile(r"|nan|n/?a|null|none", re.IGNORECASE)
HIDDEN = "all cells of a hidden marker or frame are empty, and every line shows some"


class Hideable(NamedTuple):
    """Columns that lines may leave empty together: places of values and of deviations among all; what they show."""

    values: Sequence[int]
    deviations: Sequence[int]
    word: str


class Block(NamedTuple):
    """Lines of a file: numbers (B, c), NaN where hidden, texts by the name of their column, and the lines' numbers."""

    numbers: Tensor
    texts: dict[str, list[str]]
    lines: list[int]


LARGEST_NUMBER = 1e12
"""Larger numbers, in any unit, are no measurements: marks of missing readings, or damage."""
_PLAIN = re.compile(r"[0-9+\-.eE\n]*", re.ASCII)
"""Characters of numbers: of these, ``float`` reads what _NUMBER matches, only faster."""


def read_cells(path: Path, sep: str) -> tuple[list[str], Lines]:
    """Read a CSV file as text: the header, and number and cells of every line below it that is not blank.

    Raises:
        MeasurementError: a file that cannot be read or has no rows, or lines of different lengths.
    """
    with CsvLines(path, sep) as file:
        lines = [line for block in file.blocks(LONGEST_LINE) for line in block]
        mistakes = Mistakes(path, (), ".")
        mistakes.without_ragged(lines, len(file.header))
        mistakes.raise_first()
        return file.header, lines


def repeated(names: Sequence[str]) -> list[str]:
    """Return the names that occur more than once."""
    return [name for name, count in Counter(names).items() if count > 1]


@dataclass
class BadCells:
    """Cells that are not what they should be: the first one (line, column, text) and the lines of all."""

    first: tuple[int, str, str] | None = None
    count: int = 0
    lines: list[int] = field(default_factory=list)

    def add(self, line: int, name: str, text: str) -> None:
        """Add a cell: its line, the name of its column, its text.

        Of the cells of one line, a wrong one is named rather than an empty one beside it.
        """
        if self.first is None or (self.first[0] == line and text and not self.first[2]):
            self.first = (line, name, text)
        self.count += 1
        if line not in self.lines[-1:]:
            self.lines.append(line)

    def error(self, path: Path, expected: str, fix: str) -> MeasurementError:
        """Error that names the first of the cells and the lines of the next ones."""
        line, name, text = self.first or (0, "", "")
        where = f" (and {self.count - 1} more, on line {few(self.lines[1:] or [line])})" if self.count > 1 else ""
        what = f"file '{path}', line {line}, column '{shown(name)}'{where}"
        got = shown(repr(text)) if text else "an empty cell"
        return MeasurementError.of(what, expected=expected, got=got, fix=fix)


class Mistakes:
    """Faults in the rows of a file. Lines of different lengths come first, then cells that are no numbers."""

    def __init__(self, path: Path, wanted: Sequence[str], decimal: str, markers: int = 0) -> None:
        self.path, self.wanted, self.decimal, self.markers = path, wanted, decimal, markers
        self.ragged: list[tuple[int, int]] = []
        self.unreadable, self.missing = BadCells(), BadCells()

    def __bool__(self) -> bool:
        return bool(self.ragged or self.unreadable.count or self.missing.count)

    def without_ragged(self, lines: Lines, expected: int) -> Lines:
        """The lines that have the expected number of cells."""
        self.expected = expected
        self.ragged += [(line, len(cells)) for line, cells in lines if len(cells) != expected]
        return [(line, cells) for line, cells in lines if len(cells) == expected]

    def add(self, lines: Sequence[int], rows: Sequence[Sequence[str]]) -> None:
        """Find the cells that are no finite numbers in the wanted columns of some lines."""
        for line, cells in zip(lines, rows, strict=True):
            for name, cell in zip(self.wanted, cells, strict=True):
                value = number(cell, self.decimal)
                if value is None:
                    self.unreadable.add(line, name, cell)
                elif not abs(value) < LARGEST_NUMBER:  # NaN too
                    self.missing.add(line, name, cell)

    def raise_first(self) -> None:
        """Raise MeasurementError if anything is wrong."""
        if self.ragged:
            what = f"file '{self.path}', line {few([line for line, _ in self.ragged])}"
            fix = "repair these lines (a cell that holds the separator must be quoted)"
            expected, got = f"{self.expected} cells as in the header", self.ragged[0][1]
            raise MeasurementError.of(what, expected=expected, got=got, fix=fix)
        if self.unreadable.first:
            fix = _number_hint(self.unreadable.first[2], self.decimal)
            raise self.unreadable.error(self.path, "a number", fix)
        if self.missing.first:
            finite = math.isfinite(number(self.missing.first[2], self.decimal) or 0.0)
            expected = f"a number below {LARGEST_NUMBER:g} in size" if finite else "a finite number"
            hint = f" ({HIDDEN})" * (self.markers > 1)
            raise self.missing.error(self.path, expected, f"remove or repair these lines{hint}")


def find_columns(path: Path, header: list[str], wanted: Sequence[str], sep: str) -> list[int]:
    """Return the position of every wanted column in the header."""
    missing = [name for name in wanted if name not in header]
    if missing and header[0].startswith("#"):
        what, fix = f"file '{path}' begins with a comment", "remove the lines before the header; none is skipped"
        expected = "the names of the columns in the first line"
        raise MeasurementError.of(what, expected=expected, got=shown(repr(header[0])), fix=fix)
    if missing and len(header) == 1:
        raise _one_column(path, header[0], sep)
    if "" in header:
        blank = few([place + 1 for place, name in enumerate(header) if not name])
        fix = "name every column, or remove the extra separators"
        raise MeasurementError.of(f"file '{path}', header: column {blank} has no name", fix=fix)
    twice = repeated(header)
    if twice:
        fix = "give every column its own name"
        raise MeasurementError.of(f"file '{path}', header: {listed(twice)} named more than once", fix=fix)
    if missing:
        what, got = f"file '{path}', header: no column {listed(missing)}", f"the columns {listed(header)}"
        raise MeasurementError.of(what, got=got, fix=_near(missing, [name for name in header if name not in wanted]))
    return [header.index(name) for name in wanted]


def _one_column(path: Path, text: str, sep: str) -> MeasurementError:
    """Error for a header with a single column: most likely the separator is wrong."""
    counts = {other: text.count(other) for other in ";,\t| " if other != sep}
    likely = max(counts, key=lambda other: counts[other])
    fix = f"pass sep={likely!r}" if counts[likely] else "check the file"
    got = f"a single column {shown(repr(text))}"
    return MeasurementError.of(f"file '{path}', header", expected=f"columns separated by {sep!r}", got=got, fix=fix)


def _near(missing: Sequence[str], free: Sequence[str]) -> str:
    """Which of the columns that no other name matches may be meant; "_", "joint" and case do not count."""
    names = {_bare(name): name for name in free if len(name) <= LONGEST_NAME}
    near = {
        name: difflib.get_close_matches(_bare(name), names, n=2)
        for name in missing[:MOST_NAMES]
        if len(name) <= LONGEST_NAME
    }
    hints = [
        f"for '{shown(name)}', did you mean {' or '.join(shown(names[m]) for m in found)}"
        for name, found in near.items()
        if found
    ]
    return "; ".join(hints) if hints else "pass the names as written in the header"


def _bare(name: str) -> str:
    """A name as it is compared with others."""
    lowered = name.lower()
    return lowered.replace("joint", "").replace("_", "") or lowered


def fill_hidden(rows: list[list[str]], hideable: Sequence[Hideable], *, all_hidden: bool) -> list[tuple[int, int]]:
    """Write zeros into the cells of hidden markers, in place, and return their places (row, column)."""
    filled = []
    for number_of_row, cells in enumerate(rows):
        hidden = [all(_EMPTY.fullmatch(cells[k]) for k in own.values) for own in hideable]
        if all(hidden) and not all_hidden:
            continue  # no marker at all: a mistake
        kept = {k for own, gone in zip(hideable, hidden, strict=True) if not gone for k in own.deviations}
        for own, gone in zip(hideable, hidden, strict=True):
            for column in (*own.values, *own.deviations) if gone else ():
                if column in own.values or (column not in kept and _EMPTY.fullmatch(cells[column])):
                    cells[column] = "0"
                    filled.append((number_of_row, column))
    return filled


def parse(rows: Sequence[Sequence[str]], decimal: str) -> Tensor | None:
    """The numbers of cells, (B, c); None if some are none, or look like none."""
    if not rows:
        return torch.empty(0, 0, dtype=torch.float64, device=HOST)
    text = "\n".join(cell for row in rows for cell in row)
    if decimal != ".":
        text = text.replace(".", "?").replace(decimal, ".")  # a point is not part of a number here
    if not _PLAIN.fullmatch(text):
        return None
    try:
        values = torch.tensor([float(cell) for cell in text.split("\n")], dtype=torch.float64, device=HOST)
    except ValueError:
        return None
    whole = len(values) == sum(map(len, rows))  # otherwise a cell holds a line break
    return values.view(len(rows), -1) if whole else None


def number(text: str, decimal: str) -> float | None:
    """Return the number; NaN for an empty cell or a word such as "n/a"; None for anything else."""
    if _MISSING.fullmatch(text):
        return math.nan
    if decimal != ".":
        text = text.replace(".", "?").replace(decimal, ".")  # a point is not part of a number here
    return float(text) if _NUMBER.fullmatch(text) else None


def _number_hint(text: str, decimal: str) -> str:
    other, word = (",", "comma") if decimal == "." else (".", "point")
    if number(text, other) is not None:
        return f"looks like a decimal {word}: pass decimal={other!r}"
    if "." in text and "," in text:
        return "export the numbers without thousands separators"
    return "repair this cell, or name another column"
