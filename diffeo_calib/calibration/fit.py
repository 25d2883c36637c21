"""`fit`: one entry for every solver and integrator of the exact model."""

from __future__ import annotations

import time
from typing import Protocol

from diffeo_calib.calibration.gauss_newton import GaussNewton
from diffeo_calib.calibration.problem import Problem
from diffeo_calib.calibration.result import Fit, Progress, Solution, certify, silent, step_error
from diffeo_calib.deformation import Momenta
from diffeo_calib.flows.integrate import RK4

STEP_ERROR = 0.01
"""Largest time-stepping error that is accepted when steps are chosen, in units of the noise."""
END_RESIDUAL = 0.05
"""Largest violation of the end condition (12) that is accepted when steps are chosen."""
MAX_STEPS = 16


class Solver(Protocol):
    """A minimiser of a problem's energy."""

    def solve(
        self, problem: Problem, integrator: RK4, start: Momenta | None = None, progress: Progress = silent
    ) -> Solution:
        """Minimise the energy from ``start``."""
        ...


def fit(
    problem: Problem,
    solver: Solver | None = None,
    integrator: RK4 | None = None,
    *,
    start: Momenta | None = None,
    progress: Progress = silent,
) -> Fit:
    """Fit the exact model k1 = psi o k0 o phi^-1 to a problem's measurements.

    Args:
        problem: data, kernels, noise.
        solver: :class:`GaussNewton` by default.
        integrator: time stepping. By default one step, doubled until its error at the data is below
            1 % of the noise and the end residual below 5 % (at most 16 steps).
        start: initial momenta; the solver's own start by default.
        progress: called as ``progress(task, done, total)``.

    Returns:
        a :class:`Fit`; look at ``status``, ``coupling_residual`` and ``end_residual``.

    Raises:
        NumericalError: the linear algebra broke down (noise too small for the kernels).
    """
    solver = solver if solver is not None else GaussNewton()
    begin = time.perf_counter()
    if integrator is not None:
        solution = solver.solve(problem, integrator, start, progress)
    else:
        solution, integrator = _with_chosen_steps(problem, solver, start, progress)
    return certify(problem, solution, integrator, time.perf_counter() - begin)


def _with_chosen_steps(
    problem: Problem, solver: Solver, start: Momenta | None, progress: Progress
) -> tuple[Solution, RK4]:
    integrator = RK4(1)
    solution = solver.solve(problem, integrator, start, progress)
    while integrator.steps < MAX_STEPS and not solution.interrupted and _too_coarse(problem, solution, integrator):
        integrator = integrator.refined()
        solution = solver.solve(problem, integrator, solution.momenta, progress)
    return solution, integrator


def _too_coarse(problem: Problem, solution: Solution, integrator: RK4) -> bool:
    sigma = float(problem.noise.covariance.diagonal(dim1=-2, dim2=-1).min().sqrt())
    deformation = problem.deform(solution.momenta, integrator)
    fine = step_error(problem, deformation) <= STEP_ERROR * sigma  # False for NaN
    return not (fine and problem.end_residual(deformation) <= END_RESIDUAL)
