"""L-BFGS: the optimum of Gauss-Newton, its best evaluation, overflows and preconditioning."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
import torch
from fit_bank import random_start
from math_bank import few_points, normal, rr_problem

import diffeo_calib as dc
from diffeo_calib.common.errors import NumericalError
from diffeo_calib.fitting.problem import Problem, tangent
from diffeo_calib.fitting.result import Fit
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation

Run = Callable[[Momenta, dc.RK4], GeodesicDeformation]


def test_lbfgs_stays_at_the_gauss_newton_optimum(small: Fit, fine: Fit) -> None:
    after = dc.fit(small.problem, dc.LBFGS(max_iterations=10), dc.RK4(2), start=small.momenta)
    assert after.energy <= small.energy
    assert after.energy == pytest.approx(small.energy, rel=1e-6)
    after = dc.fit(fine.problem, dc.LBFGS(max_iterations=5), dc.RK4(8), start=fine.momenta)
    assert after.energy <= fine.energy
    assert after.energy == pytest.approx(fine.energy, rel=1e-8)


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


def test_lbfgs_keeps_its_best_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupted during a line search: further evaluations never make the result worse."""
    energies = []
    for calls in range(2, 12):  # the first evaluation is the start; the third overshoots
        problem, left = rr_problem(3), [calls]
        deform = problem.deform

        def interrupted(
            momenta: Momenta, integrator: dc.RK4, left: list[int] = left, run: Run = deform
        ) -> GeodesicDeformation:
            left[0] -= 1
            if left[0] == 0:
                raise KeyboardInterrupt
            return run(momenta, integrator)

        start = random_start(problem)
        monkeypatch.setattr(problem, "deform", interrupted)
        energies.append(dc.fit(problem, dc.LBFGS(), dc.RK4(1), start=start).energy)
    assert all(after <= before for before, after in pairwise(energies))
    assert energies[-1] < energies[0]


@pytest.mark.slow
def test_overflowing_steps_of_lbfgs_are_shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the flows overflow, the line search turns back and the descent continues."""
    calls, deform = [0], Problem.deform

    def overflowing(problem: Problem, *arguments: Any, **options: Any) -> GeodesicDeformation:
        calls[0] += 1
        if calls[0] in (5, 6):
            raise NumericalError("too far")
        return deform(problem, *arguments, **options)

    problem, solver = few_points(), dc.LBFGS()
    start = problem.zero()
    start = start.unflatten(0.05 * normal(start.flatten().numel(), seed=9))
    expected = dc.fit(problem, dc.GaussNewton(), dc.RK4(1)).energy
    monkeypatch.setattr(Problem, "deform", overflowing)
    fit = dc.fit(problem, solver, dc.RK4(1), start=start)
    assert calls[0] > 6
    assert fit.energy == pytest.approx(expected, rel=1e-6)
