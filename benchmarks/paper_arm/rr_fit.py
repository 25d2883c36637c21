"""The paper's RR test bed: accuracy and cost of the exact model, by solver, time steps and size.

    python benchmarks/paper_arm/rr_fit.py --out rr.json

Noise-free measurements on a grid of [-pi, pi)^2 (Orozco & Ratajczak 2025, section 5: 16 x 16):

    optimum   Gauss-Newton for several noises and time steps; L-BFGS from its solution, an independent check
    descent   L-BFGS from the tangent solution: in the momenta, preconditioned, with torchdiffeq's adjoint
    size      a 64 x 64 grid: conjugate gradients on kernel sums, and a few control points

Fields of a record: `case` as above; `integrator` is the requested time stepping, `used` the actual one; `sigma` and
`energy` as in (5) and (16); `coupling_residual` and `end_residual` are the certificates of a fit (null with fewer
control points than data); `orders_random` is log10(mean nominal error / mean error of the fit) over 3000 random
held-out configurations, `orders_grid` the same over the fitted grid; `jacobian_relative_error` compares the model's
Jacobian with central differences; `evaluations` counts runs of the two flows; `peak_mib` is the process's peak memory
so far; `failure` is the reason why there are no numbers.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import resource
from collections.abc import Iterator
from dataclasses import replace

import rr_bed
from harness import Record, run
from section_5 import section_5

import diffeo_calib as dc
from diffeo_calib.fitting.fit import Solver
from diffeo_calib.flows.integrators import Integrator

SIGMAS = (0.01, 0.001)
INTEGRATORS = (dc.RK4(1), dc.RK4(2), dc.RK4(4), dc.RK8(1), None)
LARGE_GRID, CONTROLS = 64, 300
ITERATIONS = 200  # of L-BFGS from the tangent solution


def measure(quick: bool) -> Iterator[Record]:
    """Yield the records of all cases."""
    for sigma in SIGMAS[:1] if quick else SIGMAS:
        for integrator in INTEGRATORS[1:2] if quick else INTEGRATORS:
            yield from optimum(section_5(sigma), sigma, integrator)
    if not quick:
        yield from descent()
        yield from size()


def optimum(problem: dc.Problem, sigma: float, integrator: Integrator | None) -> Iterator[Record]:
    """Fit with Gauss-Newton, then with L-BFGS from there."""
    start = None
    for name, solver in (("Gauss-Newton", dc.GaussNewton()), ("L-BFGS from there", dc.LBFGS())):
        case: Record = {"case": "optimum", "solver": name, "sigma": sigma}
        record, start = attempt(case, problem, solver, integrator, start)
        yield record
        if start is None:
            return


def descent() -> Iterator[Record]:
    """Fit with L-BFGS from the tangent solution."""
    problem, solver = section_5(SIGMAS[0]), dc.LBFGS(max_iterations=ITERATIONS)
    adjoint = dc.TorchDiffEq("rk4", adjoint=True, step_size=0.5)
    yield attempt(
        {"case": "descent", "solver": "Gauss-Newton", "sigma": SIGMAS[0]}, problem, dc.GaussNewton(), dc.RK4(2)
    )[0]
    for name, method, integrator in (
        ("L-BFGS in the momenta", replace(solver, preconditioned=False), dc.RK4(2)),
        ("L-BFGS preconditioned", solver, dc.RK4(2)),
        ("L-BFGS preconditioned", solver, adjoint),
    ):
        yield attempt({"case": "descent", "solver": name, "sigma": SIGMAS[0]}, problem, method, integrator)[0]


def size() -> Iterator[Record]:
    """Fit 4096 measurements."""
    case: Record = {"case": "size", "sigma": SIGMAS[0]}
    problem, loose = section_5(SIGMAS[0], LARGE_GRID), dc.GaussNewton(tolerance=1e-6)
    for name, controls in ((f"{CONTROLS} control points", CONTROLS), ("conjugate gradients", None)):
        yield attempt(case | {"solver": name}, problem, loose, None, controls=controls)[0]


def attempt(
    case: Record,
    problem: dc.Problem,
    solver: Solver,
    integrator: Integrator | None,
    start: object = None,
    *,
    controls: int | None = None,
) -> tuple[Record, object]:
    """Fit once: the record, and the momenta unless the fit failed."""
    named = case | {"points": len(problem.x), "integrator": "chosen" if integrator is None else repr(integrator)}
    try:
        fit = dc.fit(problem, solver, integrator, start=start, controls=controls)  # pyright: ignore[reportArgumentType]
    except dc.DiffeoCalibError as error:
        return named | {"failure": str(error)}, None
    return named | describe(fit), fit.momenta


def describe(fit: dc.Fit) -> Record:
    """Return the fields of one fit."""
    return {
        "controls": len(fit.model.deformation.x),
        "used": repr(fit.integrator),
        **rr_bed.describe(fit),
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "failure": None,
    }


if __name__ == "__main__":
    shown = ("case", "solver", "points", "controls", "integrator", "used", "sigma", "energy", "coupling_residual")
    run(__doc__, measure, (*shown, "end_residual", "orders_random", "evaluations", "seconds"))
