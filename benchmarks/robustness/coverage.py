"""How many points lie in the predicted 95 % regions: on simulated arms whose truth is known, and on real robots.

    python benchmarks/robustness/coverage.py --out coverage.json
    python benchmarks/robustness/coverage.py --cases clean t3 --sizes 30 60 --seeds 20
    python benchmarks/robustness/coverage.py --cases ipa_ur10 ipa_ur10_a franka_fr3 --data FOLDER --sizes 30 60

Cases of the simulated arm: `clean` (Gaussian noise of 0.02 mm), `t3` (Student's t with 3 degrees of freedom, the same
scale), `outliers` (2 % of the training rows are wrong by 5 mm). Of real robots, which need measurements, random
configurations with their repeats are the training set and all others are held out.

Fields of a record: `measured` is the share of new measurements in the regions of `predict`, `true` that of the true
places in those of `predict(noise=False)`; `outside` is the share of measurements of configurations beyond the joint
limits, which the training set fills, by up to 20 % of the range on either side, at least one joint of each. Errors
within one fit are correlated, so that the coverage of a perfect model varies too: `perfect_std` is its standard
deviation over draws of the robot from the posterior of this fit. `seconds` is the time of the calibration.
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

import harness
import numpy as np
import torch
from harness import Record
from robot_data import BUILT_IN, data_folder, descriptor, read
from scipy.stats import chi2, t
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.robots.simulated_arm import SimulatedArm

SIMULATED = ("clean", "t3", "outliers")
SIZES, SEEDS = (30, 60, 150, 450), 20
QUICK_SIZES, QUICK_SEEDS = (30,), 2
TEST_ROWS, DRAWS = 300, 40
BEYOND = 0.2
FREEDOM, WRONG_SHARE, WRONG_M = 3.0, 0.02, 5e-3
SERIES_A = {"ipa_ur10_a": ("ipa_ur10", "measurements_grid_900.csv")}
"""A second table of a data set."""
INSIDE_95 = float(chi2.ppf(0.95, 3))
SHARES = ("measured", "true", "outside")


def noise(shape: tuple[int, ...], case: str, sigma: float, rng: np.random.Generator) -> Tensor:
    """Errors of measurements, m."""
    drawn = sigma * rng.standard_normal(shape)
    if case == "t3":
        drawn /= np.sqrt(rng.chisquare(FREEDOM, (shape[0], 1, 1)) / FREEDOM)
    return torch.from_numpy(drawn)


def beyond(arm: SimulatedArm, count: int, rng: np.random.Generator) -> Tensor:
    """Configurations (count, 6) with at least one joint outside of the limits, rad."""
    low, high = arm.nominal.limits.unbind(1)
    share = torch.from_numpy(rng.uniform(-BEYOND, 1 + BEYOND, (8 * count, arm.nominal.n)))
    return (low + (high - low) * share[((share < 0) | (share > 1)).any(1)])[:count]


def simulated(case: str, poses: int, seed: int) -> Record:
    """Calibrate one simulated arm."""
    arm, rng = SimulatedArm(seed=seed), np.random.default_rng([seed, poses])
    q = arm.sample(poses + TEST_ROWS, seed)
    true = arm.true_points(q)
    points = true + noise(tuple(true.shape), case, arm.noise, rng)
    if case == "outliers":
        wrong = rng.permutation(poses)[: max(1, round(WRONG_SHARE * poses))]
        direction = rng.standard_normal((len(wrong), 1, 3))
        points[wrong] += torch.from_numpy(WRONG_M * direction / np.linalg.norm(direction, axis=-1, keepdims=True))
    begin = time.perf_counter()
    model = dc.calibrate(arm.nominal, dc.Measurements(q[:poses], points[:poses])).model
    seconds = time.perf_counter() - begin
    away = beyond(arm, TEST_ROWS, rng)
    seen = arm.true_points(away)
    seen = seen + noise(tuple(seen.shape), case, arm.noise, rng)
    return {
        **{"case": case, "poses": poses, "seed": seed},
        "measured": coverage(model, q[poses:], points[poses:]),
        "true": coverage(model, q[poses:], true[poses:], noise=False),
        "outside": coverage(model, away, seen),
        **common(model, q[poses:], true[poses:], seconds),
    }


def measured(case: str, poses: int, seed: int, folder: Path) -> Record:
    """Calibrate a real robot with some of its configurations."""
    name, csv = SERIES_A.get(case, (case, None))
    entries = descriptor(folder / name) if csv is None else {**BUILT_IN[name], "csv": csv}
    found = read(folder / name, entries)
    train, test = split(found.measurements, poses, seed)
    begin = time.perf_counter()
    model = dc.calibrate(found.robot, train).model
    seconds = time.perf_counter() - begin
    record: Record = {"case": case, "poses": poses, "seed": seed, "measured": coverage(model, test.q, test.points)}
    return record | common(model, test.q[:TEST_ROWS], test.points[:TEST_ROWS], seconds)


def split(data: dc.Measurements, poses: int, seed: int) -> tuple[dc.Measurements, dc.Measurements]:
    """About ``poses`` rows of random configurations with all their repeats, and the other rows."""
    groups = data.groups().numpy()
    order = np.random.default_rng([seed, 9]).permutation(groups.max() + 1)
    rows = np.cumsum(np.bincount(groups)[order])
    inside = np.isin(groups, order[: np.searchsorted(rows, poses) + 1])
    return data[inside], data[~inside]


def coverage(model: dc.CalibratedKinematics, q: Tensor, points: Tensor, *, noise: bool = True) -> float:
    """Share of points (N, P, 3) in their 95 % regions."""
    mean, covariance = model.predict(q, noise=noise)
    return float((squares(points - mean, covariance) < INSIDE_95).double().mean())


def squares(errors: Tensor, covariance: Tensor) -> Tensor:
    """Squared Mahalanobis distances: (..., 3), (..., 3, 3) -> (...)."""
    return (errors * torch.linalg.solve(covariance, errors[..., None])[..., 0]).sum(-1)


def common(model: dc.CalibratedKinematics, q: Tensor, points: Tensor, seconds: float) -> Record:
    """Fields of both kinds of records."""
    error = 1e3 * float((points - model(q)).square().sum(-1).mean().sqrt())
    return {"rms_mm": error, "perfect_std": perfect_deviation(model, q), "seconds": seconds}


def perfect_deviation(model: dc.CalibratedKinematics, q: Tensor) -> float:
    """Standard deviation of the coverage over draws of errors from the model's own posterior, new noise added."""
    n, m = len(q), model.map.m
    _, at = model.map.geodesic.linearised_value(q)
    values, vectors = torch.linalg.eigh(model.map.conditional.covariance_between(at))
    root, new = vectors * values.clamp(min=0).sqrt(), torch.linalg.cholesky(model.map.new_noise)
    rng = np.random.default_rng(0)
    covariance, found = model.predict(q)[1], []
    for _ in range(DRAWS):
        own = (root @ torch.from_numpy(rng.standard_normal(n * m))).view(n, m)
        errors = own + torch.from_numpy(rng.standard_normal((n, m))) @ new.mT
        found.append(float((squares(errors.unflatten(1, (-1, 3)), covariance) < INSIDE_95).double().mean()))
    return float(np.std(found, ddof=1))


def measure(plan: Namespace) -> Iterator[Record]:
    """Yield a record for every case, size and seed; a failure becomes a record with the reason."""
    for case in plan.cases:
        for poses in plan.sizes:
            for seed in range(plan.seeds):
                try:
                    simulation = case in SIMULATED
                    yield simulated(case, poses, seed) if simulation else measured(case, poses, seed, plan.data)
                except Exception as error:  # the others are still measured
                    yield {"case": case, "poses": poses, "seed": seed, "note": f"{type(error).__name__}: {error}"}


def summary(records: list[Record]) -> list[Record]:
    """Means over seeds with their 95 % confidence intervals, spreads over seeds, and that of a perfect model."""
    rows: list[Record] = []
    for case, poses in dict.fromkeys((record["case"], record["poses"]) for record in records):
        some = [r for r in records if (r["case"], r["poses"]) == (case, poses) and "measured" in r]
        row: Record = {"case": case, "poses": poses, "seeds": len(some)}
        for name in SHARES:
            values = np.array([float(r[name] or 0.0) for r in some if name in r])
            if len(values) > 1:
                half = float(t.ppf(0.975, len(values) - 1)) * values.std(ddof=1) / len(values) ** 0.5
                row[name] = f"{values.mean():.3f} +- {half:.3f}"
                row[f"{name}_std"], row[f"{name}_min"] = float(values.std(ddof=1)), float(values.min())
        for name in ("perfect_std", "rms_mm", "seconds"):
            row[name] = float(np.mean([float(r[name] or 0.0) for r in some])) if some else None
        rows.append(row)
    return rows


def arguments(given: list[str] | None = None) -> Namespace:
    """Parse the command line; --quick overrides sizes, seeds and cases."""
    parser = harness.parser(__doc__)
    known = [*SIMULATED, "ipa_ur10", *SERIES_A, "franka_fr3"]
    parser.add_argument("--cases", nargs="+", choices=known, default=list(SIMULATED))
    parser.add_argument("--sizes", nargs="+", type=harness.count, default=list(SIZES), metavar="N")
    parser.add_argument("--seeds", type=harness.count, default=SEEDS, metavar="N")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="folder of data sets; default: $DIFFEO_CALIB_DATA")
    plan = parser.parse_args(given)
    if plan.quick:
        plan.cases, plan.sizes, plan.seeds = ["clean"], list(QUICK_SIZES), QUICK_SEEDS
    if not set(plan.cases) <= set(SIMULATED):
        plan.data = data_folder(plan.data)
    return plan


def run(plan: Namespace) -> None:
    """Measure, print single records and the means over seeds."""
    warnings.simplefilter("ignore", DiffeoCalibWarning)
    records = harness.report(measure(plan), plan.out)
    harness.Console(width=harness.WIDTH).print(harness.table(summary(records)))


if __name__ == "__main__":
    harness.guarded(lambda: run(arguments()))
