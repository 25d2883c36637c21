"""What a terminal shows of names and cells, short and without control characters; the progress line."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from command_bank import Command, Site, edited, set_cell
from product_bank import simulated
from rich.console import Console

import diffeo_calib as dc
from diffeo_calib.cli import console
from diffeo_calib.cli.console import plain
from diffeo_calib.common.errors import LONGEST_NAME, InputError, few, listed, printable, sentence, shown

ESCAPE = "\x1b[31mred\x07"


def test_control_characters_are_escaped_everywhere() -> None:
    for text in (
        sentence(ESCAPE, expected=ESCAPE, got=ESCAPE, fix=ESCAPE),
        few([ESCAPE]),
        listed([ESCAPE]),
        plain(ESCAPE),
    ):
        assert text.isprintable()
        assert "\\x1b" in text
    assert printable("a\u202eb\udcff\x00") == "a\\u202eb\\udcff\\x00"
    assert printable("Gelenk 1, \u03b1 \u95a2\u7bc0") == "Gelenk 1, \u03b1 \u95a2\u7bc0"
    assert plain("two\nlines") == "two\nlines"


def test_long_values_are_cut_in_the_middle() -> None:
    assert len(shown("x" * 100_000)) <= LONGEST_NAME
    assert shown("short") == "short"
    assert shown("begin" + "x" * 1000 + "end").startswith("begin")
    assert shown("begin" + "x" * 1000 + "end").endswith("end")
    assert len(str(InputError.of("w" * 10**5, expected="e" * 10**5, got="g" * 10**5, fix="f" * 10**5))) < 6000


@pytest.mark.parametrize("row", [0, 3])
def test_a_cell_of_100_kB(row: int, small_site: Site, command: Command, tmp_path: Path) -> None:
    csv = edited(small_site, tmp_path / "t.csv", set_cell(row, 2, "x" * 100_000))
    done = command(*small_site.fit(csv, tmp_path / "model"))
    assert done.code == 1
    assert len(done.error) < 1500
    assert "elbow_joint" in done.error


def test_escape_sequences_of_a_file_do_not_reach_the_terminal(
    small_site: Site, command: Command, tmp_path: Path
) -> None:
    for row, column in ((0, 2), (4, 2), (0, 7)):
        csv = edited(small_site, tmp_path / "t.csv", set_cell(row, column, ESCAPE))
        done = command(*small_site.fit(csv, tmp_path / "model"))
        assert done.code == 1
        assert "\x1b" not in done.err + done.out
        assert "\\x1b" in done.error
    done = command(*small_site.fit(tmp_path / f"{ESCAPE}.csv", tmp_path / "model"))
    assert "\x1b" not in done.err
    done = command(*small_site.fit(small_site.csv, tmp_path / "model", "--position", ESCAPE))
    assert done.code == 1
    assert "\x1b" not in done.err


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


def test_keywords_are_said_as_options_unless_as_those_of_Python(capsys: pytest.CaptureFixture[str]) -> None:
    console.show("error", "name the column `rotation_angle`: --marker smr (in Python `marker`), sep=';'")
    assert "column --rotation-angle: --marker smr (in Python `marker`), --sep ';'" in capsys.readouterr().err


def test_every_task_of_a_calibration_has_words() -> None:
    arm, train, _ = simulated(20)
    seen: set[str] = set()
    dc.calibrate(arm.nominal, train, progress=lambda task, *_: seen.add(task))
    assert seen <= set(console.WORDS)
