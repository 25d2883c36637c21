"""Errors of a kinematics against numpy, and markers that do not match."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from product_bank import Case

import diffeo_calib as dc
from diffeo_calib.errors import InputError


@pytest.mark.parametrize(("rows", "markers"), [(1, 1), (2, 1), (7, 3), (200, 2)])
def test_numbers_are_numpy_s(rows: int, markers: int) -> None:
    rng = np.random.default_rng(rows)
    q, points = rng.normal(size=(rows, 2)), rng.normal(size=(rows, markers, 3))
    predicted = points + 1e-3 * rng.normal(size=points.shape) * rng.exponential(size=(rows, markers, 1))
    distances = np.linalg.norm(predicted - points, axis=-1)
    found = dc.evaluate(lambda _: torch.from_numpy(predicted), dc.Measurements(q, points))
    np.testing.assert_allclose(found.errors.numpy(), distances, rtol=1e-12)
    assert found.rms == pytest.approx(float(np.sqrt(np.mean(distances**2))), rel=1e-12)
    assert found.mean == pytest.approx(float(np.mean(distances)), rel=1e-12)
    assert found.median == pytest.approx(float(np.median(distances)), rel=1e-12)
    assert found.p95 == pytest.approx(float(np.percentile(distances, 95)), rel=1e-12)
    assert found.max == pytest.approx(float(distances.max()), rel=1e-15)
    assert found.quantile(0.25) == pytest.approx(float(np.quantile(distances, 0.25)), rel=1e-12)
    assert isinstance(found.rms, float)


def test_a_perfect_model_has_no_error() -> None:
    data = dc.Measurements([[0.1], [0.2]], [[1.0, 2, 3], [4, 5, 6]])
    found = dc.evaluate(lambda _: data.points, data)
    assert (found.rms, found.mean, found.median, found.p95, found.max) == (0, 0, 0, 0, 0)


def test_models_that_carry_a_gradient_can_be_evaluated(arm: Case) -> None:
    data = arm.test.rows(slice(3))
    assert dc.evaluate(lambda q: arm.model(q.requires_grad_(False).clone().requires_grad_()), data).rms > 0


def test_another_number_of_markers(arm: Case, pair: Case) -> None:
    message = (
        r"do not have the same markers: expected predictions of shape \(300, 2, 3\), got \(300, 1, 3\); evaluate on"
    )
    with pytest.raises(InputError, match=message):
        dc.evaluate(arm.model, pair.test)
    with pytest.raises(InputError, match="do not have the same markers"):
        dc.evaluate(pair.model, arm.test)


def test_another_number_of_joints(arm: Case) -> None:
    with pytest.raises(InputError, match=r"`q` must have shape \(N, 6\)"):
        dc.evaluate(arm.model, dc.Measurements(arm.test.q[:, :5], arm.test.points))
