"""What a campaign keeps: nothing is lost and nothing half is taken, whenever it is killed."""

from __future__ import annotations

import http.client
import io
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from command_bank import PROGRAM, Command

import diffeo_calib as dc
from diffeo_calib.campaign.feeds import parsed
from diffeo_calib.campaign.journal import GrowingTable, Journal
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import SimulatedArm

ROWS = 24
WRONG = 20
"""A row whose positions are 1000 times too large."""
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
        journal.add([{"line": 2}, {"line": 3}])
    for cut in range(1, 12):
        with path.open("ab") as file:
            file.write(b'{"line": 4}\n'[:cut])
        with Journal(path) as journal:
            assert journal.entries == [{"line": 2}, {"line": 3}]
        assert path.read_bytes() == b'{"line": 2}\n{"line": 3}\n'


def test_a_second_writer_and_another_file_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.journal"
    with Journal(path), pytest.raises(InputError, match="another process"):
        Journal(path)
    path.write_text("x,y\n1,2\n")
    with pytest.raises(InputError, match="not the journal"):
        Journal(path)


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
    path.write_text("a,b\n")
    with pytest.raises(InputError, match="shorter"):
        table.new_lines()


def test_rows_are_appended_whole(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    table = GrowingTable(path, ";", ",")
    table.append(*table.written({"a": 1.5, "b": "s"}))
    path.write_bytes(path.read_bytes() + b"7;")  # another program, or torn by a crash
    assert table.new_lines() == [b"1,5;s\n"]
    with pytest.raises(InputError, match="another program"):
        table.append(*table.written({"a": 2}))
    os.utime(path, (0, 0))
    assert table.append(*table.written({"b": "t", "a": -2e-05})) == b"7;"
    table.append(*table.written({"a": None, "b": 3}))
    assert table.new_lines() == [b"-2e-05;t\n", b";3\n"]
    with pytest.raises(InputError, match="columns c"):
        table.written({"a": 1, "c": 2})
    assert path.read_text() == "a;b\n1,5;s\n-2e-05;t\n;3\n"


@pytest.mark.parametrize(
    "bad", [b'{"a": 1', b'{"a": 1}', b"[1]\n", b"1\n", b'{"a": NaN}\n', b'{"a": [1]}\n', b'{"a": "x\\n"}\n', b"\xff\n"]
)
def test_lines_that_are_no_rows(bad: bytes) -> None:
    with pytest.raises(InputError, match="a line of JSON"):
        parsed(bad)
    assert parsed(b'{"a": 1.5, "b": null, "c": "x"}\n') == {"a": 1.5, "b": None, "c": "x"}


def test_the_command_ends_at_its_target_and_goes_on(tmp_path: Path, lines: list[str], command: Command) -> None:
    (tmp_path / "run.csv").write_text("".join(lines[:15]) + lines[15][:20])
    words = ["campaign", tmp_path / "campaign.toml", "--once"]
    first = command(*words, "--target", "1um")
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
    assert command(*words, "--target", "50mm").code == 0


def test_rows_that_are_there_before_are_judged_as_with_once(
    tmp_path: Path, lines: list[str], command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also without a row that comes later; a line that cannot be read is named by its place in the table."""
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"")))
    wrong = ",".join(["1000"] * len(lines[0].split(","))) + "\n"
    (tmp_path / "run.csv").write_text("".join([*lines[:18], wrong, *lines[18:20], "x" + lines[20]]))
    accepted = []
    for how in ("--once", "--stdin"):
        done = command("campaign", tmp_path / "campaign.toml", how, "--accepted", tmp_path / "accepted.csv")
        assert done.code == 0
        assert "row 19 looks wrong" in done.out
        assert "mm expected" in done.out
        assert "run.csv', line 22" in done.out
        accepted.append((tmp_path / "accepted.csv").read_text())
        (tmp_path / "run.csv.journal").unlink()
    assert accepted[0] == accepted[1]


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
    address = urlsplit(process.stdout.readline().split()[-1])
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
    assert "15 of 16 rows accepted" in out
    assert json.loads(journal.read_text().splitlines()[-1])["decided"] is True
