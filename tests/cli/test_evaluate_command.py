"""`diffeo-calib evaluate`, with --free too, and `predict`; what they say about a model's origin."""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from command_bank import FORMAT, POSITION, TABLE, Command, Outcome, Site
from kind_bank import UNITS, kind_named
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.cli.printed import registration_lines
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.poses import angle_between, rotation_matrices
from diffeo_calib.robots.se3 import twist_transform


def test_evaluate(fitted: Outcome, site: Site, model: dc.CalibratedKinematics, command: Command) -> None:
    assert fitted.code == 0
    done = command("evaluate", site.folder / "model.safetensors", site.csv, *TABLE)
    assert (done.code, done.err.strip()) == (0, "")
    train, test = site.data.split(0.7, seed=0)
    for label, data in (("40 in all", site.data), ("28 used in the fit", train), ("12 not used in the fit", test)):
        found = dc.evaluate(model, data)
        expected = [1e3 * value for value in (found.rms, found.median, found.p95, found.max)]
        assert done.numbers(label) == pytest.approx(expected, abs=1.01e-4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--length", "m"], "1000 times too large: check their unit (--length)"),
        (["--position", "my,mx,mz"], "left-handed: exchange two position columns"),
    ],
)
def test_errors_that_no_robot_has_are_exit_1(
    options: list[str], words: str, fitted: Outcome, site: Site, command: Command
) -> None:
    """A wrong unit, a left-handed frame: no table, and one sentence that names the mistake."""
    assert fitted.code == 0
    table = TABLE[2:] if "--position" in options else TABLE
    done = command("evaluate", site.folder / "model.safetensors", site.csv, *table, *options)
    assert done.code == 1
    assert "in all" not in done.out
    assert words in done.error


def test_absurd_errors_without_a_known_mistake_are_printed(
    fitted: Outcome, site: Site, command: Command, tmp_path: Path
) -> None:
    """Joints and positions of different rows."""
    assert fitted.code == 0
    points = site.data.points[torch.randperm(len(site.data), generator=torch.Generator().manual_seed(0))]
    csv = with_points(site, tmp_path / "shuffled.csv", points)
    done = command("evaluate", site.folder / "model.safetensors", csv, *TABLE)
    assert done.code == 1
    assert "40 in all" in done.out
    assert done.error.startswith("error: these errors are not those of a calibrated robot")


def with_points(site: Site, path: Path, points: Tensor) -> Path:
    """The table with other positions."""
    data = dc.Measurements(site.data.q, points, site.data.joint_names, doubt=False)
    write_measurements(path, data, FORMAT, position=["mx", "my", "mz"])
    return path


def test_rows_that_repeat_those_of_the_fit_are_said(
    fitted: Outcome, site: Site, command: Command, tmp_path: Path
) -> None:
    """The table of the fit again, and a copy with fewer digits, but not rows of other poses."""
    assert fitted.code == 0
    model, (train, test) = site.folder / "model.safetensors", site.data.split(0.7, seed=0)
    for data, repeated in (
        (train, True),
        (dc.Measurements(train.q.round(decimals=4), train.points), True),
        (test, False),
    ):
        named = dc.Measurements(data.q, data.points, site.data.joint_names, doubt=False)
        write_measurements(tmp_path / "t.csv", named, FORMAT, position=["mx", "my", "mz"])
        done = command("evaluate", model, tmp_path / "t.csv", *TABLE)
        assert ("rows repeat joint values of the fit" in " ".join(done.out.split())) == repeated


def test_wrong_rows_are_named(fitted: Outcome, site: Site, command: Command, tmp_path: Path) -> None:
    """One alone, and a block with its cause; the exit code is 0, since most rows are right."""
    assert fitted.code == 0
    points = site.data.points.clone()
    points[3] += 0.05
    points[30:] += torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64)
    path = with_points(site, tmp_path / "t.csv", points)
    done = command("evaluate", site.folder / "model.safetensors", path, *TABLE)
    assert done.code == 0
    assert "11 of 40 rows look wrong (numbers are lines of the file):" in done.out
    (warning,) = done.warnings
    assert "10 rows look wrong that follow one another: lines 32 to 41 to the end of the table" in warning
    assert "moving the measuring device by 200 mm" in warning


def test_predict(fitted: Outcome, site: Site, model: dc.CalibratedKinematics, command: Command, tmp_path: Path) -> None:
    assert fitted.code == 0
    table = [option for option in TABLE if option not in ("--position", "mx,my,mz")]
    done = command("predict", site.folder / "model.safetensors", site.csv, *table, "-o", tmp_path / "p.csv")
    assert (done.code, done.err.strip()) == (0, "")
    assert "40 predictions written" in done.out
    header, *rows = (tmp_path / "p.csv").read_text().splitlines()
    assert header.split(";") == [*site.arm.nominal.joint_names, "x", "y", "z", "std_x", "std_y", "std_z"]
    values = np.array([[float(cell.replace(",", ".")) for cell in row.split(";")] for row in rows])
    mean, covariance = model.predict(site.data.q)
    deviations = np.sqrt(np.diagonal(covariance[:, 0].numpy(), axis1=1, axis2=2))
    np.testing.assert_allclose(values[:, :6], np.rad2deg(site.data.q.numpy()), rtol=1e-14)
    np.testing.assert_allclose(values[:, 6:9], 1e3 * mean[:, 0].numpy(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(values[:, 9:], 1e3 * deviations, rtol=1e-6)


def test_blocks_do_not_change_predictions_or_errors(
    fitted: Outcome, site: Site, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert fitted.code == 0
    path, names = site.folder / "model.safetensors", ("whole.csv", "blocks.csv")
    printed = []
    for name, rows in zip(names, (2048, 7), strict=True):
        monkeypatch.setattr("diffeo_calib.cli.commands.evaluate.ROWS_AT_ONCE", rows)
        assert command("predict", path, site.csv, *TABLE[2:], "-o", tmp_path / name).code == 0
        printed.append(command("evaluate", path, site.csv, *TABLE).out)
    whole, blocks = (
        np.loadtxt((tmp_path / name).read_text().replace(",", ".").splitlines(), delimiter=";", skiprows=1)
        for name in names
    )
    assert whole.shape == (40, 12)
    np.testing.assert_allclose(blocks, whole, rtol=1e-9)
    assert printed[0] == printed[1]


def test_an_acceptance_limit_has_an_exit_code(fitted: Outcome, site: Site, command: Command) -> None:
    assert fitted.code == 0
    arguments = ["evaluate", site.folder / "model.safetensors", site.csv, *TABLE, "--tolerance"]
    rms = command(*arguments, "1m").numbers("12 not used in the fit")[0]
    done = command(*arguments, f"{1.01 * rms:.6f} mm")
    assert done.code == 0
    assert f"RMS {rms:.4f} mm on 12 rows not used in the fit: within the limit of " in done.out
    done = command(*arguments, f"{990 * rms:.3f}um")
    assert done.code == 4
    assert "above the limit of" in done.out
    for wrong in ("0.1", "-1mm", "nanmm", "mm", "1 inch", "0m"):
        assert "--tolerance" in command(*arguments, wrong).error


def test_residuals_of_every_row(
    fitted: Outcome, site: Site, model: dc.CalibratedKinematics, command: Command, tmp_path: Path
) -> None:
    assert fitted.code == 0
    path = tmp_path / "residuals.csv"
    done = command("evaluate", site.folder / "model.safetensors", site.csv, *TABLE, "-o", path)
    assert done.code == 0
    assert f"residuals: {path}" in done.out
    header, *lines = path.read_text().splitlines()
    assert header == "line;used_in_fit;kind;device;marker;dx;dy;dz;size;unit"
    rows = [line.replace(",", ".").split(";") for line in lines]
    assert {(row[2], row[-1]) for row in rows} == {("position", "mm")}
    cells = np.array([[float(row[column]) for column in (0, 1, 5, 6, 7, 8)] for row in rows])
    assert cells[:, 0].astype(int).tolist() == list(range(2, 42))
    assert cells[:, 1].sum() == 28
    away = 1e3 * (site.data.points - model(site.data.q)).flatten(1).numpy()
    np.testing.assert_allclose(cells[:, 2:5], away, atol=2e-4)
    np.testing.assert_allclose(cells[:, 5], np.linalg.norm(cells[:, 2:5], axis=1), rtol=1e-12)
    refused = command("evaluate", site.folder / "model.safetensors", *TABLE[2:])
    assert "--length without CSV" in refused.error
    refused = command("evaluate", site.folder / "model.safetensors")
    assert "write a page about the rows of the fit by --report" in refused.error


NOTE = "arm 7 [left], spring check; serial 4711 é"


@pytest.mark.slow
@pytest.mark.usefixtures("given_scales")
def test_a_note_travels_with_the_model(site: Site, command: Command, tmp_path: Path) -> None:
    path = tmp_path / "noted.safetensors"
    done = command(*site.fit(site.csv, path, "--note", NOTE, "--holdout", "0"))
    assert done.code == 0
    model = dc.load(path)
    assert isinstance(model, dc.CalibratedKinematics)
    assert model.provenance is not None
    assert model.provenance.note == NOTE
    said = command("evaluate", path, site.csv, *TABLE)
    assert (
        f"to robot 'simulated_arm', 40 rows, table sha256 {model.provenance.table_sha256[:12]}...; note: {NOTE}"
        in said.out
    )


def test_commands_say_where_the_model_comes_from(
    fitted: Outcome, site: Site, model: dc.CalibratedKinematics, command: Command, tmp_path: Path
) -> None:
    assert fitted.code == 0
    assert model.provenance is not None
    assert model.provenance.table_sha256 == hashlib.sha256(site.csv.read_bytes()).hexdigest()
    line = model.provenance.sentence(model.robot.name, 28)
    path, units = site.folder / "model.safetensors", TABLE[2:]
    for arguments in (["evaluate", path, site.csv, *TABLE], ["predict", path, site.csv, *units, "-o", tmp_path / "p"]):
        done = command(*arguments)
        assert (done.code, done.err.strip()) == (0, "")
        assert line in done.out


# --- poses that `predict` writes are measurements that other commands read ---


@pytest.mark.parametrize(
    ("options", "columns"),
    [
        ([], ["rx", "ry", "rz"]),
        (["--rotation-angle", "rad"], ["rx", "ry", "rz"]),
        (["--convention", "quat_wxyz"], ["qw", "qx", "qy", "qz"]),
        (["--convention", "XYZ"], ["euler1", "euler2", "euler3"]),
    ],
)
def test_predict_with_poses(options: list[str], columns: list[str], command: Command, tmp_path: Path) -> None:
    kind, path = kind_named("poses"), tmp_path / "p.csv"
    done = command("predict", kind.file, kind.table("new")[0], *UNITS, *options, "-o", path)
    assert (done.code, done.err.strip()) == (0, "")
    assert "joints, poses and standard deviations" in done.out
    printed = re.search(r"`evaluate` and `fit` read these poses with (--.*)", done.out)
    assert printed is not None
    again = command("evaluate", kind.file, path, *UNITS, *shlex.split(printed[1]), "--json", tmp_path / "e.json")
    assert again.code == 0
    assert json.loads((tmp_path / "e.json").read_text())["results"]["errors"]["all"]["rms_m"] < 1e-6
    header, *rows = path.read_text().splitlines()
    places, deviations = ["x", "y", "z", "std_x", "std_y", "std_z"], ["std_rx", "std_ry", "std_rz"]
    assert header.split(",") == [*kind.robot.joint_names, *places, *columns, *deviations]
    values = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    poses, covariance = kind.model.predict_poses(kind.new.q)
    std = np.sqrt(np.diagonal(covariance.numpy(), axis1=1, axis2=2))
    unit = "rad" if "rad" in options else "deg"
    convention = options[1] if "--convention" in options else "rotvec"
    turned = rotation_matrices(values[:, 12:-3], convention, angle=unit)
    assert float(angle_between(turned, poses[:, :3, :3]).max()) < 1e-10
    np.testing.assert_allclose(values[:, 6:9], 1e3 * poses[:, :3, 3].numpy(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(values[:, 9:12], 1e3 * std[:, :3], rtol=1e-6)
    np.testing.assert_allclose(values[:, -3:], std[:, 3:] if unit == "rad" else np.degrees(std[:, 3:]), rtol=1e-6)


# --- a model in a new place: --free, and errors that are named as motions without it ---


MOVE = twist_transform(torch.tensor([0.01, -0.02, 0.005, 0.004, -0.003, 0.006], dtype=torch.float64))


def table(site: Site, path: Path, T: Tensor, rows: int, *, marker: float = 0.0, seed: int = 9) -> Path:
    """New measurements of the site's arm, seen from another place, the marker moved by so many metres."""
    arm = site.arm
    q, points = arm.measure(rows, seed=seed)
    tip = arm.truth.poses(q)[:, :3, :3]
    points = points + marker * tip[:, None, :, 0]
    data = dc.Measurements(q, points @ T[:3, :3].mT + T[:3, 3], arm.nominal.joint_names)
    write_measurements(path, data, FORMAT, position=[POSITION.split(",")])
    return path


MOVED = {
    0.0: r"moving the measuring device by (\S+) mm and 0\.4\d+ degrees explains (\S+) % of the squared error; ",
    0.01: r"moving the marker on the flange by (\S+) mm explains (\S+) % of the squared error; ",
}
"""By how far the marker moved, m: else the device did."""


@pytest.mark.parametrize("marker", MOVED)
def test_what_moved_is_named(marker: float, fitted: Outcome, site: Site, command: Command, tmp_path: Path) -> None:
    assert fitted.code == 0
    path = table(site, tmp_path / "a", torch.eye(4, dtype=torch.float64) if marker else MOVE, 12, marker=marker)
    done = command("evaluate", site.folder / "model.safetensors", path, *TABLE)
    (line,) = done.warnings
    advice = r"register the model first: `model.registered`, evaluate --free both\."
    found = re.fullmatch(f"warning: {MOVED[marker]}{advice}", line)
    assert done.code == 0
    assert found is not None, line
    assert float(found[1]) == pytest.approx(10.0, abs=0.4) if marker else float(found[1]) > 10.0
    assert float(found[2]) > 99.0


def test_register_prints_and_writes_the_registered_model(
    fitted: Outcome, site: Site, model: dc.CalibratedKinematics, command: Command, tmp_path: Path
) -> None:
    assert fitted.code == 0
    path, output = table(site, tmp_path / "new.csv", MOVE, 8), tmp_path / "there.safetensors"
    done = command("evaluate", site.folder / "model.safetensors", path, *TABLE, "--free", "both", "-o", output)
    assert (done.code, done.err.strip()) == (0, "")
    before, after = done.numbers("8 with the places of the fit")[0], done.numbers("8 with places found anew")[0]
    assert before > 10.0
    assert after < 0.5
    assert "8 rows took part: RMS " in done.out
    assert "with each row left out in turn" in done.out
    assert "the measuring frame of the model, seen from the new one: " in done.out
    assert "marker in the frame of 'flange': " in done.out
    assert "unmoved with probability" in done.out
    assert f"registered model: {output}" in done.out
    there = dc.load(output)
    assert isinstance(there, dc.CalibratedKinematics)
    assert there.registration is not None
    torch.testing.assert_close(there.registration.transform, MOVE, rtol=0, atol=3e-3)
    worn: Any = SimpleNamespace(registration=replace(there.registration, excess=5.0), on=there.on)
    said = "\n".join(registration_lines(worn))
    assert ("unmoved with" in said, "what else has changed is in them" in said) == (False, True)
    assert there.provenance == model.provenance
    rest = table(site, tmp_path / "rest.csv", MOVE, 30, seed=10)
    again = command("evaluate", output, rest, *TABLE)
    assert again.numbers("30 in all")[0] < 0.5
    assert "moving " not in again.out


def test_options_of_the_registration(fitted: Outcome, site: Site, command: Command, tmp_path: Path) -> None:
    assert fitted.code == 0
    model, path = site.folder / "model.safetensors", table(site, tmp_path / "new.csv", MOVE, 8)
    done = command("evaluate", model, path, *TABLE, "--free", "base")
    assert done.code == 0
    assert "in the frame of 'flange'" not in done.out
    refused = command("evaluate", model, path, *TABLE, "-o", tmp_path / "m.safetensors")
    assert refused.code == 1
    assert refused.error.startswith("error: -o without --free: expected a table of errors, got ")
    onto = command("evaluate", model, path, *TABLE, "--free", "both", "-o", model)
    assert onto.error == f"error: -o {model} is the file of MODEL; name another file."
    few = command("evaluate", model, table(site, tmp_path / "two.csv", MOVE, 2), *TABLE, "--free", "both")
    assert few.code == 1
    assert "expected at least 3 rows, got 2" in few.error
