"""Joint values with few digits: the step is found, and reported where it limits the accuracy."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from product_bank import Case, simulated

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.campaign import quantum, warn_of_rounding
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.fitting.result import silent


@pytest.mark.parametrize(
    ("step", "words"),
    [
        (1e-3, "0.001 rad"),
        (5e-4, "0.0005 rad"),
        (math.radians(0.1), "0.1 degrees"),
        (math.radians(0.01), "0.01 degrees"),
        (math.radians(1.0), "1 degrees"),
    ],
)
def test_the_step_of_a_column(step: float, words: str, arm: Case) -> None:
    values = (arm.train.q[:, 1] / step).round() * step
    assert quantum(values, turning=True) == (pytest.approx(step), words)
    assert quantum(arm.train.q[:, 1], turning=True) is None
    assert quantum(values[:6], turning=True) is None  # a few round numbers are no evidence
    assert quantum(1e-6 * torch.rand(40, dtype=torch.float64), turning=True) is None  # nor is zero, of any step


def test_the_step_of_a_slide() -> None:
    values = (torch.linspace(0.1, 0.6, 40, dtype=torch.float64).sqrt() * 1e3).round() / 1e3
    assert quantum(values, turning=False) == (pytest.approx(1e-3), "1 mm")


def rounded(arm: Case, step: float) -> dc.Measurements:
    return dc.Measurements((arm.train.q / step).round() * step, arm.train.points)


def test_values_commanded_with_few_digits_are_right(arm: Case) -> None:
    """Their rounding would cause far larger errors than remain."""
    data, tangent = rounded(arm, 1e-2), place(arm.robot, arm.train, silent).tangent_data()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_rounding(arm.robot, data, tangent, arm.result.leave_one_out)
        warn_of_rounding(arm.robot, rounded(arm, 1e-6), tangent, arm.result.leave_one_out)  # or far smaller ones


def test_few_rows_do_not_tell(arm: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their errors are as large as those of rounding, whatever the digits."""
    monkeypatch.setattr(gates, "ROUNDING_LEAST", 0.0)
    monkeypatch.setattr(gates, "ROUNDING_MOST", math.inf)
    data = rounded(arm, 1e-3)
    judged = place(arm.robot, arm.train, silent).tangent_data(), arm.result.leave_one_out
    with pytest.warns(DiffeoCalibWarning, match="are rounded to"):
        warn_of_rounding(arm.robot, data, *judged)
    warn_of_rounding(arm.robot, data.rows(slice(15)), *judged)  # a warning fails this test


@pytest.mark.slow
def test_readings_rounded_to_a_milliradian() -> None:
    arm, train, _ = simulated(40)
    data = dc.Measurements((1e3 * train.q).round() / 1e3, train.points)
    words = (
        r"waist_joint, .*, wrist_roll_joint are rounded to 0.001 rad: .* got 0\.\d+ mm RMS of position error from this"
    )
    with pytest.warns(DiffeoCalibWarning, match=words):
        dc.calibrate(arm.nominal, data)
