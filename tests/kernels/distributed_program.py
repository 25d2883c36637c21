"""What the tests of distributed sums run in every process: `python distributed_program.py FOLDER`."""

import sys
from itertools import product
from pathlib import Path
from typing import Any

import torch
from math_bank import rr_problem
from sum_bank import FORMULAS, points
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.kernels.profiles import MaternProfile
from diffeo_calib.kernels.reductions import backends, distributed
from diffeo_calib.regression import control_points

COUNT, ROWS = 300, 200


def sums(backend: backends.Backend) -> list[Tensor]:
    found: list[Tensor] = []
    for formula, rows in product(FORMULAS.values(), (None, points(ROWS, 2))):
        found += backends.evaluate(formula, MaternProfile(2.5), rows, points(COUNT, 1), backend)
    return found


def fits(backend: backends.Backend) -> list[Tensor]:
    """Steps of L-BFGS, through flows and their gradients, of Gauss-Newton by conjugate gradients, of control points."""
    found = []
    for solver, options in (
        (dc.LBFGS(max_iterations=3), {}),
        (dc.GaussNewton(linear="cg", max_iterations=2), {}),
        (dc.GaussNewton(max_iterations=2), {"controls": 12}),
    ):
        fit = dc.fit(rr_problem(5), solver, dc.RK4(2), backend=backend, **options)
        found += [torch.tensor([fit.energy], dtype=torch.float64), fit.model(fit.problem.x)]
    return found


def agree(folder: Path) -> None:
    backends.BACKENDS["distributed"] = distributed.Distributed(smallest=1)
    control_points.SHARED_ENTRIES = 1
    found: dict[str, Any] = {make.__name__: make("distributed") for make in (sums, fits)}
    found["alone"] = {make.__name__: make("dense") for make in (sums, fits)}
    torch.save(found, folder / f"found_{distributed.ranks().own}.pt")


if __name__ == "__main__":
    torch.set_num_threads(1)
    agree(Path(sys.argv[1]))
