"""`diffeo-calib init`: propose the options of `fit` for a table and a URDF as a campaign file, with reasons."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from math import inf
from os.path import relpath
from pathlib import Path

from diffeo_calib.cli import proposals
from diffeo_calib.cli.console import say
from diffeo_calib.cli.declarations import InitOptions
from diffeo_calib.cli.guesses import Sheet, guess_joints, guess_sheet
from diffeo_calib.cli.options import CORNERS
from diffeo_calib.common.errors import InputError, few
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.csv.images import CAMERA, IMAGE, PIXEL, POINT
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.urdf import chains_in, load_urdf

CLEAR_RESIDUAL_RATIO = 0.2
"""A reading is clear if its residual is below this share of every other one's."""
COLUMNS = ("joints", "position", "socket", "rotation", "std", "session", "payload", "reading", "time", "temperature")
"""Entries that name columns."""


@dataclass(frozen=True)
class Choice:
    """One entry of the campaign file: its value, and why."""

    name: str
    value: str | list[str] | bool
    why: str

    def line(self) -> str:
        """As TOML."""
        values = self.value if isinstance(self.value, list) else [self.value]
        written = [json.dumps(value, ensure_ascii=False) for value in values]
        text = f"[{', '.join(written)}]" if isinstance(self.value, list) else written[0]
        return f"{self.name} = {text}  # {self.why}" if self.name else f"# {self.why}"


def run(given: InitOptions) -> None:
    """Propose a campaign, write it, and print it; a file that was edited is replaced with --force alone."""
    csv, output = given.csv, given.output
    sheet = guess_sheet(csv)
    choices = list(_choices(csv, given.urdf, output, sheet))
    unused = [name for name in sheet.header if name not in _used(choices)]
    lines = [
        "# Options of `diffeo-calib fit`, proposed by `diffeo-calib init`: check every line.",
        *(choice.line() for choice in choices),
        f"# columns that are not used: {few(unused, 20)}" if unused else "# all columns are used",
    ]
    content = ("\n".join(lines) + "\n").encode()
    if output.exists() and not given.force and output.read_bytes() != content:
        fix = "name another file by -o, or add --force to replace it"
        raise InputError.of(f"'{output}' exists and holds other options", expected="a new file", fix=fix)
    write_whole(output, content)
    say(*lines)
    fill_in = ", fill in the lines that say `uncomment`" * any("uncomment" in line for line in lines)
    say(f"campaign: {output}; check it{fill_in}, then run: diffeo-calib fit {output}")


def _choices(csv: Path, urdf: Path, output: Path, sheet: Sheet) -> Iterator[Choice]:
    folder = output.parent
    yield Choice("csv", relpath(csv, folder), "the table")
    yield Choice("robot", relpath(urdf, folder), "the URDF")
    base, tip, (joints, how), why = _chain(urdf, sheet)
    rows = proposals.rows_in(csv, sheet, joints)
    tips = proposals.tips_of(rows.markers, [leaf for _, leaf, _ in chains_in(urdf)])
    chain = load_urdf(urdf, base, list(dict.fromkeys(tips)) or tip)
    if tips:
        joints, how = guess_joints(sheet.numbers, chain.joint_names) or (joints, how)
    yield Choice("base", base, why)
    leaf = "a leaf below it; the markers are fixed to it or to a link before it"
    yield Choice("tip", tips, "leaves after which the columns are named") if tips else Choice("tip", tip, leaf)
    yield Choice("joints", ",".join(joints), how)
    yield from (Choice(*entry) for entry in rows.entries())
    yield Choice("sep", "tab" if sheet.sep == "\t" else sheet.sep, f"{len(sheet.numbers)} columns are numbers with it")
    yield Choice("decimal", sheet.decimal, "the same")
    seen = proposals.Source(csv, chain, joints, rows, TableFormat("mm", "deg"), sheet.numbers, tips)
    units = list(_units(seen, sheet))
    yield from units
    found = {choice.name: str(choice.value) for choice in units}
    table = TableFormat(found["length"], found["angle"], sheet.sep, sheet.decimal)
    beside: Iterable[proposals.Entry] = (
        () if "rotation" in found else proposals.beside(replace(seen, table=table), sheet)
    )
    yield from (Choice(*entry) for entry in beside)
    yield Choice("output", csv.with_suffix(".safetensors").name, "the model")
    yield Choice("report", csv.with_suffix(".html").name, "the report")


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
    no_length = source.rows.without_length and all(source.robot.periodic)
    lengths = ("mm",) if no_length else ("m", "mm")
    residuals: dict[tuple[str, ...], float] = {}
    cameras = ("", "camera on the tool") if source.rows.of_boards else ("",)
    for length, angle, camera in product(lengths, ("rad", "deg"), cameras):
        table = TableFormat(length, angle, sheet.sep, sheet.decimal, camera_on_tool=bool(camera))
        residuals[length, angle, camera] = source.residual(table)
    (length, angle, camera), best = min(residuals.items(), key=lambda entry: entry[1])
    others = min(value for units, value in residuals.items() if units != (length, angle, camera))
    found = source.words(best, others)
    if not best < proposals.LARGEST_RESIDUAL or best > CLEAR_RESIDUAL_RATIO * others:
        seen = [Choice(*entry) for entry in proposals.camera(source, sheet)]
        if seen:
            yield from seen
            return
        if best == inf:
            source.read_residual(TableFormat(length, angle, sheet.sep, sheet.decimal))  # says why
        got = "; ".join(
            f"{' and '.join(filter(None, units))}: {source.size(value)}" for units, value in residuals.items()
        )
        fix = (
            "check the table's joints against the URDF, or write the file yourself; of a robot with several tips the "
            "columns of each are to be named after it, such as left_x"
        )
        raise InputError.of(
            "units with which the robot explains the rows", expected="one clear reading", got=got, fix=fix
        )
    if no_length:
        yield Choice("length", length, "of lengths that you add: the table holds none")
    else:
        yield Choice("length", length, found)
    yield Choice("angle", angle, found if no_length else "the same")
    if camera:
        yield Choice("camera-on-tool", True, "the same; else the board is on the tool")


def _used(choices: list[Choice]) -> set[str]:
    columns = [choice.value for choice in choices if choice.name in COLUMNS]
    texts = [str(text) for value in columns for text in (value if isinstance(value, list) else [value])]
    corners = {IMAGE, *POINT, *PIXEL, CAMERA} if any(text.startswith(CORNERS) for text in texts) else set[str]()
    return corners | {name for text in texts for name in text.rpartition("=")[2].split(",")}
