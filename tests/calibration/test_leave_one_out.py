"""Outliers: errors under the posterior, weights of outliers and inliers, and leave-one-out by refitting."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from tangent_bank import Setting, built, covariance
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut, estimate_tails, leave_one_out, random_blocks
from diffeo_calib.calibration.scales.selection import SearchLimits, select
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
    limits = SearchLimits(fewest_first=15, most_first=15)
    return Chosen(setting.tangent_data, select(setting.scales, setting.tangent_data, limits=limits).scales)


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
    tails = estimate_tails(data, clean.scales)
    good = [row for row in range(60) if row not in bad]
    assert tails.gross
    assert float(tails.weights[bad].max()) < 0.1 * (5e-4 / by)
    assert float(tails.weights[good].min()) > 0.2
    errors = leave_one_out(data.with_tails(tails), clean.scales)
    assert sorted(errors.squares[:, 0].topk(4).indices.tolist()) == bad


def test_tails_do_not_depend_on_where_the_search_starts(clean: Chosen) -> None:
    data = clean.moved(3, slice(0, 3), 1e-3)
    first = estimate_tails(data, clean.scales)
    down = data.with_tails(Tails(inf, torch.full((60, 1), 0.5, dtype=torch.float64)))
    again = estimate_tails(down, clean.scales)
    assert again.freedom == pytest.approx(first.freedom, rel=0.1)
    assert_close(again.weights, first.weights, rtol=0, atol=0.05)


@pytest.mark.parametrize("name", ["pair", "framed"])
def test_weights_are_those_of_the_errors_under_the_posterior(name: str, request: pytest.FixtureRequest) -> None:
    """Conditioned on everything: the mean error, and the uncertainty of the signal. One round, from given weights."""
    case: Chosen = request.getfixturevalue(name)
    data = case.conditioned().told
    n, m = data.y.shape
    G, total = data.linearisation(case.scales).gram(), covariance(data, case.scales)
    target = data.target.flatten()
    gain = torch.linalg.solve(total, G).mT
    residual, uncertain = target - gain @ target, G - gain @ G
    moments = torch.outer(residual, residual) + (uncertain + uncertain.mT) / 2
    blocks = torch.stack([moments[m * i : m * (i + 1), m * i : m * (i + 1)] for i in range(n)])
    expected = reweight(data.noise_model.squares(data.noise(case.scales), blocks), data.noise_model.freedom)
    actual = estimate_tails(data, case.scales, rounds=1)
    assert actual.freedom == expected.freedom < inf
    assert_close(actual.weights, expected.weights, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", ["clean", "pair", "framed"])
def test_leave_one_out_is_refitting_without_the_row(name: str, request: pytest.FixtureRequest) -> None:
    case: Chosen = request.getfixturevalue(name)
    whole = case.conditioned()
    data, found = whole.told, leave_one_out(whole, case.scales)
    n, m = data.y.shape
    G, total, noise = data.linearisation(case.scales).gram(), covariance(data, case.scales), data.noise(case.scales)
    assert found.errors.shape == whole.y.shape
    assert found.squares.shape == (n, data.noise_model.bodies)
    assert found.count == data.y.numel()
    scale = float(found.errors.abs().max())
    for row in range(0, n, 5):
        own = slice(m * row, m * (row + 1))
        rest = torch.cat([torch.arange(m * row), torch.arange(m * (row + 1), m * n)])
        gain = torch.linalg.solve(total[rest][:, rest], G[rest][:, own]).mT
        error = data.target[row] - gain @ data.target.flatten()[rest]
        of_row = whole.rows(torch.tensor([row]))
        assert_close(found.errors[row], of_row.in_coordinates(error[None])[0], rtol=0, atol=1e-8 * scale)
        predicted = G[own, own] - gain @ G[rest][:, own] + noise[row]
        sensor = data.noise_model.rows(torch.tensor([row]))
        expected = sensor.squares(predicted[None], torch.outer(error, error)[None])
        assert_close(found.squares[row], expected[0], rtol=1e-7, atol=1e-8)
    trace = float(torch.linalg.solve(total, G).trace())  # of the matrix that makes fitted values from measured ones
    assert found.effective == pytest.approx(trace, rel=1e-6)


@pytest.mark.parametrize(("coordinates", "count"), [(180, 1), (179, 2), (26, 7), (3, 60)])
def test_blocks_cover_every_row_once(coordinates: int, count: int, clean: Chosen) -> None:
    blocks = random_blocks(clean.data, 0, coordinates)
    assert len(blocks) == count
    assert sorted(torch.cat(blocks).tolist()) == list(range(60))
    sizes = [len(rows) for rows in blocks]
    assert max(sizes) - min(sizes) <= 1
    assert not torch.equal(torch.cat(blocks), torch.cat(random_blocks(clean.data, 1, coordinates)))


def test_several_blocks_are_predicted_one_by_one(pair: Chosen) -> None:
    whole, data = leave_one_out(pair.data, pair.scales), weighted(pair.data)
    found = leave_one_out(data, pair.scales, seed=3, block_coordinates=130)
    for rows in random_blocks(data, 3, 130):
        alone = leave_one_out(data.rows(rows), pair.scales)
        assert_close(found.errors[rows], alone.errors, rtol=0, atol=1e-9)
        assert_close(found.squares[rows], alone.squares, rtol=1e-5, atol=1e-7)
    assert bool(torch.isfinite(found.errors).all())
    assert found.effective is None  # that of no single fit
    again, other = (leave_one_out(data, pair.scales, seed=seed, block_coordinates=130) for seed in (3, 4))
    assert torch.equal(again.errors, found.errors)
    assert not torch.allclose(other.errors, found.errors, rtol=1e-3, atol=0)
    assert float(found.errors.square().mean()) > 0.8 * float(whole.errors.square().mean())  # fewer rows predict worse


def doubled(values: Tensor) -> Tensor:
    return torch.cat([values, values])


def test_few_data_inflate_the_regions_as_student_s_t_does() -> None:
    """95 % regions of three normal coordinates whose variance was estimated from nu further coordinates."""
    errors = torch.zeros(30, 3, dtype=torch.float64)
    for freedom in (8, 20):
        left_out = LeaveOneOut(errors, errors[:, :1], effective=90.0 - freedom)
        rng = np.random.default_rng(0)
        estimated = rng.chisquare(freedom, 200_000) / freedom
        squares = (rng.standard_normal((200_000, 3)) ** 2).sum(1) / estimated
        inside = (squares / left_out.inflation(30) < chi2.ppf(0.95, 3)).mean()
        assert abs(inside - 0.95) < 0.003
    assert LeaveOneOut(errors, errors[:, :1], effective=None).inflation(30) == 1.0
    exhausted = LeaveOneOut(errors, errors[:, :1], effective=89.9)
    assert exhausted.inflation(30) == LeaveOneOut(errors, errors[:, :1], effective=82.0).inflation(30)
    twice = LeaveOneOut(doubled(errors), doubled(errors[:, :1]), effective=70.0)
    assert twice.inflation(30) == LeaveOneOut(errors, errors[:, :1], effective=70.0).inflation(30)
