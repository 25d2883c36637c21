"""What is done to a measurement table, see tables.py: cells, rows, columns, the file, the options."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

ROWS = 30
JOINTS, PLACES = range(6), range(6, 9)
Rng = np.random.Generator


@dataclass
class Sheet:
    """A table as cells, the header first, and how it is written and read."""

    cells: list[list[str]]
    sep: str = ","
    eol: str = "\n"
    encoding: str = "utf-8"
    options: dict[str, str] = field(default_factory=lambda: {"length": "mm", "angle": "deg", "sep": ","})
    after: Callable[[bytes], bytes] | None = None
    moved: dict[str, float] = field(default_factory=dict)
    """Constants that were added to columns, by their names."""

    @property
    def content(self) -> bytes:
        """The file."""
        text = self.eol.join(self.sep.join(row) for row in self.cells) + self.eol
        content = text.encode(self.encoding, "replace")
        return content if self.after is None else self.after(content)


ODD_CELLS = (
    *(
        "",
        " ",
        "nan",
        "NaN",
        "inf",
        "-inf",
        "1e300",
        "-1e300",
        "1e30",
        "1e-300",
        "1e999",
        "abc",
        "--5",
        "1.2.3",
        "0x1F",
    ),
    *("1_000", "1 000", "１２", "5°", "5 mm", '"', '"5', "'7'", "NULL", "None", "#REF!", "=1+1", "\x00", "\x1b[31m7"),
    *("1,5", "1.5e", "+3", ".5", "5.", "1e2", "999999", "-0", "0" * 400, "9" * 400, "x" * 20000, "7;8", "\t3", "NA"),
    *("1d3", "∞", "π", "1/3", "true", "12:30", "2024-01-01", "\ufeff3", "−3"),
)


def _pick(rng: Rng, items: Sequence[str]) -> str:
    return items[int(rng.integers(len(items)))]


def _row(rng: Rng) -> int:
    return int(rng.integers(1, ROWS + 1))


def _numbers(sheet: Sheet, column: int) -> np.ndarray:
    return np.array([float(row[column]) for row in sheet.cells[1:]])


def _set_numbers(sheet: Sheet, column: int, values: np.ndarray) -> None:
    for row, value in zip(sheet.cells[1:], values, strict=True):
        row[column] = repr(float(value))


def odd_cell(sheet: Sheet, rng: Rng) -> None:
    """A cell that is no number, or an absurd one."""
    sheet.cells[_row(rng)][int(rng.integers(9))] = _pick(rng, ODD_CELLS)


def odd_header(sheet: Sheet, rng: Rng) -> None:
    """A name that is empty, repeated or strange."""
    names = sheet.cells[0]
    names[int(rng.integers(9))] = _pick(rng, (*ODD_CELLS, *names, names[0].upper(), f" {names[1]} ", f'"{names[2]}"'))


def changed_number(sheet: Sheet, rng: Rng) -> None:
    """One cell by a large amount: a digit, the sign, the decimal point."""
    row, column = sheet.cells[_row(rng)], int(rng.integers(9))
    value, how = float(row[column]), int(rng.integers(5))
    row[column] = repr([-value, 10 * value, value / 10, value + 100, float(rng.normal(0, 1000))][how])


def changed_rows(sheet: Sheet, rng: Rng) -> None:
    """A block of rows whose positions are off by the same vector, or by random ones."""
    first, count = _row(rng), int(rng.integers(1, ROWS // 2))
    size = 10 ** rng.uniform(0, 3.5)
    shift = rng.normal(0, size, 3)
    for row in sheet.cells[first : first + count]:
        away = shift if rng.random() < 0.7 else rng.normal(0, size, 3)
        for column, change in zip(PLACES, away, strict=True):
            row[column] = repr(float(row[column]) + float(change))


def scaled_column(sheet: Sheet, rng: Rng) -> None:
    """A column in another unit, mirrored, or without its decimals."""
    column = int(rng.integers(9))
    factors = (-1, 0.001, 1000, 0.01, 10, np.pi / 180, 180 / np.pi, 25.4, 0, 0.5, 2, 1.01)
    _set_numbers(sheet, column, _numbers(sheet, column) * factors[int(rng.integers(len(factors)))])


def scaled_group(sheet: Sheet, rng: Rng) -> None:
    """All joints or all positions in another unit."""
    factor = float(rng.choice([-1, 0.001, 1000, np.pi / 180, 180 / np.pi, 25.4, 0.01]))
    for column in JOINTS if rng.random() < 0.5 else PLACES:
        _set_numbers(sheet, column, _numbers(sheet, column) * factor)


def moved_column(sheet: Sheet, rng: Rng) -> None:
    """A constant added to a column: an offset of a joint, or of the measuring frame (harmless)."""
    column, by = int(rng.integers(9)), float(rng.choice([1, -5, 90, -180, 360, 1000, 1e6]))
    _set_numbers(sheet, column, _numbers(sheet, column) + by)
    sheet.moved[sheet.cells[0][column]] = by


def rounded_column(sheet: Sheet, rng: Rng) -> None:
    """A column with few digits, or constant."""
    column, digits = int(rng.integers(9)), int(rng.integers(-2, 3))
    values = np.round(_numbers(sheet, column), digits)
    _set_numbers(sheet, column, values if rng.random() < 0.8 else np.full_like(values, values[0]))


def swapped_columns(sheet: Sheet, rng: Rng) -> None:
    """Two columns under each other's names."""
    one, other = rng.choice(9, 2, replace=False)
    for row in sheet.cells[1:]:
        row[one], row[other] = row[other], row[one]


def reordered_columns(sheet: Sheet, rng: Rng) -> None:
    """Columns with their names in another order: harmless."""
    order = rng.permutation(9)
    sheet.cells[:] = [[row[k] for k in order] for row in sheet.cells]


def reordered_rows(sheet: Sheet, rng: Rng) -> None:
    """Rows in another order: harmless."""
    sheet.cells[1:] = [sheet.cells[1 + k] for k in rng.permutation(len(sheet.cells) - 1)]


def slipped_rows(sheet: Sheet, rng: Rng) -> None:
    """Positions that slip against the joints, all of them or from a row on."""
    first, slip = (1 if rng.random() < 0.5 else _row(rng)), int(rng.choice([-2, -1, 1, 2]))
    rows = sheet.cells[first:]
    places = [row[6:] for row in rows]
    for k, row in enumerate(rows):
        row[6:] = places[(k + slip) % len(places)]


def shuffled_rows(sheet: Sheet, rng: Rng) -> None:
    """Positions of other rows: two that are swapped, or all."""
    count = len(sheet.cells) - 1
    chosen = rng.choice(count, 2 if rng.random() < 0.5 else count, replace=False)
    places = [sheet.cells[1 + k][6:] for k in chosen]
    for k, place in zip(np.roll(chosen, 1), places, strict=True):
        sheet.cells[1 + k][6:] = place


def repeated_rows(sheet: Sheet, rng: Rng) -> None:
    """Rows that are there twice."""
    sheet.cells += [list(row) for row in sheet.cells[1 : 1 + int(rng.integers(1, 5))]]


def missing_rows(sheet: Sheet, rng: Rng) -> None:
    """Few rows, one, or none."""
    del sheet.cells[int(rng.choice([0, 1, 2, 3, 5, 8, 12, 20])) :]


def ragged_rows(sheet: Sheet, rng: Rng) -> None:
    """Cells too many or too few, empty rows, a second header, notes."""
    row, how = _row(rng), int(rng.integers(6))
    if how < 2:
        sheet.cells[row] = sheet.cells[row][: int(rng.integers(9))] if how else [*sheet.cells[row], "1"]
    else:
        extra = [[""], [""] * 9, list(sheet.cells[0]), ["# measured in the morning"]][how - 2]
        sheet.cells.insert(row, extra)


def missing_column(sheet: Sheet, rng: Rng) -> None:
    """A column that is not there."""
    column = int(rng.integers(9))
    for row in sheet.cells:
        del row[column]


def written_otherwise(sheet: Sheet, rng: Rng) -> None:
    """Line ends, encodings, byte order marks, trailing spaces, quotes."""
    how = int(rng.integers(8))
    sheet.eol = ["\r\n", "\r", "\n\n", "\n", "\n", "\n", " \n", ",\n"][how]
    sheet.encoding = ["utf-8", "utf-8", "utf-8", "utf-16", "utf-8-sig", "latin-1", "utf-8", "utf-8"][how]
    if rng.random() < 0.3:
        sheet.cells[:] = [[f'"{cell}"' for cell in row] for row in sheet.cells]


def separated_otherwise(sheet: Sheet, rng: Rng) -> None:
    """Another separator or decimal mark, with the options changed or not."""
    sheet.sep = _pick(rng, (";", "\t", "|", " ", ",", ":", "a", "."))
    sheet.options["sep"] = _pick(rng, (sheet.sep, ",", ";", "", "\\t", "ab", "\n", "'", '"', "0"))
    sheet.options["decimal"] = _pick(rng, (".", ",", "", ";", "..", "1"))


def read_otherwise(sheet: Sheet, rng: Rng) -> None:
    """The wrong unit, or none."""
    name = _pick(rng, ("length", "angle"))
    sheet.options[name] = _pick(rng, ("m", "mm", "rad", "deg", "", "cm"))


def broken_bytes(sheet: Sheet, rng: Rng) -> None:
    """Bytes that are flipped, cut off, repeated or put in."""
    how, share, value = int(rng.integers(5)), rng.random(), int(rng.integers(256))

    def edit(content: bytes) -> bytes:
        place = int(share * len(content))
        flipped = content[:place] + bytes([value]) + content[place + 1 :]
        put_in = content[:place] + bytes([value]) * 3 + content[place:]
        return [flipped, content[:place], put_in, content + content[place:], b"\x1f\x8b" + content][how]

    sheet.after = edit


QUICK = (
    *(odd_cell, odd_header, reordered_columns, reordered_rows, repeated_rows, missing_rows, ragged_rows),
    *(missing_column, written_otherwise, separated_otherwise, broken_bytes),
)
"""Judged by reading alone, or harmless: milliseconds."""
SLOW = (
    *(changed_number, changed_rows, scaled_column, scaled_group, moved_column, rounded_column, swapped_columns),
    *(slipped_rows, shuffled_rows, read_otherwise),
)
"""Numbers that are wrong: the registration looks for the likely mistake, which takes seconds."""
MUTATIONS = (*QUICK, *QUICK, *SLOW)
