"""The diffeomorphism of a flow: passive points, Jacobians, invertibility, and transported momenta."""

import pytest
import torch
from math_bank import (
    CASES,
    NAMES,
    Case,
    case_named,
    central_difference,
    inverse_of,
    naive_rk4,
    normal,
    rows_jacobian,
    slopes,
)
from torch import Tensor

from diffeo_calib.flows import geodesic
from diffeo_calib.flows.geodesic import Flow
from diffeo_calib.flows.integrators import RK4, RK8, Integrator
from diffeo_calib.flows.torchdiffeq import TorchDiffEq

every_case = pytest.mark.parametrize("case", CASES, ids=NAMES)
N, M = 5, 7


def flow_of(case: Case, steps: int = 3, size: float = 0.3) -> Flow:
    return Flow(case.kernel, case.points(N, seed=2), size * normal(N, case.dim, seed=3), RK4(steps))


@every_case
def test_passive_points_are_controls_without_momentum(case: Case) -> None:
    """The naive geodesic of controls and of passive points with a = 0, together."""
    flow, x = flow_of(case), case.points(M, seed=1)
    q, a = flow.nodes[0]
    state = torch.stack([torch.cat([q, x]), torch.cat([a, torch.zeros_like(x)])])
    expected = naive_rk4(case.geodesic_field, state, 3)[-1][0, N:].detach()
    torch.testing.assert_close(flow(x), expected, rtol=1e-13, atol=1e-13)


@every_case
def test_jacobian_is_the_derivative_of_the_flow(case: Case) -> None:
    flow, x, dx = flow_of(case), case.points(M, seed=1), normal(M, case.dim, seed=4)
    y, jacobian = flow.with_jacobian(x)
    torch.testing.assert_close(y, flow(x), rtol=0, atol=1e-14)
    torch.testing.assert_close(jacobian, rows_jacobian(flow, x), rtol=1e-12, atol=1e-12)
    difference = central_difference(flow, x, dx)
    torch.testing.assert_close((jacobian @ dx[:, :, None])[:, :, 0], difference, rtol=1e-9, atol=1e-9)


def test_blocks_of_passive_points_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    flow, x = flow_of(case_named("sum")), case_named("sum").points(M, seed=1)
    whole = flow(x), *flow.with_jacobian(x)
    monkeypatch.setattr(geodesic, "BLOCK_ROWS", M - 1)
    torch.testing.assert_close((flow(x), *flow.with_jacobian(x)), whole, rtol=0, atol=1e-13)


@every_case
def test_flow_is_invertible_and_keeps_orientation(case: Case) -> None:
    flow, x = flow_of(case), case.points(M, seed=1)
    y, jacobian = flow.with_jacobian(x)
    assert float(torch.linalg.det(jacobian).min()) > 0.0
    torch.testing.assert_close(inverse_of(flow, y), x, rtol=0, atol=1e-11)
    torch.testing.assert_close(flow(inverse_of(flow, x)), x, rtol=0, atol=1e-12)


CURVED = [case for case in CASES if case.name not in ("matern-1.5", "constant", "output")]


@pytest.mark.parametrize("case", CURVED, ids=[case.name for case in CURVED])
def test_momenta_are_transported_as_cotangents(case: Case) -> None:
    """a(1) = M^-T a(0) along the exact flow, hence with the order of the method along the discrete one."""
    errors = []
    for steps in (4, 8, 16):
        flow = flow_of(case, steps)
        q, a = flow.nodes[0]
        _, jacobian = flow.with_jacobian(q)
        expected = torch.linalg.solve(jacobian.mT, a[:, :, None])[:, :, 0]
        errors.append(float((flow.end[1] - expected).abs().max()))
    assert errors[-1] <= 1e-6
    assert min(slopes(errors)) >= 3.5


def test_no_passive_points() -> None:
    flow, none = flow_of(case_named("sum")), torch.zeros(0, 3, dtype=torch.float64)
    assert flow(none).shape == (0, 3)
    assert [t.shape for t in flow.with_jacobian(none)] == [(0, 3), (0, 3, 3)]


def test_gradients_pass_through_flow_and_momenta() -> None:
    """The model is differentiable in x and in the momenta at the same time."""
    case = case_named("gaussian-mixed")
    q, x = case.points(3, seed=2), case.points(2, seed=1)
    a = 0.3 * normal(3, 3, seed=3)

    def transported(momenta: Tensor, points: Tensor) -> Tensor:
        return Flow(case.kernel, q, momenta, RK4(1))(points)

    assert torch.autograd.gradcheck(transported, (a.requires_grad_(), x.requires_grad_()), eps=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    ("case", "integrator"),
    [
        *((case, RK4(2)) for case in CASES),
        *((case_named("sum"), integrator) for integrator in (RK8(1), TorchDiffEq("rk4", step_size=0.5))),
    ],
    ids=lambda value: getattr(value, "name", type(value).__name__),
)
def test_jacobians_of_the_controls_are_those_of_passive_points(case: Case, integrator: Integrator) -> None:
    """One run of controls, momenta and Jacobians equals a run of the controls followed by one of passive points."""
    q, a = case.points(5, seed=2), 0.3 * normal(5, case.dim, seed=3)
    plain, together = (Flow(case.kernel, q, a, integrator, variational=v) for v in (False, True))
    for actual, expected in zip(together.nodes, plain.nodes, strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-11, atol=1e-12)
    for flow in (plain, together):
        for actual, expected in zip(flow.control_path(), plain.path(q), strict=True):
            for one, other in zip(actual, expected, strict=True):
                torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-12)
    x = case.points(4, seed=6)
    torch.testing.assert_close(together(x), plain(x), rtol=1e-11, atol=1e-12)
