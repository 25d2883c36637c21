"""Kernel sums against an explicit loop over pairs, and blocks of rows against the whole."""

from collections.abc import Callable

import pytest
import torch
from math_bank import normal
from torch import Tensor

from diffeo_calib import reductions
from diffeo_calib.profiles import CauchyProfile, GaussianProfile, MaternProfile, Profile
from diffeo_calib.reductions import Points

ROWS, COLUMNS, FEATURES, OUTPUTS = 7, 5, 3, 2
FAR = float(1 << 20)
PROFILES = (GaussianProfile(), CauchyProfile(), MaternProfile(2.5), MaternProfile(3.5))

every_profile = pytest.mark.parametrize("profile", PROFILES, ids=lambda p: f"{type(p).__name__}{getattr(p, 'nu', '')}")


def representable(*shape: int, seed: int) -> Tensor:
    """Random numbers with 20 binary digits, so that adding 2^20 loses nothing."""
    return (normal(*shape, seed=seed) * 2**20).round() / 2**20


def points(count: int, seed: int) -> Points:
    return Points(
        representable(count, FEATURES, seed=seed),
        normal(count, OUTPUTS, seed=seed + 1),
        normal(count, FEATURES, seed=seed + 2),
        normal(count, OUTPUTS, seed=seed + 3),
    )


def kappa(profile: Profile, e: Tensor, f: Tensor, order: int) -> Tensor:
    return profile.derivative(((e - f) ** 2).sum(), order)


def naive_matrix(profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    return (torch.stack([torch.stack([kappa(profile, e, f, 0) for f in j.features]) for e in i.features]),)


def naive_field(profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    u = some(j.momenta)
    return (torch.stack([total(kappa(profile, e, f, 0) * u[b] for b, f in enumerate(j.features)) for e in i.features]),)


def naive_field_and_jacobian(profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    u = some(j.momenta)
    slopes = [
        total(2 * kappa(profile, e, f, 1) * torch.outer(u[b], e - f) for b, f in enumerate(j.features))
        for e in i.features
    ]
    return naive_field(profile, i, j)[0], torch.stack(slopes)


def naive_gradient(profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    a, b = some(i.momenta), some(j.momenta)
    slopes = [
        total(2 * kappa(profile, e, f, 1) * (a[k] @ b[m]) * (e - f) for m, f in enumerate(j.features))
        for k, e in enumerate(i.features)
    ]
    return naive_field(profile, i, j)[0], torch.stack(slopes)


def naive_hessian_product(profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    """The derivative of :func:`naive_gradient` by autograd in a single variable t."""

    def moved(p: Points, t: Tensor) -> Points:
        return Points(p.features + t * some(p.d_features), some(p.momenta) + t * some(p.d_momenta))

    def at(t: Tensor) -> tuple[Tensor, ...]:
        return naive_gradient(profile, moved(i, t), moved(j, t))

    zero = torch.zeros((), dtype=torch.float64)
    eps = 1e-3
    parts = [(at(zero + k * eps), at(zero - k * eps)) for k in (1, 2, 3)]
    weights = (1.5, -0.3, 1 / 30)
    dv, dg = (total(w * (p[n] - m[n]) / (2 * eps) for w, (p, m) in zip(weights, parts, strict=True)) for n in (0, 1))
    return dv, dg, at(zero)[1]


def some(value: Tensor | None) -> Tensor:
    assert value is not None
    return value


def total(values: object) -> Tensor:
    return torch.stack(list(values)).sum(0)  # pyright: ignore[reportArgumentType]


Naive = Callable[[Profile, Points, Points], tuple[Tensor, ...]]
FORMULAS: dict[str, tuple[reductions.Formula, Naive, float]] = {
    "profile_matrix": (reductions.profile_matrix, naive_matrix, 1e-13),
    "field": (reductions.field, naive_field, 1e-13),
    "field_and_jacobian": (reductions.field_and_jacobian, naive_field_and_jacobian, 1e-12),
    "gradient": (reductions.gradient, naive_gradient, 1e-12),
    "hessian_product": (reductions.hessian_product, naive_hessian_product, 2e-9),
}
every_formula = pytest.mark.parametrize(("formula", "naive", "atol"), FORMULAS.values(), ids=FORMULAS.keys())


@every_profile
@every_formula
def test_sums_are_those_of_a_loop_over_pairs(
    formula: reductions.Formula, naive: Naive, atol: float, profile: Profile
) -> None:
    i, j = points(ROWS, 10), points(COLUMNS, 20)
    for actual, expected in zip(reductions.run(formula, profile, i, j), naive(profile, i, j), strict=True):
        torch.testing.assert_close(actual, expected, rtol=0, atol=atol)


@every_profile
@every_formula
def test_centring_keeps_the_digits_far_from_the_origin(
    formula: reductions.Formula, naive: Naive, atol: float, profile: Profile
) -> None:
    i, j = points(ROWS, 10), points(COLUMNS, 20)
    far_i, far_j = (p._replace(features=p.features + FAR) for p in (i, j))
    near, far = (reductions.run(formula, profile, a, b) for a, b in ((i, j), (far_i, far_j)))
    for actual, expected in zip(far, near, strict=True):
        torch.testing.assert_close(actual, expected, rtol=0, atol=1e-12)


@every_profile
@pytest.mark.parametrize("formula", [formula for formula, _, _ in FORMULAS.values()], ids=FORMULAS.keys())
@pytest.mark.parametrize("elements", [1, 2 * COLUMNS, 3 * COLUMNS + 1, ROWS * COLUMNS - 1])
def test_blocks_of_rows_change_nothing(
    monkeypatch: pytest.MonkeyPatch, formula: reductions.Formula, profile: Profile, elements: int
) -> None:
    i, j = points(ROWS, 10), points(COLUMNS, 20)
    whole = reductions.run(formula, profile, i, j)
    monkeypatch.setattr(reductions, "BLOCK_ELEMENTS", elements)
    for actual, expected in zip(reductions.run(formula, profile, i, j), whole, strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-13, atol=1e-13)


def test_blocks_bound_the_rows_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []

    def formula(pairs: object, profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
        seen.append(len(i.features))
        return (i.features,)

    monkeypatch.setattr(reductions, "BLOCK_ELEMENTS", 3 * COLUMNS)
    reductions.run(formula, GaussianProfile(), points(ROWS, 10), points(COLUMNS, 20))
    assert seen == [3, 3, 1]


@every_formula
def test_no_rows_and_no_columns(formula: reductions.Formula, naive: Naive, atol: float) -> None:
    some_points, none = points(ROWS, 10), points(0, 20)
    for tensor in reductions.run(formula, GaussianProfile(), none, some_points):
        assert len(tensor) == 0
    for tensor in reductions.run(formula, GaussianProfile(), some_points, none)[:2]:
        assert len(tensor) == ROWS
        if tensor.shape[1]:
            torch.testing.assert_close(tensor, torch.zeros_like(tensor), rtol=0, atol=0)
