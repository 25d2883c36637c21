"""Noise of markers and of poses, and of new rows whose noise differs: by simulation, in units of the noise."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from kind_bank import kind_named
from scipy.stats import chi2
from tangent_bank import built, normal
from torch import Tensor

from diffeo_calib.calibration.choose_scales import robot_problem
from diffeo_calib.calibration.scales.noise_model import differing_factor
from diffeo_calib.maps.noise import HIDDEN_VARIANCE
from diffeo_calib.regression.regions import region_factor

# --- new measurements where the noise differs from row to row ---------------------------------------------------------

INSIDE_95 = float(chi2.ppf(0.95, 3))


def blocks(rows: int, coordinates: int, seed: int) -> Tensor:
    """Covariances of different sizes and directions."""
    root = normal(rows, coordinates, coordinates, seed=seed) * normal(rows, 1, coordinates, seed=seed + 1).square()
    return root @ root.mT + 1e-3 * torch.eye(coordinates, dtype=torch.float64)


def everywhere(covariance: Tensor) -> Tensor:
    return torch.ones(covariance.shape[:2], dtype=torch.bool)


def share(errors: Tensor, covariance: Tensor) -> float:
    """Share of errors (..., 3 P) whose markers lie in their 95 % regions."""
    inside = []
    for marker in range(len(covariance) // 3):
        own = slice(3 * marker, 3 * marker + 3)
        found = errors[..., own].reshape(-1, 3)
        squares = (found * torch.linalg.solve(covariance[own, own], found.mT).mT).sum(1)
        inside.append(float((squares < INSIDE_95).double().mean()))
    return sum(inside) / len(inside)


def test_regions_hold_95_percent_of_a_mixture() -> None:
    for seed in range(3):
        each = blocks(60, 6, 10 * seed)
        mean = each.mean(0)
        errors = (torch.linalg.cholesky(each)[:, None] @ normal(60, 2000, 6, seed=seed)[..., None])[..., 0]
        factor = differing_factor(each, mean, everywhere(each))
        assert share(errors, mean) < 0.93
        assert share(errors, factor * mean) == pytest.approx(0.95, abs=0.01)


def test_hidden_markers_do_not_count() -> None:
    each = blocks(30, 6, 3)
    seen = everywhere(each)
    seen[20:, :3] = seen[:10, 3:] = False
    hidden = torch.where(seen[:, :, None] & seen[:, None], each, HIDDEN_VARIANCE * torch.eye(6, dtype=torch.float64))
    other = torch.where(seen[:, :, None] & seen[:, None], each, torch.eye(6, dtype=torch.float64))
    mean = each.mean(0)
    assert differing_factor(hidden, mean, seen) == pytest.approx(differing_factor(other, mean, seen), rel=1e-12)


def test_new_noise_is_the_mean_and_what_differs() -> None:
    """Joint noise moves a marker by its lever arms; without it all rows err alike."""
    data, scales = built("two markers").tangent_data, built("two markers").scales
    each, mean = data.noise(scales), data.noise_model.mean_covariance(scales, data.jacobian)
    factor = differing_factor(each, mean, data.visible)
    assert factor > 1.001
    torch.testing.assert_close(robot_problem(data, scales).new_noise, factor * mean, rtol=1e-12, atol=0.0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows
@pytest.mark.parametrize("name", ["several kinds", "laser beams", "inclinations"])
def test_coordinates_beside_readings_have_the_tails_of_all_rows(name: str) -> None:
    """Those of the geometric calibration, which it leaves large, would widen the noise of a position by a half."""
    noise, new = kind_named(name).model.map.noise, kind_named(name).model.map.new_noise
    whole = noise.visible.sum(1) == noise.visible.sum(1).max()
    size = int(noise.visible[whole][0].sum())
    measured = noise.covariance[whole][:, :size, :size].diagonal(dim1=1, dim2=2).mean()
    assert 0.9 < float(new[:size, :size].diagonal().mean() / measured) < 1.15


def test_rows_with_known_deviations_keep_their_own() -> None:
    """They are judged by these: the mean is too large for most, and too small for the rest."""
    plain, scales = built("two markers").tangent_data, built("two markers").scales
    each = blocks(*plain.y.shape, seed=8) * 1e-8
    data = replace(plain, noise_model=replace(plain.noise_model, known=each))
    wanted = data.noise(scales) * region_factor(data.tails.freedom, 3)
    torch.testing.assert_close(data.noise_of_new_rows(scales), wanted, rtol=1e-12, atol=0.0)
    found = plain.noise_of_new_rows(scales)
    torch.testing.assert_close(found, found[:1].expand_as(found))
