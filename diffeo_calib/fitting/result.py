"""The result of a fit: the model, certificates that it solves the problem, and a status sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from math import inf, isnan, nan
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.flows.integrators import Integrator
from diffeo_calib.maps.deformation import Deformation, Momenta


class Stop(Enum):
    """A reason to stop: a sentence with placeholders, and whether the solver met its criterion.

    Placeholders: ``iterations`` and ``evaluations`` (counts), ``limit`` (of iterations), ``measure`` (the value of the
    criterion: a residual, a relative fall of the energy, or the norm of a gradient).
    """

    FITTED = "converged: the data are fitted to rounding after {iterations} iterations", True
    RESIDUAL = "converged: residual {measure:.1e} after {iterations} iterations", True
    TIME_STEPS = (
        "converged to the accuracy of the time steps: residual {measure:.1e} after {iterations} iterations",
        True,
    )
    ROUNDING = "converged to rounding: residual {measure:.1e} after {iterations} iterations", True
    ENERGY_SETTLED = (
        "converged: the energy has settled after {iterations} iterations (last relative change {measure:.1e})",
        True,
    )
    ENERGY = "converged: the energy no longer falls after {evaluations} evaluations", True
    GRADIENT = "converged: gradient {measure:.1e} after {iterations} iterations", True
    STUCK = "stopped: no step lowers the energy, residual {measure:.1e}", False
    NO_STEP = "stopped: no step lowers the energy", False
    NO_APPROXIMATE_STEP = "stopped: no step in the approximate Gauss-Newton direction lowers the energy", False
    DIVERGED = "diverged after {iterations} iterations: lower `step`, the best state so far is kept", False
    LIMIT = "stopped at the limit of {limit} iterations", False
    INTERRUPTED = "interrupted after {iterations} iterations: the best state so far is kept", False

    def __init__(self, text: str, converged: bool) -> None:
        self.text = text
        self.converged = converged


Progress = Callable[[str, int, int], None]
"""``progress(task, done, total)``: called during long work; the command line shows it as a bar."""


NEGLIGIBLE_ENERGY = 1e-12
"""Energy per measured coordinate below which k0 fits the data up to rounding, so that residuals are meaningless."""
UNFINISHED_COUPLING_RESIDUAL = 0.01
"""Coupling residual above which a descent has not reached the optimum (time steps hardly change this residual)."""
MAX_END_RESIDUAL = 0.05  # largest violation of the end condition (12) of a converged fit


def silent(task: str, done: int, total: int) -> None:
    """The default progress callback: does nothing."""


@dataclass(frozen=True)
class Solution:
    """The result of a solver: the best momenta, and why it stopped."""

    momenta: Momenta  # best momenta
    stop: Stop  # reason to stop
    history: list[float]  # energy at the start and after every iteration (L-BFGS: every few iterations)
    iterations: int  # number of accepted iterations
    evaluations: int  # number of forward runs of the two flows, including those of gradients
    measure: float = nan  # final value of the solver's criterion
    limit: int = 0  # of iterations
    advice: str = ""  # what to change if the solver did not converge

    @property
    def status(self) -> str:
        """Why the solver stopped, in words."""
        numbers = {"iterations": self.iterations, "evaluations": self.evaluations, "limit": self.limit}
        return self.stop.text.format(measure=self.measure, **numbers)

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C stopped it."""
        return self.stop is Stop.INTERRUPTED

    @property
    def exhausted(self) -> bool:
        """Whether it stopped at the limit of iterations."""
        return self.stop is Stop.LIMIT


@dataclass(frozen=True, repr=False)
class Fit:
    """A fitted model and its certificates.

    Attributes:
        problem: the fitted problem. formulation: "exact", or "eulerian" as in the paper.
        model: the calibrated map, ``model(x)``, ``model.jacobian(x)`` and, if exact, ``model.predict(x)``.
        energy: E at the solution (16). ``field_energy`` and ``data_energy`` are parts of it.
        coupling_residual: |b_end - Dk0(xi)^T p| / |b_end|, 0 at an optimum; usually 1e-6 or less. NaN in the
            Eulerian formulation, in which the coupling holds by construction.
        end_residual: |p_end - R^-1 (y - z1)| / |p_end|, 0 at an optimum, end condition (12). In the exact model it
            is the first sign of too coarse time steps; above 0.05 the fit does not count as converged. Minima of the
            Eulerian energy do not satisfy (12), so it certifies nothing there. Both residuals are NaN with fewer
            control points than data.
        energy_drift: relative drift of the two Hamiltonians along the flows (of their sum in the Eulerian
            formulation), 0 for exact flows.
        step_error: estimated time-stepping error of k1 at the data, m (by step doubling).
        iterations, evaluations: number of accepted iterations, and of forward runs of the two flows.
        history: energy by iteration (L-BFGS: every few iterations).
        backend: backends of the kernel sums between the control points, (joint space, task space).
        momenta: b, p and theta at the solution; p is the paper's P0 (in the Eulerian formulation b is implied and
            empty). integrator: time stepping.
        status: why the fit stopped. converged: whether it met its tolerance.
        advice: what to change if the fit did not converge; replaces the solver's advice.
        seconds: wall time of the fit.
    """

    problem: Problem
    model: FittedMap
    solution: Solution
    energy: float
    field_energy: float
    data_energy: float
    coupling_residual: float
    end_residual: float
    energy_drift: float
    step_error: float
    seconds: float
    advice: str = ""

    def __repr__(self) -> str:
        return f"Fit(energy={self.energy:.6g}, {self.model!r}: {self.status})"

    @property
    def residual(self) -> Tensor:
        """(N, r) measured minus modelled numbers, m."""
        return self.problem.y - self.problem.values(self.model.geodesic)

    @property
    def shifts(self) -> Tensor:
        """(c,) posterior mean of the shifts that rows share, in units of their prior deviations; see :class:`Noise`."""
        noise = self.problem.noise
        return torch.einsum("nmc,nm->c", noise.shared, noise.solve(self.residual))

    def gradients(self, x: object, loss: Callable[[Tensor], Tensor]) -> Any:
        """Derivatives of a loss of the model by measurements, noise and scales, with the fit following them.

        Args:
            x: (M, n) configurations, rad or m. loss: a torch function of k1(x) (M, m), m, to a scalar.

        Returns:
            a :class:`~diffeo_calib.fitting.gradients.FitGradients`.

        Raises:
            InputError: a fit that did not converge, of the Eulerian formulation, or with fewer control points than
                data; x of the wrong shape, or a loss that is no scalar of its argument.
            NumericalError: the iteration does not converge, since the fit is too far from linear.
        """
        from diffeo_calib.fitting.gradients import gradients  # noqa: PLC0415  # it builds on solvers

        return gradients(self, x, loss)

    @property
    def status(self) -> str:
        """Why the fit stopped and, if it did not converge, what to change, in one sentence."""
        reason = self.solution.status
        if self.solution.stop.converged and not self.converged:
            reason += f", but the end condition (12) is violated by {100 * self.end_residual:.0f} %"
        return "; ".join(filter(None, (reason, self._usual_advice and (self.advice or self._usual_advice))))

    @property
    def _usual_advice(self) -> str:
        if not (self.solution.stop.converged and self._violated):
            return self.solution.advice
        unfinished = self.coupling_residual > UNFINISHED_COUPLING_RESIDUAL
        return ("start from Gauss-Newton or " if unfinished else "") + "use more time steps"

    @property
    def converged(self) -> bool:
        return self.solution.stop.converged and not self._violated

    @property
    def _violated(self) -> bool:
        negligible = self.energy <= NEGLIGIBLE_ENERGY * self.problem.y.numel()
        certifies = self.formulation == "exact" and not isnan(self.end_residual)
        return certifies and self.end_residual > MAX_END_RESIDUAL and not negligible

    @property
    def iterations(self) -> int:
        return self.solution.iterations

    @property
    def evaluations(self) -> int:
        return self.solution.evaluations

    @property
    def history(self) -> list[float]:
        return self.solution.history

    @property
    def formulation(self) -> str:
        return self.model.formulation

    @property
    def backend(self) -> tuple[str, str]:
        return self.model.deformation.backends

    @property
    def momenta(self) -> Momenta:
        return self.solution.momenta

    @property
    def integrator(self) -> Integrator:
        return self.model.deformation.integrator


@dataclass(frozen=True)
class Stepped:
    """A run of the flows, what it predicts, and its estimated time-stepping error, m: what certificates need."""

    deformation: Deformation
    values: Tensor
    error: float


def stepped(objective: Problem, momenta: Momenta, integrator: Integrator) -> Stepped:
    """Run the flows with these time steps, and with refined ones."""
    deformation = objective.deform(momenta, integrator)
    values = objective.values(deformation)
    return Stepped(deformation, values, step_error(objective, deformation, values))


def certify(
    problem: Problem,
    objective: Problem,
    solution: Solution,
    integrator: Integrator,
    seconds: float,
    *,
    known: Stepped | None = None,
) -> Fit:
    """Compute the certificates of a solution; ``known`` is its run with these time steps, if there was one."""
    run = known or stepped(objective, solution.momenta, integrator)
    parts, deformation = objective.energy(run.deformation, run.values), run.deformation
    return Fit(
        problem=problem,
        model=objective.calibrated(deformation),
        solution=solution,
        energy=float(parts.total),
        field_energy=float(parts.field_x + parts.field_y),
        data_energy=float(parts.data),
        coupling_residual=objective.coupling_residual(deformation),
        end_residual=objective.end_residual(deformation),
        energy_drift=deformation.energy_drift(),
        step_error=run.error,
        seconds=seconds,
    )


def step_error(objective: Problem, deformation: Deformation, values: Tensor | None = None) -> float:
    """Estimated time-stepping error of k1(x_i) in m: the largest change with a finer integrator, extrapolated.

    Args:
        objective: the problem. deformation: of it. values: what it predicts, if that is known.
    """
    try:
        fine = objective.deform(deformation.momenta, deformation.integrator.refined())
    except NumericalError:  # the finer flow overflows
        return inf
    values = objective.values(deformation) if values is None else values
    change = float((objective.values(fine) - values).abs().max())
    return change * deformation.integrator.error_per_change
