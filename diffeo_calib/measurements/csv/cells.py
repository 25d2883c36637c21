"""Columns of numbers from a CSV file. Every mistake is one error that names the file, the line and the column.

This module knows neither units nor robots. Only the wanted columns are read as numbers; other columns may hold
anything.
"""

from __future__ import annotations

import difflib
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import LONGEST_NAME, MOST_NAMES, MeasurementError, few, listed, shown
from diffeo_calib.measurements.csv.lines import CsvLines, Lines

_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_MISSING = re.compile(r"|[+-]?(nan|inf|infinity)|n/?a|null|none", re.IGNORECASE)
_EMPTY = re.compile(r"|nan|n/?a|null|none", re.IGNORECASE)
HIDDEN = "all cells of a hidden marker or frame are empty, and every line shows some"
Hideable = tuple[Sequence[int], Sequence[int]]
"""Places of a marker's, or frame's, values among the wanted columns, and of its standard deviations."""
LARGEST_NUMBER = 1e12
"""Larger numbers, in any unit, are no measurements: marks of missing readings, or damage."""
_PLAIN = re.compile(r"[0-9+\-.eE\n]*", re.ASCII)
"""Characters of numbers: of these, ``float`` reads what _NUMBER matches, only faster."""


def number_blocks(
    file: CsvLines,
    wanted: Sequence[str],
    decimal: str,
    rows: int,
    hideable: Sequence[Hideable] = (),
    *,
    all_hidden: bool = False,
) -> Iterator[tuple[Tensor, list[int]]]:
    """Read some columns of a CSV file in blocks of rows.

    Args:
        file: the file, with one header line.
        wanted: names of c columns.
        decimal: ``"."`` or ``","``.
        rows: most rows of a block.
        hideable: the columns of markers that rows may hide: not all of them in one row, unless ``all_hidden``.

    Yields:
        (B, c) finite numbers as written in the file, NaN for hidden markers, and the line number of every row; nothing
        more from the first block with a mistake on.

    Raises:
        MeasurementError: anything unreadable, missing, ragged or not finite. Mistakes in rows are counted in the whole
            file first.
    """
    columns = _find_columns(file.path, file.header, wanted, file.sep)
    mistakes = _Mistakes(file.path, wanted, decimal, markers=len(hideable))
    for lines in file.blocks(rows):
        whole = mistakes.without_ragged(lines, len(file.header))
        cells = [[cells[column] for column in columns] for _, cells in whole]
        numbers, hidden = _parse(cells, decimal), []
        if numbers is None and hideable:
            hidden = _fill_hidden(cells, hideable, all_hidden=all_hidden)
            numbers = _parse(cells, decimal)
        if numbers is None or not bool((numbers.abs() < LARGEST_NUMBER).all()):
            mistakes.add([line for line, _ in whole], cells)
        elif not mistakes:
            if hidden:
                numbers[tuple(zip(*hidden, strict=True))] = math.nan
            yield numbers, [line for line, _ in lines]
    mistakes.raise_first()


def read_cells(path: Path, sep: str) -> tuple[list[str], Lines]:
    """Read a CSV file as text: the header, and number and cells of every line below it that is not blank.

    Raises:
        MeasurementError: a file that cannot be read or has no rows, or lines of different lengths.
    """
    with CsvLines(path, sep) as file:
        lines = file.all()
        mistakes = _Mistakes(path, (), ".")
        mistakes.without_ragged(lines, len(file.header))
        mistakes.raise_first()
        return file.header, lines


@dataclass(frozen=True)
class TextCells:
    """The cells of a CSV file as text, which are read when they are first asked for.

    Args:
        path, sep: the file and its separator.
    """

    path: Path
    sep: str

    @cached_property
    def _read(self) -> tuple[list[str], dict[int, list[str]]]:
        header, rows = read_cells(self.path, self.sep)
        return [name.strip() for name in header], dict(rows)

    def texts(
        self,
        column: str,
        lines: Sequence[int],
        *,
        empty: bool = False,
        expected: str = "a name",
        fix: str = "fill it in",
    ) -> list[str]:
        """The cells of one column in these lines, as text without blanks around it.

        Args:
            column: its name. lines: numbers of the lines.
            empty: whether cells may be empty. expected: what they hold. fix: what to do about an empty one.

        Raises:
            MeasurementError: no such column, several, or an empty cell unless ``empty``.
        """
        names, cells = self._read
        if names.count(column) != 1:
            what, got = f"file '{self.path}', column '{column}'", f"{names.count(column)} of {few(names)}"
            fix = "name a column of the table"
            raise MeasurementError.of(what, expected="one column of this name", got=got, fix=fix)
        place = names.index(column)
        texts = [cells[line][place].strip() for line in lines]
        if "" in texts and not empty:
            bad = BadCells()
            for line, text in zip(lines, texts, strict=True):
                if not text:
                    bad.add(line, column, text)
            raise bad.error(self.path, expected, fix)
        return texts

    def numbers(self, column: str, lines: Sequence[int], decimal: str, fix: str, *, empty: bool = False) -> Tensor:
        """(N,) the cells of one column as numbers in the unit of the file, NaN for empty ones if they may be.

        Raises:
            MeasurementError: as :meth:`texts`; a cell that is no finite number.
        """
        found = []
        for line, text in zip(lines, self.texts(column, lines, empty=empty, expected="a number", fix=fix), strict=True):
            value = number(text, decimal) if text else None
            if text and (value is None or not abs(value) < LARGEST_NUMBER):
                what = f"file '{self.path}', line {line}, column '{column}'"
                fix = "repair or remove this line; pass `decimal` if the numbers have another decimal mark"
                raise MeasurementError.of(what, expected="a number", got=shown(repr(text)), fix=fix)
            found.append(math.nan if value is None else value)
        return torch.tensor(found, dtype=torch.float64, device=HOST)


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
        """Add a cell: its line, the name of its column, its text."""
        self.first = self.first or (line, name, text)
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


class _Mistakes:
    """What is wrong with the rows of a file. Lines of different lengths come first, then cells that are no numbers."""

    def __init__(self, path: Path, wanted: Sequence[str], decimal: str, markers: int = 0) -> None:
        self.path, self.wanted, self.decimal, self.markers = path, wanted, decimal, markers
        self.ragged: list[int] = []
        self.expected = self.got = 0
        self.unreadable, self.missing = BadCells(), BadCells()

    def __bool__(self) -> bool:
        return bool(self.ragged or self.unreadable.count or self.missing.count)

    def without_ragged(self, lines: Lines, expected: int) -> Lines:
        """The lines that have the expected number of cells."""
        whole = [(line, cells) for line, cells in lines if len(cells) == expected]
        if len(whole) < len(lines):
            others = [(line, len(cells)) for line, cells in lines if len(cells) != expected]
            self.expected, self.got = expected, self.got or others[0][1]
            self.ragged += [line for line, _ in others]
        return whole

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
            what = f"file '{self.path}', line {few(self.ragged)}"
            fix = "repair these lines (a cell that holds the separator must be quoted)"
            expected = f"{self.expected} cells as in the header"
            raise MeasurementError.of(what, expected=expected, got=self.got, fix=fix)
        if self.unreadable.first:
            fix = _number_hint(self.unreadable.first[2], self.decimal)
            raise self.unreadable.error(self.path, "a number", fix)
        if self.missing.first:
            finite = math.isfinite(number(self.missing.first[2], self.decimal) or 0.0)
            expected = f"a number below {LARGEST_NUMBER:g} in size" if finite else "a finite number"
            hint = f" ({HIDDEN})" * (self.markers > 1)
            raise self.missing.error(self.path, expected, f"remove or repair these lines{hint}")


def _find_columns(path: Path, header: list[str], wanted: Sequence[str], sep: str) -> list[int]:
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
        raise MeasurementError.of(what, got=got, fix=_near(missing, header))
    return [header.index(name) for name in wanted]


def _one_column(path: Path, text: str, sep: str) -> MeasurementError:
    """Error for a header with a single column: most likely the separator is wrong."""
    counts = {other: text.count(other) for other in ";,\t| " if other != sep}
    likely = max(counts, key=lambda other: counts[other])
    fix = f"pass sep={likely!r}" if counts[likely] else "check the file"
    got = f"a single column {shown(repr(text))}"
    return MeasurementError.of(f"file '{path}', header", expected=f"columns separated by {sep!r}", got=got, fix=fix)


def _near(missing: Sequence[str], header: Sequence[str]) -> str:
    lowered = {name.lower(): name for name in header if len(name) <= LONGEST_NAME}
    near = {
        name: difflib.get_close_matches(name.lower(), lowered, n=2)
        for name in missing[:MOST_NAMES]
        if len(name) <= LONGEST_NAME
    }
    hints = [
        f"for '{shown(name)}', did you mean {' or '.join(shown(lowered[m]) for m in found)}"
        for name, found in near.items()
        if found
    ]
    return "; ".join(hints) if hints else "pass the names as written in the header"


def _fill_hidden(rows: list[list[str]], hideable: Sequence[Hideable], *, all_hidden: bool) -> list[tuple[int, int]]:
    """Write zeros into the cells of hidden markers, in place, and return their places (row, column)."""
    filled = []
    for number_of_row, cells in enumerate(rows):
        hidden = [all(_EMPTY.fullmatch(cells[k]) for k in places) for places, _ in hideable]
        if all(hidden) and not all_hidden:
            continue  # no marker at all: a mistake
        for (places, deviations), gone in zip(hideable, hidden, strict=True):
            for column in (*places, *deviations) if gone else ():
                if column in places or _EMPTY.fullmatch(cells[column]):
                    cells[column] = "0"
                    filled.append((number_of_row, column))
    return filled


def _parse(rows: Sequence[Sequence[str]], decimal: str) -> Tensor | None:
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
