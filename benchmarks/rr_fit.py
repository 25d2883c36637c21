"""The paper's RR test bed: accuracy and cost of the exact model, by solver and time steps.

256 noise-free measurements on the 16 x 16 grid of [-pi, pi)^2 (Orozco & Ratajczak 2025, section 5);
L-BFGS starts from the Gauss-Newton solution and serves as an independent check of the optimum.

Fields of a record: `integrator` is what was asked for, `steps` what was used; `sigma` and `energy` as in
(5) and (16); `coupling_residual` and `end_residual` are the certificates of a fit; `orders_random` is
log10(mean nominal error / mean error of the fit) over 3000 random configurations that were not fitted,
`orders_grid` the same over the fitted grid; `jacobian_relative_error` compares the model's Jacobian with
central differences; `evaluations` counts runs of the two flows; `failure` says why there are no numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import log10, pi

import torch
from harness import Record, run
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots import elastic_rr

SIGMAS = (0.01, 0.001)
STEPS = (1, 2, 4, 8)
TEST_ROWS, JACOBIAN_ROWS, SEED = 3000, 50, 0
DIFFERENCE = 1e-5  # rad

JOINT_KERNEL = dc.VonMises(concentration=(1.0186, 1.0186), variance=8.0)
TASK_KERNEL = dc.Gaussian(lengthscale=0.5135**0.5, variance=1.0)


def measure(quick: bool) -> Iterator[Record]:
    """Yield one record for every sigma, integrator and solver."""
    x = elastic_rr.grid(16)
    for sigma in SIGMAS[:1] if quick else SIGMAS:
        problem = dc.Problem(
            elastic_rr.nominal,
            x,
            elastic_rr.real(x),
            joint_kernel=JOINT_KERNEL,
            task_kernel=TASK_KERNEL,
            noise=sigma,
        )
        for integrator in [dc.RK4(2)] if quick else [*(dc.RK4(steps) for steps in STEPS), None]:
            yield from compare_solvers(problem, sigma, integrator)


def compare_solvers(problem: dc.Problem, sigma: float, integrator: dc.RK4 | None) -> Iterator[Record]:
    """Fit with Gauss-Newton, then with L-BFGS from there."""
    start = None
    for solver in (dc.GaussNewton(), dc.LBFGS()):
        name = "default" if integrator is None else f"RK4({integrator.steps})"
        case: Record = {"formulation": "exact", "solver": type(solver).__name__, "integrator": name, "sigma": sigma}
        try:
            fit = dc.fit(problem, solver=solver, integrator=integrator, start=start)
        except dc.DiffeoCalibError as error:
            yield case | {"failure": str(error)}
            return
        start = fit.momenta
        yield case | describe(fit)


def describe(fit: dc.Fit) -> Record:
    """Return what a record says of one fit."""
    generator = torch.Generator().manual_seed(SEED)
    test = pi * (2.0 * torch.rand(TEST_ROWS, 2, generator=generator, dtype=torch.float64) - 1.0)
    return {
        "steps": fit.integrator.steps,
        "energy": fit.energy,
        "coupling_residual": fit.coupling_residual,
        "end_residual": fit.end_residual,
        "orders_random": orders(fit.model, test),
        "orders_grid": orders(fit.model, fit.problem.x),
        "jacobian_relative_error": jacobian_error(fit.model, test[:JACOBIAN_ROWS]),
        "iterations": fit.iterations,
        "evaluations": fit.evaluations,
        "seconds": fit.seconds,
        "status": fit.status,
        "failure": None,
    }


def orders(model: dc.CalibratedMap, x: Tensor) -> float:
    """Return by how many orders of magnitude the mean error falls."""
    real = elastic_rr.real(x)
    nominal, fitted = ((y - real).norm(dim=1).mean() for y in (elastic_rr.nominal(x), model(x)))
    return log10(float(nominal / fitted))


def jacobian_error(model: dc.CalibratedMap, x: Tensor) -> float:
    """Return |J - central differences| / |J|, Frobenius norms over all x (M, n)."""
    jacobian = model.jacobian(x)  # (M, m, n)
    pushes = DIFFERENCE * torch.eye(x.shape[1], dtype=x.dtype)
    differences = torch.stack([(model(x + h) - model(x - h)) / (2.0 * DIFFERENCE) for h in pushes], dim=2)
    return float((jacobian - differences).norm() / jacobian.norm())


if __name__ == "__main__":
    shown = ("solver", "integrator", "steps", "sigma", "energy", "coupling_residual", "end_residual")
    run(__doc__, measure, (*shown, "orders_random", "orders_grid", "jacobian_relative_error", "evaluations", "seconds"))
