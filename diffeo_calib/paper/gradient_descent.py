"""Gradient descent with a fixed step: Algorithm 1 of the paper, kept for comparison.

    P0 <- 0;   repeat   P0 <- P0 - mu grad E(P0)   until |grad E| < epsilon

(R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025,
Listing 1.) The Hessian at zero is G + G R^-1 G: steps beyond 2 / (g + g^2 / sigma^2), with g the largest
eigenvalue of G, diverge, and momenta along small eigenvalues hardly change. The other solvers need thousands of times
fewer evaluations.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from diffeo_calib.common.checks import check_count, check_number
from diffeo_calib.fitting.lbfgs import Descent
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.fitting.result import Progress, Solution, Stop, silent
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.maps.deformation import Momenta

DIVERGED_ENERGY_RATIO = 1e3
"""Energy, relative to the best one, above which a descent with a fixed step counts as diverged."""


@dataclass(frozen=True)
class GradientDescent:
    """Gradient descent with a fixed step, for every formulation.

    Args:
        step: mu, the factor of the gradient.
        tolerance: epsilon: stop when the norm of the gradient is below it (units of 1 / momentum).
        max_iterations: upper bound on steps.
        integrator: time stepping, unless it is passed to :func:`fit`.
    """

    step: float
    tolerance: float = 1e-6
    max_iterations: int = 1000
    integrator: Integrator | None = None

    def __post_init__(self) -> None:
        check_number(self.step, "`step`", above=0.0)
        check_number(self.tolerance, "`tolerance`", above=-1e-300)
        check_count(self.max_iterations, "`max_iterations`")

    def solve(
        self, problem: Problem, integrator: Integrator, start: Momenta | None = None, progress: Progress = silent
    ) -> Solution:
        """Descend from ``start`` (zero by default).

        If the descent diverges or Ctrl-C interrupts it, the best state is kept.
        """
        run = Descent(problem, integrator, start if start is not None else problem.zero())
        run.renew()
        try:
            for iteration in range(self.max_iterations):
                progress("gradient descent", iteration, self.max_iterations)
                if not self._evaluate(run):
                    return run.solution(Stop.DIVERGED)
                size = float(run.gradient.norm())
                if size < self.tolerance:
                    return run.solution(Stop.GRADIENT, measure=size)
                with torch.no_grad():
                    run.variables -= self.step * run.gradient
            self._evaluate(run)
        except KeyboardInterrupt:
            return run.solution(Stop.INTERRUPTED)
        return run.solution(Stop.LIMIT, "raise `max_iterations` or `step`", self.max_iterations)

    def _evaluate(self, run: Descent) -> bool:
        """Evaluate the current momenta; False where the descent has diverged."""
        energy = float(run.closure())
        if run.overflowed:
            return False
        run.history.append(energy)
        run.iterations = len(run.history) - 1
        return energy <= DIVERGED_ENERGY_RATIO * run.best_energy
