"""Solvers of the exact model: one optimum, how they stop, and the paper's test bed against reference values."""

from contextlib import suppress
from itertools import pairwise

import pytest
import torch
from fit_bank import random_start, stop_at
from math_bank import K_V, K_W, few_points, normal, planar_two_markers, rr_problem, tensor, two_marker_problem, uniform
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import NumericalError
from diffeo_calib.fitting import gauss_newton
from diffeo_calib.fitting.gauss_newton import Mixing
from diffeo_calib.fitting.problem import Problem, tangent
from diffeo_calib.fitting.result import Fit
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.robots import elastic_rr


@pytest.fixture(scope="module")
def small() -> Fit:
    """An 8 x 8 grid: quick to fit, and deformed as much as the paper's."""
    return dc.fit(rr_problem(8), dc.GaussNewton(), dc.RK4(2))


@pytest.fixture(scope="module")
def fine(small: Fit) -> Fit:
    """The same problem with finer time steps."""
    return dc.fit(small.problem, dc.GaussNewton(), dc.RK4(8), start=small.momenta)


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
    torch.testing.assert_close(fit.momenta.joint[0], matrix.T @ mu, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(fit.momenta.task[0], mu, rtol=1e-12, atol=1e-14)
    assert fit.energy == pytest.approx(0.5 * float(gap @ mu), rel=1e-12)
    assert fit.data_energy == pytest.approx(0.5 * sigma**2 * float(mu @ mu), rel=1e-10)
    assert fit.converged
    assert fit.coupling_residual <= 1e-12
    assert fit.end_residual <= 1e-12
    assert fit.energy_drift <= 1e-14


def test_certificates_improve_with_the_time_steps(small: Fit, fine: Fit) -> None:
    """The residuals of the discretised optimum are time-stepping errors, O(h^4); L-BFGS finds no lower one."""
    assert fine.coupling_residual <= small.coupling_residual / 50
    assert fine.end_residual <= small.end_residual / 50
    assert fine.energy_drift <= small.energy_drift / 50
    assert fine.step_error <= small.step_error / 50
    exact = small.problem.deform(small.momenta, dc.RK4(32)).z1
    assert small.step_error == pytest.approx(float((small.model.deformation.z1 - exact).abs().max()), rel=5e-3)
    after = dc.fit(fine.problem, dc.LBFGS(max_iterations=5), dc.RK4(8), start=fine.momenta)
    assert fine.energy * (1 - 1e-8) <= after.energy <= fine.energy


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
    assert fit.iterations == call * (5 if isinstance(solver, dc.LBFGS) else 1)
    torch.testing.assert_close(fit.model(problem.x), fit.model.deformation.z1, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_the_status_names_what_limits_a_settled_fit() -> None:
    """A tolerance that coarse time steps cannot meet. (For the limit by rounding, see the noise-free calibration.)"""
    problem, solver = rr_problem(3, noise=0.1), dc.GaussNewton(tolerance=0.0, max_iterations=60)
    fits = [dc.fit(problem, solver, integrator) for integrator in (dc.RK4(1), dc.RK4(2), dc.RK8(1))]
    assert all(fit.status.startswith("converged to the accuracy of the time steps: residual ") for fit in fits[:2])
    assert fits[2].end_residual < 1e-3 * fits[1].end_residual < 1e-1 * fits[0].end_residual


def test_a_fit_that_is_stuck_far_from_an_optimum_has_not_converged() -> None:
    """The energy no longer falls, but the end condition is violated by 200 %, with finer time steps too."""
    solver = dc.GaussNewton(tolerance=0.0, max_iterations=60)
    fit = dc.fit(rr_problem(4, noise=0.01), solver, dc.RK4(1))
    assert fit.end_residual > 1.0
    assert not fit.converged
    assert fit.status.startswith("stopped: no step lowers the energy")
    assert "converged" not in fit.status


@pytest.mark.parametrize("integrator", [dc.RK4(2), None], ids=["two steps", "chosen steps"])
def test_noise_too_small_is_one_clear_error(integrator: dc.RK4 | None) -> None:
    """A repeated configuration, and noise that float64 cannot resolve beside the kernels."""
    x = uniform(6, 2, seed=1)
    with pytest.raises(NumericalError, match=r"not positive definite.*raise `noise` or lower the kernels' variances"):
        dc.fit(two_marker_problem(torch.cat([x, x]), 1e-12), dc.GaussNewton(), integrator)


def unguarded() -> Problem:
    """The test bed with a nominal map that accepts NaN."""

    def nominal(x: Tensor) -> Tensor:
        t1, t2 = x[:, 0], x[:, 0] + x[:, 1]
        return torch.stack([t1.cos() + 0.5 * t2.cos(), t1.sin() + 0.5 * t2.sin()], -1)

    x = elastic_rr.grid(3)
    return Problem(nominal, x, elastic_rr.real(x), joint_kernel=K_V, task_kernel=K_W, noise=0.01)


@pytest.mark.parametrize("integrator", [dc.RK4(1), None], ids=["one step", "chosen steps"])
@pytest.mark.parametrize("solver", [dc.GaussNewton(), dc.LBFGS()], ids=["gauss-newton", "lbfgs"])
def test_a_start_with_too_large_flows_is_reported(solver: dc.GaussNewton | dc.LBFGS, integrator: dc.RK4 | None) -> None:
    """With flows too large for their time steps no step helps, and the status says what to change."""
    problem = unguarded()
    if integrator is not None:
        fit = dc.fit(problem, solver, integrator, start=random_start(problem, 3.0))
        assert not fit.converged
        assert "use more time steps" in fit.status
    with suppress(NumericalError):
        assert not dc.fit(problem, solver, integrator, start=random_start(problem, 100.0)).converged


@pytest.mark.slow
def test_lbfgs_descends_from_the_tangent_model_to_the_same_optimum() -> None:
    problem = few_points()
    fit = dc.fit(problem, dc.LBFGS(), dc.RK4(1))
    first = problem.energy(problem.deform(tangent(problem).momenta(), dc.RK4(1))).total
    assert fit.history[0] == pytest.approx(float(first), rel=1e-12)
    assert all(after <= before for before, after in pairwise(fit.history))
    assert fit.converged
    other = dc.fit(problem, dc.GaussNewton(), dc.RK4(1))
    assert fit.energy == pytest.approx(other.energy, rel=1e-9)
    torch.testing.assert_close(fit.momenta.flatten(), other.momenta.flatten(), rtol=0, atol=1e-5)


def momenta(task: Tensor) -> Momenta:
    """Task momenta alone, b and theta that follow from them linearly."""
    return Momenta(2.0 * task[:, :2], task, task.sum(0))


@pytest.mark.parametrize("rates", [[0.3], [0.5, -0.8], [0.9, 0.4, -0.2], [1.5, 0.5]])
def test_a_linear_iteration_ends_after_one_step_for_each_rate(rates: list[float]) -> None:
    """x -> A x + (1 - A) x* from zero, two more steps for start and end; also one that diverges by itself."""
    vectors, fixed = torch.linalg.qr(normal(12, 12, seed=1)).Q, normal(12, seed=2)
    A = vectors[:, : len(rates)] * tensor(rates) @ vectors[:, : len(rates)].T
    mixing, point = Mixing(), momenta(torch.zeros(4, 3, dtype=torch.float64))
    for _ in range(len(rates) + 2):
        target = momenta((A @ (point.task.flatten() - fixed) + fixed).view(-1, 3))
        point = mixing.mixed(point, target) or target
    assert_close(point.flatten(), momenta(fixed.view(-1, 3)).flatten(), rtol=1e-9, atol=1e-9)


def fitted(monkeypatch: pytest.MonkeyPatch, below: float) -> Fit:
    monkeypatch.setattr(gauss_newton, "MIXED_RESIDUAL", below)
    return dc.fit(rr_problem(8), dc.GaussNewton(tolerance=1e-6), dc.RK8(2))


def test_the_optimum_is_the_same_after_fewer_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, mixed = fitted(monkeypatch, 0.0), fitted(monkeypatch, 0.1)
    assert mixed.converged
    assert mixed.iterations < plain.iterations
    assert mixed.energy == pytest.approx(plain.energy, rel=1e-6)


@pytest.mark.slow
def test_default_integrator_is_fine_enough(small: Fit) -> None:
    fit = dc.fit(small.problem)
    assert fit.integrator.intervals in (1, 2, 4, 8)
    assert fit.step_error <= 0.01 * 0.01
    assert fit.end_residual <= 0.05
    assert fit.energy == pytest.approx(small.energy, rel=1e-4)
    assert fit.history[0] == pytest.approx(fit.energy, rel=1e-2)  # every refinement starts from the previous fit
    coarse, fine = (dc.fit(rr_problem(4, noise=sigma)).integrator for sigma in (0.3, 0.003))
    assert isinstance(coarse, dc.RK4)
    assert isinstance(fine, dc.RK8)
    stopped = dc.fit(rr_problem(4, noise=0.1), dc.LBFGS(max_iterations=5))
    assert "limit of 5 iterations" in stopped.status
    assert stopped.integrator.intervals <= 2, "before the optimum, the end residual does not measure the time steps"


@pytest.fixture(scope="module")
def two_steps() -> Fit:
    return dc.fit(rr_problem(16), dc.GaussNewton(), dc.RK4(2))


@pytest.fixture(scope="module")
def four_steps(two_steps: Fit) -> Fit:
    return dc.fit(two_steps.problem, dc.GaussNewton(max_iterations=4), dc.RK4(4), start=two_steps.momenta)


def test_energy_with_two_steps(two_steps: Fit) -> None:
    assert two_steps.converged
    assert two_steps.energy <= 5.6963e-2
    assert two_steps.energy == pytest.approx(5.6962289e-2, rel=1e-6)
    assert two_steps.coupling_residual <= 1e-6


def test_energy_with_four_steps(four_steps: Fit) -> None:
    assert four_steps.energy == pytest.approx(5.6961068e-2, rel=1e-6)
    assert four_steps.coupling_residual <= 1e-6
    assert four_steps.end_residual <= 5e-3
    assert four_steps.field_energy == pytest.approx(5.69582e-2, rel=1e-5)
    squares = float((four_steps.model.deformation.z1 - four_steps.problem.y).square().sum())
    assert squares == pytest.approx(5.649e-10, rel=1e-2)


def test_held_out_error_falls_by_five_orders(two_steps: Fit) -> None:
    x = uniform(3000, 2, seed=0)
    truth = elastic_rr.real(x)
    nominal, fitted = ((guess - truth).norm(dim=1).mean() for guess in (elastic_rr.nominal(x), two_steps.model(x)))
    assert float(nominal) == pytest.approx(0.108, abs=2e-3)
    assert float(torch.log10(nominal / fitted)) >= 5.0


def test_jacobian_of_the_fitted_model(two_steps: Fit) -> None:
    """The exact Jacobian of the model is that of the real arm, which the paper's (18)-(20) do not reach."""
    x = uniform(200, 2, seed=1)
    live = x.clone().requires_grad_()
    real = torch.stack([torch.autograd.grad(elastic_rr.real(live)[:, k].sum(), live)[0] for k in range(2)], 1)
    torch.testing.assert_close(two_steps.model.jacobian(x), real, rtol=0, atol=1e-4)
