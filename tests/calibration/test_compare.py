"""What a comparison of a model with new rows, or with another model, finds; nothing where nothing changed."""

from __future__ import annotations

import warnings
from functools import cache
from math import inf
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from again_bank import arm, model, payloads, positions
from campaigns import CAMPAIGNS
from product_bank import usual_scales
from torch import Tensor
from torch.distributions import MultivariateNormal

import diffeo_calib as dc
from diffeo_calib.calibration.recalibration.find_changes import NOISE_FACTORS, SIZES, likelihood_ratios
from diffeo_calib.calibration.recalibration.recalibrate import Comparison

OFFSET = 1e-3
"""Of a joint, rad."""


def with_offset(data: dc.Measurements, joint: int, size: float = OFFSET) -> dc.Measurements:
    """Rows whose encoder of a joint reads too little."""
    q = data.q.clone()
    q[:, joint] -= size
    return dc.Measurements(q, data.points, data.joint_names)


def compared_with(rows: dc.Measurements) -> Comparison:
    compared = dc.compare(model(positions), rows)
    assert isinstance(compared, Comparison)
    return compared


@cache
def unchanged() -> Comparison:
    return compared_with(positions(arm(), 24, seed=5))


@pytest.mark.parametrize(("joint", "what"), [(0, "device"), (5, "markers")])
def test_offsets_that_places_hide_are_named(joint: int, what: str) -> None:
    rows = with_offset(positions(arm(), 24, seed=5), joint)
    (found,) = compared_with(rows).hidden
    assert found.joint == arm().nominal.joint_names[joint]
    assert found.size == pytest.approx(OFFSET, abs=4 * found.deviation)
    assert found.deviation < 0.3 * OFFSET
    assert what in str(found)


def test_nothing_is_hidden_where_nothing_moved() -> None:
    assert unchanged().hidden == ()


def test_the_smallest_offset_that_rows_show() -> None:
    rows = positions(arm(), 24, seed=5)
    waist, _, elbow, *_ = unchanged().changes.smallest
    assert waist.size == inf  # the device's place hides it
    assert 2e-5 < elbow.size < 3e-4
    for factor in (0.2, 1.5):
        found = compared_with(with_offset(rows, 2, factor * elbow.size)).changes.found
        assert [one.part for one in found] == [f"the offset of {elbow.joint}"] * (factor > 1)
        for one in found:
            assert one.others == ()
            assert one.deviation is not None
            assert abs(one.size - factor * elbow.size) < 4 * one.deviation < 4e-4


def test_a_change_between_two_models_is_named() -> None:
    """An offset, or wear; tests/test_matrix.py compares models between which nothing changed."""
    name = arm().nominal.joint_names[2]
    offset = with_offset(positions(arm(), 40, seed=7), 2, 0.4 * OFFSET)
    for rows, part in ((offset, f"the offset of {name}"), (positions(arm().worn(2, 3.0), 40, seed=7), name)):
        new = dc.calibrate(arm().nominal, rows, hyperparameters=usual_scales(arm().nominal)).model
        compared = dc.compare(model(positions), new)
        assert compared.rms > 2.0 * compared.expected  # a change does not explain itself
        assert compared.telling
        (one,) = compared.changes.found
        assert one.part == part
        assert one.deviation is None or one.size == pytest.approx(0.4 * OFFSET, abs=4 * one.deviation)
        assert one.part in str(compared)


def test_places_that_a_fit_left_open_explain_no_difference_of_models() -> None:
    """With a tool that only turns about the vertical its height is open, by decimetres, and found anew."""
    q = CAMPAIGNS["tool turned about the vertical"](arm(), 30, torch.Generator().manual_seed(3))
    rows = dc.Measurements(q, arm().true_points(q), doubt=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dc.DiffeoCalibWarning)  # of what is open
        old = dc.calibrate(arm().nominal, rows, hyperparameters=usual_scales(arm().nominal)).model
    compared = dc.compare(old, model(positions))
    assert compared.expected < 1e-3
    assert not compared.changes.found


def test_ratios_are_those_of_the_definition() -> None:
    """Largest densities over all levels of noise and sizes of the change, with explicit matrices."""
    draws = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=draws, dtype=torch.float64)

    shapes, roots, noise = normal(18, 4), {"a": normal(6, 3, 2), "b": normal(6, 3, 1)}, normal(6, 3, 5)
    base, noise = shapes @ shapes.T, noise @ noise.mT
    residual = 3.0 * roots["a"] @ normal(2) + normal(6, 3)
    seen = torch.ones_like(residual, dtype=torch.bool)
    none = base.new_zeros(0)
    given = SimpleNamespace(C=base, slopes=base[:, :0], prior=none.view(0, 0))
    rows: Any = SimpleNamespace(weighted_noise=noise, visible=seen, residual=residual, given=given)
    found, level = likelihood_ratios(rows, roots, seed=0)

    def densities(root: Tensor, sizes: Tensor) -> Tensor:  # (noise, sizes)
        columns = root.flatten(0, 1)
        levels = base + NOISE_FACTORS[:, None, None] * torch.block_diag(*noise)
        covariances = levels[:, None] + sizes[:, None, None] * (columns @ columns.T)
        return MultivariateNormal(torch.zeros_like(residual.flatten()), covariances).log_prob(residual.flatten())

    without = densities(roots["a"], torch.zeros(1, dtype=torch.float64))
    assert level**2 == pytest.approx(float(NOISE_FACTORS[without[:, 0].argmax()]))
    for name, root in roots.items():
        best = densities(root, SIZES).amax(0)
        assert found[name].value == pytest.approx(2.0 * float(best.max() - without.max()), rel=1e-6)
        assert found[name].variance == pytest.approx(float(SIZES[best.argmax()]))


def test_a_model_with_payloads_is_compared_with_one_without_any_under_none() -> None:
    loaded, bare = model(payloads), model(positions)
    for pair in ((loaded, bare), (bare, loaded)):
        found = dc.compare(*pair)
        assert found.payload == 0.0
        assert found.rms < 3.0 * found.expected
        assert str(found).startswith("with a payload of 0")
