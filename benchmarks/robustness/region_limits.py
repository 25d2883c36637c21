"""How often regions that are exactly right lie within the targets of `regions.py`: what no method can do better.

    python benchmarks/robustness/region_limits.py --data FOLDER --out region_limits.json

One model makes errors that configurations have in common, so that the share of held-out rows in right 95 % regions
differs from model to model. Here errors are drawn from the joint posterior of a model over all held-out rows, with its
noise: its regions are right by construction. Fields of a record, over the draws:

spread         standard deviation of the share of held-out rows in their regions
exact          share of draws within the target
estimated      the same where one factor on all covariances is estimated from as many independent Gaussian numbers as
               were measured: parameters cost nothing, tails are known. A real method has less to go by.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share
sys.path.insert(0, str(Path(__file__).parents[1] / "real_robots"))

import warnings
from argparse import Namespace
from collections.abc import Iterator
from itertools import product

import harness
import numpy as np
import regions
import torch
from harness import Record
from regions import INSIDE_95
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning

SIZES, DRAWS, MOST_ROWS = (15, 20, 30, 40, 60, 150), 400, 400
COLUMNS = ("case", "rows", "seed", "spread", "exact", "estimated", "note")


def factor(covariances: Tensor) -> Tensor:
    """Lower triangular factor of a covariance that rounding may have left without full rank."""
    eye = torch.eye(covariances.shape[-1], dtype=covariances.dtype)
    return torch.linalg.cholesky(covariances + 1e-10 * covariances.diagonal(dim1=-2, dim2=-1).mean() * eye)


def squares(model: dc.CalibratedKinematics, q: Tensor, draws: int, seed: int) -> Tensor:
    """(N, draws) squared errors over their covariances, of new positions of robots that the model expects."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        joint, own, new = model.map.joint_covariance(q), model.predict(q, noise=False)[1], model.predict(q)[1]
    own, new = own.reshape(-1, 3, 3), new.reshape(-1, 3, 3)
    joint = joint.reshape(3 * len(q), -1)
    widened = own.diagonal(dim1=-2, dim2=-1).sum() / joint.diagonal().sum()
    shape = 3 * len(q), draws
    errors = factor(widened * joint) @ torch.randn(shape, generator=generator, dtype=joint.dtype)
    noise = torch.randn(shape, generator=generator, dtype=joint.dtype).unflatten(0, (-1, 3))
    errors = errors.unflatten(0, (-1, 3)) + factor(new - own) @ noise
    return (errors * torch.linalg.solve(new, errors)).sum(1)


def measured(name: str, rows: int, seed: int, plan: Namespace) -> Record:
    """Shares within the target, for one model."""
    found = regions.case(name, rows, seed, plan.data)
    own = squares(dc.calibrate(found.robot, found.train).model, found.test.q[:MOST_ROWS], DRAWS, seed)
    numbers = 3 * rows
    factors = torch.from_numpy(np.random.default_rng(seed).chisquare(numbers, DRAWS) / numbers)
    exact, estimated = ((own < INSIDE_95 * each).double().mean(0) for each in (1.0, factors))
    low, high = regions.MANY_RANGE if rows >= regions.MANY_ROWS else regions.FEW_RANGE
    record: Record = {"case": name, "rows": rows, "seed": seed, "spread": float(exact.std())}
    for key, shares in (("exact", exact), ("estimated", estimated)):
        record[key] = float(((shares >= low) & (shares <= high)).double().mean())
    return record


def measure(plan: Namespace) -> Iterator[Record]:
    """Yield a record for every set, number of rows and seed."""
    for rows, seed in product(plan.sizes or SIZES, range(plan.seeds)):
        for name in plan.cases:
            try:
                yield measured(name, rows, seed, plan)
            except Exception as error:  # the others are still measured
                yield {"case": name, "rows": rows, "seed": seed, "note": f"{type(error).__name__}: {error}"}


def summary(records: list[Record]) -> list[Record]:
    """Means over the sets of each number of rows."""
    found: list[Record] = []
    for rows in dict.fromkeys(r["rows"] for r in records):
        some = [r for r in records if r["rows"] == rows and "exact" in r]
        means = {
            name: float(np.mean([float(r[name] or 0.0) for r in some])) for name in ("spread", "exact", "estimated")
        }
        found.append({"rows": rows, "sets": len(some), **means})
    return found


def run(plan: Namespace) -> None:
    """Measure, print single records and the summary."""
    warnings.simplefilter("ignore", DiffeoCalibWarning)
    records = harness.report(measure(plan), plan.out, COLUMNS)
    harness.Console(width=harness.WIDTH).print(harness.table(summary(records)))


if __name__ == "__main__":
    harness.guarded(lambda: run(regions.arguments()))
