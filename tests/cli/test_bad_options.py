"""Options that do not match the file: exit code 1 and one sentence that says what to do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from command_bank import ROTATION, TABLE, Command, Site, edited

pytestmark = pytest.mark.slow  # calibrations by the dozen


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--decimal", "."], r"looks like a decimal comma: pass --decimal ','"),
        (["--sep", ",", "--decimal", "."], r"single column .*; pass --sep ';'"),
        (["--sep", ","], r"`sep` and `decimal`: expected different characters.*--sep ';'"),
        (["--sep", ";;"], r"`sep`: expected one character"),
        (["--decimal", "x"], r"`decimal`: expected '\.' or ','"),
        (["--duplicates", "ignore"], r"`duplicates`: expected 'error' or 'keep' or 'drop'"),
        (["--position", "mx,my,height"], r"no column \['height'\]"),
        (["--tip", "hand"], r"no link 'hand'.*its links are base_link, .*flange"),
        (["--tip", "flnage"], r"did you mean 'flange'"),
        (["--tip", "flange", "--tip", "wrist_link"], r"--tip: expected 1, one for each --position, got 2"),
        (["--base", "output_link"], r"no moving joint from 'output_link' to 'flange'"),
        (["--joints", "waist_joint,shoulder_joint"], r"expected 6 columns, in the order .*, got 2"),
        (["--joints", "a,b,c,d,e,f"], r"no column \['a', 'b', 'c', 'd', 'e', 'f'\]"),
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
        (ROTATION[2:], r"--convention and --rotation-angle without --rotation"),
        ([*ROTATION[:2], "--convention", "euler"], r"--convention: expected 'rotvec'.* got 'euler'"),
        (["--rotation", "a,b", *ROTATION[2:]], r"--rotation: expected 3 names of columns for 'xyz', got \['a', 'b'\]"),
        ([*ROTATION, "--convention", "matrix"], r"--rotation: expected 9 names of columns for 'matrix'"),
        (ROTATION, r"no column \['a', 'b', 'c'\]"),
        (["--rotation", "mx,my,waist_joint", *ROTATION[2:]], r"the named columns: expected distinct columns"),
        (["--rotation", "i,j,k", *ROTATION[2:4], "--rotation-angle", "rad"], r"do not fit this robot"),
        (["--lever", "100"], r"--lever without --rotation"),
        (["--rotation-std", "a,b,c"], r"--rotation-std without --rotation"),
        (["--std", "a,b"], r"--std: expected names of columns: one, one per marker or three per marker"),
        (["--std", "s"], r"no column \['s'\]"),
        (["--std", "k"], r"line 2, column 'k'.*: expected a positive standard deviation, got '0'"),
        (["--rotation", "i,j,k,l", "--convention", "quat_xyzw"], r"line 2, columns i, j, k, l: .*quaternion"),
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
