"""Unusual data: other numbers of joints, repeats, known deviations, and markers that some rows hide."""

import math
from dataclasses import replace
from math import nan

import numpy as np
import pytest
import torch
from process_bank import case
from product_bank import Case, simulated, with_usual_scales
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration import calibrate, choose_scales
from diffeo_calib.calibration.choose_scales import robot_problem
from diffeo_calib.calibration.identification import identification
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.calibration.scales import leave_one_out
from diffeo_calib.common.device import seeded
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.fitting import fit as fitting
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.robots import Geometry, SimulatedArm


def held_out(result: dc.CalibrationResult, test: dc.Measurements) -> float:
    return dc.evaluate(result.model, test).rms


@pytest.mark.slow
def test_few_poses_with_many_repeats_are_few_poses() -> None:
    """Repeats determine the noise, not the robot: its 95 % regions have to stay wide."""
    arm, train, test = simulated(8)
    noise = 2e-5 * torch.randn(144, 1, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    data = dc.Measurements(train.q.repeat(18, 1), train.points.repeat(18, 1, 1) + noise)
    with pytest.warns(DiffeoCalibWarning, match="8 different poses are too few to select scales"):
        result = dc.calibrate(arm.nominal, data)
    mean, covariance = result.model.predict(test.q)
    error = (test.points - mean)[:, 0, :, None]
    squares = (error.mT @ torch.linalg.solve(covariance[:, 0], error)).flatten()
    assert float((squares < 7.81).double().mean()) > 0.85
    with pytest.warns(DiffeoCalibWarning, match="too few to select scales"):  # which the registration fits exactly
        dc.calibrate(arm.nominal, dc.Measurements(train.q[:3], train.points[:3], std=2e-5))


@pytest.mark.slow
def test_deviations_of_each_coordinate(arm: Case) -> None:
    """A device that sees depth badly: x is known to 0.5 mm only."""
    std = torch.tensor([5e-4, 2e-5, 2e-5], dtype=torch.float64).expand(60, 1, 3)
    draw = torch.from_numpy(np.random.default_rng(8).standard_normal((60, 1, 1)))
    points = arm.train.points + draw * torch.tensor([5e-4, 0.0, 0.0], dtype=torch.float64)
    scales = arm.result.selection.scales
    given, unknown = (
        dc.calibrate(arm.robot, dc.Measurements(arm.train.q, points, std=own), hyperparameters=scales)
        for own in (std, None)
    )
    assert held_out(given, arm.test) < 0.8 * held_out(unknown, arm.test)
    noise = given.model.map.noise.covariance.diagonal(dim1=1, dim2=2)
    assert float(noise[:, 0].min()) > 4e-4**2
    assert float(noise[:, 1:].max()) < 2e-4**2


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


@pytest.mark.slow
@pytest.mark.parametrize(("joints", "rows", "gain"), [(11, 60, 0.5), (3, 40, 0.9), (1, 20, 1.0)])
def test_other_numbers_of_joints(joints: int, rows: int, gain: float) -> None:
    robot = random_chain(joints)
    train, test = random_measurements(robot, rows, 1), random_measurements(robot, 300, 5)
    result = with_usual_scales(robot, train)
    assert result.fit.converged
    assert len(result.parts) == joints + 5
    geometry = dc.evaluate(result.identification.geometry.points, test).rms
    assert held_out(result, test) < gain * geometry


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
    errors, covariance = (arm.true_points(others) - result.model(others))[:, 0], result.model.predict(others)[1][:, 0]
    geometry = arm.true_points(others) - result.identification.geometry.points(others)
    assert float(errors.square().mean()) < 0.05 * float(geometry.square().mean())
    squares = (errors[:, None] @ torch.linalg.solve(covariance, errors[:, :, None])).flatten()
    assert float((squares < 7.8147).double().mean()) > 0.9


def test_exact_model_is_conditioned_on_the_seen_coordinates_alone() -> None:
    one = case("hidden markers")
    problem = robot_problem(one.data, one.scales)
    model = fit(problem, GaussNewton(tolerance=1e-9)).model
    value, at = model.geodesic.linearised_value(one.data.x)
    G, R = at.gram(), torch.block_diag(*model.noise.covariance)
    seen = one.data.visible.flatten()
    p = model.geodesic.end_momenta.reshape(-1)
    residual = (problem.y - value).flatten()
    assert_close(R[seen][:, seen] @ p[seen], residual[seen], rtol=1e-5, atol=1e-11)  # p = R^-1 (y - k1)
    new = SimulatedArm(seed=3, markers=3).sample(5, seed=8)
    mean, covariance = model.predict(new, noise=False)
    there = model.geodesic.linearise(new)
    cross = at.gram(there)
    K = (G + R)[seen][:, seen]
    expected = there.gram() - cross[seen].mT @ torch.linalg.solve(K, cross[seen])
    blocks = torch.stack([expected[9 * k : 9 * k + 9, 9 * k : 9 * k + 9] for k in range(5)])
    assert_close(covariance, blocks, rtol=1e-5, atol=1e-13)
    assert bool(mean.isfinite().all())
    measured = model.measured()
    assert_close(measured.flatten()[seen], problem.y.flatten()[seen], rtol=0, atol=1e-8)


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
    with pytest.raises(MeasurementError, match="marker 1: hidden in all 10 rows"):
        dc.calibrate(arm.nominal, data.rows(slice(10, None)))
    with pytest.raises(MeasurementError, match="never show marker 1"):
        register(arm.nominal, q[10:], points[10:])
