"""How time and memory of a fit grow with the number of measurements, with a fixed number of control points.

    python benchmarks/paper_arm/growth.py --out growth.json

The elastic arm of the paper with a tenth of its errors (1 % of its reach), random configurations, measured without
noise, sigma 1e-3, 150 control points, two steps of RK4, every fit in a process of its own, on one thread. The model is
judged at 3000 other configurations.

Fields of a record:

    seconds, cpu_seconds   of the fit; peak_mib: largest memory of the process above that before the fit
    rms                    at the other configurations, length units
    iterations, converged  of the fit
    time_exponent, memory_exponent   slopes of cpu_seconds and peak_mib against the measurements, from the record before
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import math
import multiprocessing
import resource
import time
from collections.abc import Iterator

import harness
import torch
from harness import Record
from held_out import exponents
from section_5 import section_5

import diffeo_calib as dc
from diffeo_calib.robots import elastic_rr

ROWS, QUICK_ROWS = (1000, 3000, 10_000, 30_000), (1000, 3000)
SLOPES = {"time_exponent": "cpu_seconds", "memory_exponent": "peak_mib"}
NOISE, CONTROLS, OTHERS, SHARE = 1e-3, 150, 3000, 0.1


def random_configurations(count: int, seed: int) -> torch.Tensor:
    """Uniform on the torus: (count, 2), rad."""
    generator = torch.Generator().manual_seed(seed)
    return 2.0 * math.pi * torch.rand(count, 2, generator=generator, dtype=torch.float64) - math.pi


def really(x: torch.Tensor) -> torch.Tensor:
    """Where the arm goes: (N, 2) -> (N, 2)."""
    return elastic_rr.nominal(x) + SHARE * (elastic_rr.real(x) - elastic_rr.nominal(x))


def fitted(rows: int) -> Record:
    """One fit."""
    torch.set_num_threads(1)
    x, others = random_configurations(rows, 0), random_configurations(OTHERS, 1)
    y = really(x)
    spec = section_5(NOISE).spec
    joint, task = spec.joint_kernel.scaled(SHARE**2), spec.task_kernel.scaled(SHARE**2)
    problem = dc.Problem(elastic_rr.nominal, x, y, joint_kernel=joint, task_kernel=task, noise=NOISE)
    before, wall, cpu = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter(), time.process_time()
    fit = dc.fit(problem, integrator=dc.RK4(2), controls=CONTROLS)
    record: Record = {"rows": rows, "seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0
    errors = (fit.model(others) - really(others)).square().sum(1).mean().sqrt()
    record |= {"peak_mib": peak, "rms": float(errors), "iterations": fit.iterations, "converged": fit.converged}
    return record


def measure(quick: bool) -> Iterator[Record]:
    """One record for each number of rows."""
    last: Record | None = None
    for rows in QUICK_ROWS if quick else ROWS:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            record = pool.apply(fitted, (rows,))
        if last is not None:
            record |= exponents(record, last, "rows", SLOPES)
        yield record
        last = record


if __name__ == "__main__":
    harness.run(__doc__, lambda plan: measure(plan.quick))
