"""Solvers of the exact model: Gauss-Newton and L-BFGS find the same optimum, and say how they stopped."""

from collections.abc import Callable
from itertools import pairwise

import pytest
import torch
from math_bank import (
    K_V,
    K_W,
    normal,
    planar_two_markers,
    rr_problem,
    tensor,
    two_marker_problem,
    uniform,
)

import diffeo_calib as dc
from diffeo_calib.calibration.problem import Problem
from diffeo_calib.calibration.result import Fit
from diffeo_calib.calibration.tangent import tangent
from diffeo_calib.deformation import Momenta
from diffeo_calib.errors import NumericalError


@pytest.fixture(scope="module")
def small() -> Fit:
    """A 5 x 5 grid: quick, and deformed as much as the paper's."""
    return dc.fit(rr_problem(5, noise=0.05), dc.GaussNewton(), dc.RK4(2))


def random_start(problem: Problem, size: float = 0.02) -> Momenta:
    zero = problem.zero()
    return zero.unflatten(size * normal(zero.flatten().numel(), seed=21))


def test_one_point_in_closed_form() -> None:
    """One measurement: straight geodesics, and a quadratic energy when k0 is linear."""
    matrix, offset, sigma = tensor([[1.0, 0.4], [-0.3, 0.8]]), tensor([0.2, -0.1]), 0.1
    x, y = tensor([[0.3, -0.5]]), tensor([[1.2, 0.4]])
    problem = Problem(
        lambda q: q @ matrix.T + offset,
        x,
        y,
        joint_kernel=dc.Gaussian(0.7, 0.5),
        task_kernel=dc.Matern(0.4, 2.5, 0.3),
        noise=sigma,
    )
    # z1 = k0(x + v b) + w p; stationary: mu = (v A A^T + w I + sigma^2 I)^-1 (y - k0), b = A^T mu, p = mu.
    gap = (y - x @ matrix.T - offset)[0]
    eye = torch.eye(2, dtype=torch.float64)
    mu = torch.linalg.solve(0.5 * matrix @ matrix.T + (0.3 + sigma**2) * eye, gap)
    fit = dc.fit(problem, dc.GaussNewton(), dc.RK4(1))
    torch.testing.assert_close(fit.momenta.x[0], matrix.T @ mu, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(fit.momenta.y[0], mu, rtol=1e-12, atol=1e-14)
    assert fit.energy == pytest.approx(0.5 * float(gap @ mu), rel=1e-12)
    assert fit.data_energy == pytest.approx(0.5 * sigma**2 * float(mu @ mu), rel=1e-10)
    assert fit.converged
    assert fit.coupling_residual <= 1e-12
    assert fit.end_residual <= 1e-12
    assert fit.energy_drift <= 1e-14


def test_certificates_of_a_converged_fit(small: Fit) -> None:
    assert small.converged
    assert small.status.startswith("converged")
    assert small.coupling_residual <= 1e-4
    assert small.end_residual <= 1e-3
    assert small.energy == pytest.approx(small.field_energy + small.data_energy, rel=1e-12)
    assert small.energy == pytest.approx(small.history[-1], rel=1e-12)
    assert small.iterations == len(small.history) - 1 < small.evaluations + 1
    assert small.energy_drift <= 1e-4
    assert small.integrator == dc.RK4(2)


def test_certificates_improve_with_the_time_steps(small: Fit) -> None:
    """The residuals of the discretised optimum are time-stepping errors, O(h^4)."""
    fine = dc.fit(small.problem, dc.GaussNewton(), dc.RK4(8), start=small.momenta)
    assert fine.coupling_residual <= small.coupling_residual / 50
    assert fine.end_residual <= small.end_residual / 50
    assert fine.energy_drift <= small.energy_drift / 50
    assert fine.step_error <= small.step_error / 50


def test_step_error_is_an_error_of_the_end_points(small: Fit) -> None:
    exact = small.problem.deform(small.momenta, dc.RK4(32)).z1
    error = float((small.model.deformation.z1 - exact).abs().max())
    assert small.step_error == pytest.approx(error, rel=0.1)


def test_history_never_rises_beyond_the_flatness(small: Fit) -> None:
    for before, after in pairwise(small.history):
        assert after <= before * (1 + 1e-6)
    assert small.history[-1] < 1e-2 * small.history[0]


def test_optimum_does_not_depend_on_the_start(small: Fit) -> None:
    for start in (tangent(small.problem).momenta(), random_start(small.problem)):
        other = dc.fit(small.problem, dc.GaussNewton(), dc.RK4(2), start=start)
        assert other.converged
        assert other.energy == pytest.approx(small.energy, rel=1e-7)
        torch.testing.assert_close(other.momenta.x, small.momenta.x, rtol=0, atol=2e-5 * float(small.momenta.x.norm()))
        torch.testing.assert_close(other.momenta.y, small.momenta.y, rtol=0, atol=2e-5 * float(small.momenta.y.norm()))


def test_gauss_newton_optimum_is_stationary() -> None:
    """The gradient of the discretised energy, measured against its own start, vanishes at the optimum."""
    problem = rr_problem(5, noise=0.05)
    fit = dc.fit(problem, dc.GaussNewton(), dc.RK4(8))

    def gradient(momenta: Momenta) -> torch.Tensor:
        live = momenta.flatten().requires_grad_()
        total = problem.energy(problem.deform(momenta.unflatten(live), dc.RK4(8))).total
        return torch.autograd.grad(total, live)[0]

    assert float(gradient(fit.momenta).norm()) <= 1e-7 * float(gradient(problem.zero()).norm())


def test_lbfgs_stays_at_the_gauss_newton_optimum(small: Fit) -> None:
    after = dc.fit(small.problem, dc.LBFGS(max_iterations=10), dc.RK4(2), start=small.momenta)
    assert after.energy <= small.energy
    assert after.energy == pytest.approx(small.energy, rel=2e-5)
    fine = dc.fit(small.problem, dc.GaussNewton(), dc.RK4(8), start=small.momenta)
    after = dc.fit(small.problem, dc.LBFGS(max_iterations=5), dc.RK4(8), start=fine.momenta)
    assert after.energy == pytest.approx(fine.energy, rel=1e-8)


def test_lbfgs_descends_from_the_tangent_model_to_the_same_optimum() -> None:
    """With few points and much noise the problem is well enough conditioned for L-BFGS to finish."""
    problem = rr_problem(3, noise=0.3)
    fit = dc.fit(problem, dc.LBFGS(max_iterations=100), dc.RK4(4))
    first = problem.energy(problem.deform(tangent(problem).momenta(), dc.RK4(4))).total
    assert fit.history[0] == pytest.approx(float(first), rel=1e-12)
    assert all(after <= before for before, after in pairwise(fit.history))
    assert fit.converged
    assert fit.energy == pytest.approx(dc.fit(problem, dc.GaussNewton(), dc.RK4(4)).energy, rel=1e-6)


def test_several_markers() -> None:
    problem = two_marker_problem(20)
    fit = dc.fit(problem, dc.GaussNewton(), dc.RK4(4))
    assert fit.converged
    assert fit.coupling_residual <= 1e-6
    x = uniform(300, 2, seed=30)
    truth = planar_two_markers(x, (1.03, 0.49), 0.03)
    before, after = (float((guess - truth).norm(dim=1).mean()) for guess in (planar_two_markers(x), fit.model(x)))
    assert after <= before / 30
    assert fit.model(x).shape == (300, 4)
    assert fit.model.jacobian(x).shape == (300, 4, 2)


def test_noise_blocks_weigh_the_rows() -> None:
    """A row with a thousand times the noise no longer matters; nor does it pull the others."""
    covariance = (0.01**2 * torch.eye(4, dtype=torch.float64)).repeat(12, 1, 1)
    covariance[5] *= 1e6
    wrong = two_marker_problem(12, covariance)
    wrong.y[5] += 1.0
    fit = dc.fit(wrong, dc.GaussNewton(), dc.RK4(2))
    rest = [i for i in range(12) if i != 5]
    assert float((fit.model(wrong.x) - wrong.y)[rest].abs().max()) <= 1e-3
    assert float((fit.model(wrong.x) - wrong.y)[5].abs().max()) >= 0.5


def test_data_without_error_need_no_deformation() -> None:
    x = uniform(8, 2, seed=3)
    problem = Problem(
        planar_two_markers, x, planar_two_markers(x), joint_kernel=K_V, task_kernel=K_W, noise=0.01, markers=2
    )
    for solver in (dc.GaussNewton(), dc.LBFGS()):
        fit = dc.fit(problem, solver, dc.RK4(1))
        assert fit.converged
        assert fit.energy <= 1e-25
        torch.testing.assert_close(fit.model(x), planar_two_markers(x), rtol=0, atol=1e-15)


def test_default_integrator_is_fine_enough(small: Fit) -> None:
    fit = dc.fit(small.problem)
    assert fit.integrator.steps in (1, 2, 4, 8)
    assert fit.step_error <= 0.01 * 0.05
    assert fit.end_residual <= 0.05
    assert fit.energy == pytest.approx(small.energy, rel=1e-3)


def test_smaller_noise_asks_for_more_steps() -> None:
    steps = [dc.fit(rr_problem(4, noise=sigma)).integrator.steps for sigma in (0.3, 0.001)]
    assert steps[0] < steps[1]


def stop_at(call: int) -> Callable[[str, int, int], None]:
    calls = []

    def progress(task: str, done: int, total: int) -> None:
        calls.append((task, done, total))
        if len(calls) > call:
            raise KeyboardInterrupt

    return progress


@pytest.mark.parametrize("call", [0, 2])
@pytest.mark.parametrize("solver", [dc.GaussNewton(), dc.LBFGS(tolerance=0.0)], ids=["gauss-newton", "lbfgs"])
@pytest.mark.parametrize("integrator", [dc.RK4(1), None], ids=["one step", "chosen steps"])
def test_interruption_keeps_the_best_state(solver: dc.GaussNewton | dc.LBFGS, call: int, integrator: dc.RK4) -> None:
    problem = rr_problem(3, noise=0.1)
    fit = dc.fit(problem, solver, integrator, progress=stop_at(call))
    assert fit.status.startswith("interrupted after")
    assert "best state so far is kept" in fit.status
    assert not fit.converged
    assert fit.solution.interrupted
    assert fit.energy == pytest.approx(min(fit.history), rel=1e-12)
    assert fit.iterations == call
    torch.testing.assert_close(fit.model(problem.x), fit.model.deformation.z1, rtol=0, atol=1e-13)


@pytest.mark.parametrize("solver", [dc.GaussNewton(max_iterations=2), dc.LBFGS(max_iterations=5, tolerance=0.0)])
def test_limit_of_iterations_is_reported(solver: dc.GaussNewton | dc.LBFGS) -> None:
    fit = dc.fit(rr_problem(3, noise=0.1), solver, dc.RK4(1))
    assert "raise `max_iterations`" in fit.status
    assert not fit.converged


def test_progress_counts_up() -> None:
    calls: list[tuple[str, int, int]] = []
    dc.fit(
        rr_problem(3, noise=0.1),
        dc.GaussNewton(max_iterations=9),
        dc.RK4(1),
        progress=lambda task, done, total: calls.append((task, done, total)),
    )
    assert [done for _, done, _ in calls] == list(range(len(calls)))
    assert {(task, total) for task, _, total in calls} == {("Gauss-Newton", 9)}


@pytest.mark.parametrize("integrator", [dc.RK4(2), None], ids=["two steps", "chosen steps"])
def test_noise_too_small_is_one_clear_error(integrator: dc.RK4 | None) -> None:
    with pytest.raises(NumericalError, match=r"not positive definite.*raise `noise` or lower the kernels' variances"):
        dc.fit(rr_problem(16, noise=1e-10), dc.GaussNewton(), integrator)


def test_a_hopeless_start_is_reported() -> None:
    """Flows too violent for their time steps: no step helps, and the status says what to change."""
    problem = rr_problem(3)
    fit = dc.fit(problem, dc.GaussNewton(), dc.RK4(1), start=random_start(problem, 1e3))
    assert not fit.converged
    assert "use more time steps" in fit.status
