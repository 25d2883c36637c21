"""A robot that is measured again: the old model and a few new rows, in a new set-up, with and without changes."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from product_bank import Case, simulated, simulated_poses
from recorded_bank import made
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError
from diffeo_calib.interop.numpy_model import load_numpy
from diffeo_calib.measurements.poses import poses_from_marks
from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.robots.simulated_arm import SimulatedArm

pytestmark = pytest.mark.slow  # fits by the dozen
NEW_ROWS = 20


def elsewhere() -> Tensor:
    """A measuring frame far from the first one."""
    turn = rotation(torch.tensor([0.3, -2.0, 0.7], dtype=torch.float64))
    return transforms(turn, torch.tensor([1.5, -0.4, 0.2], dtype=torch.float64))


def seen_from(T: Tensor, data: dc.Measurements) -> dc.Measurements:
    return dc.Measurements(data.q, data.points @ T[:3, :3].mT + T[:3, 3])


def measured(arm: SimulatedArm, rows: int, seed: int) -> dc.Measurements:
    return seen_from(elsewhere(), dc.Measurements(*arm.measure(rows, seed=seed)))


def worn(joint: int, factor: float) -> SimulatedArm:
    """The arm of the fixture with a larger transmission error of one joint."""
    return simulated(1)[0].worn(joint, factor)


@pytest.fixture(scope="module")
def again(arm: Case) -> tuple[dc.Recalibration, dc.Measurements]:
    """The arm after a move of the device, and rows to test."""
    robot = simulated(1)[0]
    return dc.recalibrate(arm.model, measured(robot, NEW_ROWS, 5)), measured(robot, 100, 6)


def within_region(model: dc.CalibratedKinematics, test: dc.Measurements) -> float:
    """Share of rows in their 95 % regions."""
    mean, covariance = model.predict(test.q)
    error = (test.points - mean)[:, 0, :, None]
    return float(((error.mT @ torch.linalg.solve(covariance[:, 0], error)).flatten() < 7.81).double().mean())


def test_new_rows_add_to_what_the_old_model_knew(arm: Case, again: tuple[dc.Recalibration, dc.Measurements]) -> None:
    found, test = again
    new = measured(simulated(1)[0], NEW_ROWS, 5)
    recalibrated = dc.evaluate(found.model, test).rms
    assert recalibrated < 0.9 * dc.evaluate(arm.model.registered(new, learn=False), test).rms
    alone = dc.calibrate(arm.robot, new, hyperparameters=arm.result.selection.scales).model
    assert recalibrated < 0.7 * dc.evaluate(alone, test).rms
    assert 0.9 < within_region(found.model, test) <= 1.0
    assert found.marker == "same"
    assert found.outliers == ()
    assert 1.0 <= found.inflation < 1.5
    assert found.changes.found == ()
    assert "no change was found" in found.status
    torch.testing.assert_close(found.moved.transform, elsewhere(), rtol=0.0, atol=1e-3)
    assert found.left_out_rms == pytest.approx(recalibrated, rel=0.6)


def test_the_model_is_one_like_any_other(again: tuple[dc.Recalibration, dc.Measurements], tmp_path: Path) -> None:
    found, test = again
    assert len(found.model.configurations) == 60 + NEW_ROWS
    dc.save(found.model, tmp_path / "model.safetensors")
    loaded = dc.load(tmp_path / "model.safetensors")
    assert torch.equal(loaded(test.q), found.model(test.q))
    torch.testing.assert_close(loaded.predict(test.q[:9])[1], found.model.predict(test.q[:9])[1])
    numpy = load_numpy(tmp_path / "model.safetensors")(test.q.numpy())
    np.testing.assert_allclose(numpy, found.model(test.q).numpy(), atol=1e-12)
    back = dc.compensate(found.model, found.model.tool_poses(test.q[:3]), start=test.q[:3])
    torch.testing.assert_close(back.q, test.q[:3], rtol=0.0, atol=1e-7)


def test_recalibrated_once_more(again: tuple[dc.Recalibration, dc.Measurements]) -> None:
    """Rows of three sessions, each in its own frame."""
    found, test = again
    third = seen_from(torch.linalg.inv(elsewhere()), measured(simulated(1)[0], NEW_ROWS, 7))
    more = dc.recalibrate(found.model, third, drift="none")
    back = seen_from(torch.linalg.inv(elsewhere()), test)
    assert dc.evaluate(more.model, back).rms < dc.evaluate(found.model, test).rms
    assert more.model.map.geodesic.spec.at_controls is not None
    assert len(more.model.configurations) == 60 + 2 * NEW_ROWS


def test_old_rows_and_new_rows_together_are_one_calibration(arm: Case) -> None:
    """In the same place, with the same scales: as accurate as if all rows had been measured at once."""
    robot = simulated(1)[0]
    new, test = (dc.Measurements(*robot.measure(rows, seed=seed)) for rows, seed in ((40, 8), (100, 9)))
    together = dc.Measurements(torch.cat([arm.train.q, new.q]), torch.cat([arm.train.points, new.points]))
    scales = arm.result.selection.scales
    once = dc.calibrate(arm.robot, together, hyperparameters=scales).model
    twice = dc.recalibrate(arm.model, new, drift="none").model
    assert dc.evaluate(twice, test).rms < 1.08 * dc.evaluate(once, test).rms


@pytest.mark.parametrize(("joint", "size"), [(1, -3e-4), (4, 1.5e-3)])
def test_a_moved_zero_is_named_with_its_size(arm: Case, joint: int, size: float) -> None:
    robot = simulated(1)[0]
    q, moved = robot.sample(NEW_ROWS, 5), torch.zeros(6, dtype=torch.float64)
    moved[joint] = size
    y = robot.true_points(q + moved)
    noise = robot.noise * torch.randn(y.shape, generator=torch.Generator().manual_seed(1), dtype=y.dtype)
    found = dc.compare(arm.model, seen_from(elsewhere(), dc.Measurements(q, y + noise)))
    change, *rest = found.changes.found
    assert not rest
    assert change.part == f"the offset of {robot.nominal.joint_names[joint]}"
    assert change.deviation is not None
    assert change.deviation < 0.1e-3
    assert abs(change.size - size) < 4 * change.deviation
    assert change.others == ()


def test_a_worn_joint_is_named_and_followed(arm: Case) -> None:
    robot = worn(1, 2.0)
    new, test = measured(robot, NEW_ROWS, 5), measured(robot, 100, 6)
    found = dc.recalibrate(arm.model, new)
    assert [change.part for change in found.changes.found] == ["shoulder_joint"]
    (change,) = found.changes.found
    assert change.angle
    assert change.probability < 0.01
    assert change.size == pytest.approx(float(robot._waves[1][1].square().sum().sqrt()) / 2 / 2**0.5, rel=0.5)
    assert "shoulder_joint has changed by 0." in found.status
    held = dc.evaluate(found.model, test).rms
    with pytest.warns(DiffeoCalibWarning, match="times as large as the model leads to expect"):
        still = dc.recalibrate(arm.model, new, drift="none")
    assert held < 0.5 * dc.evaluate(still.model, test).rms
    assert 0.88 < within_region(found.model, test) <= 1.0


def test_outliers_hardly_count(arm: Case) -> None:
    robot = simulated(1)[0]
    new, test = measured(robot, 12, 5), measured(robot, 100, 6)
    points = new.points.clone()
    points[3] += torch.tensor([0.003, -0.004, 0.0], dtype=torch.float64)
    clean, spoilt = (
        dc.recalibrate(arm.model, dc.Measurements(new.q, given), drift="none") for given in (new.points, points)
    )
    assert spoilt.outliers == (3,)
    assert dc.evaluate(spoilt.model, test).rms < 1.2 * dc.evaluate(clean.model, test).rms


def test_another_marker(arm: Case) -> None:
    robot = copy.copy(simulated(1)[0])
    shift = torch.tensor([[0.0, 0.12, -0.2]], dtype=torch.float64)
    robot.truth = replace(robot.truth, tool=robot.truth.tool + shift)
    new, test = measured(robot, NEW_ROWS, 5), measured(robot, 100, 6)
    found = dc.recalibrate(arm.model, new, drift="none")
    assert found.marker == "other"
    assert dc.evaluate(found.model, test).rms < 1.02 * dc.evaluate(arm.model.registered(new, learn=False), test).rms
    assert 0.9 < within_region(found.model, test) <= 1.0


def test_poses(posed: Case) -> None:
    robot = simulated_poses(1)[0]
    lever, T = posed.model.lever, elsewhere()
    assert lever is not None

    def poses(rows: int, seed: int) -> dc.Measurements:
        q, points = robot.measure(rows, seed=seed)
        frames = T @ dc.Measurements.from_poses(q, poses_from_marks(points, lever), lever=lever).poses
        return dc.Measurements.from_poses(q, frames, lever=0.2)

    new, test = poses(NEW_ROWS, 5), poses(60, 6)
    found = dc.recalibrate(posed.model, new, drift="none")
    registered, again = dc.evaluate(posed.model.registered(new, learn=False), test), dc.evaluate(found.model, test)
    assert again.rms < 0.9 * registered.rms
    assert again.angles.square().mean() < registered.angles.square().mean()


def test_old_models_with_control_points(arm: Case) -> None:
    scales = arm.result.selection.scales
    coarse = dc.calibrate(arm.robot, arm.train, hyperparameters=scales, controls=30).model
    robot = simulated(1)[0]
    new, test = measured(robot, NEW_ROWS, 5), measured(robot, 100, 6)
    found = dc.recalibrate(coarse, new, drift="none")
    assert len(found.model.configurations) == 60 + NEW_ROWS
    assert dc.evaluate(found.model, test).rms < dc.evaluate(coarse.registered(new, learn=False), test).rms


def test_a_model_and_itself_do_not_differ(arm: Case) -> None:
    found = dc.compare(arm.model, arm.model)
    assert found.rms < 1e-6
    assert not found.changes.found


def test_models_of_a_robot_before_and_after_wear(arm: Case) -> None:
    """Whatever frame they are in: what differs is the joint."""
    robot = worn(2, 3.0)
    scales = arm.result.selection.scales
    after = dc.calibrate(robot.nominal, measured(robot, 60, 5), hyperparameters=scales).model
    found = dc.compare(arm.model, after)
    assert [change.part for change in found.changes.found] == ["elbow_joint"]
    truth = 2 / 3 * float(robot._waves[1][2].square().sum().sqrt()) / 2**0.5
    assert found.changes.found[0].size == pytest.approx(truth, rel=0.3)
    assert found.rms > 2 * found.expected


def test_rows_outside_of_the_old_range_say_nothing_about_change(arm: Case) -> None:
    """Extrapolation is no change: they take part in the fit, not in the test."""
    model, robot = arm.model, simulated(1)[0]
    q = 1.3 * robot.sample(400, seed=5)
    low, high = model.configurations.amin(0), model.configurations.amax(0)
    beyond = 0.1 * (high - low)
    outside = q[((q < low - beyond) | (q > high + beyond)).any(1)][:NEW_ROWS]
    shifted = torch.cat([outside, robot.sample(3, seed=6).clamp(low, high)])
    with pytest.warns(DiffeoCalibWarning, match=r"only 3 rows lie within .* measure 5 poses or more"):
        found = dc.compare(model, dc.Measurements(shifted, robot.true_points(shifted)))
    assert isinstance(found, dc.Comparison)
    assert found.changes.rows == 3
    assert "changes were not tested" in str(found)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"marker": "glued"}, "`marker`"),
        ({"drift": "all"}, "`drift`"),
        ({"seed": -1}, "seed"),
        ({"new": "table.csv"}, "the new rows: expected dc.Measurements"),
        ({"model": "model.safetensors"}, "`model`"),
    ],
)
def test_bad_arguments(arm: Case, change: dict[str, object], message: str) -> None:
    given = {"model": arm.model, "new": measured(simulated(1)[0], 8, 5)} | change
    with pytest.raises(InputError, match=message):
        dc.recalibrate(**given)


def test_another_kind_of_measurements_is_refused(arm: Case) -> None:
    for (_, new, _), got in ((simulated(9, markers=2), "2 marker"), (simulated_poses(9), "poses")):
        with pytest.raises(InputError, match=f"expected 1 marker\\(s\\), got {got}.*register"):
            dc.recalibrate(arm.model, new)


def test_models_of_other_robots_are_not_compared(arm: Case) -> None:
    with pytest.raises(InputError, match="models of one robot"):
        dc.compare(arm.model, made("slides"))
