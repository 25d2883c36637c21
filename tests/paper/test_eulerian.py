"""The paper's formulation: equations (16)-(21) one by one, its algorithms and errata, and the exact model beside it."""

from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from listings import Descent, lr_calibration
from math_bank import (
    K_V,
    K_W,
    few_points,
    naive_rk4,
    normal,
    planar_two_markers,
    rr_problem,
    tensor,
    two_marker_problem,
    uniform,
)
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.problem import slope, tangent
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.nominal import as_nominal
from diffeo_calib.paper.eulerian import Eulerian, EulerianDeformation, EulerianProblem
from diffeo_calib.robots import elastic_rr

SWITCHES = [Eulerian(*flags) for flags in product((False, True), repeat=3)]
CORRECTED = Eulerian(printed_jacobian=False)


def name(equations: Eulerian) -> str:
    return "-".join(s for s, on in vars(equations).items() if on) or "corrected"


def momenta(p0: Tensor) -> Momenta:
    return Momenta(p0.new_zeros(0, 2), p0, p0.new_zeros(0))


def small_problem(count: int = 7) -> dc.Problem:
    x = uniform(count, 2, seed=3)
    return dc.Problem(elastic_rr.nominal, x, elastic_rr.real(x), joint_kernel=K_V, task_kernel=K_W, noise=0.1)


def deformed(
    p0: Tensor, equations: Eulerian | None = None, integrator: Integrator | None = None
) -> EulerianDeformation:
    return EulerianProblem(small_problem(len(p0)), equations).deform(momenta(p0), integrator or dc.RK4(2))


P0 = 0.03 * normal(7, 2, seed=5)


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
    first = [(*rr_derivatives(a)[:2], b) for a, b in zip(x, P0, strict=True)]
    start = np.stack([np.concatenate([k, b, J.ravel()]) for k, J, b in first])

    def field(packed: Tensor) -> Tensor:
        state = [[row[:2], row[2:4], row[4:].reshape(2, 2)] for row in packed.numpy()]
        rates = naive_rates(equations, x, state)
        return tensor(np.stack([np.concatenate([part.ravel() for part in rate]) for rate in rates]))

    expected = naive_rk4(field, tensor(start), 2)[-1]
    run = deformed(P0, equations, dc.RK4(2))
    torch.testing.assert_close(run.nodes[-1], expected, rtol=0, atol=1e-12)
    assert float((run.nodes[-1] - run.nodes[0]).abs().amax(0).min()) > 5e-4  # everything has moved


def test_16_against_loops_and_several_markers() -> None:
    """Two markers of one configuration are two landmarks of w: against the field of all marker points."""
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
    problem, p0 = two_marker_problem(uniform(5, 2, seed=2)), 0.05 * normal(10, 2, seed=3)
    flow = EulerianProblem(problem).deform(momenta(p0), dc.RK4(1))
    z = planar_two_markers(problem.x).reshape(10, 2)
    jacobian = as_nominal(planar_two_markers).jacobian(problem.x, torch.zeros(0))
    a = -torch.einsum("imn,im->in", jacobian, p0.reshape(5, 4))
    v, w = problem.spec.joint_kernel.field(problem.x, problem.x, a), problem.spec.task_kernel.field(z, z, p0)
    rate = flow.unpack(flow.rates(flow.nodes[0]))[0]
    expected = w.reshape(5, 4) - torch.einsum("imn,in->im", jacobian, v)
    torch.testing.assert_close(rate, expected, rtol=0, atol=1e-13)


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


def test_a_fit_of_an_easy_problem_and_overflow(tmp_path: Path) -> None:
    fit = dc.fit(few_points(), formulation="eulerian")
    assert fit.converged
    assert fit.status.startswith("converged")
    again = dc.fit(fit.problem, formulation="eulerian", start=fit.momenta)
    assert again.energy == pytest.approx(fit.energy, rel=1e-8)
    assert fit.energy == pytest.approx(dc.fit(few_points()).energy, rel=0.1)
    x = uniform(6, 2, seed=3)
    found = fit.model.inverse(fit.model(x), x + 0.01)
    torch.testing.assert_close(fit.model(found), fit.model(x), rtol=0, atol=1e-10)
    assert (fit.model(x[:0]).shape, fit.model.jacobian(x[:0]).shape) == ((0, 2), (0, 2, 2))
    for action in (lambda: fit.model.predict(x), lambda: dc.save(fit.model, tmp_path / "model.safetensors")):
        with pytest.raises(InputError, match='formulation="exact"'):
            action()
    with pytest.raises(NumericalError, match=r"fixed points \(17\) overflows"):
        deformed(1e30 * P0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"formulation": "lagrangian"}, r'`formulation`: expected "exact" or "eulerian", got \'lagrangian\''),
        ({"printed_sign": True}, r'expected none, got printed_sign; .*formulation="eulerian"'),
        ({"formulation": "eulerian", "sign": True}, r"expected printed_sign, printed_jacobian, .* got sign"),
        ({"formulation": "eulerian", "printed_sign": 1}, r"`printed_sign`: expected True or False, got 1"),
        ({"formulation": "eulerian", "controls": 3}, r"momentum at every measurement"),
        ({"formulation": "eulerian", "solver": dc.GaussNewton()}, r"use dc.LBFGS\(\) or dc.GradientDescent"),
        ({"formulation": "eulerian", "start": tangent(few_points()).momenta()}, r"same control points and formulation"),
    ],
)
def test_wrong_arguments_are_one_clear_error(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        dc.fit(few_points(), integrator=dc.RK4(1), **arguments)  # pyright: ignore[reportArgumentType]


STEP = 0.05


def test_algorithm_1_is_gradient_descent_from_zero() -> None:
    problem = few_points()
    K = problem.spec.joint_kernel, problem.spec.task_kernel
    result = lr_calibration(problem.x, problem.y, elastic_rr.nominal, *K, 0.3, Descent(STEP, 1e-9, 12))
    solver = dc.GradientDescent(step=STEP, tolerance=1e-9, max_iterations=12)
    fit = dc.fit(problem, solver, dc.RK4(2), formulation="eulerian")
    torch.testing.assert_close(result[1], fit.momenta.task, rtol=0, atol=1e-12)
    assert torch.equal(result[0], problem.x)
    assert result[2:] == (elastic_rr.nominal, *K)
    assert not result[1].requires_grad
    settled = lr_calibration(problem.x, problem.y, elastic_rr.nominal, *K, 0.3, Descent(STEP, 1e6, 12))
    assert not bool(settled[1].any())  # the tolerance is met at once


@pytest.mark.parametrize(("formulation", "step"), [("exact", 100.0), ("eulerian", 1e30)])
def test_too_long_a_step_diverges_and_says_so(formulation: str, step: float) -> None:
    solver = dc.GradientDescent(step=step)
    fit = dc.fit(few_points(), solver, dc.RK4(1), formulation=formulation)  # pyright: ignore[reportArgumentType]
    assert not fit.converged
    assert "diverged" in fit.status
    assert "lower `step`" in fit.status
    assert fit.iterations == len(fit.history) - 1
    assert fit.energy == pytest.approx(min(fit.history), rel=1e-12)


@pytest.fixture(scope="module")
def bed() -> dc.Problem:
    return rr_problem(8)


def fitted(problem: dc.Problem, **errata: bool) -> dc.Fit:
    return dc.fit(problem, dc.LBFGS(max_iterations=30), dc.RK4(2), formulation="eulerian", **errata)  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module")
def corrected(bed: dc.Problem) -> dc.Fit:
    return fitted(bed)


def jacobian_error(model: FittedMap | Callable[[Tensor], Tensor], x: Tensor) -> float:
    assert isinstance(model, FittedMap)
    pushes = 1e-5 * torch.eye(2, dtype=torch.float64)
    differences = torch.stack([(model(x + h) - model(x - h)) / 2e-5 for h in pushes], 2)
    return float((model.jacobian(x) - differences).norm() / differences.norm())


def mean_error(model: Callable[[Tensor], Tensor], x: Tensor) -> float:
    return float((model(x) - elastic_rr.real(x)).norm(dim=1).mean())


def test_corrected_sign_fits_the_test_bed(bed: dc.Problem, corrected: dc.Fit) -> None:
    x = uniform(500, 2, seed=7)
    assert corrected.energy == pytest.approx(dc.fit(bed).energy, rel=0.5)
    assert mean_error(corrected.model, x) < 1e-2 * mean_error(elastic_rr.nominal, x)
    assert corrected.formulation == "eulerian"
    assert np.isnan(corrected.coupling_residual)
    assert np.isfinite(corrected.end_residual)
    assert corrected.evaluations > corrected.iterations > 0


def test_erratum_1_printed_sign_is_slow(bed: dc.Problem, corrected: dc.Fit) -> None:
    """No shooting step lowers the energy, and a descent from zero needs many times more evaluations."""
    solver = dc.LBFGS(max_iterations=corrected.iterations)
    fit = dc.fit(bed, solver, dc.RK4(2), formulation="eulerian", printed_sign=True)
    assert not fit.converged
    assert fit.energy > 2 * corrected.energy
    assert EulerianProblem(bed, Eulerian(printed_sign=True)).start(dc.RK4(2))[0].task.count_nonzero() == 0
    for equations, lowers in ((Eulerian(printed_sign=True), False), (Eulerian(), True)):
        problem = EulerianProblem(bed, equations)
        start = tangent(bed).momenta().task
        energies = [float(problem.energy(problem.deform(momenta(s * start), dc.RK4(2))).total) for s in (0.0, 0.5, 1.0)]
        assert (max(energies[1:]) < energies[0]) is lowers
        assert (min(energies[1:]) > energies[0]) is not lowers


def test_erratum_2_order_of_the_missing_term() -> None:
    """Dk1 compared with differences of k1: a first-order error as printed, a second-order one with -D^2k0[v]."""
    x = uniform(10, 2, seed=0)
    for equations, ratio in ((Eulerian(), 2.0), (CORRECTED, 4.0)):
        errors = [jacobian_error(FittedMap(deformed(s * P0, equations), small_problem().noise), x) for s in (0.1, 0.05)]
        assert errors[0] / errors[1] == pytest.approx(ratio, rel=0.15)


def test_erratum_3_the_energy_drifts_with_p_div_v_and_not_without(bed: dc.Problem, corrected: dc.Fit) -> None:
    """On the optimum's path 1/2 |v|^2 + 1/2 |w|^2 should be constant."""
    printed = fitted(bed, printed_divergence=True)
    assert corrected.energy_drift < 0.01
    assert printed.energy_drift > 10 * corrected.energy_drift
    assert printed.energy > corrected.energy
