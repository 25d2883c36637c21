"""Robots from files with a Denavit-Hartenberg table: a header, and one line for each joint.

Columns have their usual names, in any order: a, alpha, d, theta, and if there are any beta, offset (of the joint's
value), joint (its name), type, min, max and convention. The unit of a column stands behind its name: `d [mm]`,
`alpha_deg`. Columns a_{i-1} and alpha_{i-1} are Craig's. Cells may be multiples of pi and may name the joint's value:
`pi/2`, `q1 - 90`.
"""

from __future__ import annotations

import csv
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, nan, pi
from pathlib import Path
from typing import Any

from diffeo_calib.common.errors import RobotError, few, shown
from diffeo_calib.common.files import decoded, read_regular
from diffeo_calib.robots.dh import LARGEST_ANGLE_RAD, LONGEST_LINK_M, DHRow, from_dh
from diffeo_calib.robots.tree import Chain

NUMBERS = {
    "a": "a linklength lange gliedlange longitud longueur lunghezza",
    "alpha": "alpha linktwist twist verdrehung verwindung torsion torsione",
    "d": "d linkoffset versatz gelenkversatz desplazamiento decalage",
    "theta": "theta jointangle thetaoffset drehwinkel gelenkwinkel angulo",
    "beta": "beta",
    "offset": "offset jointoffset qoffset",
    "lower": "min lower qmin lowerlimit minlimit",
    "upper": "max upper qmax upperlimit maxlimit",
}
"""Number of a joint -> letters of its column's name."""
TEXTS = {
    "name": "joint name jointname frame link axis i no gelenk achse articulacion eje axe",
    "kind": "type kind jointtype sigma",
    "unread": "mimic x y z roll pitch yaw",
    "convention": "convention dhconvention",
}
KINDS = {
    **dict.fromkeys(("revolute", "r", "rotary", "rotational", "continuous", "0"), "revolute"),
    **dict.fromkeys(("prismatic", "p", "linear", "slide", "translational", "1"), "prismatic"),
}
UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "inch": 0.0254, "rad": 1.0, "deg": pi / 180}
SPELLED = {"°": "deg", "grad": "deg", "in": "inch"}
WORDS = {"standard": "classic|classical|sdh", "craig": "craig|mdh"}
"""Words of a file's comments, or of its name, that say its convention."""
USUAL = {
    "standard": r"standard(?!\W+dev)|distal",
    "craig": r"(?<!last )(?<!was )modified(?!\s*(?:on|by|at|:|\d))|proximal",
}
"""Words with other meanings: they count as the cell of a column, as all of a comment, or beside these:"""
TOPIC = "dh|denavit|conventions?|parameters?"
PLAIN = str.maketrans({"α": "alpha", "θ": "theta", "ϑ": "theta", "β": "beta", "π": "pi", "−": "-", "$": "", "\\": ""})
UNIT = re.compile(r"(?:[\[(]\s*|[_ ,/])(mm|cm|m|in|rad|deg|grad|°)(?:ch|ians?|rees?)?(?:\s*[\])]|$)", re.IGNORECASE)
INDEXED = re.compile(r"(a|alpha|d|theta)[_ ]*[{(]?\s*(?:[ijkn](\s*-\s*1)?|(prev)\w*)\s*[})]?")
VALUE = re.compile(r"(?:^|\+)(?:q|theta|th|d)_?\{?\d*\}?\*?(?=$|[+-])")
"""The joint's own value in a cell, such as q1 or theta_1*."""
TURNS = re.compile(r"([+-]?[\d.]*)\*?pi(?:/([\d.]+))?")
RIGHT_ANGLE_RAD = 0.02  # largest difference from 90 or 180 degrees that is one of calibration
LARGEST_FILE = 1_000_000  # bytes of a file that no table has


@dataclass(frozen=True)
class DHFile:
    """The table of a file."""

    path: Path  # the file
    names: list[str]  # of the joints
    rows: list[DHRow]  # their parameters [m, rad]
    convention: str  # "standard" or "craig", empty if the file does not say it
    units: str  # how it was read, in words
    sure: bool = True  # whether words without another meaning say the convention

    @classmethod
    def read(cls, path: Path) -> DHFile:
        """Read a file; columns that say no unit have that with which the robot has the size of one, and right angles.

        Raises RobotError: no such table, a cell that is no number, no unit of angles or limits, or two conventions.
        """
        text = decoded(read_regular(path, "robot's description", LARGEST_FILE, RobotError))[0]
        lines = [line.strip() for line in text.translate(PLAIN).splitlines() if line.strip(" \t-:|+")]
        header, cells, notes = _cells(path, lines)
        rows = [_named(list(map(_what, header)), row) for row in cells]
        said, sure = _conventions(header, rows, [path.stem, *notes])
        if len(said) > 1:
            expected = "standard or craig (modified), in one place"
            raise RobotError.of(f"'{path}' names two conventions", expected=expected)
        stated = {_what(cell): unit[1].lower() for cell in header if (unit := UNIT.search(cell))}
        own = {what: SPELLED.get(unit, unit) for what, unit in stated.items()}
        units = _units(path, rows, own)
        names = [row.get("name") or str(k + 1) for k, row in enumerate(rows)]
        names = [f"joint_{name}" if name.isdecimal() else name for name in names]
        table = [_row(row, units, f"joint '{shown(name)}' of '{path}'") for name, row in zip(names, rows, strict=True)]
        words = f"lengths in {units['a']}, angles in {units['alpha']}" + ", by size" * (not {"a", "alpha"} <= set(own))
        return cls(path, names, table, "".join(said), words, sure)

    def chain(self, convention: str | None = None, tip: str | None = None) -> Chain:
        """The robot from "base" to "tip", or up to a joint.

        Args:
            convention: "standard" or "craig", if the file does not say it. tip: name of the joint.

        Raises RobotError: no convention, or another one than that of the file; no such joint.
        """
        way = (self.convention if self.sure else convention or self.convention) or convention
        if not way or convention not in (None, way):
            what, expected = f"the convention of '{self.path}'", "standard or craig (modified)"
            got = f"{convention}, but the file says {way}" if way else "neither in the file"
            raise RobotError.of(
                what, expected=expected, got=got, fix="say it by --dh-convention; `init` finds the one that fits"
            )
        if tip not in (None, *self.names):
            what, expected = f"--tip of '{self.path}'", f"one of {few(self.names, 20)}"
            raise RobotError.of(what, expected=expected, got=shown(str(tip)))
        count = len(self.names) if tip is None else self.names.index(tip) + 1
        chain = from_dh(self.rows[:count], way, self.names[:count], self.path.stem)
        return Chain(chain.name, chain.base, tip or chain.tip, chain.joints)


def _cells(path: Path, lines: Sequence[str]) -> tuple[list[str], list[list[str]], list[str]]:
    """The header, the cells of every joint, and all other lines."""
    seps = [max(",;\t|", key=line.count) for line in lines]
    headers = [_split(line.lstrip("#%/ "), sep) for line, sep in zip(lines, seps, strict=True)]
    top = next((k for k, header in enumerate(headers) if {"a", "alpha", "d"} <= set(map(_what, header))), None)
    if top is None:
        what, expected = f"'{path}' is no DH table", "a header with the columns a, alpha, d and theta"
        raise RobotError.of(what, expected=expected, got=shown((lines or ["no line"])[0]), fix="or pass a URDF")
    cells = [_split(line, seps[top]) for line in lines[top + 1 :] if line[0] not in "#%/"]
    names = [name for name in map(_what, headers[top]) if name not in ("", "unread")]
    bad = next((row for row in cells if len(row) != len(headers[top])), names if len(set(names)) < len(names) else None)
    if bad is not None or not cells:
        expected, got = f"rows of {len(headers[top])} cells, one column of each kind", few(bad or ["no row"], 20)
        raise RobotError.of(f"the DH table '{path}'", expected=expected, got=got, fix="repair this line")
    return headers[top], cells, [line for k, line in enumerate(lines) if k < top or line[0] in "#%/"]


def _named(header: Sequence[str], cells: Sequence[str]) -> dict[str, str]:
    """Cells by what they hold; those of all columns that are not read as one."""
    whole = list(zip(header, cells, strict=True))
    return dict(whole) | {"unread": " ".join(cell for what, cell in whole if what == "unread" and cell)}


def _split(line: str, sep: str) -> list[str]:
    """Cells of a line; with white space between them where there is no separator."""
    return [cell.strip() for cell in next(csv.reader([line], delimiter=sep))] if sep in line else line.split()


def _bare(cell: str) -> str:
    """A name in the header without its unit."""
    return unicodedata.normalize("NFKD", UNIT.sub("", cell, count=1).strip().lower())


def _what(cell: str) -> str:
    """What a column holds; empty if its name is unknown."""
    indexed = INDEXED.fullmatch(_bare(cell))
    letters = indexed[1] if indexed else re.sub(r"[^a-z]", "", _bare(cell))
    return next((what for what, names in (NUMBERS | TEXTS).items() if letters in names.split()), "")


def _conventions(
    header: Sequence[str], rows: Sequence[Mapping[str, str]], notes: Sequence[str]
) -> tuple[set[str], bool]:
    """The conventions that a file names in its header, cells and other lines; whether by words with one meaning."""
    said = {"craig" for cell in header if (index := INDEXED.fullmatch(_bare(cell))) and (index[2] or index[3])}
    cells = [row.get("convention", "") for row in rows]
    said |= {way for way, words in WORDS.items() if _mention([*cells, *notes], words) or _mention(cells, USUAL[way])}
    if said:
        return said, True
    about = [line for line in notes if _mention([line], TOPIC) or len(re.findall(r"[^\W_]+", line)) == 1]
    return {way for way, words in USUAL.items() if _mention(about, words)}, False


def _mention(lines: Sequence[str], words: str) -> bool:
    return any(re.search(f"(?<![a-z])({words})(?![a-z])", line, re.IGNORECASE) for line in lines)


def _units(path: Path, rows: Sequence[Mapping[str, str]], stated: Mapping[str, str]) -> dict[str, str]:
    """Units of all columns, by size where the header has none.

    No link is longer than 20 m, and most axes are at right angles. Raises RobotError: angles that may be in rad or deg;
    small limits or offsets of joints that turn beside angles in degrees, which may be either.
    """
    a, d, alpha, theta = ([_number(row, what) for row in rows] for what in ("a", "d", "alpha", "theta"))
    length = max(map(abs, a))
    if length <= LONGEST_LINK_M:  # of axes that are nearly parallel two d of hundreds of metres nearly cancel
        length = min(abs(sum(d)), max(map(abs, d)))
    angles, texts = [*map(abs, alpha + theta)], " ".join(row.get(k, "") for row in rows for k in ("alpha", "theta"))
    angle = "rad" if "pi" in texts.lower() or not any(angles) or _right(angles) else ""
    angle = "deg" if "°" in texts or max(angles) > LARGEST_ANGLE_RAD else angle
    lengths = dict.fromkeys(("a", "d"), "mm" if length > LONGEST_LINK_M else "m")
    units = lengths | dict.fromkeys(("alpha", "theta", "beta"), angle) | dict(stated)
    if not units["alpha"] or not units["theta"]:
        what, fix = f"the unit of angles of '{path}'", "write it into the header: alpha [deg], theta [deg]"
        raise RobotError.of(what, expected="rad or deg", got="numbers that may be either", fix=fix)
    turning = [row for row in rows if _kind(row) == "revolute"]
    for column, names in (("min", ("lower", "upper")), ("offset", ("offset",))):
        cells = [(row, name) for row in turning for name in names if "pi" not in row.get(name, "").lower()]
        sizes = [size for row, name in cells if isfinite(size := abs(_number(row, name))) and size]
        unit = next((stated[name] for name in names if name in stated), "")
        if sizes and not unit:
            unit = "deg" if max(sizes) > LARGEST_ANGLE_RAD else "rad"
            if unit == "rad" and units["theta"] == "deg" and not _right(sizes):
                got, fix = f"at most {max(sizes):g}, with angles in deg", f"write {column} [rad] or {column} [deg]"
                raise RobotError.of(f"the unit of `{column}` of '{path}'", expected="rad or deg", got=got, fix=fix)
        units |= dict.fromkeys(names, unit) if unit else {}
    return units


def _right(sizes: Sequence[float]) -> bool:
    """Whether one is a right angle, or two, in rad."""
    return any(abs(size - turn) < RIGHT_ANGLE_RAD for size in sizes for turn in (pi / 2, pi))


def _kind(row: Mapping[str, str]) -> str:
    """Kind of a joint; empty if its name is unknown."""
    slides = VALUE.search(re.sub(r"\s", "", row["d"].lower())) is not None
    return KINDS.get(row.get("kind", "").lower() or ("p" if slides else "r"), "")


def _row(row: Mapping[str, str], units: Mapping[str, str], what: str) -> DHRow:
    """The parameters of a joint."""
    kind = _kind(row)
    value: dict[str, Any] = {name: _number(row, name) for name in NUMBERS}
    wrong = [name for name in NUMBERS if not isfinite(value[name])] + ["kind"] * (not kind)
    wrong += ["unread"] * bool(row.get("unread"))  # of tables that `export` writes
    if wrong:
        expected, got = "a revolute or prismatic joint, numbers and multiples of pi", f"{wrong[0]} {row[wrong[0]]!r}"
        raise RobotError.of(what, expected=expected, got=shown(got), fix="correct the cell, or pass a URDF")
    variable = "d" if kind == "prismatic" else "theta"
    for name in NUMBERS:
        unit = units.get(name) or units[variable]
        if name in ("offset", "lower", "upper") and variable == "d" and unit in ("rad", "deg"):
            unit = units["d"]  # that of the joints that turn
        value[name] *= 1.0 if "pi" in row.get(name, "").lower() else UNITS[unit]
    value[variable] += value.pop("offset")
    value |= {name: end for name, end in (("lower", -inf), ("upper", inf)) if not row.get(name)}
    return DHRow(kind=kind, **value)


def _number(row: Mapping[str, str], what: str) -> float:
    """A cell in its own unit, a multiple of pi in rad, without the joint's own value; 0 where it is empty, or NaN."""
    text = re.sub(r"[\s°]", "", row.get(what, "").lower()).replace(",", ".")
    text = VALUE.sub("", "" if text == "-" else text)
    try:
        if (turns := TURNS.fullmatch(text)) is None:
            return float(text or 0)
        factor = f"{turns[1]}1" if turns[1] in ("", "+", "-") else turns[1]
        return float(factor) * pi / float(turns[2] or 1)
    except (ValueError, ZeroDivisionError):
        return nan
