"""Time stepping: orders of convergence, quadrature, and the discrete adjoint."""

import pytest
import torch
from math_bank import CASES, NAMES, Case, central_difference, naive_rk4, normal, slopes, tensor
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.flows.geodesic import Flow, geodesic_field
from diffeo_calib.flows.integrators import RK4, RK8, RungeKutta

every_case = pytest.mark.parametrize("case", CASES, ids=NAMES)


@pytest.mark.parametrize(
    ("method", "start", "rate", "steps"), [(RK4, 1.0, 1.0, (8, 16, 32, 64)), (RK8, 4.0, 3.0, (12, 24))]
)
def test_order_on_an_equation_with_known_solution(
    method: type[RungeKutta], start: float, rate: float, steps: tuple[int, ...]
) -> None:
    """y' = -(1 + rate t) y^2, as an autonomous pair: y(1) = 1 / (1 / start + 1 + rate / 2)."""

    def field(stage: int, state: Tensor) -> Tensor:
        return torch.stack([-(1 + rate * state[1]) * state[0] ** 2, torch.ones_like(state[1])])

    exact = 1.0 / (1.0 / start + 1.0 + 0.5 * rate)
    errors = [float(abs(method(s).nodes(field, tensor([start, 0.0]))[-1][0] - exact)) for s in steps]
    assert slopes(errors) == pytest.approx([method.order] * (len(steps) - 1), abs=0.15)


def test_stages_are_numbered_in_order() -> None:
    seen = []

    def field(stage: int, state: Tensor) -> Tensor:
        seen.append(stage)
        return state

    for method, stages in ((RK4(3), 12), (RK8(2), 24)):
        seen.clear()
        nodes = method.nodes(field, tensor([1.0]))
        assert seen == list(range(stages))
        assert len(nodes) == method.steps + 1


@pytest.mark.parametrize("steps", [1, 2, 3, 4, 5, 8])
def test_weights_integrate_polynomials(steps: int) -> None:
    """Simpson is exact for cubics, the trapezoid for lines; both for constants."""
    weights, times = tensor(RK4(steps).weights()), torch.linspace(0, 1, steps + 1, dtype=torch.float64)
    for degree in range(4 if steps % 2 == 0 else 2):
        torch.testing.assert_close((weights * times**degree).sum(), tensor(1 / (degree + 1)), rtol=0, atol=1e-15)
    assert bool((weights > 0).all())


@pytest.mark.parametrize("steps", [0, -1, 1.5, "2", None])
def test_bad_numbers_of_steps_are_refused(steps: object) -> None:
    with pytest.raises(InputError, match="`steps` of RK4: expected an integer of at least 1"):
        RK4(steps)  # pyright: ignore[reportArgumentType]


@every_case
def test_geodesic_follows_the_naive_integration(case: Case) -> None:
    state = torch.stack([case.points(5, seed=2), 0.6 * normal(5, case.dim, seed=3)])
    nodes = Flow(case.kernel, state[0], state[1], RK4(3)).nodes
    for actual, expected in zip(nodes, naive_rk4(case.geodesic_field, state, 3), strict=True):
        torch.testing.assert_close(actual, expected.detach(), rtol=1e-12, atol=1e-12)


@every_case
def test_discrete_adjoint(case: Case) -> None:
    """Backpropagation through the steps is the exact gradient of the discrete map."""
    state = torch.stack([case.points(4, seed=2), 0.6 * normal(4, case.dim, seed=3)])
    weight, direction = normal(2, 4, case.dim, seed=4), normal(2, 4, case.dim, seed=5)

    def loss(at: Tensor) -> Tensor:
        end = RK4(2).nodes(lambda stage, s: geodesic_field(case.kernel, s), at)[-1]
        return (weight * end + 0.5 * end**2).sum()

    def naive_loss(at: Tensor) -> Tensor:
        end = naive_rk4(case.geodesic_field, at, 2)[-1]
        return (weight * end + 0.5 * end**2).sum()

    live = state.clone().requires_grad_()
    (actual,) = torch.autograd.grad(loss(live), live)
    (naive,) = torch.autograd.grad(naive_loss(live), live)
    torch.testing.assert_close(actual, naive, rtol=1e-12, atol=1e-12)
    difference = central_difference(loss, state, direction)
    torch.testing.assert_close((actual * direction).sum(), difference, rtol=1e-8, atol=1e-8)
