"""New rows that an old model must not be made to fit, and rows whose own noise counts."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from product_bank import Case, simulated, ur10_measurements, ur10_scales
from test_recalibrate import elsewhere, measured, seen_from, within_region

import diffeo_calib as dc
from diffeo_calib.calibration.recalibration.new_rows import NewRows
from diffeo_calib.calibration.recalibration.recalibrate import place_again, weighed
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, MeasurementError
from diffeo_calib.kinematics.re_registration.linear_rows import larger
from diffeo_calib.robots.simulated_arm import SimulatedArm

pytestmark = pytest.mark.slow


def noisy(data: dc.Measurements, metres: float, std: float | None = None) -> dc.Measurements:
    generator = torch.Generator().manual_seed(3)
    noise = metres * torch.randn(data.points.shape, generator=generator, dtype=torch.float64)
    return dc.Measurements(data.q, data.points + noise, std=std)


@pytest.fixture(scope="module")
def new() -> dc.Measurements:
    return measured(simulated(1)[0], 20, 5)


def test_the_table_of_the_fit_would_count_twice(arm: Case) -> None:
    with pytest.raises(InputError, match="fitted to 60 of these 60 measurements: they would count twice; pass rows"):
        dc.recalibrate(arm.model, arm.train)


def test_rows_that_a_registration_learnt_from_would_count_twice(
    arm: Case, new: dc.Measurements, tmp_path: Path
) -> None:
    dc.save(arm.model.registered(new), tmp_path / "model")
    with pytest.raises(InputError, match="fitted to 20 of these 20 measurements: they would count twice; pass rows"):
        dc.recalibrate(dc.load(tmp_path / "model"), new)  # pyright: ignore[reportArgumentType]
    dc.recalibrate(arm.model.registered(new, learn=False), new)
    other = measured(simulated(1)[0], 15, 6)
    for learn in (True, False):
        again = arm.model.registered(new).registered(other, learn=learn)
        with pytest.raises(InputError, match="they would count twice"):
            dc.recalibrate(again, new)


def test_other_units_are_refused_before_the_work(arm: Case, new: dc.Measurements) -> None:
    for factor in (1e3, 1e-3):
        with pytest.raises(MeasurementError, match=r"the new rows do not have the robot's size.*check `length`"):
            dc.recalibrate(arm.model, dc.Measurements(new.q, factor * new.points, doubt=False))


def test_a_device_of_another_scale_is_warned_about(arm: Case, new: dc.Measurements) -> None:
    with pytest.warns(DiffeoCalibWarning, match=r"are 1\.00\d\d times those that the model predicts; check the scale"):
        dc.compare(arm.model, dc.Measurements(new.q, 1.006 * new.points))


@pytest.mark.parametrize("what", ["noise", "another arm"])
def test_rows_of_which_half_contradict_the_model_are_warned_about(arm: Case, new: dc.Measurements, what: str) -> None:
    rows = noisy(new, 5e-3) if what == "noise" else measured(SimulatedArm(seed=9), 20, 5)
    with pytest.warns(DiffeoCalibWarning) as caught:
        dc.recalibrate(arm.model, rows, drift="none")
    assert any(re.search("of 20 new rows contradict .*belongs to this robot", str(one.message)) for one in caught)


def test_rows_that_leave_the_device_open_are_refused(arm: Case, new: dc.Measurements) -> None:
    rows = dc.Measurements(new.q[:1].repeat(8, 1), new.points[:1].repeat(8, 1, 1), doubt=False)
    for work in (dc.recalibrate, dc.compare):
        with pytest.raises(MeasurementError, match=r"do not tell where the measuring device stands.*several joints"):
            work(arm.model, rows)


def test_known_noise_of_the_new_rows_counts(arm: Case, new: dc.Measurements) -> None:
    rows = noisy(new, 1e-3, std=1e-3)
    found = dc.recalibrate(arm.model, rows, drift="none")
    test = measured(simulated(1)[0], 200, 6)
    assert found.outliers == ()
    assert within_region(found.model, test) > 0.9


def test_larger_of_two_covariances() -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(5, 3, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    a, b = a @ a.mT, b @ b.mT
    both = larger(a, b)
    for one in (a, b):
        assert float(torch.linalg.eigvalsh(both - one).min()) > -1e-12
    torch.testing.assert_close(larger(a, 0.5 * a), a)


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


def test_an_inflated_model_is_the_same_but_for_its_uncertainty(
    arm: Case, new: dc.Measurements, monkeypatch: pytest.MonkeyPatch
) -> None:
    test = measured(simulated(1)[0], 50, 6)
    found = []
    for factor in (1.0, 4.0):
        monkeypatch.setattr(NewRows, "inflation", factor)
        found.append(dc.recalibrate(arm.model, new, drift="none").model)
    torch.testing.assert_close(found[1](test.q), found[0](test.q), rtol=0.0, atol=1e-8)
    plain, wide = (model.predict(test.q)[1] for model in found)
    torch.testing.assert_close(wide, 4.0 * plain, rtol=1e-3, atol=0.0)


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


def test_a_drift_is_part_of_what_left_out_rows_are_predicted_with(arm: Case) -> None:
    robot = simulated(1)[0].worn(1, 6.0)
    found = dc.recalibrate(arm.model, measured(robot, 20, 5))
    assert [change.part for change in found.changes.found][:1] == [robot.nominal.joint_names[1]]
    error = dc.evaluate(found.model, measured(robot, 200, 6)).rms
    assert found.left_out_rms < 3 * error < 0.5 * found.rms_before


def test_the_same_place_is_seen_again(arm: Case, new: dc.Measurements) -> None:
    back = seen_from(torch.linalg.inv(elsewhere()), new)
    found = dc.recalibrate(arm.model, back, drift="none")
    torch.testing.assert_close(found.moved.transform, torch.eye(4, dtype=torch.float64), rtol=0.0, atol=1e-3)
