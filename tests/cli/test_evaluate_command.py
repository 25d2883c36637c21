"""`diffeo-calib evaluate` and `predict` with models of points, and what they say about a model's origin."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from command_bank import FORMAT, TABLE, Command, Outcome, Site
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements


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
