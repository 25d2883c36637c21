"""Options that do not match the file, and tables with mistakes: exit code 1 and one sentence that says what to do."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from command_bank import ROTATION, TABLE, Command, Site, edited, rows_of

pytestmark = pytest.mark.slow  # calibrations by the dozen


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--sep", ","], r"--sep and --decimal: expected different characters.*--sep ';'"),
        (["--tip", "hand"], r"no link 'hand'.*its links are base_link, .*flange"),
        (["--tip", "flnage"], r"did you mean 'flange'"),
        (["--tip", "flange", "--tip", "wrist_link"], r"--tip: expected 1, one for each --position, got 2"),
        (["--base", "output_link"], r"no moving joint from 'output_link' to 'flange'"),
        (["--joints", "waist_joint,shoulder_joint"], r"expected 6 columns, in the order .*, got 2"),
        (["--robot", "nowhere.urdf"], r"there is no file nowhere.urdf; check the path of --robot"),
    ],
)
def test_wrong_options(options: list[str], message: str, small_site: Site, command: Command, tmp_path: Path) -> None:
    given = small_site.fit(small_site.csv, tmp_path / "model")
    for option in ("--position", "--tip"):  # list options: a second one would be a second marker
        if option in options:
            at = given.index(option)
            given = given[:at] + given[at + 2 :]
    done = command(*given, *options)
    assert done.code == 1
    assert re.search(message, done.error), done.error
    assert not (tmp_path / "model").exists()


def test_rotations_for_a_model_of_points(small_site: Site, sound: bytes, command: Command, tmp_path: Path) -> None:
    (tmp_path / "model").write_bytes(sound)
    csv = edited(
        small_site, tmp_path / "t.csv", lambda cells: [cells[0] + list("ijk"), *([*r, *"789"] for r in cells[1:])]
    )
    done = command("evaluate", tmp_path / "model", csv, *TABLE, "--rotation", "i,j,k", *ROTATION[2:])
    assert done.code == 1
    assert "calibrated with points: expected measured points, got poses" in done.error
    for option in (["--convention", "rotvec"], ["--rotation-angle", "deg"]):
        done = command("predict", tmp_path / "model", csv, *TABLE[2:], *option, "-o", tmp_path / "p.csv")
        assert done.code == 1
        assert "this model has none" in done.error
        assert not (tmp_path / "p.csv").exists()


@pytest.mark.parametrize("rows", [1, 2])
def test_too_few_rows_without_holding_any_out(rows: int, small_site: Site, command: Command, tmp_path: Path) -> None:
    csv = edited(small_site, tmp_path / "bad.csv", rows_of(*range(rows + 1)))
    done = command(*small_site.fit(csv, tmp_path / "model", "--holdout", 0))
    assert done.code == 1
    assert f"at least 3 poses, got {rows}" in done.error
    assert "measure more poses" in done.error


def test_shuffled_rows(small_site: Site, command: Command, tmp_path: Path) -> None:
    """Points paired with other rows' joints: what a sorted spreadsheet column does."""

    def shuffle(cells: list[list[str]]) -> list[list[str]]:
        order = np.random.default_rng(0).permutation(len(cells) - 1) + 1
        return [cells[0], *(cells[i + 1][:6] + cells[j][6:] for i, j in enumerate(order))]

    done = command(*small_site.fit(edited(small_site, tmp_path / "bad.csv", shuffle), tmp_path / "model"))
    assert done.code == 1
    doubts = [text for text in done.warnings if "the measurements do not fit this robot" in text]
    assert "rows pair joints with their own points" in doubts[0]
    assert "of the judged positions are more than" in done.error
    assert (tmp_path / "model").exists()


def to_the_wrist(site: Site, output: Path) -> list[object]:
    """Arguments of `fit` with a tip before the last joint."""
    return ["wrist_link" if word == "flange" else word for word in site.fit(site.csv, output)]


def test_a_tip_before_the_last_joint(small_site: Site, command: Command, tmp_path: Path) -> None:
    done = command(*to_the_wrist(small_site, tmp_path / "model"))
    assert done.code == 1
    assert "the measurements do not fit this robot, even with geometric errors" in done.error
    assert "as the tip" in done.error
