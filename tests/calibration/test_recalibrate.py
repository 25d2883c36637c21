"""A robot that is measured again: the old model and a few new rows, in a new set-up, with and without changes."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from product_bank import Case, simulated, simulated_poses, ur10_measurements, ur10_scales
from recorded_bank import made
from table_bank import refused
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.recalibration.new_rows import weighed
from diffeo_calib.calibration.recalibration.new_set_up import place_again
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation, transforms

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


def amplitudes_of(robot: SimulatedArm, joint: int) -> Tensor:
    """Those of a joint's transmission error, rad."""
    joints, _, amplitudes, _ = robot._waves
    return amplitudes[joints == joint]


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
    assert change.size == pytest.approx(float(amplitudes_of(robot, 1).norm()) / 2 / 2**0.5, rel=0.5)
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


def test_models_of_a_robot_before_and_after_wear(arm: Case) -> None:
    """Whatever frame they are in: what differs is the joint."""
    robot = worn(2, 3.0)
    scales = arm.result.selection.scales
    after = dc.calibrate(robot.nominal, measured(robot, 60, 5), hyperparameters=scales).model
    found = dc.compare(arm.model, after)
    assert [change.part for change in found.changes.found] == ["elbow_joint"]
    truth = 2 / 3 * float(amplitudes_of(robot, 2).norm()) / 2**0.5
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


def noisy(data: dc.Measurements, metres: float, std: float | None = None) -> dc.Measurements:
    generator = torch.Generator().manual_seed(3)
    noise = metres * torch.randn(data.points.shape, generator=generator, dtype=torch.float64)
    return dc.Measurements(data.q, data.points + noise, std=std)


@pytest.fixture(scope="module")
def new() -> dc.Measurements:
    return measured(simulated(1)[0], 20, 5)


def test_rows_that_a_registration_learnt_from_would_count_twice(
    arm: Case, new: dc.Measurements, tmp_path: Path
) -> None:
    dc.save(arm.model.registered(new), tmp_path / "model")
    with pytest.raises(InputError, match="fitted to 20 of these 20 measurements: they would count twice; pass rows"):
        dc.recalibrate(dc.load(tmp_path / "model"), new)  # pyright: ignore[reportArgumentType]
    other = measured(simulated(1)[0], 15, 6)
    again = arm.model.registered(new).registered(other, learn=False)
    with pytest.raises(InputError, match="they would count twice"):
        dc.recalibrate(again, new)


def test_a_device_of_another_scale_is_warned_about(arm: Case, new: dc.Measurements) -> None:
    with pytest.warns(DiffeoCalibWarning, match=r"are 1\.00\d\d times those that the model predicts; check the scale"):
        dc.compare(arm.model, dc.Measurements(new.q, 1.006 * new.points))


def test_rows_of_which_half_contradict_the_model_are_warned_about(arm: Case, new: dc.Measurements) -> None:
    for rows in (noisy(new, 5e-3), measured(SimulatedArm(seed=9), 20, 5)):
        with pytest.warns(DiffeoCalibWarning) as caught:
            dc.recalibrate(arm.model, rows, drift="none")
        assert any(re.search("of 20 new rows contradict .*belongs to this robot", str(one.message)) for one in caught)


def test_known_noise_of_the_new_rows_counts(arm: Case, new: dc.Measurements) -> None:
    rows = noisy(new, 1e-3, std=1e-3)
    found = dc.recalibrate(arm.model, rows, drift="none")
    test = measured(simulated(1)[0], 200, 6)
    assert found.outliers == ()
    assert within_region(found.model, test) > 0.9


def test_markers_that_moved_although_they_are_said_to_be_the_same(arm: Case, new: dc.Measurements) -> None:
    T = elsewhere() @ arm.model.geometry.base @ arm.robot(new.q)
    shift = (T[:, :3, :3] @ torch.tensor([1e-3, 0.0, 0.0], dtype=torch.float64))[:, None]
    with pytest.warns(DiffeoCalibWarning, match=r'markers have moved by .* mm, although marker="same"'):
        dc.compare(arm.model, dc.Measurements(new.q, new.points + shift), marker="same")


def test_interrupted_work_leaves_no_model(arm: Case, new: dc.Measurements) -> None:
    def interrupt(task: str, done: int, total: int) -> None:
        if task == "Gauss-Newton":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        dc.recalibrate(arm.model, new, drift="none", progress=interrupt)


def test_variances_grow_where_the_old_scales_do_not_hold(arm: Case, new: dc.Measurements) -> None:
    """By the squares of the errors that rows left out would have, if these are larger than expected."""
    rows = weighed(place_again(arm.model, new), "same")
    usual = rows.inflation
    assert 1.0 <= usual < 1.5
    worse, better = rows.changed(), rows.changed()
    vars(worse)["residual"], vars(better)["residual"] = 3.0 * rows.residual, 0.1 * rows.residual
    assert 2.0 < worse.inflation < 9.0 * usual
    assert better.inflation == 1.0


def test_a_ur10_measured_again(ur10_folder: Path) -> None:
    """Two series of one robot, in different set-ups and joint ranges: regions of 95 % nearly hold in the other one."""
    robot, data = ur10_measurements(ur10_folder)
    columns = [f"measurement_{axis}" for axis in "xyz"]
    units = {"length": "mm", "angle": "rad", "sep": ";", "decimal": ","}
    before = dc.read_measurements(ur10_folder / "measurements_grid_900.csv", robot, columns, **units)  # pyright: ignore[reportArgumentType]
    old = dc.calibrate(robot, before[::8], hyperparameters=ur10_scales()).model
    new, test = data.split(30 / len(data), seed=0)
    found = dc.recalibrate(old, new)
    assert dc.evaluate(found.model, test).rms < 0.9 * dc.evaluate(old.registered(new, learn=False), test).rms
    assert within_region(found.model, test) > 0.83


def test_what_is_refused(arm: Case, new: dc.Measurements) -> None:
    model: Any = arm.model
    still = dc.Measurements(new.q[:1].repeat(8, 1), new.points[:1].repeat(8, 1, 1), doubt=False)

    def again(rows: Any = new, old: Any = model, **options: Any) -> Callable[[], object]:
        return lambda: dc.recalibrate(old, rows, **options)

    def of_size(factor: float) -> dc.Measurements:
        return dc.Measurements(new.q, factor * new.points, doubt=False)

    refused(
        ("fitted to 60 of these 60 measurements: they would count twice; pass rows", again(arm.train)),
        ("`marker`", again(marker="glued")),
        ("`drift`", again(drift="all")),
        ("seed", again(seed=-1)),
        ("the new rows: expected dc.Measurements", again("table.csv")),
        ("`model`", again(old="model.safetensors")),
        (r"expected 1 marker\(s\), got 2 marker.*register", again(simulated(9, markers=2)[1])),
        (r"expected 1 marker\(s\), got poses.*register", again(simulated_poses(9)[1])),
        (r"the new rows do not have the robot's size.*check `length`", again(of_size(1e3))),
        (r"the new rows do not have the robot's size.*check `length`", again(of_size(1e-3))),
        (r"do not tell where the measuring device stands.*several joints", again(still)),
        (r"do not tell where the measuring device stands.*several joints", lambda: dc.compare(model, still)),
        ("models of one robot", lambda: dc.compare(model, made("slides"))),
    )
