"""Radial profiles at zero, and where derivatives end; test_kernels.py has their textbook formulas."""

import pytest
import torch
from math_bank import tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.kernels.profiles import MAX_ORDER, PROFILES, GaussianProfile


@pytest.mark.parametrize("name", PROFILES)
def test_every_derivative_is_the_slope_of_the_one_before(name: str) -> None:
    profile, r2, h = PROFILES[name], tensor([0.03, 0.9, 2.3, 40.0]), 1e-5
    for order in range(MAX_ORDER):
        change = (profile.derivative(r2 + h, order) - profile.derivative(r2 - h, order)) / (2 * h)
        torch.testing.assert_close(profile.derivatives(r2, order + 1)[order + 1], change, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("name", PROFILES)
def test_at_zero_values_are_one_and_all_is_finite(name: str) -> None:
    """And the slope is that of 1 - nu / (2 (nu - 1)) r2 + ..., of a Matern kernel."""
    profile, r2 = PROFILES[name], tensor([0.0, 1e-300, 1e-17, 1e-16]).requires_grad_()
    assert float(profile.derivative(tensor(0.0), 0)) == 1.0
    values = profile.derivatives(r2, MAX_ORDER)
    (first,) = torch.autograd.grad(values[0].sum(), r2)
    for value in (*values, first):
        assert bool(torch.isfinite(value).all())
    if (nu := getattr(profile, "nu", None)) is not None:
        assert float(first[0]) == pytest.approx(-nu / (2 * (nu - 1)), rel=1e-15)


@pytest.mark.parametrize("name", PROFILES)
def test_differentiating_too_often_is_refused(name: str) -> None:
    if isinstance(PROFILES[name], GaussianProfile):
        return  # one exponential, which autograd follows as often as it likes
    r2 = tensor([0.5]).requires_grad_()
    with pytest.raises(InputError, match="too often"):
        PROFILES[name].derivatives(r2, MAX_ORDER)[MAX_ORDER].sum().backward()
