"""Tables with every kind of mistake: exit code 1 and one sentence that says what to do."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from command_bank import Command, Edit, Site, edited, rows_of, set_cell

pytestmark = pytest.mark.slow  # calibrations by the dozen


BAD_TABLES: dict[str, tuple[Edit, str]] = {
    "nan": (set_cell(4, 2, "NaN"), r"line 5, column 'elbow_joint': expected a finite number, got 'NaN'; remove"),
    "infinite": (set_cell(4, 7, "-inf"), r"line 5, column 'my': expected a finite number, got '-inf'; remove"),
    "empty cell": (set_cell(4, 7, ""), r"line 5, column 'my': expected a finite number, got an empty cell"),
    "word": (set_cell(4, 7, "far"), r"line 5, column 'my': expected a number, got 'far'"),
    "missing column": (lambda cells: [row[:-1] for row in cells], r"header: no column \['mz'\]"),
    "misspelt column": (set_cell(0, 2, "elbow_jiont"), r"for 'elbow_joint', did you mean elbow_jiont"),
    "blank column": (set_cell(0, 2, ""), r"no column \['elbow_joint'\]: got the columns .*, '',"),
    "column twice": (set_cell(0, 2, "waist_joint"), r"no column \['elbow_joint'\]: got the columns"),
    "duplicated rows": (lambda cells: [*cells, cells[3]], r"line 32 repeats 4; real repeats differ by noise"),
    "header only": (rows_of(0), r"has a header but no rows: expected at least one row"),
    "empty": (rows_of(), r"is empty: expected a header and rows of numbers"),
    "ragged": (lambda cells: cells[6].pop(), r"line 7: expected 9 cells as in the header, got 8; repair"),
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
