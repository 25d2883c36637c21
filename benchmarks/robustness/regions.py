"""Coverage and sharpness of predicted 95 % regions, over simulated arms of eleven kinds and measured robots.

    python benchmarks/robustness/regions.py --data FOLDER --out regions.json
    python benchmarks/robustness/regions.py --sizes 20 60 --seeds 1 --methods fresh      (packaged arm alone)

Simulated arms (`varied_arms.py`) take turns on the packaged chain and, with --data, on a UR10, an iiwa and a Panda.
With --data the measured sets are the UR10's series D and A and the Franka FR3. Rows that are not used for training are
held out; a simulated arm has 400 random ones. Methods:

fresh          a calibration of `rows` rows
registered     a model of 150 rows of a simulated arm, or of a whole series of the UR10, with device and marker found
               anew from `rows` rows of another date, drawn at random
recalibrated   `dc.recalibrate` of that model with the same rows

scales_of      a calibration of `rows` rows with the scales of a model of 150 rows: of another arm of the same kind and
               chain, or of the other series of the UR10

On the other date, device and marker of a simulated arm are elsewhere and its errors differ by `drift` (0, 5 or 20 %).

Fields of a record: `new` is the share of held-out measurements in the regions of `predict`, `robot` that of the true
places in those of `predict(noise=False)` (simulated arms only), `sharpness` the root mean square of the predicted
deviations of new measurements over `rms_mm`, the RMS of their errors. `seconds` is the time of the method.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share
sys.path.insert(0, str(Path(__file__).parents[1] / "real_robots"))

import time
import warnings
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import product

import harness
import numpy as np
import torch
from harness import Record
from robot_data import BUILT_IN, RobotData, data_folder, descriptor, read
from scipy.stats import chi2
from torch import Tensor
from varied_arms import KINDS, VariedArm

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError
from diffeo_calib.robots.simulated_arm import URDF_FILE

SIZES, DATED_SIZES, SEEDS = (15, 20, 30, 40, 60, 150, 300), (10, 20, 60), 2
METHODS = ("fresh", "scales_of", "registered", "recalibrated")
FRESH = METHODS[:2]
TEST_ROWS, OLD_ROWS = 400, 150
OLD_SERIES_ROWS = {"ipa_ur10_a": 700, "ipa_ur10": 442}
OTHER_SERIES = {"ipa_ur10_a": "ipa_ur10", "ipa_ur10": "ipa_ur10_a"}
MEASURED = (*OTHER_SERIES, "franka_fr3")
SERIES_A = {"ipa_ur10_a": ("ipa_ur10", "measurements_grid_900.csv")}
"""A second table of a data set."""
INSIDE_95 = float(chi2.ppf(0.95, 3))
SHARP = 0.9, 1.15
"""Target range of `sharpness`."""
COLUMNS = ("method", "case", "rows", "seed", "drift", "new", "robot", "sharpness", "rms_mm", "seconds", "note")
DRIFTS = 0.0, 0.05, 0.2
DATED_KINDS = ("usual", "stiff", "soft", "gears", "t3", "noisy")
CHAINS = (
    ("ipa_ur10/ur10_robot.urdf", "base_link", "ee_link"),
    ("mukca/iiwa14.urdf", "base_link", "ball_link"),
    ("mukca/panda.urdf", "panda_link0", "ball_link"),
)
MANY_ROWS, MANY_RANGE, FEW_RANGE, DATED_RANGE = 60, (0.92, 0.98), (0.90, 0.99), (0.90, 0.98)
"""Target ranges of `new`: of fresh calibrations from MANY_ROWS on and of fewer rows, and of another date."""


@dataclass(frozen=True)
class Case:
    """One robot with rows for training and held-out rows; ``truth`` is (N, 1, 3), m, where it is known."""

    robot: dc.Tree
    train: dc.Measurements
    test: dc.Measurements
    truth: Tensor | None = None


@cache
def chains(folder: Path | None) -> list[dc.Tree]:
    """Nominal chains of the simulated arms."""
    found = [dc.load_urdf(URDF_FILE, base="base_link", tip="flange")]
    return (
        found if folder is None else [*found, *(dc.load_urdf(folder / file, base, tip) for file, base, tip in CHAINS)]
    )


@cache
def series(name: str, folder: Path) -> RobotData:
    """A measured robot."""
    own, csv = SERIES_A.get(name, (name, None))
    return read(folder / own, descriptor(folder / own) if csv is None else {**BUILT_IN[own], "csv": csv})


def arm(kind: str, seed: int, folder: Path | None) -> VariedArm:
    """A simulated arm of a kind."""
    number, nominal = list(KINDS).index(kind), chains(folder)
    return VariedArm(nominal[(number + seed) % len(nominal)], KINDS[kind], 100 * number + seed)


def simulated(own: VariedArm, rows: int, seed: int, style: str | None = None) -> Case:
    """Rows of a simulated arm, and random ones that are held out."""
    q, held_out = own.rows(rows, seed, style), own.rows(TEST_ROWS, seed + 1000, "random")
    names = own.nominal.joint_names
    train = dc.Measurements(q, own.measured(q, seed), names)
    test = dc.Measurements(held_out, own.measured(held_out, seed + 1000), names)
    return Case(own.nominal, train, test, own.true_points(held_out))


def case(name: str, rows: int, seed: int, folder: Path | None) -> Case:
    """Rows of an arm or of a measured robot."""
    if name in KINDS:
        return simulated(arm(name, seed, folder), rows, seed)
    if folder is None:
        raise InputError.of(f"the measured set '{name}'", expected="a folder of data sets")
    found = series(name, folder)
    return Case(found.robot, *split(found.measurements, rows, seed))


def split(data: dc.Measurements, poses: int, seed: int) -> tuple[dc.Measurements, dc.Measurements]:
    """About ``poses`` rows of random configurations with all their repeats, and the other rows."""
    groups = data.groups().numpy()
    order = np.random.default_rng([seed, 9]).permutation(groups.max() + 1)
    rows = np.cumsum(np.bincount(groups)[order])
    inside = np.isin(groups, order[: np.searchsorted(rows, poses) + 1])
    return data[inside], data[~inside]


@cache
def other_robot(name: str, seed: int, folder: Path | None) -> dc.CalibratedKinematics:
    """The model of another robot of the same type."""
    other = seed if name in OTHER_SERIES else seed + len(chains(folder))
    found = case(OTHER_SERIES.get(name, name), OLD_ROWS, other, folder)
    return dc.calibrate(found.robot, found.train).model


@cache
def old_model(name: str, seed: int, folder: Path | None) -> dc.CalibratedKinematics:
    """The model of an earlier date, or of another robot of the same type."""
    rows = OLD_SERIES_ROWS.get(name, OLD_ROWS)
    old = case(name, rows, 0 if name in OTHER_SERIES else seed, folder)
    return dc.calibrate(old.robot, old.train).model


def another_date(name: str, rows: int, seed: int, drift: float, folder: Path | None) -> tuple[str, Case]:
    """The name of the old model, and rows of the same robot on another date."""
    if name in OTHER_SERIES:
        return OTHER_SERIES[name], case(name, rows, seed, folder)
    later = arm(name, seed, folder).later(7000 + 100 * list(KINDS).index(name) + seed, drift)
    return name, simulated(later, rows, 50 + seed, "random")


def judged(model: dc.CalibratedKinematics, found: Case) -> Record:
    """Errors, coverage and sharpness on held-out rows."""
    mean, covariance = model.predict(found.test.q)
    error = found.test.points - mean
    rms = float(error.square().sum(-1).mean().sqrt())
    predicted = float(covariance.diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt())
    new = _share(error, covariance)
    record: Record = {"new": new, "robot": None, "sharpness": predicted / rms, "rms_mm": 1e3 * rms}
    if found.truth is not None:
        record["robot"] = _share(found.truth - mean, model.predict(found.test.q, noise=False)[1])
    return record


def squares(errors: Tensor, covariance: Tensor) -> Tensor:
    """Squared Mahalanobis distances: (..., 3), (..., 3, 3) -> (...)."""
    return (errors * torch.linalg.solve(covariance, errors[..., None])[..., 0]).sum(-1)


def _share(error: Tensor, covariance: Tensor) -> float:
    return float((squares(error, covariance) < INSIDE_95).double().mean())


def measured(keys: Record, name: str, rows: int, seed: int, plan: Namespace) -> Record:
    """One model, judged; a failure becomes a record with the reason."""
    try:
        method, old = keys["method"], None
        if method in FRESH:
            found = case(name, rows, seed, plan.data)
            others = [other_robot(name, seed, plan.data)] if method == "scales_of" else []
        else:
            others, drift = [], float(keys["drift"] or 0.0)
            earlier, found = another_date(name, rows, seed, drift, plan.data)
            old = old_model(earlier, seed, plan.data)
        begin = time.perf_counter()
        if old is None:
            model = dc.calibrate(found.robot, found.train, scales_of=others).model
        elif method == "registered":
            model = old.registered(found.train)
        else:
            model = dc.recalibrate(old, found.train).model
        return {**keys, **judged(model, found), "seconds": time.perf_counter() - begin}
    except Exception as error:  # the others are still measured
        return {**keys, "note": f"{type(error).__name__}: {error}"}


def measure(plan: Namespace) -> Iterator[Record]:
    """Yield a record for every method, set and number of rows."""
    for method in plan.methods:
        fresh = method in FRESH
        known = plan.cases if method == "fresh" else [*KINDS, *OTHER_SERIES] if fresh else [*DATED_KINDS, *OTHER_SERIES]
        for rows in plan.sizes or (SIZES if fresh else DATED_SIZES):
            for seed, name in product(range(plan.seeds), [name for name in plan.cases if name in known]):
                for drift in (None,) if fresh or name in OTHER_SERIES else DRIFTS:
                    keys: Record = {"method": method, "case": name, "rows": rows, "seed": seed, "drift": drift}
                    yield measured(keys, name, rows, seed, plan)


def summary(records: list[Record]) -> list[Record]:
    """Over all sets of a method and a number of rows: means, ranges, and the share of sets within the targets."""
    rows: list[Record] = []
    for method, count in dict.fromkeys((r["method"], int(r["rows"] or 0)) for r in records):
        some = [r for r in records if (r["method"], r["rows"]) == (method, count) and "new" in r]
        if not some:
            continue
        new, robot, sharp, rms = (_numbers(some, name) for name in ("new", "robot", "sharpness", "rms_mm"))
        low, high = DATED_RANGE if method not in FRESH else MANY_RANGE if count >= MANY_ROWS else FEW_RANGE
        row: Record = {"method": method, "rows": count, "sets": len(some), "new": _range(new)}
        row |= {"within": float(((new >= low) & (new <= high)).mean()), "robot": _range(robot)}
        row |= {"sharpness": _range(sharp), "sharp": float(((sharp >= SHARP[0]) & (sharp <= SHARP[1])).mean())}
        rows.append({**row, "rms_mm": float(np.exp(np.log(rms).mean()))})
    return rows


def _numbers(records: list[Record], name: str) -> np.ndarray:
    return np.array([float(r[name] or 0.0) for r in records if r[name] is not None])


def _range(values: np.ndarray) -> str:
    """Mean, smallest and largest."""
    return f"{values.mean():.3f} ({values.min():.3f}-{values.max():.3f})" if len(values) else ""


def arguments(given: list[str] | None = None) -> Namespace:
    """Parse the command line; --quick overrides methods, cases, sizes and seeds."""
    parser = harness.parser(__doc__)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--cases", nargs="+", choices=[*KINDS, *MEASURED])
    parser.add_argument("--sizes", nargs="+", type=harness.count, metavar="N", help="numbers of rows")
    parser.add_argument("--seeds", type=harness.count, default=SEEDS, metavar="N")
    parser.add_argument(
        "--data", type=Path, metavar="FOLDER", help="folder of data sets; default: simulated arms alone"
    )
    plan = parser.parse_args(given)
    if plan.quick:
        plan.methods, plan.cases, plan.sizes, plan.seeds = ["fresh"], ["usual"], [20], 1
    plan.data = data_folder(plan.data) if plan.data or not set(plan.cases or ()) <= set(KINDS) else None
    plan.cases = plan.cases or [*KINDS, *(MEASURED if plan.data else ())]
    return plan


def run(plan: Namespace) -> None:
    """Measure, print single records and the summary."""
    warnings.simplefilter("ignore", DiffeoCalibWarning)
    records = harness.report(measure(plan), plan.out, COLUMNS)
    harness.Console(width=harness.WIDTH).print(harness.table(summary(records)))


if __name__ == "__main__":
    harness.guarded(lambda: run(arguments()))
