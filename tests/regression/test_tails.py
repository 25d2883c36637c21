"""Heavy tails against scipy, good and gross errors, and the factor with which 95 % regions hold."""

from math import inf, log
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.stats import chi2, f
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.regression.regions import OTHER_DATE, SCALE_EFOLDS, region_scale
from diffeo_calib.regression.tails import (
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


def expectation_maximisation(errors: Tensor) -> tuple[float, float]:
    """Freedom and scale, from a scale that is three times too large."""
    freedom, scale = inf, 3.0 * float(errors.square().median().sqrt())
    for _ in range(30):
        tails = reweight((errors.square().sum(1, keepdim=True)) / scale**2, errors.shape[1])
        freedom, scale = tails.freedom, float((tails.weights * errors.square()).mean().sqrt())
    return freedom, scale


def log_posterior(errors: Tensor, freedom: float, scale: float) -> float:
    """Of Student's t by scipy, and the log-normal prior of its freedom."""
    k = errors.shape[1]
    distribution: Any = stats.multivariate_t  # scipy's stubs want whole degrees of freedom
    each = distribution.logpdf(errors.numpy(), np.zeros(k), scale**2 * np.eye(k), df=freedom)
    return float(np.sum(each)) - 0.5 * (log(freedom / FREEDOM_CENTRE) / FREEDOM_EFOLDS) ** 2


@pytest.mark.parametrize("dim", [1, 3, 6])
@pytest.mark.parametrize("count", [6, 80])
def test_no_other_freedom_is_more_likely(dim: int, count: int) -> None:
    """And the weights are those of the formula."""
    errors = simulated(count, dim, 4.0, seed=dim)
    squares = errors.square().sum(1, keepdim=True)
    found = reweight(squares, dim)
    best = log_posterior(errors, found.freedom, 1.0)
    for other in np.geomspace(SMALLEST_FREEDOM, GAUSSIAN_FREEDOM, 57):
        assert log_posterior(errors, other, 1.0) <= best + 1e-3  # the grid is one percent wide
    assert_close(found.weights, (found.freedom + dim) / (found.freedom + squares), rtol=1e-14, atol=0)


@pytest.mark.parametrize(("freedom", "scale"), [(2.5, 1.0), (5.0, 3e-5), (12.0, 40.0)])
def test_freedom_and_scale_are_those_that_scipy_finds(freedom: float, scale: float) -> None:
    errors = simulated(3000, 1, freedom, scale, seed=1)
    expected, _, expected_scale = stats.t.fit(errors.numpy().ravel() / scale, floc=0.0)
    found, own = expectation_maximisation(errors)
    assert found == pytest.approx(expected, rel=0.03)
    assert own / scale == pytest.approx(expected_scale, rel=0.01)
    assert expectation_maximisation(simulated(4000, 3, inf, scale, seed=3))[0] == inf, "clean data have no tails"


def test_errors_of_no_size_or_of_any_size_do_no_harm() -> None:
    for size in (0.0, 1e-300, 1e300):
        tails = reweight(torch.full((5, 2), size, dtype=torch.float64), 3)
        assert tails.freedom >= SMALLEST_FREEDOM * (1 - 1e-12)
        assert bool(torch.isfinite(tails.weights).all())
        assert bool((tails.weights >= 0).all())


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


def share(factor: float, squares: np.ndarray, k: int) -> float:
    return float((squares < factor * chi2.ppf(0.95, k)).mean())


@pytest.mark.parametrize("k", [1, 3, 6])
@pytest.mark.parametrize("size", [0.3, 1.0, 4.0])
def test_gaussian_errors_of_any_size(k: int, size: float) -> None:
    rng = np.random.default_rng(k)
    held = [
        share(region_scale(torch.from_numpy(size * rng.chisquare(k, 200)), k), size * rng.chisquare(k, 20_000), k)
        for _ in range(5)
    ]
    assert np.mean(held) == pytest.approx(0.955, abs=0.015)


def test_tails_and_outliers_are_held() -> None:
    rng, new = np.random.default_rng(0), 3 * f.rvs(3, 3.0, size=20_000, random_state=1)
    heavy = [
        share(region_scale(torch.from_numpy(3 * rng.f(3, 3.0, size=400)), 3), np.asarray(new), 3) for _ in range(10)
    ]
    assert np.mean(heavy) == pytest.approx(0.95, abs=0.015)
    clean, held = np.asarray(rng.chisquare(3, 20_000)), list[float]()
    for _ in range(5):
        mixed = rng.chisquare(3, 400) * np.where(rng.random(400) < 0.02, 1e4, 1.0)
        held.append(share(region_scale(torch.from_numpy(mixed), 3), clean, 3))
    assert np.mean(held) == pytest.approx(0.975, abs=0.02)


def test_few_errors_widen_regions_and_none_leave_them() -> None:
    rng = np.random.default_rng(0)
    few, many = (np.mean([region_scale(torch.from_numpy(rng.chisquare(3, n)), 3) for _ in range(6)]) for n in (8, 800))
    assert 1.05 * many < few < 1.6
    assert region_scale(torch.full((3, 1), torch.nan), 3) == 1.0


def test_few_errors_of_another_date_may_have_any_size() -> None:
    """Ten errors of 50 times the variance: the prior of a calibration's own scales leaves new ones outside."""
    rng, new = np.random.default_rng(4), 50 * np.random.default_rng(5).chisquare(3, 20_000)
    few = [torch.from_numpy(50 * rng.chisquare(3, 10)) for _ in range(12)]
    own, other = (
        np.mean([share(region_scale(each, 3, efolds=p), new, 3) for each in few]) for p in (SCALE_EFOLDS, OTHER_DATE)
    )
    assert own < 0.93
    assert 0.94 < other < 0.985


def test_repeats_with_shares_count_as_one() -> None:
    once = torch.from_numpy(np.random.default_rng(0).chisquare(3, 30))
    often, dims = once.repeat_interleave(4), torch.full((120,), 3)
    assert region_scale(often, dims, torch.full((120,), 0.25)) == pytest.approx(region_scale(once, 3), rel=0.05)
    hidden = torch.cat([once, torch.full((5,), torch.nan)])
    assert region_scale(hidden, 3) == region_scale(once, 3)
