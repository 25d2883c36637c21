"""Landmark geodesics and time stepping, ours and torchdiffeq's: naive algorithms, autograd, orders, mistakes."""

from functools import cache
from typing import Any

import math_bank
import pytest
import torch
from math_bank import CASES, NAMES, Case, case_named, naive_rk4, normal, slopes, tensor
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.flows import geodesic
from diffeo_calib.flows.geodesic import Flow, energy, geodesic_field, velocity
from diffeo_calib.flows.integrators import RK4, RK8, Integrator, RungeKutta
from diffeo_calib.flows.torchdiffeq import ADAPTIVE, FIXED, TorchDiffEq

every_case = pytest.mark.parametrize("case", CASES, ids=NAMES)
N, M = 5, 7


def start(case: Case, size: float = 0.3) -> Tensor:
    """(2, N, n)"""
    return torch.stack([case.points(N, seed=2), size * normal(N, case.dim, seed=3)])


def flow_of(case: Case, integrator: Integrator, size: float = 0.3, *, variational: bool = False) -> Flow:
    q, a = start(case, size)
    return Flow(case.kernel, q, a, integrator, variational=variational)


@every_case
def test_energy_velocity_and_their_gradients(case: Case) -> None:
    """Closed-form backpropagation compared with autograd, for all inputs together and each alone."""
    q, a = start(case, 1.0).unbind(0)
    matrix = case.matrix(q, q)
    q, a = q.requires_grad_(), a.requires_grad_()
    value = energy(case.kernel, q, a)
    torch.testing.assert_close(value.detach(), 0.5 * a.detach().flatten() @ matrix @ a.detach().flatten())
    actual = torch.autograd.grad(3.0 * value, (q, a))
    expected = torch.autograd.grad(3.0 * case.hamiltonian(q, a), (q, a), materialize_grads=True)
    torch.testing.assert_close(actual, expected, rtol=1e-12, atol=1e-12)
    x, (q, a), c = case.points(N + 2, seed=1), start(case, 1.0).unbind(0), normal(N + 2, case.dim, seed=8)
    for live in ((True, True, True), (True, False, False), (False, True, False), (False, False, True)):
        inputs = [t.clone().requires_grad_(flag) for t, flag in zip((x, q, a), live, strict=True)]
        wanted = [t for t in inputs if t.requires_grad]
        actual, expected = velocity(case.kernel, *inputs), case.kernel.field(*inputs)
        torch.testing.assert_close(actual, expected, rtol=0, atol=0)
        one, other = (torch.autograd.grad((c * value).sum(), wanted) for value in (actual, expected))
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


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


@every_case
def test_nodes_adjoint_and_passive_points_are_those_of_the_naive_integration(case: Case) -> None:
    """Backpropagation through the steps, by the closed form of each, is the exact gradient of the discrete map."""
    state, weight = start(case, 0.6), normal(2, N, case.dim, seed=4)
    nodes = flow_of(case, RK4(3), 0.6).nodes
    for actual, expected in zip(nodes, naive_rk4(case.geodesic_field, state, 3), strict=True):
        torch.testing.assert_close(actual, expected.detach(), rtol=1e-12, atol=1e-12)
    live, found = state.clone().requires_grad_(), []
    nodes = RK4(2).nodes(lambda _, s: geodesic_field(case.kernel, s), live)
    for end in (nodes[-1], naive_rk4(case.geodesic_field, live, 2)[-1]):
        found.append(torch.autograd.grad((weight * end + 0.5 * end**2).sum(), live)[0])
    torch.testing.assert_close(*found, rtol=1e-12, atol=1e-12)
    flow, x = flow_of(case, RK4(3)), case.points(M, seed=1)
    q, a = flow.nodes[0]
    state = torch.stack([torch.cat([q, x]), torch.cat([a, torch.zeros_like(x)])])
    expected = naive_rk4(case.geodesic_field, state, 3)[-1][0, N:].detach()
    torch.testing.assert_close(flow(x), expected, rtol=1e-13, atol=1e-13)


def test_velocity_is_twice_differentiable() -> None:
    kernel = dc.Gaussian(0.8, 1.3) + dc.Matern(0.9, 3.5)
    inputs = [normal(*shape, seed=k).requires_grad_() for k, shape in enumerate(((3, 2), (2, 2), (2, 2)))]
    assert torch.autograd.gradgradcheck(lambda x, q, a: velocity(kernel, x, q, a), inputs)


@every_case
def test_jacobian_is_the_derivative_of_the_flow(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """It keeps orientation; blocks of points change nothing, also of none."""
    flow, x, dx = flow_of(case, RK4(3)), case.points(M, seed=1), normal(M, case.dim, seed=4)
    y, jacobian = flow.with_jacobian(x)
    torch.testing.assert_close(y, flow(x), rtol=0, atol=1e-14)
    torch.testing.assert_close(jacobian, math_bank.rows_jacobian(flow, x), rtol=1e-12, atol=1e-12)
    assert float(torch.linalg.det(jacobian).min()) > 0.0
    difference = math_bank.central_difference(flow, x, dx)
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
    case = case_named("gaussian-mixed")
    q, x, a = case.points(3, seed=2), case.points(2, seed=1), 0.3 * normal(3, 3, seed=3)
    assert torch.autograd.gradcheck(
        lambda momenta, points: Flow(case.kernel, q, momenta, integrator)(points),
        (a.requires_grad_(), x.requires_grad_()),
        eps=1e-5,
        atol=1e-5,
        fast_mode=True,
    )


FEW, MANY = 5, 6
CASE = case_named("gaussian-mixed")  # methods see no kernels
START = torch.stack([CASE.points(FEW, seed=2), 0.3 * normal(FEW, CASE.dim, seed=3)])
DIRECTION = normal(2, FEW, CASE.dim, seed=5)
every_adaptive = pytest.mark.parametrize("method", ADAPTIVE)


def flow_by(integrator: Integrator, at: Tensor = START) -> Flow:
    return Flow(CASE.kernel, at[0], at[1], integrator)


@cache
def exact() -> Flow:
    return flow_by(RK4(128))


def distance(one: Tensor, other: Tensor) -> float:
    return float((one - other).norm() / other.norm())


def loss(integrator: Integrator, at: Tensor) -> Tensor:
    end = flow_by(integrator, at).end
    return (normal(2, FEW, CASE.dim, seed=4) * end + 0.5 * end**2).sum()


def gradient(integrator: Integrator) -> Tensor:
    live = START.clone().requires_grad_()
    return torch.autograd.grad(loss(integrator, live), live)[0]


@pytest.mark.parametrize(("method", "start", "rate", "steps"), [(RK4, 1, 1, (8, 16, 32, 64)), (RK8, 4, 3, (12, 24))])
def test_order_on_an_equation(method: type[RungeKutta], start: float, rate: float, steps: tuple[int, ...]) -> None:
    """y' = -(1 + rate t) y^2, as an autonomous pair: y(1) = 1 / (1 / start + 1 + rate / 2)."""

    def field(_: int, state: Tensor) -> Tensor:
        return torch.stack([-(1 + rate * state[1]) * state[0] ** 2, torch.ones_like(state[1])])

    solution = 1.0 / (1.0 / start + 1.0 + 0.5 * rate)
    errors = [float(abs(method(s).nodes(field, tensor([start, 0.0]))[-1][0] - solution)) for s in steps]
    assert slopes(errors) == pytest.approx([method.order] * (len(steps) - 1), abs=0.15)


@pytest.mark.parametrize(("method", "order"), FIXED.items())
def test_order_of_fixed_steps(method: str, order: int) -> None:
    errors = [distance(flow_by(TorchDiffEq(method, step_size=1 / k)).end, exact().end) for k in (8, 16, 32)]
    assert slopes(errors) == pytest.approx([order] * 2, abs=0.15)


@every_adaptive
@pytest.mark.parametrize("rtol", [1e-2, 1e-9])
def test_adaptive_steps_keep_their_tolerance(method: str, rtol: float) -> None:
    integrator = TorchDiffEq(method, step_size=1.0, rtol=rtol, atol=1e-3 * rtol)
    assert distance(flow_by(integrator).end, exact().end) <= 10.0 * rtol


@pytest.mark.parametrize("steps", [1, 2, 3, 8])
def test_weights_integrate_polynomials(steps: int) -> None:
    """Simpson is exact for cubics, the trapezoid for lines; both for constants."""
    weights, times = tensor(RK4(steps).weights()), torch.linspace(0, 1, steps + 1, dtype=torch.float64)
    for degree in range(4 if steps % 2 == 0 else 2):
        torch.testing.assert_close((weights * times**degree).sum(), tensor(1 / (degree + 1)), rtol=0, atol=1e-15)
    assert bool((weights > 0).all())


@pytest.mark.parametrize("integrator", [RK4(8), *(TorchDiffEq(name, step_size=1 / 16) for name in FIXED)], ids=repr)
def test_the_change_of_a_refined_run_gives_the_error(integrator: Integrator) -> None:
    coarse, fine = (flow_by(i).end for i in (integrator, integrator.refined()))
    expected = float((coarse - exact().end).norm())
    assert integrator.error_per_change * float((coarse - fine).norm()) == pytest.approx(expected, rel=0.05)


def test_refined_tightens_everything() -> None:
    coarse = TorchDiffEq("dopri5", adjoint=True, step_size=0.5, rtol=1e-4, atol=1e-6)
    found = coarse.refined()
    assert (found.method, found.adjoint, found.intervals) == ("dopri5", True, 4)
    assert (found.rtol, found.atol) == pytest.approx((1e-6, 1e-8))
    assert coarse.error_per_change == 1.0
    finest = TorchDiffEq("dopri5").refined().refined().refined()
    assert (finest.rtol, finest.atol) == (1e-13, 1e-16)  # as far as rounding allows


@pytest.mark.parametrize("method", FIXED)
def test_backpropagation_is_the_exact_gradient_of_the_discrete_run(method: str) -> None:
    integrator = TorchDiffEq(method)
    difference = math_bank.central_difference(lambda at: loss(integrator, at), START, DIRECTION)
    torch.testing.assert_close((gradient(integrator) * DIRECTION).sum(), difference, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
@every_adaptive
@pytest.mark.parametrize("adjoint", [False, True])
def test_gradient_through_adaptive_steps(method: str, adjoint: bool) -> None:
    expected = (gradient(RK4(32)) * DIRECTION).sum()
    actual = (gradient(TorchDiffEq(method, adjoint, rtol=1e-7, atol=1e-9)) * DIRECTION).sum()
    torch.testing.assert_close(actual, expected, rtol=2e-6, atol=0)


BAD: list[tuple[type[Integrator], dict[str, Any], str]] = [
    *((RK4, {"steps": steps}, "`steps` of RK4: expected an integer of at least 1.*") for steps in (0, 1.5, "2", None)),
    *(
        (TorchDiffEq, {"method": name}, rf"`method` .*: expected midpoint, rk4, bosh3, dopri5, dopri8, got {name!r}\.")
        for name in ("euler", None)
    ),
    *(
        (TorchDiffEq, {"step_size": step}, r"`step_size` of TorchDiffEq: expected .*, got .*\.")
        for step in (0.0, -0.5, 0.3, 1.5, float("nan"), 1e-9, 1e-320, "0.5", None, True)
    ),
    *(
        (TorchDiffEq, {name: value}, rf"`{name}` of TorchDiffEq: expected a number above .* and below 1, got .*\.")
        for name in ("rtol", "atol")
        for value in (0.0, 1.0, float("nan"), 1e-30, None, "tight")
    ),
    (TorchDiffEq, {"adjoint": "no"}, r"`adjoint` of TorchDiffEq: expected True or False, got 'no'\."),
]


@pytest.mark.parametrize(("method", "arguments", "message"), BAD)
def test_bad_arguments_are_refused(method: type[Integrator], arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}$"):
        method(**arguments)


@every_adaptive
@pytest.mark.parametrize("adjoint", [False, True])
def test_momenta_that_are_too_large_are_reported(method: str, adjoint: bool) -> None:
    q, a = tensor([[0.0], [0.2], [0.5]]), tensor([[3e200], [-4e200], [2e200]])
    with pytest.raises(NumericalError, match=r"adaptive integration broke down .*; the momenta are too large: .*\.$"):
        Flow(dc.Gaussian(0.3), q, a, TorchDiffEq(method, adjoint))
