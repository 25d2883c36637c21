"""`diffeo-calib init`: propose the options of `fit` for a table and a URDF as a campaign file, with reasons."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from math import inf
from os.path import relpath
from pathlib import Path
from typing import Any

from diffeo_calib.cli import proposals
from diffeo_calib.cli.console import say
from diffeo_calib.cli.declarations import InitOptions
from diffeo_calib.cli.guesses import Sheet, guess_joints, guess_sheet
from diffeo_calib.cli.options import CORNERS
from diffeo_calib.cli.proposals import Choice, Source
from diffeo_calib.common.errors import InputError, few
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.csv.images import CAMERA, IMAGE, PIXEL, POINT
from diffeo_calib.measurements.table_format import UNITS_PER_METRE, TableFormat
from diffeo_calib.robots.urdf import chains_in, load_urdf

CLEAR_RATIO = 5.0
"""A reading is clear if every other one's residual is larger by this."""
DOUBTFUL = 0.01
"""Share of what the rows vary, left by the best units, above which other meanings of the joints are sought."""
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
    base, tip, (joints, how), why = _chain(urdf, sheet)
    rows = proposals.rows_in(csv, sheet, joints)
    tips = proposals.tips_of(rows.markers, [leaf for _, leaf, _ in chains_in(urdf)])
    chain = load_urdf(urdf, base, list(dict.fromkeys(tips)) or tip)
    if tips:
        joints, how = guess_joints(sheet.numbers, chain.joint_names) or (joints, how)
    yield Choice("base", base, why)
    leaf = "a leaf below it; the markers are fixed to it or to a link before it"
    yield Choice("tip", tips, "leaves after which the columns are named") if tips else Choice("tip", tip, leaf)
    seen = Source(csv, chain, joints, rows, TableFormat("mm", "deg", sheet.sep, sheet.decimal), sheet.numbers, tips)
    units = list(_units(seen))
    meant = [choice for choice in units if choice.name == "joints"]
    yield from meant or [Choice("joints", ",".join(joints), how)]
    yield from rows.entries()
    yield Choice("sep", "tab" if sheet.sep == "\t" else sheet.sep, f"{len(sheet.numbers)} columns are numbers with it")
    yield Choice("decimal", sheet.decimal, "the same")
    yield from (choice for choice in units if choice not in meant)
    found = {choice.name: str(choice.value) for choice in units}
    table = replace(seen.table, length=found["length"], angle=found["angle"], joint_length=found.get("joint-length"))
    if "rotation" not in found:
        joints = found["joints"].split(",") if meant else joints
        yield from proposals.beside(replace(seen, table=table, joints=joints), sheet)
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


def _units(source: Source) -> Iterator[Choice]:
    """Units, and a meaning of the joints' columns, with which the nominal robot can explain the rows."""
    no_length, boards = source.rows.without_length and all(source.robot.periodic), source.rows.of_boards
    lengths = ["mm"] if no_length else list(UNITS_PER_METRE)
    found = _left(source, lengths, [None], boards=boards)
    if not all(source.robot.periodic) and not proposals.is_clear(found, CLEAR_RATIO):
        others = _left(source, lengths, lengths, boards=boards)
        found = others if proposals.is_clear(others, CLEAR_RATIO) else found
    (best, (length, angle, slides, camera)), *others = found
    clear = proposals.is_clear(found, CLEAR_RATIO)
    poses = [] if clear else list(proposals.camera(source))
    if best == inf and not poses:
        source.read_residual(replace(source.table, length=length, angle=angle))  # says why
    likely = list(dict.fromkeys(key[0] for _, key in found))[:2]
    meant = [] if poses or best < DOUBTFUL or not any(source.robot.periodic) else list(source.conventions(best, likely))
    if not clear and not poses and not meant:
        got = "; ".join(f"{' and '.join(filter(None, units))}: {100 * value:.3g} %" for value, units in found)
        fix = (
            "no signs, zeros, coupling or units of the joints do either: check the table's joints against the URDF, or "
        )
        fix += (
            "write the file yourself; of a robot with several tips the columns of each are to be named after it, such "
        )
        fix += "as left_x"
        what = "units with which the robot explains what the rows vary"
        raise InputError.of(what, expected="one clear reading", got=f"left unexplained {got}", fix=fix)
    if poses or meant:
        yield from poses or meant
        return
    why = source.words(best, others[0][0])
    yield Choice("length", length, "of lengths that you add: the table holds none" if no_length else why)
    yield Choice("angle", angle, why if no_length else "the same")
    if slides:
        yield Choice("joint-length", slides, "the same: the slides are in another unit")
    if camera:
        yield Choice("camera-on-tool", True, "the same; else the board is on the tool")


def _left(source: Source, lengths: list[str], slides: list[Any], *, boards: bool) -> list[tuple[float, Any]]:
    """Share of the rows that is left with units of length and angle, of slides, and with the camera on the tool."""
    formats = {
        key: replace(source.table, length=key[0], angle=key[1], joint_length=key[2], camera_on_tool=bool(key[3]))
        for key in product(lengths, ("rad", "deg"), slides, ("", "camera on the tool") if boards else ("",))
        if key[2] != key[0]
    }
    return proposals.residuals(source, formats)


def _used(choices: list[Choice]) -> set[str]:
    columns = [choice.value for choice in choices if choice.name in COLUMNS]
    texts = [str(text) for value in columns for text in (value if isinstance(value, list) else [value])]
    corners = {IMAGE, *POINT, *PIXEL, CAMERA} if any(text.startswith(CORNERS) for text in texts) else set[str]()
    names = (name for text in texts for name in text.rpartition("=")[2].split(","))
    return corners | {name for each in names for name in re.findall(r"\{([^{}]+)\}", each) or [each]}
