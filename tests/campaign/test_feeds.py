"""Rows over standard input: answered one by one, none taken in twice or by half."""

from __future__ import annotations

import json
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from command_bank import Command, Outcome

from diffeo_calib.robots import SimulatedArm

ARM = SimulatedArm(2)
WORDS = ["--position", "x,y,z", "--length", "m", "--angle", "rad", "--base", "base_link", "--tip", "flange"]


def row(number: int, **more: Any) -> bytes:
    """A row as a line."""
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

        def buffer() -> Iterator[bytes]:
            try:
                yield from lines
            except BaseException as error:  # in a thread of its own
                failed.append(error)

        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=buffer()))
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


def test_every_view_of_nothing(run: Callable[..., tuple[Outcome, Answers]]) -> None:
    """A page before any row; each of what is sent first ended the campaign once."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        page = free.getsockname()[1]

    @contextmanager
    def asked(method: str, path: str) -> Iterator[HTTPResponse]:
        connection = HTTPConnection("127.0.0.1", page, timeout=60)
        connection.request(method, path, headers={"X-Campaign": "1"})
        yield connection.getresponse()
        connection.close()

    def shown(text: str) -> int:
        """Number of poses on the page when it says something."""
        for _ in range(600):
            with asked("GET", "/state") as answer:
                state = json.load(answer)
            if state.get("state", "").startswith(text):
                return len(state["done"])
            time.sleep(0.1)
        return -1

    def lines() -> Iterator[bytes]:
        yield from (b"{}\n", b'{"do": "reject", "line": 2}\n', b'{"joint_1": 1}\n')
        for method, path in (("GET", "/"), *(("POST", f"/{what}?line=2") for what in ("accept", "reject", "repeat"))):
            with asked(method, path) as answer:
                assert answer.status == 200
        assert shown("0 of 0 rows accepted; no model yet") == 0
        yield row(0)
        assert shown("1 of 1") == 1
        yield b'{"do": "repeat", "line": 2}\n'

    done, (_, first, decision, unreadable, *clicked, taken, repeated, _) = run(lines(), "--page", page)
    assert done.code == 0, done.err
    assert first["rows"] == 0
    assert all("there is none yet" in one["error"] for one in (decision, *clicked))
    assert "header" in unreadable["error"]
    assert (taken["line"], len(repeated["next"])) == (2, 1)


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
    """The next row lost its first characters, and was accepted."""
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
