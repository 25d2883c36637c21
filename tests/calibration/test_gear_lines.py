"""Gear lines of simulated arms, and scales of other robots of the same type."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import pi
from typing import Any

import pytest
import torch
from table_bank import refused
from tangent_bank import covariance
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.choose_scales import scales_of_models
from diffeo_calib.calibration.identification.identification import Prior
from diffeo_calib.calibration.scales.gear_lines import _fall, _Scan, find_gear_lines
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.selection import defaults
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.process.scales import DEVIATIONS, SCALES, Hyperparameters
from diffeo_calib.process.tails import Tails
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.dh import from_dh

ROWS = 16


def measured(seed: int) -> tuple[SimulatedArm, dc.Measurements]:
    arm = SimulatedArm(seed=seed)
    return arm, dc.Measurements(*arm.measure(ROWS))


@pytest.fixture(scope="module")
def first() -> dc.CalibrationResult:
    arm, data = measured(0)
    return dc.calibrate(arm.nominal, data)


@pytest.fixture(scope="module")
def second(first: dc.CalibrationResult) -> dc.CalibrationResult:
    arm, data = measured(1)
    return dc.calibrate(arm.nominal, data, scales_of=[first.model])


def with_scales(model: CalibratedKinematics, scales: torch.Tensor | None) -> CalibratedKinematics:
    return model.changed(scales=scales)


def test_scales_are_those_of_the_other_model_but_for_one_factor(
    first: dc.CalibrationResult, second: dc.CalibrationResult
) -> None:
    ours, theirs = second.selection.scales, first.selection.scales
    factor = float(ours.sensor_noise / theirs.sensor_noise)
    torch.testing.assert_close(ours.vector, theirs.inflated(factor).vector)
    assert "1 other model" in second.selection.status


def test_means_are_quadratic_of_deviations_and_geometric_of_others(first: dc.CalibrationResult) -> None:
    scales, model = first.selection.scales, first.model
    larger = with_scales(model, scales.vector * 7.0)
    mean = scales_of_models([model, larger], scales)
    for name in SCALES:
        expected = 5.0 if name in DEVIATIONS else 7.0**0.5
        torch.testing.assert_close(getattr(mean, name), expected * getattr(scales, name))


def test_unusable_models_are_refused(first: dc.CalibrationResult) -> None:
    arm, data = measured(1)
    planar, model, wrong = from_dh([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), first.model, "model"

    def calibrated(scales_of: Any, robot: dc.Chain = arm.nominal, **more: Any) -> Callable[[], object]:
        return lambda: dc.calibrate(robot, data, scales_of=scales_of, **more)

    refused(
        (r"scales_of.*2 joints.*6 joints", calibrated([model], planar)),
        (r"model 2.*calibrated robot.*str", calibrated([model, wrong])),
        (r"scales_of.*list", calibrated(model)),
        (r"model 1 has no scales", calibrated([with_scales(model, None)])),
        (r"hyperparameters.*scales_of", calibrated([model], hyperparameters=first.selection.scales)),
    )


# --- gear lines: planted ones are found, none where there is none -----------------------------------------------------

LINES = ((2, 200.3, 1e-4), (0, 121.0, 8e-5))


def drawn(lines: object = LINES, *, q: Tensor | None = None, seed: int = 0) -> tuple[TangentData, Hyperparameters]:
    """Measurements of the model itself, drawn from its prior, with gear lines in addition; 150 poses by default."""
    arm = SimulatedArm(1)
    q = arm.sample(150, seed=3) if q is None else q
    nominal = GeometryMap(arm.truth, elastic=True)
    zero = torch.zeros(nominal.parameters, dtype=torch.float64)
    sensor = NoiseModel.alike(len(q), 1)
    data = TangentData(nominal, zero, q, arm.truth.points(q).flatten(1), sensor, Tails.none(len(q), 1))
    scales = defaults(data, 3e-5, Prior())
    matrix = data.linearisation(scales).gram() + torch.block_diag(*data.noise(scales))
    noise = torch.randn(len(matrix), dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    y = data.y + (torch.linalg.cholesky(matrix) @ noise).view_as(data.y)
    for joint, frequency, amplitude in lines:
        y = y + amplitude * data.jacobian[..., joint] * (frequency * q[:, joint, None] + 0.7).sin()
    return replace(data, y=y), scales


def test_planted_lines_are_found() -> None:
    data, scales = drawn()
    lines = find_gear_lines(data, scales)
    scales = replace(scales, lines=lines)
    assert find_gear_lines(data.with_position_errors(scales), scales) == ()
    found = sorted(lines, key=lambda line: -line.frequency)
    assert [line.joint for line in found] == [joint for joint, _, _ in LINES]
    for line, (_, frequency, amplitude) in zip(found, LINES, strict=True):
        assert line.frequency == pytest.approx(frequency, abs=0.5)
        assert line.amplitude * 2**0.5 == pytest.approx(amplitude, rel=0.35)  # b is that of cosine and sine each


def test_no_line_where_other_frequencies_explain_the_same() -> None:
    """On whole multiples of 5 degrees, frequencies that differ by 72 per rad are one."""
    q = SimulatedArm(1).sample(150, seed=3)
    step = 5.0 * pi / 180.0
    grid = q.clone()
    grid[:, 2] = (q[:, 2] / step).round() * step
    assert [line.joint for line in find_gear_lines(*drawn(LINES[:1]))] == [2]
    assert find_gear_lines(*drawn(LINES[:1], q=grid)) == ()


def test_the_scan_is_that_of_least_squares() -> None:
    """Against dense generalised least squares, at frequencies of the scan and between them."""
    data, scales = drawn()
    scan = _Scan(data.process(scales))
    K = covariance(data, scales)
    whiten = torch.linalg.inv(torch.linalg.cholesky(K))
    r = whiten @ data.target.flatten()
    for joint in (0, 3):
        falls = _fall(*scan._binned(joint))
        for at in (0, 4817, 10300):
            frequency = float(scan.frequencies[at])
            angle = frequency * data.x[:, joint, None]
            J = data.jacobian[..., joint]
            X = whiten @ torch.stack([(J * angle.cos()).flatten(), (J * angle.sin()).flatten()], 1)
            expected = float(r @ r) - float((r - X @ torch.linalg.lstsq(X, r).solution).square().sum())
            exact = scan._evidence(joint, torch.tensor([frequency], dtype=torch.float64))
            assert float(exact.gain) == pytest.approx(expected, rel=1e-6, abs=1e-6)
            assert float(falls[at]) == pytest.approx(expected, rel=0.02, abs=0.05)


@pytest.mark.slow
def test_a_calibration_reports_its_lines_and_predicts_better() -> None:
    arm = SimulatedArm(3, lines=[(1, 100.0, 1e-4), (0, 200.0, 8e-5)])
    result = dc.calibrate(arm.nominal, dc.Measurements(*arm.measure(120, seed=2)))
    assert sorted(round(line.frequency) for line in result.gear_lines) == [100, 200]
    assert {line.multiple for line in result.gear_lines} == {1, 2}
    names = arm.nominal.joint_names
    assert {line.joint for line in result.gear_lines} == {names[0], names[1]}
    q = arm.sample(300, seed=9)
    error = (result.model(q) - arm.true_points(q)).norm(dim=-1)
    assert float(error.square().mean().sqrt()) < 5e-5  # 0.08 mm without the lines
