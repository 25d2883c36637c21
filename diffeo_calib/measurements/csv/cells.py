"""Cells and columns of a table. Every mistake is one error that names the file, the line and the column.

This module knows neither units nor robots. Only the wanted columns are read as numbers; other columns may hold
anything.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from diffeo_calib.common.errors import LONGEST_NAME, MOST_NAMES, MeasurementError, few, listed, shown

_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_MISSING = re.compile(
    r"|[+-]?nan|#?n/?a|n\.a\.|#nv|null|none|nil|-+|\*+|\?+"
    r"|[+-]?1\.#(ind|[qs]?nan)0*|missing|lost|occluded|hidden|invalid|no data|out of view"
    r"|invisible|not (visible|tracked|found|available)",
    re.IGNORECASE,
)
_DEGREES = re.compile(
    r"([+-]?)(\d+(?:\.\d+)?) ?°(?: ?((?:[0-5]?\d|60)(?:\.\d+)?) ?['′])?(?: ?((?:[0-5]?\d|60)(?:\.\d+)?) ?(?:\"|''|″))?",
    re.ASCII,
)
_INFINITE = re.compile(r"[+-]?inf(inity)?", re.IGNORECASE)
_TYPOGRAPHY = str.maketrans("\u2212\u2013\u2019\u00a0\u202f\u2009", "--'   ")

LARGEST_NUMBER = 1e12  # larger numbers, in any unit, are no measurements: marks of missing readings, or damage
_PLAIN = re.compile(r"[0-9+\-.eE]*", re.ASCII)
"""Characters of numbers: of these, ``float`` reads what _NUMBER matches, only faster."""


def csv_text(rows: Iterable[Iterable[object]], sep: str = ",", end: str = "\n") -> str:
    """Rows of cells as CSV; numbers are read back to the last bit."""
    text = io.StringIO(newline="")
    csv.writer(text, delimiter=sep, lineterminator=end).writerows(rows)
    return text.getvalue()


def repeated(names: Sequence[str]) -> list[str]:
    """Return the names that occur more than once."""
    return [name for name, count in Counter(names).items() if count > 1]


def bad_cells(path: Path, cells: Sequence[tuple[int, str, str]], expected: str, fix: str) -> MeasurementError:
    """Error about cells, each a line, a column and a text, that are not what they should be.

    It names the first, but of one line a wrong one rather than an empty one, and the lines of the next ones.
    """
    line, name, text = next((cell for cell in cells if cell[0] == cells[0][0] and cell[2]), cells[0])
    others = list(dict.fromkeys(other for other, _, _ in cells if other != line)) or [line]
    where = f" (and {len(cells) - 1} more, on line {few(others)})" if len(cells) > 1 else ""
    got = shown(repr(text)) if text else "an empty cell"
    return MeasurementError.of(
        f"file '{path}', line {line}, column '{shown(name)}'{where}", expected=expected, got=got, fix=fix
    )


def find_columns(path: Path, header: list[str], wanted: Sequence[str], sep: str) -> list[int]:
    """Return the position of every wanted column in the header."""
    missing = [name for name in wanted if name not in header]
    if missing:
        what, got = f"file '{path}', header: no column {listed(missing)}", f"the columns {listed(header)}"
        fix = _near(missing, [name for name in header if name not in wanted])
        likely = max(";,\t| ", key=header[0].count)
        if len(header) == 1 and likely in header[0]:
            got, fix = f"a single column {shown(repr(header[0]))} without {sep!r}", f"pass sep={likely!r}"
        elif header == [str(k + 1) for k in range(len(header))]:
            fix = "the file has no header line: name its columns by their places, such as '1', '2', '3'"
        raise MeasurementError.of(what, got=got, fix=fix)
    twice = [name for name in repeated(header) if name in wanted]
    if twice:
        fix = "give every column its own name"
        raise MeasurementError.of(f"file '{path}', header: {listed(twice)} named more than once", fix=fix)
    return [header.index(name) for name in wanted]


def _near(missing: Sequence[str], free: Sequence[str]) -> str:
    """Which of the columns that no other name matches may be meant; "_", "joint" and case do not count."""
    names = {re.sub("joint|_", "", name.lower()) or name: name for name in free if len(name) <= LONGEST_NAME}
    hints = []
    for name in [name for name in missing[:MOST_NAMES] if len(name) <= LONGEST_NAME]:
        near = difflib.get_close_matches(re.sub("joint|_", "", name.lower()) or name, names, n=2)
        hints += [f"for '{shown(name)}', did you mean {' or '.join(shown(names[key]) for key in near)}"] * bool(near)
    return "; ".join(hints) if hints else "pass the names as written in the header"


def numbers_in(texts: Sequence[str], decimal: str, *, whole: bool = True) -> list[float | None]:
    """The numbers of a column, see :func:`number`; "1,481" is one where another cell such as "1,481.25" proves it.

    A ``whole`` column that holds numbers with the other decimal mark alone, which no thousands explain, has this one.
    """
    plain = texts if decimal == "." else [text.replace(".", "?").replace(decimal, ".") for text in texts]
    if _PLAIN.fullmatch("".join(plain)):
        with suppress(ValueError):
            return [float(text) for text in plain]
    grouped = any(_GROUP[decimal] in text and number(text, decimal) is not None for text in texts)
    values = [number(text, decimal, grouped=grouped) for text in texts]
    if whole and None in values and any(number(text, decimal, grouped=True) is None for text in texts):
        other = [number(text, _GROUP[decimal]) for text in texts]
        return values if None in other else other
    return values


_GROUP = {".": ",", ",": "."}  # by decimal mark, the one between thousands that may be a decimal mark too


def number(text: str, decimal: str, *, grouped: bool = False) -> float | None:
    """Return the number, finite or not; NaN for an empty cell or a word such as "n/a"; None for anything else.

    Thousands may be grouped by spaces, apostrophes, or by the other decimal mark where the cell shows both or several
    groups; with ``grouped`` also elsewhere. Degrees, minutes and seconds such as 12°34'56.7" are degrees.
    """
    if _MISSING.fullmatch(text):
        return math.nan
    text = text.translate(_TYPOGRAPHY)
    if _INFINITE.fullmatch(text):
        return math.inf
    if "°" in text and (angle := _DEGREES.fullmatch(text.replace(decimal, "."))):
        parts = [float(part or 0.0) for part in angle.groups()[1:]]
        return float(f"{angle[1]}1") * (parts[0] + parts[1] / 60.0 + parts[2] / 3600.0)
    for mark in (_GROUP[decimal], "'", " "):
        if mark in text:
            pattern = rf"[+-]?[1-9]\d{{0,2}}((?:{re.escape(mark)}\d{{3}})+)({re.escape(decimal)}\d*)?"
            matched = re.fullmatch(pattern, text, re.ASCII)
            if matched and (mark != _GROUP[decimal] or matched[2] or len(matched[1]) > 4 or grouped):
                text = text.replace(mark, "")
    if decimal != ".":
        text = text.replace(".", "?").replace(decimal, ".")  # a point is not part of a number here
    return float(text) if _NUMBER.fullmatch(text) else None


def number_hint(text: str, decimal: str) -> str:
    """What to do about a cell that is no number."""
    other, word = (",", "comma") if decimal == "." else (".", "point")
    if number(text, other) is not None or number(text, decimal, grouped=True) is not None:
        return f"looks like a decimal {word}: pass decimal={other!r}, or export without marks of thousands"
    return "repair this cell, or name another column"
