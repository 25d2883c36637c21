"""`fit`: one entry for every solver and integrator of the exact model."""

from __future__ import annotations

import time
from math import log2
from typing import Protocol

from diffeo_calib.calibration.gauss_newton import GaussNewton
from diffeo_calib.calibration.problem import Problem
from diffeo_calib.calibration.result import END_RESIDUAL, Fit, Progress, Solution, certify, silent, step_error
from diffeo_calib.deformation import Momenta
from diffeo_calib.errors import NumericalError
from diffeo_calib.flows.integrate import RK4

STEP_ERROR = 0.01
"""Largest time-stepping error that is accepted when steps are chosen, in units of the noise."""
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
    if start is not None:
        integrator = _enough_steps(problem, start, integrator)
    while True:
        solution = solver.solve(problem, integrator, start, progress)
        wanted = _enough_steps(problem, solution.momenta, integrator)
        if solution.interrupted or wanted == integrator:
            return solution, integrator
        start, integrator = solution.momenta, wanted


def _enough_steps(problem: Problem, momenta: Momenta, integrator: RK4) -> RK4:
    """The method with as many steps as the errors at these momenta ask for, by their order 4."""
    try:
        deformation = problem.deform(momenta, integrator)
    except NumericalError:  # these steps are so long that the flows overflow
        return RK4(MAX_STEPS)
    sigma = float(problem.noise.covariance.diagonal(dim1=-2, dim2=-1).min().sqrt())
    excess = max(
        step_error(problem, deformation) / (STEP_ERROR * sigma), problem.end_residual(deformation) / END_RESIDUAL
    )
    doublings = 0 if excess <= 1.0 else max(1, round(0.25 * log2(excess if excess < 1e12 else 1e12)))
    return RK4(min(MAX_STEPS, integrator.steps * 2**doublings)) if integrator.steps < MAX_STEPS else integrator
