"""`diffeo-calib campaign`: rows judged while they are measured: the table, its journal, and what is answered."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from itertools import chain
from queue import Empty
from threading import Thread
from typing import Any

import typer

from diffeo_calib.campaign.campaign import TOGETHER, Campaign, Next
from diffeo_calib.campaign.feeds import DECISIONS, ID, Entry, Inbox, as_line, check_cells, read_lines
from diffeo_calib.campaign.journal import BEGUN, KEPT, GrowingTable, Journal, digest
from diffeo_calib.campaign.verdicts import Verdict
from diffeo_calib.cli.console import EXIT_INTERRUPTED, err, interrupts, plain, record, say
from diffeo_calib.cli.declarations import CampaignOptions
from diffeo_calib.cli.models import EXIT_ABOVE, parsed_length, robot_of
from diffeo_calib.cli.tables import MeasuredTable, measured_table, of_robot
from diffeo_calib.common.errors import DiffeoCalibError, InputError, few
from diffeo_calib.common.files import write_whole
from diffeo_calib.measurements.csv.columns import Columns, PoseColumns
from diffeo_calib.measurements.csv.files import read_joints
from diffeo_calib.measurements.csv.joined import HeldFile
from diffeo_calib.measurements.csv.sensors import columns_of
from diffeo_calib.measurements.table_format import ZERO
from diffeo_calib.reports.live import Page, served, state_of

JOURNAL = ".journal"
LOOK_SECONDS = 0.1
LONGEST = 200  # characters of an option in a journal; of longer ones it holds a hash


@dataclass
class Live:
    """A campaign, the table that it follows and its journal."""

    campaign: Campaign
    source: MeasuredTable
    tips: Sequence[str]  # of the markers
    journal: Journal
    given: CampaignOptions
    table: GrowingTable = field(init=False)  # the file
    columns: Columns = field(init=False)  # those of its joints
    lines: list[bytes] = field(default_factory=list)  # all that were judged
    waiting: list[bytes] = field(default_factory=list)  # those that were read and were not
    said: list[tuple[bool, bool]] = field(default_factory=list)  # whether each row is accepted, and to be repeated
    ids: dict[str, int] = field(default_factory=dict)  # number of the line of each id
    unreadable: dict[int, str] = field(default_factory=dict)  # lines that are no rows, and why
    revised: list[int] = field(default_factory=list)  # rows that the last line changed
    late: list[int] = field(default_factory=list)  # rows that a new model changed, not told yet
    _found: tuple[object, Next | None] | None = None

    def __post_init__(self) -> None:
        self.table = GrowingTable(self.source.csv, self.source.table.sep, self.source.table.decimal)
        self.columns = Columns.of(of_robot(self.source.table, self.campaign.robot).joints_only())

    def say(self, text: str, entry: Entry) -> None:
        """Print a text, or an entry as a line of JSON."""
        if self.given.stdin:
            sys.stdout.write(as_line(entry).decode())
            sys.stdout.flush()
        elif text:
            say(text)

    def resume(self) -> None:
        """Go on after the lines that the journal knows."""
        entries = [stored for stored in self.journal.entries if "line" in stored]
        lines = self.table.new_lines()
        places = [name for name in self.missing if name in self.columns.joints.columns and name.isdecimal()]
        if self.table.header and places:  # columns are named by their places, and the first line is a row
            what = f"{self.source.csv} has no column {few(places)}: a table that grows needs a header line"
            got = f"the first line {few(sorted(self.table.cells(self.table.header)))}"
            raise InputError.of(what, got=got, fix="name the columns in its first line")
        for number, entry in enumerate(entries):
            if number >= len(lines) or digest(lines[number]) != entry["sha"]:
                fix = f"undo the change, or remove '{self.journal.path.name}' to judge all rows anew"
                raise InputError.of(f"line {number + 2} of {self.source.csv} was changed after it was judged", fix=fix)
        now = self._begun()
        begun = next((stored[BEGUN] for stored in self.journal.entries if BEGUN in stored), now)
        if names := [name for name in begun | now if begun.get(name) != now.get(name)]:
            then, got = (", ".join(f"{name} {each.get(name, 'none')}" for name in names) for each in (begun, now))
            fix = f"go on as it was begun, or remove '{self.journal.path.name}' to judge all rows anew"
            what = f"{self.source.csv} was judged with another {' and '.join(names)} than it is read with now"
            raise InputError.of(what, expected=then, got=got, fix=fix)
        for line in lines[: len(entries)]:
            self._keep(line)
        self.unreadable = {n: entry["unreadable"] for n, entry in enumerate(entries) if "unreadable" in entry}
        verdicts = [kept for entry in entries for kept in entry.get("rows", [])]
        for entry in self.journal.entries:
            if "row" in entry:
                verdicts[entry["row"]] |= {name: entry[name] for name in KEPT if name in entry}
        readable = [line if "rows" in entry else b"\n" for line, entry in zip(lines, entries, strict=False)]
        if verdicts:
            if len(table := self._read(readable)) != len(verdicts):
                raise self.journal.damaged(f"{len(verdicts)} verdicts of {len(table)} rows")
            self.campaign.resume(table, [Verdict(row, **kept) for row, kept in enumerate(verdicts)])
            self.say(f"going on after {len(entries)} lines{expected(self.campaign)}", self.state())
        self.said = [(verdict.accepted, verdict.again) for verdict in self.campaign.verdicts]
        self.waiting = lines[len(entries) :]

    @property
    def missing(self) -> list[str]:
        """Columns that the header does not name."""
        wanted = columns_of(of_robot(self.source.table, self.campaign.robot))
        needed = [*wanted.names, *(name for name, needed in wanted.texts.items() if needed)]
        named = {ZERO, *(cell.strip() for cell in self.table.cells(self.table.header))}
        return [name for name in needed if name not in named]

    def _begun(self) -> dict[str, str]:
        """What rows are read and judged with; of long texts their hashes."""
        robot, source = self.campaign.robot, self.source
        parts = robot.place_offsets, robot.axes, robot.coupling, robot.coupling_offset
        numbers = [(part.round(decimals=9) + 0.0).tolist() for part in parts]  # without -0.0
        setup = {"robot": (robot.revolute.tolist(), robot.before, numbers), "tip": self.tips}
        setup |= vars(source.table) | {"header": self.table.header.decode("latin-1").strip()}
        setup["position"] = [",".join(triple) for triple in source.table.position or ()]
        setup["joints"] = self.columns.table.joints
        texts = {name: str(value) for name, value in setup.items() if value}
        return {name: text if len(text) < LONGEST else digest(text.encode()) for name, text in texts.items()}

    def new_lines(self) -> list[bytes]:
        """Lines that have not been judged."""
        lines, self.waiting = [*self.waiting, *self.table.new_lines()], []
        return lines

    def judge(self, lines: Sequence[bytes]) -> None:
        """Judge lines, and say what became of them; after the last what comes next."""
        for start in range(0, len(lines), TOGETHER):
            part, left = lines[start : start + TOGETHER], max(0, len(lines) - start - TOGETHER)
            first = len(self.lines)
            self._add(part, left)
            for number in range(first, len(self.lines)):
                more = left or number + 1 < len(self.lines) or self.campaign.reached
                self._say(self.answer(number) | ({} if more else self.state()))
            if self.campaign.reached:
                self.waiting = [*lines[start + TOGETHER :]]
                return

    def poll(self) -> bool:
        """Say what a model that was made in the background changes; whether there was one."""
        made = self.campaign.poll()
        if made:
            self._changed()
        return made

    def end(self) -> None:
        """Wait for models that are made in the background, and say what they change."""
        if self.campaign.wait():
            self._changed()

    def _changed(self) -> None:
        self.journal.add(self._revised())
        self.late += self.revised
        if not self.given.stdin:  # those who send rows get one answer for each
            changed = "\n".join(str(self.campaign.verdicts[row]) for row in self.revised)
            self._say(({"text": changed} if changed else {}) | self.state())

    def take(self, entry: Entry | DiffeoCalibError) -> None:
        """Do what was sent, and answer it: judge a row, decide about one, or say how the campaign is."""
        answer: Entry = {}
        try:
            if isinstance(entry, DiffeoCalibError):
                raise entry
            check_cells(entry)
            answer |= {ID: entry[ID]} if ID in entry else {}
            if "do" in entry:
                self.decide(entry.get("line"), entry["do"])
            elif entry:
                number = self.known(entry)
                answer = self.answer(self._append(entry) if number is None else number) | answer
            self.poll()
            answer |= self.state()
        except InputError as error:
            answer["error"] = str(error)
        self._say(answer)

    def known(self, row: Entry) -> int | None:
        """Number of the line that a row repeats; InputError for other values under its id."""
        if ID not in row:
            return None
        header, line = self.table.written(row)
        number = self.ids.get(self.table.cells(line)[self.table.cells(header).index(ID)])
        if number is not None and not self.table.same(line, self.lines[number]):
            what = f"{ID} {row[ID]} is that of line {number + 2} of {self.source.csv}, whose values are others"
            fix = "count on after those of the table when your program starts again, or leave ids out"
            raise InputError.of(what, fix=fix)
        return number

    def decide(self, line: object, what: object) -> None:
        """Do what a user decided about the rows of a line; InputError for no such line or decision."""
        if what not in DECISIONS:
            raise InputError.of("a decision about a row", expected=f"one of {few(DECISIONS)}", got=str(what))
        rows = [verdict.row for verdict in self.campaign.verdicts if verdict.line == line]
        if not rows:
            numbers = f", 2 to {len(self.lines) + 1}" if self.lines else "; there is none yet"
            expected = f"a line of {self.source.csv} with a row{numbers}"
            raise InputError.of("`line`", expected=expected, got=str(line))
        for row in rows:
            getattr(self.campaign, str(what))(row)
        self.journal.add(self._revised())

    def _append(self, row: Entry) -> int:
        self.judge(self.new_lines())
        header, line = self.table.written(row)
        self._read([line], header, len(self.lines))
        torn = self.table.append(header, line).decode(errors="replace")
        if torn:
            self.journal.add([{"removed": torn}])
            self.say(f"half a line was removed from the end of {self.source.csv}: {torn}", {"removed": torn})
        *others, last = self.new_lines()
        while others:  # also those after the target was reached
            self.judge(others)
            others, self.waiting = self.waiting, []
        self._add([last])
        return len(self.lines) - 1

    def _add(self, lines: Sequence[bytes], waiting: int = 0) -> None:
        """Judge lines, after which others wait, and bring that to the disk."""
        first, verdicts = len(self.lines), list[Verdict]()
        begun: list[Entry] = [] if first else [{BEGUN: self._begun()}]
        entries: list[Entry] = [{"line": first + k + 2, "sha": digest(line)} for k, line in enumerate(lines)]
        try:
            data = self._read(lines, first=first)
            if len(lines) > len(set(data.line_numbers.tolist())) > 0:
                raise InputError.of("lines without a row")
            verdicts = self.campaign.add(data, waiting=waiting)
        except InputError as error:
            if not len(self.campaign) and self.missing:  # nor can any other line be read
                raise DiffeoCalibError(str(error)) from error
            if len(lines) > 1:  # one of them cannot be read
                for left, line in zip(reversed(range(len(lines))), lines, strict=True):
                    self._add([line], left + waiting)
                return
            entries[0]["unreadable"] = self.unreadable[first] = str(error)
        for entry, line in zip(entries, lines, strict=True):
            if of_line := [verdict for verdict in verdicts if verdict.line == entry["line"]]:
                entry["rows"] = [{name: getattr(verdict, name) for name in KEPT} for verdict in of_line]
            self._keep(line)
        self.journal.add([*begun, *entries, *self._revised()])

    def _keep(self, line: bytes) -> None:
        self.lines.append(line)
        header, cells = self.table.cells(self.table.header), self.table.cells(line)
        if ID in header and len(cells) == len(header) and cells[header.index(ID)]:
            self.ids[cells[header.index(ID)]] = len(self.lines) - 1

    def _revised(self) -> Iterator[Entry]:
        """Entries of rows that are accepted now and were not, or the other way round; of those to be repeated, too."""
        now = [(verdict.accepted, verdict.again) for verdict in self.campaign.verdicts]
        self.revised = [row for row, (one, other) in enumerate(zip(self.said, now, strict=False)) if one != other]
        self.said = now
        for row in self.revised:
            yield {"row": row} | {name: getattr(self.campaign.verdicts[row], name) for name in KEPT}

    def answer(self, number: int) -> Entry:
        """Outcome of a line."""
        every, answer = self.campaign.verdicts, {"line": number + 2}
        if number in self.unreadable:
            return answer | {"error": f"line {number + 2} left out: {self.unreadable[number]}"}
        of_line = [verdict for verdict in every if verdict.line == number + 2]
        return of_line[0].entry() | answer | {"text": "\n".join(map(str, of_line)), "revised": self.told()}

    def told(self) -> list[Entry]:
        """Rows that changed since this was asked last."""
        every, rows = self.campaign.verdicts, dict.fromkeys([*self.late, *self.revised])
        self.late, self.revised = [], []
        return [{"line": every[row].line, "accepted": every[row].accepted} for row in rows]

    def _say(self, answer: Entry) -> None:
        words = ["left out: " + answer["error"]] if "error" in answer else [answer["text"]] if "text" in answer else []
        if "next" in answer:
            words.append(f"  {'; '.join(filter(None, self.words))}")
        self.say("\n".join(words), answer)

    def state(self) -> Entry:
        """The campaign in numbers, with what to measure next: joint values in the unit of the table."""
        error, proposal = self.campaign.expected_error, self.found
        entry: Entry = {"rows": len(self.campaign), "accepted_rows": len(self.campaign.accepted)}
        entry["expected_error_mm"] = None if error is None else 1e3 * error
        if self.campaign.goal is not None:
            limit, more = self.campaign.error_limit, None if proposal is None else proposal.needed
            entry["error_limit_mm"] = None if limit is None else 1e3 * limit
            entry |= {"more_rows": more, "target_reached": self.campaign.reached}
        poses = [] if proposal is None else self.columns.joints_from_si(proposal.q[: self.given.count]).tolist()
        return entry | {"next": [dict(zip(self.columns.joints.columns, q, strict=True)) for q in poses]}

    @property
    def found(self) -> Next | None:
        """The next poses, and the forecast."""
        now = self.campaign.models, [(verdict.accepted, verdict.again) for verdict in self.campaign.verdicts]
        if self._found is None or self._found[0] != now:
            self._found = now, self.campaign.next(max(self.given.count, 1))
        return self._found[1]

    @property
    def words(self) -> tuple[str, str]:
        """The expected error with the rows to the goal, and the next poses."""
        state, error = self.state(), expected(self.campaign)
        more = "?" if state.get("more_rows", "") is None else state.get("more_rows", "")
        needed = "" if more == "" else f", {more} more rows to the target"
        poses = (", ".join(f"{value:.6g}" for value in pose.values()) for pose in state["next"])
        return f"{error[2:]}{needed}" if error else "no model yet", "; ".join(f"next: {pose}" for pose in poses)

    def _read(self, lines: Sequence[bytes], header: bytes = b"", first: int = 0) -> Any:
        """Lines as a table, in their order; ``first`` is the number of the first one, for messages."""
        held = HeldFile(self.source.csv)
        held.content = (header or self.table.header) + b"\n" * first + b"".join(lines)
        data = replace(self.source, csv=held, growing=True).read(self.campaign.robot, self.tips)
        return data.rows(data.line_numbers.argsort(stable=True))


def expected(campaign: Campaign) -> str:
    """The expected error in words, after a comma; empty without one."""
    error, limit = campaign.expected_error, campaign.error_limit
    below = "" if limit is None else f" (95 %: below {1e3 * limit:.4g} mm)"
    return "" if error is None else f", {1e3 * error:.4g} mm expected{below}"


def run(given: CampaignOptions) -> None:
    """Follow a table until the target is reached or the rows end."""
    if given.by is not None or given.marker is not None:
        fix = "give every row in one line of one file, with columns for each marker"
        raise InputError.of("--places or --marker, of a table that grows line by line", fix=fix)
    source = measured_table(given.csv, given)
    goal = parsed_length(given.tolerance)
    if isinstance(source.table.joints, PoseColumns):
        fix = "measure with --robot and joint values, or fit the table when it is complete"
        raise InputError.of("--robot-pose of a table that grows: the middle of all poses is not known yet", fix=fix)
    robot = robot_of(given, source)
    candidates = given.candidates and read_joints(given.candidates, of_robot(source.table, robot))
    with ExitStack() as stack:
        journal = stack.enter_context(Journal(source.csv.with_name(source.csv.name + JOURNAL)))
        campaign = Campaign(robot, candidates=candidates, goal=goal)
        live = Live(campaign, source, given.tip or list(robot.tips), journal, given)
        live.resume()
        inbox = Inbox()  # a SimpleQueue can wait for ever after a signal
        page = None if given.page is None else stack.enter_context(served(given.page, inbox))
        if page is not None:
            live.say(f"the campaign is shown at {page.url}", {"shown": page.url})
        code = _followed(live, given, inbox, page)
        _end(live)
    if given.accepted is not None:
        numbers = dict.fromkeys(campaign.verdicts[row].line for row in campaign.accepted)
        write_whole(given.accepted, live.table.header + b"".join(live.lines[number - 2] for number in numbers))
    if code:
        raise typer.Exit(code)


def _followed(live: Live, given: CampaignOptions, inbox: Inbox, page: Page | None) -> int:
    step = interrupts.watching(lambda *_: None, lambda text: err.print(plain(text)))
    try:
        for news in chain([True], _happening(live, given, inbox)):
            step("campaign", 0, 1)
            if page is not None and news:
                page.publish(state_of(live.campaign, live.words, live.found))
            if live.campaign.reached:
                break
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    live.end()
    return 0 if live.campaign.goal is None or live.campaign.reached else EXIT_ABOVE


def _happening(live: Live, given: CampaignOptions, inbox: Inbox) -> Iterator[bool]:
    """Do what comes, until the rows end; yields whether anything was done."""
    if given.stdin:
        lines = getattr(sys.stdin.buffer, "raw", sys.stdin.buffer)  # a lock of a buffer would break the exit of Python
        Thread(target=read_lines, args=(lines, inbox), daemon=True).start()
    while True:
        lines = live.new_lines()
        live.judge(lines)
        live.campaign.background = not given.once  # rows that were there before are judged one after the other
        yield bool(lines)
        if given.once and not lines:
            return
        try:
            sent = inbox.get(timeout=LOOK_SECONDS)
        except Empty:
            yield live.poll()
            continue
        if sent is None:
            return
        live.take(sent)
        yield True


def _end(live: Live) -> None:
    state = live.state() | {"revised": live.told(), "ended": True}
    record.add(rows=len(live.campaign), accepted=state["accepted_rows"], expected_error_m=live.campaign.expected_error)
    accepted = f"{state['accepted_rows']} of {state['rows']} rows accepted"
    later = len(live.new_lines())
    rest = f"; the target is reached: {later} later lines of the table were not judged" * (later > 0)
    unread = f", {len(live.unreadable)} lines could not be read" * bool(live.unreadable)
    live.say(accepted + unread + expected(live.campaign) + rest, state)
