"""Sums by plane waves: within the accuracy asked for, or over all pairs."""

from typing import Any

import pytest
import torch
from math_bank import normal
from sum_bank import assert_same, every_formula
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.kernels.profiles import CauchyProfile, GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.reductions import backends, fourier
from diffeo_calib.kernels.reductions.formulas import FIELD, Formula, Points

COUNT = 4000
TORUS = dc.PerJoint([0.8, 1.5], [1.0, 1.0], dc.Space((True, True)))
smooth = pytest.mark.parametrize("profile", [GaussianProfile(), MaternProfile(3.5)], ids=lambda p: p.name)


def cloud(count: int, dim: int, side: float, seed: int, outputs: int = 2) -> Points:
    """Points in a box, with momenta of one sign: errors of single pairs add up as far as they can."""
    generator = torch.Generator().manual_seed(seed)
    at = side * torch.rand(count, dim, dtype=torch.float64, generator=generator)
    u, du, dx = (torch.ones(count, k, dtype=torch.float64) for k in (outputs, outputs, dim))
    return Points(at, u, dx, du)


@smooth
@every_formula
@pytest.mark.parametrize(("dim", "side"), [(1, 6.0), (2, 1.5)])
def test_errors_stay_below_the_accuracy(profile: Profile, formula: Formula, dim: int, side: float) -> None:
    rows, columns = cloud(COUNT, dim, side, 1), cloud(COUNT, dim, side, 2)
    # of absolute momenta, times the number of terms that a result adds up
    terms = 1.0 if formula is FIELD else 2.0 * columns.momenta.shape[1] * dim
    exact = backends.evaluate(formula, profile, rows, columns)
    for accuracy in (1e-2, 1e-4):
        found = fourier.sums(formula, profile, rows, columns, accuracy)
        assert found is not None or (dim == 2 and isinstance(profile, MaternProfile))
        assert_same(found or exact, exact, accuracy * terms * COUNT)


@pytest.mark.parametrize("kernel", [dc.Gaussian([0.5, 2.0]), TORUS, dc.Gaussian(0.4) + dc.Cauchy(1.0)])
def test_kernels_with_an_accuracy(kernel: dc.Kernel) -> None:
    """Length scales of every coordinate, circles, and sums of which only one term has waves."""
    q, a, dq, da = (normal(COUNT, 2, seed=k).clamp(-1.5, 1.5) for k in range(4))
    bound = 1e-3 * float(a.abs().sum())
    within = kernel.using("auto", accuracy=1e-3)
    assert_same([within.field(None, q, a)], [kernel.field(None, q, a)], bound)
    assert_same(within.field_and_jacobian(None, q, a), kernel.field_and_jacobian(None, q, a), 10 * bound)
    assert_same(within.hessian_product(q, a, dq, da), kernel.hessian_product(q, a, dq, da), 100 * bound)
    assert not torch.equal(within.field(None, q, a), kernel.field(None, q, a))
    assert all("within 0.001" in name for name in within.backends(COUNT, q.device))


@pytest.mark.parametrize(
    ("profile", "count", "dim"),
    [(GaussianProfile(), 100, 2), (CauchyProfile(), COUNT, 2), (GaussianProfile(), COUNT, 6)],
)
def test_no_waves_where_they_do_not_pay(profile: Profile, count: int, dim: int) -> None:
    """Few points, no spectral density, many coordinates."""
    assert fourier.sums(FIELD, profile, None, cloud(count, dim, 2.0, 1), 1e-3) is None


def test_a_lattice_that_misses_the_accuracy_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    columns = cloud(COUNT, 1, 6.0, 1)
    assert fourier.sums(FIELD, GaussianProfile(), None, columns, 1e-4) is not None
    monkeypatch.setattr(fourier, "bandwidth", lambda *_: 1.0)
    assert fourier.sums(FIELD, GaussianProfile(), None, columns, 1e-4) is None


def test_autograd_follows_all_pairs() -> None:
    q, a = normal(COUNT, 1, seed=1).requires_grad_(), normal(COUNT, 1, seed=2)
    slopes: list[Tensor] = []
    for kernel in (dc.Gaussian(0.5), dc.Gaussian(0.5).using("tiled", accuracy=1e-2)):
        slopes += torch.autograd.grad(kernel.field(None, q, a).square().sum(), q)
    torch.testing.assert_close(slopes[1], slopes[0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("lengthscale", [1.0, 1e-3])
def test_points_that_are_not_finite(value: float, lengthscale: float) -> None:
    """A flow that diverges: no waves, and no pair is left out, so that solvers see it."""
    q, a = normal(COUNT, 2, seed=1), normal(COUNT, 2, seed=2)
    q[7, 1] = value
    found, exact = (dc.Gaussian(lengthscale).using("tiled", accuracy).field(None, q, a) for accuracy in (1e-3, None))
    assert bool(found.isnan().any())
    assert torch.equal(found.isnan(), exact.isnan())


@pytest.mark.parametrize("accuracy", [0.0, 1.0, -1e-3, 1e-15, float("nan"), True, "1e-6", [1e-6], 1e-6 + 0j])
def test_an_impossible_accuracy(accuracy: Any) -> None:
    with pytest.raises(InputError, match=r"`accuracy`: expected a number between 1e-12 and 1, got .*all pairs"):
        dc.Gaussian(0.5).using("auto", accuracy=accuracy)
