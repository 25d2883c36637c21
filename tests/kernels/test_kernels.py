"""Kernels of the bank, their textbook formulas, profiles at zero; kernels and profiles of a user, in fits and files."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import math_bank
import pytest
import torch
from math_bank import CASES, MIXED, NAMES, Case, case_named, circle, normal, rows_jacobian, tensor
from table_bank import refused
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.interop import model_file
from diffeo_calib.kernels.base import Kernel, SumKernel
from diffeo_calib.kernels.profiles import MAX_ORDER, PROFILES, GaussianProfile, Profile
from diffeo_calib.kernels.radial import RadialKernel

every_case = pytest.mark.parametrize("case", CASES, ids=NAMES)
M, N = 6, 5


def data(case: Case) -> tuple[Tensor, Tensor, Tensor]:
    return case.points(M, seed=1), case.points(N, seed=2), normal(N, case.dim, seed=3)


def test_points_and_momenta_of_other_shapes_are_refused() -> None:
    case = case_named("sum-output")
    (x, q, a), k = data(case), case.kernel
    for wrong in (a[:-1], a[:, :-1], a[0]):
        of_two = lambda _, q, a: k.hamiltonian_gradient(q, a), lambda _, q, a: k.hessian_product(q, a, q, a)
        for method in (k.field, *of_two):
            with pytest.raises(InputError, match="the momenta `a`"):
                method(x, q, wrong)
    for wrong in (torch.cat([x, x], 1), x[:, :-1]):
        for method in (k.field, k.field_and_jacobian, lambda x, q, a: k.gradient(x, x, q, a)):
            with pytest.raises(InputError, match="the points `x`"):
                method(wrong, q, a)


@every_case
def test_matrix_is_the_textbook_formula_periodic_symmetric_and_positive_semi_definite(case: Case) -> None:
    x, q, _ = data(case)
    torch.testing.assert_close(case.kernel.matrix(x, q), case.matrix(x, q), rtol=1e-13, atol=1e-13)
    x = torch.cat([case.points(20, seed=1), case.points(4, seed=1) + 1e-4])
    matrix = case.kernel.matrix(x, x)
    torch.testing.assert_close(matrix, matrix.T, rtol=0, atol=5e-15)
    assert float(torch.linalg.eigvalsh(matrix).min()) >= -1e-10
    y = case.points(N, seed=2)
    torch.testing.assert_close(case.kernel.matrix(x, y), case.kernel.matrix(y, x).T, rtol=0, atol=5e-15)
    x, q, a = data(case)
    turns = torch.round(3 * normal(M, case.dim, seed=4)) * 2 * torch.pi * torch.tensor(case.space.periodic)
    found, expected = (case.kernel.field_and_jacobian(at, q, a) for at in (x + turns, x))
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-13)


@every_case
def test_field_its_jacobian_and_gradients(case: Case) -> None:
    """Of H(q, a), and of sum_ij c_i^T K(x_i, q_j) a_j in c and x."""
    x, q, a = data(case)
    v, dv = case.kernel.field_and_jacobian(x, q, a)
    torch.testing.assert_close(v, case.velocity(x, q, a), rtol=1e-13, atol=1e-13)
    naive = rows_jacobian(lambda at: case.velocity(at, q, a), x)
    torch.testing.assert_close(dv, naive, rtol=1e-12, atol=1e-12)
    own = rows_jacobian(lambda at: case.kernel.field(at, q, a), x)
    torch.testing.assert_close(own, naive, rtol=1e-12, atol=1e-12)
    x, q, a = data(case)
    live_q, live_a = q.clone().requires_grad_(), a.clone().requires_grad_()
    slope, velocity = torch.autograd.grad(case.hamiltonian(live_q, live_a), (live_q, live_a), materialize_grads=True)
    torch.testing.assert_close(case.kernel.hamiltonian_gradient(q, a), (velocity, slope), rtol=1e-12, atol=1e-12)
    c, live = normal(M, case.dim, seed=8).requires_grad_(), x.clone().requires_grad_()
    expected = torch.autograd.grad((c * case.velocity(live, q, a)).sum(), (c, live))
    torch.testing.assert_close(case.kernel.gradient(x, c.detach(), q, a), expected, rtol=1e-12, atol=1e-12)


@every_case
def test_hessian_product_and_coinciding_points(case: Case) -> None:
    """Double autograd of the pairs i != j. Two coinciding controls act like one with the sum of their momenta."""
    _, q, a = data(case)
    dq, da = normal(N, case.dim, seed=6), normal(N, case.dim, seed=7)
    live_q, live_a = q.clone().requires_grad_(), a.clone().requires_grad_()
    gq, ga = torch.autograd.grad(case.hamiltonian(live_q, live_a), (live_q, live_a), create_graph=True)
    expected_q, expected_a = torch.autograd.grad((gq * dq).sum() + (ga * da).sum(), (live_q, live_a))
    dv, dg = case.kernel.hessian_product(q, a, dq, da)
    torch.testing.assert_close(dv, expected_a, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(dg, expected_q, rtol=1e-12, atol=1e-12)
    _, q, a = data(case)
    doubled, parts = torch.cat([q, q]), torch.cat([0.3 * a, 0.7 * a])
    d = normal(2, N, case.dim, seed=6)
    single = (*case.kernel.hamiltonian_gradient(q, a), *case.kernel.hessian_product(q, a, d[0], d[1]))
    double = (
        *case.kernel.hamiltonian_gradient(doubled, parts),
        *case.kernel.hessian_product(doubled, parts, torch.cat([d[0], d[0]]), torch.cat([0.3 * d[1], 0.7 * d[1]])),
    )
    for name, one, two in zip(("v", "g", "dv", "dg"), single, double, strict=True):
        shares = (1.0, 1.0) if name in ("v", "dv") else (0.3, 0.7)  # a_i^T Dv(q_i) is linear in a_i
        expected = torch.cat([s * one for s in shares])
        torch.testing.assert_close(two, expected, rtol=0, atol=1e-8 if "1.5" in case.name else 1e-12)


@every_case
def test_gram_has_the_explicit_blocks(case: Case) -> None:
    x, y = case.points(4, seed=1), case.points(3, seed=2)
    left, right = normal(4, 2, case.dim, seed=3), normal(3, 5, case.dim, seed=4)
    rows = [torch.cat([left[i] @ case.pair(x[i], y[j]) @ right[j].T for j in range(3)], 1) for i in range(4)]  # (2, 15)
    torch.testing.assert_close(case.kernel.gram(x, left, y, right), torch.cat(rows), rtol=1e-12, atol=1e-13)


BUILDERS: dict[str, Callable[[Tensor, Tensor], Kernel]] = {
    "matern": lambda s, v: dc.Matern(s, 1.5, v, space=MIXED),
    "cauchy": lambda s, v: dc.Cauchy(s, v, space=MIXED),
    "von-mises": dc.VonMises,
    "sum": lambda s, v: dc.PerJoint(s, v, MIXED) + dc.Gaussian(s, v, space=MIXED) + math_bank.constant_kernel(v),
}


@pytest.mark.parametrize("build", BUILDERS.values(), ids=BUILDERS.keys())
def test_hyper_parameter_gradients(build: Callable[[Tensor, Tensor], Kernel]) -> None:
    x = math_bank.uniform(4, 3, seed=1)
    left, right = normal(4, 2, 3, seed=3), normal(4, 1, 3, seed=4)
    scales, variance = tensor([0.8, 1.1, 0.7]).requires_grad_(), tensor([0.5, 1.5, 0.9]).requires_grad_()
    assert torch.autograd.gradcheck(lambda s, v: build(s, v).gram(x, left, x, right), (scales, variance), atol=1e-7)


BAD: dict[str, tuple[Callable[[], object], str]] = {
    "zero lengthscale": (lambda: dc.Matern([1.0, 0.0]), "`lengthscale`: expected positive"),
    "zero concentration": (lambda: dc.VonMises([1.0, 0.0]), "`concentration`: expected positive"),
    "negative variance": (lambda: dc.Gaussian(1.0, [1.0, -2.0]), "`variance`: expected non-negative"),
    "a word": (lambda: dc.Gaussian("wide"), "`lengthscale` cannot be read as numbers"),
    "a vector": (lambda: RadialKernel(GaussianProfile(), variance=[1.0, 2.0], output=0), "one output: expected"),
    "per-joint scales": (lambda: dc.PerJoint([1.0, 1.0], [1.0, 1.0, 1.0], circle(3)), "`lengthscale` has the wrong"),
    "per-joint variances": (lambda: dc.PerJoint([1.0] * 3, [1.0], circle(3)), "`variance` has the wrong shape"),
    "no term": (lambda: SumKernel([]), "at least one term"),
    "smoothness": (lambda: dc.Matern(1.0, 2.0), r"1\.5, 2\.5 or 3\.5"),
}


WRONG_DIMENSION: dict[str, tuple[Kernel, int]] = {
    "scales": (dc.Gaussian([1.0, 1.0, 1.0]), 2),
    "variances": (dc.Gaussian(1.0, [1.0, 1.0]), 3),
    "space": (dc.Gaussian(1.0, space=circle(2)), 3),
    "per joint": (dc.PerJoint([1.0, 1.0], [1.0, 1.0], circle(2)), 3),
    "column": (RadialKernel(GaussianProfile(), columns=[0, 3]), 3),
    "output": (RadialKernel(GaussianProfile(), output=3), 3),
    "one term": (dc.Gaussian(1.0) + dc.VonMises([1.0, 1.0]), 3),
}


def test_bad_hyper_parameters_and_other_dimensions_are_refused() -> None:
    refused(*((message, make) for make, message in BAD.values()))
    for kernel, dim in WRONG_DIMENSION.values():
        with pytest.raises(InputError):
            kernel.check(dim, "joint_kernel")


@pytest.mark.parametrize("name", PROFILES)
def test_profiles_at_zero_and_beyond_their_derivatives(name: str) -> None:
    """And the slope is that of 1 - nu / (2 (nu - 1)) r2 + ..., of a Matern kernel."""
    profile, r2 = PROFILES[name], tensor([0.0, 1e-300, 1e-17, 1e-16]).requires_grad_()
    assert float(profile.derivative(tensor(0.0), 0)) == 1.0
    values = profile.derivatives(r2, MAX_ORDER)
    (first,) = torch.autograd.grad(values[0].sum(), r2)
    for value in (*values, first):
        assert bool(torch.isfinite(value).all())
    if (nu := getattr(profile, "nu", None)) is not None:
        assert float(first[0]) == pytest.approx(-nu / (2 * (nu - 1)), rel=1e-15)
    if isinstance(PROFILES[name], GaussianProfile):
        return  # one exponential, which autograd follows as often as it likes
    r2 = tensor([0.5]).requires_grad_()
    with pytest.raises(InputError, match="too often"):
        PROFILES[name].derivatives(r2, MAX_ORDER)[MAX_ORDER].sum().backward()


class Skewed(Kernel):
    """exp(-|x - y|^2 / (2 s^2)) [[1, c], [c, 1]]: a Gaussian with correlated components."""

    def __init__(self, scale: float, coupling: float) -> None:
        self.scale, self.coupling = scale, coupling

    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        kappa = (-(x[:, None] - y[None]).square().sum(-1) / (2 * self.scale**2)).exp()
        A = torch.tensor([[1.0, self.coupling], [self.coupling, 1.0]], dtype=x.dtype, device=x.device)
        return torch.kron(kappa.contiguous(), A)


class Plain(Kernel):
    """The package's Gaussian, defined by its matrix alone, to compare all defaults with the closed forms."""

    def __init__(self, scale: float, variance: float) -> None:
        self.scale, self.variance = scale, variance

    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        kappa = self.variance * (-(x[:, None] - y[None]).square().sum(-1) / (2 * self.scale**2)).exp()
        return torch.kron(kappa.contiguous(), torch.eye(x.shape[1], dtype=x.dtype, device=x.device))


PLAIN, CLOSED = Plain(0.8, 1.3), dc.Gaussian(0.8, 1.3)


def same(found: object, expected: object, atol: float = 1e-13) -> None:
    torch.testing.assert_close(found, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("dim", [1, 3])
def test_defaults_agree_with_closed_forms(dim: int) -> None:
    x, c, q, a = (normal(n, dim, seed=k) for k, n in enumerate((4, 4, 5, 5)))
    dq, da = normal(5, dim, seed=5), normal(5, dim, seed=6)
    gram = x, normal(4, 2, dim, seed=7), q, normal(5, 3, dim, seed=8)
    for method, arguments in (
        ("field", (x, q, a)),
        ("field", (None, q, a)),
        ("field", (x, q, normal(5, 4, dim, seed=3))),
        ("field_and_jacobian", (x, q, a)),
        ("gradient", (x, c, q, a)),
        ("hamiltonian_gradient", (q, a)),
        ("hessian_product", (q, a, dq, da)),
        ("gram", gram),
        ("own_blocks", (x, normal(2, 3, 2 * dim, seed=9))),
    ):
        same(getattr(PLAIN, method)(*arguments), getattr(CLOSED, method)(*arguments))
    terms = PLAIN, CLOSED, dc.Matern(0.7)
    same(SumKernel(terms).gram(*gram), sum(t.gram(*gram) for t in terms))


class Forgetful(Plain):
    """Does not keep its argument."""

    def __init__(self, width: float) -> None:
        super().__init__(width, 1.0)


class Changed(Plain):
    """A matrix that is none of a kernel."""

    def __init__(self, change: Callable[[Tensor, Tensor], Tensor]) -> None:
        super().__init__(1.0, 1.0)
        self.change = change

    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        return self.change(super().matrix(x, y), x)


@pytest.mark.parametrize(
    ("kernel", "words"),
    [
        (Changed(lambda K, x: K + 0.1 * x.flatten()[:, None]), "an asymmetry of"),
        (Changed(lambda K, _: -K), "a smallest eigenvalue of -"),
        (Changed(lambda K, x: K[: len(x), : len(x)]), r"shape \(3, 3\)"),
        (Changed(lambda K, _: K.float()), "torch.float32"),
        (Skewed(1.0, 2.0), "a smallest eigenvalue of -"),
    ],
)
def test_a_matrix_that_is_no_kernel_is_refused(kernel: Kernel, words: str) -> None:
    with pytest.raises(InputError, match=f"`joint_kernel`.*{words}"):
        fitted(kernel)


@dataclass(frozen=True)
class RationalQuadratic(Profile):
    """(1 + r2 / (2 alpha))^-alpha; ``wrong`` multiplies one derivative."""

    alpha: float = 1.5
    wrong: tuple[int, float] = (0, 1.0)
    name: str = "rq"  # pyright: ignore[reportAssignmentType]

    def derivative(self, r2: Any, order: int) -> Any:
        factor = self.wrong[1] if order == self.wrong[0] else 1.0
        for k in range(order):
            factor *= -(self.alpha + k) / (2 * self.alpha)
        return factor * (-(self.alpha + order) * (1.0 + r2 / (2 * self.alpha)).log()).exp()


class Short(RationalQuadratic):
    """Two derivatives of three."""

    def derivative(self, r2: Any, order: int) -> Any:
        return (super().derivative(r2, order),)[max(order - 2, 0)]


WRONG: list[tuple[Profile, str]] = [
    (RationalQuadratic(wrong=(1, 2.0)), r"`derivative` of order 1 at r2 = 0\.31: expected -0\.391[^;]* got -0\.782"),
    (RationalQuadratic(wrong=(2, 1.01)), "`derivative` of order 2"),
    (RationalQuadratic(wrong=(3, -1.0)), "`derivative` of order 3"),
    (RationalQuadratic(wrong=(3, float("nan"))), "`derivative` of order 3"),
    (RationalQuadratic(wrong=(0, 2.0)), r"expected kappa = 1, got 2\.0"),
    (RationalQuadratic(name="gaussian"), "`name` = 'gaussian' of a profile of the package"),
    (Short(), r"no `derivative` of order 3 \(IndexError.*expected orders 0 to 3"),
]


@pytest.mark.parametrize(("profile", "words"), WRONG)
def test_a_wrong_profile_is_refused(profile: Profile, words: str) -> None:
    for alpha in (0.1, 1.5, 80.0):
        RadialKernel(RationalQuadratic(alpha))
    with pytest.raises(InputError, match=words):
        RadialKernel(profile)


def nominal(x: Tensor) -> Tensor:
    return torch.stack([x[:, 0], x[:, 1], x.sin().sum(1)], 1)


def fitted(kernel: Kernel) -> FittedMap:
    x = torch.cartesian_prod(*[torch.linspace(-1, 1, 3, dtype=torch.float64)] * 2)
    y = nominal(x) + 0.05 * x.cos().sum(1, keepdim=True)
    problem = dc.Problem(nominal, x, y, joint_kernel=kernel, task_kernel=dc.Gaussian(1.0), noise=0.01)
    return dc.fit(problem, integrator=dc.RK4(2)).model


def test_another_backend_and_kernels_that_cannot_be_saved(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="`change` of the kernel Changed cannot be saved"):
        dc.save(fitted(Changed(lambda K, _: K)), tmp_path / "x")
    with pytest.raises(InputError, match="argument `width` is not an attribute"):
        dc.save(fitted(Forgetful(0.7)), tmp_path / "x")
    assert list(tmp_path.iterdir()) == []

    class Unwarned(Skewed):
        pass

    kernel = Unwarned(0.7, 0.3)
    assert kernel.using("auto") is kernel.using("dense") is kernel
    with pytest.warns(dc.DiffeoCalibWarning, match="Unwarned .* dense matrix; .* RadialKernel"):
        kernel.using("fused")
    kernel.using("tiled")  # warnings are errors


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    model = fitted(Skewed(0.7, 0.4) + RadialKernel(RationalQuadratic(2.5), lengthscale=0.9))
    path = tmp_path_factory.mktemp("own") / "own.safetensors"
    dc.save(model, path)
    return model, path


OWN = {"Skewed": Skewed, "rq": RationalQuadratic(2.5)}
NO_CLASSES = r"`kernels`: expected names -> subclasses of dc\.Kernel, or profiles"


def test_a_model_with_kernel_and_profile_is_loaded(saved: tuple[Any, Path]) -> None:
    """By the name and the numbers of the kernel; files of an old version have no values of the profile to compare."""
    (model, path), at = saved, tensor([[0.3, -0.2]])
    again: Any = dc.load(path, nominal, kernels=OWN)
    same(again(at), model(at), 0.0)
    header, tensors = model_file.describe(model)
    header = json.loads(json.dumps(header))
    assert header["joint_kernel"][1].pop("profile_probe")[0] == 1.0
    with pytest.warns(dc.DiffeoCalibWarning, match="profile 'rq' is that of its fit is not checked"):
        model_file.rebuild(header, tensors, nominal, OWN)


@pytest.mark.parametrize(
    ("kernels", "words"),
    [
        ({"rq": OWN["rq"]}, r"uses the kernel 'Skewed', which is not part of diffeo_calib.*kernels"),
        ({"Skewed": Skewed}, r"uses the profile 'rq', which is not part of diffeo_calib.*load\(path, kernels=\{'rq': "),
        (OWN | {"rq": RationalQuadratic(2.4)}, "profile 'rq' .* is not that of the model: expected kappa = 1, "),
        (OWN | {"rq": RationalQuadratic}, "is not that of the model"),  # called without arguments
        (OWN | {"rq": RationalQuadratic(2.5, wrong=(2, 1.1))}, "`derivative` of order 2"),
        *((classes, NO_CLASSES) for classes in (["Skewed"], {"Skewed": Skewed(0.7, 0.4)}, {"Skewed": dict}, Skewed)),
    ],
)
def test_another_kernel_or_profile_is_refused(kernels: Any, words: str, saved: tuple[Any, Path]) -> None:
    with pytest.raises(InputError, match=words) as caught:
        dc.load(saved[1], nominal, kernels=kernels)
    assert "save the model again" not in str(caught.value)
