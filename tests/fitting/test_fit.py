"""The arguments of `fit`: solvers, integrators, backends, fewer control points, and what it refuses."""

from collections.abc import Callable
from itertools import pairwise
from math import nan
from typing import Any, cast

import pytest
import torch
from fit_bank import stop_at
from math_bank import K_V, K_W, few_points, normal, rr_problem, two_marker_problem, uniform
from table_bank import refused

import diffeo_calib as dc
from diffeo_calib.common import checks
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting import fit as fitting
from diffeo_calib.fitting.fit import choose_controls
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.kernels.reductions.fused import FUSED
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
