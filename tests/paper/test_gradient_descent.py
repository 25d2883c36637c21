"""Gradient descent with a fixed step: convergence, divergence, limits and interruptions."""

from __future__ import annotations

from itertools import pairwise

import pytest
from fit_bank import stop_at
from math_bank import few_points

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError

STEP = 0.05


@pytest.mark.slow
@pytest.mark.parametrize(("formulation", "step", "tolerance"), [("exact", 0.15, 1e-3), ("eulerian", 0.05, 3e-3)])
def test_finds_the_optimum_of_an_easy_problem(formulation: str, step: float, tolerance: float) -> None:
    problem = few_points()
    solver = dc.GradientDescent(step=step, tolerance=tolerance, max_iterations=300)
    fit = dc.fit(problem, solver, dc.RK4(1), formulation=formulation)  # pyright: ignore[reportArgumentType]
    best = dc.fit(problem, dc.LBFGS(max_iterations=40), dc.RK4(1), formulation=formulation)  # pyright: ignore[reportArgumentType]
    assert fit.converged
    assert fit.status.startswith("converged: gradient")
    assert fit.energy == pytest.approx(best.energy, rel=2e-3)
    assert all(after <= before for before, after in pairwise(fit.history))
    assert fit.history[0] == pytest.approx(float(problem.energy(problem.deform(problem.zero(), dc.RK4(1))).total))


@pytest.mark.parametrize(("formulation", "step"), [("exact", 100.0), ("eulerian", 1e30)])
def test_too_long_a_step_diverges_and_says_so(formulation: str, step: float) -> None:
    solver = dc.GradientDescent(step=step)
    fit = dc.fit(few_points(), solver, dc.RK4(1), formulation=formulation)  # pyright: ignore[reportArgumentType]
    assert not fit.converged
    assert "diverged" in fit.status
    assert "lower `step`" in fit.status
    assert fit.iterations == len(fit.history) - 1
    assert fit.energy == pytest.approx(min(fit.history), rel=1e-12)


def test_limit_and_interruption_keep_the_best_state() -> None:
    fit = dc.fit(few_points(), dc.GradientDescent(step=STEP, max_iterations=3), dc.RK4(1))
    assert "raise `max_iterations`" in fit.status
    assert fit.solution.exhausted
    assert fit.iterations == 3
    assert fit.energy == pytest.approx(fit.history[-1], rel=1e-12)
    again = dc.fit(fit.problem, dc.GradientDescent(step=STEP, max_iterations=1), dc.RK4(1), start=fit.momenta)
    assert again.history[0] == pytest.approx(fit.energy, rel=1e-12)

    fit = dc.fit(few_points(), dc.GradientDescent(step=STEP), dc.RK4(1), progress=stop_at(2))
    assert fit.solution.interrupted
    assert fit.energy == pytest.approx(min(fit.history), rel=1e-12)


@pytest.mark.parametrize(
    "arguments",
    [{"step": 0.0}, {"step": -1.0}, {"step": 1.0, "tolerance": -1.0}, {"step": 1.0, "max_iterations": 0}],
)
def test_wrong_settings(arguments: dict[str, float]) -> None:
    with pytest.raises(InputError, match=r"`(step|tolerance|max_iterations)`: expected"):
        dc.GradientDescent(**arguments)  # pyright: ignore[reportArgumentType]
