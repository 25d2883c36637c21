"""Radial profiles compared with independent high-precision formulas and with autograd."""

from collections.abc import Callable
from typing import Any

import mpmath
import pytest
import torch
from math_bank import tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.kernels.profiles import (
    MAX_ORDER,
    CauchyProfile,
    ConstantProfile,
    GaussianProfile,
    MaternProfile,
    Profile,
)

RADII = (0.03, 0.2, 0.9, 2.3, 7.0)


def bessel(nu: float) -> Callable[[Any], Any]:
    """The textbook Matern 2^(1 - nu) / Gamma(nu) (sqrt(2 nu) r)^nu K_nu(sqrt(2 nu) r), in r2 = r^2."""

    def kappa(r2: Any) -> Any:
        z = mpmath.sqrt(2 * mpmath.mpf(nu) * r2)
        return 2 ** (1 - mpmath.mpf(nu)) / mpmath.gamma(nu) * z**nu * mpmath.besselk(nu, z)

    return kappa


PROFILES: dict[str, tuple[Profile, Callable[[Any], Any]]] = {
    "gaussian": (GaussianProfile(), lambda r2: mpmath.exp(-r2 / 2)),
    "cauchy": (CauchyProfile(), lambda r2: 1 / (1 + r2)),
    "constant": (ConstantProfile(), lambda r2: mpmath.mpf(1) + 0 * r2),
    "matern-1.5": (MaternProfile(1.5), bessel(1.5)),
    "matern-2.5": (MaternProfile(2.5), bessel(2.5)),
    "matern-3.5": (MaternProfile(3.5), bessel(3.5)),
}
every_profile = pytest.mark.parametrize(("profile", "textbook"), PROFILES.values(), ids=PROFILES.keys())


@every_profile
@pytest.mark.parametrize("order", range(MAX_ORDER + 1))
def test_derivatives_are_those_of_the_textbook(profile: Profile, textbook: Callable[[Any], Any], order: int) -> None:
    with mpmath.workdps(40):
        expected = tensor([float(mpmath.diff(textbook, mpmath.mpf(r2), order)) for r2 in RADII])
    torch.testing.assert_close(profile.derivative(tensor(RADII), order), expected, rtol=2e-12, atol=1e-15)
    torch.testing.assert_close(profile.derivatives(tensor(RADII), order)[order], expected, rtol=2e-12, atol=1e-15)


@every_profile
def test_value_at_zero_is_one(profile: Profile, textbook: Callable[[Any], Any]) -> None:
    assert float(profile.derivative(tensor(0.0), 0)) == 1.0


@every_profile
@pytest.mark.parametrize("order", range(MAX_ORDER))
def test_autograd_gives_the_next_derivative(profile: Profile, textbook: Callable[[Any], Any], order: int) -> None:
    r2 = tensor(RADII).requires_grad_()
    (actual,) = torch.autograd.grad(profile.derivatives(r2, order)[order].sum(), r2)
    torch.testing.assert_close(actual, profile.derivative(tensor(RADII), order + 1), rtol=1e-13, atol=1e-15)


@every_profile
def test_everything_used_is_finite_at_zero(profile: Profile, textbook: Callable[[Any], Any]) -> None:
    r2 = tensor([0.0, 1e-300, 1e-17, 1e-16]).requires_grad_()
    values = profile.derivatives(r2, MAX_ORDER)
    (first,) = torch.autograd.grad(values[0].sum(), r2)
    for value in (*values, first):
        assert bool(torch.isfinite(value).all())


@pytest.mark.parametrize("nu", [1.5, 2.5, 3.5])
def test_slope_of_matern_at_zero(nu: float) -> None:
    """kappa = 1 - nu / (2 (nu - 1)) r2 + ..."""
    slope = float(MaternProfile(nu).derivative(tensor(0.0), 1))
    assert slope == pytest.approx(-nu / (2 * (nu - 1)), rel=1e-15)


@pytest.mark.parametrize("profile", [CauchyProfile(), ConstantProfile(), MaternProfile(3.5)])
def test_differentiating_too_often_is_refused(profile: Profile) -> None:
    r2 = tensor([0.5]).requires_grad_()
    with pytest.raises(InputError, match="too often"):
        profile.derivatives(r2, MAX_ORDER)[MAX_ORDER].sum().backward()


@pytest.mark.parametrize("nu", [0.5, 2.0, -1.5])
def test_unknown_smoothness_is_refused(nu: float) -> None:
    with pytest.raises(InputError, match=r"1\.5, 2\.5 or 3\.5"):
        MaternProfile(nu)
