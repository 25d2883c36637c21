"""Planned poses against random ones: held-out errors of calibrations with 20, 40, 60 and 100 poses of a pool.

    python benchmarks/real_robots/planning.py --data FOLDER --random 10 --splits 1 --out planning.json
    python benchmarks/real_robots/planning.py --data FOLDER --again --out again.json
    python benchmarks/real_robots/planning.py --speed --out speed.json

30 % of the measured poses of a robot are held out; the others are the pool. Every method chooses from the
configurations of the pool alone, and `dc.calibrate` is run on the poses that it chose:

random          so many rows of the pool, for each of the seeds
farthest        farthest-point design: each pose is the farthest from those chosen, on the torus of the joints
d_optimal       the classical design: each pose raises the determinant of the information about the geometry most
greedy          `dc.plan` of the nominal robot with its usual scales, all poses at once
sequential      20 poses of `dc.plan`, a calibration, 20 poses of `dc.plan` of its model, a calibration, ...
sequential_far  the same, but the first 20 are the farthest-point design

Robots: series D and A of the UR10, the Franka (80 poses in the pool), the simulated arm.

With --again: a model of 400 poses of one series of the UR10 is carried over to the other by 5 to 60 rows, which are
drawn at random or planned (`dc.plan(model, ..., free="base")`): the posterior of the model, linearised, is conditioned
on the rows, the base free.

Fields of a record: `robot`, `method`, `split` and `seed`, `poses`, held-out `rms_mm`, `p95_mm`, and for planned poses
`expected_mm`: the RMS that the plan led to expect, measurement noise included. With --speed: `candidates`, `poses`,
`seconds`.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import argparse
import warnings
from collections.abc import Iterator
from dataclasses import replace

import harness
import torch
from harness import Record
from robot_data import data_folder, find, read
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.planning.scene import of_model
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.simulated_arm import SimulatedArm

SIZES, QUICK_SIZES = (20, 40, 60, 100), (20,)
METHODS = ("random", "farthest", "d_optimal", "greedy", "sequential", "sequential_far")
ARM_ROWS = 800
AGAIN, AGAIN_QUICK, OLD_ROWS = (5, 10, 20, 60), (5,), 400
COLUMNS = ("robot", "method", "split", "seed", "poses", "rms_mm", "p95_mm", "expected_mm")


def robots(folder: Path | None, wanted: list[str]) -> Iterator[tuple[str, dc.Chain, dc.Measurements]]:
    """Yield name, robot and measurements."""
    if "arm" in wanted:
        arm = SimulatedArm(seed=1)
        yield "arm", arm.nominal, dc.Measurements(*arm.measure(ARM_ROWS, seed=2), arm.nominal.joint_names)
    names = {"ur10_d": "ipa_ur10", "ur10_a": "ipa_ur10", "franka": "franka_fr3"}
    for name in wanted:
        if name in names:
            place = data_folder(folder)
            described = dict(find(place, [names[name]])[names[name]])
            if name == "ur10_a":
                described["csv"] = "measurements_grid_900.csv"
            found = read(place / names[name], described)
            yield name, found.robot, found.measurements


def farthest(robot: dc.Chain, q: Tensor, count: int) -> list[int]:
    """Farthest-point design on the torus, from the pose nearest to the mean; slides in half-strokes."""
    turns = torch.tensor(robot.periodic)
    half = 0.5 * (q.amax(0) - q.amin(0)).clamp(min=1e-9)
    lifted = torch.cat([torch.where(turns, q.cos(), q / half), torch.where(turns, q.sin(), 0.0)], 1)
    chosen = [int((lifted - lifted.mean(0)).norm(dim=1).argmin())]
    near = (lifted - lifted[chosen[0]]).norm(dim=1)
    while len(chosen) < count:
        chosen.append(int(near.argmax()))
        near = torch.minimum(near, (lifted - lifted[chosen[-1]]).norm(dim=1))
    return chosen


def d_optimal(robot: dc.Chain, q: Tensor, count: int) -> list[int]:
    """Greedy D-optimal design of the geometric errors, priors of 1 mm and 1 mrad, noise of 0.1 mm."""
    marker = torch.tensor([[0.1, 0.0, 0.1]], dtype=torch.float64)
    geometry = replace(Geometry.nominal(robot), tool=marker)
    deviations = torch.full((geometry.size,), 1e-3, dtype=torch.float64)
    deviations[geometry.slices["base"]], deviations[geometry.slices["tool"]] = 0.1, 0.1
    slopes = geometry.sensitivities(q).flatten(1, 2) * deviations / 1e-4  # (N, 3, K)
    inverse, eye, chosen = torch.eye(geometry.size, dtype=torch.float64), torch.eye(3, dtype=torch.float64), []
    for _ in range(count):
        gain = torch.logdet(eye + slopes @ inverse @ slopes.mT)
        gain[chosen] = -torch.inf
        chosen.append(int(gain.argmax()))
        own = slopes[chosen[-1]] @ inverse
        inverse = inverse - own.mT @ torch.linalg.solve(eye + own @ slopes[chosen[-1]].mT, own)
    return chosen


def measured(
    robot: dc.Chain, pool: dc.Measurements, test: dc.Measurements, rows: list[int]
) -> tuple[dc.CalibratedKinematics, Record]:
    """Calibrate with some rows of the pool, and the held-out errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
        model = dc.calibrate(robot, pool.rows(rows)).model
        found = dc.evaluate(model, test)
    return model, {"poses": len(rows), "rms_mm": 1e3 * found.rms, "p95_mm": 1e3 * found.p95}


def expected(plan: dc.Plan, poses: int) -> float:
    """RMS of held-out errors that a plan leads to expect, mm."""
    return 1e3 * float(plan.expected_rms[poses].square() + plan.noise_rms**2) ** 0.5


def chosen(method: str, robot: dc.Chain, q: Tensor, size: int, seed: int) -> tuple[list[int], float | None]:
    """Rows of the pool, all at once, and the RMS expected of them."""
    if method == "random":
        return shuffled(len(q), seed)[:size], None
    if method == "greedy":
        plan = dc.plan(robot, q, size)
        return plan.rows.tolist(), expected(plan, size)
    return {"farthest": farthest, "d_optimal": d_optimal}[method](robot, q, size), None


def sequential(
    method: str, robot: dc.Chain, pool: dc.Measurements, test: dc.Measurements, sizes: list[int]
) -> Iterator[Record]:
    """Yield a record for every size."""
    rows, guess = chosen("greedy" if method == "sequential" else "farthest", robot, pool.q, sizes[0], 0)
    model = None
    for size in sizes:
        if model is not None:
            left = [row for row in range(len(pool)) if row not in set(rows)]
            plan = dc.plan(model, pool.q[left], size - len(rows), target=pool.q)
            rows, guess = rows + [left[row] for row in plan.rows.tolist()], expected(plan, len(plan))
        model, record = measured(robot, pool, test, rows)
        yield record | {"method": method, "seed": 0, "expected_mm": guess}


def designed(
    method: str, robot: dc.Chain, pool: dc.Measurements, test: dc.Measurements, cases: list[tuple[int, int]]
) -> Iterator[Record]:
    """Yield a record for every size and seed of a design."""
    for size, seed in cases:
        rows, guess = chosen(method, robot, pool.q, size, seed)
        yield measured(robot, pool, test, rows)[1] | {"method": method, "seed": seed, "expected_mm": guess}


def compare(arguments: argparse.Namespace) -> Iterator[Record]:
    """Yield the records of all robots, splits, methods and sizes."""
    sizes = QUICK_SIZES if arguments.quick else SIZES
    for name, robot, data in robots(arguments.data, arguments.robots):
        for split in range(arguments.splits):
            pool, test = data.split(0.7, split)
            some = [size for size in sizes if size < len(pool)]
            for method in arguments.methods:
                if method.startswith("sequential"):
                    records = sequential(method, robot, pool, test, some)
                else:
                    seeds = range(arguments.random if method == "random" else 1)
                    records = designed(method, robot, pool, test, [(size, seed) for size in some for seed in seeds])
                for record in records:
                    yield {"robot": name, "split": split} | record


def again(arguments: argparse.Namespace) -> Iterator[Record]:
    """Yield the records of models of one series that are carried over to the other."""
    series = {name: (robot, data) for name, robot, data in robots(arguments.data, ["ur10_a", "ur10_d"])}
    for old, new in (("ur10_a", "ur10_d"), ("ur10_d", "ur10_a")):
        (robot, before), (_, data) = series[old], series[new]
        model = measured(robot, before, before, shuffled(len(before), 0)[:OLD_ROWS])[0]
        pool, test = data.split(0.7, 0)
        for size in AGAIN_QUICK if arguments.quick else AGAIN:
            plan = dc.plan(model, pool.q, size, free="base")
            designs = [("planned", 0, plan.rows.tolist())]
            designs += [("random", seed, shuffled(len(pool), seed)[:size]) for seed in range(arguments.random)]
            for method, seed, rows in designs:
                guess = expected(plan, size) if method == "planned" else None
                record: Record = {"robot": f"{old} -> {new}", "method": method, "split": 0, "seed": seed, "poses": size}
                yield record | carried_over(model, pool.rows(rows), test) | {"expected_mm": guess}


def carried_over(model: dc.CalibratedKinematics, new: dc.Measurements, test: dc.Measurements) -> Record:
    """Held-out errors after conditioning the linearised posterior of a model on new rows, the base free."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
        placed = model.registered(new, free="base", learn=False)
    start = of_model(placed, "base", (new.q[:0], new.q, test.q))[0]
    measured, tested = (start.at.rows(own) for own in torch.arange(len(start.at.xi)).split([len(new), len(test)]))
    inner = start.known.covariance_between(measured) + torch.block_diag(*start.noise[: len(new)])
    residual = torch.linalg.solve(inner, (new.points - placed(new.q)).flatten())
    known = start.known.covariance_between(tested, measured) @ residual
    errors = (placed(test.q) + known.view_as(test.points) - test.points).norm(dim=-1).flatten()
    return {"rms_mm": 1e3 * float(errors.square().mean().sqrt()), "p95_mm": 1e3 * float(errors.quantile(0.95))}


def shuffled(count: int, seed: int) -> list[int]:
    """Row numbers in random order."""
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed)).tolist()


def speed(quick: bool) -> Iterator[Record]:
    """Yield the times of plans of the simulated arm."""
    arm = SimulatedArm(seed=1)
    for count in (1000,) if quick else (1000, 5000):
        q = arm.sample(count, seed=5)
        times = harness.interleaved({"plan": lambda q=q: dc.plan(arm.nominal, q, 60)}, 1 if quick else 3)["plan"]
        yield {"candidates": count, "poses": 60, "seconds": sorted(times)[len(times) // 2]}


def main() -> None:
    """Parse the arguments and measure."""
    parser = harness.parser(__doc__)
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="the folder of measurements")
    parser.add_argument("--robots", nargs="+", default=["ur10_d", "ur10_a", "arm", "franka"], help="which robots")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS, help="which methods")
    parser.add_argument("--random", type=harness.count, default=10, metavar="N", help="seeds of random designs")
    parser.add_argument("--splits", type=harness.count, default=1, metavar="N", help="splits into pool and test rows")
    parser.add_argument("--again", action="store_true", help="carry models over to another series instead")
    parser.add_argument("--speed", action="store_true", help="time plans instead")
    arguments = parser.parse_args()
    if arguments.speed:
        records, columns = speed(arguments.quick), ()
    else:
        records, columns = again(arguments) if arguments.again else compare(arguments), COLUMNS

    def program() -> None:
        harness.report(records, arguments.out, columns)

    harness.guarded(program)


if __name__ == "__main__":
    main()
