"""The benchmark beside a busy process: it measures every call, and stops the process that it starts."""

from __future__ import annotations

import subprocess
from functools import partial

import busy_machine
import pytest


def test_calls_run_without_and_with_a_busy_process(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []
    real = subprocess.Popen

    def popen(*words: object, **options: object) -> subprocess.Popen[bytes]:
        started.append(real(*words, **options))  # pyright: ignore[reportCallIssue, reportArgumentType]
        return started[-1]

    monkeypatch.setattr(busy_machine.subprocess, "Popen", popen)
    monkeypatch.setattr(busy_machine, "SETTLING_S", 0.0)
    beside: list[bool] = []
    record = busy_machine.compare(lambda: beside.append(any(one.poll() is None for one in started)), 2)
    assert set(beside) == {False, True}
    assert len(started) == 2
    assert all(one.poll() is not None for one in started)
    assert record["ratio"] == pytest.approx(record["busy_ms"] / record["idle_ms"])  # pyright: ignore[reportOperatorIssue]


@pytest.mark.parametrize(
    "name", ["fit of the RR arm, RK4(2)", "kernel sum, 1024 points", "loss and gradient, 256 points"]
)
def test_calls_can_be_made(name: str) -> None:
    busy_machine.CALLS[name]()()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["calibration, 60 poses", "positions, 10000 rows", "commands, 1000 rows", "command line, 60 poses"]
)
def test_slow_calls_can_be_made(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With fewer poses and rows."""
    monkeypatch.setattr(busy_machine, "TRAINING", 20)
    call = busy_machine.CALLS[name]
    assert isinstance(call, partial)
    call.func(20)()
