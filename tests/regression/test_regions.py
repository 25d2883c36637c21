"""The factor with which 95 % regions hold, from errors whose distribution is known."""

import numpy as np
import pytest
import torch
from scipy.stats import chi2, f

from diffeo_calib.regression.regions import OTHER_DATE, SCALE_EFOLDS, region_scale


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
