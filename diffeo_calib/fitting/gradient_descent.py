"""Gradient descent with a fixed step: Algorithm 1 of the paper, kept for comparison.

    P0 <- 0;   repeat   P0 <- P0 - mu grad E(P0)   until |grad E| < epsilon

(R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025,
Listing 1.) The Hessian at zero is G + G R^-1 G (tangent.py): steps beyond 2 / (g + g^2 / sigma^2), with g the largest
eigenvalue of G, diverge, and momenta along small eigenvalues hardly change. The other solvers need thousands of times
fewer evaluations.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import nan

from torch import Tensor

from diffeo_calib.common.checks import check_count, check_number
from diffeo_calib.fitting.objective import Objective, slope
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
        self, problem: Objective, integrator: Integrator, start: Momenta | None = None, progress: Progress = silent
    ) -> Solution:
        """Descend from ``start`` (zero by default).

        If the descent diverges or Ctrl-C interrupts it, the best state is kept.
        """
        run = _Run(problem, integrator, start if start is not None else problem.zero())
        try:
            for iteration in range(self.max_iterations):
                progress("gradient descent", iteration, self.max_iterations)
                gradient = run.evaluate()
                if gradient is None:
                    return run.solution(Stop.DIVERGED)
                size = float(gradient.norm())
                if size < self.tolerance:
                    return run.solution(Stop.GRADIENT, size)
                run.at = run.at - self.step * gradient
            run.evaluate()
        except KeyboardInterrupt:
            return run.solution(Stop.INTERRUPTED)
        return run.solution(Stop.LIMIT, limit=self.max_iterations, advice="raise `max_iterations` or `step`")


class _Run:
    """State of one solve: current momenta, best momenta and their energy."""

    def __init__(self, problem: Objective, integrator: Integrator, start: Momenta) -> None:
        self.problem, self.integrator, self.shape = problem, integrator, start
        self.at = self.best = start.flatten().detach()
        self.best_energy = float("inf")
        self.history: list[float] = []
        self.evaluations = 0

    def evaluate(self) -> Tensor | None:
        """The gradient at the current momenta, or None where the descent has diverged."""
        variables = self.at.clone().requires_grad_()
        found = slope(self.problem, self.integrator, self.shape.unflatten(variables), variables)
        self.evaluations += 1
        if found is None:
            return None
        energy, gradient = float(found[0]), found[1]
        self.history.append(energy)
        if energy < self.best_energy:
            self.best, self.best_energy = self.at, energy
        return gradient if energy <= DIVERGED_ENERGY_RATIO * self.best_energy else None

    def solution(self, stop: Stop, measure: float = nan, *, limit: int = 0, advice: str = "") -> Solution:
        """The best state and the reason to stop."""
        momenta, iterations = self.shape.unflatten(self.best), max(len(self.history) - 1, 0)
        done = (self.history, iterations, self.evaluations)
        return Solution(momenta, stop, *done, measure=measure, limit=limit, advice=advice)
