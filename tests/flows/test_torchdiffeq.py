"""torchdiffeq's methods on geodesics: their orders, their adjoints, and passive points."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
import torch
from math_bank import Case, case_named, central_difference, normal, rows_jacobian, slopes, tensor
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.flows.geodesic import Flow
from diffeo_calib.flows.integrators import RK4, Integrator
from diffeo_calib.flows.torchdiffeq import ADAPTIVE, FIXED, TorchDiffEq

N, M = 5, 6
CASES = [case_named(name) for name in ("gaussian-mixed", "cauchy-mixed")]

every_case = pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
every_fixed = pytest.mark.parametrize(("method", "order"), FIXED.items(), ids=FIXED.keys())
every_adaptive = pytest.mark.parametrize("method", ADAPTIVE)
every_method = pytest.mark.parametrize("method", [*FIXED, *ADAPTIVE])
SOME_METHODS = [(CASES[0], "midpoint"), (CASES[0], "dopri5"), (CASES[1], "rk4"), (CASES[1], "dopri8")]
some_methods = pytest.mark.parametrize(
    ("case", "method"), SOME_METHODS, ids=lambda value: getattr(value, "name", value)
)
"""Methods see no kernels: of every case a fixed and an adaptive method."""


def start(case: Case) -> Tensor:
    """(2, N, n)"""
    return torch.stack([case.points(N, seed=2), 0.3 * normal(N, case.dim, seed=3)])


def flow_of(case: Case, integrator: Integrator) -> Flow:
    q, a = start(case)
    return Flow(case.kernel, q, a, integrator)


def exact(case: Case) -> Flow:
    """The flow with many steps of RK4."""
    return _exact(case.name)


@cache
def _exact(name: str) -> Flow:
    return flow_of(case_named(name), RK4(128))


def distance(one: Tensor, other: Tensor) -> float:
    return float((one - other).norm() / other.norm())


def loss(case: Case, integrator: Integrator, at: Tensor) -> Tensor:
    end = Flow(case.kernel, at[0], at[1], integrator).end
    return (normal(2, N, case.dim, seed=4) * end + 0.5 * end**2).sum()


def gradient(case: Case, integrator: Integrator) -> Tensor:
    live = start(case).requires_grad_()
    return torch.autograd.grad(loss(case, integrator, live), live)[0]


# --- The path of the controls -----------------------------------------------------------------------------------


@every_case
@every_fixed
def test_order_of_fixed_steps(case: Case, method: str, order: int) -> None:
    end = exact(case).end
    errors = [distance(flow_of(case, TorchDiffEq(method, step_size=1 / k)).end, end) for k in (8, 16, 32)]
    assert slopes(errors) == pytest.approx([order] * 2, abs=0.15)


@every_case
@every_adaptive
@pytest.mark.parametrize("rtol", [1e-2, 1e-4, 1e-9])
def test_adaptive_steps_keep_their_tolerance(case: Case, method: str, rtol: float) -> None:
    integrator = TorchDiffEq(method, step_size=1.0, rtol=rtol, atol=1e-3 * rtol)
    assert distance(flow_of(case, integrator).end, exact(case).end) <= 10.0 * rtol


@every_method
@pytest.mark.parametrize("adjoint", [False, True])
def test_nodes_are_at_multiples_of_the_step(method: str, adjoint: bool) -> None:
    integrator = TorchDiffEq(method, adjoint=adjoint, step_size=1 / 32)
    nodes = flow_of(CASES[0], integrator).nodes
    assert len(nodes) == integrator.intervals + 1 == len(integrator.weights()) == 33
    for node, expected in zip(nodes, exact(CASES[0]).nodes[::4], strict=True):
        torch.testing.assert_close(node, expected, rtol=0, atol=3e-5 if method == "midpoint" else 1e-7)


FIXED_STEPS = [RK4(8), TorchDiffEq("rk4", step_size=1 / 8), TorchDiffEq("midpoint", step_size=1 / 16)]


@every_case
@pytest.mark.parametrize("integrator", FIXED_STEPS, ids=repr)
def test_the_change_of_a_refined_run_gives_the_error(case: Case, integrator: Integrator) -> None:
    coarse, fine = (flow_of(case, i).end for i in (integrator, integrator.refined()))
    expected = float((coarse - exact(case).end).norm())
    assert integrator.error_per_change * float((coarse - fine).norm()) == pytest.approx(expected, rel=0.05)


def test_refined_tightens_everything() -> None:
    coarse = TorchDiffEq("dopri5", adjoint=True, step_size=0.5, rtol=1e-4, atol=1e-6)
    assert (coarse.refined().method, coarse.refined().adjoint) == ("dopri5", True)
    assert coarse.refined().intervals == 2 * coarse.intervals == 4
    assert (coarse.refined().rtol, coarse.refined().atol) == pytest.approx((1e-6, 1e-8))
    assert coarse.error_per_change == 1.0
    finest = TorchDiffEq("dopri5").refined().refined().refined()
    assert (finest.rtol, finest.atol) == (1e-13, 1e-16)  # as far as rounding allows


# --- Gradients --------------------------------------------------------------------------------------------------


@every_case
@every_fixed
def test_backpropagation_is_the_exact_gradient_of_the_discrete_run(case: Case, method: str, order: int) -> None:
    integrator, direction = TorchDiffEq(method), normal(2, N, case.dim, seed=5)
    difference = central_difference(lambda at: loss(case, integrator, at), start(case), direction)
    torch.testing.assert_close((gradient(case, integrator) * direction).sum(), difference, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
@every_case
@every_fixed
def test_order_of_the_adjoint(case: Case, method: str, order: int) -> None:
    """The adjoint equation and backpropagation agree only in the limit, where both agree with RK4's gradient."""
    limit, errors, differences = gradient(case, RK4(64)), [], []
    for count in (8, 16, 32):
        adjoint, discrete = (gradient(case, TorchDiffEq(method, flag, 1 / count)) for flag in (True, False))
        differences.append(distance(adjoint, discrete))
        errors.append(distance(discrete, limit))
    assert slopes(differences) == pytest.approx([order] * 2, abs=0.15)
    assert slopes(errors) == pytest.approx([order] * 2, abs=0.15)


@pytest.mark.slow
@every_case
@every_adaptive
@pytest.mark.parametrize("adjoint", [False, True])
def test_gradient_through_adaptive_steps(case: Case, method: str, adjoint: bool) -> None:
    direction = normal(2, N, case.dim, seed=5)
    difference = central_difference(lambda at: loss(case, RK4(32), at), start(case), direction)
    actual = (gradient(case, TorchDiffEq(method, adjoint, rtol=1e-7, atol=1e-9)) * direction).sum()
    torch.testing.assert_close(actual, difference, rtol=2e-6, atol=0)


# --- Passive points ---------------------------------------------------------------------------------------------


@pytest.mark.slow
@some_methods
def test_passive_points_and_their_jacobians(case: Case, method: str) -> None:
    """Compared with RK4; the Jacobian is also the derivative of the discrete flow itself."""
    flow = flow_of(case, TorchDiffEq(method, step_size=1 / 8, rtol=1e-8))
    x, dx = case.points(M, seed=1), normal(M, case.dim, seed=4)
    y, jacobian = flow.with_jacobian(x)
    close = 1e-2 if method == "midpoint" else 1e-5
    torch.testing.assert_close((y, jacobian), exact(case).with_jacobian(x), rtol=0, atol=close)
    own = 1e-12 if method in FIXED else 1e-7  # adaptive steps depend on all that is integrated
    torch.testing.assert_close(flow(x), y, rtol=0, atol=own)
    torch.testing.assert_close(jacobian, rows_jacobian(flow, x), rtol=0, atol=own)
    difference = central_difference(flow, x, dx, eps=1e-2)
    torch.testing.assert_close((jacobian @ dx[:, :, None])[:, :, 0], difference, rtol=0, atol=1e3 * own)


@pytest.mark.parametrize("adjoint", [False, True])
def test_gradients_pass_through_flow_and_momenta(adjoint: bool) -> None:
    case = CASES[0]
    q, x, a = case.points(3, seed=2), case.points(2, seed=1), 0.3 * normal(3, 3, seed=3)
    integrator = TorchDiffEq(adjoint=adjoint, step_size=1 / 8)

    def transported(momenta: Tensor, points: Tensor) -> Tensor:
        return Flow(case.kernel, q, momenta, integrator)(points)

    assert torch.autograd.gradcheck(
        transported, (a.requires_grad_(), x.requires_grad_()), eps=1e-5, atol=1e-5, fast_mode=True
    )


# --- Mistakes ---------------------------------------------------------------------------------------------------

BAD: dict[str, tuple[dict[str, Any], str]] = {
    "unknown method": (
        {"method": "euler"},
        r"`method` .*: expected midpoint, rk4, bosh3, dopri5, dopri8, got 'euler'\.",
    ),
    "no method": ({"method": None}, r"`method` .*: expected midpoint, rk4, bosh3, dopri5, dopri8, got None\."),
    **{
        f"step {step}": ({"step_size": step}, r"`step_size` of TorchDiffEq: expected .*, got .*\.")
        for step in (0.0, -0.5, 0.3, 0.7, 1.5, 2.0, float("nan"), 1e-9, 1e-320, "0.5", None, True)
    },
    **{
        f"{name} {value}": (
            {name: value},
            rf"`{name}` of TorchDiffEq: expected a number above .* and below 1, got .*\.",
        )
        for name in ("rtol", "atol")
        for value in (0.0, -1e-6, 1.0, float("nan"), 1e-30, None, "tight")
    },
    "adjoint in words": ({"adjoint": "no"}, r"`adjoint` of TorchDiffEq: expected True or False, got 'no'\."),
}


@pytest.mark.parametrize(("arguments", "message"), BAD.values(), ids=BAD.keys())
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=f"^{message}$"):
        TorchDiffEq(**arguments)


@every_adaptive
@pytest.mark.parametrize("adjoint", [False, True])
def test_momenta_that_are_too_large_are_reported(method: str, adjoint: bool) -> None:
    q, a = tensor([[0.0], [0.2], [0.5]]), tensor([[3e200], [-4e200], [2e200]])
    with pytest.raises(NumericalError, match=r"adaptive integration broke down .*; the momenta are too large: .*\.$"):
        Flow(dc.Gaussian(0.3), q, a, TorchDiffEq(method, adjoint))
