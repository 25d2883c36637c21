"""Heavy tails: weights by the formula, degrees of freedom and scale against scipy, and a likelihood that only rises."""

from math import inf, log
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from diffeo_calib.process.tails import (
    FREEDOM_CENTRE,
    FREEDOM_EFOLDS,
    GAUSSIAN_FREEDOM,
    SMALLEST_FREEDOM,
    gross_weights,
    reweight,
)


def simulated(count: int, dim: int, freedom: float, scale: float = 1.0, seed: int = 0) -> Tensor:
    """Errors (count, dim) with Student's t, Gaussian for infinite freedom."""
    rng = np.random.default_rng(seed)
    mixing = np.ones(count) if freedom == inf else rng.chisquare(freedom, count) / freedom
    return torch.from_numpy(scale * rng.standard_normal((count, dim)) / np.sqrt(mixing)[:, None])


def expectation_maximisation(errors: Tensor, rounds: int = 30) -> tuple[list[float], list[float]]:
    """Freedom and scale, round by round, from a scale that is three times too large."""
    freedoms, scales = [], [3.0 * float(errors.square().median().sqrt())]
    for _ in range(rounds):
        tails = reweight((errors.square().sum(1, keepdim=True)) / scales[-1] ** 2, errors.shape[1])
        freedoms.append(tails.freedom)
        scales.append(float((tails.weights * errors.square()).mean().sqrt()))
    return freedoms, scales


def log_posterior(errors: Tensor, freedom: float, scale: float) -> float:
    """Of Student's t by scipy, and the log-normal prior of its freedom."""
    k = errors.shape[1]
    distribution: Any = stats.multivariate_t  # scipy's stubs want whole degrees of freedom
    each = distribution.logpdf(errors.numpy(), np.zeros(k), scale**2 * np.eye(k), df=freedom)
    return float(np.sum(each)) - 0.5 * (log(freedom / FREEDOM_CENTRE) / FREEDOM_EFOLDS) ** 2


# --- weights ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rows", "markers", "dim"), [(40, 1, 3), (30, 2, 3), (25, 1, 6), (60, 3, 1)])
def test_weights_are_those_of_the_formula(rows: int, markers: int, dim: int) -> None:
    squares = simulated(rows * markers, dim, 3.0).square().sum(1).view(rows, markers)
    tails = reweight(squares, dim)
    assert tails.weights.shape == (rows, markers)
    assert SMALLEST_FREEDOM < tails.freedom < GAUSSIAN_FREEDOM
    for weight, square in zip(tails.weights.flatten().tolist(), squares.flatten().tolist(), strict=True):
        assert weight == pytest.approx((tails.freedom + dim) / (tails.freedom + square), rel=1e-14)


@pytest.mark.parametrize("dim", [1, 3, 6])
def test_no_other_freedom_is_more_likely(dim: int) -> None:
    errors = simulated(80, dim, 4.0, seed=dim)
    found = reweight(errors.square().sum(1, keepdim=True), dim).freedom
    best = log_posterior(errors, found, 1.0)
    for other in np.geomspace(SMALLEST_FREEDOM, GAUSSIAN_FREEDOM, 57):
        assert log_posterior(errors, other, 1.0) <= best + 1e-3  # the grid is one percent wide


# --- degrees of freedom and scale ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("freedom", "scale"), [(2.5, 1.0), (5.0, 3e-5), (12.0, 40.0)])
def test_freedom_and_scale_are_those_that_scipy_finds(freedom: float, scale: float) -> None:
    errors = simulated(3000, 1, freedom, scale, seed=1)
    expected, _, expected_scale = stats.t.fit(errors.numpy().ravel() / scale, floc=0.0)
    freedoms, scales = expectation_maximisation(errors)
    assert freedoms[-1] == pytest.approx(expected, rel=0.03)
    assert scales[-1] / scale == pytest.approx(expected_scale, rel=0.01)


@pytest.mark.parametrize("dim", [3, 6])
def test_many_clean_data_have_no_tails(dim: int) -> None:
    errors = simulated(4000, dim, inf, 0.3, seed=3)
    freedoms, scales = expectation_maximisation(errors, rounds=12)
    assert freedoms[-1] == inf
    assert scales[-1] == pytest.approx(float(errors.square().mean().sqrt()), rel=1e-9)
    assert bool((reweight(errors.square().sum(1, keepdim=True) / scales[-1] ** 2, dim).weights == 1).all())


def test_clean_data_are_known_to_be_so_after_a_few_rounds() -> None:
    freedoms, scales = expectation_maximisation(simulated(150, 3, inf, 5e-5, seed=4), rounds=10)
    assert freedoms[-1] > 20
    assert scales[-1] == pytest.approx(5e-5, rel=0.08)


def test_a_handful_of_errors_leaves_the_prior() -> None:
    """The prior keeps nu near its centre."""
    found = reweight(torch.tensor([[2.9], [3.2]], dtype=torch.float64), 3).freedom
    assert FREEDOM_CENTRE / 1.5 < found < FREEDOM_CENTRE * np.exp(FREEDOM_EFOLDS)


def test_one_gross_outlier_loses_its_influence() -> None:
    errors = simulated(100, 3, inf, 1.0, seed=5)
    clean_scale = float(errors.square().mean().sqrt())
    errors[17] = 1e4
    _, scales = expectation_maximisation(errors)
    tails = reweight(errors.square().sum(1, keepdim=True) / scales[-1] ** 2, 3)
    assert float(tails.weights[17]) < 1e-6
    others = torch.cat([tails.weights[:17], tails.weights[18:]])
    assert 0.3 < float(others.min()) < float(others.max()) < 3.0
    assert float(errors.square().mean().sqrt()) > 900 * clean_scale  # what a Gaussian would say
    assert scales[-1] == pytest.approx(clean_scale, rel=0.25)
    assert tails.freedom < 30


def test_errors_of_no_size_or_of_any_size_do_no_harm() -> None:
    for size in (0.0, 1e-300, 1e300):
        tails = reweight(torch.full((5, 2), size, dtype=torch.float64), 3)
        assert tails.freedom >= SMALLEST_FREEDOM * (1 - 1e-12)
        assert bool(torch.isfinite(tails.weights).all())
        assert bool((tails.weights >= 0).all())


# --- the likelihood rises -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("freedom", [2.0, 3.0, 8.0])
@pytest.mark.parametrize("dim", [1, 3, 6])
def test_likelihood_never_falls(dim: int, freedom: float) -> None:
    errors = simulated(200, dim, freedom, 2.0, seed=10 * dim)
    freedoms, scales = expectation_maximisation(errors, rounds=15)
    assert max(freedoms) < inf
    along = []
    for k, nu in enumerate(freedoms):
        along += [log_posterior(errors, nu, scales[k]), log_posterior(errors, nu, scales[k + 1])]
    assert min(np.diff(along)) > -1e-8 * abs(along[-1])
    assert along[-1] - along[0] > 10.0


# --- good or gross ------------------------------------------------------------------------------------------------


def contaminated(share: float, size: float, dim: int, scale: float = 1.0, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Squares (200, 1) of errors whose good ones have the variance ``scale``, and which of them are gross."""
    errors, gross = simulated(200, dim, inf, scale**0.5, seed), torch.zeros(200, dtype=torch.bool)
    gross[np.random.default_rng(seed).permutation(200)[: round(200 * share)]] = True
    errors[gross] += size * simulated(int(gross.sum()), dim, inf, 1.0, seed + 1)
    return errors.square().sum(1, keepdim=True), gross


@pytest.mark.parametrize("scale", [1.0, 0.1])
@pytest.mark.parametrize("dim", [1, 3, 6])
@pytest.mark.parametrize(("share", "size"), [(0.02, 1e3), (0.05, 40.0), (0.2, 100.0), (0.3, 1e3)])
def test_gross_errors_lose_their_weight_and_good_ones_gain_none(
    share: float, size: float, dim: int, scale: float
) -> None:
    """Also where the noise is said to be ten times too large, as scales are that were chosen with gross errors."""
    squares, gross = contaminated(share, size, dim, scale, seed=dim)
    weights = gross_weights(squares, dim)
    assert weights is not None
    assert float(weights.max()) <= 1.0
    clear = gross[:, None] & (squares > 25 * scale * dim)
    assert float(weights[clear].max()) < 0.05
    assert float(weights[~gross].min()) > 0.5


@pytest.mark.parametrize("dim", [1, 3, 6])
@pytest.mark.parametrize("freedom", [3.0, 8.0, inf])
def test_heavy_tails_and_clean_errors_are_not_gross(freedom: float, dim: int) -> None:
    for seed in range(10):
        squares = simulated(120, dim, freedom, seed=seed).square().sum(1, keepdim=True)
        assert gross_weights(squares, dim) is None
        assert gross_weights(10.0 * squares, dim) is None, "noise that is said to be too small"


def test_hidden_markers_and_bodies_of_several_dimensions() -> None:
    squares, gross = contaminated(0.05, 100.0, 3)
    squares, dim = torch.cat([squares, torch.full_like(squares, torch.nan)], 1), torch.tensor([[3, 6]]).expand(200, 2)
    weights = gross_weights(squares, dim)
    assert weights is not None
    assert bool((weights[:, 1] == 1.0).all())
    assert torch.equal(weights[:, 0] < 0.5, gross)
