"""What does a column of times bring where device or arm drift with it, and where nothing does?

    python benchmarks/robustness/drifts.py --seeds 3 --out drifts.json
    python benchmarks/robustness/drifts.py --cases sets --sizes 20 60 --seeds 4 --data FOLDER --out none.json

A simulated arm (0.02 mm of noise, one marker) whose device shifts, whose shoulder's offset changes or which grows in
proportion to time, rows in random order; 100 rows are held out. `sets` are those of `regions.py`, with times drawn at
random (even seeds) or in the order of the rows, with which nothing is known to drift.

Fields of a record: `held_mm` RMS error of held-out rows, `true_mm` that of true places in the middle of the time, both
without the column and `..._column` with it; `used` whether the drift became part of the model.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share
sys.path.insert(0, str(Path(__file__).parents[1] / "real_robots"))

import argparse
import warnings
from collections.abc import Iterator

import harness
import numpy as np
import torch
from harness import Record
from regions import MEASURED, case
from robot_data import data_folder
from torch import Tensor
from varied_arms import KINDS

import diffeo_calib as dc
from diffeo_calib.calibration.placing.placement import Drift
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.robots import SimulatedArm

HELD_OUT, TRUE_ROWS = 100, 300
DRIFTS = {"frame": (1e-4, 3e-4), "joint": (1.5e-4, 3e-4), "growth": (1.5e-4, 3e-4), "none": (0.0,)}
"""Sizes over the whole time: m, rad and parts of the length."""


def drifted(arm: SimulatedArm, name: str, size: float, q: Tensor, time: Tensor) -> Tensor:
    """True places at times from -1/2 to 1/2, m."""
    points, ramp = arm.true_points(q), size * time[:, None, None]
    if name == "frame":
        return points + ramp * torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)
    if name == "growth":
        return points + ramp * (points - points.mean((0, 1)))
    turned = q.clone()
    turned[:, 1] += ramp[:, 0, 0] * (name == "joint")
    return arm.true_points(turned)


def used(result: dc.CalibrationResult) -> bool:
    """Whether the drift is part of the model."""
    return any(isinstance(own, Drift) for own in result.placement)


def simulated(name: str, size: float, rows: int, seed: int) -> Record:
    """One arm, without and with the column."""
    arm, rng = SimulatedArm(seed), np.random.default_rng([seed, 21])
    q, time = arm.sample(rows + HELD_OUT, seed + 100), torch.from_numpy(rng.uniform(-0.5, 0.5, rows + HELD_OUT))
    points = drifted(arm, name, size, q, time)
    points = points + arm.noise * torch.from_numpy(rng.standard_normal(tuple(points.shape)))
    data = dc.Measurements(q, points).with_covariates(time=time)
    train, test, other = data[:rows], data[rows:], arm.sample(TRUE_ROWS, seed + 5)
    record: Record = {"case": name, "size": size, "rows": rows, "seed": seed}
    for end, table in (("", train.with_covariates()), ("_column", train)):
        result = dc.calibrate(arm.nominal, table)
        record[f"held_mm{end}"] = 1e3 * dc.evaluate(result.model, result.aligned(test)).rms
        away = result.model(other) - arm.true_points(other)
        record[f"true_mm{end}"] = 1e3 * float(away.square().sum(-1).mean().sqrt())
        record["used"] = used(result)
    return record


def of_set(name: str, rows: int, seed: int, folder: Path | None) -> Record:
    """A set without a known drift."""
    found = case(name, rows, seed, folder)
    count = len(found.train)
    time = np.arange(count) if seed % 2 else np.random.default_rng([seed, 5]).uniform(size=count)
    result = dc.calibrate(found.robot, found.train.with_covariates(time=time))
    return {"case": name, "size": None, "rows": rows, "seed": seed, "used": used(result)}


def measure(plan: argparse.Namespace) -> Iterator[Record]:
    """Yield the records."""
    for rows in plan.sizes:
        for seed in range(1 if plan.quick else plan.seeds):
            for name in plan.cases:
                for size in DRIFTS.get(name, ()):
                    yield simulated(name, size, rows, seed)
            for name in [*KINDS, *(MEASURED if plan.data else ())] if "sets" in plan.cases else ():
                yield of_set(name, rows, seed, plan.data)


def main() -> None:
    """Parse the arguments and measure."""
    parser = harness.parser(__doc__)
    parser.add_argument("--cases", nargs="+", choices=[*DRIFTS, "sets"], default=list(DRIFTS))
    parser.add_argument("--sizes", nargs="+", type=harness.count, default=[40, 100], metavar="N", help="rows")
    parser.add_argument("--seeds", type=harness.count, default=3, metavar="N")
    parser.add_argument(
        "--data", type=Path, metavar="FOLDER", help="folder of data sets; default: simulated arms alone"
    )
    plan = parser.parse_args()
    plan.data = data_folder(plan.data) if plan.data else None
    warnings.simplefilter("ignore", DiffeoCalibWarning)
    harness.guarded(lambda: _report(plan))


def _report(plan: argparse.Namespace) -> None:
    harness.report(measure(plan), plan.out)


if __name__ == "__main__":
    main()
