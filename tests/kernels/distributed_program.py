"""What the tests of distributed sums run in every process: `python distributed_program.py TASK FOLDER`."""

import os
import signal
import sys
import time
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


def everything_shared() -> None:
    backends.BACKENDS["distributed"] = distributed.Distributed(smallest=1)
    control_points.SHARED_ENTRIES = 1


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
    everything_shared()
    found: dict[str, Any] = {make.__name__: make("distributed") for make in (sums, fits)}
    found["alone"] = {make.__name__: make("dense") for make in (sums, fits)}
    torch.save(found, folder / f"found_{distributed.ranks().own}.pt")


def lost(folder: Path) -> None:
    """Rank 1 dies in the third sum; the other one must not write its model."""
    everything_shared()
    own, sums_done = distributed.ranks(), 0
    original = distributed.Ranks.check_agreement

    def check(self: distributed.Ranks, what: str, numbers: Tensor) -> None:
        nonlocal sums_done
        sums_done += 1
        if own.own == 1 and sums_done == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        original(self, what, numbers)

    distributed.Ranks.check_agreement = check
    begin = time.monotonic()
    try:
        fit = dc.fit(rr_problem(8), integrator=dc.RK4(2), backend="distributed")
        dc.save(fit.model, folder / "model.safetensors")
    except dc.DiffeoCalibError as error:
        print(f"{type(error).__name__} after {time.monotonic() - begin:.1f} s: {error}")
        sys.exit(7)


if __name__ == "__main__":
    torch.set_num_threads(1)
    {"agree": agree, "lost": lost}[sys.argv[1]](Path(sys.argv[2]))
