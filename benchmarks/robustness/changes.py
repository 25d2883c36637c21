"""Does the test of changes keep its level, and does it name the joint that has changed? On a simulated arm.

    python benchmarks/robustness/changes.py --seeds 400 --cases none --rows 20 60 --out false_alarms.json
    python benchmarks/robustness/changes.py --seeds 50 --out power.json

A model of 150 poses meets 20 or 60 new rows of the same arm, in which nothing has changed (`none`), the transmission
error of one joint has grown by 10, 25, 50 or 100 % (`joint_3 +25 %`), or the payload by 1 or 2 kg (`+1 kg`).

Fields of a record: `case`, `rows`, `sets` of rows; `alarm_5` and `alarm_1` are the shares of sets in which something is
named at 5 and 1 %, `right` the share of the alarms at 5 % whose clearest part is the one that changed.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import argparse
import copy
import warnings
from collections.abc import Iterator

import harness
from harness import Record

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm

TRAINING, SEED = 150, 1
SIZES = (20, 60)
GROWTHS, LOADS = (0.1, 0.25, 0.5, 1.0), (1.0, 2.0)
COLUMNS = ("case", "rows", "sets", "alarm_5", "alarm_1", "right", "named")


def cases(arm: SimulatedArm) -> dict[str, tuple[SimulatedArm, str]]:
    """Name of every case -> the arm as it is now, and the part that has changed."""
    found = {"none": (arm, "")}
    for joint, name in enumerate(arm.nominal.joint_names):
        for growth in GROWTHS:
            found[f"joint_{joint + 1} +{100 * growth:.0f} %"] = (arm.worn(joint, 1.0 + growth), name)
    for load in LOADS:
        found[f"+{load:.0f} kg"] = (SimulatedArm(SEED, payload=arm.payload + load), "gravity")
    return found


def measured(model: dc.CalibratedKinematics, arm: SimulatedArm, part: str, rows: int, sets: int) -> Record:
    """The alarms of many sets of rows."""
    at_5, at_1, right, named = 0, 0, 0, []
    for seed in range(sets):
        data = dc.Measurements(*arm.measure(rows, seed=1000 + seed))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
            found = dc.compare(model, data, seed=seed)
        smallest = min(found.changes.probabilities.values())
        clearest = min(found.changes.probabilities, key=lambda name: found.changes.probabilities[name])
        at_5, at_1 = at_5 + (smallest <= 0.05), at_1 + (smallest <= 0.01)
        right += smallest <= 0.05 and clearest == part
        named += [clearest] if smallest <= 0.05 and clearest != part else []
    wrong = ", ".join(f"{name} {named.count(name)}" for name in sorted(set(named)))
    share = right / at_5 if at_5 and part else None
    return {"sets": sets, "alarm_5": at_5 / sets, "alarm_1": at_1 / sets, "right": share, "named": wrong}


def measure(arguments: argparse.Namespace) -> Iterator[Record]:
    """Yield the records of all cases."""
    arm = SimulatedArm(SEED)
    model = dc.calibrate(arm.nominal, dc.Measurements(*arm.measure(TRAINING, seed=2))).model
    known = cases(copy.copy(arm))
    for case in arguments.cases or known:
        for rows in arguments.rows[:1] if arguments.quick else arguments.rows:
            sets = 2 if arguments.quick else arguments.seeds
            yield {"case": case, "rows": rows} | measured(model, *known[case], rows, sets)


if __name__ == "__main__":
    which = {"nargs": "+", "metavar": "CASE", "help": "which cases; all by default"}
    seeds, rows = harness.number(50, "sets of rows of each case"), harness.numbers(SIZES)
    harness.run(__doc__, measure, COLUMNS, seeds=seeds, rows=rows, cases=which)
