"""632 poses of a UR10 under a laser tracker: what the product is for. Needs DIFFEO_CALIB_DATA."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from command_bank import run_process
from product_bank import Case

import diffeo_calib as dc

POSITION = ("measurement_x", "measurement_y", "measurement_z")
WITHIN = {  # held-out RMS in mm
    "nominal + registration": (0.70, 0.80),
    "geometry": (0.38, 0.43),
    "diffeomorphic": (0.05, 0.16),  # required: 0.33
}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def ur10(ur10_folder: Path) -> Case:
    robot = dc.load_urdf(ur10_folder / "ur10_robot.urdf", base="base_link", tip="ee_link")
    csv = ur10_folder / "measurements_iso_cubes.csv"
    data = dc.read_measurements(csv, robot, POSITION, length="mm", angle="rad", sep=";", decimal=",")
    assert len(data) == 632
    train, test = data.split(0.7, seed=0)
    return Case(robot, train, test, dc.calibrate(robot, train))


def test_held_out_errors(ur10: Case) -> None:
    for name, stage in ur10.result.stages.items():
        low, high = WITHIN[name]
        assert low <= 1e3 * dc.evaluate(stage, ur10.test).rms <= high, name
    assert 1e3 * ur10.held_out()[2] <= 0.33


def test_certificates(ur10: Case) -> None:
    fit = ur10.result.fit
    assert fit.converged
    assert fit.coupling_residual <= 1e-4
    assert fit.end_residual <= 1e-4


def test_predicted_deviations_hold(ur10: Case) -> None:
    mean, covariance = ur10.model.predict(ur10.test.q)
    error = (ur10.test.points - mean)[..., None]
    distance = (error.mT @ torch.linalg.solve(covariance, error)).flatten()
    assert float((distance < 7.8147).double().mean()) > 0.80


def test_the_command_line_finds_the_same(ur10: Case, ur10_folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "ur10.safetensors"
    done = run_process(
        *("fit", ur10_folder / "measurements_iso_cubes.csv", "--robot", ur10_folder / "ur10_robot.urdf"),
        *("--base", "base_link", "--tip", "ee_link", "--position", ",".join(POSITION), "--length", "mm"),
        *("--angle", "rad", "--sep", ";", "--decimal", ",", "-o", path, "--figure", tmp_path / "ur10.png"),
    )
    assert done.code == 0, done.err
    for label, data in ((f"{len(ur10.train)} training", ur10.train), (f"{len(ur10.test)} held out", ur10.test)):
        for name, stage in ur10.result.stages.items():
            found = dc.evaluate(stage, data)
            expected = [1e3 * value for value in (found.rms, found.median, found.p95, found.max)]
            assert done.numbers(name, label) == pytest.approx(expected, abs=2e-4), (name, label)
    loaded = dc.load(path)
    assert isinstance(loaded, dc.CalibratedKinematics)
    assert dc.evaluate(loaded, ur10.test).rms == pytest.approx(ur10.held_out()[2], rel=1e-3)
    assert (tmp_path / "ur10.png").stat().st_size > 20_000
