"""Re-registration on a real UR10 whose second half is moved by a rigid transform: few rows lose little accuracy."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from product_bank import ur10_measurements, ur10_scales

import diffeo_calib as dc
from diffeo_calib.robots.se3 import twist_transform

ROWS = 120
"""Of the model."""


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")
def test_a_tracker_that_moved_between_two_halves(ur10_folder: Path) -> None:
    """RMS on the other rows of the moved half, in units of that of the same model where nothing moved."""
    robot, data = ur10_measurements(ur10_folder)
    half, other = data.split(0.5, seed=0)
    model = dc.calibrate(robot, half[:ROWS], hyperparameters=ur10_scales()).model
    T = twist_transform(torch.tensor([1.0, -2.0, 0.5, 0.7, -1.2, 0.4], dtype=torch.float64))
    moved = dc.Measurements(other.q, other.points @ T[:3, :3].mT + T[:3, 3], robot.joint_names)
    for rows, most in ((20, 1.05), (6, 1.25)):
        order = torch.randperm(len(other), generator=torch.Generator().manual_seed(0))
        found = model.registered(moved.rows(order[:rows]))
        rest = order[rows:]
        assert dc.evaluate(found, moved.rows(rest)).rms < most * dc.evaluate(model, other.rows(rest)).rms
        mean, covariance = found.predict(moved.q[rest[:40]])
        away = (mean - moved.points[rest[:40]])[..., None]
        assert float((away.mT @ torch.linalg.solve(covariance, away) < 7.815).double().mean()) > 0.88


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")
def test_a_marker_that_the_fit_hardly_knew(ur10_folder: Path) -> None:
    """Rows of another date, whose tool tilts otherwise, place it along the one direction that the fit left open."""
    robot, fitted = ur10_measurements(ur10_folder)
    columns = [f"measurement_{axis}" for axis in "xyz"]
    csv = ur10_folder / "measurements_grid_900.csv"
    other = dc.read_measurements(csv, robot, columns, length="mm", angle="rad", sep=";", decimal=",")
    model = dc.calibrate(robot, fitted.split(0.2, seed=0)[0], hyperparameters=ur10_scales()).model
    rows = torch.randperm(len(other), generator=torch.Generator().manual_seed(0))
    found = model.registered(other.rows(rows[:20]))
    assert dc.evaluate(found, other.rows(rows[20:])).rms < 6e-4  # held to its old place: 7 mm
