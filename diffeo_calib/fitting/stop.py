"""The reasons why solvers stop, each with its sentence."""

from __future__ import annotations

from enum import Enum


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
