"""Measured robots: 632 poses of a UR10 by a laser tracker, 114 of an FR3 whose camera sees a board."""

from pathlib import Path
from typing import Any

import pytest
import robot_data
from product_bank import Case, covered, ur10_measurements

import diffeo_calib as dc

LARGEST = {"nominal": 0.80, "geometric": 0.43, "calibrated": 0.125}
"""Held-out RMS in mm with 442 poses, seed 0."""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def ur10(ur10_folder: Path) -> Case:
    robot, data = ur10_measurements(ur10_folder)
    assert len(data) == 632
    train, test = data.split(0.7, seed=0)
    return Case(robot, train, test, dc.calibrate(robot, train))


def test_held_out_errors(ur10: Case) -> None:
    for name, stage in ur10.result.stages.items():
        assert 1e3 * dc.evaluate(stage, ur10.test).rms <= LARGEST[name], name


def test_the_fit_converges_and_its_deviations_hold(ur10: Case) -> None:
    fit = ur10.result.fit
    assert fit.converged
    assert max(fit.coupling_residual, fit.end_residual) <= 1e-4
    assert 0.92 < covered(ur10.model, ur10.test) < 0.99
    assert len(ur10.result.outliers) <= 0.02 * len(ur10.train)  # gross errors are not invented
    assert ur10.result.left_out_rms == pytest.approx(ur10.held_out()[2], rel=0.25)


def fr3(folder: Path, *, poses: bool) -> tuple[dc.Chain, dc.Measurements]:
    """The robot by its published table, and the measurements of its camera, which have heavy tails."""
    found = robot_data.read(folder / "franka_fr3", robot_data.BUILT_IN["franka_fr3"], poses=poses)
    assert len(found.measurements) == 114
    return found.robot, found.measurements


def test_heavy_tails_of_a_camera(ur10_folder: Path) -> None:
    """Medians, since single images are far off; these are flagged."""
    robot, data = fr3(ur10_folder.parent, poses=False)
    train, test = data.split(0.7, seed=0)
    result = dc.calibrate(robot, train)
    _, geometry, diffeomorphic = (1e3 * dc.evaluate(stage, test).median for stage in result.stages.values())
    assert diffeomorphic < min(0.85 * geometry, 0.7)
    assert 1 <= len(result.outliers) <= 12
    assert result.tails.freedom < 8


def test_poses_of_a_camera(ur10_folder: Path) -> None:
    robot, data = fr3(ur10_folder.parent, poses=True)
    train, test = data.split(0.5, seed=1)
    result = dc.calibrate(robot, train)
    each: Any = [dc.evaluate(stage, test) for stage in result.stages.values()]
    _, geometry, diffeomorphic = each
    assert diffeomorphic.median < 0.9 * geometry.median
    assert diffeomorphic.orientation.median < 0.7 * geometry.orientation.median
