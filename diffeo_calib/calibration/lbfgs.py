"""L-BFGS on the initial momenta P0 = (b, p) and theta: the paper's own route, kept as a check.

Gradients are backpropagated through the integrator with the Hessian-product adjoint of
flows/hamiltonian.py. From zero the problem is hopelessly ill-conditioned (kernel matrices have
condition number 1e13), so the start is the tangent solution, or a Gauss-Newton iterate.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from diffeo_calib.calibration.problem import Problem
from diffeo_calib.calibration.result import Progress, Solution, silent
from diffeo_calib.calibration.tangent import tangent
from diffeo_calib.deformation import Momenta
from diffeo_calib.errors import NumericalError
from diffeo_calib.flows.integrate import Integrator

ITERATIONS_PER_CALL = 5
"""torch's optimiser is called in short bursts, between which progress is shown."""


@dataclass(frozen=True)
class LBFGS:
    """torch.optim.LBFGS with a strong-Wolfe line search.

    Args:
        max_iterations: upper bound on L-BFGS iterations.
        tolerance: stop when the relative fall of the energy in one burst is below it.
        history_size: number of remembered pairs.
    """

    max_iterations: int = 200
    tolerance: float = 1e-10
    history_size: int = 50

    def solve(
        self, problem: Problem, integrator: Integrator, start: Momenta | None = None, progress: Progress = silent
    ) -> Solution:
        """Minimise the energy from ``start`` (the tangent solution by default).

        Ctrl-C ends it early with the best state found, as does a step so long that the flows overflow.
        """
        start = start if start is not None else tangent(problem).momenta()
        run = _Run(problem, integrator, start)
        optimizer = torch.optim.LBFGS(
            [run.vector],
            max_iter=ITERATIONS_PER_CALL,
            max_eval=5 * ITERATIONS_PER_CALL,
            tolerance_grad=0.0,
            tolerance_change=0.0,
            history_size=self.history_size,
            line_search_fn="strong_wolfe",
        )
        try:
            run.history.append(run.evaluate(start.flatten()))
            return self._iterate(run, optimizer, progress)
        except KeyboardInterrupt:
            return run.solution(
                f"interrupted after {run.evaluations} evaluations: the best state so far is kept",
                False,
                interrupted=True,
            )
        except NumericalError as error:
            if run.best_energy == float("inf"):
                raise
            return run.solution(f"stopped: {error}", False)

    def _iterate(self, run: _Run, optimizer: torch.optim.LBFGS, progress: Progress) -> Solution:
        for iteration in range(0, self.max_iterations, ITERATIONS_PER_CALL):
            progress("L-BFGS", iteration, self.max_iterations)
            before = run.best_energy
            optimizer.step(run.closure)  # pyright: ignore[reportArgumentType]
            run.history.append(run.best_energy)
            if before - run.best_energy <= self.tolerance * abs(run.best_energy):
                return run.solution(f"converged: the energy no longer falls after {run.evaluations} evaluations", True)
        advice = "raise `max_iterations` or start from Gauss-Newton"
        return run.solution(f"stopped at the limit of {self.max_iterations} iterations: {advice}", False)


@dataclass
class _Run:
    """State of one solve: the optimiser's variables and the best momenta met."""

    problem: Problem
    integrator: Integrator
    start: Momenta
    history: list[float] = field(default_factory=list)
    evaluations: int = 0
    best_energy: float = float("inf")

    def __post_init__(self) -> None:
        self.vector = self.start.flatten().clone().requires_grad_()
        self.best = self.start

    def evaluate(self, vector: Tensor) -> float:
        """Energy without its gradient."""
        with torch.no_grad():
            return float(self._energy(vector))

    def _energy(self, vector: Tensor) -> Tensor:
        momenta = self.start.unflatten(vector)
        total = self.problem.energy(self.problem.deform(momenta, self.integrator)).total
        self.evaluations += 1
        value = float(total.detach())
        if value < self.best_energy:
            self.best_energy = value
            self.best = Momenta(*(t.detach().clone() for t in momenta.tensors))
        return total

    def closure(self) -> Tensor:
        """Energy at the optimiser's variables, their gradient left in ``grad``."""
        with torch.enable_grad():
            total = self._energy(self.vector)
            (self.vector.grad,) = torch.autograd.grad(total, self.vector)
        return total.detach()

    def solution(self, status: str, converged: bool, *, interrupted: bool = False) -> Solution:
        """The best state met, with the reason to stop."""
        return Solution(self.best, status, converged, self.history, self.evaluations, interrupted)
