"""Unusual data, and rows that cannot belong to the robot: refused if a mistake explains them, else with a warning."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from math import inf, nan, pi
from typing import Any

import pytest
import torch
from kind_bank import kind_named
from numbers_bank import inside, normal, rms, tensor
from product_bank import Case, covered, erring, simulated, with_usual_scales
from robots_bank import limited
from table_bank import refused, warned
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration import calibrate, choose_scales
from diffeo_calib.calibration.diagnostics.plausibility import check_identification, check_joints, check_limits
from diffeo_calib.calibration.identification import identification
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register, register_inliers
from diffeo_calib.calibration.scales import leave_one_out
from diffeo_calib.common.device import seeded
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.fitting import fit as fitting
from diffeo_calib.robots import Joint, SimulatedArm


@pytest.mark.slow
def test_few_poses_with_many_repeats_are_few_poses() -> None:
    """Repeats determine the noise, not the robot: its 95 % regions have to stay wide."""
    arm, train, test = simulated(8)
    noise = normal(144, 1, 3, size=2e-5)
    data = dc.Measurements(train.q.repeat(18, 1), train.points.repeat(18, 1, 1) + noise)
    with pytest.warns(DiffeoCalibWarning, match="8 different poses are too few to select scales"):
        result = dc.calibrate(arm.nominal, data)
    assert covered(result.model, test) > 0.85
    with pytest.warns(DiffeoCalibWarning, match="too few to select scales"):  # which the registration fits exactly
        dc.calibrate(arm.nominal, dc.Measurements(train.q[:3], train.points[:3], std=2e-5))


@pytest.mark.slow
def test_deviations_of_each_coordinate(arm: Case) -> None:
    """A device that sees depth badly: x is known to 0.5 mm only."""
    std = tensor([5e-4, 2e-5, 2e-5]).expand(60, 1, 3)
    points = arm.train.points + normal(60, 1, 1, seed=8) * tensor([5e-4, 0.0, 0.0])
    scales = arm.result.selection.scales
    given = dc.calibrate(arm.robot, dc.Measurements(arm.train.q, points, std=std), hyperparameters=scales)
    alike = replace(scales, sensor_noise=scales.sensor_noise.new_tensor(3e-4))  # in all directions
    unknown = dc.calibrate(arm.robot, dc.Measurements(arm.train.q, points), hyperparameters=alike)
    assert dc.evaluate(given.model, arm.test).rms < 0.8 * dc.evaluate(unknown.model, arm.test).rms
    noise = given.model.map.noise.covariance.diagonal(dim1=1, dim2=2)
    assert float(noise[:, 0].min()) > 4e-4**2
    assert float(noise[:, 1:].max()) < 2e-4**2


@pytest.mark.slow
@pytest.mark.parametrize(("joints", "rows", "gain"), [(11, 60, 0.5), (3, 40, 0.9), (1, 20, 1.0)])
def test_other_numbers_of_joints(joints: int, rows: int, gain: float) -> None:
    """Axes that turn against each other by right angles."""
    robot = dc.from_dh([(0.03 * k, math.pi / 2 * (-1) ** k, 0.3 - 0.02 * k) for k in range(joints)])
    train, test = (erring(robot, count, seed, noise=2e-5) for count, seed in ((rows, 1), (300, 5)))
    result = with_usual_scales(robot, train)
    assert result.fit.converged
    assert len(result.parts) == joints + 5
    geometry = dc.evaluate(result.identification.geometry.points, test).rms
    assert dc.evaluate(result.model, test).rms < gain * geometry


@pytest.mark.slow
def test_many_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sample stands for all rows, but each is fitted and judged: a wrong one is found that is in none."""
    arm, rows, sampled, wrong = SimulatedArm(seed=4), 240, 60, 5
    for where, name in (
        (identification, "COORDINATES"),
        (choose_scales, "MOST_COORDINATES"),
        (fitting, "SAMPLE_COORDINATES"),
        (calibrate, "MAX_DENSE"),
        (leave_one_out, "BLOCK_COORDINATES"),
    ):
        monkeypatch.setattr(where, name, 3 * sampled)
    monkeypatch.setattr(calibrate, "AUTO_CONTROLS", 40)
    q, points = arm.measure(rows, seed=5)
    points[wrong, 0, 0] += 0.02
    assert wrong not in torch.randperm(rows, generator=seeded(0))[:sampled]
    result = with_usual_scales(arm.nominal, dc.Measurements(q, points))
    assert len(result.model.map.deformation.x) == 40
    assert torch.equal(result.model.configurations, q)
    assert result.leave_one_out.errors.shape == (rows, 3)
    assert result.leave_one_out.effective is None, "several blocks"
    assert result.tails.weights.shape == result.identification.tails.weights.shape == (rows, 1)
    assert int(result.identification.tails.weights.argmin()) == wrong
    assert [one.row for one in result.outliers] == [wrong]
    assert result.fit.converged
    others = arm.sample(300, seed=9)
    errors = arm.true_points(others) - result.model(others).detach()
    assert rms(errors) < 0.22 * rms(arm.true_points(others) - result.identification.geometry.points(others))
    assert inside(errors, result.model.predict(others)[1]) > 0.9


def test_identification_ignores_hidden_markers_exactly() -> None:
    """With half of the rows entirely doubled but hidden, nothing changes."""
    arm = SimulatedArm(seed=3, markers=2)
    q, points = arm.measure(30, seed=4)
    split = torch.full((60, 2, 3), nan, dtype=torch.float64)
    split[:30, 0], split[30:, 1] = points[:, 0], points[:, 1]
    whole, parts = register(arm.nominal, q, points), register(arm.nominal, q.repeat(2, 1), split)
    assert_close(parts.geometry.tool, whole.geometry.tool, rtol=0, atol=1e-9)
    noise = 2e-5
    one = identify(whole.geometry, q, points, noise)
    two = identify(whole.geometry, q.repeat(2, 1), split, noise)
    assert float(((two.theta - one.theta) / one.deviations).abs().max()) < 1e-3
    assert_close(two.covariance, one.covariance, rtol=1e-6, atol=1e-15)
    assert two.rms == pytest.approx(one.rms, rel=1e-9)


def test_marker_that_no_row_shows_is_refused() -> None:
    arm = SimulatedArm(seed=3, markers=2)
    q, points = arm.measure(20, seed=4)
    points[10:, 1] = nan
    data = dc.Measurements(q, points, arm.nominal.joint_names)
    refused(
        ("marker 1: hidden in all 10 rows", lambda: dc.calibrate(arm.nominal, data.rows(slice(10, None)))),
        ("never show marker 1", lambda: register(arm.nominal, q[10:], points[10:])),
    )


NOT_THIS_ROBOT = "the measurements do not fit this robot"
ARM, ROWS, _ = simulated(30)
ROBOT, Q, POINTS = ARM.nominal, ROWS.q, ROWS.points


@pytest.mark.parametrize(
    ("q", "points", "words"),
    [
        (180 / pi * Q, POINTS, "the joint values seem to be degrees.*check the angle unit"),
        (Q, POINTS.roll(1, 0), "one row too late: pair every configuration"),
        (torch.cat([Q[:, :3], Q[:, 3:4].roll(1, 0), Q[:, 4:]], 1), POINTS, "those of the row before: pair them"),
        (Q, torch.cat([POINTS[:15].roll(1, 0), POINTS[15:]]), ""),
    ],
)
def test_a_mistake_that_explains_the_rows_is_named(q: Tensor, points: Tensor, words: str) -> None:
    """Others: test_other_readings.py. A sign of the first joint is another frame, and cannot be noticed."""
    with pytest.raises(MeasurementError, match=f"{NOT_THIS_ROBOT}.*{words}"):
        dc.calibrate(ROBOT, dc.Measurements(q, points, doubt=False))


@pytest.mark.parametrize("name", ["poses", "several tips"])
def test_poses_in_another_unit_of_lengths_are_told_so(name: str) -> None:
    """The points that represent a pose keep a size of their own, which no check of sizes sees."""
    kind = kind_named(name)
    frames = kind.data.frames.clone()
    frames[..., :3, 3] *= 1e-3
    on = None if kind.data.on is None else kind.data.on[::3]
    poses = frames if frames.shape[1] > 1 else frames[:, 0]
    data = dc.Measurements.from_poses(kind.data.q, poses, kind.data.joint_names, on=on)
    with pytest.raises(MeasurementError, match=r"positions seem to be 1000 times too small.*check their unit"):
        dc.calibrate(kind.robot, data, hyperparameters=kind.scales)


def test_rows_that_cannot_be_those_of_the_robot_are_refused() -> None:
    def calibrated(q: Tensor, points: Tensor, **names: Any) -> Callable[[], object]:
        return lambda: dc.calibrate(ROBOT, dc.Measurements(q, points, **names))

    still, numbered = POINTS[:1].expand_as(POINTS).clone(), [f"q{k}" for k in range(1, 7)]
    refused(
        (r"never move.* got 0 m; .*a ball in one hand that rests in sockets", calibrated(Q, still)),
        (r"expected 6 joints .waist_joint.*, got 5; check the base and tip", calibrated(Q[:, :5], POINTS)),
        ("put the columns in the robot's order", calibrated(Q, POINTS, joint_names=ROBOT.joint_names[::-1])),
        (r"got \S*q1.*joints=.*from_dh\(\.\.\., names=", calibrated(Q, POINTS, joint_names=numbered)),
        (r"at least 3 poses, got .*measure more poses", calibrated(Q[:1], POINTS[:1])),
        (r"at least 3 poses, got .*measure more poses", calibrated(Q[:2], POINTS[:2])),
        (r"same configuration|does not move", calibrated(Q[:1].repeat(30, 1), POINTS[:1] + 1e-5 * normal(30, 1, 3))),
    )


@pytest.mark.filterwarnings("ignore:rail. never moved")
def test_a_rail_that_stands_still_is_calibrated() -> None:
    """Its values, near zero, are near a multiple of any step."""
    q, y = ARM.measure(40, seed=2)
    rail = Joint("rail", "prismatic", torch.eye(4, dtype=torch.float64), lower=-1.0, upper=1.0)
    robot = dc.Chain("on a rail", "ground", ROBOT.tip, [rail, *ROBOT.joints])
    places = 1e-6 * torch.arange(40, dtype=torch.float64).remainder(53)
    data = dc.Measurements(torch.cat([places[:, None], q], 1), (1e6 * y).round() / 1e6)
    assert with_usual_scales(robot, data).left_out_rms < 2e-4


def test_a_slide_moves_relative_to_its_stroke() -> None:
    robot = limited(("revolute", -1.0, 1.0), ("prismatic", 0.0, 0.084))
    angles, places = torch.linspace(-1, 1, 9, dtype=torch.float64), torch.zeros(9, 1, 3, dtype=torch.float64)
    moved, hardly = (dc.Measurements(torch.stack([angles, 0.02 + s * angles], 1), places) for s in (0.016, 0.001))
    check_joints(robot, moved)  # a warning fails this test
    with pytest.warns(DiffeoCalibWarning, match="^j1: hardly moved"):
        check_joints(robot, hardly)


@pytest.mark.slow
def test_rows_that_no_reading_explains_are_calibrated_with_a_warning() -> None:
    """In any order; and with a tip before the joint that carries the marker."""
    mixed = POINTS[torch.randperm(30, generator=torch.Generator().manual_seed(0))]
    result, texts = warned(with_usual_scales, ROBOT, dc.Measurements(Q, mixed))
    assert math.isfinite(result.left_out_rms)
    assert any(f"{NOT_THIS_ROBOT}, even with geo" in one for one in texts)
    short = dc.Chain("short", "base_link", "wrist_link", ROBOT.joints[:-2])
    data = dc.Measurements(Q[:, :5], POINTS)
    start = register_inliers(short, data)[0].geometry
    with pytest.warns(DiffeoCalibWarning, match=r"do not fit this robot, even with .* the tip link or DH convention"):
        check_identification(data, identify(start, data.q, data.points))


@pytest.mark.slow
def test_a_joint_offset_is_reported_and_calibrated(arm: Case) -> None:
    """Far larger than geometric errors are expected to be: the accuracy hardly suffers."""
    shift = tensor([0.0, 0.0, 0.0, 0.0, math.radians(-30), 0.0])
    words = r"^joint offsets are far .*: wrist_bend_joint by (-?\d+\.\d) degrees: got"
    with pytest.warns(DiffeoCalibWarning, match=words):
        result = with_usual_scales(arm.robot, dc.Measurements(arm.train.q + shift, arm.train.points))
    held_out = dc.evaluate(result.model, dc.Measurements(arm.test.q + shift, arm.test.points)).rms
    assert held_out < 1.7 * arm.held_out()[-1]
    shift = tensor([0.0, 0.04, -0.04, 0.0, 0.03, 0.0])
    with pytest.warns(DiffeoCalibWarning, match="joint offsets are far.*: shoulder_joint by .*elbow_joint by .* degr"):
        with_usual_scales(arm.robot, dc.Measurements(arm.train.q + shift, arm.train.points))


@pytest.mark.slow
def test_a_joint_that_never_moves_is_predicted_where_it_stands() -> None:
    """Its warning names it, and the model does not invent errors of it."""
    arm, train, test = simulated(40)
    q, other = train.q.clone(), test.q.clone()
    q[:, 5], other[:, 5] = -0.7, -0.7
    data = dc.Measurements(q, arm.true_points(q) + 2e-5 * normal(40, 1, 3, seed=1))
    result, (text,) = warned(with_usual_scales, arm.nominal, data)
    assert text.startswith("wrist_roll_joint: never moved in these measurements")
    there = dc.Measurements(other, arm.true_points(other))
    geometry = dc.evaluate(result.identification.geometry.points, there).rms
    assert dc.evaluate(result.model, there).rms < 0.25 * geometry
    (part,) = [part for part in result.parts if part.name == "transmission of wrist_roll_joint"]
    assert part.displacement < 1e-4


def test_joints_far_beyond_their_limits_are_warned_about_in_their_own_unit() -> None:
    robot = limited(("revolute", -1.0, 1.0), ("prismatic", 0.0, 0.6), ("revolute", 0.0, 0.0), ("revolute", -inf, inf))
    for q, words in (
        ([7.48, 0.7, 3.0, 9.0], ""),  # 1.2 and a turn
        ([0.0, 8.0, 0.0, 0.0], r"^j1: far beyond .*: expected 0 to 0.6 m, got 8 to 8 m; .*not in millimetres"),
        ([9.0, 0.1, 0.0, 0.0], r"^j0: far beyond .*: expected -1 to 1 rad, got 2.72 to 2.72 rad; .*not in degrees"),
    ):
        _, texts = warned(check_limits, robot, dc.Measurements([q], [[0.0, 0.0, 0.0]]))
        assert len(texts) == bool(words)
        assert all(re.search(words, one) for one in texts)


@pytest.mark.slow
def test_markers_that_are_exchanged_in_half_of_the_rows(pair: Case) -> None:
    points = pair.train.points.clone()
    points[:20] = points[:20, [1, 0]]
    _, texts = warned(with_usual_scales, pair.robot, dc.Measurements(pair.train.q, points))
    assert any(re.search(r"rows are outliers.*markers (0 and 1|1 and 0) seem to be exchanged", one) for one in texts)


def test_poses_commanded_in_whole_degrees_are_calibrated() -> None:
    """An elastic arm that errs by a millimetre, which steps of 1 degree would explain if they were reported so."""
    arm = SimulatedArm(seed=1, gravity=2.0)
    q = arm.sample(40, 3).rad2deg().round().deg2rad()
    points = (arm.true_points(q) + arm.noise * normal(40, 1, 3)).round(decimals=6)
    result = with_usual_scales(arm.nominal, dc.Measurements(q, points))
    assert 5e-4 < result.registration.rms < 5e-3
    assert result.left_out_rms < 0.3 * result.registration.rms
    assert math.isfinite(result.expected.workspace)
