"""Landmark geodesics: the hand-written adjoint, and the invariants of Hamilton's equations."""

import pytest
import torch
from math_bank import CASES, NAMES, Case, normal, slopes
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.flows.geodesic import Flow, energy, geodesic_field, velocity
from diffeo_calib.flows.integrators import RK4
from diffeo_calib.kernels.base import Kernel

every_case = pytest.mark.parametrize("case", CASES, ids=NAMES)
SMOOTH = [case for case in CASES if "1.5" not in case.name]
every_smooth_case = pytest.mark.parametrize("case", SMOOTH, ids=[case.name for case in SMOOTH])
N = 5


def start(case: Case, size: float = 0.3) -> Tensor:
    """(2, N, n)"""
    return torch.stack([case.points(N, seed=2), size * normal(N, case.dim, seed=3)])


@every_case
def test_adjoint_of_the_right_hand_side(case: Case) -> None:
    """The closed form compared with backpropagation through the gradient of H."""
    state, cotangent = start(case, 1.0).requires_grad_(), normal(2, N, case.dim, seed=8)
    (actual,) = torch.autograd.grad((geodesic_field(case.kernel, state) * cotangent).sum(), state)
    (expected,) = torch.autograd.grad((case.geodesic_field(state) * cotangent).sum(), state)
    torch.testing.assert_close(actual, expected, rtol=1e-12, atol=1e-12)


@every_case
def test_energy_and_its_gradient(case: Case) -> None:
    q, a = start(case, 1.0).unbind(0)
    matrix = case.matrix(q, q)
    q, a = q.requires_grad_(), a.requires_grad_()
    value = energy(case.kernel, q, a)
    torch.testing.assert_close(value.detach(), 0.5 * a.detach().flatten() @ matrix @ a.detach().flatten())
    actual = torch.autograd.grad(3.0 * value, (q, a))
    expected = torch.autograd.grad(3.0 * case.hamiltonian(q, a), (q, a), materialize_grads=True)
    torch.testing.assert_close(actual, expected, rtol=1e-12, atol=1e-12)


@every_case
def test_velocity_and_its_gradients(case: Case) -> None:
    """Closed-form backpropagation compared with autograd of the sum, for all inputs together and each alone."""
    x, (q, a), c = case.points(N + 2, seed=1), start(case, 1.0).unbind(0), normal(N + 2, case.dim, seed=8)
    for live in ((True, True, True), (True, False, False), (False, True, False), (False, False, True)):
        inputs = [t.clone().requires_grad_(flag) for t, flag in zip((x, q, a), live, strict=True)]
        wanted = [t for t in inputs if t.requires_grad]
        actual, expected = velocity(case.kernel, *inputs), case.kernel.field(*inputs)
        torch.testing.assert_close(actual, expected, rtol=0, atol=0)
        torch.testing.assert_close(
            torch.autograd.grad((c * actual).sum(), wanted),
            torch.autograd.grad((c * expected).sum(), wanted),
            rtol=1e-12,
            atol=1e-12,
        )


def test_velocity_is_twice_differentiable() -> None:
    kernel = dc.Gaussian(0.8, 1.3) + dc.Matern(0.9, 3.5)
    inputs = [normal(k, 2, seed=k).requires_grad_() for k in (3, 2)]
    inputs.append(normal(2, 2, seed=7).requires_grad_())
    assert torch.autograd.gradcheck(lambda x, q, a: velocity(kernel, x, q, a), inputs)
    assert torch.autograd.gradgradcheck(lambda x, q, a: velocity(kernel, x, q, a), inputs)


@every_smooth_case
def test_energy_is_conserved_with_the_order_of_the_method(case: Case) -> None:
    state = start(case, 0.6)
    flows = [Flow(case.kernel, state[0], state[1], RK4(steps)) for steps in (8, 16, 32)]
    drifts = [flow.energy_drift() for flow in flows]
    values = [float(energy(case.kernel, *node)) for node in (flows[0].nodes[0], flows[0].end)]
    assert drifts[0] == pytest.approx(abs(values[1] - values[0]) / values[0], rel=1e-6, abs=1e-15)
    assert drifts[-1] <= 1e-6
    if drifts[0] > 1e-13:  # straight geodesics conserve it exactly
        assert min(slopes(drifts)) >= 3.85


@pytest.mark.parametrize("kernel", [dc.Gaussian(0.8, 1.3), dc.Matern(0.9, 2.5), dc.Cauchy(1.2)], ids=repr)
def test_angular_momentum_is_conserved(kernel: Kernel) -> None:
    """Isotropic kernels are invariant under rotations: d/dt sum_i q_i x a_i = 0."""
    q, a = normal(N, 2, seed=2), normal(N, 2, seed=3)
    dq, da = geodesic_field(kernel, torch.stack([q, a]))
    assert abs(float(torch.linalg.det(torch.stack([torch.cat([dq, q]), torch.cat([a, da])], 1)).sum())) < 1e-13
