"""L-BFGS on the initial momenta P0 = (b, p) and theta: the paper's own route, with exact gradients.

Gradients are backpropagated through the integrator with the Hessian-product adjoint of
flows/geodesic.py, or come from torchdiffeq's adjoint equation. In the momenta themselves the problem
is too ill-conditioned (kernel matrices have condition number 1e13). It is well-conditioned in the variables w,

    (b, p, theta) = origin + M L^-T w,    L L^T = G + R,    M mu = (Theta_0^T mu, Phi_0^T mu, Lambda^-1 (Dpsi S)^T mu),

with G, Theta_0, Phi_0 and S linearised at the origin as in a Gauss-Newton step. These variables span N m of the
N (n + m) directions, so they are renewed around the best momenta from time to time. When they yield no further
progress, the descent ends in the momenta themselves. (Exact normal equations in the momenta are no better far
from the optimum: directions that are flat in the linearised problem are curved in the exact one.)
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import nan

import torch
from torch import Tensor

from diffeo_calib.common.checks import check_count, check_number
from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.fitting.problem import Problem, slope
from diffeo_calib.fitting.result import Progress, Solution, Stop, silent
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.regression.conditional import Process

ITERATIONS_PER_CALL = 5  # iterations per call of torch's optimiser; progress is reported between calls
RENEWAL_ITERATIONS = 40  # iterations after which the preconditioned variables are renewed
OVERFLOW_ENERGY_RATIO = 1e6
"""Energy, relative to the best one, reported for momenta whose flows overflow, so that the line search turns back."""


@dataclass(frozen=True)
class LBFGS:
    """torch.optim.LBFGS with a strong-Wolfe line search.

    Args:
        max_iterations: upper bound on L-BFGS iterations.
        tolerance: stop when the relative fall of the energy in 5 iterations is below it.
        history_size: number of stored update pairs.
        preconditioned: whether to descend in variables in which the linearised problem is well-conditioned (see the
            module), rather than in the momenta; they need a Cholesky factor of (N m)^2 numbers.
        integrator: time stepping, unless it is passed to :func:`fit`.
    """

    max_iterations: int = 200
    tolerance: float = 1e-10
    history_size: int = 50
    preconditioned: bool = True
    integrator: Integrator | None = None

    def __post_init__(self) -> None:
        check_count(self.max_iterations, "`max_iterations`")
        check_count(self.history_size, "`history_size`")
        check_number(self.tolerance, "`tolerance`", above=-1e-300, below=1.0)
        if not isinstance(self.preconditioned, bool):
            raise InputError.of("`preconditioned`", expected="True or False", got=as_written(self.preconditioned))

    def solve(
        self, problem: Problem, integrator: Integrator, start: Momenta | None = None, progress: Progress = silent
    ) -> Solution:
        """Minimise the energy from ``start``; by default from :meth:`Problem.start`.

        Steps whose flows overflow are shortened. Ctrl-C stops early and keeps the best state.

        Raises:
            NumericalError: the flows of the start overflow.
        """
        begin, evaluations = (start, 0) if start is not None else problem.start(integrator)
        run = Descent(problem, integrator, begin, self.history_size, evaluations=evaluations)
        run.begin()
        try:
            return self._iterate(run, progress)
        except KeyboardInterrupt:
            return run.solution(Stop.INTERRUPTED)

    def _iterate(self, run: Descent, progress: Progress) -> Solution:
        renewal: bool | None = self.preconditioned
        while run.iterations < self.max_iterations:
            progress("L-BFGS", run.iterations, self.max_iterations)
            if renewal is not None:
                run.renew(preconditioned=renewal)
            before = run.best_energy
            run.optimizer.step(run.closure)  # pyright: ignore[reportArgumentType]
            run.history.append(run.best_energy)
            run.iterations = run.renewed + int(run.optimizer.state[run.variables]["n_iter"])
            settled = before - run.best_energy <= self.tolerance * abs(run.best_energy)
            if settled and run.factor is None:
                return run.solution(Stop.ENERGY)
            due = run.factor is not None and (settled or run.age >= RENEWAL_ITERATIONS)
            renewal = not (settled and run.age <= ITERATIONS_PER_CALL) if due else None
        advice = "raise `max_iterations`" + (" or start from Gauss-Newton" if run.problem.certified else "")
        return run.solution(Stop.LIMIT, advice, self.max_iterations)


@dataclass
class Descent:
    """State of one solve: the optimiser's variables and the best momenta."""

    problem: Problem
    integrator: Integrator
    best: Momenta
    history_size: int = 0
    history: list[float] = field(default_factory=list)
    iterations: int = 0
    evaluations: int = 0
    best_energy: float = float("inf")
    overflowed: bool = False

    @property
    def age(self) -> int:
        """Iterations since the variables were renewed."""
        return self.iterations - self.renewed

    @property
    def gradient(self) -> Tensor:
        """Gradient of the energy by the variables, after :meth:`closure`."""
        return self.variables.grad  # pyright: ignore[reportReturnType]

    def begin(self) -> None:
        """Evaluate the start."""
        self._note(self.best, float(self.problem.energy(self.problem.deform(self.best, self.integrator)).total))
        self.history.append(self.best_energy)

    def renew(self, preconditioned: bool = False) -> None:
        """Choose new variables around the best momenta."""
        self.origin, self.renewed = self.best.flatten().detach(), self.iterations
        self.factor: Process | None = None
        self.variables = self.origin.clone().requires_grad_()
        if preconditioned:
            self.factor = self.problem.preconditioner(self.best, self.integrator)
            self.variables = torch.zeros_like(self.factor.alpha, requires_grad=True)
        self.optimizer = torch.optim.LBFGS(
            [self.variables],
            max_iter=ITERATIONS_PER_CALL,
            max_eval=5 * ITERATIONS_PER_CALL,
            tolerance_grad=0.0,
            tolerance_change=0.0,
            history_size=self.history_size,
            line_search_fn="strong_wolfe",
        )

    def momenta(self) -> Momenta:
        """The optimiser's variables as momenta."""
        if self.factor is None:
            return self.best.unflatten(self.variables)
        change = self.problem.unknowns(self.factor.of_white(self.variables))
        return self.best.unflatten(self.origin + change.flatten())

    def closure(self) -> Tensor:
        """Energy at the optimiser's variables; stores their gradient in ``grad``."""
        with torch.enable_grad():
            momenta = self.momenta()
        energy_and_slope = slope(self.problem, self.integrator, momenta, self.variables)
        self.overflowed = energy_and_slope is None
        if energy_and_slope is None:
            self.evaluations += 1
            self.variables.grad = torch.zeros_like(self.variables)
            return self.origin.new_tensor(OVERFLOW_ENERGY_RATIO * (abs(self.best_energy) + 1.0))
        total, self.variables.grad = energy_and_slope
        self._note(momenta, float(total))
        return total

    def _note(self, momenta: Momenta, energy: float) -> None:
        self.evaluations += 1
        if energy < self.best_energy:
            self.best_energy = energy
            self.best = Momenta(*(t.detach().clone() for t in momenta.tensors))

    def solution(self, stop: Stop, advice: str = "", limit: int = 0, measure: float = nan) -> Solution:
        """The best state and the reason to stop."""
        done = (self.history, self.iterations, self.evaluations)
        return Solution(self.best, stop, *done, measure=measure, limit=limit, advice=advice)
