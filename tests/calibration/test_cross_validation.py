"""Deviations of poses outside of the fit: folds in closed form, with scales that were selected without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from product_bank import simulated
from scipy.stats import chi2
from tangent_bank import Setting, built, covariance, normal, weighted
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.scales.cross_validation import (
    FoldLimits,
    cross_validated_inflation,
    left_out_squares,
    motions,
    noise_of_new_rows,
    random_folds,
)
from diffeo_calib.calibration.scales.selection import SearchLimits, select
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.process.tails import Tails
from diffeo_calib.regression.regions import region_scale
from diffeo_calib.robots import SimulatedArm

BRIEF = FoldLimits(iterations=1)


def narrow(setting: Setting) -> TangentData:
    """With weights of any size, and a narrow prior of the base: G + R spans eight powers of ten with the usual."""
    return replace(weighted(setting), place_deviation=1e-3)


def groups(data: TangentData) -> Tensor:
    return torch.arange(len(data.x))


def parted(data: TangentData, *parts: Tensor) -> Tensor:
    """(N,) the number of each row's part, negative for none."""
    numbers = torch.full((len(data.x),), -1, dtype=torch.int64)
    for number, rows in enumerate(parts):
        numbers[rows] = number
    return numbers


# --- folds --------------------------------------------------------------------------------------------------------


def test_folds_are_predicted_from_all_other_rows(setting: Setting) -> None:
    """By the formulas for conditional Gaussians, one marker or pose after the other."""
    whole, scales, rows = narrow(setting), setting.scales, torch.tensor([1, 4, 7])
    data, new = whole.told, whole.blocks_in_numbers(noise_of_new_rows(whole, scales))
    m = data.y.shape[1]
    inside = torch.isin(torch.arange(data.y.numel()) // m, rows)
    K, y = covariance(data, scales), data.target.flatten()
    gain = torch.linalg.solve(K[~inside][:, ~inside], K[~inside][:, inside]).T
    errors = (y[inside] - gain @ y[~inside]).view(3, m, 1)
    spread = (K[inside][:, inside] - gain @ K[~inside][:, inside]).view(3, m, 3, m)
    own = torch.stack([spread[k, :, k] for k in range(3)])
    part = data.rows(rows)
    predicted = own - part.weighted_noise(scales) + new[rows]
    expected = part.noise_model.squares(predicted, errors @ errors.mT)
    found = left_out_squares(whole, scales, parted(whole, rows))
    assert_close(found[rows], expected, rtol=1e-4, atol=1e-6)
    assert bool(found[[0, 2, 3]].isnan().all())


def test_rows_are_left_out_part_by_part(setting: Setting) -> None:
    data, parts = narrow(setting), [torch.tensor([1, 4]), torch.tensor([7])]
    together = left_out_squares(data, setting.scales, parted(data, *parts))
    for rows in parts:
        alone = left_out_squares(data, setting.scales, parted(data, rows))
        assert_close(together[rows], alone[rows], equal_nan=True)


def test_rows_along_motions_and_repeats_belong_together() -> None:
    rng = np.random.default_rng(0)
    starts, steps = rng.uniform(-1, 1, (8, 1, 6)), 0.01 * rng.standard_normal((8, 1, 6)) * np.arange(5)[:, None]
    along, alone = torch.from_numpy((starts + steps).reshape(40, 6)), torch.from_numpy(rng.uniform(-1, 1, (30, 6)))
    x = torch.cat([along, alone, along[:1]])
    labels = torch.cat([torch.arange(70), torch.zeros(1, dtype=torch.int64)])
    found = motions(x, labels)
    assert found[:40].view(8, 5).unique(dim=1).shape == (8, 1)
    assert len(found.unique()) == 38
    assert found[-1] == found[0]
    few = motions(along[:20], torch.arange(20))  # four motions are too few to leave one out
    assert len(few.unique()) == 20


def test_repeats_stay_in_one_fold() -> None:
    labels = torch.tensor([0, 1, 2, 0, 3, 4, 2, 5, 6, 0])
    for seed in range(3):
        folds = random_folds(labels, 3, seed)
        assert len(folds) == 3
        assert sorted(torch.cat([inside for _, inside in folds]).tolist()) == list(range(10))
        for outside, inside in folds:
            assert sorted([*outside.tolist(), *inside.tolist()]) == list(range(10))
            assert not set(labels[outside].tolist()) & set(labels[inside].tolist())
            assert 2 <= len(set(labels[inside].tolist())) <= 3
    assert len(random_folds(labels, 50, 0)) == 7
    first, same, other = (random_folds(labels, 3, seed)[0][1].tolist() for seed in (0, 0, 1))
    assert first == same != other


# --- the factor ---------------------------------------------------------------------------------------------------


def drawn(setting: Setting, seed: int) -> TangentData:
    """Measurements of a robot that the scales describe exactly."""
    data = setting.tangent_data
    factor = torch.linalg.cholesky(covariance(data, setting.scales))
    target = (factor @ normal(data.y.numel(), seed=seed)).view_as(data.y)
    return replace(data, y=data.y + target - data.target)


def test_right_scales_predict_folds_with_errors_as_large_as_the_measured_ones() -> None:
    setting, ratios = built("sliding"), []
    for seed in range(20):
        data = drawn(setting, seed)
        for _, rows in random_folds(groups(data), 5, seed):
            ratios.append(float(left_out_squares(data, setting.scales, parted(data, rows))[rows].mean()) / 3)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.08)


def test_right_scales_are_hardly_widened() -> None:
    """By the uncertainty of the factor, and by what a search changes that sees fewer rows."""
    setting, found = built("sliding"), []
    for seed in range(5):
        data = drawn(setting, seed)
        factor = cross_validated_inflation(setting.scales, setting.scales, data, groups(data), seed=seed, limits=BRIEF)
        found.append(factor or 0.0)
    assert min(found) > 0.5
    assert 0.9 < np.median(found) < 1.7, found


def test_outliers_hardly_change_the_factor() -> None:
    setting = built("sliding")
    clean = drawn(setting, 1)
    y = clean.y.clone()
    y[3] += 5e-3
    weights = torch.ones_like(clean.tails.weights)
    weights[3] = 1e-5
    wrong = replace(clean, y=y).with_tails(Tails(4.0, weights))
    before, after = (
        cross_validated_inflation(setting.scales, setting.scales, data, groups(data), limits=BRIEF)
        for data in (clean, wrong)
    )
    assert after == pytest.approx(before, rel=0.5)


@pytest.mark.slow
def test_scales_chosen_on_few_poses_fit_these_poses() -> None:
    """Leave-one-out errors look small, errors of other poses and cross-validated ones do not."""
    arm, train, _ = simulated(30)
    setting = Setting(arm.nominal, train)
    data = setting.tangent_data
    scales = select(setting.scales, data, limits=SearchLimits(fewest_first=40, most_first=40)).scales
    optimistic = region_scale(left_out_squares(data, scales, torch.arange(30)), 3)
    ratio = np.mean(
        [(cross_validated_inflation(setting.scales, scales, data, groups(data), seed=seed) or 0.0) for seed in range(2)]
    )
    assert optimistic < 0.75
    assert ratio > 1.15 * optimistic  # both are drawn towards one by the prior


# --- on a robot ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_coverage_with_few_poses() -> None:
    """The 95 % regions of new measurements, two arms with 30 poses."""
    found = []
    for seed in range(2):
        arm = SimulatedArm(seed=seed)
        q, points = arm.measure(330, seed)
        model = dc.calibrate(arm.nominal, dc.Measurements(q[:30], points[:30])).model
        mean, covariance = model.predict(q[30:])
        errors = (points[30:] - mean)[..., None]
        squares = (errors.mT @ torch.linalg.solve(covariance, errors)).flatten()
        found.append(float((squares < chi2.ppf(0.95, 3)).double().mean()))
    assert 0.9 < np.mean(found) < 0.995, found
