"""`diffeo-calib init`: propose the options of `fit` for a table and a URDF as a campaign file, with reasons."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from math import inf
from os.path import relpath
from pathlib import Path

from diffeo_calib.cli import proposals
from diffeo_calib.cli.console import say
from diffeo_calib.cli.declarations import InitOptions
from diffeo_calib.cli.guesses import Sheet, guess_joints, guess_sheet, joints_without_column
from diffeo_calib.cli.options import CORNERS
from diffeo_calib.cli.proposals import Choice, Source
from diffeo_calib.common.errors import InputError, few
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.csv.images import CAMERA, IMAGE, PIXEL, POINT
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.urdf import chains_in, load_urdf

CLEAR_RATIO = 5.0
"""A reading is clear if every other one's residual is larger by this."""
COLUMNS = ("joints", "position", "socket", "rotation", "std", "session", "payload", "reading", "time", "temperature")
"""Entries that name columns."""


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
    base, tip, joints, why = _chain(urdf, sheet)
    rows = proposals.rows_in(csv, sheet, joints)
    tips = proposals.tips_of(rows.markers, [leaf for _, leaf, _ in chains_in(urdf)])
    chain = load_urdf(urdf, base, list(dict.fromkeys(tips)) or tip)
    seen = Source(csv, chain, joints, rows, TableFormat("mm", "deg", sheet.sep, sheet.decimal), sheet.numbers, tips)
    seen, names = proposals.joint_columns(seen, guess_joints(sheet.numbers, chain.joint_names))
    seen = proposals.measured(seen)
    units = list(_units(seen, sheet))
    found = {choice.name: str(choice.value) for choice in units}
    seen = replace(seen, table=replace(seen.table, length=found["length"], angle=found["angle"]))
    yield Choice("base", base, why)
    leaf = "a leaf below it; the markers are fixed to it or to a link before it"
    several = Choice("tip", list(seen.tips), "leaves after which the columns are named")
    yield several if tips else Choice("tip", tip, leaf)
    yield from names
    yield from seen.rows.entries()
    yield Choice("sep", "tab" if sheet.sep == "\t" else sheet.sep, f"{len(sheet.numbers)} columns are numbers with it")
    yield Choice("decimal", sheet.decimal, "the same")
    yield from units
    others = proposals.other_units(seen, seen.table.length, seen.table.angle)
    if others:
        yield Choice("", "", f"{few(others)}: the names say another unit than the robot finds in the numbers: check it")
    if "rotation" not in found:
        yield from proposals.beside(seen, sheet)
    yield Choice("output", csv.with_suffix(".safetensors").name, "the model")
    yield Choice("report", csv.with_suffix(".html").name, "the report")


def _chain(urdf: Path, sheet: Sheet) -> tuple[str, str, list[str], str]:
    """First and last link of the longest chain whose joints the table has, and the columns of its joints."""
    chains = chains_in(urdf)
    for base, tip, joints in chains:
        found = guess_joints(sheet.numbers, joints) if joints else []
        if found:
            return base, tip, found[0].names, f"root of the URDF; {len(joints)} joints to {tip}"
    expected = " or ".join(few(joints, 20) for _, _, joints in chains[:3]) or "a robot with joints"
    missing = joints_without_column(sheet.numbers, chains[0][2])
    fix = f"no column is named after {few(missing, 20)}: name the columns as the joints, or q1, q2, ... in their order"
    raise InputError.of(f"columns of the joints of '{urdf}'", expected=expected, got=few(sheet.numbers, 20), fix=fix)


def _units(source: Source, sheet: Sheet) -> Iterator[Choice]:
    """Units with which the nominal robot can explain the positions, or the sockets."""
    no_length = source.rows.without_length and all(source.robot.periodic)
    marks = sheet.sep, sheet.decimal
    formats = {
        key: TableFormat(*key[:2], *marks, camera_on_tool=bool(key[2]))
        for key in product(
            ("mm",) if no_length else ("m", "mm"),
            ("rad", "deg"),
            ("", "camera on the tool") if source.rows.of_boards else ("",),
        )
    }
    (best, (length, angle, camera)), *others = found = proposals.residuals(source, formats)
    named = [entry for entry in found if not proposals.other_units(source, *entry[1][:2])]
    open_ones = not proposals.is_clear(found, CLEAR_RATIO) and len(named) < len(found)
    if open_ones and named and named[0][0] < CLEAR_RATIO * best:
        (best, (length, angle, camera)), *others = found = named
    if not proposals.is_clear(found, CLEAR_RATIO):
        poses = list(proposals.rotation(source, camera=True))
        if best == inf and not poses:
            source.read_residual(TableFormat(length, angle, *marks))  # says why
        if not poses:
            got = "; ".join(f"{' and '.join(filter(None, units))}: {source.size(value)}" for value, units in found)
            fix = "check the table's joints against the URDF, or write the file yourself; of a robot with several tips "
            fix += "the columns of each are to be named after it, such as left_x"
            what = "units with which the robot explains the rows"
            raise InputError.of(what, expected="one clear reading", got=got, fix=fix)
        yield from poses
        return
    why = source.words(best, others[0][0] if others else inf)
    why += ", by the names of the columns: the numbers leave it open" * open_ones
    yield Choice("length", length, "of lengths that you add: the table holds none" if no_length else why)
    yield Choice("angle", angle, why if no_length else "the same")
    if camera:
        yield Choice("camera-on-tool", True, "the same; else the board is on the tool")


def _used(choices: list[Choice]) -> set[str]:
    columns = [choice.value for choice in choices if choice.name in COLUMNS]
    texts = [str(text) for value in columns for text in (value if isinstance(value, list) else [value])]
    corners = {IMAGE, *POINT, *PIXEL, CAMERA} if any(text.startswith(CORNERS) for text in texts) else set[str]()
    return corners | {name for text in texts for name in text.rpartition("=")[2].split(",")}
