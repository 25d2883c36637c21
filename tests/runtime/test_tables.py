"""Tables of periodic functions against the sums that they replace."""

from __future__ import annotations

import numpy as np
import pytest

from diffeo_calib.runtime.profiles import FORMULAS
from diffeo_calib.runtime.tables import JointTables, PeriodicSum, tabulate

SMOOTH = [name for name in FORMULAS if name != "matern32"]


def periodic_sum(profile: str, lengthscale: float = 0.3, count: int = 40) -> PeriodicSum:
    """A sum with angles over several turns, some of them equal."""
    rng = np.random.default_rng(0)
    angles = np.concatenate([rng.uniform(-7, 7, count - 2), [1.0, 1.0]])
    return PeriodicSum(profile, lengthscale, angles, 1e-3 * rng.normal(size=count))


@pytest.mark.parametrize("profile", SMOOTH)
def test_interpolation_error(profile: str) -> None:
    """Everywhere, also across 0 and at the controls, not only midway between the knots."""
    exact = periodic_sum(profile)
    table = tabulate([exact])
    assert table is not None
    tables, x = JointTables.of((1,), ((table,),), 2), np.concatenate([np.linspace(-9.0, 9.0, 5001), exact.angles])
    values, slopes = tables.velocity_and_jacobian(0, np.stack([np.zeros_like(x), x], axis=1))
    wanted = exact.derivatives(x)
    np.testing.assert_allclose(values[:, 1], wanted[:, 0], rtol=0, atol=3e-13)
    np.testing.assert_allclose(slopes[:, 1, 1], wanted[:, 1], rtol=0, atol=1e-9)
    assert not values[:, 0].any()


@pytest.mark.parametrize("profile", FORMULAS)
def test_derivatives_against_differences(profile: str) -> None:
    exact, x, h = periodic_sum(profile), np.linspace(0.013, 6.0, 50), 1e-5
    _, slope, curvature = exact.derivatives(x).T
    by_values, by_slopes, _ = ((exact.derivatives(x + h) - exact.derivatives(x - h)) / (2 * h)).T
    np.testing.assert_allclose(slope, by_values, rtol=0, atol=1e-8)
    np.testing.assert_allclose(curvature, by_slopes, rtol=1e-4, atol=1e-6)


def test_sums_of_several_kernels() -> None:
    sums = [periodic_sum("matern52"), periodic_sum("gaussian", 0.5)]
    table = tabulate(sums)
    assert table is not None
    x = np.linspace(0, 2 * np.pi, 777)
    found = JointTables.of((0,), ((table,),), 1).velocity_and_jacobian(0, x[:, None])[0][:, 0]
    np.testing.assert_allclose(found, sum(s.derivatives(x)[:, 0] for s in sums), rtol=0, atol=3e-13)


def test_functions_that_are_too_rough() -> None:
    assert tabulate([periodic_sum("gaussian", lengthscale=1e-4, count=400)]) is None
