"""Rows over a socket: answered one by one, none lost by a cut connection, none taken in twice or by half."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from command_bank import Command, Outcome

from diffeo_calib.campaign.feeds import listening
from diffeo_calib.common.errors import InputError
from diffeo_calib.robots import SimulatedArm

ARM = SimulatedArm(2)
WORDS = ["--position", "x,y,z", "--length", "m", "--angle", "rad", "--base", "base_link", "--tip", "flange"]


def row(number: int, **more: Any) -> bytes:
    """A row as a line."""
    q, y = ARM.measure(1, seed=number)
    values = dict(zip([*ARM.nominal.joint_names, "x", "y", "z"], [*q[0].tolist(), *y[0, 0].tolist()], strict=True))
    return (json.dumps({"id": number, **values, **more}) + "\n").encode()


def free_port() -> int:
    """Not one that the system gives to clients, which could then connect to themselves."""
    for port in random.sample(range(20000, 30000), 100):
        with socket.socket() as found, suppress(OSError):
            found.bind(("127.0.0.1", port))
            return port
    raise OSError("no free port")


class Client:
    """A connection, after what it is told first."""

    def __init__(self, port: int, first: bytes = b"") -> None:
        for _ in range(600):
            try:
                self.socket = socket.create_connection(("127.0.0.1", port), timeout=60)
                break
            except ConnectionRefusedError:
                time.sleep(0.05)
        self.lines = self.socket.makefile("rwb")
        if first:
            self.write(first)
        self.first = self.read()

    def write(self, text: bytes) -> None:
        self.lines.write(text)
        self.lines.flush()

    def read(self) -> dict[str, Any]:
        return json.loads(self.lines.readline() or b"{}")

    def ask(self, text: bytes) -> dict[str, Any]:
        self.write(text)
        return self.read()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.cut()

    def cut(self) -> None:
        self.lines.close()
        self.socket.close()


@pytest.fixture
def run(tmp_path: Path, command: Command) -> Callable[..., tuple[Outcome, Any]]:
    """Runs a campaign that listens beside a client, which ends it by Ctrl-C unless it ends by itself within seconds."""
    ARM.write_urdf(tmp_path / "robot.urdf")

    def both(client: Callable[[int], Any], *words: object, seconds: float = 0.0) -> tuple[Outcome, Any]:
        port, over = free_port(), Event()

        def ended() -> Any:
            try:
                return client(port)
            finally:
                if not over.wait(seconds):
                    os.kill(os.getpid(), signal.SIGINT)

        with ThreadPoolExecutor() as pool:
            found = pool.submit(ended)
            robot = ["--robot", tmp_path / "robot.urdf", *WORDS, "--accepted", tmp_path / "accepted.csv"]
            done = command("campaign", tmp_path / "run.csv", *robot, "--listen", port, *words)
            over.set()
        return done, found.result()

    return both


def test_every_row_is_answered_and_taken_once(tmp_path: Path, run: Callable[..., tuple[Outcome, Any]]) -> None:
    def client(port: int) -> list[dict[str, Any]]:
        with Client(port) as one:
            answers = [one.first, one.ask(row(0)), one.ask(row(1))]
            one.write(row(2))  # nobody knows whether it arrives
        with Client(port) as two:
            answers += [two.ask(row(2)), two.ask(row(3))]
            two.write(row(4)[:-20])  # half a line
        with Client(port) as one, Client(port) as two:
            answers += [one.ask(row(5)), two.ask(row(6)), one.ask(row(7, unknown=1)), one.ask(row(8, x="wide"))]
            answers += [two.ask(b'{"do": "reject", "line": %d}\n' % number) for number in (11, 3)]
            return [*answers, two.ask(b"{}\n"), one.ask(b"GET / HTTP/1.1\n"), one.read()]

    done, (first, *answers) = run(client)
    assert done.code == 130
    assert (first["rows"], first["next"]) == (0, [])
    assert [(one["id"], one["line"]) for one in answers[:6]] == [(0, 2), (1, 3), (2, 4), (3, 5), (5, 6), (6, 7)]
    assert all(f"row {one['line']}: " in one["text"] for one in answers[:6])
    assert all(one["fits"] is None and one["accepted"] for one in answers[:6])
    for one, words in zip(answers[6:9], ("columns unknown", "wide", "2 to 7"), strict=True):
        assert words in one["error"], one
    assert answers[9]["accepted_rows"] == answers[10]["accepted_rows"] == 5
    assert "JSON" in answers[11]["error"]
    assert answers[12] == {}
    table = (tmp_path / "run.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in table] == ["id", "0", "1", "2", "3", "5", "6"]
    assert (tmp_path / "accepted.csv").read_text().splitlines() == table[:2] + table[3:]

    def again(port: int) -> dict[str, Any]:
        with Client(port) as one:
            return one.ask(row(6))

    _, answer = run(again, "--json-lines")
    assert (answer["line"], answer["accepted_rows"]) == (7, 5)


def test_every_view_of_nothing(tmp_path: Path, run: Callable[..., tuple[Outcome, Any]]) -> None:
    """A page before any row; each of what is sent first ended the campaign once."""
    page = free_port()

    @contextmanager
    def asked(method: str, path: str) -> Iterator[HTTPResponse]:
        connection = HTTPConnection("127.0.0.1", page, timeout=60)
        connection.request(method, path, headers={"X-Campaign": "1"})
        yield connection.getresponse()
        connection.close()

    def shown(text: str) -> int:
        """Number of poses on the page when it says something."""
        with asked("GET", "/events") as events:
            for line in events:
                if line.startswith(b"data: {"):
                    state = json.loads(line.removeprefix(b"data: "))
                    if state.get("state", "").startswith(text):
                        return len(state["done"])
        return -1

    def client(port: int) -> list[Any]:
        with Client(port) as one:
            seen = [one.first, *map(one.ask, (b"{}\n", b'{"do": "reject", "line": 2}\n', b'{"joint_1": 1}\n'))]
            for method, path in (
                ("GET", "/"),
                *(("POST", f"/{what}?line=2") for what in ("accept", "reject", "repeat")),
            ):
                with asked(method, path) as answer:
                    assert answer.status == 200
            assert shown("0 of 0 rows accepted; no model yet") == 0
            seen.append(one.ask(row(0)))
            assert shown("1 of 1") == 1
            return [*seen, one.ask(b'{"do": "repeat", "line": 2}\n')]

    done, (first, again, decision, unreadable, taken, repeated) = run(client, "--page", page)
    assert done.code == 130, done.err
    assert first["rows"] == again["rows"] == 0
    assert "there is none yet" in decision["error"]
    assert "header" in unreadable["error"]
    assert (taken["line"], len(repeated["next"])) == (2, 1)


def test_rows_under_an_id_of_others(tmp_path: Path, run: Callable[..., tuple[Outcome, Any]]) -> None:
    """A program that counts anew loses no row in silence, also after the campaign was started again."""

    def client(port: int) -> list[dict[str, Any]]:
        with Client(port) as one:
            first = one.ask(row(0)), one.ask(row(1)), one.ask(row(2, id="two"))
            same = one.ask(row(1)), one.ask(row(1, id="1")), one.ask(row(2, id="two"))
            other = one.ask(row(3, id=1)), one.ask(row(3, id="1")), one.ask(row(3, id="two"))
            return [*first, *same, *other, one.ask(row(3, id=None)), one.ask(row(3, id=""))]

    for _ in range(2):
        done, answers = run(client, "--json-lines")
        assert done.code == 130
        assert [one.get("line") for one in answers] == [2, 3, 4, 3, 3, 4, *5 * [None]]
        assert all("whose values are others" in one["error"] for one in answers[6:9])
        assert all("leave it out" in one["error"] for one in answers[9:])
    assert len((tmp_path / "run.csv").read_text().splitlines()) == 4


def test_a_row_that_is_none_ends_nothing(run: Callable[..., tuple[Outcome, Any]]) -> None:
    """Neither the campaign nor the connection."""
    bad = [row(1).replace(b'"x": ', b'"x": %s, "y": ' % value) for value in (b"1e999", b"NaN", b"true", b"[1]")]
    bad += [row(1).replace(b'"id": 1', b'"id": %s' % value) for value in (b"1e999", b"-Infinity", b"false", b"[]")]

    def client(port: int) -> list[dict[str, Any]]:
        with Client(port) as one:
            return [one.ask(text) for text in [*bad, row(0)]]

    done, (*refused, taken) = run(client, "--json-lines")
    assert done.code == 130
    for one, name in zip(refused, 4 * ["x"] + 4 * ["id"], strict=True):
        assert f"'{name}' of a row: expected a finite number" in one["error"]
    assert taken["line"] == 2


def test_a_table_that_another_program_edits(tmp_path: Path, run: Callable[..., tuple[Outcome, Any]]) -> None:
    """The next row lost its first characters, and was accepted."""

    def client(port: int) -> tuple[dict[str, Any], str]:
        with Client(port) as one:
            for number in range(3):
                one.ask(row(number))
            path = tmp_path / "run.csv"
            whole = path.read_text()
            path.write_text(whole[:-20] + whole[-17:])
            return one.ask(row(3)), whole[:-20] + whole[-17:]

    done, (answer, edited) = run(client, seconds=20.0)
    assert done.code == 1
    assert "was changed" in done.error
    assert "error" in answer
    assert "line" not in answer
    assert (tmp_path / "run.csv").read_text() == edited


@pytest.mark.parametrize("typed", [True, False])
def test_a_token_is_asked_for(
    typed: bool, run: Callable[..., tuple[Outcome, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def client(port: int) -> list[dict[str, Any]]:
        words = b'{"token": "secret"}\n', b'{"token": "no"}\n', row(1)
        with Client(port, words[0]) as known, Client(port, words[1]) as other, Client(port, words[2]) as third:
            return [known.first, known.ask(row(0)), other.first, third.first]

    if not typed:
        monkeypatch.setenv("DIFFEO_CALIB_TOKEN", "secret")
    _, (first, answer, *others) = run(client, *["--token", "secret"] * typed, "--json-lines")
    assert first["rows"] == 0
    assert answer["accepted"]
    assert all("token" in one["error"] for one in others)


@pytest.mark.parametrize("address", ["0.0.0.0:0", "example.org:1", "x", "70000"])
def test_addresses_that_are_refused(address: str) -> None:
    with pytest.raises(InputError), listening(address, "", None):  # pyright: ignore[reportArgumentType]
        pass
