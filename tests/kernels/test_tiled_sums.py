"""Tiled sums: they equal sums over one matrix, need bounded memory, and are differentiable."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from math_bank import normal, torch_threads
from sum_bank import (
    COLUMNS,
    FEATURES,
    ROWS,
    apart,
    assert_same,
    every_formula,
    every_profile,
    mapped,
    points,
    sides,
    torch_backends,
)
from torch import Tensor

from diffeo_calib.kernels.profiles import GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.reductions import backends, tiled
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.kernels.reductions.formulas import FIELD, GRADIENT, HESSIAN_PRODUCT, Dense, Formula, Points
from diffeo_calib.kernels.reductions.tiled import Tiled

TILES = (1, 6, 9, 1000)
"""Pairs in a tile: sides that divide the points and sides that do not, one tile, and more than all pairs."""


@every_profile
@every_formula
@pytest.mark.parametrize("elements", TILES)
def test_tiles_change_nothing(formula: Formula, profile: Profile, elements: int) -> None:
    i, j = apart()
    expected = Dense().reduce(formula, profile, i, j)
    assert_same(Tiled(elements).reduce(formula, profile, i, j), expected)


@every_profile
@every_formula
@pytest.mark.parametrize("elements", TILES)
def test_sums_that_visit_each_pair_once(formula: Formula, profile: Profile, elements: int) -> None:
    """Without rows the symmetric algorithm runs, otherwise the rectangular one."""
    i = points(ROWS, 10)
    symmetric = Tiled(elements).reduce(formula, profile, None, i)
    atol = 1e-6 if profile == MaternProfile(1.5) else 1e-12  # r2 is 0 or 1e-16 on the diagonal
    assert_same(symmetric, Tiled(elements).reduce(formula, profile, i, i), atol)
    assert_same(symmetric, Dense().reduce(formula, profile, None, i), atol)


@pytest.fixture
def tiles(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """The size of every tile."""
    sizes: list[tuple[int, int]] = []
    recycled = tiled._recycled

    def watched(weights: Any, elements: int, i: Points, j: Points) -> Any:
        sizes.append((len(i.features), len(j.features)))
        return recycled(weights, elements, i, j)

    monkeypatch.setattr(tiled, "_recycled", watched)
    return sizes


def test_memory_is_bounded_by_the_tiles(tiles: list[tuple[int, int]]) -> None:
    """20000 points on one thread: tiles fit the cache, each pair is visited once, and buffers are recycled."""
    count = 20_000
    many = Points(normal(count, FEATURES, seed=1), normal(count, 1, seed=2))
    buffers = tiled.BUFFERS.of(tiled.CPU_ELEMENTS, many.features)
    buffers.clear()
    with torch_threads(1):
        (total,) = backends.evaluate(FIELD, GaussianProfile(), None, many, "tiled")
    assert max(m * n for m, n in tiles) <= tiled.CPU_ELEMENTS
    assert sum(m * n for m, n in tiles) < 0.52 * count**2
    tiled.BUFFERS.of(1, many.features)  # takes back what was lent
    assert 0 < len(buffers) <= 4
    few = many._replace(features=many.features[:3])
    assert_same(backends.evaluate(FIELD, GaussianProfile(), few, many, "dense"), [total[:3]], 1e-11)


def test_buffers_of_inference_mode_serve_outside_of_it() -> None:
    i, formula = points(COLUMNS, 1), GRADIENT
    tiled.BUFFERS.of(7, i.features).clear()
    with torch.inference_mode():
        inside = Tiled(7).reduce(formula, GaussianProfile(), None, i)
    assert_same(Tiled(7).reduce(formula, GaussianProfile(), None, i), list(inside), 0.0)


# --- Differentiation --------------------------------------------------------------------------------------------


def derivatives(
    reduce: Callable[..., tuple[Tensor, ...]], formula: Formula, profile: Profile, same: bool
) -> list[Tensor]:
    """Value, gradient and a Hessian product of a weighted sum of all results, in all inputs."""
    i, j = sides(same)
    i = None if i is None else mapped(i, lambda t: t.clone().requires_grad_())
    j = mapped(j, lambda t: t.clone().requires_grad_())
    inputs = ([] if i is None else i.tensors) + j.tensors
    results = reduce(formula, profile, i, j)
    loss = sum(((normal(*t.shape, seed=k) * t).sum() for k, t in enumerate(results)), torch.zeros(()))
    first = torch.autograd.grad(loss, inputs, create_graph=True, materialize_grads=True)
    if formula is HESSIAN_PRODUCT:  # it needs a fourth derivative of the profile
        return [*results, *first]
    slope = sum(((normal(*t.shape, seed=k) * t).sum() for k, t in enumerate(first)), torch.zeros(()))
    return [*results, *first, *torch.autograd.grad(slope, inputs, materialize_grads=True)]


@every_formula
@pytest.mark.parametrize("profile", [MaternProfile(3.5), GaussianProfile()], ids=["matern", "gaussian"])
@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("elements", [6, 9])
def test_derivatives_do_not_depend_on_the_tiles(formula: Formula, profile: Profile, same: bool, elements: int) -> None:
    expected = derivatives(Dense().reduce, formula, profile, same)
    assert_same(derivatives(Tiled(elements).reduce, formula, profile, same), expected, 1e-11)


@torch_backends
def test_dispatched_sums_are_differentiable(backend: Backend) -> None:
    """Including the centring of the points, which must not change the derivatives."""
    i, j = (p.features for p in apart())

    def gradient(e: Tensor, f: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        return backends.evaluate(
            GRADIENT, GaussianProfile(), Points(e, points(ROWS, 10).momenta), Points(f, u), backend
        )

    live = [t.clone().requires_grad_() for t in (i, j, points(COLUMNS, 20).momenta)]
    assert torch.autograd.gradcheck(gradient, live)
    assert torch.autograd.gradgradcheck(gradient, live)
