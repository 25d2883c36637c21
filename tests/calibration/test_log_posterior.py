"""Log posterior of the scales: likelihood and prior against scipy and formulas, gradients against differences."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tangent_bank import Setting, built, noise_covariance, normal, shaken, tangent_covariance, weighted
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.scales.selection import ScalePrior, log_posterior
from diffeo_calib.process.scales import AMPLITUDES, SCALES


def log_prior(scales: dc.Hyperparameters, centre: dc.Hyperparameters) -> float:
    """Log-normal, entry by entry: amplitudes may grow a little and shrink a lot."""
    total = 0.0
    for name in SCALES:
        away = (getattr(scales, name) / getattr(centre, name)).log().flatten().tolist()
        for a in away:
            width = 1.0
            if name in AMPLITUDES:
                width = 1.0 if a > 0 else 2.0
            total -= 0.5 * (a / width) ** 2
    return total


def log_density(matrix: Tensor, target: Tensor) -> float:
    """Of a Gaussian with mean 0, by numpy."""
    (_, size), square = (
        np.linalg.slogdet(matrix.numpy()),
        target.numpy() @ np.linalg.solve(matrix.numpy(), target.numpy()),
    )
    return float(-0.5 * (square + size + len(target) * np.log(2 * np.pi)))


# --- the posterior ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [2])
def test_posterior_is_likelihood_times_prior(setting: Setting, seed: int) -> None:
    scales, data = shaken(setting.scales, seed), weighted(setting, seed)
    nominal, theta, x = data.told.nominal, data.theta, data.x
    total = tangent_covariance(scales, nominal, theta, x)
    total += torch.block_diag(*noise_covariance(scales, setting, theta, data.tails.weights))
    target = (data.y - nominal(x, theta) + nominal.sensitivities(x, theta) @ theta).flatten()
    if data.basis is not None:  # six numbers of every pose
        basis = torch.block_diag(*data.basis)
        total, target = basis.T @ total @ basis, basis.T @ target
    found = log_posterior(scales.logarithms(), setting.scales, data)
    assert found is not None
    assert found.likelihood == pytest.approx(log_density(total, target), rel=1e-6)
    assert found.prior == pytest.approx(log_prior(scales, setting.scales), rel=1e-9)


@pytest.mark.slow
def test_gradient_against_central_differences(setting: Setting) -> None:
    data = weighted(setting).rows(torch.arange(0, len(setting.data), 2))
    point, h = shaken(setting.scales, 2).logarithms(), 0.02  # long steps: the prior of the base is wide

    def value(at: Tensor) -> float:
        found = log_posterior(at, setting.scales, data)
        assert found is not None
        return found.likelihood + found.prior

    def change(step: Tensor) -> float:
        return value(point + step) - value(point - step)

    found = log_posterior(point, setting.scales, data)
    assert found is not None
    start = 0
    for name in SCALES:  # along one direction for every kind of scale
        size = getattr(setting.scales, name).numel()
        step = torch.zeros_like(point)
        step[start : start + size] = h * normal(size, seed=start)
        start += size
        expected, scale = (8 * change(step) - change(2 * step)) / 12, float(found.gradient.abs().max())
        assert float(found.gradient @ step) == pytest.approx(expected, rel=1e-4, abs=1e-6 * scale)


@pytest.mark.parametrize("prior", [ScalePrior(), ScalePrior(length=0.7, growth=0.3, shrinkage=1.5)])
def test_prior_of_amplitudes_lets_them_shrink(prior: ScalePrior) -> None:
    setting = built("sliding")
    data, centre, shrinks = setting.tangent_data, setting.scales.logarithms(), setting.scales.amplitudes()
    assert prior.growth < prior.shrinkage
    for entry in (0, int(shrinks.nonzero()[0]), int(shrinks.nonzero()[-1]), len(centre) - 5):
        for step in (-1.5, 0.7):
            point = centre.clone()
            point[entry] += step
            found = log_posterior(point, setting.scales, data, prior)
            assert found is not None
            width = prior.length
            if bool(shrinks[entry]):
                width = prior.growth if step > 0 else prior.shrinkage
            assert found.prior == pytest.approx(-0.5 * (step / width) ** 2, rel=1e-9)


# --- singular covariances -----------------------------------------------------------------------------------------


def test_a_singular_covariance_has_no_posterior() -> None:
    setting = built("two markers")
    scales = setting.scales
    # next to no noise and an amplitude of e^25 defaults: G + R is singular in float64
    mute = replace(
        scales,
        sensor_noise=scales.sensor_noise * 1e-9,
        joint_noise=scales.joint_noise * 1e-9,
        task_amplitude=scales.task_amplitude * math.exp(25),
        task_lengthscale=scales.task_lengthscale * 1e4,
    )
    assert log_posterior(mute.logarithms(), scales, setting.tangent_data) is None


def test_a_wide_prior_costs_no_digits(setting: Setting) -> None:
    """Of metres or of kilometres: the likelihood then falls by the logarithm of the prior alone, the gradient stays."""
    scales = setting.scales
    wide = [
        log_posterior(scales.logarithms(), scales, replace(weighted(setting), place_deviation=d)) for d in (1e1, 1e3)
    ]
    assert wide[0] is not None
    assert wide[1] is not None
    free = (wide[0].likelihood - wide[1].likelihood) / math.log(1e2)
    assert free == pytest.approx(round(free), abs=1e-2)
    torch.testing.assert_close(wide[0].gradient, wide[1].gradient, rtol=1e-4, atol=1e-4)
