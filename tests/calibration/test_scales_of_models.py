"""Scales of other robots of the same type: which ones are used, and models that cannot give any."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from table_bank import refused

import diffeo_calib as dc
from diffeo_calib.calibration.scales.of_models import scales_of_models
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.process.scales import DEVIATIONS, SCALES
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
    return model._with(scales=scales)


def test_scales_are_those_of_the_other_model_but_for_one_factor(
    first: dc.CalibrationResult, second: dc.CalibrationResult
) -> None:
    ours, theirs = second.selection.scales, first.selection.scales
    factor = float(ours.sensor_noise / theirs.sensor_noise)
    torch.testing.assert_close(ours.vector, theirs.inflated(factor).vector)
    assert "1 other model" in second.selection.status


def test_scales_survive_the_file_and_its_placing(first: dc.CalibrationResult, tmp_path: Path) -> None:
    dc.save(first.model, tmp_path / "model.safetensors")
    loaded = dc.load(tmp_path / "model.safetensors")
    assert isinstance(loaded, CalibratedKinematics)
    for model in (first.model, loaded, loaded.with_tool([0.0, 0.0, 0.1])):
        torch.testing.assert_close(model.scales, first.selection.scales.vector)


def test_means_are_quadratic_of_deviations_and_geometric_of_others(first: dc.CalibrationResult) -> None:
    scales, model = first.selection.scales, first.model
    larger = with_scales(model, scales.vector * 7.0)
    mean = scales_of_models([model, larger], scales)
    for name in SCALES:
        expected = 5.0 if name in DEVIATIONS else 7.0**0.5
        torch.testing.assert_close(getattr(mean, name), expected * getattr(scales, name))


def test_a_part_that_a_model_does_not_need_stays_out(first: dc.CalibrationResult) -> None:
    some = first.selection.scales
    scales = replace(some, transmission_amplitude=torch.zeros_like(some.transmission_amplitude))
    found = scales_of_models([with_scales(first.model, scales.vector)], scales)
    assert not bool(found.transmission_amplitude.any())
    torch.testing.assert_close(found.vector, scales.vector)


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
