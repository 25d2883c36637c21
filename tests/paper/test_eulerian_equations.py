"""The paper's formulation at fixed points: equations (16)-(21) one by one, and the exact model for comparison."""

from itertools import product

import numpy as np
import pytest
import torch
from eulerian_bank import CORRECTED, P0, SWITCHES, deformed, momenta, name, small_problem
from math_bank import naive_rk4, normal, planar_two_markers, tensor, two_marker_problem, uniform
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.fitting.problem import slope
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.maps.nominal import as_nominal
from diffeo_calib.paper.eulerian import Eulerian, EulerianDeformation, EulerianProblem


def k_v(d: np.ndarray) -> float:
    return 8.0 * float(np.exp(1.0186 * (np.cos(d) - 1.0).sum()))


def k_v_slope(d: np.ndarray) -> np.ndarray:
    return -1.0186 * np.sin(d) * k_v(d)


def k_w(d: np.ndarray) -> float:
    return float(np.exp(-(d @ d) / 1.0270))


def k_w_slope(d: np.ndarray) -> np.ndarray:
    return -2.0 / 1.0270 * d * k_w(d)


def rr_derivatives(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """k0, Dk0 and D^2k0 of the nominal arm (22) at one configuration, by hand."""
    a, b = x[0], x[0] + x[1]
    link1, link2 = np.array([np.cos(a), np.sin(a)]), 0.5 * np.array([np.cos(b), np.sin(b)])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    first = np.stack([turn @ (link1 + link2), turn @ link2], 1)
    second = np.empty((2, 2, 2))
    second[:, 0, 0] = -(link1 + link2)
    second[:, 0, 1] = second[:, 1, 0] = second[:, 1, 1] = -link2
    return link1 + link2, first, second


def naive_rates(equations: Eulerian, x: np.ndarray, state: list[list[np.ndarray]]) -> list[list[np.ndarray]]:
    """(17) and (19), line by line, for every point i."""
    rates = []
    for xi, (ki, pi, ji) in zip(x, state, strict=True):
        v, dv, w, dw = np.zeros(2), np.zeros((2, 2)), np.zeros(2), np.zeros((2, 2))
        for xj, (kj, pj, jj) in zip(x, state, strict=True):
            aj = (1.0 if equations.printed_sign else -1.0) * jj.T @ pj
            v += k_v(xi - xj) * aj
            dv += np.outer(aj, k_v_slope(xi - xj))
            w += k_w(ki - kj) * pj
            dw += np.outer(pj, k_w_slope(ki - kj))
        divergence = pi * np.trace(dv) if equations.printed_divergence else 0.0
        bend = 0.0 if equations.printed_jacobian else np.einsum("mab,b->ma", rr_derivatives(xi)[2], v)
        rates.append([w - ji @ v, -dw.T @ pi - divergence, dw @ ji - ji @ dv - bend])
    return rates


@pytest.mark.parametrize("equations", SWITCHES, ids=name)
def test_17_and_19_against_loops(equations: Eulerian) -> None:
    x = small_problem().x.numpy()
    start = np.stack(
        [np.concatenate([rr_derivatives(a)[0], b, rr_derivatives(a)[1].ravel()]) for a, b in zip(x, P0, strict=True)]
    )

    def field(packed: Tensor) -> Tensor:
        state = [[row[:2], row[2:4], row[4:].reshape(2, 2)] for row in packed.numpy()]
        rates = naive_rates(equations, x, state)
        return tensor(np.stack([np.concatenate([part.ravel() for part in rate]) for rate in rates]))

    expected = naive_rk4(field, tensor(start), 2)[-1]
    run = deformed(P0, equations, dc.RK4(2))
    torch.testing.assert_close(run.nodes[-1], expected, rtol=0, atol=1e-12)
    assert float((run.nodes[-1] - run.nodes[0]).abs().amax(0).min()) > 5e-4  # everything has moved


def test_16_against_loops() -> None:
    problem = EulerianProblem(small_problem())
    deformation = problem.deform(momenta(P0), dc.RK4(2))
    parts = problem.energy(deformation)
    x, p = problem.x.numpy(), P0.numpy()
    k0, j0, _ = (np.stack(t) for t in zip(*map(rr_derivatives, x), strict=True))
    pairs = list(product(range(7), repeat=2))
    joint = 0.5 * sum(k_v(x[i] - x[j]) * p[i] @ j0[i] @ j0[j].T @ p[j] for i, j in pairs)
    task = 0.5 * sum(k_w(k0[i] - k0[j]) * p[i] @ p[j] for i, j in pairs)
    data = sum(float(r @ r) for r in deformation.z1 - problem.y) / (2 * 0.1**2)
    assert float(parts.field_x) == pytest.approx(joint, rel=1e-12)
    assert float(parts.field_y) == pytest.approx(task, rel=1e-12)
    assert float(parts.data) == pytest.approx(data, rel=1e-12)
    assert float(parts.total) == pytest.approx(joint + task + data, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("equations", [Eulerian(), CORRECTED], ids=name)
@pytest.mark.parametrize("integrator", [dc.RK4(2), dc.TorchDiffEq("dopri5", step_size=1.0)], ids=repr)
def test_20_is_17_with_the_point_added(equations: Eulerian, integrator: Integrator) -> None:
    """A point without momentum, carried from the start, ends where (20), (21) put it; so does a data point."""
    xi = uniform(3, 2, seed=8)
    base = deformed(P0, equations, integrator)
    x = torch.cat([base.x, xi])
    both = EulerianDeformation(base.spec, x, momenta(torch.cat([P0, torch.zeros(3, 2)])), integrator, equations)
    k, _, jacobian = both.unpack(both.nodes[-1])
    torch.testing.assert_close(base(x), k, rtol=0, atol=1e-10)
    torch.testing.assert_close(base.jacobian(x), jacobian, rtol=0, atol=1e-10)
    torch.testing.assert_close(base(base.x), base.z1, rtol=0, atol=1e-10)


EXACT_GRADIENT = [*((e, dc.RK4(2), 1e-7) for e in SWITCHES), (CORRECTED, dc.RK8(1), 1e-7)]
OTHERS = [
    (CORRECTED, dc.TorchDiffEq("rk4", step_size=0.5), 1e-7),
    (CORRECTED, dc.TorchDiffEq("dopri8", adjoint=True, step_size=1.0), 1e-5),
    (Eulerian(printed_divergence=True), dc.TorchDiffEq("rk4", adjoint=True, step_size=0.0625), 1e-3),
]


@pytest.mark.parametrize(("equations", "integrator", "tolerance"), EXACT_GRADIENT + OTHERS, ids=repr)
def test_gradient_against_finite_differences(equations: Eulerian, integrator: Integrator, tolerance: float) -> None:
    problem = EulerianProblem(small_problem(), equations)

    def energy(at: Tensor) -> Tensor:
        return problem.energy(problem.deform(momenta(at), integrator)).total

    at = P0.clone().requires_grad_()
    found = slope(problem, integrator, momenta(at), at)
    assert found is not None
    direction, h = normal(7, 2, seed=6), 1e-5
    difference = float(energy(P0 + h * direction) - energy(P0 - h * direction)) / (2 * h)
    assert float((found[1] * direction).sum()) == pytest.approx(difference, rel=tolerance)


def test_several_markers_move_in_one_field() -> None:
    """Two markers of one configuration are two landmarks of w: against the field of all marker points."""
    problem, p0 = two_marker_problem(uniform(5, 2, seed=2)), 0.05 * normal(10, 2, seed=3)
    flow = EulerianProblem(problem).deform(momenta(p0), dc.RK4(1))
    z = planar_two_markers(problem.x).reshape(10, 2)
    jacobian = as_nominal(planar_two_markers).jacobian(problem.x, torch.zeros(0))
    a = -torch.einsum("imn,im->in", jacobian, p0.reshape(5, 4))
    v, w = problem.spec.joint_kernel.field(problem.x, problem.x, a), problem.spec.task_kernel.field(z, z, p0)
    rate = flow.unpack(flow.rates(flow.nodes[0]))[0]
    expected = w.reshape(5, 4) - torch.einsum("imn,in->im", jacobian, v)
    torch.testing.assert_close(rate, expected, rtol=0, atol=1e-13)
