"""How a table seems to be written, and what its columns hold, by their names: what `diffeo-calib init` starts from."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.cells import LARGEST_NUMBER, bad_cells, number, number_hint, numbers_in
from diffeo_calib.measurements.csv.lines import CsvLines
from diffeo_calib.measurements.readings import MILLIMETRES
from diffeo_calib.sensors.kinds import known_kinds

SEPARATORS = (",", ";", "\t", "|", " ")
DECIMALS = (".", ",")
ROWS_LOOKED_AT = 50
"""Rows that are looked at."""
NOT_MEASURED = ("std", "sigma", "dev", "err", "goal", "target", "command", "cmd", "nominal", "desired", "plan")
"""Parts of the names of columns that hold deviations or wishes, not measured places."""
TURNS = ("rot", "euler", "quat", "ang")
"""Parts of the names of columns that hold rotations."""
UNITS = re.compile(r"[_ ]*[\[(]?(?:rad|deg|degrees?|mm|m)[\])]?$", re.IGNORECASE)
"""Units that follow the name of a column."""


PLACE = re.compile(r"(?<![a-z])[tpm]$", re.IGNORECASE)
"""A letter before x, y, z that says what they are: translation, position, measured."""
PIXELS = ("u", "v"), ("pixel_u", "pixel_v"), ("u_px", "v_px")
"""Names of columns of images."""
LENS, SOME_LENS = "FX,FY,CX,CY", "1000,1000,500,500"
"""Placeholder for the user to fill in, and the value that replaces it while the other rows are read."""
SESSIONS = ("session", "setup", "set_up", "station", "anchor", "device", "plane")
PAYLOADS = ("payload", "mass", "load", "payload_kg", "mass_kg", "load_kg")
COVARIATES = {
    "time": ("time", "time_s", "time_h", "timestamp", "seconds", "minutes", "hours", "hour"),
    "temperature": ("temperature", "temp", "temperature_c", "temp_c"),
}
"""Option -> names of columns with which something may drift."""
ROTATIONS = (
    ("qx", "qy", "qz", "qw"),
    ("quat_x", "quat_y", "quat_z", "quat_w"),
    tuple(f"r{row}{column}" for row in "123" for column in "123"),
    tuple(f"r{row}{column}" for row in "012" for column in "012"),
    ("rx", "ry", "rz"),
    ("rot_x", "rot_y", "rot_z"),
    ("rotvec_x", "rotvec_y", "rotvec_z"),
    ("roll", "pitch", "yaw"),
    ("euler1", "euler2", "euler3"),
)
"""Ends of the names of rotation columns."""
DEVIATIONS = re.compile(r"(std_?dev|stdev|std|sigma|dev)")


@dataclass(frozen=True)
class Sheet:
    """A table as it seems to be written.

    Args:
        sep, decimal: between cells, and in numbers. header: all columns. numbers: those that hold numbers alone.
        notes: what the reader decided. odd: which cells are no numbers in columns that seem to hold some; or empty.
    """

    sep: str
    decimal: str
    header: tuple[str, ...]
    numbers: tuple[str, ...]
    notes: tuple[str, ...] = ()
    odd: str = ""


def guess_sheet(path: Path) -> Sheet:
    """The separator and decimal mark with which most columns are numbers; MeasurementError says why none is right."""
    found, reasons = list[Sheet](), list[tuple[int, MeasurementError]]()
    for sep in SEPARATORS:
        file = CsvLines(path, sep)
        try:
            with file:
                rows = [line for block in file.blocks() for line in block][:ROWS_LOOKED_AT]
        except MeasurementError as error:
            reasons.append((len(file.header), error))
            continue
        lines, cells = zip(*rows, strict=True)
        columns = {name: texts for name, *texts in zip(file.header, *cells, strict=True) if name}
        for decimal in (mark for mark in DECIMALS if mark != sep):
            numbers = tuple(name for name, texts in columns.items() if _readable(texts, decimal))
            odd = [
                cell for name in columns if name not in numbers for cell in _odd(name, lines, columns[name], decimal)
            ]
            why = str(bad_cells(path, odd, "a number", number_hint(odd[0][2], decimal))) if odd else ""
            found.append(Sheet(sep, decimal, tuple(columns), numbers, tuple(file.notes), why))
    best = max(found, key=lambda sheet: len(sheet.numbers), default=None)
    width, reason = max(reasons, key=lambda one: one[0], default=(0, None))
    if reason is not None and (best is None or not best.numbers or width > 2 * len(best.numbers)):
        raise reason
    if best is None or not best.numbers:
        fix = "check that one line names the columns, and that the lines below hold numbers"
        raise MeasurementError.of(f"'{path}' is no table of numbers with any usual separator", fix=fix)
    return best


def _readable(texts: Sequence[str], decimal: str) -> bool:
    """Whether `fit` reads the cells: numbers, or marks of lost ones; dates such as 20210313... are all too large."""
    values = numbers_in(texts, decimal)
    large = [value for value in values if value is not None and abs(value) >= LARGEST_NUMBER]  # not NaN
    return None not in values and 2 * len(large) <= len(values)


def _odd(name: str, lines: Sequence[int], texts: Sequence[str], decimal: str) -> list[tuple[int, str, str]]:
    """Line, column and text of the cells that are no numbers, if most are, or if they look like numbers."""
    values = numbers_in(texts, decimal)
    found = [(line, name, text) for line, text, value in zip(lines, texts, values, strict=True) if value is None]
    seem = bool(found) and number(found[0][2], decimal, grouped=True) is not None
    return found if seem or 2 * len(found) < len(texts) else []


def guess_joints(columns: Sequence[str], joints: Sequence[str]) -> tuple[list[str], str] | None:
    """Columns of the joints in the robot's order, and why; None if no reading of the names gives them all.

    Names are compared as they are, without case, units and signs, and then as numbered series such as q1, q2, ...
    """
    if columns and all(column.isdecimal() for column in columns) and len(columns) > len(joints):
        return [*columns[: len(joints)]], "the first columns: no line of the file names them"
    for how, plain in (("named as in the URDF", str), ("named as in the URDF but for units and case", _bare)):
        known = {plain(column): column for column in columns}
        if len(known) == len(columns) and all(plain(joint) in known for joint in joints):
            return [known[plain(joint)] for joint in joints], how
    series: dict[str, dict[int, str]] = {}
    for column in columns:
        parts = re.fullmatch(r"(.*?)(\d+)(\D*)", column)
        if parts is not None:
            series.setdefault(f"{parts[1]}#{parts[3]}".lower(), {})[int(parts[2])] = column
    for numbered in series.values():
        for first in (0, 1):
            wanted = range(first, first + len(joints))
            if len(numbered) == len(joints) and set(numbered) == set(wanted):
                return [numbered[k] for k in wanted], "numbered in the order of the URDF's joints"
    return None


def guess_positions(columns: Sequence[str]) -> list[list[str]]:
    """Triples of columns whose names differ by x, y and z alone, in their order; no deviations, no targets."""
    found: dict[str, dict[str, str]] = {}
    no_place = (*NOT_MEASURED, *TURNS)
    for column in [name for name in columns if not any(word in name.lower() for word in no_place)]:
        for place in [k for k, letter in enumerate(column.lower()) if letter in "xyz"]:
            around = column[:place], column[place + 1 :]
            before, after = PLACE.sub("", around[0]), around[1]
            if not any(text and text[edge].isalpha() for text, edge in ((before, -1), (after, 0))):
                found.setdefault("#".join(around).lower(), {})[column[place].lower()] = column
    return [[triple[axis] for axis in "xyz"] for triple in found.values() if set(triple) == set("xyz")]


def guess_sockets(header: Sequence[str]) -> list[str] | None:
    """The columns place and socket, or socket alone, that name where a ball rested; None without a socket."""
    known = {name.lower(): name for name in header}
    return [known[name] for name in ("place", "socket") if name in known] if "socket" in known else None


def guess_readings(columns: Sequence[str]) -> dict[str, list[str]]:
    """Texts of `fit --reading` of all kinds of devices, by the names of their columns; these columns."""
    found = dict[str, list[str]]()
    for kind in known_kinds().values():
        numbers = [""] if kind.numbers_each == 1 else [f"{k + 1}" for k in range(kind.numbers_each)]
        unit = UNITS if kind.unit == MILLIMETRES else re.compile(rf"[_ ]*[\[(]?{re.escape(kind.unit[0])}[\])]?$")
        there = {_plain(unit.sub("", name)): name for name in reversed(columns)}
        for word, known in kind.columns().items():
            each = ([f"{_plain(name)}{number}" for number in numbers] for name in known)
            own = next(([there[name] for name in names] for names in each if set(names) <= set(there)), None)
            if own is not None and own not in found.values():
                found[f"{word}={','.join(own)}"] = own
    names = {name.lower(): name for name in columns}
    pixels = next(([names[name] for name in pair] for pair in PIXELS if set(pair) <= set(names)), None)
    if pixels is not None:
        found[f"image={','.join(pixels)},{LENS}"] = pixels
    return found


def guess_column(header: Sequence[str], words: Sequence[str]) -> str | None:
    """The first column that has one of these names, but for case and units; None without one."""
    return next((name for name in header if UNITS.sub("", name).lower() in words), None)


def guess_rotation(columns: Sequence[str], position: Sequence[str]) -> list[str] | None:
    """Columns of a rotation by their names: four of a quaternion, nine of a matrix or three angles; None without any.

    Of several, those whose names begin as the position's do.
    """
    names = [name for name in columns if not any(word in name.lower() for word in NOT_MEASURED)]
    found: list[tuple[str, list[str]]] = []
    for words in ROTATIONS:
        by_prefix: dict[str, dict[str, str]] = {}
        for name in names:
            bare = UNITS.sub("", name).lower()
            word = next((word for word in words if bare.endswith(word)), None)
            if word is not None:
                by_prefix.setdefault(bare.removesuffix(word), {})[word] = name
        found += [
            (before, [own[word] for word in words]) for before, own in by_prefix.items() if len(own) == len(words)
        ]
    start = position[0].lower()
    return min(found, key=lambda entry: not start.startswith(entry[0]), default=(None, None))[1]


def guess_deviations(columns: Sequence[str], triples: Sequence[Sequence[str]]) -> list[str] | None:
    """Columns whose names are those of the positions but for a word such as std, in their order; None if one lacks."""
    known: dict[str, str] = {}
    for column in columns:
        bare = DEVIATIONS.sub("", UNITS.sub("", column).lower())
        if bare != UNITS.sub("", column).lower():
            known[re.sub(r"[^a-z0-9]", "", bare)] = column
    wanted = [_bare(name) for triple in triples for name in triple]
    return [known[name] for name in wanted] if all(name in known for name in wanted) else None


def _bare(name: str) -> str:
    """A name without unit, case and signs."""
    return _plain(UNITS.sub("", name))


def _plain(name: str) -> str:
    """A name without case and signs."""
    return re.sub(r"[^a-z0-9]", "", name.lower())
