"""What does a column of payloads bring? On a simulated elastic arm whose payload changes from row to row.

    python benchmarks/robustness/payloads.py --rows 60 150 --seeds 5 --out payloads.json

Every row carries 0, 5 or 10 kg, drawn at random (0.02 mm noise per coordinate, one marker). The arm is calibrated with
the column of masses, which are said to sit at the flange; with the column and the true place of the masses; without
either; and, to compare, with as many rows under 5 kg throughout. Errors are those of the true positions of 400 other
configurations: under 1.5, 4, 7 or 9 kg, and under 5 kg for the arm that carried them.

Fields of a record: `rows`, `seed`; `with_um`, `placed_um`, `without_um`, `constant_um` held-out RMS errors; `covered`
share of the true positions in the 95 % regions of the model with the column.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import argparse
import warnings
from collections.abc import Iterator

import harness
import numpy as np
import torch
from harness import Record
from held_out import covered

import diffeo_calib as dc
from diffeo_calib.robots.payload import with_load
from diffeo_calib.robots.simulated_arm import PAYLOAD_CENTRE, SimulatedArm

CHOICES, OTHERS, USUAL = (0.0, 5.0, 10.0), (1.5, 4.0, 7.0, 9.0), 5.0
TEST_ROWS = 400
COLUMNS = ("rows", "seed", "with_um", "placed_um", "without_um", "constant_um", "covered")


def measured(rows: int, seed: int) -> Record:
    """Held-out errors of one arm."""
    arm, rng = SimulatedArm(seed), np.random.default_rng(seed)
    masses, other = (torch.from_numpy(rng.choice(kg, count)) for kg, count in ((CHOICES, rows), (OTHERS, TEST_ROWS)))
    q = arm.sample(TEST_ROWS, seed=2000)
    test = dc.Measurements(q, arm.true_points(q, other), doubt=False)
    train = dc.Measurements(*arm.measure(rows, seed=1000 + seed, payload=masses))
    laden = dc.calibrate(arm.nominal, train.with_payload(masses)).model
    robot = with_load(arm.nominal, "load", PAYLOAD_CENTRE)
    placed = dc.calibrate(robot, train.with_payload(masses, at="load")).model
    plain = dc.calibrate(arm.nominal, train).model
    constant = dc.calibrate(arm.nominal, dc.Measurements(*arm.measure(rows, seed=1000 + seed, payload=USUAL))).model
    under_usual = dc.Measurements(q, arm.true_points(q, USUAL), doubt=False)
    errors = {
        "with_um": dc.evaluate(laden, test.with_payload(other)),
        "placed_um": dc.evaluate(placed, test.with_payload(other)),
        "without_um": dc.evaluate(plain, test),
        "constant_um": dc.evaluate(constant, under_usual),
    }
    found = {name: 1e6 * error.rms for name, error in errors.items()}
    mean, covariance = laden.at_payloads(other).predict(test.q, noise=False)
    return {"rows": rows, "seed": seed, **found, "covered": covered(test.points - mean, covariance)}


def measure(arguments: argparse.Namespace) -> Iterator[Record]:
    """Yield one record for every number of rows and seed."""
    sizes, seeds = (arguments.rows[:1], 1) if arguments.quick else (arguments.rows, arguments.seeds)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
        for rows in sizes:
            for seed in range(seeds):
                yield measured(rows, seed)


if __name__ == "__main__":
    rows, seeds = harness.numbers([60, 150], "of a campaign"), harness.number(5, "arms")
    harness.run(__doc__, measure, COLUMNS, rows=rows, seeds=seeds)
