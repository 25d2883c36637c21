"""What a fit returns: the model, the proof that it solves the problem, and a sentence about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import isnan

from diffeo_calib.calibration.problem import Problem
from diffeo_calib.deformation import Deformation, Momenta
from diffeo_calib.flows.integrate import Integrator
from diffeo_calib.model import CalibratedMap

Progress = Callable[[str, int, int], None]
"""``progress(task, done, total)``: called by long work; the command line draws it."""


NEGLIGIBLE = 1e-12
"""Energy per measured coordinate below which k0 itself fits the data to rounding: its residuals mean nothing."""
END_RESIDUAL = 0.05
"""Largest violation of the end condition (12) with which a fit may call itself converged."""


def silent(task: str, done: int, total: int) -> None:
    """The default progress callback: draws nothing."""


@dataclass(frozen=True)
class Solution:
    """What a solver hands back: the best momenta it met and why it stopped.

    Args:
        momenta: best state.
        status: why it stopped. advice: what to change if that is not convergence.
        converged: whether its own criterion was met.
        history: energy after every iteration (of L-BFGS: every few), the start first.
        iterations: accepted ones.
        evaluations: forward runs of the two flows, gradients included.
        interrupted: whether Ctrl-C ended it.
        exhausted: whether the limit of iterations did.
    """

    momenta: Momenta
    status: str
    converged: bool
    history: list[float]
    iterations: int
    evaluations: int
    interrupted: bool = False
    exhausted: bool = False
    advice: str = ""


@dataclass(frozen=True, repr=False)
class Fit:
    """A fitted exact model and its certificates.

    Attributes:
        model: the calibrated map, ``model(x)``, ``model.jacobian(x)``, ``model.predict(x)``.
        energy: E at the solution (16). ``field_energy`` and ``data_energy`` are parts of it.
        coupling_residual: |b_end - Dk0(xi)^T p| / |b_end|, 0 at an optimum; 1e-6 and below is usual.
        end_residual: |p_end - R^-1 (y - z1)| / |p_end|, 0 at an optimum, end condition (12); both residuals are NaN
            with fewer control points than data. It is the first
            to show too coarse time steps; above 0.05 the fit does not call itself converged.
        energy_drift: relative drift of the two Hamiltonians along the flows, 0 for exact flows.
        step_error: estimated time-stepping error of k1 at the data, m (step doubling).
        iterations, evaluations: work done.
        history: energy by iteration (of L-BFGS: every few).
        backend: what ran the kernel sums between the control points, (joint space, task space).
        status: why the fit stopped. converged: whether it met its tolerance.
        seconds: wall time of the fit.
    """

    problem: Problem
    model: CalibratedMap
    solution: Solution
    energy: float
    field_energy: float
    data_energy: float
    coupling_residual: float
    end_residual: float
    energy_drift: float
    step_error: float
    seconds: float

    def __repr__(self) -> str:
        return f"Fit(energy={self.energy:.6g}, {self.model!r}: {self.status})"

    @property
    def status(self) -> str:
        """Why the fit stopped, and what to change if that is not convergence, in one sentence."""
        return "; ".join(filter(None, (self.solution.status, self.solution.advice)))

    @property
    def converged(self) -> bool:
        """Whether the solver met its tolerance."""
        return self.solution.converged

    @property
    def iterations(self) -> int:
        """Accepted iterations."""
        return self.solution.iterations

    @property
    def evaluations(self) -> int:
        """Forward runs of the two flows."""
        return self.solution.evaluations

    @property
    def history(self) -> list[float]:
        """Energy after every iteration, the start first."""
        return self.solution.history

    @property
    def backend(self) -> tuple[str, str]:
        """What ran the kernel sums between the control points: in joint space, in task space."""
        deformation = self.model.deformation
        flows = (deformation.joint_flow, deformation.task_flow)
        joint, task = (
            "+".join(sorted(flow.kernel.backends(len(flow.nodes[0][0]), flow.nodes[0].device))) for flow in flows
        )
        return joint, task

    @property
    def momenta(self) -> Momenta:
        """b, p and theta at the solution; p is the paper's P0."""
        return self.solution.momenta

    @property
    def integrator(self) -> Integrator:
        """The time stepping that was used."""
        return self.model.deformation.integrator


def certify(problem: Problem, solution: Solution, integrator: Integrator, seconds: float) -> Fit:
    """Run the solution once more, and once with half the step, to measure its certificates."""
    deformation = problem.deform(solution.momenta, integrator)
    parts = problem.energy(deformation)
    end_residual = problem.end_residual(deformation)
    fits = isnan(end_residual) or end_residual <= END_RESIDUAL or float(parts.total) <= NEGLIGIBLE * problem.y.numel()
    if solution.converged and not fits:
        status = f"{solution.status}, but the end condition (12) is violated by {100 * end_residual:.0f} %"
        solution = replace(solution, status=status, advice="use more time steps", converged=False)
    return Fit(
        problem=problem,
        model=CalibratedMap(deformation, problem.noise, problem.x),
        solution=solution,
        energy=float(parts.total),
        field_energy=float(parts.field_x + parts.field_y),
        data_energy=float(parts.data),
        coupling_residual=problem.coupling_residual(deformation),
        end_residual=end_residual,
        energy_drift=max(deformation.joint_flow.energy_drift(), deformation.task_flow.energy_drift()),
        step_error=step_error(problem, deformation),
        seconds=seconds,
    )


def step_error(problem: Problem, deformation: Deformation) -> float:
    """Estimated time-stepping error of k1(x_i) in m: the largest change with a finer integrator, extrapolated."""
    fine = problem.deform(deformation.momenta, deformation.integrator.refined())
    return (
        float((problem.values(fine) - problem.values(deformation)).abs().max())
        * deformation.integrator.error_per_change
    )
