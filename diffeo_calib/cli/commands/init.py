"""`diffeo-calib init`: propose the options of `fit` for a table and a URDF as a campaign file, with reasons."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from os.path import relpath
from pathlib import Path

from diffeo_calib.cli import proposals
from diffeo_calib.cli.console import say
from diffeo_calib.common.errors import InputError, few
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.csv.guess import (
    PAYLOADS,
    SESSIONS,
    Sheet,
    guess_column,
    guess_joints,
    guess_positions,
    guess_reading,
    guess_sheet,
    guess_sockets,
)
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.urdf import chains_in, load_urdf

CLEAR = 0.2
"""A reading is clear if its residual is below this share of every other one's."""
COLUMNS = ("joints", "position", "socket", "rotation", "std", "session", "payload")
"""Entries that name columns."""


@dataclass(frozen=True)
class Choice:
    """One entry of the campaign file: its value, and why."""

    name: str
    value: str | list[str]
    why: str

    def line(self) -> str:
        """As TOML."""
        values = self.value if isinstance(self.value, list) else [self.value]
        written = [_quoted(value) for value in values]
        text = f"[{', '.join(written)}]" if isinstance(self.value, list) else written[0]
        return f"{self.name} = {text}  # {self.why}" if self.name else f"# {self.why}"


def run(csv: Path, urdf: Path, output: Path, *, force: bool = False) -> None:
    """Propose a campaign, write it, and print it; a file that was edited is replaced with ``force`` alone."""
    sheet = guess_sheet(csv)
    choices = list(_choices(csv, urdf, output, sheet))
    unused = [name for name in sheet.header if name not in _used(choices)]
    lines = [
        "# Options of `diffeo-calib fit`, proposed by `diffeo-calib init`: check every line.",
        *(choice.line() for choice in choices),
        f"# columns that are not used: {few(unused, 20)}" if unused else "# all columns are used",
    ]
    content = ("\n".join(lines) + "\n").encode()
    if output.exists() and not force and output.read_bytes() != content:
        fix = "name another file by -o, or add --force to replace it"
        raise InputError.of(f"'{output}' exists and holds other options", expected="a new file", fix=fix)
    write_whole(output, content)
    for line in lines:
        say(line)
    say(f"campaign: {output}; check it, then run: diffeo-calib fit {output}")


def _choices(csv: Path, urdf: Path, output: Path, sheet: Sheet) -> Iterator[Choice]:
    folder = output.parent
    yield Choice("csv", relpath(csv, folder), "the table")
    yield Choice("robot", relpath(urdf, folder), "the URDF")
    base, tip, names, why = _chain(urdf, sheet)
    yield Choice("base", base, why)
    yield Choice("tip", tip, "a leaf below it; the markers are fixed to it or to a link before it")
    joints, how = names
    yield Choice("joints", ",".join(joints), how)
    sockets = guess_sockets(sheet.header) or []
    with_gaps = sheet.header if sockets else sheet.numbers  # rows in sockets have no positions
    markers = [triple for triple in guess_positions(with_gaps) if not set(triple) & set(joints)]
    others = [name for name in sheet.numbers if name not in joints]
    reading = None if markers or sockets else guess_reading(others)
    if not markers and not sockets and reading is None:
        expected = "three columns of numbers named x, y and z, alone or behind a separator, such as left_x"
        fix = "without a tracker: a ball in sockets has columns `place` and `socket`, which `init` knows; options for "
        fix += 'wires, gauges and cameras are in the README, "Without a tracker"'
        raise InputError.of(f"positions in '{csv}'", expected=expected, got=few(sheet.numbers, 20), fix=fix)
    if markers:
        yield Choice("position", [",".join(triple) for triple in markers], f"{len(markers)} marker(s), by their names")
    if sockets:
        yield Choice("socket", sockets, "by their names; a ball on the tool rested in this socket of a block there")
    session = None if sockets else guess_column([name for name in sheet.header if name not in joints], SESSIONS)
    yield from _more(reading, session, guess_column(others, PAYLOADS))
    yield Choice("sep", "tab" if sheet.sep == "\t" else sheet.sep, f"{len(sheet.numbers)} columns are numbers with it")
    yield Choice("decimal", sheet.decimal, "the same")
    chain = load_urdf(urdf, base, tip)
    seen = proposals.Source(csv, chain, joints, markers, TableFormat("mm", "deg"), sheet.numbers, tuple(sockets))
    if reading is not None:
        seen = replace(seen, reading=proposals.reading_columns(reading, session))
    units = list(_units(seen, sheet))
    yield from units
    found = {choice.name: str(choice.value) for choice in units}
    if reading is not None:
        yield Choice("", "", "beside readings no rotations and deviations were looked for")
    elif sockets:
        lines = proposals.distance_lines(csv, sheet, sockets[-1], found["length"])
        yield from (Choice("", "", line) for line in lines)
    else:
        table = TableFormat(found["length"], found["angle"], sheet.sep, sheet.decimal)
        source = replace(seen, table=table)
        for part in (proposals.rotation(source), proposals.deviations(source)):
            yield from (Choice(*entry) for entry in part)
    yield Choice("output", csv.with_suffix(".safetensors").name, "the model")
    if not sockets:
        yield Choice("report", csv.with_suffix(".html").name, "the report")


def _more(reading: tuple[str, str] | None, session: str | None, payload: str | None) -> Iterator[Choice]:
    """Columns of readings, set-ups and payloads, by their names."""
    if reading is not None:
        word, column = reading
        yield Choice("reading", f"{word}={column}", "by its name; `displacement` is a distance with an unknown zero")
    if session is not None:
        yield Choice("session", session, "by its name: the device, or its set-up, of every row")
    if payload is not None:
        yield Choice("payload", payload, "by its name: the known mass that the robot carried")


def _chain(urdf: Path, sheet: Sheet) -> tuple[str, str, tuple[list[str], str], str]:
    """First and last link of the longest chain whose joints the table has, and the columns of its joints."""
    chains = chains_in(urdf)
    for base, tip, joints in chains:
        found = guess_joints(sheet.numbers, joints) if joints else None
        if found is not None:
            return base, tip, found, f"root of the URDF; {len(joints)} joints to {tip}"
    expected = " or ".join(few(joints, 20) for _, _, joints in chains[:3]) or "a robot with joints"
    raise InputError.of(f"columns of the joints of '{urdf}'", expected=expected, got=few(sheet.numbers, 20))


def _units(source: proposals.Source, sheet: Sheet) -> Iterator[Choice]:
    """Units with which the nominal robot can explain the positions, or the sockets."""
    no_length = not source.markers and source.reading is None and all(source.robot.periodic)
    lengths = ("mm",) if no_length else ("m", "mm")
    residuals: dict[tuple[str, str], float] = {}
    for length, angle in product(lengths, ("rad", "deg")):
        residuals[length, angle] = source.residual(TableFormat(length, angle, sheet.sep, sheet.decimal))
    (length, angle), best = min(residuals.items(), key=lambda entry: entry[1])
    others = min(value for units, value in residuals.items() if units != (length, angle))
    found = source.words(best, others)
    if not best < proposals.LARGEST_RESIDUAL or best > CLEAR * others:
        got = "; ".join(f"{' and '.join(units)}: {source.size(value)}" for units, value in residuals.items())
        fix = (
            "write the file yourself; `init` tries one tip, and a table of markers on several needs `tip` and "
            "`position` once for each"
        )
        raise InputError.of(
            "units with which the robot explains the rows", expected="one clear reading", got=got, fix=fix
        )
    if no_length:
        yield Choice("length", length, "of the distances of sockets: the table holds no length")
    else:
        yield Choice("length", length, found)
    yield Choice("angle", angle, found if no_length else "the same")


def _used(choices: list[Choice]) -> set[str]:
    columns = [choice.value for choice in choices if choice.name in COLUMNS]
    columns += [str(choice.value).partition("=")[2] for choice in choices if choice.name == "reading"]
    texts = [text for value in columns for text in (value if isinstance(value, list) else [value])]
    return {name for text in texts for name in text.split(",")}


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
