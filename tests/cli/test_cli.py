"""The command line from measurements to predictions, its exit codes and what it prints."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_bank import TABLE, Command, Outcome, Site, environment, make_site, run_process
from product_bank import simulated_poses
from typer.testing import CliRunner

import diffeo_calib as dc
from diffeo_calib.calibration.findings import Outlier, parts
from diffeo_calib.cli import main as cli
from diffeo_calib.cli.console import Interrupts, outlier_lines
from diffeo_calib.kinematics.evaluation import Evaluation
from diffeo_calib.measurements.csv_files import write_measurements
from diffeo_calib.measurements.poses import angle_between, rotation_matrices

STAGES = ("nominal + registration", "geometry", "diffeomorphic")


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    return Command(capsys, monkeypatch)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return make_site(tmp_path_factory.mktemp("site"), rows=40)


@pytest.fixture(scope="module")
def fitted(site: Site) -> Outcome:
    """One real fit in a process of its own, with its model and its figure."""
    return run_process(*site.fit(site.csv, site.folder / "model.safetensors", "--figure", site.folder / "errors.png"))


@pytest.fixture(scope="module")
def model(fitted: Outcome, site: Site) -> dc.CalibratedKinematics:
    assert fitted.code == 0
    loaded = dc.load(site.folder / "model.safetensors")
    assert isinstance(loaded, dc.CalibratedKinematics)
    return loaded


# --- fit ----------------------------------------------------------------------------------------------------------


def test_fit_prints_three_stages_in_training_and_held_out(
    fitted: Outcome, site: Site, model: dc.CalibratedKinematics
) -> None:
    assert fitted.err.strip() == ""
    parts = dict(zip(("28 training", "12 held out"), site.data.split(0.7, seed=0), strict=True))
    rms = {label: [fitted.numbers(stage, label)[0] for stage in STAGES] for label in parts}
    assert rms["12 held out"][0] > rms["12 held out"][1] > rms["12 held out"][2]
    for label, data in parts.items():
        found = dc.evaluate(model, data)
        expected = [1e3 * value for value in (found.rms, found.median, found.p95, found.max)]
        assert fitted.numbers(STAGES[2], label) == pytest.approx(expected, abs=1.01e-4)
    assert "Position errors in mm by stage" in fitted.out
    assert "converged" in fitted.out
    residuals = re.search(r"coupling residual (\S+), end residual (\S+), time-stepping error \S+ mm", fitted.out)
    assert residuals is not None
    assert all(float(value) <= 1e-4 for value in residuals.groups())


def test_fit_prints_what_each_part_explains(fitted: Outcome, model: dc.CalibratedKinematics) -> None:
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in fitted.out.splitlines() if "│" in line]
    printed = {row[0]: row[1:] for row in rows if len(row) == 3}
    found = parts(model)
    assert list(printed) == [part.name for part in found]
    for part in found:
        angle = "" if part.angle is None else f"{1e3 * part.angle:.4f}"
        assert printed[part.name] == [f"{1e3 * part.displacement:.4f}", angle]
    assert "look wrong" not in fitted.out
    assert model.report["outliers"] == 0
    assert model.report["geometry [m]"] == pytest.approx(found[0].displacement, rel=1e-12)


@pytest.mark.slow
def test_outliers_are_told_by_their_lines_in_the_file(site: Site, command: Command, tmp_path: Path) -> None:
    """Two training rows are wrong, far from the top of the file; nothing is dropped and the exit code is 0."""
    train, _ = site.data.split(0.7, seed=0)
    first, second = (int(train.numbers[k]) for k in (5, 20))  # from 0: the header is line 1, row 0 is line 2
    points = site.data.points.clone()
    points[first] += torch.tensor([0.03, 0.04, 0.0], dtype=torch.float64)
    points[second] = points[first - 1]
    data = dc.Measurements(site.data.q, points, site.data.joint_names, doubt=False)
    position = ["mx", "my", "mz"]
    write_measurements(tmp_path / "t.csv", data, length="mm", angle="deg", sep=";", decimal=",", position=position)
    done = command(*site.fit(tmp_path / "t.csv", tmp_path / "model"))
    assert done.code == 0
    assert "2 of 28 training rows look wrong (numbers are lines of the file); none was dropped:" in done.out
    told = [line for line in done.out.splitlines() if line.startswith("  row ")]
    assert [line.split(":")[0] for line in told] == [f"  row {second + 2}", f"  row {first + 2}"]
    assert "a wrong pairing?" in told[0] or "far from where the other rows predict it" in told[0]
    assert "marker" not in "".join(told)  # there is only one
    far = re.search(r"row \d+: (\S+) mm off, weight (\S+); far from where", told[1])
    assert far is not None
    assert float(far[1]) == pytest.approx(50, abs=1.0)
    assert float(far[2]) < 1e-3
    loaded = dc.load(tmp_path / "model")
    assert isinstance(loaded, dc.CalibratedKinematics)
    assert (loaded.report["outliers"], loaded.report["rows"]) == (2, 28)
    rms = done.numbers(STAGES[2], "12 held out")[0]
    assert rms < done.numbers(STAGES[1], "12 held out")[0]


def test_many_outliers_are_cut_short() -> None:
    found = [Outlier(k, None if k % 2 else 1, k + 2, 0.05 - 1e-3 * k, 1e-3, "odd") for k in range(13)]
    lines = list(outlier_lines(found, 100))
    assert lines[0].startswith("13 of 100 training rows look wrong")
    assert lines[1] == "  row 2, marker 1: 50.000 mm off, weight 0.001; odd"
    assert lines[2] == "  row 3: 49.000 mm off, weight 0.001; odd"  # a pose has no marker
    assert len(lines) == 12
    assert lines[-1] == "  and 3 more"
    assert list(outlier_lines([], 100)) == []
    twice = [Outlier(4, k, 6, 0.01, 0.1, "odd") for k in (0, 1)]
    assert next(iter(outlier_lines(twice, 9))).startswith("1 of 9 training rows")


@pytest.mark.slow
def test_fit_equals_calibrate(site: Site, model: dc.CalibratedKinematics) -> None:
    train, test = site.data.split(0.7, seed=0)
    expected = dc.calibrate(site.arm.nominal, train).model
    # The CSV's last digit is not the same, and the search for scales ends a little elsewhere.
    torch.testing.assert_close(model(test.q), expected(test.q), rtol=0, atol=1e-5)
    assert expected.report["rows"] == model.report["rows"]
    assert expected.report.keys() == model.report.keys()


def test_fit_draws_a_figure(fitted: Outcome, site: Site) -> None:
    assert fitted.code == 0
    assert (site.folder / "errors.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    assert "figure: " in fitted.out


@pytest.mark.slow
def test_holdout_zero_and_other_names(site: Site, command: Command, tmp_path: Path) -> None:
    """All rows in training; joint columns with names of their own; points and commas of the other kind."""
    names = list("abcdef")
    data = site.data.rows(slice(20))
    write_measurements(tmp_path / "t.csv", data, length="m", angle="rad", sep="\t", joints=names)
    done = command(
        *("fit", tmp_path / "t.csv", *site.robot(), "--position", "x,y,z", "--length", "m", "--angle", "rad"),
        *("--joints", ",".join(names), "--sep", "\\t", "--holdout", 0, "-o", tmp_path / "all.safetensors"),
        *("--figure", tmp_path / "all.svg"),
    )
    assert done.code == 0
    assert done.err.strip() == ""
    assert "held out │" not in done.out
    assert "no row was held out: these are errors on rows that were fitted" in done.out
    assert re.search(r"leave-one-out RMS 0\.\d+ mm", done.out) is not None
    assert "look wrong" not in done.out
    for stage in STAGES:
        assert len(done.numbers(stage, "20 training")) == 4
    loaded = dc.load(tmp_path / "all.safetensors")
    assert isinstance(loaded, dc.CalibratedKinematics)
    assert loaded.report["rows"] == 20
    assert loaded.robot.joint_names == site.arm.nominal.joint_names
    assert "20 training rows, no row was held out" in (tmp_path / "all.svg").read_text()


@pytest.mark.slow
def test_two_markers(command: Command, tmp_path: Path) -> None:
    site = make_site(tmp_path, rows=16, markers=2)
    table = ["--length", "mm", "--angle", "deg", "--sep", ";", "--decimal", ","]
    markers = ["--position", "x0,y0,z0", "--position", "x1, y1 ,z1"]
    path = tmp_path / "two.safetensors"
    done = command("fit", site.csv, *site.robot(), *markers, *table, "-o", path, "--holdout", 0)
    assert (done.code, done.err.strip()) == (0, "")
    evaluated = command("evaluate", path, site.csv, *markers, *table)
    assert evaluated.numbers("in all") == pytest.approx(done.numbers("diffeomorphic"), abs=1.01e-4)
    predicted = command("predict", path, site.csv, *table, "-o", tmp_path / "p.csv")
    assert predicted.code == 0
    header = (tmp_path / "p.csv").read_text().splitlines()[0].split(";")
    kinds = [f"{kind}{axis}" for kind in ("", "std_") for axis in "xyz"]
    assert header == [*site.arm.nominal.joint_names, *(f"marker{k}_{kind}" for k in (1, 2) for kind in kinds)]
    crossed = command("evaluate", path, site.csv, *reversed_markers(markers), *table)
    assert crossed.numbers("in all")[0] > 10.0  # markers in the wrong order are not the same markers
    assert len(crossed.warnings) == 1
    fewer = command("evaluate", path, site.csv, *markers[:2], *table)
    assert fewer.code == 1
    assert "do not have the same markers" in fewer.error


def reversed_markers(markers: list[str]) -> list[str]:
    return [*markers[2:], *markers[:2]]


# --- evaluate and predict -----------------------------------------------------------------------------------------


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
        (["--length", "m"], "mm by the model's own uncertainty, got "),
        (["--joints", "shoulder_joint,waist_joint,elbow_joint"], "the order of the columns"),
        (["--position", "my,mx,mz"], "a model predicts in the measuring frame of its fit"),
    ],
)
def test_absurd_errors_are_doubted(
    options: list[str], words: str, fitted: Outcome, site: Site, command: Command
) -> None:
    """A wrong unit, joints exchanged, a left-handed frame."""
    assert fitted.code == 0
    if "--joints" in options:
        names = [*options[1].split(","), *site.arm.nominal.joint_names[3:]]
        options = ["--joints", ",".join(names)]
    table = TABLE[2:] if "--position" in options else TABLE
    done = command("evaluate", site.folder / "model.safetensors", site.csv, *table, *options)
    assert done.code == 0
    (told,) = [line for line in done.warnings if "these errors are not those of a calibrated robot" in line]
    assert words in told
    assert "check --length and --angle, " in told


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


def test_predict_in_metres_from_joints_alone(
    fitted: Outcome, site: Site, model: dc.CalibratedKinematics, command: Command, tmp_path: Path
) -> None:
    assert fitted.code == 0
    q = site.data.q[:3]
    lines = [",".join(f"q{i}" for i in range(6)), *(",".join(map(repr, row)) for row in q.tolist())]
    (tmp_path / "path.csv").write_text("\n".join(lines))
    names = ["--joints", "q0,q1,q2,q3,q4,q5", "--length", "m", "--angle", "rad"]
    done = command(
        "predict", site.folder / "model.safetensors", tmp_path / "path.csv", *names, "-o", tmp_path / "p.csv"
    )
    assert done.code == 0
    values = np.loadtxt(tmp_path / "p.csv", delimiter=",", skiprows=1)
    assert np.array_equal(values[:, :6], q.numpy())
    assert np.array_equal(values[:, 6:9], model(q)[:, 0].numpy())  # all digits are written


# --- poses --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Posed:
    """A table of measured poses with standard deviations, the command that fits it, and what it printed."""

    site: Site
    data: dc.Measurements
    table: list[str]
    fitted: Outcome

    @property
    def path(self) -> Path:
        return self.site.folder / "posed.safetensors"

    @property
    def model(self) -> dc.CalibratedKinematics:
        loaded = dc.load(self.path)
        assert isinstance(loaded, dc.CalibratedKinematics)
        return loaded


@pytest.fixture(scope="module")
def posed_site(tmp_path_factory: pytest.TempPathFactory) -> Posed:
    """20 poses, joints in deg, rotations as Euler angles in rad, lever 80 mm."""
    folder = tmp_path_factory.mktemp("posed")
    arm, data, _ = simulated_poses(20, lever=0.08)
    assert data.poses is not None
    known = dc.Measurements.from_poses(
        data.q, data.poses, data.joint_names, lever=0.08, position_std=2e-5, rotation_std=2e-4
    )
    site = Site(folder, arm, known)
    arm.write_urdf(site.urdf)
    units: dict[str, Any] = {"length": "mm", "angle": "deg", "sep": ";", "decimal": ","}
    names = ["mx", "my", "mz"], ["ra", "rb", "rc"]
    write_measurements(
        site.csv, known, position=names[0], rotation=names[1], convention="ZYX", rotation_angle="rad", **units
    )
    rotation = ["--rotation", "ra, rb ,rc", "--convention", "ZYX", "--rotation-angle", "rad", "--lever", "80"]
    std = ["--std", "std_mx,std_my,std_mz", "--rotation-std", "std_rx,std_ry,std_rz"]
    table = [*TABLE, *rotation, *std]
    path = folder / "posed.safetensors"
    options = [*site.robot(), *table, "-o", path, "--figure", folder / "e.png"]
    return Posed(site, known, table, run_process("fit", site.csv, *options))


def all_numbers(outcome: Outcome, *labels: str) -> list[float]:
    """Errors in mm and in deg of one row of a table."""
    rows = [line.split("│") for line in outcome.out.splitlines() if all(label in line for label in labels)]
    assert len(rows) == 1, outcome.out
    return [float(cell) for cell in rows[0][-9:-1]]


def all_errors(found: Evaluation) -> list[float | None]:
    distances = [1e3 * value for value in (found.rms, found.median, found.p95, found.max)]
    return [*distances, found.angle_rms, found.angle_median, found.angle_p95, found.angle_max]


@pytest.mark.slow
def test_fit_with_poses(posed_site: Posed) -> None:
    done, model = posed_site.fitted, posed_site.model
    assert (done.code, done.err.strip()) == (0, "")
    assert "Position errors in mm by stage, orientation errors in deg" in done.out
    assert model.lever == pytest.approx(0.08)
    train, test = posed_site.data.split(0.7, seed=0)
    for label, data in (("14 training", train), ("6 held out", test)):
        found = all_numbers(done, STAGES[2], label)
        assert found == pytest.approx(all_errors(dc.evaluate(model, data)), abs=1.01e-4)
    assert all_numbers(done, STAGES[0], "6 held out")[4] > all_numbers(done, STAGES[2], "6 held out")[4]
    assert (posed_site.site.folder / "e.png").is_file()


@pytest.mark.slow
def test_fit_reads_poses_and_standard_deviations(
    posed_site: Posed, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[dc.Measurements] = []

    def look(_: Any, data: dc.Measurements, **__: Any) -> None:
        seen.append(data)
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "calibrate", look)
    site = posed_site.site
    done = command("fit", site.csv, *site.robot(), *posed_site.table, "-o", tmp_path / "m", "--holdout", 0)
    assert done.code == 130
    (found,) = seen
    assert found.joint_names == site.arm.nominal.joint_names
    assert found.lever == pytest.approx(0.08)
    for name in ("poses", "points", "std", "rotation_std", "covariance"):
        torch.testing.assert_close(getattr(found, name), getattr(posed_site.data, name), rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_evaluate_with_poses(posed_site: Posed, command: Command) -> None:
    done = command("evaluate", posed_site.path, posed_site.site.csv, *posed_site.table)
    assert (done.code, done.err.strip()) == (0, "")
    train, test = posed_site.data.split(0.7, seed=0)
    parts = (("20 in all", posed_site.data), ("14 used in the fit", train), ("6 not used in the fit", test))
    for label, data in parts:
        expected = all_errors(dc.evaluate(posed_site.model, data))
        assert all_numbers(done, label) == pytest.approx(expected, abs=1.01e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "columns"),
    [
        ([], ["rx", "ry", "rz"]),
        (["--rotation-angle", "rad"], ["rx", "ry", "rz"]),
        (["--convention", "quat_wxyz"], ["qw", "qx", "qy", "qz"]),
        (["--convention", "XYZ"], ["euler1", "euler2", "euler3"]),
    ],
)
def test_predict_with_poses(
    options: list[str], columns: list[str], posed_site: Posed, command: Command, tmp_path: Path
) -> None:
    units = ["--length", "mm", "--angle", "deg", "--sep", ";", "--decimal", ","]
    done = command("predict", posed_site.path, posed_site.site.csv, *units, *options, "-o", tmp_path / "p.csv")
    assert (done.code, done.err.strip()) == (0, "")
    assert "20 predictions written" in done.out
    assert "joints, poses and standard deviations" in done.out
    told = re.search(r"`evaluate` and `fit` read these poses with (--position .*)", done.out)
    assert told is not None
    again = command("evaluate", posed_site.path, tmp_path / "p.csv", *units, *told[1].split())
    assert again.code == 0
    assert max(all_numbers(again, "20 in all")) < 1e-3
    header, *rows = (tmp_path / "p.csv").read_text().splitlines()
    deviations = ["std_rx", "std_ry", "std_rz"]
    expected = [*posed_site.site.arm.nominal.joint_names, "x", "y", "z", "std_x", "std_y", "std_z"]
    assert header.split(";") == [*expected, *columns, *deviations]
    values = np.array([[float(cell.replace(",", ".")) for cell in row.split(";")] for row in rows])
    poses, covariance = posed_site.model.predict_poses(posed_site.data.q)
    std = np.sqrt(np.diagonal(covariance.numpy(), axis1=1, axis2=2))
    unit = "rad" if "rad" in options else "deg"
    convention = options[1] if "--convention" in options else "rotvec"
    turned = rotation_matrices(values[:, 12:-3], convention, angle=unit)
    assert float(angle_between(turned, poses[:, :3, :3]).max()) < 1e-10
    np.testing.assert_allclose(values[:, 6:9], 1e3 * poses[:, :3, 3].numpy(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(values[:, 9:12], 1e3 * std[:, :3], rtol=1e-6)
    np.testing.assert_allclose(values[:, -3:], std[:, 3:] if unit == "rad" else np.degrees(std[:, 3:]), rtol=1e-6)


def test_standard_deviations_of_points(
    site: Site, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[dc.Measurements] = []

    def look(_: Any, data: dc.Measurements, **__: Any) -> None:
        seen.append(data)
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "calibrate", look)
    data = dc.Measurements(site.data.q, site.data.points, site.data.joint_names, std=3e-5)
    write_measurements(tmp_path / "t.csv", data, length="mm", angle="deg")
    table = ["--position", "x,y,z", "--length", "mm", "--angle", "deg", "--std", "std_x,std_y,std_z", "--holdout", 0]
    assert command("fit", tmp_path / "t.csv", *site.robot(), *table, "-o", tmp_path / "m").code == 130
    torch.testing.assert_close(seen[0].std, data.std, rtol=1e-12, atol=0)
    assert seen[0].poses is None


# --- exit codes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ["fit"],
        ["fit", "t.csv", "--robot", "r.urdf"],
        ["nonsense"],
        ["evaluate", "m", "t.csv", "--position", "x,y,z", "--length", "inch", "--angle", "rad"],
        ["evaluate", "m", "t.csv", "--position", "x,y,z", "--length", "m", "--angle", "rad", "--surprise"],
        ["fit", "t.csv", "--holdout", "1.5"],
        ["fit", "t.csv", "--holdout", "nan"],
        ["evaluate", "m", "t.csv", "--length", "m", "--angle", "rad"],
        [
            "evaluate",
            "m",
            "t.csv",
            "--position",
            "x,y,z",
            "--length",
            "m",
            "--angle",
            "rad",
            "--rotation-angle",
            "turn",
        ],
        ["demo", "--seed", "-1"],
        ["demo", "--rows", "3"],
    ],
)
def test_wrong_usage_is_exit_2(arguments: list[str], command: Command) -> None:
    done = command(*arguments)
    assert done.code == 2
    assert "Traceback" not in done.err
    assert "Usage" in done.err


@pytest.mark.parametrize("option", ["--rows", "--seed"])
def test_options_of_the_other_demo_are_refused(option: str, command: Command, tmp_path: Path) -> None:
    done = command("demo", "--paper", option, 30, "-o", tmp_path / "new")
    assert done.code == 1
    assert "belong to the simulated arm" in done.error
    assert not (tmp_path / "new").exists()


def test_help_names_every_command() -> None:
    shown = CliRunner().invoke(cli.app, ["--help"])
    assert shown.exit_code == 0
    assert all(name in shown.output for name in ("fit", "evaluate", "predict", "demo"))
    for name in ("fit", "evaluate", "predict", "demo"):
        assert CliRunner().invoke(cli.app, [name, "--help"]).exit_code == 0


def test_unconverged_is_exit_3_with_the_model_written(
    site: Site, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_measurements(tmp_path / "t.csv", site.data.rows(slice(11)), length="m", angle="rad")
    monkeypatch.setattr("diffeo_calib.calibration.calibrate.GaussNewton", partial(dc.GaussNewton, max_iterations=1))
    path = tmp_path / "early.safetensors"
    table = ["--position", "x,y,z", "--length", "m", "--angle", "rad"]
    done = command("fit", tmp_path / "t.csv", *site.robot(), *table, "-o", path, "--holdout", 0)
    assert done.code == 3
    assert "stopped at the limit of 1 iterations; judge it by held-out errors" in done.out
    assert "pass fewer --controls" in done.out
    assert "max_iterations" not in done.out
    assert any("11 poses are too few to select scales" in warning for warning in done.warnings)
    assert isinstance(dc.load(path), dc.CalibratedKinematics)


def interrupted_calibrate(*_: Any, **__: Any) -> None:
    raise KeyboardInterrupt


def test_ctrl_c_before_there_is_a_model_is_exit_130(
    site: Site, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli, "calibrate", interrupted_calibrate)
    done = command(*site.fit(site.csv, tmp_path / "none.safetensors"))
    assert done.code == 130
    assert not (tmp_path / "none.safetensors").exists()
    assert "Traceback" not in done.err


def test_ctrl_c_before_there_is_a_model_is_said(
    site: Site, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli, "calibrate", interrupted_calibrate)
    assert "interrupted" in command(*site.fit(site.csv, tmp_path / "none.safetensors")).err


@pytest.mark.parametrize("seconds", [0.1, 0.3, 0.6])
def test_ctrl_c_while_the_package_is_imported(seconds: float, site: Site, tmp_path: Path) -> None:
    """The program has begun, its imports have not ended: one sentence at once, no traceback."""
    program = "import diffeo_calib_program, os; print('begun', flush=True); diffeo_calib_program.main()"
    command = [sys.executable, "-c", program, *map(str, site.fit(site.csv, tmp_path / "none.safetensors"))]
    options: dict[str, Any] = {"env": environment(), "encoding": "utf-8", "start_new_session": True}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        time.sleep(seconds)
        os.kill(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    assert err == "error: interrupted before there was a result to keep.\n"


def test_ctrl_c_is_raised_once_and_only_where_there_is_a_state_to_keep(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before, and the second time, the process ends."""
    ended: list[str] = []
    monkeypatch.setattr("diffeo_calib.cli.console._stop", ended.append)
    before = signal.getsignal(signal.SIGINT)
    interrupts, seen = Interrupts(), []
    interrupts.install()
    try:
        progress = interrupts.watching(lambda *given: seen.append(given))
        progress("geometry", 0, 1)
        signal.raise_signal(signal.SIGINT)
        assert ended == ["interrupted before there was a result to keep"]
        interrupts.install()
        progress("hyper-parameters", 1, 40)
        signal.raise_signal(signal.SIGINT)
        assert len(ended) == 1
        with pytest.raises(KeyboardInterrupt):
            progress("hyper-parameters", 2, 40)
        progress("Gauss-Newton", 0, 30)
        signal.raise_signal(signal.SIGINT)
        assert ended[1:] == ["interrupted again, stopped at once"]
    finally:
        signal.signal(signal.SIGINT, before)
    assert interrupts.asked
    assert len(seen) == 4


INTERRUPTIBLE = """
import diffeo_calib.cli.main as cli

calibrate = cli.calibrate

def told(robot, data, *, progress, **options):
    def step(task, done, total):
        print(task, done, flush=True)
        progress(task, done, total)
    return calibrate(robot, data, progress=step, **options)

cli.calibrate = told
cli.main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["hyper-parameters 3", "Gauss-Newton 1"])
def test_ctrl_c_in_a_real_process_writes_the_model(moment: str, tmp_path: Path) -> None:
    site, path = make_site(tmp_path, rows=200), tmp_path / "cut.safetensors"
    process = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTIBLE, *map(str, site.fit(site.csv, path))],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment(),
        encoding="utf-8",
        start_new_session=True,
    )
    guard = threading.Timer(240, process.kill)
    guard.start()
    try:
        assert process.stdout is not None
        lines = iter(process.stdout.readline, "")
        begun = any(line.strip() == moment for line in lines)
        assert begun, process.stderr.read() if process.stderr else ""
        os.kill(process.pid, signal.SIGINT)
        out, err = process.communicate()
    finally:
        guard.cancel()
        process.kill()
    assert process.returncode == 130, err
    assert "Traceback" not in err
    assert "interrupted" in out
    assert "model: " in out
    model = dc.load(path)
    assert isinstance(model, dc.CalibratedKinematics)
    _, test = site.data.split(0.7, seed=0)
    done = Outcome(130, out, err)
    assert done.numbers("diffeomorphic", "60 held out")[0] == pytest.approx(
        1e3 * dc.evaluate(model, test).rms, abs=1.01e-4
    )
    assert done.numbers("diffeomorphic", "60 held out")[0] < done.numbers("geometry", "60 held out")[0]


@pytest.mark.slow
def test_demo(tmp_path: Path) -> None:
    done = run_process("demo", "--output", tmp_path / "demo", "--rows", 40)
    assert (done.code, done.err.strip()) == (0, "")
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    assert names == {"arm.urdf", "measurements.csv", "model.safetensors", "calibration.png"}
    assert done.numbers("diffeomorphic", "held out")[0] < done.numbers("geometry", "held out")[0]
    # the command that it shows is one that works
    shown = re.search(r"  diffeo-calib (fit .*?)\n\n", done.out, re.DOTALL)
    assert shown is not None
    arguments = shown.group(1).replace("\\\n", " ").replace("'", "").split()
    again = run_process(*arguments)
    assert again.code == 0
    assert again.numbers("diffeomorphic", "held out") == done.numbers("diffeomorphic", "held out")


@pytest.mark.slow
def test_demo_of_the_paper(tmp_path: Path) -> None:
    done = run_process("demo", "--paper", "--output", tmp_path / "paper")
    assert (done.code, done.err.strip()) == (0, "")
    assert "energy (16) 5.696" in done.out
    assert "5.07 orders of magnitude less" in done.out
    assert len(list((tmp_path / "paper").glob("figure_*.png"))) == 5
