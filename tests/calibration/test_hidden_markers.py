"""Hidden markers: the same as a second implementation that drops their coordinates, and from table to report."""

from __future__ import annotations

from math import nan
from typing import Any

import pytest
import torch
from process_bank import case
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.choose_scales import robot_problem
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.robots import SimulatedArm


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
    with pytest.raises(MeasurementError, match="marker 1 is hidden in all 10 rows"):
        dc.calibrate(arm.nominal, data.rows(slice(10, None)))
    with pytest.raises(MeasurementError, match="never show marker 1"):
        register(arm.nominal, q[10:], points[10:])


# --- from the table to the report -------------------------------------------------------------------------------------

COUNT, WRONG_ROW = 40, 7


def three_markers(*, worn: float = 1.0) -> SimulatedArm:
    return SimulatedArm(seed=0, markers=3).worn(2, worn)


def with_gaps(data: dc.Measurements, seed: int, share: float = 0.3) -> dc.Measurements:
    """The same rows without some markers."""
    gone = torch.rand(data.points.shape[:2], generator=torch.Generator().manual_seed(seed)) < share
    gone[gone.all(1), 0] = False
    return dc.Measurements(data.q, data.points.masked_fill(gone[..., None], nan), data.joint_names)


def rows(count: int, seed: int, robot: SimulatedArm | None = None) -> dc.Measurements:
    robot = robot or three_markers()
    return dc.Measurements(*robot.measure(count, seed=seed), robot.nominal.joint_names)


@pytest.fixture(scope="module")
def some() -> dc.Measurements:
    """Rows with gaps, one of them with a wrong marker beside a hidden one."""
    data = with_gaps(rows(COUNT, 1), 0)
    points = data.points.clone()
    points[WRONG_ROW] = rows(COUNT, 1).points[WRONG_ROW]
    points[WRONG_ROW, 0], points[WRONG_ROW, 2, 1] = nan, points[WRONG_ROW, 2, 1] + 2e-3
    return dc.Measurements(data.q, points, data.joint_names)


@pytest.fixture(scope="module")
def result(some: dc.Measurements) -> Any:
    return dc.calibrate(three_markers().nominal, some)


@pytest.mark.slow
def test_only_the_wrong_marker_loses_its_weight(result: Any) -> None:
    (found,) = result.outliers
    assert (found.row, found.marker) == (WRONG_ROW, 2)
    assert "marker 2 alone is off" in found.reason
    weights = result.tails.weights[WRONG_ROW]
    assert float(weights[2]) < 0.1 < float(weights[1])
    assert float(weights[0]) == 1.0
