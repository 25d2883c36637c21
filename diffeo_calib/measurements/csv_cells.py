"""Columns of numbers from a CSV file. Every mistake is one error that names the file, the line and the column.

This module knows neither units nor robots. Only the wanted columns are read as numbers; other columns may hold
anything.
"""

from __future__ import annotations

import csv
import difflib
import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MOST_NAMES, MeasurementError, as_written, few, listed

_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_MISSING = re.compile(r"|[+-]?(nan|inf|infinity)|n/?a|null|none", re.IGNORECASE)

Lines = list[tuple[int, list[str]]]
"""Line number in the file and cells of every line that is not blank."""


def read_columns(path: Path, wanted: Sequence[str], sep: str, decimal: str) -> tuple[Tensor, list[int]]:
    """Read some columns of a CSV file (UTF-8, one header line, blank lines skipped).

    Args:
        path: the file.
        wanted: names of c columns.
        sep: one character between cells.
        decimal: ``"."`` or ``","``.

    Returns:
        (N, c) finite numbers as written in the file, and the line number of every row.

    Raises:
        MeasurementError: anything unreadable, missing, ragged or not finite.
    """
    header, lines = _read_lines(path, sep)
    columns = _find_columns(path, header, wanted, sep)
    _check_cells(path, header, lines)
    return _parse(path, lines, wanted, columns, decimal), [line for line, _ in lines]


def read_cells(path: Path, sep: str) -> tuple[list[str], Lines]:
    """Read a CSV file as text: the header, and number and cells of every line below it that is not blank.

    Raises:
        MeasurementError: a file that cannot be read or has no rows, or lines of different lengths.
    """
    header, lines = _read_lines(path, sep)
    _check_cells(path, header, lines)
    return header, lines


def repeated(names: Sequence[str]) -> list[str]:
    """Return the names that occur more than once."""
    return [name for name, count in Counter(names).items() if count > 1]


def _read_lines(path: Path, sep: str) -> tuple[list[str], Lines]:
    """Return the cells of the header, and the lines below it that are not blank."""
    lines: Lines = []
    line = 0
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, delimiter=sep, strict=True, skipinitialspace=sep != " ")
            for cells in reader:
                first, line = line + 1, reader.line_num  # a quoted cell may span lines
                if any(cell.strip() for cell in cells) or len(cells) > 1:
                    lines.append((first, [cell.strip() for cell in cells]))
    except FileNotFoundError as error:
        fix = f"check the name and the folder (searched from '{Path.cwd()}')"
        raise MeasurementError.of(f"file '{path}' does not exist", fix=fix) from error
    except OSError as error:
        fix = "pass the name of a readable file"
        raise MeasurementError.of(f"file '{path}' cannot be opened ({error.strerror})", fix=fix) from error
    except UnicodeDecodeError as error:
        fix = "save the table as CSV with UTF-8 encoding (a spreadsheet file cannot be read)"
        raise MeasurementError.of(f"file '{path}' is not UTF-8 text", expected="a CSV file", fix=fix) from error
    except csv.Error as error:
        what = f"file '{path}', line {line + 1}: not valid CSV ({error})"
        raise MeasurementError.of(what, fix="repair the quotes of this line") from error
    if not lines:
        fix = "check that it was exported completely"
        raise MeasurementError.of(f"file '{path}' is empty", expected="a header and rows of numbers", fix=fix)
    return lines[0][1], lines[1:]


def _find_columns(path: Path, header: list[str], wanted: Sequence[str], sep: str) -> list[int]:
    """Return the position of every wanted column in the header."""
    missing = [name for name in wanted if name not in header]
    if missing and header[0].startswith("#"):
        what, fix = f"file '{path}' begins with a comment", "remove the lines before the header; none is skipped"
        expected = "the names of the columns in the first line"
        raise MeasurementError.of(what, expected=expected, got=as_written(header[0]), fix=fix)
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
    got = "a single column " + repr(text if len(text) < 80 else text[:77] + "...")
    return MeasurementError.of(f"file '{path}', header", expected=f"columns separated by {sep!r}", got=got, fix=fix)


def _near(missing: Sequence[str], header: Sequence[str]) -> str:
    lowered = {name.lower(): name for name in header}
    near = {name: difflib.get_close_matches(name.lower(), lowered, n=2) for name in missing[:MOST_NAMES]}
    hints = [
        f"for '{name}', did you mean {' or '.join(lowered[m] for m in found)}" for name, found in near.items() if found
    ]
    return "; ".join(hints) if hints else "pass the names as written in the header"


def _check_cells(path: Path, header: list[str], lines: Lines) -> None:
    if not lines:
        what, fix = f"file '{path}' has a header but no rows", "check that it was exported completely"
        raise MeasurementError.of(what, expected="at least one row of numbers", fix=fix)
    ragged = [(line, len(cells)) for line, cells in lines if len(cells) != len(header)]
    if ragged:
        what = f"file '{path}', line {few([line for line, _ in ragged])}"
        fix = "repair these lines (a cell that holds the separator must be quoted)"
        raise MeasurementError.of(what, expected=f"{len(header)} cells as in the header", got=ragged[0][1], fix=fix)


def _parse(path: Path, lines: Lines, wanted: Sequence[str], columns: Sequence[int], decimal: str) -> Tensor:
    """Return the numbers of the chosen columns, (N, c)."""
    values = [[_number(cells[column], decimal) for column in columns] for _, cells in lines]
    unreadable, missing = [], []
    for (line, cells), row in zip(lines, values, strict=True):
        for name, column, value in zip(wanted, columns, row, strict=True):
            if value is None:
                unreadable.append((line, name, cells[column]))
            elif not math.isfinite(value):
                missing.append((line, name, cells[column]))
    if unreadable:
        raise _bad_cells(path, unreadable, "a number", _number_hint(unreadable[0][2], decimal))
    if missing:
        raise _bad_cells(path, missing, "a finite number", "remove or repair these lines")
    return torch.tensor(values, dtype=torch.float64, device=HOST)


def _bad_cells(path: Path, cells: Sequence[tuple[int, str, str]], expected: str, fix: str) -> MeasurementError:
    """Error that names the first of the cells (line, column, text) and the lines of the next ones."""
    line, name, text = cells[0]
    others = list(dict.fromkeys(other for other, _, _ in cells if other != line))
    where = f" (and {len(cells) - 1} more, on line {few(others or [line])})" if len(cells) > 1 else ""
    got = repr(text) if text else "an empty cell"
    return MeasurementError.of(
        f"file '{path}', line {line}, column '{name}'{where}", expected=expected, got=got, fix=fix
    )


def _number(text: str, decimal: str) -> float | None:
    """Return the number; NaN for an empty cell or a word such as "n/a"; None for anything else."""
    if _MISSING.fullmatch(text):
        return math.nan
    if decimal != ".":
        text = text.replace(".", "?").replace(decimal, ".")  # a point is not part of a number here
    return float(text) if _NUMBER.fullmatch(text) else None


def _number_hint(text: str, decimal: str) -> str:
    other, word = (",", "comma") if decimal == "." else (".", "point")
    if _number(text, other) is not None:
        return f"looks like a decimal {word}: pass decimal={other!r}"
    if "." in text and "," in text:
        return "export the numbers without thousands separators"
    return "repair this cell, or name another column"
