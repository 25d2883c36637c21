"""Rows and folds that are left out: weights, errors and deviations outside of the fit, by closed forms and refits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from tangent_bank import Setting, built, covariance, normal, prior_covariance
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.scales import leave_one_out as one_out
from diffeo_calib.calibration.scales.leave_one_out import (
    LeaveOneOut,
    cross_validated_inflation,
    leave_one_out,
    motions,
    random_folds,
)
from diffeo_calib.calibration.scales.selection import select
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.process.tails import Tails, reweight
from diffeo_calib.robots import SimulatedArm


@dataclass
class Chosen:
    """Clean measurements, and scales that were chosen for them."""

    data: TangentData
    scales: dc.Hyperparameters

    def moved(self, row: int, coordinates: slice, by: float) -> TangentData:
        return moved(self.data, row, coordinates, by)

    def conditioned(self) -> TangentData:
        """With weights of any size, and a narrow prior of the base: G + R spans eight powers of ten with the usual."""
        return weighted(replace(self.data, place_deviation=1e-3))


def moved(data: TangentData, row: int, coordinates: slice, by: float) -> TangentData:
    """The same measurements, one of them wrong."""
    y = data.y.clone()
    y[row, coordinates] += by
    return replace(data, y=y)


def chosen(setting: Setting) -> Chosen:
    return Chosen(setting.tangent_data, select(setting.scales, setting.tangent_data, iterations=15).scales)


@pytest.fixture(scope="module")
def clean() -> Chosen:
    arm = SimulatedArm(seed=4)
    return chosen(Setting(arm.nominal, dc.Measurements(*arm.measure(60, seed=5))))


@pytest.fixture(scope="module")
def pair() -> Chosen:
    arm = SimulatedArm(seed=4, markers=2)
    return chosen(Setting(arm.nominal, dc.Measurements(*arm.measure(40, seed=5))))


@pytest.fixture(scope="module")
def framed() -> Chosen:
    return chosen(built("posed"))


def weighted(data: TangentData, seed: int = 0) -> TangentData:
    weights = np.random.default_rng(seed).uniform(0.05, 1.5, tuple(data.tails.weights.shape))
    return data.with_tails(Tails(4.0, torch.from_numpy(weights)))


@pytest.mark.parametrize("by", [5e-4, 5e-2])
def test_wrong_rows_lose_their_weight(clean: Chosen, by: float) -> None:
    data, bad = clean.data, [7, 20, 21, 55]
    for row, sign in zip(bad, (1, -1, 1, -1), strict=True):
        data = moved(data, row, slice(row % 3, row % 3 + 1), sign * by)
    tails = one_out.weighed(data, clean.scales).tails
    good = [row for row in range(60) if row not in bad]
    assert tails.gross
    assert float(tails.weights[bad].max()) < 0.1 * (5e-4 / by)
    assert float(tails.weights[good].min()) > 0.2
    errors = leave_one_out(data.with_tails(tails), clean.scales)
    assert sorted(errors.squares[:, 0].topk(4).indices.tolist()) == bad


@pytest.mark.parametrize("name", ["pair", "framed"])
def test_weights_are_those_of_the_errors_under_the_posterior(
    name: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Conditioned on everything: the mean error, and the uncertainty of the signal. One round, from given weights."""
    case: Chosen = request.getfixturevalue(name)
    data = case.conditioned()
    n, m = data.target.shape
    G, total = prior_covariance(data, case.scales), covariance(data, case.scales)
    target = data.target.flatten()
    gain = torch.linalg.solve(total, G).mT
    residual, uncertain = target - gain @ target, G - gain @ G
    moments = torch.outer(residual, residual) + (uncertain + uncertain.mT) / 2
    blocks = torch.stack([moments[m * i : m * (i + 1), m * i : m * (i + 1)] for i in range(n)])
    blocks = data.blocks_in_coordinates(blocks)
    expected = reweight(data.noise_model.squares(data.noise(case.scales), blocks), data.noise_model.freedom)
    monkeypatch.setattr(one_out, "ROUNDS", 1)
    monkeypatch.setattr(one_out, "gross_weights", lambda *_: None)
    actual = one_out.weighed(data, case.scales).tails
    assert actual.freedom == expected.freedom < inf
    assert_close(actual.weights, expected.weights, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", ["clean", "pair", "framed"])
def test_leave_one_out_is_refitting_without_the_row(name: str, request: pytest.FixtureRequest) -> None:
    case: Chosen = request.getfixturevalue(name)
    data = case.conditioned()
    found = leave_one_out(data, case.scales)
    n, m = data.target.shape
    G, total = prior_covariance(data, case.scales), covariance(data, case.scales)
    noise = data.blocks_in_numbers(data.noise(case.scales))
    assert found.errors.shape == data.y.shape
    assert found.squares.shape == (n, data.noise_model.bodies)
    assert found.count == data.target.numel()
    scale = float(found.errors.abs().max())
    for row in range(0, n, 5):
        own = slice(m * row, m * (row + 1))
        rest = torch.cat([torch.arange(m * row), torch.arange(m * (row + 1), m * n)])
        gain = torch.linalg.solve(total[rest][:, rest], G[rest][:, own]).mT
        error = data.target[row] - gain @ data.target.flatten()[rest]
        of_row = data.rows(torch.tensor([row]))
        assert_close(found.errors[row], of_row.in_coordinates(error[None, :, None])[0, :, 0], rtol=0, atol=1e-8 * scale)
        predicted = G[own, own] - gain @ G[rest][:, own] + noise[row]
        sensor = data.noise_model.rows(torch.tensor([row]))
        both = (of_row.blocks_in_coordinates(one[None]) for one in (predicted, torch.outer(error, error)))
        expected = sensor.squares(*both)
        assert_close(found.squares[row], expected[0], rtol=1e-7, atol=1e-8)
    trace = float(torch.linalg.solve(total, G).trace())  # of the matrix that makes fitted values from measured ones
    assert found.effective == pytest.approx(trace, rel=1e-6)


def test_several_blocks_are_predicted_one_by_one(pair: Chosen, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, data = leave_one_out(pair.data, pair.scales), weighted(pair.data)
    monkeypatch.setattr(one_out, "BLOCK_COORDINATES", 130)
    found = leave_one_out(data, pair.scales, seed=3)
    for rows, _ in one_out._parts(data, 3):
        alone = leave_one_out(data.rows(rows), pair.scales)
        assert_close(found.errors[rows], alone.errors, rtol=0, atol=1e-9)
        assert_close(found.squares[rows], alone.squares, rtol=1e-5, atol=1e-7)
    assert bool(torch.isfinite(found.errors).all())
    assert found.effective is None  # that of no single fit
    again, other = (leave_one_out(data, pair.scales, seed=seed) for seed in (3, 4))
    assert torch.equal(again.errors, found.errors)
    assert not torch.allclose(other.errors, found.errors, rtol=1e-3, atol=0)
    assert float(found.errors.square().mean()) > 0.8 * float(whole.errors.square().mean())  # fewer rows predict worse


def doubled(values: Tensor) -> Tensor:
    return torch.cat([values, values])


def test_few_data_inflate_the_regions_as_student_s_t_does() -> None:
    """95 % regions of three normal coordinates whose variance was estimated from nu further coordinates."""
    errors = torch.zeros(30, 3, dtype=torch.float64)
    for freedom in (8, 20):
        left_out = LeaveOneOut(errors, errors[:, :1], count=90, effective=90.0 - freedom)
        rng = np.random.default_rng(0)
        estimated = rng.chisquare(freedom, 200_000) / freedom
        squares = (rng.standard_normal((200_000, 3)) ** 2).sum(1) / estimated
        inside = (squares / left_out.inflation(30) < chi2.ppf(0.95, 3)).mean()
        assert abs(inside - 0.95) < 0.003
    assert LeaveOneOut(errors, errors[:, :1], count=90, effective=None).inflation(30) == 1.0
    exhausted = LeaveOneOut(errors, errors[:, :1], count=90, effective=89.9)
    assert exhausted.inflation(30) == LeaveOneOut(errors, errors[:, :1], count=90, effective=82.0).inflation(30)
    twice = LeaveOneOut(doubled(errors), doubled(errors[:, :1]), count=180, effective=70.0)
    assert twice.inflation(30) == LeaveOneOut(errors, errors[:, :1], count=90, effective=70.0).inflation(30)


# --- folds ------------------------------------------------------------------------------------------------------------


def groups(data: TangentData) -> Tensor:
    return torch.arange(len(data.x))


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


def drawn(setting: Setting, seed: int) -> TangentData:
    """Measurements of a robot that the scales describe exactly."""
    data = setting.tangent_data
    factor = torch.linalg.cholesky(covariance(data, setting.scales))
    target = (factor @ normal(data.y.numel(), seed=seed)).view_as(data.y)
    return replace(data, y=data.y + target - data.target)


def test_right_scales_are_hardly_widened(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the uncertainty of the factor, and by what a search changes that sees fewer rows."""
    setting, found = built("sliding"), []
    monkeypatch.setattr(one_out, "ITERATIONS", 1)
    for seed in range(5):
        data = drawn(setting, seed)
        factor = cross_validated_inflation(setting.scales, setting.scales, data, groups(data), seed=seed)
        found.append(factor or 0.0)
    assert min(found) > 0.5
    assert 0.9 < np.median(found) < 1.7, found


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
