"""A UR10 measured again with another set-up: what the old model is worth, and what a few new rows add.

    python benchmarks/real_robots/recalibration.py --data FOLDER --out recalibration.json

A model of one series of the UR10 (700 rows of series A, or 442 of series D) meets 5 to 60 rows of the other, in which
the measuring device and its target were set up anew. All other rows of that series are held out.

fresh          a calibration of the new rows alone
registered     the old model with device and markers found anew (`model.registered`)
recalibrated   `dc.recalibrate` of the old model
twice          the same after a recalibration with 20 other rows of the same series

Fields of a record: `series`, `method`, `rows`, `seed` of the rows, held-out `rms_mm` and `p95_mm`; `inside` is the
share of held-out rows in their 95 % regions, `changed` names what the test found, `seconds` is the time.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import argparse
import time
import warnings
from collections.abc import Iterator

import harness
import torch
from harness import Record
from planning import robots, shuffled
from scipy.stats import chi2

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibError

OLD_ROWS = {"ur10_a": 700, "ur10_d": 442}
SIZES, QUICK_SIZES = (5, 10, 20, 30, 60), (10,)
BEFORE = 20
METHODS = ("fresh", "registered", "recalibrated", "twice")
COLUMNS = ("series", "method", "rows", "seed", "rms_mm", "p95_mm", "inside", "changed", "seconds")
INSIDE_95 = float(chi2.ppf(0.95, 3))


def judged(model: dc.CalibratedKinematics, test: dc.Measurements) -> Record:
    """Errors and coverage on held-out rows."""
    found = dc.evaluate(model, test)
    mean, covariance = model.predict(test.q)
    error = (test.points - mean)[..., None]
    squares = (error.mT @ torch.linalg.solve(covariance, error)).flatten()
    return {
        "rms_mm": 1e3 * found.rms,
        "p95_mm": 1e3 * found.p95,
        "inside": float((squares < INSIDE_95).double().mean()),
    }


def measure(arguments: argparse.Namespace) -> Iterator[Record]:
    """Yield the records of both directions, without warnings: so few rows leave much open."""
    warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
    series = {name: (robot, data) for name, robot, data in robots(arguments.data, list(OLD_ROWS))}
    for old, new in (pair for pair in (("ur10_a", "ur10_d"), ("ur10_d", "ur10_a")) if pair[0] in arguments.old):
        (robot, before), (_, data) = series[old], series[new]
        model = dc.calibrate(robot, before.rows(shuffled(len(before), 0)[: OLD_ROWS[old]])).model
        for rows in QUICK_SIZES if arguments.quick else SIZES:
            for seed in range(1 if arguments.quick else arguments.seeds):
                order = shuffled(len(data), seed)
                parts = [
                    data.rows(part) for part in (order[:rows], order[rows : rows + BEFORE], order[rows + BEFORE :])
                ]
                for method in arguments.methods:
                    record: Record = {"series": f"{old} -> {new}", "method": method, "rows": rows, "seed": seed}
                    yield record | one(method, model, *parts)


def one(
    method: str, old: dc.CalibratedKinematics, new: dc.Measurements, before: dc.Measurements, test: dc.Measurements
) -> Record:
    """One method, judged on the held-out rows."""
    begin, changed = time.perf_counter(), ""
    try:
        if method == "fresh":
            model = dc.calibrate(old.robot, new).model
        elif method == "registered":
            model = old.registered(new)
        else:
            found = dc.recalibrate(old if method == "recalibrated" else dc.recalibrate(old, before).model, new)
            model, changed = found.model, ", ".join(change.part for change in found.changes.found)
    except DiffeoCalibError as error:
        return {"changed": f"refused: {error}"}
    return judged(model, test) | {"changed": changed, "seconds": time.perf_counter() - begin}


if __name__ == "__main__":
    harness.run(
        __doc__,
        measure,
        COLUMNS,
        data=harness.DATA,
        old=harness.names(OLD_ROWS, text="series of old models"),
        methods=harness.names(METHODS),
        seeds=harness.number(3, "sets of rows"),
    )
