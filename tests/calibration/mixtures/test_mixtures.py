"""Measured positions and rows in sockets in one table: accuracy, the frame of the device, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from mixture_bank import TRACKED
from simulated_sockets import SocketRows
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.moved_devices import changes_of
from diffeo_calib.calibration.identification.identification import Prior
from diffeo_calib.calibration.identification.registration import register_sockets
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.calibration.scales.cross_validation import inflation_by_places
from diffeo_calib.calibration.scales.selection import defaults, log_posterior
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.fitting.result import silent
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.regression.regions import region_factor
from diffeo_calib.robots import Geometry, SimulatedArm
from diffeo_calib.robots.se3 import twist_transform

CHI2_3 = 7.815


@pytest.fixture(scope="module")
def scales(arm: SimulatedArm, tracked: dc.Measurements) -> dc.Hyperparameters:
    noise = torch.tensor(2e-5, dtype=torch.float64)
    return replace(dc.calibrate(arm.nominal, tracked).selection.scales, other_noise=noise)


@pytest.fixture(scope="module")
def result(arm: SimulatedArm, mixture: dc.Measurements, scales: dc.Hyperparameters) -> dc.CalibrationResult:
    return dc.calibrate(arm.nominal, mixture, hyperparameters=scales)


@pytest.fixture(scope="module")
def tangent(arm: SimulatedArm, mixture: dc.Measurements) -> TangentData:
    """The mixture around its geometric calibration."""
    return place(arm.nominal, mixture, silent).tangent_data()


def rms(errors: Tensor) -> float:
    return float(errors.square().sum(-1).mean().sqrt())


def test_better_than_either_half(
    arm: SimulatedArm,
    result: dc.CalibrationResult,
    scales: dc.Hyperparameters,
    tracked: dc.Measurements,
    resting: dc.Measurements,
) -> None:
    """In the tracker's frame, where the sockets alone know no frame at all; as accurate as predicted."""
    q = arm.sample(400, seed=9)
    truth = arm.true_points(q)
    mean, covariance = result.model.predict(q, noise=False)
    errors = mean - truth.flip(1)  # the ball is last
    squares = (errors * torch.linalg.solve(covariance, errors[..., None])[..., 0]).sum(-1)
    assert float((squares < CHI2_3).double().mean()) > 0.85
    alone = replace(scales, other_noise=None)
    by_tracker = dc.calibrate(arm.nominal, tracked.rows(slice(TRACKED)), hyperparameters=alone)
    by_sockets = dc.calibrate(arm.nominal, resting, hyperparameters=alone)
    away = by_sockets.model(q)[:, 0].detach() @ arm.truth.base[:3, :3].mT + arm.truth.base[:3, 3] - truth[:, 0]
    assert rms(errors[:, 0]) < 0.8 * rms(by_tracker.model(q)[:, 0] - truth[:, 1])
    assert rms(errors[:, 1]) < 0.8 * rms(away)
    assert result.fit.converged


def test_the_sockets_are_in_the_frame_of_the_device(
    arm: SimulatedArm, result: dc.CalibrationResult, rows: SocketRows
) -> None:
    found, base = result.sockets, arm.truth.base
    assert found is not None
    assert found.by_device
    truth = torch.stack([rows.positions[name] for name in found.names]) @ base[:3, :3].mT + base[:3, 3]
    errors = (found.positions - truth).flatten()
    assert float(errors.square().mean().sqrt()) < 4e-4
    squares = float(errors @ torch.linalg.solve(found.covariance, errors))
    assert squares < 2.5 * len(errors), "as far away as the covariance says"
    assert "mm in the measuring frame, deviations 0." in found.sentences()[0]
    assert not any("smaller than the true error" in line for line in found.sentences())


def test_equivariance_under_motions_of_the_device(
    arm: SimulatedArm, mixture: dc.Measurements, scales: dc.Hyperparameters, result: dc.CalibrationResult
) -> None:
    """Another frame of the tracker is another frame of everything that was found."""
    T = twist_transform(torch.tensor([0.4, -0.2, 0.9, 0.3, 1.1, -0.5], dtype=torch.float64))
    moved = with_attributes(mixture, points=mixture.points @ T[:3, :3].mT + T[:3, 3])
    first, second = result, dc.calibrate(arm.nominal, moved, hyperparameters=scales)
    q = arm.sample(20, seed=1)
    torch.testing.assert_close(second.model(q), first.model(q) @ T[:3, :3].mT + T[:3, 3], rtol=0, atol=2e-6)
    assert first.sockets is not None
    assert second.sockets is not None
    places = first.sockets.positions @ T[:3, :3].mT + T[:3, 3]
    torch.testing.assert_close(second.sockets.positions, places, rtol=0, atol=2e-6)


def test_the_posterior_of_independent_equations(tangent: TangentData) -> None:
    """The regression with hidden coordinates and shared shifts, against one of the measured coordinates alone."""
    data, scales = tangent, defaults(tangent, 3e-4, Prior())
    kinds, shared = data.noise_model.row_kinds, data.shared
    assert kinds is not None
    assert shared is not None
    resting = kinds == 1
    assert scales.other_noise is not None
    assert not bool(shared[~resting].any()), "no position that was measured shares a shift"
    assert not bool(shared[:, :3].any())
    assert bool(shared[resting][:, 3:].any(2).all())
    scales = replace(scales, other_noise=3.0 * scales.sensor_noise)
    data = data.with_tails(replace(data.tails, weights=torch.ones_like(data.tails.weights)))
    seen = data.visible.flatten()
    levels = torch.where(resting, 3.0, 1.0).double() * scales.sensor_noise
    J = data.jacobian.flatten(0, 1)[seen]
    own = torch.arange(len(resting)).repeat_interleave(6)[seen]
    same = (own[:, None] == own).double()
    R = same * (J @ torch.diag(scales.joint_noise.square()) @ J.mT)
    R = R + torch.diag(levels[own].square() + 1e-14)
    G, Z = data.linearisation(scales).gram()[seen][:, seen], shared.flatten(0, 1)[seen]
    mu = torch.linalg.solve(G + R + Z @ Z.mT, data.target.flatten()[seen])
    found = data.numbers.in_table(data.process(scales).mu).flatten()[seen]
    assert float((found - mu).norm() / mu.norm()) < 1e-6


def test_the_device_holds_the_frame(tangent: TangentData) -> None:
    """Nothing has to be fixed: base and first joint are found with everything else."""
    assert bool(tangent.theta[:12].all())


def test_the_noise_of_sockets_is_searched(tangent: TangentData) -> None:
    """One more scale, whose slope is that of the log posterior."""
    centre = defaults(tangent, 3e-4, Prior())
    point, step = centre.logarithms() + 0.1, 1e-4
    assert len(point) == len(replace(centre, other_noise=None).logarithms()) + 1
    found = log_posterior(point, centre, tangent)
    assert found is not None
    values = []
    for sign in (-1.0, 1.0):
        moved = point.clone()
        moved[-1] += sign * step
        there = log_posterior(moved, centre, tangent)
        assert there is not None
        values.append(there.likelihood + there.prior)
    assert abs(float(found.gradient[-1])) > 1.0
    assert float(found.gradient[-1]) == pytest.approx((values[1] - values[0]) / (2 * step), rel=1e-5)
    wider = centre.inflated(2.0).other_noise
    assert wider is not None
    assert centre.other_noise is not None
    assert float(wider) == 2.0 * float(centre.other_noise)


def test_each_tracked_configuration_is_a_degree_of_freedom_beside_the_places(
    tangent: TangentData, mixture: dc.Measurements
) -> None:
    """Places that contradict each other widen the deviations as by themselves, but no more for being few."""
    places, socket, groups = mixture.places, mixture.socket, mixture.groups()
    assert places is not None
    assert socket is not None
    assert len(places.unique()) == 4 + 1, "one number for all tracked rows"
    wide = defaults(tangent, 1e-2, Prior())
    assert inflation_by_places(tangent, wide, places, socket, groups) == region_factor(4 + TRACKED, 3)
    repeated = torch.where(places < 0, groups // 5, groups)
    assert inflation_by_places(tangent, wide, places, socket, repeated) == region_factor(4 + TRACKED // 5, 3)
    narrow = defaults(tangent, 1e-5, Prior())
    found = inflation_by_places(tangent, narrow, places, socket, groups)
    assert found > 2.0 * region_factor(4 + TRACKED, 3), "contradictions are not diluted by tracked rows"
    alone = inflation_by_places(tangent, narrow, places, socket, torch.zeros_like(groups))
    assert found / region_factor(4 + TRACKED, 3) == pytest.approx(alone / region_factor(4 + 1, 3), rel=1e-9)


def test_a_known_base_is_kept(arm: SimulatedArm, resting: dc.Measurements) -> None:
    """The ball is the same in every frame, the sockets move with it."""
    assert resting.socket is not None
    bare = register_sockets(arm.nominal, resting.q, resting.socket)
    T = arm.truth.base
    placed = replace(Geometry.nominal(arm.nominal), base=T)
    found = register_sockets(placed, resting.q, resting.socket)
    torch.testing.assert_close(found.identification.geometry.tool, bare.identification.geometry.tool)
    torch.testing.assert_close(found.positions, bare.positions @ T[:3, :3].mT + T[:3, 3])


def test_evaluation_of_each_kind(
    result: dc.CalibrationResult, tracked: dc.Measurements, resting: dc.Measurements, mixture: dc.Measurements
) -> None:
    new = tracked.rows(slice(TRACKED, None))
    positions = dc.evaluate(result.model, new)
    assert positions.rms == pytest.approx(rms(result.model(new.q)[:, 0] - new.points[:, 0]), rel=1e-9)
    assert positions.rms < 3e-4
    spread = dc.evaluate(result.model, resting)
    both = dc.evaluate(result.model, mixture)
    assert both["position"].count == TRACKED
    assert both.rms == pytest.approx(dc.evaluate(result.model, mixture.device_rows()).rms, rel=1e-12)
    assert both["socket"].rms == pytest.approx(spread.rms, rel=1e-12)
    errors = [one.error for one in spread.distances]
    assert [one.error for one in both["socket"].distances] == pytest.approx(errors, abs=1e-12)
    assert len(both["socket"].distances) == 4
    assert result.model.summary is not None
    left_out = result.leave_one_out.errors
    assert result.left_out_rms == pytest.approx(rms(left_out[:TRACKED, :3]), rel=1e-9)
    assert result.left_out["socket"].rms == pytest.approx(rms(left_out[TRACKED:, 3:]), rel=1e-9)
    assert both.rms == pytest.approx(result.model.summary.diffeomorphic_rms, rel=1e-12)


def test_several_set_ups_of_the_device(
    arm: SimulatedArm, mixture: dc.Measurements, scales: dc.Hyperparameters, result: dc.CalibrationResult
) -> None:
    """Rows in sockets belong to no set-up, and the places of the robot to all."""
    T = twist_transform(torch.tensor([0.1, -0.05, 0.02, 0.0, 0.2, 0.1], dtype=torch.float64))
    device, resting = mixture.device_rows(), mixture.socket_rows()
    second = torch.arange(TRACKED) % 3 == 1
    points = torch.where(second[:, None, None], device.points @ T[:3, :3].mT + T[:3, 3], device.points)
    moved = with_attributes(device, points=points).with_sessions(["ab"[int(flag)] for flag in second])
    both = dc.Measurements.joined([moved, resting])
    found = dc.calibrate(arm.nominal, both, hyperparameters=scales)
    assert found.sessions is not None
    torch.testing.assert_close(found.sessions.transforms[1], T, rtol=0, atol=5e-4)
    q = arm.sample(100, seed=2)
    assert rms(found.model(q) - arm.true_points(q).flip(1)) < 1.5 * rms(result.model(q) - arm.true_points(q).flip(1))


def test_a_moved_device_moves_no_ball(tangent: TangentData) -> None:
    device, _, marker = (one.effects for one in changes_of(tangent)[:3])
    ball = tangent.visible[:, 3:]
    assert not bool(device[:, 3:][ball].any())
    assert bool(device[:, :3].any())
    assert bool(marker[:, 3:].any())


def test_samples_of_few_poses_hold_both_kinds(tangent: TangentData) -> None:
    for poses, drawn in ((30, 15), (80, TRACKED)):
        assert int((tangent.sample(poses, 10_000, seed=0)[0] < TRACKED).sum()) == drawn


@pytest.mark.usefixtures("undrawn")
def test_what_needs_measured_positions_alone(
    result: dc.CalibrationResult,
    mixture: dc.Measurements,
    tracked: dc.Measurements,
    resting: dc.Measurements,
    tmp_path: Path,
) -> None:
    poses = torch.eye(4, dtype=torch.float64).repeat(6, 1, 1)
    posed = dc.Measurements.from_poses(tracked.q[:6], poses, tracked.joint_names, doubt=False)
    assert isinstance(dc.Measurements.joined([posed, resting]), dc.Observations)
    with pytest.raises(MeasurementError, match="the rows have no sockets"):
        tracked.socket_rows()
    new = tracked.rows(slice(TRACKED, None))
    seen = result.model.registered(new.rows(slice(8)))
    assert dc.evaluate(seen, new.rows(slice(8, None))).rms < 3e-4
    assert seen.ball  # it stayed on the tool
    dc.write_report(seen, tmp_path / "page.html", new.rows(slice(8)))
