"""Fits: one optimum by every solver, how they stop, what is refused, and the paper's test bed by reference values."""

from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from math import nan
from typing import Any, cast

import pytest
import torch
from fit_bank import random_start, stop_at
from math_bank import (
    K_V,
    K_W,
    few_points,
    normal,
    planar_two_markers,
    rows_jacobian,
    rr_problem,
    tensor,
    two_marker_problem,
    uniform,
)
from table_bank import refused
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common import checks
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.fitting import fit as fitting
from diffeo_calib.fitting import gauss_newton
from diffeo_calib.fitting.fit import choose_controls
from diffeo_calib.fitting.gauss_newton import Mixing
from diffeo_calib.fitting.problem import Problem, tangent
from diffeo_calib.fitting.result import Fit
from diffeo_calib.kernels.reductions.fused import FUSED
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.regression.conjugate_gradients import LinearSolver
from diffeo_calib.robots import elastic_rr


@pytest.mark.parametrize(("linear", "controls"), [("cholesky", None), ("cg", None), ("auto", 5)])
def test_fits_that_need_more_memory_than_is_free_are_refused(
    monkeypatch: pytest.MonkeyPatch, linear: LinearSolver, controls: int | None
) -> None:
    monkeypatch.setattr(checks, "free_memory", lambda: 2**10)
    with pytest.raises(
        InputError, match=r"more memory than is free: expected [\d.]+ GiB, got 0\.0 GiB free; fit .*controls=500"
    ):
        dc.fit(rr_problem(5), dc.GaussNewton(linear=linear), dc.RK4(1), controls=controls)
    monkeypatch.setattr(checks, "free_memory", lambda: None)
    checks.check_memory(10**18, "nothing is refused where it is not known")


def test_backend_is_an_argument_and_reported() -> None:
    problem = rr_problem(4)
    fits = {name: dc.fit(problem, integrator=dc.RK4(1), backend=name) for name in ("dense", "tiled", "auto")}
    assert fits["dense"].backend == ("dense", "dense")
    assert fits["tiled"].backend == ("tiled", "tiled")
    small = ("fused", "fused") if not FUSED.trouble() else ("dense", "dense")
    assert fits["auto"].backend == small
    torch.testing.assert_close(fits["tiled"].energy, fits["dense"].energy, rtol=1e-8, atol=0)


def test_integrator_of_the_solver() -> None:
    problem = rr_problem(4)
    own = dc.TorchDiffEq("rk4", step_size=0.5)
    assert dc.fit(problem, dc.GaussNewton(integrator=own)).integrator == own
    assert dc.fit(problem, dc.GaussNewton(integrator=own), own).integrator == own
    with pytest.raises(InputError, match="`integrator`: expected the same for `fit` and its solver"):
        dc.fit(problem, dc.GaussNewton(integrator=own), dc.RK4(2))


TORCHDIFFEQ = [dc.TorchDiffEq("rk4", adjoint=adjoint, step_size=0.25) for adjoint in (False, True)] + [
    dc.TorchDiffEq("dopri5", adjoint=adjoint, step_size=0.5, rtol=1e-6, atol=1e-9) for adjoint in (False, True)
]
SOLVERS = dc.GaussNewton(tolerance=1e-5), dc.LBFGS(tolerance=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "integrator"),
    [*((SOLVERS[0], each) for each in TORCHDIFFEQ), (SOLVERS[1], TORCHDIFFEQ[1])],
    ids=lambda value: getattr(value, "method", type(value).__name__),
)
def test_solvers_find_the_optimum_with_every_integrator(solver: Any, integrator: dc.TorchDiffEq) -> None:
    problem = few_points()
    best = dc.fit(problem, integrator=dc.RK4(8)).energy
    fit = dc.fit(problem, solver, integrator)
    assert fit.converged
    assert fit.energy == pytest.approx(best, rel=1e-5)


def test_arguments_of_the_wrong_kind_are_one_sentence() -> None:
    p, bad, fit = rr_problem(5), "`controls` cannot be read as numbers", cast(Any, dc.fit)

    def controls(value: object) -> Callable[[], object]:
        return lambda: fit(p, controls=value)

    refused(
        ("`problem`: expected a dc.Problem, got Tensor", lambda: fit(p.x)),
        (r"`solver`: expected dc.GaussNewton\(\), dc.LBFGS\(\) or dc.GradientDescent\(", lambda: fit(p, dc.LBFGS)),
        ("`integrator`: expected .*got 'rk4'", lambda: fit(p, integrator="rk4")),
        ("`integrator`: expected", lambda: fit(p, dc.LBFGS(integrator=cast(Any, dc.RK4)))),
        ("`start`: expected momenta, got Problem; pass `fit.momenta`", lambda: fit(p, start=p)),
        ("`start` has 50 value", lambda: fit(p, start=p.zero().unflatten(p.zero().flatten() * nan))),
        (r"`start`: expected shapes .*\(20, 2\).*25", lambda: fit(p, controls=20, start=p.zero())),
        ("`max_iterations`: expected an integer of at least 1", lambda: dc.GaussNewton(max_iterations=-1)),
        ("`tolerance`: expected a number above", lambda: dc.GaussNewton(tolerance=nan)),
        ("`history_size`: expected an integer of at least 1", lambda: dc.LBFGS(history_size=0)),
        ("`preconditioned`: expected True or False", lambda: dc.LBFGS(preconditioned=cast(Any, "x"))),
        ("`steps` of RK8: expected an integer of at least 1 and at most 1024", lambda: dc.RK8(10**9)),
        ("`noise`: expected at least 1e-100 m, got 1e-160", lambda: two_marker_problem(p.x, 1e-160)),
        *(("`controls`: expected 1 to 25", controls(count)) for count in (0, 26)),
        (r"`controls` has the wrong shape.*pass configurations of 2 joints", controls(torch.zeros(3, 3))),
        ("`controls` has 6 value", controls(torch.full((3, 2), nan))),
        (bad, controls("all")),
        (rf"{bad} \(booleans\)", controls(True)),
    )


def test_interrupting_the_start_of_a_coarse_fit_keeps_it() -> None:
    fit = dc.fit(rr_problem(6), integrator=dc.RK4(1), controls=20, progress=stop_at(2))
    assert fit.solution.interrupted
    assert len(fit.model.deformation.x) == 20
    assert "interrupted after 2 iterations" in fit.status


def small_deformations(rows: int = 120) -> Problem:
    """An arm with a fiftieth of the errors of the paper's."""
    x = uniform(rows, 2, seed=3)
    nominal, noise = elastic_rr.nominal(x), 1e-4
    y = nominal + 0.02 * (elastic_rr.real(x) - nominal) + noise * normal(rows, 2, seed=4)
    kernels = {"joint_kernel": K_V.scaled(0.02**2), "task_kernel": K_W.scaled(0.02**2)}
    return Problem(elastic_rr.nominal, x, y, noise=noise, **kernels)  # pyright: ignore[reportArgumentType]


def test_many_rows_start_from_a_sample_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """The controls and the first iterations come from a sample; the optimum is that of all rows."""
    problem = small_deformations()
    monkeypatch.setattr(fitting, "SAMPLE_COORDINATES", 60)
    rows = fitting.sample(problem)
    assert rows is not None
    assert len(rows) == 30
    chosen = choose_controls(problem, 20)
    assert set(chosen.tolist()) <= set(rows.tolist())
    fit = dc.fit(problem, controls=20)
    same = dc.fit(problem, integrator=fit.integrator, controls=problem.x[chosen])  # without a sample
    assert fit.energy == pytest.approx(same.energy, rel=1e-6)
    assert fit.model.x is problem.x


def test_a_fit_ends_when_the_linearised_problem_was_right() -> None:
    """With small deformations the energy falls as the linearised problem says, and no iteration has to confirm it."""
    problem = small_deformations()
    loose, tight = (
        dc.fit(problem, dc.GaussNewton(tolerance=tolerance), dc.RK4(2), controls=20) for tolerance in (1e-4, 1e-12)
    )
    falls = [(a - b) / b for a, b in pairwise(loose.history)]
    assert falls[-1] > 1e-4 >= loose.solution.measure  # the fall itself would ask for one more
    assert 0 <= loose.energy - tight.energy <= 1e-4 * tight.energy


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


def test_the_test_bed_of_the_paper() -> None:
    """Energies of two and of four steps; held-out errors fall by five orders, and the exact Jacobian of the model is
    that of the real arm, which the paper's (18)-(20) do not reach."""
    two = dc.fit(rr_problem(16), dc.GaussNewton(), dc.RK4(2))
    assert two.converged
    assert two.energy <= 5.6963e-2
    assert two.energy == pytest.approx(5.6962289e-2, rel=1e-6)
    four = dc.fit(two.problem, dc.GaussNewton(max_iterations=4), dc.RK4(4), start=two.momenta)
    assert four.energy == pytest.approx(5.6961068e-2, rel=1e-6)
    assert max(two.coupling_residual, four.coupling_residual) <= 1e-6
    assert four.end_residual <= 5e-3
    assert four.field_energy == pytest.approx(5.69582e-2, rel=1e-5)
    squares = float((four.model.deformation.z1 - four.problem.y).square().sum())
    assert squares == pytest.approx(5.649e-10, rel=1e-2)
    x = uniform(3000, 2, seed=0)
    nominal, fitted = ((k(x) - elastic_rr.real(x)).norm(dim=1).mean() for k in (elastic_rr.nominal, two.model))
    assert float(nominal) == pytest.approx(0.108, abs=2e-3)
    assert float(torch.log10(nominal / fitted)) >= 5.0
    x = uniform(200, 2, seed=1)
    torch.testing.assert_close(two.model.jacobian(x), rows_jacobian(elastic_rr.real, x), rtol=0, atol=1e-4)
