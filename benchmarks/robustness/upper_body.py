"""A simulated elastic upper body: what it brings to know that a robot is a tree.

    python benchmarks/robustness/upper_body.py --out upper_body.json

Both hands of a torso with two arms are measured. `chain` is the serial robot to the left hand, which cannot know where
the other arm is; `load` has the right arm as a load; `both` has both hands as tips. Errors are those at 1000 random
configurations without noise, of the left hand for the first two.

Fields of a record: `rows` and `seed`; `mean_mm`, `rms_mm`, `geometry_mm` (of the geometric calibration, RMS);
`coverage_95` of new noisy measurements; `seconds` of the calibration.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import time
import warnings
from argparse import Namespace
from collections.abc import Iterator

import harness
import torch
from harness import Record

import diffeo_calib as dc
from diffeo_calib.robots.simulated_body import HANDS, SimulatedUpperBody

ROBOTS = {"chain": (HANDS[:1], ()), "load": (HANDS[:1], HANDS[1:]), "both": (HANDS, ())}
INSIDE_95 = 7.8147
"""95 % quantile of chi-square with 3 degrees of freedom."""
COLUMNS = ("robot", "rows", "seed", "mean_mm", "rms_mm", "geometry_mm", "coverage_95", "seconds")


def measure(plan: Namespace) -> Iterator[Record]:
    """A record for every robot, number of rows and seed."""
    for rows in plan.rows:
        for seed in range(plan.seeds):
            body = SimulatedUpperBody(seed)
            for name in ROBOTS:
                yield {"robot": name, "rows": rows, "seed": seed} | calibrated(body, name, rows, seed)


def calibrated(body: SimulatedUpperBody, name: str, rows: int, seed: int) -> Record:
    """Errors of a calibration on configurations that it has not seen."""
    tips, loads = ROBOTS[name]
    robot, count = body.robot(tips, loads), len(tips)
    columns = body.columns(robot)
    q, points = body.measure(rows, seed)
    data = dc.Measurements(q[:, columns], points[:, :count], robot.joint_names, on=tips)
    begin = time.perf_counter()
    result = dc.calibrate(robot, data)
    seconds = time.perf_counter() - begin
    q = body.sample(1000, seed + 100)
    truth = body.true_points(q)[:, :count]
    q = q[:, columns]
    mean, covariance = result.model.predict(q)
    noise = body.noise * torch.randn(truth.shape, dtype=truth.dtype, generator=torch.Generator().manual_seed(1))
    errors, geometry = mean - truth, result.identification.geometry.points(q) - truth
    seen = (errors - noise)[..., None]
    squares = (seen.mT @ torch.linalg.solve(covariance, seen)).flatten()
    return {
        "mean_mm": 1e3 * float(errors.norm(dim=-1).mean()),
        "rms_mm": 1e3 * float(errors.norm(dim=-1).square().mean().sqrt()),
        "geometry_mm": 1e3 * float(geometry.norm(dim=-1).square().mean().sqrt()),
        "coverage_95": float((squares < INSIDE_95).double().mean()),
        "seconds": seconds,
    }


def arguments() -> Namespace:
    """Parse the command line."""
    parser = harness.parser(__doc__)
    parser.add_argument("--rows", nargs="+", type=harness.count, default=[150, 350], metavar="N")
    parser.add_argument("--seeds", type=harness.count, default=3, metavar="N")
    plan = parser.parse_args()
    if plan.quick:
        plan.rows, plan.seeds = [60], 1
    return plan


def run(plan: Namespace) -> None:
    """Measure."""
    warnings.simplefilter("ignore")
    harness.report(measure(plan), plan.out, COLUMNS)


if __name__ == "__main__":
    harness.guarded(lambda: run(arguments()))
