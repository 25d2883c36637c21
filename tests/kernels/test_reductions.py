"""Kernel sums of every backend: those of one matrix, followed by torch, and by plane waves; which backend is chosen."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import pytest
import sum_bank
import torch
from math_bank import normal, torch_threads
from sum_bank import (
    COLUMNS,
    FAR,
    PROFILES,
    ROWS,
    Formulated,
    apart,
    assert_same,
    every_formula,
    mapped,
    points,
    sides,
    torch_backends,
)
from torch import Tensor
from torch.autograd import forward_ad

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.kernels.profiles import CauchyProfile, GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kernels.reductions import backends, fourier
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


X, Q, A, C = (normal(count, 3, seed=seed) for seed, count in enumerate((30, 40, 40, 30)))
KERNEL = dc.Gaussian(0.7)


def squared_distances(x: Tensor, q: Tensor) -> Tensor:
    return (x[:, None] - q[None]).square().sum(-1)


def field(x: Tensor, q: Tensor, a: Tensor) -> Tensor:
    return (-squared_distances(x, q) / (2 * 0.7**2)).exp() @ a


def same(found: Tensor | None, expected: Tensor) -> None:
    assert found is not None
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


@torch_backends
def test_several_sums_by_vmap_over_any_argument(backend: Backend) -> None:
    kernel = KERNEL.using(backend)
    for place in range(3):
        several = normal(4, *(X, Q, A)[place].shape, seed=7)
        axes = tuple(0 if k == place else None for k in range(3))
        arguments = [several if k == place else t for k, t in enumerate((X, Q, A))]
        same(torch.vmap(kernel.field, axes)(*arguments), torch.vmap(field, axes)(*arguments))
    several = normal(4, *C.shape, seed=8)
    slopes = torch.vmap(lambda c: kernel.gradient(X, c, Q, A)[1])(several)
    expected = [torch.func.grad(lambda x, c=c: (c * field(x, Q, A)).sum())(X) for c in several]
    same(slopes, torch.stack(expected))


@torch_backends
@pytest.mark.parametrize("zero", [False, True])
def test_forward_mode_derivatives(backend: Backend, zero: bool) -> None:
    """At zero momenta too, where the field is known to vanish without a sum, but its derivative does not."""
    kernel = KERNEL.using(backend)
    arguments = (X, Q, torch.zeros_like(A) if zero else A)

    def tangent(function: Callable[..., Tensor], place: int) -> Tensor | None:
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(arguments[place], normal(*arguments[place].shape, seed=9))
            found = function(*[dual if k == place else t for k, t in enumerate(arguments)])
            return forward_ad.unpack_dual(found).tangent

    for place in (2,) if zero else (0, 1, 2):
        expected = tangent(field, place)
        assert expected is not None
        same(tangent(kernel.field, place), expected)


class Hidden(Profile):
    """exp(-alpha r2), whose parameter is no attribute."""

    name = "hidden"  # pyright: ignore[reportAssignmentType]

    def __init__(self, alpha: Tensor) -> None:
        self.where = [alpha]

    def derivative(self, r2: Tensor, order: int) -> Tensor:
        return (-(r2 * self.where[0])).exp() * (-self.where[0]) ** order


@torch_backends
@pytest.mark.parametrize("points_too", [False, True])
@pytest.mark.parametrize("accuracy", [None, 1e-3])
def test_a_parameter_of_a_profile_has_a_gradient(backend: Backend, points_too: bool, accuracy: float | None) -> None:
    alpha = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    q, c = normal(150, 3, seed=1).requires_grad_(points_too), normal(150, 3, seed=2)
    value = (c * RadialKernel(Hidden(alpha)).using(backend, accuracy).field(None, q, c)).sum()
    expected = (c * ((-squared_distances(q, q) * alpha).exp() @ c)).sum()
    wanted = (alpha, q) if points_too else (alpha,)
    for one, other in zip(torch.autograd.grad(value, wanted), torch.autograd.grad(expected, wanted), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


FUNCTIONS: dict[str, Callable[..., Tensor]] = {
    "difference": lambda r2: (1.0 - r2 * 0.1) * (-r2).exp(),
    "root by a power": lambda r2: (1.0 + r2) ** 0.5 * (-r2).exp(),
    "function of torch": lambda r2: torch.exp(-r2) * torch.cos(r2),
    "where": lambda r2: torch.where(r2 < 4.0, 1.0 - r2 / 4.0, 0.0) ** 2,
    "mask": lambda r2: (r2 != 0.25) * (-r2).exp(),
    "branch": lambda r2: (-r2).exp() if (r2 > 1.0).any() else -r2,
    "several exponents": lambda r2: (r2[..., None] * torch.tensor([-0.1, -0.9], dtype=torch.float64)).exp().mean(-1),
}


@torch_backends
@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS.keys())
def test_a_profile_may_use_any_operation_of_tensors(function: Callable[..., Tensor], backend: Backend) -> None:
    """Operations that a backend's symbols lack must not be guessed: those of tensors replace them."""
    q = torch.cartesian_prod(*[torch.arange(6.0, dtype=torch.float64) / 2] * 3)  # squared distances without rounding
    a = normal(len(q), 3, seed=1)
    kernel = RadialKernel(GaussianProfile()).using(backend)
    kernel.profile = Formulated(function)  # not all are smooth profiles with kappa(0) = 1, as a kernel asks for
    same(kernel.field(None, q, a), function(squared_distances(q, q)) @ a)


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
    assert fourier.sums(FIELD, profile, None, cloud(count, dim, 2.0, 1), 1e-3) is None


def test_autograd_and_a_lattice_that_misses_the_accuracy(monkeypatch: pytest.MonkeyPatch) -> None:
    q, a = normal(COUNT, 1, seed=1).requires_grad_(), normal(COUNT, 1, seed=2)
    slopes: list[Tensor] = []
    for kernel in (dc.Gaussian(0.5), dc.Gaussian(0.5).using("tiled", accuracy=1e-2)):
        slopes += torch.autograd.grad(kernel.field(None, q, a).square().sum(), q)
    torch.testing.assert_close(slopes[1], slopes[0], rtol=1e-12, atol=1e-12)
    columns = cloud(COUNT, 1, 6.0, 1)
    assert fourier.sums(FIELD, GaussianProfile(), None, columns, 1e-4) is not None
    monkeypatch.setattr(fourier, "bandwidth", lambda *_: 1.0)
    assert fourier.sums(FIELD, GaussianProfile(), None, columns, 1e-4) is None


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
