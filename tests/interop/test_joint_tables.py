"""Correction tables and joint offsets: the joint comes to where it should, signs and ranges included."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from product_bank import Case, simulated

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop.rigid import best_joint_offsets, joint_motion, rigid_kinematics, with_errors
from diffeo_calib.interop.tables import correction_tables, write_correction_tables, write_joint_offsets


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_corrected_command_brings_the_joint_to_its_value(arm: Case) -> None:
    """The model's own transmission error, to rounding: command + error(command) = wanted value."""
    for table in correction_tables(arm.model):
        command = table.values + table.corrections
        reached = command + arm.model.transmission(table.joint, command)
        torch.testing.assert_close(reached, table.values, rtol=0, atol=1e-14)
        torch.testing.assert_close(table.errors, arm.model.transmission(table.joint, table.values), rtol=0, atol=0)
        away = (table.corrections + table.errors).abs().max()
        assert float(away) < 0.01 * float(table.errors.abs().max()) + 1e-9, "it is minus the error, to first order"


@pytest.mark.slow
def test_the_true_joint_comes_closer(arm_200: Case) -> None:
    """The simulated arm's joints by its true gears, but for what geometry and gravity may explain as well."""
    arm, _, _ = simulated(1)
    for index, table in enumerate(correction_tables(arm_200.model)[:5]):  # the last joint turns the one marker only
        errors = []
        for command in (table.values, table.values + table.corrections):
            q = torch.zeros(len(command), 6, dtype=torch.float64)
            q[:, index] = command
            away = command + arm.components(q).transmission[:, index] - table.values
            others = torch.stack([torch.ones_like(away), table.values.cos(), table.values.sin()], 1)
            away = away - others @ torch.linalg.lstsq(others, away[:, None]).solution[:, 0]
            errors.append(float(away.square().mean().sqrt()))
        assert errors[1] < errors[0] / 5, table.joint


def test_tables_cover_what_was_measured_and_say_how_good_interpolation_is(arm: Case) -> None:
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


@pytest.mark.slow
def test_rigid_kinematics_made_for_the_tables_are_better_with_them(arm_200: Case) -> None:
    """On poses that were not fitted: nominal > rigid alone > rigid with tables > rigid made for tables."""
    model, test = arm_200.model, arm_200.test
    alone, made = rigid_kinematics(model), rigid_kinematics(model, transmission=True)
    moved = dc.Measurements(joint_motion(model, test.q), test.points)
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


@pytest.mark.slow
def test_slides(slider: Case, tmp_path: Path) -> None:
    table = correction_tables(slider.model, slide_step=0.002)[2]
    assert (table.joint, table.turns) == ("slide", False)
    truth = 4e-4 * (2 * math.pi / 0.3 * table.values).sin()
    away = table.errors - truth
    assert float((away - away.mean()).square().mean().sqrt()) < 1e-4
    write_correction_tables(slider.model, tmp_path / "t.csv", length="mm", angle="deg")
    rows = [row for row in read(tmp_path / "t.csv") if row["joint"] == "slide"]
    assert {row["unit"] for row in rows} == {"mm"}
    assert float(rows[-1]["value"]) == pytest.approx(1e3 * float(table.values[-1]), rel=1e-15)
    write_joint_offsets(slider.model, tmp_path / "o.csv", length="mm", angle="deg")
    units = [row["unit"] for row in read(tmp_path / "o.csv")]
    assert units == ["deg", "deg", "mm", "deg", "deg", "deg"]


def test_files(arm: Case, tmp_path: Path) -> None:
    """In degrees; in mm: test_slides."""
    write_correction_tables(arm.model, tmp_path / "t.csv", angle="deg")
    rows = read(tmp_path / "t.csv")
    for table in correction_tables(arm.model):
        own = [row for row in rows if row["joint"] == table.joint]
        assert {row["unit"] for row in own} == {"deg"}
        columns = ("value", "transmission_error", "correction_to_add")
        for column, values in zip(columns, (table.values, table.errors, table.corrections), strict=True):
            found = torch.tensor([float(row[column]) for row in own], dtype=torch.float64).deg2rad()
            torch.testing.assert_close(found, values, rtol=1e-14, atol=0)
    write_joint_offsets(arm.model, tmp_path / "o.csv", angle="deg")
    offsets = read(tmp_path / "o.csv")
    assert [row["joint"] for row in offsets] == list(arm.robot.joint_names)
    assert {row["unit"] for row in offsets} == {"deg"}
    found = [math.radians(float(row["offset_to_add_to_reading"])) for row in offsets]
    assert found == pytest.approx(best_joint_offsets(arm.model).offsets.tolist(), rel=1e-14)


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
        with pytest.raises(InputError, match="cannot be written"):
            write(arm.model, tmp_path / "none" / "t.csv")
