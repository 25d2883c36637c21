"""Wrong usage, options and tables with mistakes, broken files: an exit code and one sentence that says what to do."""

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from command_bank import ROTATION, TABLE, Command, Edit, Site, edited, rows_of

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat


@pytest.mark.parametrize(
    "words",
    [
        "fit",
        "nonsense",
        "evaluate m t.csv --position x,y,z --length km --angle rad",
        "evaluate m t.csv --position x,y,z --length m --angle rad --surprise",
        "fit t.csv --holdout 1.5",
        "evaluate m t.csv --position x,y,z --length m --angle rad --rotation-angle turn",
        "demo --count 3",
    ],
)
def test_wrong_usage_is_exit_2(words: str, command: Command) -> None:
    done = command(*words.split())
    assert done.code == 2
    assert "Traceback" not in done.err
    assert "Usage" in done.err


def test_unconverged_is_exit_3(site: Site, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_measurements(tmp_path / "t.csv", site.data.rows(slice(11)), TableFormat("m", "rad"))
    monkeypatch.setattr("diffeo_calib.calibration.calibrate.GaussNewton", partial(dc.GaussNewton, max_iterations=1))
    path = tmp_path / "early.safetensors"
    table = ["--position", "x,y,z", "--length", "m", "--angle", "rad"]
    done = command("fit", tmp_path / "t.csv", *site.robot(), *table, "-o", path, "--holdout", 0)
    assert done.code == 3
    assert "stopped at the limit of 1 iterations; judge it by held-out errors" in done.out
    assert "max_iterations" not in done.out
    assert any("11 poses are too few to select scales" in warning for warning in done.warnings)
    assert isinstance(dc.load(path), dc.CalibratedKinematics)


def turned(cells: list[list[str]]) -> list[list[str]]:
    """With columns of rotations, which are all the same."""
    return [cells[0] + list("ijkl"), *([*row, *"7908"] for row in cells[1:])]


def as_written(cells: list[list[str]]) -> list[list[str]]:
    return cells


def given(*words: str, edit: Edit = as_written) -> tuple[Sequence[str], Edit]:
    return words, edit


REFUSED = {
    r"--sep and --decimal: expected different characters.*--sep ';'": given("--sep", ","),
    r"no link 'hand'.*its links are base_link, .*flange": given("--tip", "hand"),
    r"--position: .* in one way, got x, y and z and zenith_gon": given("--position", "zenith_gon=x,y,z"),
    r"--tip: expected 1, one for each --position, got 2": given("--tip", "flange", "--tip", "wrist_link"),
    r"no moving joint from 'output_link' to 'flange'": given("--base", "output_link"),
    r"do not fit this robot, even with geometric errors.* as the tip": given("--tip", "wrist_link"),
    r"expected 6 columns, in the order .*, got 2": given("--joints", "waist_joint,shoulder_joint"),
    r"in another order: expected waist_joint,.*leave it out: columns that are named after": given(
        "--joints", "shoulder_joint,waist_joint,elbow_joint,forearm_roll_joint,wrist_bend_joint,wrist_roll_joint"
    ),
    r"there is no file nowhere.urdf; check the path of --robot": given("--robot", "nowhere.urdf"),
    r"--rotation is given, but its --convention is not: expected 'rotvec'": given("--rotation", "a,b,c", edit=turned),
    r"--rotation-angle is missing: expected 'rad'": given(*ROTATION[:4], edit=turned),
    r"--lever without --rotation": given("--lever", "100"),
    r"--std: expected names of columns: one, one per marker or three per": given("--std", "a,b"),
    r"in 1 row.*|at least 2|2 distinct": given(edit=rows_of(0, 1)),
    r"at least 3 poses, got 2.*measure more poses": given("--holdout", "0", edit=rows_of(0, 1, 2)),
}
"""What is said -> options, and an edit of the table."""


@pytest.mark.parametrize("message", REFUSED)
def test_what_fit_refuses(message: str, small_site: Site, command: Command, tmp_path: Path) -> None:
    options, edit = REFUSED[message]
    words = small_site.fit(edited(small_site, tmp_path / "t.csv", edit), tmp_path / "model")
    if "--tip" in options:  # a second one would be a second marker
        at = words.index("--tip")
        words = words[:at] + words[at + 2 :]
    done = command(*words, *options)
    assert done.code == 1
    assert re.search(message, done.error), done.error
    assert done.out == "" or "tip" in message
    assert "tip" in message or not (tmp_path / "model").exists()


@pytest.mark.slow
def test_models_that_do_not_belong_to_a_table(small_site: Site, sound: bytes, command: Command, tmp_path: Path) -> None:
    model, csv, out = tmp_path / "model.safetensors", small_site.csv, ["-o", tmp_path / "p.csv"]
    x = np.random.default_rng(0).uniform(-1, 1, (6, 2))
    kernels = dc.VonMises(1.0), dc.Gaussian(1.0)
    problem = dc.Problem(lambda q: q * 1.0, x, x + 0.01, noise=0.01, joint_kernel=kernels[0], task_kernel=kernels[1])
    dc.save(dc.fit(problem).model, tmp_path / "plain.safetensors")
    poses = edited(small_site, tmp_path / "t.csv", turned)
    turns = ["--rotation", "i,j,k", *ROTATION[2:]]
    whole = sound, (tmp_path / "plain.safetensors").read_bytes()
    for content, words, message in (
        (b"", ["evaluate", small_site.urdf, csv, *TABLE], "it is a URDF; pass a file written by"),
        (whole[1], ["evaluate", model, csv, *TABLE], "plain function"),
        (whole[0], ["evaluate", model, csv, *TABLE, "--joints", "waist_joint"], "expected 6 columns, in the order"),
        (whole[0], ["evaluate", model, poses, *TABLE, *turns], "with points: expected measured points, got poses"),
        (whole[0], ["predict", model, csv, *TABLE[2:], "--convention", "rotvec", *out], "this model has none"),
        (whole[0], ["predict", model, csv, *TABLE[2:], "--rotation-angle", "deg", *out], "this model has none"),
    ):
        model.write_bytes(content)
        assert message in command.failed(*words)
        assert not (tmp_path / "p.csv").exists()


def test_outputs_are_checked_before_the_fit(small_site: Site, command: Command, tmp_path: Path) -> None:
    command.monkeypatch.setattr("diffeo_calib.cli.models.robot_of", lambda *_: pytest.fail("the work has begun"))
    (tmp_path / "here.png").mkdir()
    for option in ("-o", "--report"):
        for place, message in (("none/file.png", "No such file or directory"), ("here.png", "Is a directory")):
            done = command(*small_site.fit(small_site.csv, tmp_path / "model"), option, tmp_path / place)
            assert done.code == 1
            assert f"file '{tmp_path / place}' cannot be written ({message})" in done.error
