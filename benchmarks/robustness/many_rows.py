"""How time, memory and accuracy of a calibration grow with the rows of a robot that streams its tracker.

    python benchmarks/robustness/many_rows.py --out many_rows.json

A simulated elastic arm, one marker, random configurations, 0.02 mm noise per coordinate, `calibrate` with its defaults
("auto" chooses 200 control points where more than 8000 values are measured), every calibration in a process of its own
on one thread. At 12,000 rows also with more control points. Errors are those of the true positions of 2000 other
configurations.

Fields of a record:

    rows, controls         of the calibration; controls as asked for
    seconds, cpu_seconds   of the calibration
    peak_mib, before_mib   largest memory of the process, and before the calibration: libraries and simulation
    rms_mm, covered        held-out error, share of true positions in the 95 % regions
    time_exponent, memory_exponent   slopes of cpu_seconds and peak_mib against the rows, from the record before
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import multiprocessing
import resource
import time
import warnings
from collections.abc import Iterator

import harness
import torch
from harness import Record
from held_out import covered, exponents, rms_mm

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm

ROWS, QUICK_ROWS = (1000, 3000, 12_000, 30_000, 100_000), (200,)
MORE_CONTROLS, AT_ROWS = (400, 800, 1600), 12_000
OTHERS = 2000
SLOPES = {"time_exponent": "cpu_seconds", "memory_exponent": "peak_mib"}


def calibrated(rows: int, controls: int | str) -> Record:
    """One calibration."""
    torch.set_num_threads(1)
    arm = SimulatedArm(0)
    data, others = dc.Measurements(*arm.measure(rows, seed=1000)), arm.sample(OTHERS, seed=2000)
    before, wall, cpu = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter(), time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
        model = dc.calibrate(arm.nominal, data, controls=controls).model  # pyright: ignore[reportArgumentType]
    record: Record = {"rows": rows, "controls": controls}
    record |= {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    record |= {"peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0, "before_mib": before / 1024.0}
    mean, covariance = model.predict(others, noise=False)
    errors = arm.true_points(others) - mean
    return record | {"rms_mm": rms_mm(errors), "covered": covered(errors, covariance)}


def measure(quick: bool) -> Iterator[Record]:
    """One record for each number of rows, then those with more control points."""
    last: Record | None = None
    for rows in QUICK_ROWS if quick else ROWS:
        record = _alone(rows, "auto")
        if last is not None:
            record |= exponents(record, last, "rows", SLOPES)
        yield record
        last = record
    for controls in () if quick else MORE_CONTROLS:
        yield _alone(AT_ROWS, controls)


def _alone(rows: int, controls: int | str) -> Record:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(calibrated, (rows, controls))


if __name__ == "__main__":
    harness.run(__doc__, lambda plan: measure(plan.quick))
