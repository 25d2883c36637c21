"""Errors by the position of a joint: gear lines and axes, found by evidence; scales of other robots of its type."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from math import pi
from typing import Any

import pytest
import torch
from kind_bank import kind_named
from numbers_bank import normal, rms
from product_bank import simulated
from table_bank import refused
from tangent_bank import Setting, covariance
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.choose_scales import scales_of_models
from diffeo_calib.calibration.identification.identification import Prior
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.position_errors import _fall, _Scan, find_gear_lines, with_axis_errors
from diffeo_calib.calibration.scales.selection import defaults
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.process.scales import DEVIATIONS, SCALES, TRANSMISSION_PROFILE, Hyperparameters, axis_deviations
from diffeo_calib.regression.tails import Tails
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.dh import from_dh
from diffeo_calib.runtime.build import axis_waves
from diffeo_calib.runtime.chain import Waves, wave_angles


def test_scales_are_those_of_the_other_model_but_for_one_factor() -> None:
    kind, arm = kind_named("positions"), SimulatedArm(seed=0)
    found = dc.calibrate(arm.nominal, dc.Measurements(*arm.measure(16)), scales_of=[kind.model]).selection
    factor = float(found.scales.sensor_noise / kind.scales.sensor_noise)
    assert_close(found.scales.vector, kind.scales.inflated(factor).vector, rtol=1e-9, atol=0)
    assert "1 other model" in found.status


def test_means_are_quadratic_of_deviations_and_geometric_of_others() -> None:
    scales, model = kind_named("positions").scales, kind_named("positions").model
    mean = scales_of_models([model, model.changed(scales=scales.vector * 7.0)], scales)
    for name in SCALES:
        assert_close(
            getattr(mean, name), (5.0 if name in DEVIATIONS else 7.0**0.5) * getattr(scales, name), rtol=1e-9, atol=0
        )


def test_unusable_models_are_refused() -> None:
    kind, planar = kind_named("positions"), from_dh([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])

    def calibrated(scales_of: Any, robot: dc.Tree = kind.robot, **more: Any) -> Callable[[], object]:
        return lambda: dc.calibrate(robot, kind.data, scales_of=scales_of, **more)

    refused(
        (r"scales_of.*2 joints.*6 joints", calibrated([kind.model], planar)),
        (r"model 2.*calibrated robot.*str", calibrated([kind.model, "model"])),
        (r"scales_of.*list", calibrated(kind.model)),
        (r"model 1 has no scales", calibrated([kind.model.changed(scales=None)])),
        (r"hyperparameters.*scales_of", calibrated([kind.model], hyperparameters=kind.scales)),
    )


LINES = ((2, 200.3, 1e-4), (0, 121.0, 8e-5))


def drawn(lines: Any = LINES, *, q: Tensor | None = None) -> tuple[TangentData, Hyperparameters]:
    """Measurements of the model itself, drawn from its prior, with gear lines in addition; 150 poses by default."""
    arm = SimulatedArm(1)
    q = arm.sample(150, seed=3) if q is None else q
    nominal = GeometryMap(arm.truth, elastic=True)
    zero = torch.zeros(nominal.parameters, dtype=torch.float64)
    sensor = NoiseModel.alike(len(q), 1)
    data = TangentData(nominal, zero, q, arm.truth.points(q).flatten(1), sensor, Tails.none(len(q), 1))
    scales = defaults(data, 3e-5, Prior())
    matrix = data.linearisation(scales).gram() + torch.block_diag(*data.noise(scales))
    y = data.y + (torch.linalg.cholesky(matrix) @ normal(len(matrix))).view_as(data.y)
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
    assert rms(result.model(q) - arm.true_points(q)) < 5e-5  # 0.08 mm without the lines


@cache
def setting(rows: int = 60) -> Setting:
    arm, measurements, _ = simulated(rows)
    return Setting(arm.nominal, measurements)


@pytest.mark.parametrize("joint", [0, 3])
def test_the_axis_is_found(joint: int) -> None:
    """It is shifted and turned before the joint by smooth functions of its value; clean rows have none."""
    data, scales = setting().tangent_data, setting().scales
    assert with_axis_errors(data, scales, torch.arange(60)) is scales
    x = data.x[:, joint, None]
    shape = torch.cat([(2 * x).sin(), x.cos(), (1.5 * x).sin(), (2 * x).cos(), x.sin(), 0 * x], 1)
    moved = 5e-4 * (data.sensitivities[..., 6 + 6 * joint : 12 + 6 * joint] @ shape[:, :, None])[..., 0]
    found = with_axis_errors(replace(data, y=data.y + moved), scales, torch.arange(60))
    ((axis, low, high, _),) = found.axes
    assert axis == joint
    assert low < float(x.min()) < float(x.max()) < high
    assert found.axis_errors is not None
    assert_close(found.axis_errors, torch.full_like(found.axis_errors, 4e-4), rtol=2.0, atol=0)


def test_a_device_that_drifts_while_rows_follow_an_axis_is_no_axis() -> None:
    """Where no row can tell the two, as of the first joint, the user is told."""
    data, scales, t = setting().tangent_data, setting().scales, torch.linspace(0, 1, 60, dtype=torch.float64)[:, None]
    shape = torch.cat([(9 * t).sin(), (12 * t).cos(), t, 0 * t, 0 * t, 0 * t], 1)
    for joint in (3, 0):
        lines = data.x[:, joint].argsort().argsort()
        moved = 5e-4 * (data.sensitivities[..., :6] @ shape[lines][:, :, None])[..., 0]
        drifted = replace(data, y=data.y + moved)
        if joint:
            assert with_axis_errors(drifted, scales, lines) is scales
        else:
            with pytest.warns(dc.DiffeoCalibWarning, match="may be a drift of the device"):
                with_axis_errors(drifted, scales, lines)


def test_the_prior_of_an_axis_is_that_of_functions_with_its_size() -> None:
    plain, data = setting(14).scales, setting(14).tangent_data
    errors, length = torch.tensor([[3e-4, 2e-4]], dtype=torch.float64), torch.tensor([0.3], dtype=torch.float64)
    own = {"axes": ((2, -3.0, 3.0, 10),), "axis_errors": errors, "axis_lengthscale": length}
    scales = replace(plain, **own)
    with_axis = data.with_position_errors(scales)
    assert_close(scales.from_logarithms(scales.logarithms()).axis_errors, errors, rtol=1e-12, atol=0)
    assert_close(scales.inflated(2.0).axis_errors, 2.0 * errors, rtol=1e-12, atol=0)
    waves = Waves(*map(torch.from_numpy, axis_waves(scales.axes, 6)))
    deviations = axis_deviations(errors[0], length[0], 10).view(10, 6)
    functions = wave_angles(waves, data.x, torch).cos() * deviations[:, 0] / deviations[0, 0]  # (N, K)
    twists = data.sensitivities[..., 18:24] * deviations[0]
    added = torch.einsum("ik,jk,imc,jnc->imjn", functions, functions, twists, twists)
    before, after = data.linearisation(plain).gram(), with_axis.linearisation(scales).gram()
    assert_close(after, before + added.reshape(before.shape), rtol=1e-12, atol=1e-16)
    places = torch.linspace(0.0, torch.pi, 2001, dtype=torch.float64)
    values = (torch.arange(1, 11) * places[:, None]).cos()[..., None] * deviations
    assert_close(values.square().sum(1)[:-1].mean(0), errors[0].repeat_interleave(3).square(), rtol=1e-3, atol=0)
    apart, every = torch.linspace(0.0, 0.2, 9, dtype=torch.float64), torch.arange(1, 2001)  # of a stationary process
    variances = axis_deviations(errors[0], length[0] / 6.0, 2000)[::6].square()
    fall = (1.0 - (torch.pi * torch.cat([apart, apart.new_ones(1)])[:, None] * every).cos()) @ variances
    (kernel, _) = TRANSMISSION_PROFILE.derivatives((apart / (length[0] / 6.0)).square(), 1)
    assert_close(1.0 - fall[:-1] / fall[-1], kernel, rtol=0, atol=1e-5)
