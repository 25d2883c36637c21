"""The progress line: what is being done, and how long it will take."""

from __future__ import annotations

import io

import pytest
from product_bank import simulated
from rich.console import Console

import diffeo_calib as dc
from diffeo_calib.cli import console


@pytest.mark.parametrize(
    ("done", "total", "seconds", "expected"),
    [
        (10, 40, 5.0, "15 s"),
        (1, 2, 300.0, "5 min"),
        (1, 4, 40.0, "2 min"),
        (40, 40, 5.0, "0 s"),
        (0, 40, 5.0, None),
        (1, 40, 0.5, None),
        (3, None, 9.0, None),
        (3, 9, None, None),
    ],
)
def test_the_rest_takes_as_long_as_the_steps_before(
    done: float, total: float | None, seconds: float | None, expected: str | None
) -> None:
    assert console.remaining(done, total, seconds) == expected


def last_line(monkeypatch: pytest.MonkeyPatch, *calls: tuple[str, int, int]) -> str:
    """The line on a terminal ten seconds after some calls."""
    shown, now = io.StringIO(), [0.0]
    monkeypatch.setattr(console, "err", Console(file=shown, force_terminal=True, width=120, color_system=None))
    with console.progress_bar(clock=lambda: now[0]) as progress:
        for call in calls:
            progress(*call)
        now[0] += 10.0
    return [line for line in shown.getvalue().replace("\r", "\n").split("\n") if "0:00:" in line][-1]


def test_it_says_what_is_done_and_how_long_it_will_take(monkeypatch: pytest.MonkeyPatch) -> None:
    line = last_line(monkeypatch, ("registration", 0, 1), ("rows", 0, 400), ("rows", 100, 400))
    assert "rows" in line
    assert "registration" not in line
    assert "0:00:10" in line
    assert "about 30 s left" in line


def test_a_limit_is_no_promise(monkeypatch: pytest.MonkeyPatch) -> None:
    line = last_line(monkeypatch, ("rows", 400, 400), ("Gauss-Newton", 0, 30), ("Gauss-Newton", 10, 30))
    assert "fitting" in line
    assert "at most 20 s left" in line


def test_a_task_without_steps_and_one_that_starts_again_have_no_end(monkeypatch: pytest.MonkeyPatch) -> None:
    line = last_line(monkeypatch, ("rows", 400, 400), ("registration", 0, 1))
    assert "finding base and markers" in line
    assert "left" not in line
    assert "left" not in last_line(monkeypatch, ("rows", 400, 400), ("rows", 0, 400))


def test_every_task_of_a_calibration_has_words() -> None:
    arm, train, _ = simulated(20)
    seen: set[str] = set()
    dc.calibrate(arm.nominal, train, progress=lambda task, *_: seen.add(task))
    assert seen <= set(console.WORDS)
