"""A simulated elastic upper body: what it brings to know that a robot is a tree.

    python benchmarks/robustness/upper_body.py --out upper_body.json

Both hands of a torso with two arms are measured. `chain` is the serial robot to the left hand, which cannot know where
the other arm is; `load` has the right arm as a load; `both` has both hands as tips. `load_poses` and `both_poses` are
the last two with measured poses instead of points: each coordinate with a noise of 0.1 mm, each turn with 1 mrad.
Errors are those of the markers at 1000 random configurations without noise.

Fields of a record: `rows` and `seed`; `mean_mm`, `rms_mm`, `left_mm` (RMS of the left hand), `geometry_mm` (RMS of the
geometric calibration); `coverage_95` of new noisy measurements; `seconds` of the calibration.
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
from harness import Record
from held_out import judged, rms_mm
from simulated_body import HANDS, SimulatedUpperBody
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.poses import by_frame

ROBOTS = {"chain": (HANDS[:1], ()), "load": (HANDS[:1], HANDS[1:]), "both": (HANDS, ())}
ROBOTS |= {"load_poses": ROBOTS["load"], "both_poses": ROBOTS["both"]}
COLUMNS = ("robot", "rows", "seed", "mean_mm", "rms_mm", "left_mm", "geometry_mm", "coverage_95", "seconds")


def measure(plan: Namespace) -> Iterator[Record]:
    """A record for every robot, number of rows and seed."""
    for rows in plan.rows:
        for seed in range(plan.seeds):
            body = SimulatedUpperBody(seed)
            for name in plan.robots:
                yield {"robot": name, "rows": rows, "seed": seed} | calibrated(body, name, rows, seed)


def calibrated(body: SimulatedUpperBody, name: str, rows: int, seed: int) -> Record:
    """Errors of a calibration on configurations that it has not seen."""
    tips, loads = ROBOTS[name]
    robot, count = body.robot(tips, loads), len(tips)
    columns = body.columns(robot)
    if name.endswith("_poses"):
        q, poses = body.measure_poses(rows, seed)
        data = dc.Measurements.from_poses(q[:, columns], poses[:, :count], robot.joint_names, on=tips)
    else:
        q, points = body.measure(rows, seed)
        data = dc.Measurements(q[:, columns], points[:, :count], robot.joint_names, on=tips)
    begin = time.perf_counter()
    result = dc.calibrate(robot, data)
    seconds = time.perf_counter() - begin
    q = body.sample(1000, seed + 100)
    truth = body.true_points(q)[:, :count]
    q = q[:, columns]
    mean, covariance = positions(result.model, q)
    geometry = result.identification.geometry.points(q).unflatten(1, (count, -1)).mean(2) - truth
    found = judged(mean, covariance, truth, body.noise)
    return found | {"left_mm": rms_mm((mean - truth)[:, 0]), "geometry_mm": rms_mm(geometry), "seconds": seconds}


def positions(model: dc.CalibratedKinematics, q: Tensor) -> tuple[Tensor, Tensor]:
    """Predicted markers, or origins of measured frames, and covariances: (N, P, 3) m, (N, P, 3, 3) m^2."""
    if model.lever is None:
        return model.predict(q)
    frames, covariance = map(by_frame, model.predict_poses(q))
    return frames[..., :3, 3], covariance[..., :3, :3]


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    options = {"rows": harness.numbers([150, 350]), "robots": harness.names(ROBOTS), "seeds": harness.number(3)}
    harness.run(__doc__, measure, COLUMNS, quick={"rows": [60], "seeds": 1}, **options)
