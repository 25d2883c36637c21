"""The progress line: what is being done, and how long it will take."""

from __future__ import annotations

import io

import pytest
from product_bank import simulated
from rich.console import Console

import diffeo_calib as dc
from diffeo_calib.cli import console


def last_line(monkeypatch: pytest.MonkeyPatch, *calls: tuple[str, int, int]) -> str:
    """The line on a terminal ten seconds after some calls, a second each."""
    shown, now = io.StringIO(), [0.0]
    monkeypatch.setattr(console, "err", Console(file=shown, force_terminal=True, width=120, color_system=None))
    with console.progress_bar(clock=lambda: now[0]) as progress:
        for call in calls:
            progress(*call)
            now[0] += 1.0
        now[0] += 10.0
    return [line for line in shown.getvalue().replace("\r", "\n").split("\n") if "0:00:" in line][-1]


def test_it_says_what_is_done_and_how_long_it_will_take(monkeypatch: pytest.MonkeyPatch) -> None:
    line = last_line(monkeypatch, ("registration", 0, 1), ("rows", 0, 400), ("rows", 100, 400), ("rows", 200, 400))
    assert "rows" in line
    assert "registration" not in line
    assert "0:00:13" in line
    assert "0:00:02" in line


def test_a_task_without_steps_and_one_that_starts_again_have_no_end(monkeypatch: pytest.MonkeyPatch) -> None:
    line = last_line(monkeypatch, ("rows", 400, 400), ("registration", 0, 1))
    assert "finding base and markers" in line
    assert "-:--:--" in line
    assert "-:--:--" in last_line(monkeypatch, ("rows", 400, 400), ("rows", 0, 400))


def test_every_task_of_a_calibration_has_words() -> None:
    arm, train, _ = simulated(20)
    seen: set[str] = set()
    dc.calibrate(arm.nominal, train, progress=lambda task, *_: seen.add(task))
    assert seen <= set(console.WORDS)
