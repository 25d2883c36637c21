"""Every mistake that a user makes with files and units: exit code 1 and one sentence that says what to do."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_bank import TABLE, Command, Site, make_site, run_process

import diffeo_calib as dc
from diffeo_calib.measurements.csv_files import write_measurements

pytestmark = pytest.mark.slow  # calibrations by the dozen

Edit = Callable[[list[list[str]]], object]


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    return Command(capsys, monkeypatch)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return make_site(tmp_path_factory.mktemp("site"), rows=30)


def edited(site: Site, path: Path, edit: Edit) -> Path:
    """A copy of the table after an edit of its cells, the header first."""
    cells = [line.split(";") for line in site.csv.read_text().splitlines()]
    changed = edit(cells)
    rows = changed if isinstance(changed, list) else cells
    path.write_text("".join(";".join(row) + "\n" for row in rows))
    return path


def set_cell(row: int, column: int, text: str) -> Edit:
    return lambda cells: cells[row].__setitem__(column, text)


def rows_of(*picked: int) -> Edit:
    return lambda cells: [cells[row] for row in picked]


BAD_TABLES: dict[str, tuple[Edit, str]] = {
    "nan": (set_cell(4, 2, "NaN"), r"line 5, column 'elbow_joint': expected a finite number, got 'NaN'; remove"),
    "infinite": (set_cell(4, 7, "-inf"), r"line 5, column 'my': expected a finite number, got '-inf'; remove"),
    "empty cell": (set_cell(4, 7, ""), r"line 5, column 'my': expected a finite number, got an empty cell"),
    "word": (set_cell(4, 7, "far"), r"line 5, column 'my': expected a number, got 'far'"),
    "missing column": (lambda cells: [row[:-1] for row in cells], r"header: no column \['mz'\]"),
    "misspelt column": (set_cell(0, 2, "elbow_jiont"), r"for 'elbow_joint', did you mean elbow_jiont"),
    "blank column": (set_cell(0, 2, ""), r"column 3 has no name"),
    "column twice": (set_cell(0, 2, "waist_joint"), r"\['waist_joint'\] named more than once"),
    "duplicated rows": (lambda cells: [*cells, cells[3]], r"line 32 repeats 4; real repeats differ by noise"),
    "header only": (rows_of(0), r"has a header but no rows: expected at least one row"),
    "empty": (rows_of(), r"is empty: expected a header and rows of numbers"),
    "ragged": (lambda cells: cells[6].pop(), r"line 7: expected 9 cells as in the header, got 8; repair"),
    "one row": (rows_of(0, 1), r"in 1 row.*|at least 2|2 distinct"),
    "two rows": (rows_of(0, 1, 2), r"at least 3 poses, got 1"),
}


@pytest.mark.parametrize("name", BAD_TABLES)
def test_bad_tables(name: str, site: Site, command: Command, tmp_path: Path) -> None:
    edit, message = BAD_TABLES[name]
    csv, output = edited(site, tmp_path / "bad.csv", edit), tmp_path / "model.safetensors"
    done = command(*site.fit(csv, output))
    assert done.code == 1
    assert re.search(message, done.error), done.error
    assert not output.exists()
    assert done.out == ""


@pytest.mark.parametrize("rows", [1, 2])
def test_too_few_rows_without_holding_any_out(rows: int, site: Site, command: Command, tmp_path: Path) -> None:
    csv = edited(site, tmp_path / "bad.csv", rows_of(*range(rows + 1)))
    done = command(*site.fit(csv, tmp_path / "model", "--holdout", 0))
    assert done.code == 1
    assert f"at least 3 poses, got {rows}" in done.error
    assert "measure more poses" in done.error


def test_shuffled_rows(site: Site, command: Command, tmp_path: Path) -> None:
    """Points paired with other rows' joints: what a sorted spreadsheet column does."""

    def shuffle(cells: list[list[str]]) -> list[list[str]]:
        order = np.random.default_rng(0).permutation(len(cells) - 1) + 1
        return [cells[0], *(cells[i + 1][:6] + cells[j][6:] for i, j in enumerate(order))]

    done = command(*site.fit(edited(site, tmp_path / "bad.csv", shuffle), tmp_path / "model"))
    assert done.code == 1
    assert "the measurements do not fit this robot" in done.error
    assert "rows pair joints with their own points" in done.error


# --- options that do not match the file -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "units",
    [
        (("mm", "deg"), ("mm", "rad"), "look like degrees", "angle unit"),
        (("mm", "rad"), ("mm", "deg"), "look like radians", "angle unit"),
        (("mm", "deg"), ("m", "deg"), "look like millimetres", "length unit"),
        (("m", "deg"), ("mm", "deg"), "look like metres", "length unit"),
    ],
)
def test_wrong_units(units: tuple[Any, ...], site: Site, command: Command, tmp_path: Path) -> None:
    position = ["mx", "my", "mz"]
    (length, angle), options, warning, message = units
    write_measurements(
        tmp_path / "t.csv", site.data, length=length, angle=angle, sep=";", decimal=",", position=position
    )
    done = command(*site.fit(tmp_path / "t.csv", tmp_path / "model", "--length", options[0], "--angle", options[1]))
    assert done.code == 1
    assert len(done.warnings) == 1
    assert warning in done.warnings[0]
    assert message in done.error
    if "length" in message:
        assert "the measured points do not have the robot's size" in done.error
    assert not (tmp_path / "model").exists()


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
        (["--base", "flange", "--tip", "base_link"], r"link 'base_link' is not below 'flange'"),
        (["--base", "output_link"], r"no moving joint from 'output_link' to 'flange'"),
        (["--joints", "waist_joint,shoulder_joint"], r"expected 2, got 6"),
        (["--joints", "a,b,c,d,e,f"], r"no column \['a', 'b', 'c', 'd', 'e', 'f'\]"),
        (["--robot", "nowhere.urdf"], r"there is no file 'nowhere.urdf'; check the path of the URDF"),
    ],
)
def test_wrong_options(options: list[str], message: str, site: Site, command: Command, tmp_path: Path) -> None:
    given = site.fit(site.csv, tmp_path / "model")
    if "--position" in options:  # a list option: a second one would be a second marker
        at = given.index("--position")
        given = given[:at] + given[at + 2 :]
    done = command(*given, *options)
    assert done.code == 1
    assert re.search(message, done.error), done.error
    assert not (tmp_path / "model").exists()


def test_many_columns_are_cut_short(site: Site, command: Command, tmp_path: Path) -> None:
    many = [f"extra{k}" for k in range(40)]
    csv = edited(site, tmp_path / "t.csv", lambda cells: [cells[0] + many, *(row + ["0"] * 40 for row in cells[1:])])
    at = (given := site.fit(csv, tmp_path / "model")).index("--position")
    done = command(*given[:at], *given[at + 2 :], "--position", "mx,my,height")
    assert done.code == 1
    assert "got the columns ['waist_joint', " in done.error
    assert "'extra2' and 37 more]; " in done.error
    assert "extra3" not in done.error


ROTATION = ["--rotation", "a,b,c", "--convention", "xyz", "--rotation-angle", "deg"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--rotation", "a,b,c"], r"--rotation is given, but its --convention is not: expected 'rotvec'"),
        (ROTATION[:4], r"--rotation-angle is missing: the unit of the rotation: expected 'rad' or 'deg'"),
        (ROTATION[2:], r"--convention and --rotation-angle without --rotation"),
        ([*ROTATION[:2], "--convention", "euler"], r"--convention: expected 'rotvec'.* got 'euler'"),
        ([*ROTATION, "--rotation", "a,b"], r"--rotation: expected 3 names of columns for 'xyz', got \['a', 'b'\]"),
        ([*ROTATION, "--convention", "matrix"], r"--rotation: expected 9 names of columns for 'matrix'"),
        (ROTATION, r"no column \['a', 'b', 'c'\]"),
        ([*ROTATION, "--rotation", "mx,my,waist_joint"], r"the named columns: expected distinct columns"),
        ([*ROTATION, "--rotation", "i,j,k", "--rotation-angle", "rad"], r"do not fit this robot"),
        (["--lever", "100"], r"--lever without --rotation"),
        (["--rotation-std", "a,b,c"], r"--rotation-std without --rotation"),
        (["--std", "a,b"], r"--std: expected names of columns: one, one per marker or three per marker"),
        (["--std", "s"], r"no column \['s'\]"),
        (["--std", "k"], r"line 2, column 'k': expected a positive standard deviation, got 0 "),
        (
            ["--rotation", "i,j,k,l", "--convention", "quat_xyzw"],
            r"line 2, columns i, j, k, l: .*quaternion",
        ),
        ([*ROTATION, "--rotation", "i,j,k", "--lever", "-5"], r"`lever`.*above 0, got -0.005"),
    ],
)
def test_wrong_rotations(options: list[str], message: str, site: Site, command: Command, tmp_path: Path) -> None:
    csv = edited(site, tmp_path / "t.csv", lambda cells: [cells[0] + list("ijkl"), *([*r, *"7908"] for r in cells[1:])])
    done = command(*site.fit(csv, tmp_path / "model", *options))
    assert done.code == 1
    assert re.search(message, done.error), done.error
    assert not (tmp_path / "model").exists()


def test_rotations_in_the_wrong_unit_are_doubted(site: Site, command: Command, tmp_path: Path) -> None:
    csv = edited(site, tmp_path / "t.csv", lambda cells: [cells[0] + list("ijk"), *([*r, *"123"] for r in cells[1:])])
    done = command("fit", csv, *site.fit(csv, tmp_path / "model")[2:], *ROTATION, "--rotation", "i,j,k", "--lever", "0")
    assert done.code == 1
    assert "rotations reach only 3 deg" in done.warnings[0]
    assert "pass --rotation-angle 'rad'" in done.warnings[0]


def test_rotations_for_a_model_of_points(site: Site, sound: bytes, command: Command, tmp_path: Path) -> None:
    (tmp_path / "model").write_bytes(sound)
    csv = edited(site, tmp_path / "t.csv", lambda cells: [cells[0] + list("ijk"), *([*r, *"789"] for r in cells[1:])])
    done = command("evaluate", tmp_path / "model", csv, *TABLE, *ROTATION, "--rotation", "i,j,k")
    assert done.code == 1
    assert "calibrated with points: expected measured points, got poses" in done.error
    for option in (["--convention", "rotvec"], ["--rotation-angle", "deg"]):
        done = command("predict", tmp_path / "model", csv, *TABLE[2:], *option, "-o", tmp_path / "p.csv")
        assert done.code == 1
        assert "this model has none" in done.error
        assert not (tmp_path / "p.csv").exists()


def test_joints_of_another_chain(site: Site, command: Command, tmp_path: Path) -> None:
    """Six columns for the five joints that lead to the wrong tip."""
    names = ",".join(site.arm.nominal.joint_names)
    done = command(*site.fit(site.csv, tmp_path / "model", "--tip", "wrist_link", "--joints", names))
    assert done.code == 1
    assert "expected 6, got 5" in done.error


def test_a_tip_before_the_last_joint(site: Site, command: Command, tmp_path: Path) -> None:
    done = command(*site.fit(site.csv, tmp_path / "model", "--tip", "wrist_link"))
    assert done.code == 1
    assert "the measurements do not fit this robot, even with geometric errors" in done.error
    assert "the tip link" in done.error


@pytest.mark.parametrize(("by", "words"), [(1, "one row too late"), (-1, "one row too early")])
def test_points_shifted_by_one_row(by: int, words: str, site: Site, command: Command, tmp_path: Path) -> None:
    def shift(cells: list[list[str]]) -> list[list[str]]:
        rows = cells[1:]
        return [cells[0], *(row[:6] + rows[(k - by) % len(rows)][6:] for k, row in enumerate(rows))]

    done = command(*site.fit(edited(site, tmp_path / "bad.csv", shift), tmp_path / "model", "--holdout", 0))
    assert done.code == 1
    assert f"the points seem to be {words}: pair every configuration with its own" in done.error


@pytest.mark.parametrize("column_order", ["1,0,2,3,4,5", "0,1,2,3,5,4", "0,2,1,3,4,5"])
def test_joint_columns_in_another_order(column_order: str, site: Site, command: Command, tmp_path: Path) -> None:
    names = site.arm.nominal.joint_names
    wrong = ",".join(names[int(i)] for i in column_order.split(","))
    done = command(*site.fit(site.csv, tmp_path / "model", "--joints", wrong))
    assert done.code == 1
    assert "order of the joints" in done.error


@pytest.mark.parametrize(
    "content", ["", "<robot", "<sdf></sdf>", "not xml", '<robot name="r"><link name="a"/></robot>']
)
def test_bad_urdf(content: str, site: Site, command: Command, tmp_path: Path) -> None:
    (tmp_path / "bad.urdf").write_text(content)
    done = command(*site.fit(site.csv, tmp_path / "model", "--robot", tmp_path / "bad.urdf"))
    assert done.code == 1
    assert "bad.urdf" in done.error


def test_missing_table(site: Site, command: Command, tmp_path: Path) -> None:
    done = command(*site.fit(tmp_path / "nowhere.csv", tmp_path / "model"))
    assert done.code == 1
    assert "nowhere.csv' does not exist" in done.error
    done = command(*site.fit(tmp_path, tmp_path / "model"))
    assert done.code == 1
    assert "cannot be opened" in done.error


def test_brackets_in_names_are_shown(site: Site, command: Command, tmp_path: Path) -> None:
    """Rich takes [red] for markup; a file or column of that name must still be named."""
    done = command(*site.fit(tmp_path / "[red]x[/].csv", tmp_path / "model"))
    assert done.code == 1
    assert "[red]x[/].csv" in done.error


# --- models -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sound(site: Site) -> bytes:
    path = site.folder / "sound.safetensors"
    with pytest.warns(dc.DiffeoCalibWarning, match="10 poses are too few"):
        dc.save(dc.calibrate(site.arm.nominal, site.data.rows(slice(10))).model, path)
    return path.read_bytes()


@pytest.mark.parametrize("action", ["evaluate", "predict"])
def test_bad_models(action: str, site: Site, sound: bytes, command: Command, tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    table = TABLE if action == "evaluate" else [*TABLE[2:], "-o", str(tmp_path / "p.csv")]
    for content, message in (
        (None, "there is no model file"),
        (sound[:-100], "damaged or cut short"),
        (sound[:-1] + bytes([sound[-1] ^ 1]), "checksum does not match"),
        (sound.replace(b'\\"rows\\": 10', b'\\"rows\\": 99'), "checksum does not match"),
        (site.csv.read_bytes(), "cannot be read as a model file"),
        (b"", "cannot be read as a model file"),
    ):
        if content is not None:
            assert content != sound
            path.write_bytes(content)
        done = command(action, path, site.csv, *table)
        assert done.code == 1
        assert message in done.error
        assert not (tmp_path / "p.csv").exists()


def test_a_model_of_a_plain_function(site: Site, command: Command, tmp_path: Path) -> None:
    x = np.random.default_rng(0).uniform(-1, 1, (6, 2))
    kernels = dc.VonMises(1.0), dc.Gaussian(1.0)
    problem = dc.Problem(lambda q: q * 1.0, x, x + 0.01, noise=0.01, joint_kernel=kernels[0], task_kernel=kernels[1])
    dc.save(dc.fit(problem).model, tmp_path / "plain.safetensors")
    done = command("evaluate", tmp_path / "plain.safetensors", site.csv, *TABLE)
    assert done.code == 1
    assert "plain function" in done.error


def test_a_model_s_joints_missing_in_the_table(site: Site, sound: bytes, command: Command, tmp_path: Path) -> None:
    (tmp_path / "model").write_bytes(sound)
    csv = edited(site, tmp_path / "bad.csv", set_cell(0, 5, "wrist_rol_joint"))
    done = command("evaluate", tmp_path / "model", csv, *TABLE)
    assert done.code == 1
    assert "did you mean wrist_rol_joint" in done.error
    done = command("evaluate", tmp_path / "model", site.csv, *TABLE, "--joints", "waist_joint")
    assert done.code == 1
    assert "expected 1, got 6" in done.error


PLACES = [("none/file.png", "cannot be written, there is no folder"), ("here.png", "is a folder: expected the name of")]


@pytest.mark.parametrize("case", PLACES)
def test_predictions_that_cannot_be_written(
    case: tuple[str, str], site: Site, sound: bytes, command: Command, tmp_path: Path
) -> None:
    place, message = case
    (tmp_path / "model").write_bytes(sound)
    (tmp_path / "here.png").mkdir()
    done = command("predict", tmp_path / "model", site.csv, *TABLE[2:], "-o", tmp_path / place)
    assert done.code == 1
    assert f"-o {tmp_path / place} {message}" in done.error


@pytest.mark.parametrize("case", [(option, *place) for option in ("-o", "--figure") for place in PLACES])
def test_places_are_looked_at_before_the_fit(
    case: tuple[str, str, str], site: Site, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    option, place, message = case
    monkeypatch.setattr("diffeo_calib.cli.main.load_urdf", lambda *_, **__: pytest.fail("the work has begun"))
    (tmp_path / "here.png").mkdir()
    done = command(*site.fit(site.csv, tmp_path / "model"), option, tmp_path / place)
    assert done.code == 1
    assert f"{option} {tmp_path / place} {message}" in done.error


def test_a_model_that_cannot_be_written(site: Site, command: Command, tmp_path: Path) -> None:
    csv = edited(site, tmp_path / "t.csv", rows_of(*range(12)))
    done = command(*site.fit(csv, tmp_path / "none" / "model", "--holdout", 0))
    assert done.code == 1
    assert "cannot be written" in done.error


def test_the_place_of_the_model_is_looked_at_before_the_fit(
    site: Site, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("diffeo_calib.cli.main.calibrate", lambda *_, **__: pytest.fail("the fit has begun"))
    done = command(*site.fit(site.csv, tmp_path / "none" / "model"))
    assert done.code == 1


@pytest.mark.parametrize("figure", ["errors.xyz", "none/errors.png"])
def test_a_figure_that_cannot_be_written(figure: str, site: Site, command: Command, tmp_path: Path) -> None:
    csv = edited(site, tmp_path / "t.csv", rows_of(*range(12)))
    done = command(*site.fit(csv, tmp_path / "model", "--holdout", 0, "--figure", tmp_path / figure))
    assert done.code == 1
    assert "errors" in done.error


# --- the same in a real process -----------------------------------------------------------------------------------


def test_a_real_process_says_one_warning_and_one_sentence(site: Site, tmp_path: Path) -> None:
    done = run_process(*site.fit(site.csv, tmp_path / "model", "--length", "m"))
    assert done.code == 1
    assert len(done.warnings) == 1
    assert "the measured points do not have the robot's size" in done.error


@pytest.mark.slow
def test_a_real_process_used_wrongly() -> None:
    done = run_process("fit", "--surprise")
    assert done.code == 2
    assert "Traceback" not in done.err
