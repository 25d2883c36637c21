"""Kernel sums against an explicit loop over pairs; tiles, pooled memory and the choice of a backend."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Any

import pytest
import torch
from math_bank import normal
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.kernels.profiles import CauchyProfile, ConstantProfile, GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.reductions import backends, tiled
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.kernels.reductions.dense import Dense
from diffeo_calib.kernels.reductions.formulas import (
    FIELD,
    FIELD_AND_JACOBIAN,
    GRADIENT,
    HESSIAN_PRODUCT,
    Field,
    Formula,
    Points,
)
from diffeo_calib.kernels.reductions.pairs import MatrixPairs
from diffeo_calib.kernels.reductions.pooled import Pool, PooledPairs, Symbol, pool_for
from diffeo_calib.kernels.reductions.tiled import Tiled

ROWS, COLUMNS, FEATURES, OUTPUTS = 7, 5, 3, 2
FAR = float(1 << 20)
PROFILES = (GaussianProfile(), CauchyProfile(), ConstantProfile(), *(MaternProfile(nu) for nu in (1.5, 2.5, 3.5)))
TILES = (1, 4, 6, COLUMNS, 9, ROWS * COLUMNS, 1000)
"""Pairs in a tile: sides that divide the points and sides that do not, one tile, and more than all pairs."""

every_profile = pytest.mark.parametrize("profile", PROFILES, ids=lambda p: f"{type(p).__name__}{getattr(p, 'nu', '')}")
torch_backends = pytest.mark.parametrize("backend", ["dense", "tiled"])


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
    """Rows and columns; no rows where the columns are summed over themselves."""
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


@every_profile
@torch_backends
@pytest.mark.parametrize(("formula", "naive", "atol"), NAIVE.values(), ids=NAIVE.keys())
def test_sums_are_those_of_a_loop_over_pairs(
    formula: Formula, naive: Naive, atol: float, profile: Profile, backend: Backend
) -> None:
    i, j = apart()
    assert_same(backends.evaluate(formula, profile, i, j, backend), naive(profile, i, j), atol)


@every_profile
def test_profile_matrix_is_made_pair_by_pair(profile: Profile) -> None:
    i, j = (p.features for p in apart())
    expected = torch.stack([torch.stack([kappa(profile, e, f, 0) for f in j]) for e in i])
    for shift in (0.0, FAR):
        assert_same([backends.profile_matrix(profile, i + shift, j + shift)], [expected])


@every_profile
@every_formula
@torch_backends
@pytest.mark.parametrize("same", [False, True])
def test_centring_keeps_the_digits_far_from_the_origin(
    formula: Formula, profile: Profile, backend: Backend, same: bool
) -> None:
    i, j = sides(same)
    far_i = None if i is None else i._replace(features=i.features + FAR)
    far_j = j._replace(features=j.features + FAR)
    atol = 1e-7 if profile == MaternProfile(1.5) else 1e-12  # its third derivative is singular where points coincide
    assert_same(
        backends.evaluate(formula, profile, far_i, far_j, backend),
        backends.evaluate(formula, profile, i, j, backend),
        atol,
    )


@every_formula
@torch_backends
def test_no_rows_and_no_columns(formula: Formula, backend: Backend) -> None:
    some, none = points(ROWS, 10), points(0, 20)
    shapes = [t.shape[1:] for t in backends.evaluate(formula, GaussianProfile(), None, some)]
    for rows, columns in ((none, some), (some, none), (none, none)):
        for result, shape in zip(
            backends.evaluate(formula, GaussianProfile(), rows, columns, backend), shapes, strict=True
        ):
            torch.testing.assert_close(result, torch.zeros(len(rows.features), *shape, dtype=torch.float64))


@every_formula
@torch_backends
@pytest.mark.parametrize("same", [False, True])
def test_strided_inputs(formula: Formula, backend: Backend, same: bool) -> None:
    expected = backends.evaluate(formula, CauchyProfile(), *sides(same), backend)
    i, j = (None if p is None else mapped(p, lambda t: torch.stack([t.T, t.T], -1)[..., 0].T) for p in sides(same))
    assert j is not None
    assert not j.features.is_contiguous()
    assert_same(backends.evaluate(formula, CauchyProfile(), i, j, backend), expected)


@every_profile
@every_formula
@torch_backends
@pytest.mark.parametrize("same", [False, True])
def test_single_precision_stays_single(formula: Formula, profile: Profile, backend: Backend, same: bool) -> None:
    expected = backends.evaluate(formula, profile, *sides(same), backend)
    i, j = sides(same)
    i, j = None if i is None else mapped(i, Tensor.float), mapped(j, Tensor.float)
    for single, double in zip(backends.evaluate(formula, profile, i, j, backend), expected, strict=True):
        assert single.dtype is torch.float32
        scale = float(double.abs().max()) + 1.0
        atol = 3e-3 if profile == MaternProfile(1.5) else 1e-5
        torch.testing.assert_close(single.double(), double, rtol=0, atol=atol * scale)


# --- Tiles ------------------------------------------------------------------------------------------------------


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
def test_each_pair_once_is_as_good_as_all_pairs(formula: Formula, profile: Profile, elements: int) -> None:
    """The symmetric path runs where no rows are given, and only there."""
    i = points(ROWS, 10)
    symmetric = Tiled(elements).reduce(formula, profile, None, i)
    atol = 1e-6 if profile == MaternProfile(1.5) else 1e-12  # r2 is 0 or 1e-16 on the diagonal
    assert_same(symmetric, Tiled(elements).reduce(formula, profile, i, i), atol)
    assert_same(symmetric, Dense().reduce(formula, profile, None, i), atol)


class Watched(Field):
    """The field, and a note of every tile that was asked for."""

    def __init__(self) -> None:
        self.tiles: list[tuple[int, int]] = []

    def weights(self, pairs: Any, profile: Profile, i: Points, j: Points) -> list[Any]:
        self.tiles.append((len(i.features), len(j.features)))
        return super().weights(pairs, profile, i, j)


def test_memory_is_bounded_by_the_tiles() -> None:
    """20000 points: tiles fit the cache, each pair is visited once, and buffers are used again."""
    watched, count = Watched(), 20_000
    many = Points(normal(count, FEATURES, seed=1), normal(count, 1, seed=2))
    buffers = pool_for(tiled.CPU_ELEMENTS, many.features).free
    buffers.clear()
    (total,) = backends.evaluate(watched, GaussianProfile(), None, many, "tiled")
    assert max(m * n for m, n in watched.tiles) <= tiled.CPU_ELEMENTS
    assert sum(m * n for m, n in watched.tiles) < 0.52 * count**2
    assert 0 < len(buffers) <= 4
    few = many._replace(features=many.features[:3])
    assert_same(backends.evaluate(FIELD, GaussianProfile(), few, many, "dense"), [total[:3]], 1e-11)


@pytest.mark.parametrize(("rows", "columns"), [(3, 5000), (5000, 3), (500, 700), (1, 1)])
def test_rectangular_tiles_cover_everything_within_their_size(rows: int, columns: int) -> None:
    watched, elements = Watched(), 1000
    i, j = points(rows, 1), points(columns, 2)
    assert_same(
        Tiled(elements).reduce(watched, GaussianProfile(), i, j), Dense().reduce(FIELD, GaussianProfile(), i, j), 1e-12
    )
    assert max(m * n for m, n in watched.tiles) <= elements
    assert sum(m * n for m, n in watched.tiles) == rows * columns


# --- Differentiation --------------------------------------------------------------------------------------------


def derivatives(reduce: Callable[..., list[Tensor]], formula: Formula, profile: Profile, same: bool) -> list[Tensor]:
    """Value, gradient and a Hessian product of a weighted sum of all results, in all inputs."""
    i, j = sides(same)
    i = None if i is None else mapped(i, lambda t: t.clone().requires_grad_())
    j = mapped(j, lambda t: t.clone().requires_grad_())
    inputs = ([] if i is None else i.tensors) + j.tensors
    results = formula.finish(reduce(formula, profile, i, j), j if i is None else i)
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
def test_autograd_sees_no_tiles(formula: Formula, profile: Profile, same: bool, elements: int) -> None:
    expected = derivatives(Dense().reduce, formula, profile, same)
    assert_same(derivatives(Tiled(elements).reduce, formula, profile, same), expected, 1e-11)


@torch_backends
def test_dispatched_sums_are_differentiable(backend: Backend) -> None:
    """Through the centring too, which must not be seen."""
    i, j = (p.features for p in apart())

    def gradient(e: Tensor, f: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        return backends.evaluate(
            GRADIENT, GaussianProfile(), Points(e, points(ROWS, 10).momenta), Points(f, u), backend
        )

    live = [t.clone().requires_grad_() for t in (i, j, points(COLUMNS, 20).momenta)]
    assert torch.autograd.gradcheck(gradient, live)
    assert torch.autograd.gradgradcheck(gradient, live)


@every_formula
def test_without_gradients_nothing_is_recorded(formula: Formula) -> None:
    i, j = apart()
    expected = backends.evaluate(formula, GaussianProfile(), i, j)
    live = mapped(i, lambda t: t.clone().requires_grad_())
    with torch.no_grad():
        results = backends.evaluate(formula, GaussianProfile(), live, j, "tiled")
    assert_same(results, expected)
    assert not any(t.requires_grad for t in results)


# --- Pooled matrices --------------------------------------------------------------------------------------------

M, N = 3, 4


class Counting(Pool):
    """A pool that knows how many buffers it has made."""

    made = 0

    def take(self) -> Tensor:
        self.made += not self.free
        return super().take()


def value(symbol: Symbol) -> Tensor:
    return symbol.scale * symbol.matrix


OPERATIONS: dict[str, Callable[[Any, Any], Any]] = {
    "x + y": lambda x, y: x + y,
    "3 x + 2 y": lambda x, y: 3.0 * x + 2.0 * y,
    "x + 2": lambda x, y: x + 2.0,
    "2 - 4 x": lambda x, y: 2.0 + -4.0 * x,
    "x + x": lambda x, y: x + x,
    "x y": lambda x, y: x * y,
    "x x": lambda x, y: x * x,
    "3 x 2 y": lambda x, y: (3.0 * x) * (y * 2.0),
    "x / y": lambda x, y: x / y,
    "x / 3": lambda x, y: x / 3.0,
    "1 / x": lambda x, y: 1.0 / x,
    "5 / 2 x": lambda x, y: 5.0 / (2.0 * x),
    "-x": lambda x, y: -x,
    "0 x": lambda x, y: x * 0.0,
    "0 x + 3": lambda x, y: x * 0.0 + 3.0,
    "0 x + 2 y": lambda x, y: x * 0.0 + y * 2.0,
    "exp": lambda x, y: x.exp(),
    "exp -x/2": lambda x, y: (x * -0.5).exp(),
    "relu": lambda x, y: (2.0 * x).relu(),
    "sqrt": lambda x, y: (x * x * 4.0).sqrt(),
    "nested": lambda x, y: 1.0 / (1.0 + (x * x + y * (x + y)).exp()) * y + (3.0 * x).relu(),
}


@pytest.mark.parametrize("operation", OPERATIONS.values(), ids=OPERATIONS.keys())
@pytest.mark.parametrize("evaluated", [(), (0,), (1,), (0, 1)])
def test_symbols_calculate_like_tensors(operation: Callable[[Any, Any], Any], evaluated: tuple[int, ...]) -> None:
    """Whichever of them has its matrix already; and twice, for nothing that they refer to is overwritten."""
    pool = Counting(M * N + 5, normal(1))
    factors = [(normal(M, 2, seed=k), normal(N, 2, seed=k + 1)) for k in (1, 3)]
    symbols, tensors = [PooledPairs(pool).dot(a, b) for a, b in factors], [a @ b.T for a, b in factors]
    for k in evaluated:
        assert_same([value(symbols[k])], [tensors[k]], 1e-14)
    results = [operation(*symbols), operation(*symbols)]
    assert_same(map(value, (*results, *symbols)), (*(2 * [operation(*tensors)]), *tensors), 1e-14)


@every_profile
@every_formula
def test_buffers_go_back_and_live_ones_are_never_overwritten(formula: Formula, profile: Profile) -> None:
    pool = Counting(ROWS * COLUMNS, normal(1))
    i, j = apart()
    kept = [formula.weights(PooledPairs(pool), profile, i, j) for _ in range(3)]
    tiles = [{w.matrix.data_ptr() for w in weights} for weights in kept]
    assert len(set().union(*tiles)) == 3 * len(tiles[0])
    assert set().union(*tiles).isdisjoint(b.data_ptr() for b in pool.free)
    expected = formula.weights(MatrixPairs(), profile, i, j)
    for weights in kept:
        assert_same(map(value, weights), expected, 1e-12)
    del weights
    kept.clear()
    assert len({b.data_ptr() for b in pool.free}) == len(pool.free) == pool.made
    for w in formula.weights(PooledPairs(pool), profile, i, j):
        assert w.matrix.shape == (ROWS, COLUMNS)
    del w
    assert len(pool.free) == pool.made  # nothing new was made for one more tile


def test_pools_are_apart_by_size_by_type_and_by_thread() -> None:
    found = [pool_for(8, normal(1)), pool_for(9, normal(1)), pool_for(8, normal(1).float())]
    thread = threading.Thread(target=lambda: found.append(pool_for(8, normal(1))))
    thread.start()
    thread.join()
    assert len({id(pool) for pool in found}) == 4
    assert pool_for(8, normal(3)) is found[0]
    assert found[2].take().dtype is torch.float32


# --- Dispatch ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("usable", [True, False])
@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_auto_chooses_by_size_and_device(monkeypatch: pytest.MonkeyPatch, device: str, usable: bool) -> None:
    monkeypatch.setattr(backends.BACKENDS["keops"], "usable", lambda: usable)
    here, most, fewest = torch.device(device), backends.DENSE_PAIRS[device], backends.KEOPS_PAIRS[device]
    large = "keops" if usable else "tiled"
    for pairs in (0, 1, most - 1, most, most + 1, fewest - 1, fewest, fewest + 1):
        expected = "keops" if usable and pairs >= fewest else "tiled" if pairs > most else "dense"
        assert backends.choose("auto", 1, pairs, here) == backends.choose("auto", pairs, 1, here) == expected
    for rows in (0, 1, fewest):
        assert backends.choose("dense", rows, 7, here) == "dense"
        assert backends.choose("tiled", rows, 7, here) == "tiled"
        assert backends.choose("keops", rows, 7, here) == large


def test_small_sums_do_not_even_ask_for_keops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends.BACKENDS["keops"], "usable", lambda: pytest.fail("pykeops was imported"))
    backends.evaluate(FIELD, GaussianProfile(), *apart())
    assert backends.choose("auto", 1000, 1000, torch.device("cpu")) == "tiled"


@pytest.mark.parametrize("name", ["numpy", "", "Dense", None])
def test_unknown_backends_are_refused(name: Any) -> None:
    with pytest.raises(InputError, match=r"^`backend`: expected auto, dense, tiled, keops, got .*\.$"):
        backends.check_backend(name)
    assert [backends.check_backend(known) for known in ("auto", "dense", "tiled", "keops")]
