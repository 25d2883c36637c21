"""Kernel sums of every backend: those of one matrix, on unusual input, differentiable; which backend is chosen."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import pytest
import sum_bank
import torch
from math_bank import normal, torch_threads
from sum_bank import COLUMNS, FAR, PROFILES, ROWS, apart, assert_same, mapped, points, sides
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.kernels.profiles import GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.reductions import backends
from diffeo_calib.kernels.reductions.backends import Backend
from diffeo_calib.kernels.reductions.formulas import FIELD, GRADIENT, HESSIAN_PRODUCT, Dense, Formula, Points
from diffeo_calib.kernels.reductions.fused import Fused
from diffeo_calib.kernels.reductions.symbols import recorded
from diffeo_calib.kernels.reductions.tiled import Tiled

FUSED = pytest.param(Fused(), marks=sum_bank.needs_llvmlite, id="fused")
TILED = [pytest.param(Tiled(elements), id=f"tiles of {elements}") for elements in (1, 6, 9, 1000)]
"""Sides that divide the points and sides that do not, one tile, and more than all pairs."""
ROUGH = MaternProfile(1.5)  # its third derivative is singular where points coincide: r2 is 0 or 1e-16 there
EVERY_SUM = list(product(PROFILES, (False, True)))  # with other points, and with themselves


@sum_bank.every_formula
@pytest.mark.parametrize("backend", [FUSED, *TILED])
def test_every_backend_has_the_sums_of_one_matrix(formula: Formula, backend: Any) -> None:
    """Sizes around those of tiles, vectors and groups; tiles of compiled loops have at most 256 points."""
    sizes = ((300, 271), (17, 1)) if isinstance(backend, Fused) else ((COLUMNS, ROWS),)
    for (profile, same), (count, rows) in product(EVERY_SUM, sizes):
        j, i = points(count, 2), points(rows, 1)
        expected = Dense().reduce(formula, profile, j if same else i, j)
        found = backend.reduce(formula, profile, None if same else i, j)
        assert_same(found, expected, (1e-5 if same and profile == ROUGH else 1e-12) * count)


@sum_bank.every_formula
@sum_bank.torch_backends
def test_unusual_input(formula: Formula, backend: Backend) -> None:
    """Strided tensors; points far from the origin lose no digits; single precision stays single."""
    for profile, same in EVERY_SUM:
        i, j = sides(same)
        expected = backends.evaluate(formula, profile, i, j, backend)

        def changed(change: Callable[[Points], Points], i: Any = i, j: Any = j, profile: Any = profile) -> Any:
            return backends.evaluate(formula, profile, None if i is None else change(i), change(j), backend)

        assert_same(changed(lambda p: mapped(p, lambda t: torch.stack([t.T, t.T], -1)[..., 0].T)), expected)
        far = changed(lambda p: p._replace(features=p.features + FAR))
        assert_same(far, expected, 1e-7 if profile == ROUGH else 1e-12)
        for single, double in zip(changed(lambda p: mapped(p, Tensor.float)), expected, strict=True):
            assert single.dtype is torch.float32
            atol = (3e-3 if profile == ROUGH else 1e-5) * (float(double.abs().max()) + 1.0)
            torch.testing.assert_close(single.double(), double, rtol=0, atol=atol)


@sum_bank.every_formula
@sum_bank.torch_backends
def test_no_rows_and_no_columns(formula: Formula, backend: Backend) -> None:
    some, none = points(ROWS, 10), points(0, 20)
    shapes = [t.shape[1:] for t in backends.evaluate(formula, GaussianProfile(), None, some)]
    for rows, columns in ((none, some), (some, none), (none, none)):
        found = backends.evaluate(formula, GaussianProfile(), rows, columns, backend)
        assert_same(found, [torch.zeros(len(rows.features), *shape, dtype=torch.float64) for shape in shapes])


@pytest.mark.parametrize("backend", ["tiled", pytest.param("fused", marks=sum_bank.needs_llvmlite)])
@pytest.mark.parametrize("formula", [FIELD, HESSIAN_PRODUCT])
def test_the_number_of_threads_changes_no_digit(formula: Formula, backend: str) -> None:
    """2100 points, of themselves and of others: enough for several threads."""
    i, j = points(2100, 1), points(2100, 2)

    def of(name: str) -> list[Tensor]:
        found = [backends.BACKENDS[name].reduce(formula, GaussianProfile(), rows, j) for rows in (None, i)]
        return [result for each in found for result in each or ()]

    found = []
    for count in (1, 3):
        with torch_threads(count):
            found.append(of(backend))
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))
    assert_same(found[0], of("dense"), 1e-9)


def derivatives(reduce: Callable[..., Any], formula: Formula, profile: Profile, same: bool) -> list[Tensor]:
    """Value, gradient and a Hessian product of a weighted sum of all results, in all inputs."""
    i, j = (None if p is None else mapped(p, lambda t: t.clone().requires_grad_()) for p in sides(same))
    inputs = [t for p in (i, j) if p is not None for t in p.tensors]
    results = reduce(formula, profile, i, j)
    loss = sum(((normal(*t.shape, seed=k) * t).sum() for k, t in enumerate(results)), torch.zeros(()))
    first = torch.autograd.grad(loss, inputs, create_graph=True, materialize_grads=True)
    if formula is HESSIAN_PRODUCT:  # it needs a fourth derivative of the profile
        return [*results, *first]
    slope = sum(((normal(*t.shape, seed=k) * t).sum() for k, t in enumerate(first)), torch.zeros(()))
    return [*results, *first, *torch.autograd.grad(slope, inputs, materialize_grads=True)]


@sum_bank.every_formula
@pytest.mark.parametrize("same", [False, True])
def test_derivatives_do_not_depend_on_the_tiles(formula: Formula, same: bool) -> None:
    for profile, elements in product((MaternProfile(3.5), GaussianProfile()), (6, 9)):
        expected = derivatives(Dense().reduce, formula, profile, same)
        assert_same(derivatives(Tiled(elements).reduce, formula, profile, same), expected, 1e-11)


@sum_bank.torch_backends
def test_dispatched_sums_are_differentiable(backend: Backend) -> None:
    """Including the centring of the points, which must not change the derivatives."""
    i, j = apart()

    def gradient(e: Tensor, f: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        return backends.evaluate(GRADIENT, GaussianProfile(), Points(e, i.momenta), Points(f, u), backend)

    live = [t.clone().requires_grad_() for t in (i.features, j.features, j.momenta)]
    assert torch.autograd.gradcheck(gradient, live)
    assert torch.autograd.gradgradcheck(gradient, live)


OPERATIONS: dict[str, Callable[[Any, Any], Any]] = {
    "sums": lambda x, y: x + y + (3.0 * x + 2.0 * y) * (x - y),
    "shifts": lambda x, y: (x + 2.0) * (2.0 - 4.0 * x) + (x + x),
    "products": lambda x, y: x * y + (3.0 * x) * (y * 2.0),
    "ratios": lambda x, y: y / (1.0 + x) + x / 3.0 + 5.0 / (2.0 + 2.0 * x),
    "powers": lambda x, y: (1.0 + x) ** 3 * (1.0 + x) ** -2,
    "0 x": lambda x, y: x * 0.0,
    "0 x + 3": lambda x, y: x * 0.0 + 3.0,
    "0 x + 2 y": lambda x, y: x * 0.0 + y * 2.0,
    "exp": lambda x, y: y.exp() * (x * -0.5).exp(),
    "relu": lambda x, y: (2.0 * y).relu() + 3.0 * (-2.0 * y).relu(),
    "sqrt x": lambda x, y: (x * 4.0).relu().sqrt(),
    "constant": lambda x, y: ((x * 0.0 + 4.0).sqrt() + (x * 0.0).exp()).relu().square(),
    "nested": lambda x, y: 1.0 / (1.0 + (x * x - y * (x + y)).exp()) * y + (3.0 * y).relu(),
}


@pytest.mark.parametrize("operation", OPERATIONS.values(), ids=OPERATIONS.keys())
@pytest.mark.parametrize("backend", [Tiled(), Tiled(6), FUSED])
def test_symbols_calculate_like_tensors(operation: Callable[[Any, Any], Any], backend: Any) -> None:
    """A field whose weight is any function of r2 and s, and the gradient's, in buffers that are recycled."""

    def weigh(leaf: Callable[[str], Any], profile: Profile) -> list[Any]:
        # the last summand is for matrices, where a constant is no matrix
        return [operation(leaf("r2"), leaf("s")) + 0.0 * leaf("s"), GRADIENT.weigh(leaf, profile)[1]]

    formula, (i, j) = replace(GRADIENT, weigh=weigh), apart()
    assert recorded(formula, GaussianProfile()) is not None
    found = backend.reduce(formula, GaussianProfile(), i, j)
    assert_same(found, Dense().reduce(formula, GaussianProfile(), i, j), 1e-11)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("usable", [True, False])
@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_auto_chooses_a_backend(monkeypatch: pytest.MonkeyPatch, device: str, usable: bool, compiled: bool) -> None:
    monkeypatch.setattr(backends.BACKENDS["keops"], "usable", lambda: usable)
    monkeypatch.setattr(backends.FUSED, "trouble", lambda: "" if compiled else "not here")
    here, most, fewest = torch.device(device), backends.DENSE_PAIRS[device], backends.KEOPS_PAIRS
    least = backends.FUSED_PAIRS
    for pairs in (0, 1, least - 1, least, most - 1, most, most + 1, fewest - 1, fewest, fewest + 1):
        expected = "keops" if usable and pairs >= fewest and device == "cuda" else "tiled" if pairs > most else "dense"
        expected = "fused" if compiled and device == "cpu" and pairs >= least else expected
        assert backends.choose("auto", 1, pairs, here) == backends.choose("auto", pairs, 1, here) == expected
        for name in ("dense", "tiled", "keops"):
            assert backends.choose(name, 1, pairs, here) == ("tiled" if name == "keops" and not usable else name)


def test_small_sums_do_not_import_keops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends.BACKENDS["keops"], "usable", lambda: pytest.fail("pykeops was imported"))
    backends.evaluate(FIELD, GaussianProfile(), *apart())
    assert backends.choose("auto", 1000, 1000, torch.device("cpu")) in {"fused", "tiled"}


@pytest.mark.parametrize("name", ["numpy", "", "Dense", None])
def test_unknown_backends_are_refused(name: Any) -> None:
    message = r"^`backend`: expected auto, dense, fused, tiled, keops, distributed, got .*\.$"
    with pytest.raises(InputError, match=message):
        backends.check_backend(name)
