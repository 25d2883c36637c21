"""`diffeo-calib campaign`: rows judged while they are measured."""

from __future__ import annotations

import csv
import io
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any

import typer

from diffeo_calib.campaign.campaign import Campaign
from diffeo_calib.campaign.journal import GrowingTable, Journal, digest
from diffeo_calib.campaign.verdicts import Verdict
from diffeo_calib.cli.commands.acceptance import EXIT_ABOVE, parsed_limit
from diffeo_calib.cli.commands.fit import RobotFile
from diffeo_calib.cli.console import say
from diffeo_calib.cli.options import LiveOptions
from diffeo_calib.cli.record import record
from diffeo_calib.cli.tables import MeasuredTable, joint_columns
from diffeo_calib.common.errors import DiffeoCalibError, InputError, few
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.csv.columns import Columns
from diffeo_calib.measurements.csv.files import read_joints
from diffeo_calib.reports.live import Page, served

JOURNAL = ".journal"
"""Suffix of the journal beside a table."""
LOOK_SECONDS = 0.1
SHOWN_ROWS, SHOWN_POSES = 8, 500
"""On the page: the last rows, and poses."""
KEPT = ("fits", "accepted", "error", "expected", "cause", "decided")
"""What a journal keeps of a verdict."""


def run(links: RobotFile, source: MeasuredTable, given: LiveOptions) -> None:
    """Follow a table until the target is reached or the rows end."""
    limit = parsed_limit(given.target, "--target")
    if limit is not None and limit.unit != "m":
        raise InputError.of(f"--target {given.target}", expected="a length, such as 0.15mm")
    robot = links.read()
    names = joint_columns(source.joints, robot)
    candidates = given.candidates and read_joints(given.candidates, names, source.table, kinds=robot.kinds)
    goal = None if limit is None else limit.value
    with ExitStack() as stack:
        journal = stack.enter_context(Journal(source.csv.with_name(source.csv.name + JOURNAL)))
        live = Live(Campaign(robot, candidates=candidates, background=not given.once), source, links.tips, journal)
        live.resume()
        page = None if given.page is None else stack.enter_context(served(given.page))
        if page is not None:
            say(f"the campaign is shown at {page.url}")
        _follow(live, given, goal, page)
    known, accepted = live.campaign.expected_error, live.campaign.accepted
    record.add(rows=len(live.campaign), accepted=len(accepted), expected_error_m=known)
    if given.accepted is not None:
        write_whole(given.accepted, live.table.header + b"".join(live.lines_of(accepted)))
    say(f"{len(accepted)} of {len(live.campaign)} rows accepted" + _expected(known))
    if goal is not None and not live.reached(goal):
        raise typer.Exit(EXIT_ABOVE)


def _follow(live: Live, given: LiveOptions, goal: float | None, page: Page | None) -> None:
    """Judge rows as they come, until the goal is reached or there are no more."""
    arriving = _arriving(live, given)
    for line, last in arriving:
        if line:
            live.add(line)
        decided = page is not None and live.decide(page.decisions)
        if line and live.reached(goal):
            return
        if last and (line or decided):
            say(f"  {live.outlook(given.next, goal)}")
            if page is not None:
                page.publish(state_of(live.campaign, live.outlook(1, goal), goal))
    live.campaign.wait()


def state_of(campaign: Campaign, outlook: str, goal: float | None) -> dict[str, Any]:
    """What the page shows: lengths in mm, places in m in the robot's base."""
    robot, count, known = campaign.robot, len(campaign), campaign.expected_error
    found = campaign.next(1, goal)
    seen = [(one.row + 1, 1e3 * one.expected_error) for one in campaign.verdicts if one.expected_error is not None]
    steps = [] if found is None else [(count + step, 1e3 * value) for step, value in enumerate(found.expected)]
    next_q = campaign.candidates[:0] if found is None else found.q
    verdicts = [
        {"row": one.row, "text": str(one), "accepted": one.accepted, "fits": one.fits}
        for one in campaign.verdicts[: -SHOWN_ROWS - 1 : -1]
    ]
    frames = robot.joint_frames(next_q)[:, :, :3, 3] if len(next_q) else next_q.new_zeros(1, 0, 3)
    tips = robot.tip_poses(next_q).flatten(1, -3)[:, :, :3, 3] if len(next_q) else next_q.new_zeros(0, 1, 3)
    done = robot.tip_poses(campaign.table.q[-SHOWN_POSES:]).flatten(1, -3)[:, 0, :3, 3]
    return {
        "error": None if known is None else 1e3 * known,
        "state": f"{len(campaign.accepted)} of {count} rows accepted; {outlook.partition('; next')[0]}",
        "pose": outlook.partition("; ")[2],
        "goal": None if goal is None else 1e3 * goal,
        "curve": seen[:: max(1, len(seen) // SHOWN_POSES)],
        "forecast": steps,
        "verdicts": verdicts,
        "done": done.tolist(),
        "next": tips[:, 0].tolist(),
        "links": [*frames[0].tolist(), *tips[:, 0].tolist()],
    }


@dataclass
class Live:
    """A campaign, the table that it follows and its journal.

    Args:
        tips: of the markers. table: the file. owner: the line of each row. lines: all that were judged.
        waiting: those that were there at the start and were not. said: whether each row was accepted, by the journal.
    """

    campaign: Campaign
    source: MeasuredTable
    tips: Sequence[str]
    journal: Journal
    table: GrowingTable = field(init=False)
    owner: list[int] = field(default_factory=list)
    lines: list[bytes] = field(default_factory=list)
    waiting: list[bytes] = field(default_factory=list)
    said: list[bool] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.table = GrowingTable(self.source.csv)

    def resume(self) -> None:
        """Go on after the lines that the journal knows."""
        known = [one for one in self.journal.entries if "line" in one]
        lines = self.table.new_lines()
        for number, entry in enumerate(known):
            if number >= len(lines) or digest(lines[number]) != entry["sha"]:
                fix = f"undo the change, or remove '{self.journal.path.name}' to judge all rows anew"
                raise InputError.of(f"line {number + 2} of {self.source.csv} was changed after it was judged", fix=fix)
        self.lines = lines[: len(known)]
        verdicts = [one for entry in known for one in entry.get("rows", [])]
        for entry in self.journal.entries:
            if "row" in entry:
                verdicts[entry["row"]] |= {name: entry[name] for name in KEPT if name in entry}
        readable = [line for line, entry in zip(lines, known, strict=False) if "rows" in entry]
        self.owner = [number for number, entry in enumerate(known) for _ in entry.get("rows", [])]
        if verdicts:
            self.campaign.resume(self._read(readable), [Verdict(row, **one) for row, one in enumerate(verdicts)])
            say(f"going on after {len(known)} lines{_expected(self.campaign.expected_error)}")
        self.said = [one.accepted for one in self.campaign.verdicts]
        self.waiting = lines[len(known) :]

    def new_lines(self) -> list[bytes]:
        """Lines that have not been judged."""
        found, self.waiting = [*self.waiting, *self.table.new_lines()], []
        return found

    def add(self, line: bytes) -> None:
        """Judge a line, bring that to the disk, and say it."""
        number, verdicts = len(self.lines), list[Verdict]()
        entry: dict[str, Any] = {"line": number + 2, "sha": digest(line)}
        try:
            verdicts = self.campaign.add(self._read([line]))
            entry["rows"] = [{name: getattr(one, name) for name in KEPT} for one in verdicts]
        except DiffeoCalibError as error:
            entry["unreadable"] = str(error)
        self.lines.append(line)
        self.owner += [number] * len(verdicts)
        self.journal.add([entry, *self._revised()])
        say("\n".join(map(str, verdicts)) if verdicts else f"line {number + 2} left out: {entry['unreadable']}")

    def reached(self, goal: float | None) -> bool:
        """Whether the expected error is small enough."""
        known = self.campaign.expected_error
        return goal is not None and known is not None and known <= goal

    def lines_of(self, rows: Sequence[int]) -> list[bytes]:
        """The lines of some rows."""
        return [self.lines[number] for number in dict.fromkeys(self.owner[row] for row in rows)]

    def decide(self, decisions: SimpleQueue[tuple[int, bool]]) -> bool:
        """What the user decided about rows since the last time; whether there was anything."""
        before = len(self.said), decisions.empty()
        while not decisions.empty():
            row, accepted = decisions.get()
            if row < before[0]:
                (self.campaign.accept if accepted else self.campaign.reject)(row)
        self.journal.add(self._revised())
        return not before[1]

    def _revised(self) -> Iterator[dict[str, Any]]:
        """Entries of rows that are accepted now and were not, or the other way round."""
        for row, one in enumerate(self.campaign.verdicts):
            if row < len(self.said) and self.said[row] != one.accepted:
                yield {"row": row} | {name: getattr(one, name) for name in KEPT}
        self.said = [one.accepted for one in self.campaign.verdicts]

    def outlook(self, count: int, goal: float | None) -> str:
        """The expected error, how many more rows the goal takes, and the next poses in the unit of the table."""
        known, found = self.campaign.expected_error, self.campaign.next(count, goal)
        if known is None or found is None:
            return "no model yet"
        needed = "" if goal is None else f", {'?' if found.needed is None else found.needed} more rows to the target"
        robot = self.campaign.robot
        columns = Columns.of(self.source.table.joints_only(), robot.joint_names, robot.kinds, [])
        poses = columns.joints_from_si(found.q).tolist()
        return f"{1e3 * known:.4g} mm expected{needed}" + "".join(
            f"; next: {', '.join(f'{value:.6g}' for value in pose)}" for pose in poses
        )

    def _read(self, lines: Sequence[bytes]) -> Any:
        """Lines as a table, in their order."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / self.source.csv.name
            path.write_bytes(self.table.header + b"".join(lines))
            data = replace(self.source, csv=path).read(self.campaign.robot, self.tips)
        return data.rows(data.lines.argsort(stable=True))


def _arriving(live: Live, given: LiveOptions) -> Iterator[tuple[bytes, bool]]:
    """New lines as they come, and whether each is the last for now; empty ones while there are none."""
    texts: SimpleQueue[str | None] = SimpleQueue()
    if given.stdin:
        Thread(target=_read_into, args=(texts,), daemon=True).start()
    while True:
        lines = live.new_lines()
        yield from ((line, number == len(lines)) for number, line in enumerate(lines, 1))
        if given.once and not lines:
            return
        if not lines and not given.stdin:
            time.sleep(LOOK_SECONDS)
        if given.stdin:
            try:
                text = texts.get(timeout=LOOK_SECONDS)
            except Empty:
                text = ""
            if text is None:
                return
            try:
                if text:
                    append_row(live.source.csv, text, live.source.table.sep, live.source.table.decimal)
            except InputError as error:
                say(f"left out: {error}")
        yield b"", True


def _read_into(texts: SimpleQueue[str | None]) -> None:
    """Lines of standard input, and None at its end."""
    for text in sys.stdin:
        texts.put(text)
    texts.put(None)


def append_row(path: Path, text: str, sep: str, decimal: str) -> None:
    """Append a JSON object to a table, whole: its keys are the columns, those of the first object make the header.

    Raises:
        InputError: a torn line, no object, or columns that the table does not have.
    """
    try:
        row = json.loads(text) if text.endswith("\n") else None
    except ValueError:
        row = None
    if not isinstance(row, dict) or not row:
        raise InputError.of("a row", expected="one JSON object a line", got=text.strip()[:60])
    with path.open("a+b") as file:
        file.seek(0)
        content = file.read()
        file.truncate(content.rfind(b"\n") + 1)  # a line that was torn
        header = next(csv.reader(io.StringIO(content.decode().partition("\n")[0]), delimiter=sep), [])
        written = io.StringIO()
        writer = csv.writer(written, delimiter=sep, lineterminator="\n")
        if not header:
            writer.writerow(header := list(row))
        unknown = [name for name in row if name not in header]
        if unknown:
            raise InputError.of(f"columns {few(unknown)} of a row", expected=f"those of {path.name}: {few(header)}")
        cells = [row.get(name, "") for name in header]
        writer.writerow([repr(cell).replace(".", decimal) if isinstance(cell, float) else cell for cell in cells])
        file.write(written.getvalue().encode())
        file.flush()
        os.fsync(file.fileno())


def _expected(known: float | None) -> str:
    return "" if known is None else f", {1e3 * known:.4g} mm expected"
