"""The best rigid kinematics of a model: exact where the model is rigid, and cross-validated."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from export_bank import rigid_model, wrong
from kind_bank import kind_named, table_rows
from product_bank import Case
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.identification.registration import with_joint_offsets
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop import rigid as found_rigid
from diffeo_calib.interop.rigid import GEOMETRIC, PROJECTION, best_joint_offsets, rigid_kinematics, with_errors
from diffeo_calib.interop.tables import correction_tables, write_correction_tables, write_joint_offsets
from diffeo_calib.robots import Geometry


def rms(points: Tensor, others: Tensor) -> float:
    return float((points - others).square().sum(-1).mean().sqrt())


def test_a_rigid_model_is_found_again(arm: Case) -> None:
    """Nothing is lost, at other configurations too; exact joint errors beat those that are estimated of 60 poses."""
    truth, other = (wrong(arm.robot, size=size).joint_errors for size in (1e-3, 2e-3))
    model, both = rigid_model(arm.model, wrong(arm.robot, size=1e-3)), {GEOMETRIC, PROJECTION}
    for errors, how, ways in ((None, PROJECTION, {PROJECTION}), (truth, GEOMETRIC, both), (other, PROJECTION, both)):
        found = rigid_kinematics(dc.CalibratedKinematics(model.robot, model.map, rigid_errors=errors))
        assert (found.how, set(found.validated)) == (how, ways)
        assert found.validated[how] == min(found.validated.values()) < 1e-7
        assert rms(found.geometry.points(arm.test.q), model(arm.test.q)) < 2e-8
        assert found.rms <= found.largest < 1e-8


def test_the_projection_is_a_minimum_and_its_numbers_are_those_of_the_geometry(arm: Case) -> None:
    """No change of a joint error by a tenth of its size brings the markers closer by more than the prior costs."""
    model, q, y = arm.model, arm.model.configurations, arm.model(arm.model.configurations)
    found = rigid_kinematics(dc.CalibratedKinematics(model.robot, model.map, model.summary))
    assert found.how == PROJECTION
    assert found.rms == pytest.approx(rms(found.geometry.points(q), y), rel=1e-9)
    assert found.largest == pytest.approx(float((found.geometry.points(q) - y).norm(dim=-1).max()), rel=1e-9)
    assert found.rms < found.validated[PROJECTION] < with_errors(model, None).rms
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        theta = 2e-5 * torch.randn(found.geometry.size, dtype=torch.float64, generator=generator)
        assert rms(found.geometry.points(q, theta), y) > found.rms


@pytest.mark.parametrize("size", [1e-3, 0.2])
def test_joint_offsets_are_found_again(size: float, arm: Case) -> None:
    """Those of the waist and of the last joint are the base's and the marker's: what they say together is the same."""
    offsets = size * torch.tensor([0.0, 1.0, -0.6, 0.3, 0.8, 0.0], dtype=torch.float64)
    model = rigid_model(arm.model, with_joint_offsets(Geometry.nominal(arm.robot), offsets))
    found = best_joint_offsets(model)
    torch.testing.assert_close(found.offsets, offsets, rtol=0, atol=1e-7)
    q = arm.test.q
    assert rms(found.rigid.geometry.points(q), model(q)) < 1e-6
    nominal = replace(found.rigid.geometry, joint_errors=Geometry.nominal(arm.robot).joint_errors)
    assert rms(nominal.points(q + found.offsets), model(q)) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ball in sockets", "distances"])
def test_distances_hold_where_no_row_is(name: str) -> None:
    """Rows in sockets and at one wire show little of the robot: what is said is of the joint ranges."""
    model = kind_named(name).model
    low, high = model.configurations.amin(0), model.configurations.amax(0)
    q = low + (high - low) * torch.rand(400, len(low), dtype=low.dtype, generator=torch.Generator().manual_seed(5))
    found = rigid_kinematics(model)
    assert rms(found.geometry.points(q), model(q).detach()) == pytest.approx(found.validated[found.how], rel=0.15)


@pytest.mark.slow
def test_on_a_real_robot(ur10_150: Case) -> None:
    """Held-out rows of the UR10, 150 rows fitted: 0.40 mm, where the model's geometry left alone leaves 0.6."""
    model, test = ur10_150.model, ur10_150.test
    rigid = rigid_kinematics(model)
    found, alone = (rms(geometry.points(test.q), test.points) for geometry in (rigid.geometry, model.geometry))
    assert found < 0.43e-3 < alone
    assert rigid.validated[rigid.how] == pytest.approx(found, rel=0.15)


def test_correction_tables(arm: Case) -> None:
    for table in correction_tables(arm.model):
        command = table.values + table.corrections
        reached = command + arm.model.transmission(table.joint, command)
        torch.testing.assert_close(reached, table.values, rtol=0, atol=1e-14)
        torch.testing.assert_close(table.errors, arm.model.transmission(table.joint, table.values), rtol=0, atol=0)
        away = (table.corrections + table.errors).abs().max()
        assert float(away) < 0.01 * float(table.errors.abs().max()) + 1e-9, "it is minus the error, to first order"
    measured = arm.model.configurations
    for index, table in enumerate(correction_tables(arm.model, turn_step=0.1)):
        low, high = float(table.values[0]), float(table.values[-1])
        assert (low, high) == tuple(map(float, measured[:, index].aminmax()))
        steps = table.values.diff()
        assert float(steps.max()) <= 0.1 + 1e-12
        torch.testing.assert_close(steps, steps[:1].expand_as(steps), rtol=0, atol=1e-12)
        finer = torch.linspace(low, high, 3001, dtype=torch.float64)
        exact = -arm.model.transmission(table.joint, finer)
        exact = -arm.model.transmission(table.joint, finer + exact)
        found = np.interp(finer.numpy(), table.values.numpy(), table.corrections.numpy())
        away = float((exact - torch.from_numpy(found)).abs().max())
        assert 0.5 * table.between < away < 1.5 * table.between + 1e-12


def test_files_hold_tables_and_offsets_in_degrees(arm: Case, tmp_path: Path) -> None:
    write_correction_tables(arm.model, tmp_path / "t.csv", angle="deg")
    write_joint_offsets(arm.model, tmp_path / "o.csv", angle="deg")
    for table in correction_tables(arm.model):
        own = [row for row in table_rows(tmp_path / "t.csv") if row["joint"] == table.joint]
        written = [[float(row[name]) for name in ("value", "transmission_error", "correction_to_add")] for row in own]
        assert {row["unit"] for row in own} == {"deg"}
        expected = torch.stack([table.values, table.errors, table.corrections], 1)
        torch.testing.assert_close(torch.tensor(written, dtype=torch.float64).deg2rad(), expected, rtol=1e-14, atol=0)
    found = [math.radians(float(row["offset_to_add_to_reading"])) for row in table_rows(tmp_path / "o.csv")]
    assert found == pytest.approx(best_joint_offsets(arm.model).offsets.tolist(), rel=1e-14)


@pytest.mark.slow
def test_rigid_kinematics_made_for_the_tables_are_better_with_them(arm: Case) -> None:
    """On poses that were not fitted: nominal > rigid alone > rigid with tables > rigid made for tables."""
    model, test = arm.model, arm.test
    alone, made = rigid_kinematics(model), rigid_kinematics(model, transmission=True)
    moved = dc.Measurements(found_rigid.joint_motion(model, test.q), test.points)
    errors = [
        dc.evaluate(with_errors(model, None).geometry.points, test).rms,
        dc.evaluate(alone.geometry.points, test).rms,
        dc.evaluate(with_errors(model, alone.geometry.joint_errors, transmission=True).geometry.points, moved).rms,
        dc.evaluate(made.geometry.points, moved).rms,
    ]
    assert errors == sorted(errors, reverse=True)
    assert errors[3] < 0.7 * errors[1]
    assert made.rms < with_errors(model, made.geometry.joint_errors).rms
    again = with_errors(model, made.geometry.joint_errors, transmission=True)
    assert again.rms == pytest.approx(made.rms, rel=1e-3)


def test_wrong_options(arm: Case, tmp_path: Path) -> None:
    for step in (0.0, -1.0, math.nan, True, "1"):
        with pytest.raises(InputError, match="`turn_step`: expected a number above 0"):
            correction_tables(arm.model, turn_step=step)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"`slide_step`"):
        correction_tables(arm.model, slide_step=0)
    with pytest.raises(InputError, match=r"the table of 'waist_joint' has \d+ rows: expected at most 100000"):
        correction_tables(arm.model, turn_step=1e-6)
    for write in (write_correction_tables, write_joint_offsets):
        with pytest.raises(InputError, match="`angle`"):
            write(arm.model, tmp_path / "t.csv", angle="turns")
