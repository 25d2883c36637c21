"""A robot that is measured again: the old model and a few new rows, in a new set-up, with and without changes."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import reading_bank
import torch
from again_bank import ELSEWHERE, NEW, arm, model, positions
from deformation_bank import made
from product_bank import Case, covered, simulated, simulated_poses, ur10_measurements, ur10_scales
from table_bank import refused

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation, transforms

pytestmark = pytest.mark.slow  # fits by the dozen
TURN = rotation(torch.tensor([0.3, -2.0, 0.7], dtype=torch.float64))
THERE = transforms(TURN, torch.tensor([1.5, -0.4, 0.2], dtype=torch.float64))
"""A measuring frame far from the first one."""


def measured(robot: SimulatedArm | None = None, rows: int = NEW, seed: int = 5) -> dc.Measurements:
    return positions(robot or arm(), rows, seed, THERE)


def shifted(data: dc.Measurements, by: Any) -> dc.Measurements:
    return with_attributes(data, points=data.points + by)


@cache
def old() -> dc.CalibratedKinematics:
    return model(positions)


def fitted(data: dc.Measurements) -> dc.CalibratedKinematics:
    """By rows alone, with the scales of the old model."""
    return dc.calibrate(arm().nominal, data, hyperparameters=reading_bank.scales()).model


@cache
def again() -> dc.Recalibration:
    """The arm after a move of the device."""
    return dc.recalibrate(old(), measured())


def rms(model: Any, robot: SimulatedArm | None = None) -> float:
    """Of further rows in the new place."""
    return dc.evaluate(model, measured(robot, 100, 6)).rms


def test_new_rows_add_to_what_the_old_model_knew() -> None:
    found, error = again(), rms(again().model)
    assert error < 0.9 * rms(old().registered(measured(), learn=False))
    assert error < 0.7 * rms(fitted(measured()))
    assert 0.9 < covered(found.model, measured(rows=100, seed=6)) <= 1.0
    assert found.marker == "same"
    assert found.outliers == ()
    assert 1.0 <= found.inflation < 1.5
    assert found.changes.found == ()
    assert "no change was found" in found.status
    assert found.moved is not None
    torch.testing.assert_close(found.moved.transform, THERE @ torch.linalg.inv(ELSEWHERE), rtol=0.0, atol=1e-3)
    assert found.left_out_rms == pytest.approx(error, rel=0.6)


def test_recalibrated_once_more() -> None:
    """Rows of three sessions, each in its own frame."""
    more = dc.recalibrate(again().model, positions(arm(), NEW, 7), drift="none").model
    assert dc.evaluate(more, positions(arm(), 100, 6)).rms < rms(again().model)
    assert more.map.geodesic.spec.at_controls is not None
    assert len(more.configurations) == len(old().configurations) + 2 * NEW


def test_old_rows_and_new_rows_together_are_one_calibration() -> None:
    """In the same place, with the same scales: as accurate as if all rows had been measured at once."""
    new, test = positions(arm(), 40, 8), positions(arm(), 100, 9)
    first = positions(arm(), len(old().configurations), 1)
    once = fitted(dc.Measurements.joined([first, new]))
    twice = dc.recalibrate(old(), new, drift="none").model
    assert dc.evaluate(twice, test).rms < 1.08 * dc.evaluate(once, test).rms


def test_a_worn_joint_is_named_and_followed(arm: Case) -> None:
    """With scales that were found for this arm: those of others know too little of what it may do."""
    worn = simulated(1)[0].worn(1, 2.0)
    new, test = measured(worn, 20), measured(worn, 100, 6)
    found = dc.recalibrate(arm.model, new)
    (change,) = found.changes.found
    joints, _, amplitudes, _ = worn._waves
    assert change.part == "shoulder_joint"
    assert change.angle
    assert change.probability < 0.01
    assert change.size == pytest.approx(float(amplitudes[joints == 1].norm()) / 2 / 2**0.5, rel=0.5)
    assert "shoulder_joint has changed by 0." in found.status
    with pytest.warns(DiffeoCalibWarning, match="times as large as the model leads to expect"):
        still = dc.recalibrate(arm.model, new, drift="none")
    assert dc.evaluate(found.model, test).rms < 0.5 * dc.evaluate(still.model, test).rms
    assert 0.88 < covered(found.model, test) <= 1.0


def test_a_change_of_everything_is_not_one_of_the_part_that_is_named(arm: Case) -> None:
    """Geometry and transmissions: where they alone might differ the errors are 1.5 times as large."""
    aged, generator = copy.copy(simulated(1)[0]), torch.Generator().manual_seed(3)

    def drawn(count: int) -> torch.Tensor:
        return 0.2 * torch.randn(count, generator=generator, dtype=torch.float64)

    theta, own = torch.zeros(aged.truth.size, dtype=torch.float64), aged.truth.slices["joints"]
    theta[own] = 1e-3 * drawn(own.stop - own.start)
    aged.truth = aged.truth.absorb(theta)
    joints, waves, amplitudes, phases = aged._waves
    aged._waves = joints, waves, amplitudes * (1 + 2 * drawn(len(amplitudes))), phases
    found, test = dc.recalibrate(arm.model, measured(aged, 20)), measured(aged, 100, 6)
    assert "geometry" in [change.part for change in found.changes.found]
    assert dc.evaluate(found.model, test).rms < 0.12e-3
    assert 0.9 < covered(found.model, test) <= 1.0


def test_another_tool_of_a_worn_robot_is_found() -> None:
    """Large errors are no reason to seek the marker at its old place, 110 mm away."""
    worn = arm().worn(1, 12.0)
    worn.truth = replace(worn.truth, tool=worn.truth.tool + torch.tensor([0.1, -0.05, 0.03], dtype=torch.float64))
    found = dc.recalibrate(old(), measured(worn, 12))
    assert found.marker == "other"
    assert "shoulder_joint has changed by 2." in found.status
    assert rms(found.model, worn) < 3e-3


def test_outliers_hardly_count() -> None:
    new = measured(rows=12)
    away = torch.zeros_like(new.points)
    away[3] = torch.tensor([0.003, -0.004, 0.0], dtype=torch.float64)
    clean, spoilt = (dc.recalibrate(old(), rows, drift="none") for rows in (new, shifted(new, away)))
    assert spoilt.outliers == (3,)
    assert rms(spoilt.model) < 1.2 * rms(clean.model)
    assert spoilt.inflation < 1.5 * clean.inflation  # regions are those of the robot, not of the wrong row


def test_another_marker() -> None:
    robot = copy.copy(arm())
    shift = torch.tensor([[0.0, 0.12, -0.2]], dtype=torch.float64)
    robot.truth = replace(robot.truth, tool=robot.truth.tool + shift)
    found = dc.recalibrate(old(), measured(robot), drift="none")
    assert found.marker == "other"
    assert rms(found.model, robot) < 1.02 * rms(old().registered(measured(robot), learn=False), robot)
    assert 0.9 < covered(found.model, measured(robot, 100, 6)) <= 1.0


def test_rows_outside_of_the_old_range_say_nothing_about_change() -> None:
    """Extrapolation is no change: they take part in the fit, not in the test."""
    q = 1.3 * arm().sample(400, seed=5)
    low, high = old().configurations.amin(0), old().configurations.amax(0)
    beyond = 0.1 * (high - low)
    outside = q[((q < low - beyond) | (q > high + beyond)).any(1)][:NEW]
    some = torch.cat([outside, arm().sample(3, seed=6).clamp(low, high)])
    with pytest.warns(DiffeoCalibWarning, match=r"only 3 rows lie within .* measure 5 poses or more"):
        found = dc.compare(old(), dc.Measurements(some, arm().true_points(some)))
    assert found.changes.rows == 3
    assert "changes were not tested" in str(found)


def noisy(metres: float, std: float | None = None) -> dc.Measurements:
    new = measured()
    noise = torch.randn(new.points.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return dc.Measurements(new.q, new.points + metres * noise, std=std)


def test_rows_that_a_registration_learnt_from_would_count_twice(tmp_path: Path) -> None:
    dc.save(old().registered(measured()), tmp_path / "model")
    learnt: Any = dc.load(tmp_path / "model")
    with pytest.raises(InputError, match="fitted to 30 of these 30 measurements: they would count twice; pass rows"):
        dc.recalibrate(learnt, measured())
    with pytest.raises(InputError, match="they would count twice"):
        dc.recalibrate(learnt.registered(measured(rows=15, seed=6), learn=False), measured())


def test_a_device_of_another_scale_is_warned_about() -> None:
    with pytest.warns(DiffeoCalibWarning, match=r"are 1\.00\d\d times those that the model predicts; check the scale"):
        dc.compare(old(), dc.Measurements(measured().q, 1.006 * measured().points))


def test_rows_of_which_half_contradict_the_model_are_warned_about() -> None:
    for rows in (noisy(5e-3), measured(SimulatedArm(seed=9))):
        with pytest.warns(DiffeoCalibWarning) as caught:
            dc.recalibrate(old(), rows, drift="none")
        assert any(re.search("of 30 new rows contradict .*belongs to this robot", str(one.message)) for one in caught)


def test_known_noise_of_the_new_rows_counts() -> None:
    found = dc.recalibrate(old(), noisy(1e-3, std=1e-3), drift="none")
    assert found.outliers == ()
    assert covered(found.model, measured(rows=200, seed=6)) > 0.9


def test_markers_that_moved_although_they_are_said_to_be_the_same() -> None:
    T = THERE @ arm().truth.base @ arm().nominal(measured().q)
    shift = (T[:, :3, :3] @ torch.tensor([1e-3, 0.0, 0.0], dtype=torch.float64))[:, None]
    with pytest.warns(DiffeoCalibWarning, match=r'markers have moved by .* mm, although marker="same"'):
        dc.compare(old(), shifted(measured(), shift), marker="same")


def test_interrupted_work_leaves_no_model() -> None:
    def interrupt(task: str, done: int, total: int) -> None:
        if task == "Gauss-Newton":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        dc.recalibrate(old(), measured(), drift="none", progress=interrupt)


def test_a_ur10_measured_again(ur10_folder: Path) -> None:
    """Two series of one robot, in different set-ups and joint ranges: regions of 95 % nearly hold in the other one."""
    robot, data = ur10_measurements(ur10_folder)
    columns = [f"measurement_{axis}" for axis in "xyz"]
    units = {"length": "mm", "angle": "rad", "sep": ";", "decimal": ","}
    before = dc.read_measurements(ur10_folder / "measurements_grid_900.csv", robot, columns, **units)  # pyright: ignore[reportArgumentType]
    first = dc.calibrate(robot, before[::8], hyperparameters=ur10_scales()).model
    new, test = data.split(30 / len(data), seed=0)
    found = dc.recalibrate(first, new)
    assert dc.evaluate(found.model, test).rms < 0.9 * dc.evaluate(first.registered(new, learn=False), test).rms
    assert covered(found.model, test) > 0.83


def test_what_is_refused() -> None:
    new, first = measured(), positions(arm(), len(old().configurations), 1)
    still = dc.Measurements(new.q[:1].repeat(8, 1), new.points[:1].repeat(8, 1, 1), doubt=False)

    def again(rows: Any = new, model: Any = None, **options: Any) -> Callable[[], object]:
        return lambda: dc.recalibrate(model or old(), rows, **options)

    def of_size(factor: float) -> dc.Measurements:
        return dc.Measurements(new.q, factor * new.points, doubt=False)

    refused(
        ("fitted to 60 of these 60 measurements: they would count twice; pass rows", again(first)),
        ("`marker`", again(marker="glued")),
        ("`drift`", again(drift="all")),
        ("seed", again(seed=-1)),
        ("the new rows: expected dc.Measurements", again("table.csv")),
        ("`model`", again(model="model.safetensors")),
        (r"expected 1 marker\(s\), got 2 marker.*register", again(simulated(9, markers=2)[1])),
        (r"expected 1 marker\(s\), got poses.*register", again(simulated_poses(9)[1])),
        (r"the new rows do not have the robot's size.*check `length`", again(of_size(1e3))),
        (r"the new rows do not have the robot's size.*check `length`", again(of_size(1e-3))),
        (r"do not tell where the measuring device stands.*several joints", again(still)),
        (r"do not tell where the measuring device stands.*several joints", lambda: dc.compare(old(), still)),
        ("models of one robot", lambda: dc.compare(old(), made("slides"))),
    )
