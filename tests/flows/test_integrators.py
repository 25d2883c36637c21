"""Time stepping, ours and torchdiffeq's: orders of convergence, tolerances, quadrature, gradients, mistakes."""

from functools import cache
from typing import Any

import pytest
import torch
from math_bank import case_named, central_difference, normal, rows_jacobian, slopes, tensor
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.flows.geodesic import Flow
from diffeo_calib.flows.integrators import RK4, RK8, Integrator, RungeKutta
from diffeo_calib.flows.torchdiffeq import ADAPTIVE, FIXED, TorchDiffEq

N, M = 5, 6
CASE = case_named("gaussian-mixed")  # methods see no kernels
START = torch.stack([CASE.points(N, seed=2), 0.3 * normal(N, CASE.dim, seed=3)])
DIRECTION = normal(2, N, CASE.dim, seed=5)
every_adaptive = pytest.mark.parametrize("method", ADAPTIVE)


def flow_of(integrator: Integrator, at: Tensor = START) -> Flow:
    return Flow(CASE.kernel, at[0], at[1], integrator)


@cache
def exact() -> Flow:
    """The flow with many steps of RK4."""
    return flow_of(RK4(128))


def distance(one: Tensor, other: Tensor) -> float:
    return float((one - other).norm() / other.norm())


def loss(integrator: Integrator, at: Tensor) -> Tensor:
    end = flow_of(integrator, at).end
    return (normal(2, N, CASE.dim, seed=4) * end + 0.5 * end**2).sum()


def gradient(integrator: Integrator) -> Tensor:
    live = START.clone().requires_grad_()
    return torch.autograd.grad(loss(integrator, live), live)[0]


@pytest.mark.parametrize(
    ("method", "start", "rate", "steps"), [(RK4, 1.0, 1.0, (8, 16, 32, 64)), (RK8, 4.0, 3.0, (12, 24))]
)
def test_order_on_an_equation_with_known_solution(
    method: type[RungeKutta], start: float, rate: float, steps: tuple[int, ...]
) -> None:
    """y' = -(1 + rate t) y^2, as an autonomous pair: y(1) = 1 / (1 / start + 1 + rate / 2)."""

    def field(_: int, state: Tensor) -> Tensor:
        return torch.stack([-(1 + rate * state[1]) * state[0] ** 2, torch.ones_like(state[1])])

    solution = 1.0 / (1.0 / start + 1.0 + 0.5 * rate)
    errors = [float(abs(method(s).nodes(field, tensor([start, 0.0]))[-1][0] - solution)) for s in steps]
    assert slopes(errors) == pytest.approx([method.order] * (len(steps) - 1), abs=0.15)


@pytest.mark.parametrize(("method", "order"), FIXED.items())
def test_order_of_fixed_steps(method: str, order: int) -> None:
    errors = [distance(flow_of(TorchDiffEq(method, step_size=1 / k)).end, exact().end) for k in (8, 16, 32)]
    assert slopes(errors) == pytest.approx([order] * 2, abs=0.15)


@every_adaptive
@pytest.mark.parametrize("rtol", [1e-2, 1e-9])
def test_adaptive_steps_keep_their_tolerance(method: str, rtol: float) -> None:
    integrator = TorchDiffEq(method, step_size=1.0, rtol=rtol, atol=1e-3 * rtol)
    assert distance(flow_of(integrator).end, exact().end) <= 10.0 * rtol


@pytest.mark.parametrize("steps", [1, 2, 3, 8])
def test_weights_integrate_polynomials(steps: int) -> None:
    """Simpson is exact for cubics, the trapezoid for lines; both for constants."""
    weights, times = tensor(RK4(steps).weights()), torch.linspace(0, 1, steps + 1, dtype=torch.float64)
    for degree in range(4 if steps % 2 == 0 else 2):
        torch.testing.assert_close((weights * times**degree).sum(), tensor(1 / (degree + 1)), rtol=0, atol=1e-15)
    assert bool((weights > 0).all())


@pytest.mark.parametrize(
    "integrator", [RK4(8), TorchDiffEq("rk4", step_size=1 / 8), TorchDiffEq("midpoint", step_size=1 / 16)], ids=repr
)
def test_the_change_of_a_refined_run_gives_the_error(integrator: Integrator) -> None:
    coarse, fine = (flow_of(i).end for i in (integrator, integrator.refined()))
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
    difference = central_difference(lambda at: loss(integrator, at), START, DIRECTION)
    torch.testing.assert_close((gradient(integrator) * DIRECTION).sum(), difference, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
@every_adaptive
@pytest.mark.parametrize("adjoint", [False, True])
def test_gradient_through_adaptive_steps(method: str, adjoint: bool) -> None:
    expected = (gradient(RK4(32)) * DIRECTION).sum()
    actual = (gradient(TorchDiffEq(method, adjoint, rtol=1e-7, atol=1e-9)) * DIRECTION).sum()
    torch.testing.assert_close(actual, expected, rtol=2e-6, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "close", "own"), [("midpoint", 1e-2, 1e-12), ("dopri8", 1e-5, 1e-7)])
def test_passive_points_and_their_jacobians(method: str, close: float, own: float) -> None:
    """Compared with RK4; the Jacobian is also the derivative of the discrete flow itself."""
    flow, x = flow_of(TorchDiffEq(method, step_size=1 / 8, rtol=1e-8)), CASE.points(M, seed=1)
    y, jacobian = flow.with_jacobian(x)
    torch.testing.assert_close((y, jacobian), exact().with_jacobian(x), rtol=0, atol=close)
    torch.testing.assert_close(flow(x), y, rtol=0, atol=own)
    torch.testing.assert_close(jacobian, rows_jacobian(flow, x), rtol=0, atol=own)


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
