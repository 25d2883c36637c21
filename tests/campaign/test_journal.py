"""What a campaign keeps: nothing is lost and nothing half is taken, whenever it is killed."""

from __future__ import annotations

import errno
import http.client
import io
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from command_bank import PROGRAM, Command

import diffeo_calib as dc
from diffeo_calib.campaign.feeds import as_line, check_cells, parsed
from diffeo_calib.campaign.journal import GrowingTable, Journal
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import SimulatedArm

ROWS = 24
WRONG = 20
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
    arm = SimulatedArm(2)
    q, points = arm.measure(ROWS, seed=1)
    points[WRONG] *= 1e3
    arm.write_urdf(tmp_path / "robot.urdf")
    data = dc.Measurements(q, points, arm.nominal.joint_names, doubt=False)
    write_measurements(tmp_path / "all.csv", data, TableFormat("mm", "deg"))
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    return (tmp_path / "all.csv").read_text().splitlines(keepends=True)


def test_a_torn_line_is_removed_and_the_others_stay(tmp_path: Path) -> None:
    path = tmp_path / "run.journal"
    with Journal(path) as journal:
        assert journal.entries == []
        journal.add(ENTRIES)
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


def test_a_second_writer_is_refused(tmp_path: Path) -> None:
    with Journal(tmp_path / "run.journal"), pytest.raises(InputError, match="another process"):
        Journal(tmp_path / "run.journal")


def other_files() -> Iterator[bytes]:
    """Files that are no journals."""
    deep = b'{"begun": ' + 9999 * b"["
    yield from (b"text", b"x,y\n1,2\n", b"x,y\n1,2", b'{"a": 1}\n', b"[]\n", bytes(9), b"\xff\n")
    yield from (deep, deep + b"\n", b'{"begun": 1}\n', b'{"line": 2}\n', b'{"removed": 1}\n')


def other_entries() -> Iterator[bytes]:
    """What cannot follow the entries of a journal."""
    yield from (b"text", b"text\n", b"7\n", b"null\n", b"\n", as_line(LINE), b'{"row": 0, "error": NaN}\n')
    yield b'{"row": 0, "error": 1e999}\n'
    for row in ({"row": 1}, {"row": -1}, {"row": "0"}, {"row": 10**30}, {"line": 3}, {"other": 1}, {"fits": 0}):
        yield as_line({"row": 0} | row)
    line = {"line": 3, "sha": "0", "rows": [ROW]}
    for change in ({"line": "3"}, {"line": 4}, {"sha": 7}, {"rows": []}, {"rows": 7}, {"unreadable": "x"}):
        yield as_line(line | change)
    fields = [{"fits": 1}, {"accepted": None}, {"error": "x"}, {"error": -1.0}, {"error": 1e200}, {"cause": None}]
    fields += [{"shown": "mm"}, {"shown": ["mm"]}, {"shown": ["mm", "1"]}, {"decided": 0}, {"again": []}]
    for field in fields:
        yield as_line(line | {"rows": [ROW | field]})
        yield as_line({"row": 0} | field)
    yield as_line(line | {"rows": [ROW | {"row": 0}]})
    yield as_line(line | {"rows": [{"fits": True}]})


def test_what_is_no_journal_is_left_as_it_is(tmp_path: Path) -> None:
    """Also through a link; nor is a pipe, which was waited for, a device without an end, or a folder."""
    path, link = tmp_path / "other", tmp_path / "run.csv.journal"
    link.symlink_to(path)
    whole = b"".join(as_line(one) for one in ENTRIES)
    for content in [*other_files(), *(whole + tail for tail in other_entries())]:
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"not the journal of a campaign: got .*; name another table, or move"):
            Journal(link)
        assert path.read_bytes() == content
    assert link.is_symlink()
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(InputError, match="not the journal"):
            Journal(path)


def test_a_file_system_without_locks_or_fsync(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command, lines: list[str]
) -> None:
    """The campaign runs, and says that nothing keeps a second one away."""

    def refused(*_: object) -> None:
        raise OSError(errno.EINVAL, "Invalid argument")

    monkeypatch.setattr("fcntl.flock", refused)
    monkeypatch.setattr(os, "fsync", refused)
    (tmp_path / "run.csv").write_text("".join(lines[:3]))
    done = command("campaign", tmp_path / "campaign.toml", "--once", "--accepted", tmp_path / "accepted.csv")
    assert done.code == 0, done.err
    assert "run no second campaign" in done.warnings[0]
    assert (tmp_path / "accepted.csv").read_text() == "".join(lines[:3])


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
    table = GrowingTable(path)
    assert table.new_lines() == []
    seen = []
    for text in ("a", ",b\n1", ",2\n3,", "4\n", "\n5,6\n7"):
        with path.open("a") as file:
            file.write(text)
        seen += table.new_lines()
    assert table.header == b"a,b\n"
    assert seen == [b"1,2\n", b"3,4\n", b"5,6\n"]
    whole = path.read_bytes()
    for other in ("a,b\n", "a,b\n9,2\n3,4\n\n5,6\n7", "a,b\n,2\n3,4\n\n5,6\n7,8\n9", "b,a\n1,2\n3,4\n\n5,6\n7"):
        path.write_text(other)
        with pytest.raises(InputError, match="was changed, or made shorter"):
            table.new_lines()
        with pytest.raises(InputError, match="was changed, or made shorter"):
            table.append(*table.written({"a": 1}))
        assert path.read_text() == other
    path.write_bytes(whole + b",8\n")
    assert table.new_lines() == [b"7,8\n"]
    path.unlink()
    with pytest.raises(InputError, match="changed"):
        table.new_lines()
    with pytest.raises(InputError, match="cannot be written"):
        table.append(*table.written({"a": 1}))
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
    first = command(*words, "--tolerance", "1um")
    assert first.code == 4
    (tmp_path / "run.csv").write_text("".join([*lines[:3], "1,2,three\n", *lines[3:]]))
    assert "changed after" in command(*words).error
    (tmp_path / "run.csv").write_text("".join([*lines[:22], "1,2,three\n", *lines[22:]]))
    done = command(*words, "--accepted", tmp_path / "accepted.csv")
    assert done.code == 0
    assert "going on after 14 lines" in done.out
    assert "row 15 " not in done.out
    assert "mm as m" in done.out
    assert "line 23 left out" in done.out
    kept = [line for number, line in enumerate(lines) if number != WRONG + 1]
    assert (tmp_path / "accepted.csv").read_text() == "".join(kept)
    assert command(*words, "--tolerance", "50mm", "--accepted", tmp_path / "accepted.csv").code == 0
    assert (tmp_path / "accepted.csv").read_text() == "".join(kept)  # rows after the one left out are still those


def test_rows_that_are_there_before_are_judged_as_with_once(
    tmp_path: Path, lines: list[str], command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also without a row that comes later; a line that cannot be read is named by its place in the table."""
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"")))
    wrong = ",".join(["1000"] * len(lines[0].split(","))) + "\n"
    (tmp_path / "run.csv").write_text("".join([*lines[:16], wrong, *lines[16:18], "x" + lines[18]]))
    accepted = []
    for how, known in (("--once", "mm expected"), ("--stdin", '"expected_error_mm": 0.')):  # the latter answers in JSON
        done = command("campaign", tmp_path / "campaign.toml", how, "--accepted", tmp_path / "accepted.csv")
        assert done.code == 0
        assert "row 17 looks wrong" in done.out
        assert known in done.out
        assert "run.csv', line 20" in done.out
        accepted.append((tmp_path / "accepted.csv").read_text())
        (tmp_path / "run.csv.journal").unlink()
    assert accepted[0] == accepted[1]


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
    assert command(*words).code == 0
    journal = (tmp_path / "run.csv.journal").read_bytes()
    for more, named in (
        (["--length", "m"], "expected length mm, got length m;"),
        (["--angle", "rad"], "expected angle deg, got angle rad;"),
        (["--position", "y,x,z"], "expected position ['x,y,z'], got position ['y,x,z'];"),
        (["--joints", ",".join(reversed(lines[0].split(",")[:6]))], "another order"),
        (["--joints", ",".join([*lines[0].split(",")[:5], "x"])], "expected joints"),
        (["--tip", "output_link"], "another robot and tip than"),
        (["--payload", "z"], "expected payload none, got payload z;"),
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
    (tmp_path / "run.csv.journal").write_bytes(old)
    assert command(*words).code == 0


@pytest.mark.slow
def test_a_row_rejected_on_the_page_is_rejected_in_the_journal(tmp_path: Path, lines: list[str]) -> None:
    (tmp_path / "run.csv").write_text("".join(lines[:17]))
    words = ["campaign", "campaign.toml", "--stdin", "--page", "0"]
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", PROGRAM, *words],
        cwd=tmp_path,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    address = urlsplit(json.loads(process.stdout.readline())["shown"])
    assert any("row 17" in line for line in process.stdout)
    connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=60)
    connection.request("POST", "/reject?line=7", headers={"X-Campaign": "1"})
    assert connection.getresponse().status == 200
    connection.close()
    journal = tmp_path / "run.csv.journal"
    for _ in range(600):
        if '"row": 5' in journal.read_text():
            break
        time.sleep(0.1)
    out = process.communicate(timeout=120)[0]
    ended = json.loads(out.splitlines()[-1])
    assert (ended["accepted_rows"], ended["rows"]) == (15, 16)
    assert json.loads(journal.read_text().splitlines()[-1])["decided"] is True
