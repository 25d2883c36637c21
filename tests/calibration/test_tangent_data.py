"""Tangent data and their noise, against formulas written a second time; new rows whose noise differs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from kind_bank import kind_named
from scipy.stats import chi2
from tangent_bank import Setting, built, noise_covariance, normal, shaken, tangent_covariance, weighted
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.calibration.choose_scales import robot_problem
from diffeo_calib.calibration.scales.noise_model import differing_factor
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.fitting.fit import fit
from diffeo_calib.fitting.gauss_newton import GaussNewton
from diffeo_calib.maps.noise import HIDDEN_VARIANCE
from diffeo_calib.measurements.poses import mark_jacobian
from diffeo_calib.regression.regions import region_factor


def test_covariance_and_target_are_those_written_out(setting: Setting) -> None:
    scales = shaken(setting.scales, 1)
    for data in (setting.tangent_data, weighted(setting, 1)):
        nominal, theta, x = data.nominal, data.theta, data.x
        expected = tangent_covariance(scales, nominal, theta, x)
        scale = float(expected.abs().max())
        assert_close(data.linearisation(scales).gram(), expected, rtol=0, atol=1e-12 * scale)
        rigid = nominal if data.basis is None else nominal.changed(rigid=True)
        target = data.y - nominal(x, theta) + rigid.sensitivities(x, theta) @ theta
        close = 1e-14 if data.basis is None else 1e-8  # m, of frames whose points are those of k0
        assert_close(data.target, data.in_numbers(target[:, :, None])[:, :, 0], rtol=0, atol=close)


def test_noise_is_that_written_out(setting: Setting) -> None:
    """By itself: next to the prior of the base it would be invisible."""
    scales, data = shaken(setting.scales, 5), weighted(setting, 5)
    ones = torch.ones_like(data.tails.weights)
    for weights, actual in ((ones, data.noise(scales)), (data.tails.weights, data.weighted_noise(scales))):
        expected = noise_covariance(scales, setting, data.theta, weights)
        assert_close(actual, expected, rtol=1e-6, atol=1e-7 * float(expected.abs().max()))


def test_what_is_kept_is_that_of_its_scales_and_weights(setting: Setting) -> None:
    """Whatever was asked for before: other scales, other weights, other measurements, fewer rows."""
    first, second = shaken(setting.scales, 1), shaken(setting.scales, 2)
    kept, other = setting.tangent_data.with_tails(setting.tangent_data.tails), weighted(setting, 3)
    kept.process(first)
    some = kept.rows(torch.arange(3))
    orders = [(kept.with_tails(other.tails), first), (kept, second), (kept, first), (some, first)]
    for data, scales in [*orders, (replace(kept, y=kept.y + 1e-3), first)]:
        assert_close(data.process(scales).mu, replace(data).process(scales).mu, rtol=1e-9, atol=0)


# --- six numbers of a pose in place of nine coordinates ---------------------------------------------------------------

OPEN_M = 1e-3
"""Noise of what bends the points of a pose, that tells nothing: a thousand times what the fields bend."""


def naive(setting: Setting, data: TangentData) -> tuple[Tensor, Tensor]:
    """G and R of nine coordinates a pose, of which motions that bend its points are hardly known: (9 N, 9 N) each."""
    frames = setting.data.frames
    moves = mark_jacobian(frames[:, 0], setting.data.bodies.pose_lever())  # (N, 9, 6)
    bent = torch.eye(9, dtype=torch.float64) - moves @ torch.linalg.pinv(moves)
    R = noise_covariance(setting.scales, setting, data.theta, data.tails.weights) + OPEN_M**2 * bent
    G = tangent_covariance(setting.scales, data.nominal.changed(rigid=True), data.theta, data.x)
    return G, torch.block_diag(*R)


def test_six_numbers_say_what_nine_coordinates_do() -> None:
    """Mean and covariance of k1 at the rows, by numpy with nine coordinates a pose."""
    posed = built("posed")
    data = replace(posed.tangent_data, y=posed.tangent_data.y + 1e-5 * normal(12, 9, seed=3))
    G, R = naive(posed, data)
    nominal = data.nominal.changed(rigid=True)
    S = nominal.sensitivities(data.x, data.theta)
    target = (data.y - nominal(data.x, data.theta) + S @ data.theta).flatten()
    solved = np.linalg.solve((G + R).numpy(), np.column_stack([target.numpy(), G.numpy()]))
    mean, covariance = (torch.from_numpy(G.numpy() @ part) for part in (solved[:, 0], solved[:, 1:]))

    basis = torch.block_diag(*data.basis) if data.basis is not None else torch.eye(len(target), dtype=torch.float64)
    process = data.process(posed.scales)
    found = process.mean(process.features(process.numbers.at))
    assert_close(found, basis.T @ mean, rtol=0, atol=1e-4 * float(mean.abs().max()))
    left = process.covariance_between(process.numbers.at)
    assert_close(left, basis.T @ (G - covariance) @ basis, rtol=0, atol=1e-3 * float(left.abs().max()))


def test_the_fit_of_six_numbers_is_that_of_nine() -> None:
    """Nine coordinates keep the points rigid by the slack, which is worth a small part of the noise of a pose."""
    posed = built("posed")
    data, scales = posed.tangent_data, posed.scales
    problem = robot_problem(data, scales)
    maps = [fit(each, GaussNewton(tolerance=1e-6)).model for each in (problem, problem.whole)]
    geometry = posed.nominal.geometry  # whose points nothing bends
    tool = geometry.tool + maps[0].deformation.momenta.theta[geometry.slices["tool"]].view(-1, 3)
    assert_close(torch.pdist(tool), torch.pdist(geometry.tool), rtol=1e-6, atol=0)
    x = data.x + 0.3
    (six, covariance), (nine, _) = (each.predict(x, noise=False) for each in maps)
    deviation = covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert float((six - nine).abs().max() / deviation.mean()) < 0.05
    assert maps[0].slopes is None
    assert maps[0].noise.covariance.shape == (12, 9, 9)


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
    each = torch.eye(3, dtype=torch.float64).repeat(100, 1, 1)
    each[0] *= 1e6
    assert differing_factor(each, each.mean(0), everywhere(each)) == pytest.approx(1.0, abs=1e-12), "never narrower"


def test_hidden_markers_do_not_count() -> None:
    each = blocks(30, 6, 3)
    seen = everywhere(each)
    seen[20:, :3] = seen[:10, 3:] = False
    hidden = torch.where(seen[:, :, None] & seen[:, None], each, HIDDEN_VARIANCE * torch.eye(6, dtype=torch.float64))
    other = torch.where(seen[:, :, None] & seen[:, None], each, torch.eye(6, dtype=torch.float64))
    mean = each.mean(0)
    assert differing_factor(hidden, mean, seen) == pytest.approx(differing_factor(other, mean, seen), rel=1e-12)


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
    assert_close(found, found[:1].expand_as(found), rtol=1e-12, atol=0)
