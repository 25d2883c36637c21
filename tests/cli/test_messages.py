"""What a terminal shows of names and cells, short and without control characters; the progress line."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from command_bank import Command, Site, edited, set_cell
from rich.console import Console

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


@pytest.mark.parametrize("text", [ESCAPE, "x" * 100_000])
def test_names_and_cells_of_a_file_do_not_reach_the_terminal_as_they_are(
    text: str, small_site: Site, command: Command, tmp_path: Path
) -> None:
    bad = [edited(small_site, tmp_path / f"{row}.csv", set_cell(row, 2, text)) for row in (0, 3)]
    given: list[list[object]] = [small_site.fit(csv, tmp_path / "model") for csv in bad]
    given.append(small_site.fit(small_site.csv, tmp_path / "model", "--position", text))
    if text == ESCAPE:
        given.append(small_site.fit(tmp_path / f"{text}.csv", tmp_path / "model"))
    for words in given:
        done = command(*words)
        assert done.code == 1
        assert "\x1b" not in done.err + done.out
        assert len(done.error) < 1500
        assert "elbow_joint" in done.error or words not in given[:2]


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


def test_progress_says_what_is_done_and_how_long_it_will_take(monkeypatch: pytest.MonkeyPatch) -> None:
    """A task without steps, and one that starts again, have no end."""
    line = last_line(monkeypatch, ("registration", 0, 1), ("rows", 0, 400), ("rows", 100, 400), ("rows", 200, 400))
    assert [word in line for word in ("rows", "registration", "0:00:13", "0:00:02")] == [True, False, True, True]
    line = last_line(monkeypatch, ("rows", 400, 400), ("registration", 0, 1))
    assert "finding base and markers" in line
    assert "-:--:--" in line
    assert "-:--:--" in last_line(monkeypatch, ("rows", 400, 400), ("rows", 0, 400))


def test_keywords_are_said_as_options_unless_as_those_of_Python(capsys: pytest.CaptureFixture[str]) -> None:
    console.show("error", "name the column `rotation_angle`: --marker smr (in Python `marker`), sep=';'")
    assert "column --rotation-angle: --marker smr (in Python `marker`), --sep ';'" in capsys.readouterr().err
