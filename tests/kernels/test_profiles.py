"""Radial profiles compared with independent high-precision formulas and with autograd."""

from collections.abc import Callable
from typing import Any

import mpmath
import pytest
import torch
from math_bank import tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.kernels.profiles import MAX_ORDER, PROFILES, GaussianProfile

RADII = (0.03, 0.2, 0.9, 2.3, 7.0)


def bessel(nu: float) -> Callable[[Any], Any]:
    """The textbook Matern 2^(1 - nu) / Gamma(nu) (sqrt(2 nu) r)^nu K_nu(sqrt(2 nu) r), in r2 = r^2."""

    def kappa(r2: Any) -> Any:
        z = mpmath.sqrt(2 * mpmath.mpf(nu) * r2)
        return 2 ** (1 - mpmath.mpf(nu)) / mpmath.gamma(nu) * z**nu * mpmath.besselk(nu, z)

    return kappa


TEXTBOOK: dict[str, Callable[[Any], Any]] = {
    "gaussian": lambda r2: mpmath.exp(-r2 / 2),
    "cauchy": lambda r2: 1 / (1 + r2),
    "constant": lambda r2: mpmath.mpf(1) + 0 * r2,
    "matern32": bessel(1.5),
    "matern52": bessel(2.5),
    "matern72": bessel(3.5),
}


@pytest.mark.parametrize("name", PROFILES)
def test_derivatives_are_those_of_the_textbook_and_of_autograd(name: str) -> None:
    profile, r2 = PROFILES[name], tensor(RADII)
    for order in range(MAX_ORDER + 1):
        with mpmath.workdps(40):
            expected = tensor([float(mpmath.diff(TEXTBOOK[name], mpmath.mpf(x), order)) for x in RADII])
        torch.testing.assert_close(profile.derivative(r2, order), expected, rtol=2e-12, atol=1e-15)
        torch.testing.assert_close(profile.derivatives(r2, order)[order], expected, rtol=2e-12, atol=1e-15)
    for order in range(MAX_ORDER):
        live = r2.clone().requires_grad_()
        (actual,) = torch.autograd.grad(profile.derivatives(live, order)[order].sum(), live)
        torch.testing.assert_close(actual, profile.derivative(r2, order + 1), rtol=1e-13, atol=1e-15)


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
