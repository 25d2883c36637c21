"""Landmark geodesics and their flows: against naive algorithms, autograd, and invariants of Hamilton's equations."""

import pytest
import torch
from math_bank import CASES, NAMES, Case, case_named, central_difference, naive_rk4, normal, rows_jacobian, slopes
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.flows import geodesic
from diffeo_calib.flows.geodesic import Flow, energy, geodesic_field, velocity
from diffeo_calib.flows.integrators import RK4, RK8, Integrator
from diffeo_calib.flows.torchdiffeq import TorchDiffEq

every_case = pytest.mark.parametrize("case", CASES, ids=NAMES)
N, M = 5, 7


def start(case: Case, size: float = 0.3) -> Tensor:
    """(2, N, n)"""
    return torch.stack([case.points(N, seed=2), size * normal(N, case.dim, seed=3)])


def flow_of(case: Case, integrator: Integrator, size: float = 0.3, *, variational: bool = False) -> Flow:
    q, a = start(case, size)
    return Flow(case.kernel, q, a, integrator, variational=variational)


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


SMOOTH = [case for case in CASES if "1.5" not in case.name]


@pytest.mark.parametrize("case", SMOOTH, ids=[case.name for case in SMOOTH])
def test_energy_is_conserved_with_the_order_of_the_method(case: Case) -> None:
    flows = [flow_of(case, RK4(steps), 0.6) for steps in (8, 16, 32)]
    drifts = [flow.energy_drift() for flow in flows]
    values = [float(energy(case.kernel, *node)) for node in (flows[0].nodes[0], flows[0].end)]
    assert drifts[0] == pytest.approx(abs(values[1] - values[0]) / values[0], rel=1e-6, abs=1e-15)
    assert drifts[-1] <= 1e-6
    if drifts[0] > 1e-13:  # straight geodesics conserve it exactly
        assert min(slopes(drifts)) >= 3.85


def test_momenta_are_transported_as_cotangents() -> None:
    """a(1) = M^-T a(0) along the exact flow, hence with the order of the method along the discrete one."""
    errors = []
    for steps in (4, 8, 16):
        flow = flow_of(case_named("gaussian-mixed"), RK4(steps))
        q, a = flow.nodes[0]
        expected = torch.linalg.solve(flow.with_jacobian(q)[1].mT, a[:, :, None])[:, :, 0]
        errors.append(float((flow.end[1] - expected).abs().max()))
    assert errors[-1] <= 1e-6
    assert min(slopes(errors)) >= 3.5


@every_case
def test_nodes_and_discrete_adjoint_are_those_of_the_naive_integration(case: Case) -> None:
    """Backpropagation through the steps, by the closed form of each, is the exact gradient of the discrete map."""
    state, weight = start(case, 0.6), normal(2, N, case.dim, seed=4)
    for actual, expected in zip(
        flow_of(case, RK4(3), 0.6).nodes, naive_rk4(case.geodesic_field, state, 3), strict=True
    ):
        torch.testing.assert_close(actual, expected.detach(), rtol=1e-12, atol=1e-12)
    live, found = state.clone().requires_grad_(), []
    for end in (
        RK4(2).nodes(lambda _, s: geodesic_field(case.kernel, s), live)[-1],
        naive_rk4(case.geodesic_field, live, 2)[-1],
    ):
        found.append(torch.autograd.grad((weight * end + 0.5 * end**2).sum(), live)[0])
    torch.testing.assert_close(*found, rtol=1e-12, atol=1e-12)


@every_case
def test_velocity_and_its_gradients(case: Case) -> None:
    """Closed-form backpropagation compared with autograd of the sum, for all inputs together and each alone."""
    x, (q, a), c = case.points(N + 2, seed=1), start(case, 1.0).unbind(0), normal(N + 2, case.dim, seed=8)
    for live in ((True, True, True), (True, False, False), (False, True, False), (False, False, True)):
        inputs = [t.clone().requires_grad_(flag) for t, flag in zip((x, q, a), live, strict=True)]
        wanted = [t for t in inputs if t.requires_grad]
        actual, expected = velocity(case.kernel, *inputs), case.kernel.field(*inputs)
        torch.testing.assert_close(actual, expected, rtol=0, atol=0)
        one, other = (torch.autograd.grad((c * value).sum(), wanted) for value in (actual, expected))
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


def test_velocity_is_twice_differentiable() -> None:
    kernel = dc.Gaussian(0.8, 1.3) + dc.Matern(0.9, 3.5)
    inputs = [normal(*shape, seed=k).requires_grad_() for k, shape in enumerate(((3, 2), (2, 2), (2, 2)))]
    assert torch.autograd.gradgradcheck(lambda x, q, a: velocity(kernel, x, q, a), inputs)


@every_case
def test_passive_points_are_controls_without_momentum(case: Case) -> None:
    """The naive geodesic of controls and of passive points with a = 0, together."""
    flow, x = flow_of(case, RK4(3)), case.points(M, seed=1)
    q, a = flow.nodes[0]
    state = torch.stack([torch.cat([q, x]), torch.cat([a, torch.zeros_like(x)])])
    expected = naive_rk4(case.geodesic_field, state, 3)[-1][0, N:].detach()
    torch.testing.assert_close(flow(x), expected, rtol=1e-13, atol=1e-13)


@every_case
def test_jacobian_is_the_derivative_of_the_flow(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """It keeps orientation; blocks of points change nothing, also of none."""
    flow, x, dx = flow_of(case, RK4(3)), case.points(M, seed=1), normal(M, case.dim, seed=4)
    y, jacobian = flow.with_jacobian(x)
    torch.testing.assert_close(y, flow(x), rtol=0, atol=1e-14)
    torch.testing.assert_close(jacobian, rows_jacobian(flow, x), rtol=1e-12, atol=1e-12)
    assert float(torch.linalg.det(jacobian).min()) > 0.0
    difference = central_difference(flow, x, dx)
    torch.testing.assert_close((jacobian @ dx[:, :, None])[:, :, 0], difference, rtol=1e-9, atol=1e-9)
    monkeypatch.setattr(geodesic, "BLOCK_ROWS", M - 1)
    torch.testing.assert_close((flow(x), *flow.with_jacobian(x)), (y, y, jacobian), rtol=0, atol=1e-13)
    assert [t.shape for t in flow.with_jacobian(x[:0])] == [(0, case.dim), (0, case.dim, case.dim)]


METHODS = RK8(1), TorchDiffEq("rk4", step_size=0.5)


@pytest.mark.parametrize(
    ("case", "integrator"),
    [*((case, RK4(2)) for case in CASES), *((case_named("sum"), method) for method in METHODS)],
    ids=lambda value: getattr(value, "name", type(value).__name__),
)
def test_jacobians_of_the_controls_are_those_of_passive_points(case: Case, integrator: Integrator) -> None:
    """One run of controls, momenta and Jacobians equals a run of the controls followed by one of passive points."""
    plain, together = (flow_of(case, integrator, variational=v) for v in (False, True))
    torch.testing.assert_close(together.nodes, plain.nodes, rtol=1e-11, atol=1e-12)
    expected = plain.path(plain.nodes[0][0])
    for flow in (plain, together):
        torch.testing.assert_close(flow.control_path(), expected, rtol=1e-11, atol=1e-12)
    x = case.points(4, seed=6)
    torch.testing.assert_close(together(x), plain(x), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("integrator", [RK4(1), TorchDiffEq(adjoint=True, step_size=1 / 8)], ids=repr)
def test_gradients_pass_through_flow_and_momenta(integrator: Integrator) -> None:
    """The model is differentiable in x and in the momenta at the same time."""
    case = case_named("gaussian-mixed")
    q, x, a = case.points(3, seed=2), case.points(2, seed=1), 0.3 * normal(3, 3, seed=3)
    assert torch.autograd.gradcheck(
        lambda momenta, points: Flow(case.kernel, q, momenta, integrator)(points),
        (a.requires_grad_(), x.requires_grad_()),
        eps=1e-5,
        atol=1e-5,
        fast_mode=True,
    )
