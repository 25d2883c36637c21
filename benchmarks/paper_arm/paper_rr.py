"""The paper's section 5 on the elastic RR arm: both formulations, every solver, the errata, the workspace's border.

    python benchmarks/paper_arm/paper_rr.py --out paper.json

Noise-free measurements on the 16 x 16 grid, tests on 3000 random configurations (rr_bed.py; R. Orozco, A. Ratajczak,
"Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025). The paper reports errors
3 to 5 orders of magnitude below the nominal ones, slightly higher ones at the border of the workspace, and 470 s on
12 cores.

Fields of a record:

    formulation, errata        "exact", or "eulerian" with the switch of paper/eulerian.py that differs;
                               "default": the sign corrected, (19) as printed, no P div v
    solver, integrator         the minimiser; the time stepping
    sigma, energy              as in (5) and (16)
    coupling_residual          of L_V v = -Dk^T P, zero at an optimum; null if eulerian, where it holds by construction
    end_residual               of the end condition (12); an optimum of the Eulerian energy does not satisfy it
    orders_random              log10(mean nominal error / mean error of the fit), over the 3000 random configurations
    orders_grid                the same over the fitted grid
    orders_border              the same over the 5 % of the random ones nearest to the nominal arm's singular
                               configurations, x2 = 0 (outer border) or pi (inner border): least |sin x2|
    orders_interior            the same over the other 95 %
    border_error_ratio         mean error of the fit at the border / in the interior: the paper's "slightly higher"
    border_error_ratio_lines   the same against the part of the interior that is as near to a line of the grid in x2
                               as the border is (x2 = 0 and pi are such lines, which makes the border look better)
    jacobian_relative_error    |J - central differences of k1| / |J|; rounding limits it to some 1e-11
    jacobian_autograd_error    the same against autograd of k1 (through torchdiffeq's adjoint good to 1e-7); null if
                               eulerian, where autograd in x is the derivative with some integrators and errata only
    iterations, evaluations    steps of the solver; runs of the flows, gradients included
    seconds                    wall time of the fit; below 5 s the median of 3 after a warm-up (--quick: one run)
    converged, status          whether the solver met its tolerance and, if exact, (12) within 5 %; why it stopped
    note                       a remark on the case

L-BFGS stops when five iterations lower the energy by less than 1e-6 of it, or after 600. The step of gradient descent
(Algorithm 1) is the longest stable one for the Hessian at zero, 2 / its largest eigenvalue; `seconds` exclude the
search for it.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from math import pi
from statistics import median

import rr_bed
import torch
from harness import Record, run
from section_5 import section_5
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibError, NumericalError
from diffeo_calib.fitting.fit import Formulation, Solver, formulate
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.fitting.problem import Problem, slope
from diffeo_calib.flows.integrators import Integrator, RungeKutta

GRID = 16
SIGMAS = (0.01, 0.001)
STEPS = dc.RK4(2)
ADJOINT = dc.TorchDiffEq("rk4", adjoint=True, step_size=0.5)
DESCENT = dc.LBFGS(max_iterations=600, tolerance=1e-6)
QUICK_DESCENT = dc.LBFGS(max_iterations=60, tolerance=1e-4)
ITERATIONS, QUICK_ITERATIONS = 300, 5  # of gradient descent
PRODUCTS = 12  # of the Hessian with a vector, to find its largest eigenvalue
BORDER = 0.05
REPEATS, LONG = 3, 5.0  # s

SIGN = {"printed_sign": True}
ERRATA = ({"printed_jacobian": False}, {"printed_divergence": True})


@dataclass(frozen=True)
class Case:
    """One fit; `solver` None is gradient descent."""

    formulation: Formulation
    name: str
    solver: Solver | None
    integrator: Integrator | None
    sigma: float
    errata: dict[str, bool] = field(default_factory=dict)
    note: str | None = None


def measure(quick: bool) -> Iterator[Record]:
    """Yield the records of all cases."""
    for case in quick_cases() if quick else cases():
        yield attempt(case, quick=quick)


def quick_cases() -> Iterator[Case]:
    """One of every kind."""
    sigma = SIGMAS[0]
    yield Case("exact", "Gauss-Newton", dc.GaussNewton(), STEPS, sigma)
    yield Case("exact", "gradient descent", None, STEPS, sigma)
    yield Case("eulerian", "L-BFGS", QUICK_DESCENT, STEPS, sigma)
    yield Case("eulerian", "L-BFGS", QUICK_DESCENT, STEPS, sigma, SIGN)


def cases() -> Iterator[Case]:
    """All of them."""
    for sigma in SIGMAS:
        for steps in (STEPS, dc.RK4(4), None):
            note = "the time steps are chosen by the fit" if steps is None else None
            yield Case("exact", "Gauss-Newton", dc.GaussNewton(), steps, sigma, note=note)
        for formulation in ("exact", "eulerian"):
            yield Case(formulation, "L-BFGS", DESCENT, STEPS, sigma)
            yield Case(formulation, "L-BFGS", DESCENT, ADJOINT, sigma, note="gradients by torchdiffeq's adjoint")
            yield Case(formulation, "gradient descent", None, STEPS, sigma)
        for errata in ERRATA:
            yield Case("eulerian", "L-BFGS", DESCENT, STEPS, sigma, errata)
        yield Case("eulerian", "L-BFGS", DESCENT, STEPS, sigma, SIGN, note="starts at zero: v works against w")
        yield Case("eulerian", "gradient descent", None, STEPS, sigma, SIGN, note="Algorithm 1, sign as printed")


def attempt(case: Case, *, quick: bool = False) -> Record:
    """Fit, and fit again to time it: the record."""
    record: Record = {
        "formulation": case.formulation,
        "errata": ", ".join(name if on else f"not {name}" for name, on in case.errata.items()) or "default",
        "solver": case.name,
        "integrator": short(case.integrator),
        "sigma": case.sigma,
        "note": case.note,
    }
    problem = section_5(case.sigma)
    objective = formulate(problem, case.formulation, dict(case.errata))
    try:
        solver = case.solver or gradient_descent(objective, QUICK_ITERATIONS if quick else ITERATIONS)
        fit = partial(dc.fit, problem, solver, case.integrator, formulation=case.formulation)
        return record | describe(*timed(partial(fit, **case.errata), 1 if quick else REPEATS))
    except DiffeoCalibError as error:
        return record | {"converged": False, "status": f"failed: {error}"}


def short(integrator: Integrator | None) -> str:
    """Return a short name of a time stepping."""
    if isinstance(integrator, RungeKutta):
        return f"{type(integrator).__name__}({integrator.steps})"
    return "chosen" if integrator is None else "torchdiffeq rk4, adjoint"


def timed(fit: Callable[[], dc.Fit], repeats: int) -> tuple[dc.Fit, float]:
    """The fit and its seconds: the first run's if it is long or the only one, else the median of repeated runs."""
    first = fit()
    if repeats == 1 or first.seconds >= LONG:
        return first, first.seconds
    return first, median(fit().seconds for _ in range(repeats))


def describe(fit: dc.Fit, seconds: float) -> Record:
    """Return the fields of one fit."""
    test = rr_bed.held_out()
    few, exact = test[: rr_bed.JACOBIAN_ROWS], fit.formulation == "exact"
    return {
        "integrator": short(fit.integrator),
        **rr_bed.describe(fit),
        **at_the_border(fit.model, test),
        "jacobian_autograd_error": rr_bed.autograd_error(fit.model, few) if exact else None,
        "seconds": seconds,
        "converged": fit.converged,
    }


def at_the_border(model: FittedMap, x: Tensor) -> Record:
    """Return errors at singular configurations among x (M, 2), and elsewhere."""
    singular = x[:, 1].sin().abs()
    border = singular <= singular.kthvalue(round(BORDER * len(x))).values
    spacing = 2.0 * pi / GRID
    from_line = (torch.remainder(x[:, 1] + spacing / 2.0, spacing) - spacing / 2.0).abs()  # to the grid's next line
    lines = ~border & (from_line <= from_line[border].max())
    error = rr_bed.errors(model, x)
    return {
        "orders_border": rr_bed.orders(model, x[border]),
        "orders_interior": rr_bed.orders(model, x[~border]),
        "border_error_ratio": rr_bed.finite(float(error[border].mean() / error[~border].mean())),
        "border_error_ratio_lines": rr_bed.finite(float(error[border].mean() / error[lines].mean())),
    }


def gradient_descent(objective: Problem, iterations: int) -> dc.GradientDescent:
    """Return Algorithm 1 with the step 2 / (largest eigenvalue of the Hessian at zero), by power iteration."""
    zero, push, curvature = objective.zero().flatten(), 1e-6, 0.0

    def gradient(at: Tensor) -> Tensor:
        variables = at.clone().requires_grad_()
        found = slope(objective, STEPS, objective.zero().unflatten(variables), variables)
        if found is None:
            raise NumericalError("the flows overflow next to zero")
        return found[1]

    direction = torch.randn(zero.shape, dtype=zero.dtype, generator=torch.Generator().manual_seed(rr_bed.SEED))
    for _ in range(PRODUCTS):
        direction = direction / direction.norm()
        product = (gradient(zero + push * direction) - gradient(zero - push * direction)) / (2.0 * push)
        curvature, direction = float(direction @ product), product
    return dc.GradientDescent(step=2.0 / curvature, max_iterations=iterations)


if __name__ == "__main__":
    named = ("formulation", "errata", "solver", "integrator", "sigma", "energy", "coupling_residual", "orders_random")
    seen = ("border_error_ratio", "jacobian_relative_error", "evaluations", "seconds", "converged")
    run(__doc__, measure, (*named, *seen))
