"""Cells of a table as numbers, and of files that are no text: spreadsheets, arrays of NumPy, variables of MATLAB.

An array (N, k) has a column for each k, named after it and numbered from 1; (N, 3) of an array in a file of several is
x, y, z where the name is that of places; of poses (N, 4, 4) the columns are numbered by row and column, 00 to 33. Of
several arrays those with the number of rows that most columns have are the table; (k, N) among them is turned. Two
sheets are one table if one column of both has the same texts.
"""

from __future__ import annotations

import csv
import difflib
import io
import json
import math
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import compress, product, zip_longest
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

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


# --- files that are no text

MARKS = ZIP, OLD_SHEET, NUMPY, MATLAB = b"PK\3\4", b"\xd0\xcf\x11\xe0", b"\x93NUMPY", b"MATLAB "
"""First bytes of files that are no text."""
HDF5 = b"MATLAB 7.3"
PLACES = {"p", "pos", "position", "positions", "point", "points", "xyz", "marker", "markers", "measured", "tcp"}
"""Names of arrays (N, 3) of places."""


def as_text(path: Path, data: bytes, sep: str) -> tuple[str, list[str]] | None:
    """A table that is no text, with ``sep`` between its cells, and what was decided; None for text.

    MeasurementError for a spreadsheet of an old format, arrays that are no table, or a package that is not installed.
    """
    variables = b"\0" in data and (data.startswith(MATLAB) or path.suffix.lower() == ".mat")  # version 4 has no mark
    if not variables and not data.startswith((ZIP, OLD_SHEET, NUMPY, b"{", b"[")):
        return None
    table = _table(path, data)
    return table and (csv_text(table[0], sep), table[1])


Rows = Sequence[Sequence[object]]


@lru_cache(maxsize=2)  # a spreadsheet of 5000 rows takes a second, and `init` reads its tables many times
def _table(path: Path, data: bytes) -> tuple[Rows, list[str]] | None:
    if data[:1] in (b"{", b"["):
        return _records(data)
    if data.startswith(OLD_SHEET):
        raise _no_table(path, "a spreadsheet of an old format", "save it as .xlsx or CSV")
    if data.startswith(HDF5):
        raise _no_table(path, "a MATLAB file of version 7.3", "save it with `save(..., '-v7')`, or as CSV")
    file = io.BytesIO(data)
    if not data.startswith(ZIP):
        return (_array if data.startswith(NUMPY) else _variables)(path, file)
    names = list[str]()
    with suppress(zipfile.BadZipFile), zipfile.ZipFile(file) as archive:
        names = archive.namelist()
    file.seek(0)
    if names and all(name.endswith(".npy") for name in names):
        return _joined(path, _loaded(path, lambda: dict(np.load(file, allow_pickle=False))))
    return _spreadsheet(path, file)


def _records(data: bytes) -> tuple[Rows, list[str]] | None:
    """Objects of JSON, in a list or one a line, with a column for each number or text; None for another text."""
    with suppress(ValueError, RecursionError):
        records = json.loads(data) if data[:1] == b"[" else [json.loads(line) for line in data.splitlines() if line]
        rows = [dict(_leaves("", record)) for record in records if isinstance(record, dict)]
        if header := [*dict.fromkeys(name for row in rows for name in row)]:
            return [header, *([_cell(row.get(name)) for name in header] for row in rows)], []
    return None


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Numbers and texts of an object, by names that tell where they stand in it."""
    if isinstance(value, dict):
        parts = [(f"{name}_{key}" if name else str(key), part) for key, part in value.items()]
    elif isinstance(value, list):
        parts = [*zip(names_of(name, (len(value),)), value, strict=True)]
    else:
        yield name, value
        return
    for part_name, part in parts:
        yield from _leaves(part_name, part)


def _no_table(path: Path, got: str, fix: str) -> MeasurementError:
    return MeasurementError.of(f"file '{path}' is no text but {got}", expected="a table", fix=fix)


def _spreadsheet(path: Path, file: BinaryIO) -> tuple[Rows, list[str]]:
    """The sheet with the most filled cells: values, not formulas."""
    try:
        from openpyxl import load_workbook  # noqa: PLC0415  # optional
    except ImportError:
        fix = "pip install 'diffeo_calib[excel]', or export the table as CSV"
        raise _no_table(path, "a spreadsheet, and openpyxl, which reads it, is not installed", fix) from None
    try:
        book = load_workbook(file, read_only=True, data_only=True)
        for sheet in book.worksheets:
            sheet.reset_dimensions()  # which some programs write as one cell
        sheets = {sheet.title: list(sheet.iter_rows(values_only=True)) for sheet in book.worksheets}
    except Exception as error:  # openpyxl raises errors of many kinds for damaged files
        raise _no_table(path, f"a spreadsheet that cannot be read ({error})", "save it as .xlsx or CSV") from error
    filled = {name: sum(cell is not None for row in rows for cell in row) for name, rows in sheets.items()}
    if not any(filled.values()):
        raise _no_table(path, "a spreadsheet without cells", "check that it was saved completely")
    each = {
        name: zip_longest(*(map(_cell, row) for row in sheets[name]), fillvalue="") for name in sheets if filled[name]
    }
    tables = {name: [[*row] for row in zip(*filter(any, columns), strict=True)] for name, columns in each.items()}
    if (joined := _joined_sheets(tables)) is not None:
        return joined
    best = max(filled, key=filled.__getitem__)
    others = [name for name in tables if name != best]
    return tables[best], [f"sheet '{best}' read, not {few(others)}"] * bool(others)


def _joined_sheets(sheets: Mapping[str, list[list[str]]]) -> tuple[Rows, list[str]] | None:
    """Two sheets whose first lines have one common name, with the same different texts below it, side by side."""
    each = [[row for row in rows if any(row)] for rows in sheets.values()]
    common = {*each[0][0]} & {*each[-1][0]} - {""} if len(each) == 2 else set[str]()
    if len(common) != 1:
        return None
    (by,), (one, other) = common, each
    first, second = ({row[rows[0].index(by)]: row for row in rows} for rows in each)
    if {*first} != {*second} or len({len(table) for table in (one, other, first)}) > 1:
        return None
    kept = [name != by for name in other[0]]
    cells = [[*row, *compress(second[key], kept)] for key, row in first.items()]
    return cells, [f"sheets {' and '.join(map(repr, sheets))} joined by '{by}'"]


def _cell(value: Any) -> str:
    """A number with all of its digits, or a text in one line."""
    if value is None:
        return ""
    return repr(value) if isinstance(value, int | float) else " ".join(str(value).split())


def _array(path: Path, file: BinaryIO) -> tuple[Rows, list[str]]:
    array = _loaded(path, lambda: np.load(file, allow_pickle=False))
    if array.dtype.names:
        return _joined(path, {name: array[name] for name in array.dtype.names})
    if array.ndim != 2 or array.dtype.kind not in "fiu":
        raise _no_table(path, f"an array of shape {array.shape}", "save numbers of shape (N, columns), or with names")
    return _texts(array), []


def _variables(path: Path, file: BinaryIO) -> tuple[Rows, list[str]]:
    """Variables of MATLAB, and fields of those that are structures."""
    from scipy.io import loadmat  # noqa: PLC0415  # slow to import

    whole = _loaded(path, lambda: loadmat(file, squeeze_me=True, struct_as_record=True))
    arrays = dict[str, Any]()
    for name, value in whole.items():
        fields = getattr(getattr(value, "dtype", None), "names", None)
        if fields and value.ndim == 0:
            arrays |= {f"{name}_{field}": value[field].item() for field in fields}
        elif not name.startswith("__"):
            arrays[name] = value
    return _joined(path, arrays)


def _loaded(path: Path, load: Callable[[], Any]) -> Any:
    try:
        return load()
    except Exception as error:  # of damaged files, and of arrays of objects
        raise _no_table(path, f"arrays that cannot be read ({error})", "save numbers alone, or export CSV") from error


def _joined(path: Path, arrays: Mapping[str, Any]) -> tuple[Rows, list[str]]:
    """Arrays (N, ...) of numbers or texts side by side below their names; those of other lengths are left out."""
    given = {name: np.asarray(array) for name, array in arrays.items()}
    cells = {name: array for name, array in given.items() if array.dtype.kind == "O"}  # of MATLAB
    given |= {name: array.astype(str) for name, array in cells.items() if all(isinstance(v, str) for v in array.flat)}
    usable = {name: array for name, array in given.items() if array.dtype.kind in "fiubUS" and 0 < array.ndim < 4}
    written, turned = Counter[int](), Counter[int]()  # columns of arrays with so many rows, as they are and if turned
    for array in usable.values():
        rows, columns = len(array), array[:1].size
        few_columns = min(rows, columns) if array.shape[1:] != (rows,) else 0  # a square may be either
        written[rows] += few_columns
        turned[max(rows, columns) if array.ndim == 2 else rows] += few_columns
    if not usable:
        raise _no_table(path, f"the arrays {few(list(given))}", "save numbers of shape (N,) or (N, columns)")
    rows = max(written, turned, key=lambda counts: max(counts.values())).most_common(1)[0][0]
    usable = {name: array.T if array.ndim == 2 and len(array) != rows else array for name, array in usable.items()}
    kept = {name: array for name, array in usable.items() if len(array) == rows}
    header = [column for name, array in kept.items() for column in names_of(name, array.shape[1:])]
    values = zip(*(_texts(array.reshape(rows, math.prod(array.shape[1:]))) for array in kept.values()), strict=True)
    left = [name for name in given if name not in kept]
    notes = [f"arrays {few(left)} left out: no numbers or texts of {rows} rows"] * bool(left)
    return [header, *([cell for part in row for cell in part] for row in values)], notes


def names_of(name: str, shape: tuple[int, ...]) -> Iterator[str]:
    """Columns of an array."""
    if not shape:
        yield name
    elif shape == (3,) and name.lower().rpartition("_")[2] in PLACES:
        yield from (f"{name}_{axis}" for axis in "xyz")
    elif len(shape) == 1:
        yield from (f"{name}_{k + 1}" for k in range(shape[0]))
    else:
        yield from (f"{name}_{row}{column}" for row, column in product(range(shape[0]), range(shape[1])))


def _texts(array: np.ndarray) -> list[list[str]]:
    array = array.astype(np.int64) if array.dtype.kind == "b" else array
    array = array.astype(np.str_) if array.dtype.kind == "S" else array
    return [[_cell(value) for value in row] for row in array.tolist()]
