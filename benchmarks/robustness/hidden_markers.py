"""Markers that are hidden in some rows, behind the arm for instance: calibrated as they are, and without these rows.

    python benchmarks/robustness/hidden_markers.py --out hidden_markers.json

`arm` has three markers on the tool; 30 % of their sightings are hidden, at random or where a marker faces away from the
tracker. `body` is the upper body with a marker on each hand, of which one is hidden in half of the rows. `all` are the
same rows with every marker, `hidden` those with gaps, `whole rows` the ones that show every marker. Errors are those at
1000 random configurations without noise, of all markers.

Fields of a record: `robot`, `hiding`, `case`, `seed`, `rows` that were used and `sightings` in them; `rms_mm`,
`geometry_mm` (of the geometric calibration); `coverage_95` of new noisy measurements; `seconds` of the calibration.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import time
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator
from math import nan

import harness
import torch
from harness import Record
from held_out import judged, rms_mm
from simulated_body import HANDS, SimulatedUpperBody
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.tree import Tree

HIDDEN_SHARE = 0.3
COLUMNS = ("robot", "hiding", "case", "rows", "sightings", "seed", "rms_mm", "geometry_mm", "coverage_95", "seconds")


def at_random(points: Tensor, seed: int) -> Tensor:
    """(N, P) boolean: 30 % of the sightings are hidden, but not all of a row."""
    hidden = torch.rand(points.shape[:2], generator=torch.Generator().manual_seed(seed)) < HIDDEN_SHARE
    hidden[hidden.all(1), 0] = False
    return hidden


def by_direction(points: Tensor, _: int) -> Tensor:
    """(N, P) boolean: the 30 % of the sightings that face most away from the tracker, at the origin."""
    outwards = points - points.mean(1, keepdim=True)
    facing = torch.nn.functional.cosine_similarity(outwards, -points, dim=2)
    return facing < facing.quantile(HIDDEN_SHARE)


def one_hand(points: Tensor, seed: int) -> Tensor:
    """(N, 2) boolean: in half of the rows one of the two, drawn at random."""
    draws = torch.rand(len(points), generator=torch.Generator().manual_seed(seed))
    return torch.stack([draws < 0.25, draws > 0.75], 1)


def measure(plan: Namespace) -> Iterator[Record]:
    """A record for every robot, way of hiding, case and seed."""
    for seed in range(plan.seeds):
        arm = SimulatedArm(seed=seed, markers=3)
        for record in cases(arm, arm.nominal, arm.measure(plan.arm_rows, seed), (at_random, by_direction), seed):
            yield {"robot": "arm"} | record
    for seed in range(plan.seeds if plan.body_rows else 0):
        body = SimulatedUpperBody(seed)
        for record in cases(body, body.nominal, body.measure(plan.body_rows, seed), (one_hand,), seed):
            yield {"robot": "body"} | record


def cases(
    simulated: SimulatedArm | SimulatedUpperBody,
    robot: Tree,
    measured: tuple[Tensor, Tensor],
    ways: tuple[Callable[[Tensor, int], Tensor], ...],
    seed: int,
) -> Iterator[Record]:
    """All sightings, then every way of hiding some, with and without the rows that it touches."""
    (q, points), on = measured, HANDS if len(robot.tips) > 1 else None
    every = dc.Measurements(q, points, robot.joint_names, on=on)
    yield {"hiding": "none", "case": "all", "seed": seed} | calibrated(simulated, robot, every, seed)
    for hide in ways:
        seen = points.masked_fill(hide(points, seed)[..., None], nan)
        some = dc.Measurements(q, seen, robot.joint_names, on=on)
        for case, data in (("hidden", some), ("whole rows", some.rows(some.visible.all(1)))):
            record: Record = {"hiding": hide.__name__.replace("_", " "), "case": case, "seed": seed}
            yield record | calibrated(simulated, robot, data, seed)


def calibrated(simulated: SimulatedArm | SimulatedUpperBody, robot: Tree, data: dc.Measurements, seed: int) -> Record:
    """Errors of a calibration on configurations that it has not seen."""
    begin = time.perf_counter()
    result = dc.calibrate(robot, data)
    seconds = time.perf_counter() - begin
    q = simulated.sample(1000, seed + 100)
    truth = simulated.true_points(q)
    mean, covariance = result.model.predict(q)
    geometry = result.identification.geometry.points(q) - truth
    record: Record = {"rows": len(data), "sightings": int(data.visible.sum())}
    record |= judged(mean, covariance, truth, simulated.noise)
    return record | {"geometry_mm": rms_mm(geometry), "seconds": seconds}


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    options = {"arm_rows": harness.number(100), "body_rows": harness.number(150), "seeds": harness.number(2)}
    harness.run(__doc__, measure, COLUMNS, quick={"arm_rows": 40, "body_rows": 0, "seeds": 1}, **options)
