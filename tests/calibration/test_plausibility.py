"""Doubtful measurements are calibrated with a warning: its words, and the accuracy of the model."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from math import inf

import pytest
import torch
from product_bank import Case, simulated, with_usual_scales

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.plausibility import check_limits
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.robots.joint import Joint

pytestmark = pytest.mark.slow  # calibrations by the dozen

NOT_THIS_ROBOT = "the measurements do not fit this robot"


def held_out(result: dc.CalibrationResult, test: dc.Measurements) -> float:
    return dc.evaluate(result.model, test).rms


def test_a_robot_with_large_errors_is_warned_about() -> None:
    """Joints that err by 0.05 rad: no usual arm, but it might be one."""
    arm, train, test = simulated(30, transmission=200)
    with pytest.warns(DiffeoCalibWarning, match=NOT_THIS_ROBOT + r", even with geometric errors.*median of 0\.0"):
        result = dc.calibrate(arm.nominal, train)
    assert held_out(result, test) < dc.evaluate(result.identification.geometry.points, test).rms


def test_a_joint_offset_is_reported_and_calibrated(arm: Case) -> None:
    """Far larger than geometric errors are expected to be: the accuracy hardly suffers."""
    shift = torch.zeros(6, dtype=torch.float64)
    shift[4] = math.radians(-30)
    with pytest.warns(
        DiffeoCalibWarning, match=r"^joint offsets are far .*: wrist_bend_joint by (-?\d+\.\d) degrees: got"
    ):
        result = with_usual_scales(arm.robot, dc.Measurements(arm.train.q + shift, arm.train.points))
    test = dc.Measurements(arm.test.q + shift, arm.test.points)
    assert held_out(result, test) < 1.7 * arm.held_out()[-1]
    assert held_out(result, test) < 0.3 * dc.evaluate(result.identification.geometry.points, test).rms


def test_small_offsets_of_several_joints_are_named(arm: Case) -> None:
    scales = arm.result.selection.scales
    shift = torch.tensor([0.0, 0.04, -0.04, 0.0, 0.03, 0.0], dtype=torch.float64)
    with pytest.warns(
        DiffeoCalibWarning, match=r"joint offsets are far.*: shoulder_joint by .*elbow_joint by .* degrees: got"
    ):
        dc.calibrate(arm.robot, dc.Measurements(arm.train.q + shift, arm.train.points), hyperparameters=scales)


def test_a_joint_that_never_moves_is_predicted_where_it_stands() -> None:
    """Its warning names it, and the model does not invent errors of it."""
    arm, train, test = simulated(40)
    q, other = train.q.clone(), test.q.clone()
    q[:, 5], other[:, 5] = -0.7, -0.7
    noise = 2e-5 * torch.randn(40, 1, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    with pytest.warns(DiffeoCalibWarning, match=r"^wrist_roll_joint: never moved in these measurements") as caught:
        result = dc.calibrate(arm.nominal, dc.Measurements(q, arm.true_points(q) + noise))
    assert len(caught) == 1
    there = dc.Measurements(other, arm.true_points(other))
    assert held_out(result, there) < 0.25 * dc.evaluate(result.identification.geometry.points, there).rms
    (part,) = [part for part in result.parts if part.name == "transmission of wrist_roll_joint"]
    assert part.displacement < 1e-4


def limited(*limits: tuple[str, float, float]) -> dc.Chain:
    origin = torch.eye(4, dtype=torch.float64)
    joints = [Joint(f"j{k}", kind, origin, lower=low, upper=high) for k, (kind, low, high) in enumerate(limits)]
    return dc.Chain("r", "a", "b", joints)


def test_joints_far_beyond_their_limits_are_warned_about_in_their_own_unit() -> None:
    robot = limited(("revolute", -1.0, 1.0), ("prismatic", 0.0, 0.6), ("revolute", 0.0, 0.0), ("revolute", -inf, inf))
    fine = dc.Measurements([[7.48, 0.7, 3.0, 9.0]], [[0.0, 0.0, 0.0]])  # 1.2 and a turn
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_limits(robot, fine)
    slid = dc.Measurements([[0.0, 8.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    turned = dc.Measurements([[9.0, 0.1, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    for data, words in (
        (slid, r"^j1: far beyond the robot's limits: expected 0 to 0.6 m, got 8 to 8 m; .*not in millimetres"),
        (turned, r"^j0: far beyond the robot's limits: expected -1 to 1 rad, got 2.72 to 2.72 rad; .*not in degrees"),
    ):
        with pytest.warns(DiffeoCalibWarning, match=words) as caught:
            check_limits(robot, data)
        assert len(caught) == 1


@pytest.mark.filterwarnings("ignore:a marker or the tool")
def test_markers_that_are_exchanged_in_half_of_the_rows(pair: Case) -> None:
    points = pair.train.points.clone()
    points[:20] = points[:20, [1, 0]]
    with pytest.warns(DiffeoCalibWarning, match=r"rows are outliers.*markers (0 and 1|1 and 0) seem to be exchanged"):
        dc.calibrate(pair.robot, dc.Measurements(pair.train.q, points))


# --- where warnings point -------------------------------------------------------------------------------------------


def few(arm: Case) -> dc.Measurements:
    return arm.train.rows(slice(8))


def with_an_offset(arm: Case) -> dc.Measurements:
    """Of the elbow; and a wrist that never moves."""
    q = arm.train.q[:16].clone()
    q[:, 5] = 0.1
    points = arm.result.registration.geometry.points(q)
    q[:, 2] += 0.3
    return dc.Measurements(q, points)


def overstated(arm: Case, std: float = 1e-3) -> dc.Measurements:
    """By a factor of fifty."""
    return dc.Measurements(arm.train.q[:30], arm.train.points[:30], std=std)


def in_another_unit(arm: Case) -> dc.Measurements:
    """0.02 mm that were given as 0.02 m."""
    return overstated(arm, 2e-2)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (few, ["too few"]),
        (with_an_offset, ["never moved", "joint offsets"]),
        (overstated, ["leave-one-out errors contradict the selected scales", "check `std`"]),
        (in_another_unit, ["leave-one-out errors contradict the selected scales", "check `std`"]),
    ],
)
def test_warnings_point_at_the_caller(spoil: Callable[[Case], dc.Measurements], words: list[str], arm: Case) -> None:
    """However deep in the package they are found."""
    with pytest.warns(DiffeoCalibWarning) as caught:
        dc.calibrate(arm.robot, spoil(arm))
    messages = [str(w.message) for w in caught]
    assert all(any(word in message for message in messages) for word in words), messages
    assert [(str(w.message), w.filename) for w in caught if w.filename != __file__] == []
