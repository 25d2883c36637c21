"""Change points: something moved during the measurements. Against the definition, and on calibrations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from product_bank import Case, simulated, ur10_measurements
from tangent_bank import Setting, normal
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.moved_devices import find_change_point
from diffeo_calib.common.errors import DiffeoCalibWarning

MOVED = r"seems to have moved by about ([\d.]+) mm near row (\d+)"


def from_row(points: Tensor, row: int, change: Tensor) -> Tensor:
    changed = points.clone()
    changed[row:] += change
    return changed


def found(robot: dc.Chain, data: dc.Measurements, what: str) -> tuple[float, int]:
    """Distance in mm and row, as the warning reports them."""
    with pytest.warns(DiffeoCalibWarning, match=MOVED) as caught:
        dc.calibrate(robot, data)
    (text,) = [str(w.message) for w in caught if "moved by" in str(w.message)]
    assert text.startswith(what)
    words = text.split()
    return float(words[words.index("mm") - 1]), int(words[words.index("row") + 1].rstrip(":"))


@pytest.mark.slow
def test_a_tracker_that_was_knocked_is_noticed(arm: Case) -> None:
    """0.5 mm from one row of 60 on; the error of the calibration is 0.04 mm."""
    data = arm.train
    change = torch.tensor([3e-4, 0.0, 4e-4], dtype=torch.float64)
    size, row = found(arm.robot, dc.Measurements(data.q, from_row(data.points, 25, change)), "the measuring device")
    assert size == pytest.approx(0.5, rel=0.3)
    assert abs(row - 25) <= 1


@pytest.mark.slow
def test_a_marker_that_was_knocked_is_noticed(arm: Case) -> None:
    data = arm.train
    shift = arm.result.registration.geometry.poses(data.q)[:, :3, :3] @ torch.tensor(
        [0.0, 1e-3, 0.0], dtype=torch.float64
    )
    points = data.points.clone()
    points[40:, 0] += shift[40:]
    size, row = found(arm.robot, dc.Measurements(data.q, points), "a marker")
    assert size == pytest.approx(1.0, rel=0.3)
    assert abs(row - 40) <= 1


@pytest.mark.slow
def test_rows_in_another_order_are_judged_in_the_order_of_their_numbers(arm: Case) -> None:
    change = torch.tensor([3e-4, 0.0, 4e-4], dtype=torch.float64)
    data = dc.Measurements(arm.train.q, from_row(arm.train.points, 25, change))
    mixed = data[torch.from_numpy(np.random.default_rng(0).permutation(len(data)))]
    assert abs(found(arm.robot, mixed, "the measuring device")[1] - 25) <= 1


def test_the_gain_is_that_of_the_definition() -> None:
    """Every change point by itself, with explicit matrices."""
    arm, measurements, _ = simulated(24)
    setting = Setting(arm.nominal, measurements)
    data, effects = setting.tangent_data, normal(24, 3, 4, seed=0)
    order = torch.from_numpy(np.random.default_rng(1).permutation(24))
    inverse, r = torch.linalg.inv(data.covariance_terms(setting.scales).matrix()), data.target.flatten()
    for fewest in (5, 9):
        best = find_change_point(effects, data.factorised(setting.scales), data.target, order, fewest)
        gains = []
        for row in range(fewest, 24 - fewest + 1):
            B = torch.zeros(24, 3, 4, dtype=torch.float64)
            B[order[row:]] = effects[order[row:]]
            B = B.flatten(0, 1)
            g, H = B.T @ inverse @ r, B.T @ inverse @ B
            gains.append(float(g @ torch.linalg.solve(H, g)))
        assert best.row == fewest + int(np.argmax(gains))
        assert best.gain == pytest.approx(max(gains), rel=1e-5)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:wrist_3_joint")
@pytest.mark.filterwarnings("ignore:the place of the marker on 'ee_link' is known to")
def test_rows_in_which_the_tool_hardly_turns_do_not_tell_device_from_marker(ur10_folder: Path) -> None:
    """Both shifts are the same there, and both are named."""
    robot, data = ur10_measurements(ur10_folder)
    points = from_row(data.points[:100], 50, torch.tensor([6e-4, 0.0, 8e-4], dtype=torch.float64))
    moved = dc.Measurements(data.q[:100], points)
    with pytest.warns(DiffeoCalibWarning, match="the robot's base.*these rows do not tell which"):
        size, row = found(robot, moved, "a marker or the tool")
    assert size == pytest.approx(1.0, rel=0.3)
    assert abs(row - 50) <= 2
