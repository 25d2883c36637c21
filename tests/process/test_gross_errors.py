"""Good or gross: weights by the formula, never above one; shares and sizes that are found; regions of good errors."""

from __future__ import annotations

from math import log

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from diffeo_calib.process.tails import FACTORS, SHARES, SMALLER, Tails, reweight


def squares(
    count: int, dim: int, share: float = 0.0, size: float = 1.0, *, seed: int = 0, noise: float = 1.0
) -> Tensor:
    """Squared distances (count, 1) in units of the noise; the first are gross, their deviations times ``size``."""
    errors = np.random.default_rng(seed).standard_normal((count, dim))
    errors[: round(share * count)] *= size
    return torch.from_numpy(noise**2 * (errors**2).sum(1))[:, None]


def likelihood(found: Tensor, dim: int, share: float, factor: float, scale: float = 1.0) -> float:
    """Of squared distances, by scipy; without what no candidate changes."""
    good, gross = (stats.chi2.logpdf(found.numpy(), dim, scale=scale * c) for c in (1.0, factor))
    return float(np.logaddexp(np.log1p(-share) + good, np.log(share) + gross).sum())


@pytest.mark.parametrize("dim", [1, 2, 3, 6])
def test_weights_are_expected_precisions(dim: int) -> None:
    found = squares(200, dim, 0.1, 8.0)
    tails = reweight(found, dim)
    assert tails.share > 0.0
    good, gross = (stats.chi2.pdf(found.numpy(), dim, scale=c) for c in (1.0, tails.factor))
    p = (1.0 - tails.share) * good / ((1.0 - tails.share) * good + tails.share * gross)
    np.testing.assert_allclose(tails.weights.numpy(), p + (1.0 - p) / tails.factor, rtol=1e-9)


@pytest.mark.parametrize("dim", [1, 3, 6])
def test_no_other_share_and_size_is_likelier(dim: int) -> None:
    found = squares(150, dim, 0.08, 6.0, seed=dim)
    tails = reweight(found, dim)
    best = likelihood(found, dim, tails.share, tails.factor)
    for share in SHARES:
        for factor in FACTORS:
            assert likelihood(found, dim, share, factor) <= best + 1e-9 * abs(best)


def test_no_weight_is_above_one_or_below_that_of_a_gross_one() -> None:
    for seed in range(10):
        for share, size in ((0.0, 1.0), (0.02, 4.0), (0.3, 30.0)):
            tails = reweight(squares(60, 3, share, size, seed=seed), 3)
            assert float(tails.weights.max()) <= 1.0
            assert float(tails.weights.min()) >= (1.0 - 1e-12) / tails.factor


@pytest.mark.parametrize("dim", [1, 3, 6])
def test_clean_errors_have_none(dim: int) -> None:
    found = [reweight(squares(count, dim, seed=seed), dim) for seed in range(20) for count in (20, 150, 1000)]
    clean = [tails.share == 0.0 and tails.factor == 1.0 and bool((tails.weights == 1.0).all()) for tails in found]
    assert np.mean(clean) > 0.9


@pytest.mark.parametrize("size", [5.0, 20.0, 300.0])
@pytest.mark.parametrize("dim", [3, 6])
def test_five_percent_are_found_whatever_their_size(dim: int, size: float) -> None:
    tails = reweight(squares(400, dim, 0.05, size), dim)
    assert tails.share in {0.03, 0.05, 0.08}
    assert tails.factor == pytest.approx(size**2, rel=0.7)
    assert float(tails.weights[20:].mean()) > 0.97
    assert float(tails.weights[:20].median()) < 2.0 / size**2 + 0.1


def test_errors_of_many_sizes() -> None:
    found = squares(300, 3, seed=3)
    found[:15, 0] *= torch.logspace(1.5, 8, 15, dtype=torch.float64)
    tails = reweight(found, 3)
    assert float(tails.weights[5:15].max()) < 0.05
    assert float(tails.weights[15:].median()) > 0.95


def test_noise_that_gross_errors_made_too_large_may_be_smaller() -> None:
    """Good errors are a quarter of what the noise says: with it alone, the smaller gross ones would look usual."""
    found = squares(300, 3, 0.1, 6.0, noise=0.25, seed=4)
    plain, smaller = reweight(found, 3), reweight(found, 3, SMALLER)
    assert float(plain.weights[:30].median()) > 0.5
    assert smaller.share == pytest.approx(0.1, rel=0.5)
    assert float(smaller.weights[:30].median()) < 0.2
    assert float(smaller.weights[30:].mean()) > 0.9
    clean = reweight(squares(300, 3, seed=5), 3, SMALLER)
    assert clean.share == 0.0


def test_smaller_noise_counts_with_its_likelihood() -> None:
    """The choice among candidates is that of the density of the errors, with its own scale."""
    found = squares(200, 3, 0.1, 10.0, noise=0.5, seed=6)
    none = float(stats.chi2.logpdf(found.numpy(), 3).sum())
    candidates = [
        (likelihood(found, 3, share, factor, scale) - none, scale, share, factor)
        for scale in SMALLER
        for share in SHARES
        for factor in FACTORS
    ]
    gain, scale, share, factor = max(candidates)
    assert gain > 2.0
    assert scale < 1.0
    tails = reweight(found, 3, SMALLER)
    assert (tails.share, tails.factor) == (share, factor)
    torch.testing.assert_close(tails.weights, tails.weighed(found / scale, 3).weights)


def test_hidden_ones_count_nothing_and_weigh_one() -> None:
    found = squares(100, 3, 0.05, 20.0).repeat(1, 2)
    found[:, 1] = torch.nan
    alone, both = reweight(found[:, :1], 3), reweight(found, 3)
    assert (both.share, both.factor) == (alone.share, alone.factor)
    assert torch.equal(both.weights[:, :1], alone.weights)
    assert bool((both.weights[:, 1] == 1.0).all())


def test_each_with_its_own_number_of_coordinates() -> None:
    first, second = squares(150, 2, 0.1, 9.0, seed=1), squares(150, 6, 0.1, 9.0, seed=2)
    dim = torch.tensor([2, 6]).expand(150, 2)
    found = reweight(torch.cat([first, second], 1), dim)
    for column, (own, k) in enumerate(((first, 2), (second, 6))):
        torch.testing.assert_close(found.weights[:, column : column + 1], found.weighed(own, k).weights)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e6, 1e300])
def test_errors_of_no_size_or_of_any_size_do_no_harm(size: float) -> None:
    found = torch.cat([squares(20, 3), torch.full((3, 1), size, dtype=torch.float64)])
    for tails in (reweight(found, 3), reweight(found, 3, SMALLER), reweight(found[20:], 3)):
        assert bool(tails.weights.isfinite().all())
        assert 0.0 < float(tails.weights.min()) <= float(tails.weights.max()) <= 1.0


def test_other_errors_are_weighed_alike() -> None:
    known = reweight(squares(300, 3, 0.05, 20.0), 3)
    other = torch.tensor([[0.0], [3.0], [1e5], [torch.nan]], dtype=torch.float64)
    found = known.weighed(other, 3)
    assert (found.share, found.factor) == (known.share, known.factor)
    assert found.weights.flatten().tolist() == pytest.approx([1.0, 1.0, 1.0 / known.factor, 1.0], abs=0.02)
    assert bool((Tails.none(1, 1).weighed(other, 3).weights == 1.0).all())


@pytest.mark.parametrize("dim", [1, 3, 6])
@pytest.mark.parametrize(("share", "factor"), [(0.05, 16.0), (0.05, 400.0), (0.2, 100.0), (0.4, 9.0), (0.01, 1e6)])
def test_regions_hold_what_is_not_gross(dim: int, share: float, factor: float) -> None:
    """95 % of new errors that do not count as gross, which have a weight of 0.05 or less."""
    rng = np.random.default_rng(0)
    gross = rng.random(400_000) < share
    found = rng.chisquare(dim, 400_000) * np.where(gross, factor, 1.0)
    tails = Tails(share, factor, torch.ones(1, 1))
    kept = found[tails.weighed(torch.from_numpy(found)[:, None], dim).weights.flatten().numpy() > 0.05]
    inside = (kept / tails.region_factor(dim) < stats.chi2.ppf(0.95, dim)).mean()
    assert inside == pytest.approx(0.95, abs=0.002)


def test_regions_without_gross_errors_are_those_of_the_noise() -> None:
    for dim in (1, 2, 3, 6):
        assert Tails.none(3, 1).region_factor(dim) == 1.0


def test_rows() -> None:
    some = Tails(0.05, log(30.0), torch.arange(8.0, dtype=torch.float64).view(4, 2))
    for index, expected in ((torch.tensor([2, 0]), [[4.0, 5.0], [0.0, 1.0]]), (slice(1, 2), [[2.0, 3.0]])):
        found = some.rows(index)
        assert found.weights.tolist() == expected
        assert (found.share, found.factor) == (some.share, some.factor)
