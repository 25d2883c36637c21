"""Campaigns in which the measuring device was moved by millimetres between blocks of rows.

    python benchmarks/robustness/sessions.py --out sessions.json

Rows of the simulated arm in blocks of 40 to 80, each but the first with the device shifted by 1 to 7 mm and turned by
about a milliradian. `one set-up` has the same rows without these moves; `sessions` names the blocks, `unnamed` not.
Errors are those at 1000 random configurations without noise, after a rigid fit that takes the choice of the frame out.

Fields of a record: `rows`, `seed`, `shuffled`; `rms_mm`; `moved` whether a warning names a moved device.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import warnings
from argparse import Namespace
from collections.abc import Iterator

import harness
import numpy as np
import torch
from harness import Record
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.se3 import rotation

COLUMNS = ("case", "rows", "seed", "shuffled", "rms_mm", "moved")


def campaign(rows: int, seed: int) -> tuple[SimulatedArm, Tensor, Tensor, Tensor, Tensor]:
    """The arm, joint values, points in one set-up and in several, and the number of each row's set-up."""
    arm, rng = SimulatedArm(seed=seed), np.random.default_rng(seed)
    q, points = arm.measure(rows, seed)
    numbers, first, number = np.zeros(rows, int), 0, 0
    while first < rows:
        size = int(rng.integers(40, 81))
        numbers[first : first + size] = number
        first, number = first + size, number + 1
    moved, centre = points.clone(), points.mean((0, 1))
    for k in range(1, number):
        shift = rng.standard_normal(3)
        shift *= rng.uniform(1e-3, 7e-3) / np.linalg.norm(shift)
        turn = rotation(torch.from_numpy(1e-3 * rng.standard_normal(3)))
        own = torch.from_numpy(numbers == k)
        moved[own] = (moved[own] - centre) @ turn.mT + centre + torch.from_numpy(shift)
    return arm, q, points, moved, torch.from_numpy(numbers)


def measure(plan: Namespace) -> Iterator[Record]:
    """A record for every case."""
    for rows in plan.rows:
        for seed in range(plan.seeds):
            arm, q, still, moved, numbers = campaign(rows, seed)
            names = [f"set-up {number}" for number in numbers.tolist()]
            plain = dc.Measurements(q, moved, arm.nominal.joint_names)
            yield from judged(arm, "one set-up", dc.Measurements(q, still, arm.nominal.joint_names), seed)
            for case, data in (("sessions", plain.with_sessions(names)), ("unnamed", plain)):
                yield from judged(arm, case, data, seed)
                order = torch.randperm(rows, generator=torch.Generator().manual_seed(seed))
                lines = list(range(rows))
                yield from judged(arm, case, data.rows(order).with_line_numbers(lines), seed, shuffled=True)


def judged(
    arm: SimulatedArm, case: str, data: dc.Measurements, seed: int, *, shuffled: bool = False
) -> Iterator[Record]:
    """Error of one calibration."""
    record: Record = {"case": case, "rows": len(data), "seed": seed, "shuffled": shuffled}
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        model = dc.calibrate(arm.nominal, data).model
    q = arm.sample(1000, seed + 100)
    found, truth = model(q).flatten(0, 1), arm.true_points(q).flatten(0, 1)
    T = rigid_fit(found, truth)
    errors = (found @ T[:3, :3].mT + T[:3, 3] - truth).norm(dim=-1)
    moved = any("seems to have moved" in str(one.message) for one in heard)
    yield record | {"rms_mm": 1e3 * float(errors.square().mean().sqrt()), "moved": moved}


if __name__ == "__main__":
    rows, seeds = harness.numbers([105, 250]), harness.number(3)
    harness.run(__doc__, measure, COLUMNS, quick={"rows": [105], "seeds": 1}, rows=rows, seeds=seeds)
