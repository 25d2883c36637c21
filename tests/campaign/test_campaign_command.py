"""A campaign as a command: what its table and journal keep whenever it is killed, and rows over standard input."""

import errno
import io
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any
from urllib.request import Request, urlopen

import pytest
from command_bank import PROGRAM, Command, Outcome
from table_bank import refused

import diffeo_calib as dc
from diffeo_calib.campaign.campaign import Campaign
from diffeo_calib.campaign.feeds import LONGEST_LINE, Inbox, as_line, check_cells, parsed, read_lines
from diffeo_calib.campaign.journal import GrowingTable, Journal
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import SimulatedArm

ARM = SimulatedArm(2)
ROWS = 21
WRONG = 14
"""A row whose positions are 1000 times too large."""
ROW = {"fits": None, "accepted": True, "error": 0.0, "expected": 1e-5, "cause": "", "shown": ["mm", 1000.0]}
LINE = {"line": 2, "sha": "0", "rows": [ROW]}
ENTRIES = [{"begun": {"length": "mm"}}, LINE, {"row": 0, "accepted": False}, {"removed": "1.5,"}]
CAMPAIGN = """csv = "run.csv"
robot = "robot.urdf"
base = "base_link"
tip = "flange"
position = ["x,y,z"]
length = "mm"
angle = "deg"
output = "robot.safetensors"
holdout = 0.2
"""


@pytest.fixture
def lines(tmp_path: Path) -> list[str]:
    """The lines of a table; its campaign file and robot are beside it."""
    q, points = ARM.measure(ROWS, seed=1)
    points[WRONG] *= 1e3
    ARM.write_urdf(tmp_path / "robot.urdf")
    data = dc.Measurements(q, points, ARM.nominal.joint_names, doubt=False)
    write_measurements(tmp_path / "all.csv", data, TableFormat("mm", "deg"))
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    return (tmp_path / "all.csv").read_text().splitlines(keepends=True)


def test_a_journal_is_whole_and_other_files_are_left_as_they_are(tmp_path: Path) -> None:
    """One process writes, a torn line is removed. Others through links too, pipes, devices without an end, folders."""
    path = tmp_path / "run.journal"
    with Journal(path) as journal:
        assert journal.entries == []
        journal.add(ENTRIES)
        with pytest.raises(InputError, match="another process"):
            Journal(path)
    whole = path.read_bytes()
    for torn in [*(whole[:cut] for cut in range(1, whole.find(b"\n"))), bytes(100)]:
        path.write_bytes(whole + torn)
        with Journal(path) as journal:
            assert journal.entries == ENTRIES
        assert path.read_bytes() == whole
    for cut in range(whole.find(b"\n") + 1):
        path.write_bytes(whole[:cut])
        with Journal(path) as journal:
            assert journal.entries == []
        assert path.read_bytes() == b""
    path, link = tmp_path / "other", tmp_path / "run.csv.journal"
    link.symlink_to(path)
    for content in other_files():
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"not the journal of a campaign: got .*; name another table, or move"):
            Journal(link)
        assert path.read_bytes() == content
    assert link.is_symlink()
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(InputError, match="not the journal"):
            Journal(path)


def other_files() -> Iterator[bytes]:
    """Files that are no journals, and what cannot follow the entries of one."""
    deep, whole = b'{"begun": ' + 9999 * b"[", b"".join(map(as_line, ENTRIES))
    yield from (b"text", b"x,y\n1,2\n", b"x,y\n1,2", b'{"a": 1}\n', b"[]\n", bytes(9), b"\xff\n")
    yield from (deep, deep + b"\n", b'{"begun": 1}\n', b'{"line": 2}\n', b'{"removed": 1}\n')
    for tail in (b"text", b"text\n", b"7\n", b"null\n", b"\n", as_line(LINE), b'{"row": 0, "error": NaN}\n'):
        yield whole + tail
    line = {"line": 3, "sha": "0", "rows": [ROW]}
    rows = [{"row": 1}, {"row": -1}, {"row": "0"}, {"row": 10**30}, {"line": 3}, {"other": 1}]
    fields = [{"fits": 1}, {"accepted": None}, {"error": "x"}, {"error": -1.0}, {"error": 1e200}, {"cause": None}]
    fields += [{"shown": "mm"}, {"shown": ["mm"]}, {"shown": ["mm", "1"]}, {"decided": 0}, {"again": []}]
    lines = [{"line": "3"}, {"line": 4}, {"sha": 7}, {"rows": []}, {"rows": 7}, {"unreadable": "x"}]
    lines += [{"rows": [ROW | field]} for field in [*fields, {"row": 0}]] + [{"rows": [{"fits": True}]}]
    for entry in [*({"row": 0} | own for own in rows + fields), *(line | own for own in lines)]:
        yield whole + as_line(entry)


def test_what_cannot_be_appended_whole_is_taken_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.csv"
    table = GrowingTable(path)
    table.append(*table.written({"a": 1}))

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(InputError, match="No space left on device"):
            table.append(*table.written({"a": 2}))
    assert path.read_text() == "a\n1\n"
    table.append(*table.written({"a": 3}))
    assert table.new_lines() == [b"1\n", b"3\n"]


def test_half_a_line_waits_for_its_end(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    table, seen = GrowingTable(path), list[bytes]()
    refused(("is no file to which lines", GrowingTable(Path("/dev/zero")).new_lines))
    assert table.new_lines() == []
    for text in ("a", ",b\n1", ",2\n3,", "4\n", "\n5,6\n7"):
        with path.open("a") as file:
            file.write(text)
        seen += table.new_lines()
    assert (table.header, seen) == (b"a,b\n", [b"1,2\n", b"3,4\n", b"5,6\n"])
    whole, changed = path.read_bytes(), "was changed, or made shorter"
    for other in ("a,b\n", "a,b\n9,2\n3,4\n\n5,6\n7", "a,b\n,2\n3,4\n\n5,6\n7,8\n9", "b,a\n1,2\n3,4\n\n5,6\n7"):
        path.write_text(other)
        refused((changed, table.new_lines), (changed, lambda: table.append(*table.written({"a": 1}))))
        assert path.read_text() == other
    path.write_bytes(whole + b",8\n")
    assert table.new_lines() == [b"7,8\n"]
    path.unlink()
    refused((changed, table.new_lines), ("cannot be written", lambda: table.append(*table.written({"a": 1}))))
    assert not path.exists()


def test_rows_are_appended_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, still = tmp_path / "run.csv", iter((b"7;8", b"7;8"))
    monkeypatch.setattr(time, "sleep", lambda _: path.write_bytes(b"a;b\n1,5;s\n" + next(still)))
    table = GrowingTable(path, ";", ",")
    table.append(*table.written({"a": 1.5, "b": "s"}))
    path.write_bytes(path.read_bytes() + b"7;")  # another program, or torn by a crash
    assert table.new_lines() == [b"1,5;s\n"]
    with pytest.raises(InputError, match="another program"):
        table.append(*table.written({"a": 2}))
    os.utime(path, (1e10, 1e10))  # a clock that was set back
    assert table.append(*table.written({"b": "t", "a": -2e-05})) == b"7;8"
    table.append(*table.written({"a": None, "b": 3}))
    assert table.new_lines() == [b"-2e-05;t\n", b";3\n"]
    with pytest.raises(InputError, match="columns c"):
        table.written({"a": 1, "c": 2})
    assert path.read_text() == "a;b\n1,5;s\n-2e-05;t\n;3\n"
    assert table.same(b"a;1,50;;-2e-05\n", b"a;1,5;;-0,00002\r\n")
    for other in (b"b;1,5;;0\n", b"a;1,5001;;0\n", b"a;1,5;0;0\n", b"a;1.5;;0\n"):
        assert not table.same(b"a;1,5;;0\n", other)
    assert table.cells(b'"' + 200_000 * b"x") == []


def test_lines_that_are_no_rows() -> None:
    deep, huge = 5000 * b"[" + b"\n", b'{"a": ' + 5000 * b"1" + b"}\n"
    for bad in (b'{"a": 1', b'{"a": 1}', b"[1]\n", b"1\n", b"\xff\n", deep, huge):
        with pytest.raises(InputError, match="a line of JSON"):
            parsed(bad)
    inbox = Inbox()
    read_lines(io.BytesIO(b"x" * (LONGEST_LINE + 1)), inbox)  # of no program, perhaps without an end
    assert [type(inbox.get()) for _ in range(inbox.qsize())] == [InputError, InputError, type(None)]
    assert parsed(b'{"a": 1.5, "b": null, "c": "x"}\n') == {"a": 1.5, "b": None, "c": "x"}
    for value in ("NaN", "1e999", "-Infinity", "true", "[1]", "{}", '"x\\n"', f'"{999 * "x"}"', 400 * "9"):
        for name in ("a", "id"):
            with pytest.raises(InputError, match=rf"'{name}' of a row: expected a finite number"):
                check_cells(parsed(f'{{"{name}": {value}}}\n'.encode()))
    for value in (None, "", " "):
        with pytest.raises(InputError, match="leave it out"):
            check_cells({"id": value})
    check_cells({"a": -1e299, "b": None, "c": "word", "": 7, "id": 0})


def test_the_command_ends_at_its_target_and_goes_on(tmp_path: Path, lines: list[str], command: Command) -> None:
    (tmp_path / "run.csv").write_text("".join(lines[:15]) + lines[15][:20])
    words = ["campaign", tmp_path / "campaign.toml", "--once"]
    accepted = [*words, "--accepted", tmp_path / "accepted.csv"]
    assert command(*words, "--tolerance", "1um").code == 4
    (tmp_path / "run.csv").write_text("".join([*lines[:3], "1,2,three\n", *lines[3:]]))
    assert "changed after" in command(*words).error
    (tmp_path / "run.csv").write_text("".join([*lines[:18], "1,2,three\n", *lines[18:21]]))
    done = command.ran(*accepted)
    for words in ("going on after 14 lines", "mm as m", "line 19 left out"):
        assert words in done.out
    assert "row 15 " not in done.out
    kept = [line for number, line in enumerate(lines) if number != WRONG + 1]
    assert (tmp_path / "accepted.csv").read_text() == "".join(kept[:-1])
    with (tmp_path / "run.csv").open("a") as file:
        file.write(lines[21])
    command.ran(*accepted, "--tolerance", "50mm")
    assert (tmp_path / "accepted.csv").read_text() == "".join(kept)  # rows after the one left out are still those


@pytest.mark.slow
def test_it_ends_while_a_program_may_still_send_rows(tmp_path: Path, lines: list[str]) -> None:
    (tmp_path / "run.csv").write_text("".join(lines[:4]))
    words = [sys.executable, "-c", PROGRAM, "campaign", "campaign.toml", "--once", "--stdin"]
    with subprocess.Popen(words, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
        assert process.wait(120) == 0


def test_a_campaign_goes_on_as_it_was_begun(tmp_path: Path, lines: list[str], command: Command) -> None:
    """With the same robot, columns and units: else rows before and after are of other tables."""
    (tmp_path / "run.csv").write_text("".join(lines[:4]))
    robot = (tmp_path / "robot.urdf").read_text()
    words = ["campaign", tmp_path / "campaign.toml", "--once"]
    command.ran(*words)
    journal = (tmp_path / "run.csv.journal").read_bytes()
    for more, named in (
        (["--length", "m"], "expected length mm, got length m;"),
        (["--angle", "rad"], "expected angle deg, got angle rad;"),
        (["--position", "y,x,z"], "expected position ['x,y,z'], got position ['y,x,z'];"),
        (["--joints", ",".join(reversed(lines[0].split(",")[:6]))], "another order"),
        (["--joints", ",".join([*lines[0].split(",")[:5], "w"])], "expected joints"),
        (["--joints", ",".join([*lines[0].split(",")[:5], "x"])], "got ['x'] twice"),
        (["--tip", "output_link"], "another robot and tip than"),
        (["--payload", "w"], "expected payload none, got payload w;"),
    ):
        assert named in command(*words, *more).error, more
    (tmp_path / "robot.urdf").write_text(robot.replace("0.145 0 0.254", "0.146 0 0.254"))
    assert "another robot than it" in command(*words).error
    other = robot.replace('"simulated_arm"', '"arm"').replace('"-2.9"', '"-2.8"').replace("-0.02 0 0.07", "0 0 0")
    (tmp_path / "robot.urdf").write_text(other)  # limits and meshes
    (tmp_path / "run.csv").write_text("".join([lines[0].replace("x,y", "y,x"), *lines[1:4]]))
    assert "another header than it" in command(*words).error
    (tmp_path / "run.csv").write_text("".join(lines[:6]))
    assert (tmp_path / "run.csv.journal").read_bytes() == journal
    assert command(*words, "--joints", ",".join(lines[0].split(",")[:6]), "--tolerance", "1mm").code == 4
    old = journal.split(b"\n", 1)[1]  # of versions that did not say it
    twice = old.replace(b"}]}", b'}, {"fits": null, "accepted": true}]}', 1)
    (tmp_path / "run.csv.journal").write_bytes(twice)
    assert "got 4 verdicts of 3 rows; name another table" in command(*words).error
    (tmp_path / "run.csv.journal").write_bytes(old)
    command.ran(*words)


WORDS = ["--position", "x,y,z", "--length", "m", "--angle", "rad", "--base", "base_link", "--tip", "flange"]


def row(number: int, **more: Any) -> bytes:
    q, y = ARM.measure(1, seed=number)
    values = dict(zip([*ARM.nominal.joint_names, "x", "y", "z"], [*q[0].tolist(), *y[0, 0].tolist()], strict=True))
    return (json.dumps({"id": number, **values, **more}) + "\n").encode()


Answers = list[dict[str, Any]]


@pytest.fixture
def run(tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Outcome, Answers]]:
    """Runs a campaign that is sent lines; its answers, and the last line."""
    ARM.write_urdf(tmp_path / "robot.urdf")

    def sent(lines: Iterable[bytes], *words: object) -> tuple[Outcome, Answers]:
        failed: list[BaseException] = []

        def readline(_: int) -> bytes:
            try:
                return next(rest, b"")
            except BaseException as error:  # in a thread of its own
                failed.append(error)
                return b""

        rest = iter(lines)
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=SimpleNamespace(readline=readline)))
        robot = ["--robot", tmp_path / "robot.urdf", *WORDS, "--accepted", tmp_path / "accepted.csv"]
        done = command("campaign", tmp_path / "run.csv", *robot, "--stdin", *words)
        for error in failed:
            raise error
        return done, [json.loads(line) for line in done.out.splitlines()]

    return sent


def test_every_row_is_answered_and_taken_once(tmp_path: Path, run: Callable[..., tuple[Outcome, Answers]]) -> None:
    lines = [row(0), row(1), row(2), row(2), row(3), row(5), row(6), row(7, unknown=1), row(8, x="wide")]
    lines += [b'{"do": "reject", "line": %d}\n' % number for number in (11, 3)]
    lines += [b"{}\n", b"GET / HTTP/1.1\n", row(4)[:-20]]
    done, answers = run([b"{}\n", *lines])
    assert done.code == 0
    assert (answers[0]["rows"], answers[0]["next"]) == (0, [])
    taken = [(0, 2), (1, 3), (2, 4), (2, 4), (3, 5), (5, 6), (6, 7)]
    assert [(one["id"], one["line"]) for one in answers[1:8]] == taken
    assert all(f"row {one['line']}: " in one["text"] for one in answers[1:8])
    assert all(one["fits"] is None and one["accepted"] for one in answers[1:8])
    for one, words in zip(answers[8:11], ("columns unknown", "wide", "2 to 7"), strict=True):
        assert words in one["error"], one
    assert answers[11]["accepted_rows"] == answers[12]["accepted_rows"] == 5
    assert all("JSON" in one["error"] for one in answers[13:15])
    assert answers[15]["ended"]
    table = (tmp_path / "run.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in table] == ["id", "0", "1", "2", "3", "5", "6"]
    assert (tmp_path / "accepted.csv").read_text().splitlines() == table[:2] + table[3:]
    _, (_, again, _) = run([row(6)])
    assert (again["line"], again["accepted_rows"]) == (7, 5)


def test_what_the_last_model_changes_is_answered(
    tmp_path: Path, run: Callable[..., tuple[Outcome, Answers]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model that is there only after the last row: what is accepted is the last that was said of each line."""
    ended, make = Event(), Campaign._make
    monkeypatch.setattr(Campaign, "_make", lambda *given: ended.wait() and make(*given))

    def lines() -> Iterator[bytes]:
        yield from (row(number, **({"x": 0.0} if number == 14 else {})) for number in range(16))
        ended.set()

    _, answers = run(lines())
    accepted = {one["line"]: one["accepted"] for one in answers if "line" in one}
    assert all(accepted.values())
    accepted |= {one["line"]: one["accepted"] for answer in answers for one in answer["revised"]}
    assert not accepted[16]
    table, kept = ((tmp_path / name).read_text().splitlines() for name in ("run.csv", "accepted.csv"))
    assert kept[1:] == [table[number - 1] for number in sorted(accepted) if accepted[number]]
    entries = (json.loads(line) for line in (tmp_path / "run.csv.journal").read_text().splitlines())
    assert {"row": 14, "accepted": False}.items() <= {
        k: v for one in entries if "row" in one for k, v in one.items()
    }.items()


def test_pages_of_nothing_and_of_a_row(tmp_path: Path, run: Callable[..., tuple[Outcome, Answers]]) -> None:
    """A page before any row; each of what is sent first ended the campaign once. Decisions are in the journal."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        page = free.getsockname()[1]

    def asked(method: str, path: str) -> bytes:
        request = Request(f"http://127.0.0.1:{page}{path}", method=method, headers={"X-Campaign": "1"})
        with urlopen(request, timeout=60) as answer:
            return answer.read()

    def shown(text: str) -> tuple[int, int]:
        """Numbers of poses that are done, and to be measured next, on the page when it says something."""
        for _ in range(600):
            state = json.loads(asked("GET", "/state"))
            if state.get("state", "").startswith(text):
                return len(state["done"]), len(state["next"])
            time.sleep(0.1)
        return -1, -1

    def lines() -> Iterator[bytes]:
        yield from (b"{}\n", b'{"do": "reject", "line": 2}\n', b'{"joint_1": 1}\n')
        asked("GET", "/")
        for what in ("accept", "reject", "repeat"):
            asked("POST", f"/{what}?line=2")
        assert shown("0 of 0 rows accepted; no model yet") == (0, 0)
        yield row(0)
        assert shown("1 of 1") == (1, 0)
        asked("POST", "/reject?line=2")
        assert shown("0 of 1") == (1, 0)
        decided = json.loads((tmp_path / "run.csv.journal").read_text().splitlines()[-1])
        assert (decided["row"], decided["accepted"], decided["decided"]) == (0, False, True)
        yield b'{"do": "repeat", "line": 2}\n'

    done, (_, first, decision, unreadable, *clicked, taken, rejected, repeated, _) = run(lines(), "--page", page)
    assert done.code == 0, done.err
    assert first["rows"] == 0
    assert all("there is none yet" in one["error"] for one in (decision, *clicked))
    assert len(clicked) == 3
    assert "header" in unreadable["error"]
    assert (taken["line"], rejected["accepted_rows"], len(repeated["next"])) == (2, 0, 1)


def test_rows_under_an_id_of_others(tmp_path: Path, run: Callable[..., tuple[Outcome, Answers]]) -> None:
    """A program that counts anew loses no row in silence, also after the campaign was started again."""
    first = [row(0), row(1), row(2, id="two"), row(1), row(1, id="1"), row(2, id="two")]
    other = [row(3, id=1), row(3, id="1"), row(3, id="two"), row(3, id=None), row(3, id="")]
    for again in (0, 1):
        done, answers = run([*first, *other])
        assert done.code == 0
        answers = answers[again:-1]
        assert [one.get("line") for one in answers] == [2, 3, 4, 3, 3, 4, *5 * [None]]
        assert all("whose values are others" in one["error"] for one in answers[6:9])
        assert all("leave it out" in one["error"] for one in answers[9:])
    assert len((tmp_path / "run.csv").read_text().splitlines()) == 4


def test_a_table_that_another_program_edits(tmp_path: Path, run: Callable[..., tuple[Outcome, Answers]]) -> None:
    path = tmp_path / "run.csv"

    def lines() -> Iterator[bytes]:
        yield from map(row, range(3))
        journal = tmp_path / "run.csv.journal"
        while not journal.exists() or journal.read_text().count('"line": ') < 3:
            time.sleep(0.05)
        whole = path.read_text()
        path.write_text(whole[:-20] + whole[-17:])
        yield row(3)

    done, answers = run(lines())
    assert done.code == 1
    assert "was changed" in done.error
    assert [one["line"] for one in answers if "error" not in one] == [2, 3, 4]
    assert path.read_text().count("\n") == 4
