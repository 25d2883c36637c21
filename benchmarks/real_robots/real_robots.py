"""Held-out accuracy on real robots: the package against other calibration methods on the same measurements.

    python benchmarks/real_robots/real_robots.py --data FOLDER --out real.json --figure real.png
    python benchmarks/real_robots/real_robots.py --from real.json more.json --figure real.png

The folder (default: DIFFEO_CALIB_DATA) has one subfolder per data set; robot_data.py describes its `dataset.json`, and
scripts/get_ur10_data.py fetches a data set. protocols.py splits the rows, baselines.py has the methods; the learners
among them need scikit-learn (`pip install ".[bench]"`).

Fields of a record: `size` is the requested number of training poses, `train` and `test` the numbers of rows;
`fold_or_seed`; errors are distances of markers in mm (`rms_deg`: of orientations, with --poses); `seconds` is the time
of the whole calibration; `coverage_95` is the share of held-out markers inside the method's 95 % ellipsoids (if it
predicts any); `note` says why a calibration failed or stopped early.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import time
from argparse import Namespace
from collections.abc import Iterator

import harness
import learning_curves
import torch
from baselines import METHODS, Fitted
from harness import Record
from protocols import ALL, PROTOCOLS, SIZES, Split, splits
from rich.console import Console
from robot_data import RobotData, data_folder, find, read

import diffeo_calib as dc

SEEDS = 5
QUICK_SIZES, QUICK_METHODS = (60, 150), ("registration", "geometry", "diffeo_calib")
INSIDE_95 = 7.8147
"""95 % quantile of chi-square with 3 degrees of freedom."""
KEY = ("dataset", "protocol", "size", "method", "fold_or_seed")
COLUMNS = ("dataset", "protocol", "size", "fold_or_seed", "method", "train", "test", "rms_mm", "median_mm", "p95_mm")
COLUMNS = (*COLUMNS, "max_mm", "rms_deg", "coverage_95", "seconds", "note")


def measure(plan: Namespace) -> Iterator[Record]:
    """Yield a record for every data set, split and method."""
    folder = data_folder(plan.data)
    found = [read(folder / name, entries, poses=plan.poses) for name, entries in find(folder, plan.dataset).items()]
    for data in found:
        for split in splits(data.measurements, plan.protocol, plan.sizes, plan.seeds):
            for method in plan.methods:
                yield attempt(data, split, method)


def attempt(data: RobotData, split: Split, method: str) -> Record:
    """Calibrate once; a failure becomes a record with the reason."""
    record: Record = {
        "dataset": data.name,
        "robot_joints": data.robot.n,
        "protocol": split.protocol,
        "size": split.size,
        "method": method,
        "train": len(split.train),
        "test": len(split.test),
        "fold_or_seed": split.index,
    }
    begin = time.perf_counter()
    try:
        fitted = METHODS[method](data.robot, split.train, split.index)
        seconds = time.perf_counter() - begin
        return record | errors(fitted, split.test) | {"seconds": seconds, "note": fitted.note}
    except ModuleNotFoundError as error:
        return record | {"note": f"needs {error.name}: pip install '.[bench]'"}
    except Exception as error:  # the remaining methods are still measured
        return record | {"note": f"{type(error).__name__}: {error}"}


def errors(fitted: Fitted, test: dc.Measurements) -> Record:
    """Errors on held-out rows."""
    found = dc.evaluate(fitted.kinematics, test)
    record: Record = {f"{name}_mm": 1e3 * getattr(found, name) for name in ("rms", "median", "p95", "max")}
    record["rms_deg"] = None if found.orientation is None else found.orientation.rms
    record["coverage_95"] = None if fitted.predict is None else coverage(*fitted.predict(test.q), test)
    return record


def coverage(mean: torch.Tensor, covariance: torch.Tensor, test: dc.Measurements) -> float:
    """Share of markers inside the 95 % ellipsoids: mean (N, P, 3), covariance (N, P, 3, 3)."""
    error = (test.points - mean)[..., None]
    distance = (error.mT @ torch.linalg.solve(covariance, error)).flatten()
    return float((distance < INSIDE_95).double().mean())


def arguments(given: list[str] | None = None) -> Namespace:
    """Parse the command line; --quick overrides sizes, seeds, methods and protocols."""
    parser = harness.parser(__doc__)
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="folder of data sets; default: $DIFFEO_CALIB_DATA")
    parser.add_argument("--dataset", nargs="+", default=[], metavar="NAME", help="all in the folder by default")
    parser.add_argument("--protocol", nargs="+", choices=PROTOCOLS, default=list(PROTOCOLS))
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--seeds", type=harness.count, default=SEEDS, metavar="N", help="splits of the protocol curve")
    sizes = [*SIZES, None]
    parser.add_argument("--sizes", nargs="+", type=size, default=sizes, metavar="N", help=f"of curve; or '{ALL}'")
    parser.add_argument("--poses", action="store_true", help="use orientations too, where they were measured")
    parser.add_argument("--figure", type=Path, metavar="FILE.png", help="draw learning curves")
    parser.add_argument(
        "--from", dest="earlier", nargs="+", type=Path, metavar="FILE.json", help="read, do not measure"
    )
    plan = parser.parse_args(given)
    if plan.quick:
        plan.protocol, plan.sizes, plan.seeds, plan.methods = ["curve"], list(QUICK_SIZES), 1, list(QUICK_METHODS)
    return plan


def size(text: str) -> int | None:
    """Number of training poses, or all."""
    return None if text == ALL else harness.count(text)


def run(plan: Namespace) -> None:
    """Measure or read, print the means, draw."""
    if plan.figure is not None:
        learning_curves.check_place(plan.figure)  # before hours of work
    records = harness.earlier(plan.earlier, KEY) if plan.earlier else harness.report(measure(plan), plan.out, COLUMNS)
    console = Console(width=None if sys.stdout.isatty() else harness.WIDTH)
    console.print("Means over seeds or folds")
    console.print(harness.table(learning_curves.summary(records), learning_curves.SUMMARY))
    if plan.figure is not None:
        learning_curves.draw(records, plan.figure)
        console.print(f"wrote {plan.figure}")


if __name__ == "__main__":
    harness.guarded(lambda: run(arguments()))
