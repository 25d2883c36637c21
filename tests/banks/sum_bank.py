"""Kernel sums for tests: points, profiles, formulas, and the same sums by an explicit loop over pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib.util import find_spec
from typing import Any

import pytest
import torch
from math_bank import normal
from torch import Tensor

from diffeo_calib.kernels.profiles import CauchyProfile, ConstantProfile, GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.reductions.formulas import (
    FIELD,
    FIELD_AND_JACOBIAN,
    GRADIENT,
    HESSIAN_PRODUCT,
    Formula,
    Points,
)

ROWS, COLUMNS, FEATURES, OUTPUTS = 7, 5, 3, 2
FAR = float(1 << 20)
PROFILES = (GaussianProfile(), CauchyProfile(), ConstantProfile(), *(MaternProfile(nu) for nu in (1.5, 2.5, 3.5)))

every_profile = pytest.mark.parametrize("profile", PROFILES, ids=lambda p: f"{type(p).__name__}{getattr(p, 'nu', '')}")
needs_llvmlite = pytest.mark.skipif(find_spec("llvmlite") is None, reason="llvmlite is not installed")
torch_backends = pytest.mark.parametrize("backend", ["dense", "tiled", pytest.param("fused", marks=needs_llvmlite)])


class Formulated(Profile):
    """A profile of a user: a function of r2, of which fields need no derivative."""

    name = "formulated"  # pyright: ignore[reportAssignmentType]

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.function = function

    def derivative(self, r2: Any, order: int) -> Any:
        return self.function(r2)


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


def apart() -> tuple[Points, Points]:
    """Rows and columns."""
    return points(ROWS, 10), points(COLUMNS, 20)


def sides(same: bool) -> tuple[Points | None, Points]:
    """Rows and columns; rows None for sums over the columns themselves."""
    return (None, points(ROWS, 10)) if same else apart()


def mapped(p: Points, change: Callable[[Tensor], Tensor]) -> Points:
    return Points(*(change(t) for t in p.tensors))


def assert_same(actual: Iterable[Tensor], expected: Iterable[Tensor], atol: float = 1e-13) -> None:
    for one, other in zip(actual, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=atol, atol=atol)


# --- An explicit loop over pairs --------------------------------------------------------------------------------


def kappa(profile: Profile, e: Tensor, f: Tensor, order: int) -> Tensor:
    return profile.derivative(((e - f) ** 2).sum(), order)


def over_pairs(i: Points, j: Points, summand: Callable[[int, int], Tensor]) -> Tensor:
    return torch.stack(
        [torch.stack([summand(a, b) for b in range(len(j.features))]).sum(0) for a in range(len(i.features))]
    )


def naive_field(profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    return (over_pairs(i, j, lambda a, b: kappa(profile, i.features[a], j.features[b], 0) * j.momenta[b]),)


def naive_field_and_jacobian(profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    def slope(a: int, b: int) -> Tensor:
        e, f = i.features[a], j.features[b]
        return 2 * kappa(profile, e, f, 1) * torch.outer(j.momenta[b], e - f)

    return *naive_field(profile, i, j), over_pairs(i, j, slope)


def naive_gradient(profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    def slope(a: int, b: int) -> Tensor:
        e, f = i.features[a], j.features[b]
        return 2 * kappa(profile, e, f, 1) * (i.momenta[a] @ j.momenta[b]) * (e - f)

    return *naive_field(profile, i, j), over_pairs(i, j, slope)


def naive_hessian_product(profile: Profile, i: Points, j: Points) -> tuple[Tensor, ...]:
    """The derivative of :func:`naive_gradient` by central differences, error O(t^6)."""

    def at(t: float) -> tuple[Tensor, ...]:
        a, b = (Points(p.features + t * p.d_features, p.momenta + t * p.d_momenta) for p in (i, j))
        return naive_gradient(profile, a, b)

    steps = {1: 1.5, 2: -0.3, 3: 1 / 30}
    parts = [
        tuple(w * (p - m) / 2e-3 for p, m in zip(at(k * 1e-3), at(-k * 1e-3), strict=True)) for k, w in steps.items()
    ]
    dv, dg = (sum(column, torch.zeros(())) for column in zip(*parts, strict=True))
    return dv, dg, at(0.0)[1]


Naive = Callable[[Profile, Points, Points], tuple[Tensor, ...]]
NAIVE: dict[str, tuple[Formula, Naive, float]] = {
    "field": (FIELD, naive_field, 1e-13),
    "field_and_jacobian": (FIELD_AND_JACOBIAN, naive_field_and_jacobian, 1e-12),
    "gradient": (GRADIENT, naive_gradient, 1e-12),
    "hessian_product": (HESSIAN_PRODUCT, naive_hessian_product, 2e-9),
}
FORMULAS = {name: formula for name, (formula, _, _) in NAIVE.items()}
every_formula = pytest.mark.parametrize("formula", FORMULAS.values(), ids=FORMULAS.keys())
