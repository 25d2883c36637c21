"""Drift with a column of times or temperatures: found where it is, left out where it is not, undone in other rows."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from again_bank import true_error
from numbers_bank import drawn, normal, tensor
from reading_bank import readings, scales
from table_bank import refused, warned
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.hypotheses import worth_it
from diffeo_calib.calibration.placing.placement import FRAME_M_RAD, GROWTH, OFFSET_RAD_M, Drift
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.measurements.csv.files import read_observations, write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import Geometry, SimulatedArm
from diffeo_calib.sensors.known_drift import KnownDrift

ARM = SimulatedArm(seed=0)
ROWS, OFFSET_RAD = 80, 4e-4


def hours(count: int) -> Tensor:
    """Times in random order, from 3 to 7 h."""
    return 3.0 + 4.0 * drawn(count, seed=1)


def turned(q: Tensor, time: Tensor, offset: float = OFFSET_RAD) -> Tensor:
    """Joint values whose second one is off by ``offset`` between the first hour and the last."""
    moved = q.clone()
    moved[:, 1] += offset * ((time - 3.0) / 4.0 - 0.5)
    return moved


def drifting_rows(offset: float = OFFSET_RAD) -> dc.Measurements:
    q, time = ARM.sample(ROWS + 60, seed=4), hours(ROWS + 60)
    points = ARM.true_points(turned(q, time, offset)) + normal(ROWS + 60, 1, 3, seed=2, size=2e-5)
    return dc.Measurements(q, points, ARM.nominal.joint_names).with_covariates(time=time)


def calibrated(data: object) -> Any:
    return warned(dc.calibrate, ARM.nominal, data, hyperparameters=scales())[0]


def drifts(result: Any) -> list[Drift]:
    return [own for own in result.placement if isinstance(own, Drift)]


@pytest.fixture(scope="module")
def drifted() -> tuple[dc.Measurements, dc.Measurements, Any]:
    """Rows of a fit, others of the same drift, and the calibration."""
    data = drifting_rows()
    return data[:ROWS], data[ROWS:], calibrated(data[:ROWS])


def test_a_joint_offset_that_drifts_is_part_of_the_model(drifted: Any) -> None:
    train, other, result = drifted
    plain = calibrated(train.with_covariates())
    (drift,) = drifts(result)
    (line,) = drift.sentences()
    found = re.search(f"the offset of {ARM.nominal.joint_names[1]} by ([^ ]+)", line)
    assert float(found[1]) == pytest.approx(1e3 * OFFSET_RAD, rel=0.3)
    assert drifts(plain) == []
    assert dc.evaluate(result.model, result.aligned(other)).rms < 0.7 * dc.evaluate(plain.model, other).rms
    assert true_error(result.model, ARM) < true_error(plain.model, ARM)


def test_a_column_with_which_nothing_drifts_changes_nothing() -> None:
    train = drifting_rows(0.0)[:40]
    plain, result = calibrated(train.with_covariates()), calibrated(train)
    assert drifts(result) == []
    assert torch.equal(plain.model(train.q), result.model(train.q))


@pytest.mark.slow
def test_readings_show_a_drift_too() -> None:
    time, still = hours(150), readings(ARM, "height", 150)
    moved = readings(ARM, "height", 150, noise=2e-5, turned=lambda q: turned(q, time, 2 * OFFSET_RAD))
    data = dc.Readings.heights(still.q, moved.values[:, 0], moved.device_names, ARM.nominal.joint_names)
    plain, result = calibrated(data), calibrated(data.with_covariates(time=time))
    assert len(drifts(result)) == 1
    assert true_error(result.model, ARM) < true_error(plain.model, ARM)


def test_rows_are_brought_to_the_middle_of_the_column() -> None:
    """Shift, turn, growth and offsets, written out: effects are slopes, `points` has them, `aligned` undoes them."""
    q, time = ARM.sample(20, seed=3), hours(20)
    geometry = Geometry.nominal(ARM.nominal, 2)
    nominal = GeometryMap(geometry, elastic=True)
    zero = torch.zeros(nominal.parameters, dtype=torch.float64)
    unknowns = normal(13, seed=5)
    size = unknowns * tensor([FRAME_M_RAD] * 6 + [GROWTH] + [OFFSET_RAD_M] * 6)
    a = ((time - time.min()) / (time.max() - time.min()) - 0.5)[:, None]
    plain = nominal(q, zero)
    centre = plain.view(-1, 3).mean(0)
    away = nominal(q + a * size[7:], zero).view(20, 2, 3) - centre
    turn = torch.linalg.cross((a * size[3:6])[:, None].expand_as(away), away)
    moved = away + centre + (a * size[:3])[:, None] + turn + (a * size[6])[..., None] * away
    data = dc.Measurements(q, moved).with_covariates(time=time)
    drift: Any = Drift.of_table(data, ARM.nominal)[0]
    whole = torch.eye(6, dtype=torch.float64).expand(len(plain), 6, 6)
    effects = drift.effects(SimpleNamespace(nominal=nominal, y=plain, points=plain, slopes=whole))
    assert_close(effects @ unknowns, moved.flatten(1) - plain, rtol=0, atol=1e-5)
    constants = torch.cat([drift.devices.constants[:, :2], centre[None], size[None]], 1)
    found = replace(drift.devices, constants=constants, deviations=size[None].abs())
    back = found.undone(data)
    assert_close(nominal(back.q, zero), back.points.flatten(1), rtol=0, atol=1e-5)
    assert back.covariates is None
    assert_close(found.points(lambda q: nominal(q, zero).view(-1, 2, 3), data), moved, rtol=0, atol=1e-5)


def test_a_model_keeps_its_drift(drifted: Any, tmp_path: Path) -> None:
    _, other, result = drifted
    dc.save(result.model, tmp_path / "m.safetensors")
    model = dc.load(tmp_path / "m.safetensors")
    assert isinstance(model, dc.CalibratedKinematics)
    known, told, untold = KnownDrift.of(model), dc.evaluate(model, other), dc.evaluate(model, other.with_covariates())
    assert told.rms == pytest.approx(dc.evaluate(result.model, other).rms, rel=1e-9)
    assert told.rms < 0.7 * untold.rms
    assert "time 5" in " ".join(untold.placed)  # from 3 to 7
    assert list(known.of_joints()) == drifts(result)[0].sentences()
    with torch.inference_mode():
        again = model.registered(other)
    assert KnownDrift.of(again) is None
    assert KnownDrift.of(ARM) is None


def test_beyond_its_rows_a_drift_stays_as_at_the_end(drifted: Any) -> None:
    model = drifted[2].model
    known: Any = KnownDrift.of(model)
    late, last = (drifted[1].with_covariates(time=torch.full((60,), t, dtype=torch.float64)) for t in (900.0, 7.0))
    assert_close(known.points(model, late), known.points(model, last), rtol=0, atol=1e-6)
    (line,) = [line for line in known.in_rows(late) if "outside" in line]
    assert re.search(r"\b60\b", line)
    assert dc.evaluate(model, late).placed[-1] == line
    for end in known.ends["time"]:  # the rows of the fit reach them
        there = drifted[1].with_covariates(time=torch.full((60,), end, dtype=torch.float64))
        assert not [line for line in known.in_rows(there) if "outside" in line]


def test_columns_are_rows_of_the_table(tmp_path: Path) -> None:
    (q, points), columns = ARM.measure(12, seed=1), {"time": hours(12), "temperature": 20.0 + hours(12)}
    data: Any = dc.Measurements(q, points, ARM.nominal.joint_names).with_covariates(**columns)
    both: Any = dc.Observations.joined([data, readings(ARM, "height", 12).with_covariates(**columns)])
    for rows in (data, both):
        form = write_measurements(tmp_path / "t.csv", rows, TableFormat("mm", "deg", time="hour"))
        read: Any = read_observations(tmp_path / "t.csv", form)
        assert read.covariate_names == ("time", "temperature")
        assert_close(read.rows([3, 1]).covariates, rows.covariates[[3, 1]], rtol=1e-12, atol=0)


def test_columns_that_cannot_be() -> None:
    q, points = ARM.measure(12, seed=1)
    table = dc.Measurements(q, points)
    refused(
        ("temperature", lambda: table.with_covariates(temperature=[1.0, 2.0])),
        ("time", lambda: table.with_covariates(time=[float("nan")] * 12)),
        ("covariate", lambda: dc.Measurements.joined([table, table.with_covariates(time=hours(12))])),
    )


@pytest.mark.parametrize(("left", "better"), [([0.9] * 100, True), ([1.0] * 99 + [0.0], False), ([0.99] * 100, False)])
def test_a_drift_must_help_most_rows_and_not_one(left: list[float], better: bool) -> None:
    """Left-out errors of 1, with one of 30 in the second case: without it the mean square falls to a tenth."""
    before = torch.ones(100, dtype=torch.float64)
    before[-1] = 1.0 if left[-1] else 30.0
    assert worth_it(before[:, None], before.new_tensor(left)[:, None]) == better
