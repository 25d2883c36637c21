"""Measurements as they come: wrong ones are refused or doubted, odd but honest ones are calibrated."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from itertools import combinations
from math import inf

import numpy as np
import pytest
import torch
from product_bank import Case, simulated
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.plausibility import check_limits
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.joint import Joint

pytestmark = pytest.mark.slow  # calibrations by the dozen

NOT_THIS_ROBOT = "the measurements do not fit this robot"


def held_out(result: dc.CalibrationResult, test: dc.Measurements) -> float:
    return dc.evaluate(result.model, test).rms


# --- refused --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("columns", list(combinations(range(6), 2)))
def test_two_joint_columns_swapped(columns: tuple[int, int], arm: Case) -> None:
    order = list(range(6))
    first, second = columns
    order[first], order[second] = second, first
    words = rf"the columns of {arm.robot.joint_names[first]} and {arm.robot.joint_names[second]} seem to be exchanged"
    with pytest.raises(MeasurementError, match=rf"{NOT_THIS_ROBOT}.*; {words}"):
        dc.calibrate(arm.robot, dc.Measurements(arm.train.q[:, order], arm.train.points))


@pytest.mark.parametrize("joint", range(1, 6))
def test_a_joint_with_the_opposite_sign(joint: int, arm: Case) -> None:
    """The first joint's is another frame of the device and cannot be noticed but by its mirrored errors."""
    q = arm.train.q.clone()
    q[:, joint] *= -1
    words = f"{arm.robot.joint_names[joint]} seems to count the other way"
    with pytest.raises(MeasurementError, match=f"{NOT_THIS_ROBOT}.*; {words}"):
        dc.calibrate(arm.robot, dc.Measurements(q, arm.train.points))


def test_points_in_a_left_handed_frame(arm: Case) -> None:
    for points in (arm.train.points[..., [1, 0, 2]], arm.train.points * torch.tensor([1.0, 1.0, -1.0])):
        with pytest.raises(MeasurementError, match=f"{NOT_THIS_ROBOT}.*; .* seems to be left-handed"):
            dc.calibrate(arm.robot, dc.Measurements(arm.train.q, points))


def test_a_zero_of_a_joint_elsewhere(arm: Case) -> None:
    q = arm.train.q.clone()
    q[:, 2] += math.pi / 2
    with pytest.raises(MeasurementError, match=rf"{NOT_THIS_ROBOT}.*; the zero of elbow_joint .* -90 degrees added"):
        dc.calibrate(arm.robot, dc.Measurements(q, arm.train.points))


def test_a_tip_before_the_joint_that_carries_the_marker(arm: Case) -> None:
    short = dc.Chain("short", "base_link", "wrist_link", arm.robot.joints[:-2])
    assert short.n == 5
    with pytest.raises(MeasurementError, match=NOT_THIS_ROBOT + r", even with geometric errors.*check .* the tip link"):
        dc.calibrate(short, dc.Measurements(arm.train.q[:, :5], arm.train.points))


def test_degrees_instead_of_radians(arm: Case) -> None:
    data = dc.Measurements(180 / math.pi * arm.train.q, arm.train.points, doubt=False)
    with pytest.raises(MeasurementError, match=f"{NOT_THIS_ROBOT}.*; the joint values seem to be degrees"):
        dc.calibrate(arm.robot, data)


def test_inverted_poses(posed: Case) -> None:
    poses = posed.train.poses
    assert poses is not None
    data = dc.Measurements.from_poses(posed.train.q, torch.linalg.inv(poses))
    with pytest.raises(MeasurementError, match=f"{NOT_THIS_ROBOT}.*; the poses seem to be inverted"):
        dc.calibrate(posed.robot, data)


@pytest.mark.parametrize("rows", [30, 60])
def test_many_rows_with_the_points_of_others(rows: int, arm: Case) -> None:
    points = arm.train.points.clone()
    points[:rows] = points[:rows].roll(1, 0)
    with pytest.raises(MeasurementError, match=NOT_THIS_ROBOT):
        dc.calibrate(arm.robot, dc.Measurements(arm.train.q, points))


@pytest.mark.filterwarnings("ignore:a marker or the tool")
def test_markers_that_are_exchanged_in_half_of_the_rows(pair: Case) -> None:
    points = pair.train.points.clone()
    points[:20] = points[:20, [1, 0]]
    with pytest.warns(
        DiffeoCalibWarning, match=r"rows contradict the others.*markers (0 and 1|1 and 0) seem to be exchanged"
    ):
        dc.calibrate(pair.robot, dc.Measurements(pair.train.q, points))


def test_few_poses_with_many_repeats_are_few_poses() -> None:
    """Repeats tell noise, nothing about the robot: its 95 % regions have to stay wide."""
    arm, train, test = simulated(8)
    noise = 2e-5 * torch.randn(144, 1, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    data = dc.Measurements(train.q.repeat(18, 1), train.points.repeat(18, 1, 1) + noise)
    with pytest.warns(DiffeoCalibWarning, match="8 different poses are too few to select scales"):
        result = dc.calibrate(arm.nominal, data)
    mean, covariance = result.model.predict(test.q)
    error = (test.points - mean)[:, 0, :, None]
    squares = (error.mT @ torch.linalg.solve(covariance[:, 0], error)).flatten()
    assert float((squares < 7.81).double().mean()) > 0.85


@pytest.mark.parametrize("rows", [3, 5])
def test_few_poses_with_honest_deviations_are_not_refused(rows: int) -> None:
    """Base and marker alone fit three poses exactly: that says nothing against the deviations."""
    arm, train, _ = simulated(rows)
    with pytest.warns(DiffeoCalibWarning, match="too few to select scales"):
        dc.calibrate(arm.nominal, dc.Measurements(train.q, train.points, std=2e-5))


def test_deviations_in_another_unit() -> None:
    arm, train, _ = simulated(30)
    data = dc.Measurements(train.q, train.points, std=0.02)  # mm that were meant
    with pytest.raises(MeasurementError, match=r"given standard deviations cannot be right.*check `std` and its unit"):
        dc.calibrate(arm.nominal, data)


# --- doubted --------------------------------------------------------------------------------------------------------


def test_a_robot_that_is_quite_another_is_doubted() -> None:
    """Joints that err by 0.05 rad: no usual arm, but it might be one."""
    arm, train, test = simulated(30, transmission=200)
    with pytest.warns(DiffeoCalibWarning, match=NOT_THIS_ROBOT + r", even with geometric errors.*median of 0\.0"):
        result = dc.calibrate(arm.nominal, train)
    assert held_out(result, test) < dc.evaluate(result.identification.geometry.points, test).rms


@pytest.mark.parametrize("degrees", [10, -30])
def test_a_zero_that_is_off_is_told_and_calibrated(degrees: float, arm: Case) -> None:
    """Far beyond what geometric errors are expected to be: hardly anything of the accuracy is lost."""
    shift = torch.zeros(6, dtype=torch.float64)
    shift[4] = math.radians(degrees)
    with pytest.warns(DiffeoCalibWarning, match=r"zeros of joints.*: wrist_bend_joint by (-?\d+\.\d) degrees: got"):
        result = dc.calibrate(arm.robot, dc.Measurements(arm.train.q + shift, arm.train.points))
    test = dc.Measurements(arm.test.q + shift, arm.test.points)
    assert held_out(result, test) < 1.7 * arm.held_out()[-1]
    assert held_out(result, test) < 0.3 * dc.evaluate(result.identification.geometry.points, test).rms


def test_small_zeros_of_several_joints_are_named(arm: Case) -> None:
    shift = torch.tensor([0.0, 0.04, -0.04, 0.0, 0.03, 0.0], dtype=torch.float64)
    with pytest.warns(
        DiffeoCalibWarning, match=r"zeros of joints.*: shoulder_joint by .*elbow_joint by .* degrees: got"
    ):
        dc.calibrate(arm.robot, dc.Measurements(arm.train.q + shift, arm.train.points))


def test_overstated_deviations_are_doubted() -> None:
    arm, train, _ = simulated(30)
    data = dc.Measurements(train.q, train.points, std=1e-3)  # fifty times the truth
    with pytest.warns(DiffeoCalibWarning, match=r"leave-one-out errors contradict the selected scales.*check `std`"):
        dc.calibrate(arm.nominal, data)


def test_a_joint_that_never_moves_is_predicted_where_it_stands() -> None:
    """Its warning names it, and nothing is invented about it."""
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


def test_joints_far_beyond_their_limits_are_doubted_in_their_own_unit() -> None:
    robot = limited(("revolute", -3.0, 3.0), ("prismatic", 0.0, 0.6), ("revolute", 0.0, 0.0), ("revolute", -inf, inf))
    fine = dc.Measurements([[3.5, 0.7, 3.0, 9.0]], [[0.0, 0.0, 0.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_limits(robot, fine)
    slid = dc.Measurements([[0.0, 8.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    turned = dc.Measurements([[9.0, 0.1, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    for data, words in (
        (slid, r"^j1: far beyond the robot's limits: expected 0 to 0.6 m, got 8 to 8 m; .*not in millimetres"),
        (turned, r"^j0: far beyond the robot's limits: expected -3 to 3 rad, got 9 to 9 rad; .*not in degrees"),
    ):
        with pytest.warns(DiffeoCalibWarning, match=words) as caught:
            check_limits(robot, data)
        assert len(caught) == 1


def test_a_joint_whose_zero_cannot_be_noticed_is_doubted_by_its_limits(arm: Case) -> None:
    """The first joint's zero is absorbed by where the measuring device stands."""
    q = arm.train.q[:14].clone()
    q[:, 0] += 2 * math.pi
    with pytest.warns(DiffeoCalibWarning, match="^waist_joint: far beyond the robot's limits"):
        dc.calibrate(arm.robot, dc.Measurements(q, arm.train.points[:14]))


# --- few and many ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [3, 7])
def test_few_poses_fall_back_and_are_not_worse_than_the_registration(rows: int) -> None:
    arm, train, test = simulated(rows)
    with pytest.warns(DiffeoCalibWarning, match=rf"^{rows} poses are too few to select scales: defaults are used"):
        result = dc.calibrate(arm.nominal, train)
    assert result.fit.converged
    assert result.outliers == []
    assert held_out(result, test) < 1.1 * dc.evaluate(result.registration.geometry.points, test).rms
    assert bool(torch.isfinite(result.model.predict(test.q[:5])[1]).all())


def repeated(rows: int, times: int) -> tuple[dc.Chain, dc.Measurements, dc.Measurements, dc.Measurements]:
    """Robot, rows configurations, the same approached and measured many times, others to test."""
    arm, train, test = simulated(rows)
    rng = np.random.default_rng(1)
    q = train.q.repeat(times, 1)
    points = arm.true_points(q) + 2e-5 * torch.from_numpy(rng.standard_normal((len(q), 1, 3)))
    read = q + 1e-6 * torch.from_numpy(rng.standard_normal(tuple(q.shape)))
    return arm.nominal, train, dc.Measurements(read, points), test


def test_repeats_do_not_break_the_fit() -> None:
    robot, _, often, test = repeated(15, 3)
    many = dc.calibrate(robot, often)
    assert many.fit.converged
    assert many.outliers == []
    assert held_out(many, test) < dc.evaluate(many.identification.geometry.points, test).rms
    noise = many.selection.scales.sensor_noise  # the spread of the repeats says what is noise
    assert float(noise) == pytest.approx(2e-5, rel=0.3)


@pytest.mark.slow
def test_300_rows_of_30_poses() -> None:
    robot, once, often, test = repeated(30, 10)
    assert len(often) == 300
    result = dc.calibrate(robot, often)
    assert result.fit.converged
    assert len(result.outliers) <= 1
    assert held_out(result, test) < held_out(dc.calibrate(robot, once), test)


# --- known standard deviations --------------------------------------------------------------------------------------


def mixed() -> tuple[dc.Chain, Tensor, Tensor, Tensor, dc.Measurements]:
    """Every other row measured fifty times worse: robot, q, points, standard deviations, test."""
    arm, train, test = simulated(44)
    std = torch.where(torch.arange(44) % 2 == 0, 1e-3, 2e-5).double()
    draw = torch.from_numpy(np.random.default_rng(5).standard_normal((44, 1, 3)))
    return arm.nominal, train.q, arm.true_points(train.q) + std[:, None, None] * draw, std, test


def test_known_deviations_weigh_the_rows() -> None:
    robot, q, points, std, test = mixed()
    told = dc.calibrate(robot, dc.Measurements(q, points, std=std))
    silent = dc.calibrate(robot, dc.Measurements(q, points))
    assert held_out(told, test) < 0.8 * held_out(silent, test)
    assert told.outliers == []
    noise = told.model.map.noise.covariance.diagonal(dim1=1, dim2=2).mean(1).sqrt()
    assert float(noise[::2].min()) > 0.9e-3
    assert float(noise[1::2].max()) < 2e-4


@pytest.mark.slow
def test_rows_that_are_known_to_be_bad_do_no_harm() -> None:
    robot, q, points, std, test = mixed()
    told = dc.calibrate(robot, dc.Measurements(q, points, std=std))
    good = dc.calibrate(robot, dc.Measurements(q[1::2], points[1::2]))
    assert held_out(told, test) < 1.1 * held_out(good, test)


@pytest.mark.slow
def test_known_deviations_that_are_too_small_leave_the_rest_to_be_estimated(arm: Case) -> None:
    data = dc.Measurements(arm.train.q, arm.train.points, std=1e-9)
    result = dc.calibrate(arm.robot, data)
    assert held_out(result, arm.test) < 1.1 * arm.held_out()[2]
    assert float(result.selection.scales.sensor_noise) > 5e-6


@pytest.mark.slow
def test_deviations_of_each_coordinate(arm: Case) -> None:
    """A device that sees depth badly: x is known to 0.5 mm only."""
    std = torch.tensor([5e-4, 2e-5, 2e-5], dtype=torch.float64).expand(60, 1, 3)
    draw = torch.from_numpy(np.random.default_rng(8).standard_normal((60, 1, 1)))
    points = arm.train.points + draw * torch.tensor([5e-4, 0.0, 0.0], dtype=torch.float64)
    told = dc.calibrate(arm.robot, dc.Measurements(arm.train.q, points, std=std))
    silent = dc.calibrate(arm.robot, dc.Measurements(arm.train.q, points))
    assert held_out(told, arm.test) < 0.8 * held_out(silent, arm.test)
    noise = told.model.map.noise.covariance.diagonal(dim1=1, dim2=2)
    assert float(noise[:, 0].min()) > 4e-4**2
    assert float(noise[:, 1:].max()) < 2e-4**2


# --- poses, other robots, other ways --------------------------------------------------------------------------------


def test_orientation_errors_fall_below_those_of_geometry(posed: Case) -> None:
    errors = [dc.evaluate(stage, posed.test) for stage in posed.result.stages.values()]
    assert errors[2].rms < 0.2 * errors[1].rms
    angles = [found.angle_rms or 0.0 for found in errors]
    assert 0 < angles[2] < 0.4 * angles[1]
    assert angles[2] < 0.03  # the noise of three points with 0.02 mm at 0.1 m is 0.016 deg
    assert 1e-5 < float(posed.result.selection.scales.rotation_noise) < 5e-4


def random_chain(joints: int) -> dc.Chain:
    """Axes that turn against each other by right angles."""
    rng = np.random.default_rng(0)
    rows = [(float(rng.uniform(0, 0.2)), math.pi / 2 * (-1) ** k, float(rng.uniform(0.05, 0.3))) for k in range(joints)]
    return dc.from_dh(rows, names=[f"joint_{k}" for k in range(joints)])


def random_measurements(robot: dc.Chain, rows: int, seed: int) -> dc.Measurements:
    """Geometric errors and a transmission error with two waves per turn in every joint, noise 0.02 mm."""
    truth = replace(Geometry.nominal(robot), tool=torch.tensor([[0.05, 0.02, 0.1]], dtype=torch.float64))
    theta = 5e-4 * torch.from_numpy(np.random.default_rng(7).standard_normal(truth.size))
    theta[:6] = torch.tensor([1.0, 2.0, 0.5, 0.3, 0.2, 0.1])
    rng = np.random.default_rng(seed)
    q = torch.from_numpy(rng.uniform(-2, 2, (rows, robot.n)))
    points = truth.absorb(theta).points(q + 2e-4 * (2 * q + torch.arange(robot.n)).sin())
    return dc.Measurements(q, points + 2e-5 * torch.from_numpy(rng.standard_normal((rows, 1, 3))), robot.joint_names)


@pytest.mark.parametrize(
    ("joints", "rows", "gain"),
    [(7, 40, 0.6), pytest.param(11, 60, 0.5, marks=pytest.mark.slow), pytest.param(3, 40, 0.9, marks=pytest.mark.slow)],
)
def test_other_numbers_of_joints(joints: int, rows: int, gain: float) -> None:
    robot = random_chain(joints)
    train, test = random_measurements(robot, rows, 1), random_measurements(robot, 300, 5)
    result = dc.calibrate(robot, train)
    assert result.fit.converged
    assert len(result.parts) == joints + 5
    geometry = dc.evaluate(result.identification.geometry.points, test).rms
    assert held_out(result, test) < gain * geometry


def test_a_single_joint() -> None:
    robot = random_chain(1)
    result = dc.calibrate(robot, random_measurements(robot, 20, 1))
    assert held_out(result, random_measurements(robot, 100, 5)) < 6e-5


def test_fewer_control_points_give_the_same_model(arm: Case) -> None:
    scales = arm.result.selection.scales
    coarse = dc.calibrate(arm.robot, arm.train, hyperparameters=scales, controls=40)
    assert len(coarse.model.map.deformation.x) == 40
    assert torch.equal(coarse.model.configurations, arm.train.q)
    assert coarse.fit.converged
    assert held_out(coarse, arm.test) < 1.15 * arm.held_out()[2]
    assert [part.name for part in coarse.parts] == [part.name for part in arm.result.parts]
    for mine, full in zip(coarse.parts, arm.result.parts, strict=True):
        assert mine.displacement == pytest.approx(full.displacement, rel=0.2, abs=5e-6)
    assert bool(torch.isfinite(coarse.model.predict(arm.test.q[:3])[1]).all())
