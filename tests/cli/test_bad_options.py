"""Options that do not match the file, and tables with mistakes: exit code 1 and one sentence that says what to do."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from command_bank import ROTATION, TABLE, Command, Edit, Site, edited, rows_of, set_cell

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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--rotation", "a,b,c"], r"--rotation is given, but its --convention is not: expected 'rotvec'"),
        (ROTATION[:4], r"--rotation-angle is missing: the unit of the rotation: expected 'rad' or 'deg'"),
        (["--rotation", "i,j,k", *ROTATION[2:4], "--rotation-angle", "rad"], r"do not fit this robot"),
        (["--lever", "100"], r"--lever without --rotation"),
        (["--rotation-std", "a,b,c"], r"--rotation-std without --rotation"),
        (["--std", "a,b"], r"--std: expected names of columns: one, one per marker or three per marker"),
        (["--rotation", "i,j,k", *ROTATION[2:], "--lever", "-5"], r"`lever`.*above 0, got -0.005"),
    ],
)
def test_wrong_rotations(options: list[str], message: str, small_site: Site, command: Command, tmp_path: Path) -> None:
    csv = edited(
        small_site, tmp_path / "t.csv", lambda cells: [cells[0] + list("ijkl"), *([*r, *"7908"] for r in cells[1:])]
    )
    done = command(*small_site.fit(csv, tmp_path / "model", *options))
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


BAD_TABLES: dict[str, tuple[Edit, str]] = {
    "word": (set_cell(4, 7, "far"), r"line 5, column 'my': expected a number, got 'far'"),
    "misspelt column": (set_cell(0, 2, "elbow_jiont"), r"for 'elbow_joint', did you mean elbow_jiont"),
    "duplicated rows": (lambda cells: [*cells, cells[3]], r"line 32 repeats 4; real repeats differ by noise"),
    "one row": (rows_of(0, 1), r"in 1 row.*|at least 2|2 distinct"),
    "two rows": (rows_of(0, 1, 2), r"at least 3 poses, got 1"),
}


@pytest.mark.parametrize("name", BAD_TABLES)
def test_bad_tables(name: str, small_site: Site, command: Command, tmp_path: Path) -> None:
    edit, message = BAD_TABLES[name]
    csv, output = edited(small_site, tmp_path / "bad.csv", edit), tmp_path / "model.safetensors"
    done = command(*small_site.fit(csv, output))
    assert done.code == 1
    assert re.search(message, done.error), done.error
    assert not output.exists()
    assert done.out == ""


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


@pytest.mark.parametrize("column_order", ["1,0,2,3,4,5", "0,1,2,3,5,4", "0,2,1,3,4,5"])
def test_joint_columns_in_another_order(column_order: str, small_site: Site, command: Command, tmp_path: Path) -> None:
    names = small_site.arm.nominal.joint_names
    wrong = ",".join(names[int(i)] for i in column_order.split(","))
    done = command(*small_site.fit(small_site.csv, tmp_path / "model", "--joints", wrong))
    assert done.code == 1
    assert "names the robot's joints in another order than the robot's" in done.error


def test_missing_table(small_site: Site, command: Command, tmp_path: Path) -> None:
    done = command(*small_site.fit(tmp_path / "nowhere.csv", tmp_path / "model"))
    assert done.code == 1
    assert "there is no file" in done.error
    assert "nowhere.csv" in done.error
    done = command(*small_site.fit(tmp_path, tmp_path / "model"))
    assert done.code == 1
    assert "is a folder: expected a table" in done.error
