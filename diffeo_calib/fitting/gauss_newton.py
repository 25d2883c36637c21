"""Gauss-Newton in path space: the default solver of the exact model, which needs forward passes only.

Around the current flows every field value along the path moves the end point linearly. Minimising the
energy of this linearised problem is one Gaussian regression (tangent.py), whose mu is the momentum at
time 1. Transported back to time 0 it gives the next (b, p, theta):

    mu = (G + R)^-1 (y - z1 + sum_s c_s Theta_s v_s + sum_t c_t Phi_t w_t + Dpsi S theta)
    b <- Theta_0^T mu,   p <- Phi_0^T mu,   theta <- Lambda^-1 (Dpsi S)^T mu

The first iterate from zero is exactly the tangent model. Near the optimum the steps are mixed with earlier ones
(:class:`Mixing`), which saves a fifth to a half of the factorisations. Large problems solve for mu by conjugate
gradients; with fewer control points than data the momenta themselves are the unknowns (regression/). Geodesics
of few control points do not include all paths, so this step is approximate: with large deformations it can stop
before the optimum, and the status then says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import inf

import torch
from torch import Tensor

from diffeo_calib.common.checks import check_count, check_number
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.fitting.problem import Problem, linear_optimum
from diffeo_calib.fitting.result import MAX_END_RESIDUAL, NEGLIGIBLE_ENERGY, Progress, Solution, Stop, silent
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.maps.deformation import Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.regression.conjugate_gradients import CG_TOLERANCE, LinearSolver, choose

SHORTEST_STEP = 1e-3  # smallest fraction of a Gauss-Newton step that is tried
INNER_TOLERANCE_RATIO = 1e-3  # tolerance of conjugate gradients, relative to that of the iteration
SETTLED_RESIDUAL_RATIO = 0.95
"""Where the energy is flat, a residual that falls to no less than this fraction has settled."""
STEP_ERROR_SHARE = 0.1  # relative change of a settled residual with finer time steps from which the time steps limit it
MIXED_RESIDUAL = 0.1
"""Residual below which steps are mixed with earlier ones: before, the map of steps is not nearly linear."""
MIXING_DEPTH = 5  # number of differences between steps that are kept
FLAT_ENERGY_RISE = 1e-7
"""Relative rise of the energy that still counts as flat: the fixed point of the discretised iteration and
the minimiser of the discretised energy differ by the time-stepping error."""


@dataclass(frozen=True)
class GaussNewton:
    """Gauss-Newton with steps that are halved until the energy falls.

    Args:
        max_iterations: upper bound on factorisations.
        tolerance: stop when coupling and end residual are both below it (with fewer control points than data, when
            the relative fall of the energy is, or its difference from that of the linearised problem).
        linear: "cholesky" of the matrix, conjugate gradients "cg" on kernel sums, or "auto" by size; not used with
            fewer control points than data.
        integrator: time stepping, unless it is passed to :func:`fit`.
    """

    max_iterations: int = 30
    tolerance: float = 1e-8
    linear: LinearSolver = "auto"
    integrator: Integrator | None = None

    def __post_init__(self) -> None:
        check_count(self.max_iterations, "`max_iterations`")
        check_number(self.tolerance, "`tolerance`", above=-1e-300, below=1.0)
        choose(self.linear, 1)

    def solve(
        self, problem: Problem, integrator: Integrator, start: Momenta | None = None, progress: Progress = silent
    ) -> Solution:
        """Minimise the energy from ``start`` (zero by default).

        Ctrl-C stops early and keeps the best state.

        Raises:
            InputError: a problem in the Eulerian formulation, which has no linearisation.
            NumericalError: the first factorisation fails.
        """
        if not problem.certified:
            what = "Gauss-Newton needs a linearisation, which the Eulerian formulation does not have"
            raise InputError.of(what, fix="use dc.LBFGS() or dc.GradientDescent(step=...)")
        run = _Run(problem, integrator, start if start is not None else problem.zero(), self.linear)
        try:
            for iteration in range(self.max_iterations):
                progress("Gauss-Newton", iteration, self.max_iterations)
                stop = run.advance(self.tolerance)
                if stop:
                    advice = "continue with dc.LBFGS() from `start=fit.momenta`, or use more "
                    advice += "control points" if problem.reduced else "time steps or larger noise"
                    return run.solution(stop, "" if stop.converged else advice)
        except KeyboardInterrupt:
            return run.solution(Stop.INTERRUPTED)
        return run.solution(Stop.LIMIT, "raise `max_iterations`", self.max_iterations)


class _Run:
    """State of one solve: the current deformation, its energy and residual."""

    def __init__(self, problem: Problem, integrator: Integrator, start: Momenta, linear: LinearSolver) -> None:
        self.problem, self.integrator = problem, integrator
        self.linear: LinearSolver = linear
        self.deformation = problem.deform(start, integrator, variational=True)
        self.history = [float(problem.energy(self.deformation).total)]
        self.residual = self._residual(self.deformation)
        self.evaluations = 1
        self.mixing = Mixing()

    @property
    def iterations(self) -> int:
        """Accepted iterations."""
        return len(self.history) - 1

    def advance(self, tolerance: float) -> Stop | None:
        """Run one iteration; return the reason to stop, or None to continue."""
        if self.history[-1] <= NEGLIGIBLE_ENERGY * self.problem.y.numel():
            return Stop.FITTED
        inner = max(CG_TOLERANCE, INNER_TOLERANCE_RATIO * tolerance)
        target, expected = linear_optimum(self.problem, self.deformation, self.linear, inner)
        mixed = self._mixed(target)
        if mixed is not None:
            return self._accept(*mixed, inf, tolerance)
        step = 1.0
        while step >= SHORTEST_STEP:
            trial = self._trial(self.deformation.momenta.towards(target, step))
            if trial is not None:
                return self._accept(*trial, expected if step == 1.0 else inf, tolerance)
            step *= 0.5
        return Stop.NO_APPROXIMATE_STEP if self.problem.reduced else Stop.NO_STEP

    def _mixed(self, target: Momenta) -> tuple[GeodesicDeformation, float] | None:
        """The trial of this target mixed with earlier ones; None far from the optimum, or if it is not better."""
        if self.problem.reduced or self.residual > MIXED_RESIDUAL:
            return None
        momenta = self.mixing.mixed(self.deformation.momenta, target)
        if momenta is None:
            return None
        trial = self._trial(momenta)
        if trial is not None and self._residual(trial[0]) < self.residual:
            return trial
        self.mixing = Mixing()  # starts again after a point that was rejected
        return None

    def _trial(self, momenta: Momenta) -> tuple[GeodesicDeformation, float] | None:
        """The deformation of these momenta and its energy; None if the energy rises or the flows overflow."""
        self.evaluations += 1
        try:
            deformation = self.problem.deform(momenta, self.integrator, variational=True)
        except NumericalError:
            return None
        value = float(self.problem.energy(deformation).total)
        return (deformation, value) if value <= self.history[-1] * (1.0 + FLAT_ENERGY_RISE) else None

    def _accept(self, trial: GeodesicDeformation, value: float, expected: float, tolerance: float) -> Stop | None:
        """Move there; ``expected`` is the fall of the energy of the linearised problem."""
        residual = self._residual(trial)
        if self.problem.reduced:
            # What is left to fall is not more than the error of the linearised problem.
            fall = self.history[-1] - value
            residual = min(abs(fall), abs(fall - expected)) / abs(value)
        flat = abs(value - self.history[-1]) <= FLAT_ENERGY_RISE * abs(value)
        if flat and residual > SETTLED_RESIDUAL_RATIO * self.residual:
            if residual < self.residual:
                self._move(trial, value, residual)
            if self.residual > MAX_END_RESIDUAL:  # too far from an optimum to blame time steps or rounding
                return Stop.STUCK
            return self._settled()
        self._move(trial, value, residual)
        return Stop.RESIDUAL if residual <= tolerance else None

    def _settled(self) -> Stop:
        """The reason why energy and residual have both settled: the time steps, or rounding."""
        if self.problem.reduced:
            return Stop.ENERGY_SETTLED
        try:
            fine = self._residual(self.problem.deform(self.deformation.momenta, self.integrator.refined()))
        except NumericalError:  # the finer flows overflow
            fine = inf
        steps = abs(fine - self.residual) > STEP_ERROR_SHARE * self.residual
        return Stop.TIME_STEPS if steps else Stop.ROUNDING

    def _move(self, trial: GeodesicDeformation, value: float, residual: float) -> None:
        self.deformation, self.residual = trial, residual
        self.history.append(value)

    def _residual(self, deformation: GeodesicDeformation) -> float:
        return max(self.problem.coupling_residual(deformation), self.problem.end_residual(deformation))

    def solution(self, stop: Stop, advice: str = "", limit: int = 0) -> Solution:
        """The current state and the reason to stop."""
        done = (self.history, self.iterations, self.evaluations)
        return Solution(self.deformation.momenta, stop, *done, measure=self.residual, limit=limit, advice=advice)


class Mixing:
    """Anderson mixing: what past steps of a fixed-point iteration say about the point where it will end.

    Gauss-Newton leaves out how slopes change, so that near the optimum every step repeats a share of the one before.
    With the points x_k, their targets g_k and the steps f_k = g_k - x_k, the next point is

        x = g_k - sum_j c_j (g_j+1 - g_j),    c = argmin |f_k - sum_j c_j (f_j+1 - f_j)|,

    which ends in the same point after fewer steps (Anderson 1965, "Iterative procedures for nonlinear integral
    equations"; Walker and Ni 2011, "Anderson acceleration for fixed-point iterations"). Steps are compared by their
    task momenta: at the optimum these determine b and theta, and they alone have one unit.
    """

    def __init__(self) -> None:
        self._targets: list[Tensor] = []
        self._steps: list[Tensor] = []

    def mixed(self, current: Momenta, target: Momenta) -> Momenta | None:
        """The mixed point.

        Args:
            current: where the iteration is. target: where its step leads.

        Returns:
            None where there is no earlier step to compare with, or none that differs.
        """
        self._targets = [*self._targets[-MIXING_DEPTH:], target.flatten()]
        self._steps = [*self._steps[-MIXING_DEPTH:], (target.task - current.task).flatten()]
        if len(self._steps) == 1:
            return None
        changes, moved = (
            torch.stack([after - before for before, after in pairwise(kept)], 1)
            for kept in (self._steps, self._targets)
        )
        # By singular values: differences of steps near rounding are as good as parallel.
        U, s, Vt = torch.linalg.svd(changes, full_matrices=False)
        kept = s > torch.finfo(s.dtype).eps * len(U) * s[0]
        share = Vt.T[:, kept] @ ((U.T @ self._steps[-1])[kept] / s[kept])
        mixed = self._targets[-1] - moved @ share
        return target.unflatten(mixed) if bool(kept.any()) and bool(mixed.isfinite().all()) else None
