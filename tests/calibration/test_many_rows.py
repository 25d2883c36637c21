"""Calibrations of many rows: a sample stands for all rows, except where each row counts by itself."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration import calibrate, choose_scales
from diffeo_calib.calibration.identification import identification
from diffeo_calib.calibration.identification.identification import Identification, identify
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.calibration.scales.leave_one_out import estimate_tails, random_blocks
from diffeo_calib.calibration.scales.selection import defaults
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import seeded
from diffeo_calib.fitting import fit as fitting
from diffeo_calib.fitting.result import silent
from diffeo_calib.robots import SimulatedArm

ARM = SimulatedArm(seed=4)
ROWS, SAMPLED, WRONG = 240, 60, 5


@pytest.fixture(scope="module")
def data() -> dc.Measurements:
    """Rows of which one that is in no sample is wrong by 20 mm."""
    q, points = ARM.measure(ROWS, seed=5)
    points[WRONG, 0, 0] += 0.02
    assert WRONG not in torch.randperm(ROWS, generator=seeded(0))[:SAMPLED]
    return dc.Measurements(q, points)


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples of a few rows."""
    for module in (identification, choose_scales):
        monkeypatch.setattr(module, "LIMITS", replace(module.LIMITS, coordinates=3 * SAMPLED))
    monkeypatch.setattr(fitting, "SAMPLE_COORDINATES", 3 * SAMPLED)
    monkeypatch.setattr(calibrate, "MAX_DENSE", 3 * SAMPLED)
    monkeypatch.setattr(calibrate, "AUTO_CONTROLS", 40)


def identified(data: dc.Measurements) -> Identification:
    return identify(register(ARM.nominal, data.q, data.points).geometry, data.q, data.points)


@pytest.mark.usefixtures("few")
def test_geometry_of_a_sample_weighs_all_rows(data: dc.Measurements, monkeypatch: pytest.MonkeyPatch) -> None:
    found = identified(data)
    assert found.tails.weights.shape == (ROWS, 1)
    assert int(found.tails.weights.argmin()) == WRONG
    monkeypatch.undo()
    whole = identified(data)
    assert found.noise == pytest.approx(whole.noise, rel=0.5)
    assert not torch.equal(found.theta, whole.theta)
    others = ARM.sample(200, seed=9)
    apart = (found.geometry.points(others) - whole.geometry.points(others)).norm(dim=-1)
    assert float(apart.square().mean().sqrt()) < whole.rms


@pytest.mark.slow
@pytest.mark.usefixtures("few")
def test_calibration_of_many_rows(data: dc.Measurements) -> None:
    """All rows are fitted, weighed and judged, and the wrong one is found although the sample is without it."""
    result = dc.calibrate(ARM.nominal, data, hyperparameters=scales(data))
    assert len(result.model.map.deformation.x) == 40
    assert torch.equal(result.model.configurations, data.q)
    assert result.leave_one_out.errors.shape == (ROWS, 3)
    assert result.tails.weights.shape == (ROWS, 1)
    assert [one.row for one in result.outliers] == [WRONG]
    assert result.fit.converged
    others = ARM.sample(300, seed=9)
    errors, covariance = (ARM.true_points(others) - result.model(others))[:, 0], result.model.predict(others)[1][:, 0]
    geometry = ARM.true_points(others) - result.identification.geometry.points(others)
    assert float(errors.square().mean()) < 0.05 * float(geometry.square().mean())
    squares = (errors[:, None] @ torch.linalg.solve(covariance, errors[:, :, None])).flatten()
    assert float((squares < 7.8147).double().mean()) > 0.9


def tangent_data(data: dc.Measurements) -> TangentData:
    return place(ARM.nominal, data, silent).tangent_data()


def scales(data: dc.Measurements) -> dc.Hyperparameters:
    found = identified(data)
    return defaults(tangent_data(data), found.noise, found.prior)


def test_a_wrong_row_of_one_block_among_several_is_weighed(data: dc.Measurements) -> None:
    some, chosen = tangent_data(data), scales(data)
    assert len(random_blocks(some, 0, 3 * SAMPLED)) == ROWS // SAMPLED
    found, whole = (estimate_tails(some, chosen, block_coordinates=3 * size) for size in (SAMPLED, ROWS))
    assert found.gross
    assert whole.gross
    assert int(found.weights.argmin()) == WRONG
    assert_close(found.weights, whole.weights, rtol=0.3, atol=0)
