"""Sums over nearby pairs: within the accuracy asked for, or over all pairs."""

from __future__ import annotations

import pytest
import torch
from math_bank import normal
from sum_bank import assert_same, every_formula

import diffeo_calib as dc
from diffeo_calib.kernels.profiles import CauchyProfile, GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.reductions import backends, nearby
from diffeo_calib.kernels.reductions.formulas import FIELD, Formula, Points
from diffeo_calib.kernels.reductions.nearby import negligible_beyond

COUNT, SIDE = 3000, 60.0
decaying = pytest.mark.parametrize("profile", [GaussianProfile(), MaternProfile(1.5), MaternProfile(2.5)])


def cloud(seed: int, count: int = COUNT) -> Points:
    """Points in a wide square, momenta of one sign."""
    ones = torch.ones(count, 2, dtype=torch.float64)
    return Points(
        SIDE * torch.rand(count, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)), *3 * [ones]
    )


@decaying
@every_formula
@pytest.mark.parametrize("accuracy", [1e-2, 1e-5])
@pytest.mark.parametrize("same", [True, False])
def test_errors_stay_below_the_accuracy(profile: Profile, formula: Formula, accuracy: float, same: bool) -> None:
    rows, columns = None if same else cloud(1), cloud(2)
    found = nearby.sums(formula, profile, rows, columns, accuracy)
    assert found is not None
    exact = backends.evaluate(formula, profile, rows, columns, backend="tiled")
    assert_same(found, exact, accuracy * 10 * COUNT)
    if accuracy == 1e-2:
        assert not torch.equal(found[0], exact[0])


@decaying
@pytest.mark.parametrize("accuracy", [1e-2, 1e-6])
def test_what_is_left_out_is_small(profile: Profile, accuracy: float) -> None:
    """Kernel, slope and curvature along a line, at and beyond the distance."""
    distance = negligible_beyond(profile, 2, accuracy)
    assert distance is not None
    r = torch.linspace(distance, 3 * distance, 100, dtype=torch.float64).requires_grad_()
    kappa = profile.derivative(r.square(), 0)
    (slope,) = torch.autograd.grad(kappa.sum(), r, create_graph=True)
    (curvature,) = torch.autograd.grad(slope.sum(), r)
    assert max(float(t.detach().abs().max()) for t in (kappa, slope, curvature)) < accuracy


@decaying
@pytest.mark.parametrize("accuracy", [1e-2, 1e-6])
def test_clusters_that_just_matter_are_near(profile: Profile, accuracy: float) -> None:
    """All momenta in one cluster, where the kernel is four accuracies large at the other."""
    r = torch.linspace(0.0, 60.0, 60_001, dtype=torch.float64)
    apart = float(r[profile.derivative(r.square(), 0) > 4 * accuracy][-1])
    clusters = 100.0 * (1.0 + cloud(1).features)  # most pairs are far
    clusters[:1000] = 0.0
    clusters[500:1000, 0] = apart
    momenta = (clusters == 0).to(torch.float64).prod(1, keepdim=True)
    found = nearby.sums(FIELD, profile, None, Points(clusters, momenta), accuracy)
    assert found is not None
    assert float(found[0][999]) == pytest.approx(4 * accuracy * 500, rel=0.05)


def test_blocks_hold_every_point_once() -> None:
    at = cloud(3).features
    found = nearby.blocks(at)
    assert torch.equal(torch.cat(found).sort().values, torch.arange(COUNT))
    assert max(len(own) for own in found) <= nearby.BLOCK
    widest = max(float((at[own].amax(0) - at[own].amin(0)).max()) for own in found)
    assert widest < 0.5 * SIDE


def test_rows_far_from_all_columns() -> None:
    rows, columns = cloud(1), cloud(2)
    far = rows._replace(features=rows.features + 10 * SIDE)
    found = nearby.sums(FIELD, GaussianProfile(), far, columns, 1e-6)
    assert found is not None
    assert not bool(found[0].any())


@pytest.mark.parametrize(
    ("profile", "side", "count"),
    [(CauchyProfile(), SIDE, COUNT), (GaussianProfile(), 1.0, COUNT), (GaussianProfile(), SIDE, 200)],
)
def test_all_pairs_where_nearness_does_not_help(profile: Profile, side: float, count: int) -> None:
    """A kernel that decays slowly, a length scale of the cloud's size, few points."""
    columns = cloud(1, count)
    columns = columns._replace(features=columns.features * side / SIDE)
    assert nearby.sums(FIELD, profile, None, columns, 1e-3) is None


def test_a_short_kernel_with_an_accuracy() -> None:
    q, a = 60.0 * normal(COUNT, 3, seed=1), normal(COUNT, 3, seed=2)
    kernel = dc.Matern(1.0, nu=2.5)
    within = kernel.using("auto", accuracy=1e-4)
    assert_same([within.field(None, q, a)], [kernel.field(None, q, a)], 1e-4 * float(a.abs().sum()))
    assert_same(within.hamiltonian_gradient(q, a), kernel.hamiltonian_gradient(q, a), 1e-3 * float(a.abs().sum()))
