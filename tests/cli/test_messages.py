"""What a terminal shows of names and cells: short, and without control characters; and endless files."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_bank import TABLE, Command, Site, edited, set_cell

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
    assert done.code == 2
    assert "\x1b" not in done.err


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs a device without an end")
def test_a_device_without_line_ends(small_site: Site, command: Command, tmp_path: Path) -> None:
    zero, model = Path("/dev/zero"), tmp_path / "model"
    assert "no text but binary" in command(*small_site.fit(zero, model)).error
    assert "is no file" in command(*small_site.fit(small_site.csv, model, "--robot", zero)).error
    assert "there is no model file /dev/zero" in command("evaluate", zero, small_site.csv, *TABLE).error
