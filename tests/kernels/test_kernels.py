"""Every kernel of the bank: the properties of a reproducing kernel, and its textbook formula; profiles at zero."""

from collections.abc import Callable

import math_bank
import pytest
import torch
from math_bank import CASES, MIXED, NAMES, Case, case_named, circle, normal, rows_jacobian, tensor
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.kernels.base import Kernel, SumKernel
from diffeo_calib.kernels.profiles import MAX_ORDER, PROFILES, GaussianProfile
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


@pytest.mark.parametrize(("make", "message"), BAD.values(), ids=BAD.keys())
def test_bad_hyper_parameters_are_refused(make: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()


WRONG_DIMENSION: dict[str, tuple[Kernel, int]] = {
    "scales": (dc.Gaussian([1.0, 1.0, 1.0]), 2),
    "variances": (dc.Gaussian(1.0, [1.0, 1.0]), 3),
    "space": (dc.Gaussian(1.0, space=circle(2)), 3),
    "per joint": (dc.PerJoint([1.0, 1.0], [1.0, 1.0], circle(2)), 3),
    "column": (RadialKernel(GaussianProfile(), columns=[0, 3]), 3),
    "output": (RadialKernel(GaussianProfile(), output=3), 3),
    "one term": (dc.Gaussian(1.0) + dc.VonMises([1.0, 1.0]), 3),
}


@pytest.mark.parametrize(("kernel", "dim"), WRONG_DIMENSION.values(), ids=WRONG_DIMENSION.keys())
def test_kernels_of_another_dimension_are_refused(kernel: Kernel, dim: int) -> None:
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
