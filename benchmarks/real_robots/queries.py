"""Time of queries to a calibrated robot: the package against plain ways to compute the same, on one thread.

    python benchmarks/real_robots/queries.py --data FOLDER --out queries.json
    python benchmarks/real_robots/queries.py --models positions.safetensors poses.safetensors

Without --models, 70 % of a data set are calibrated, once with positions and once with poses if it has orientations.
Queries are random configurations within the range of the measured ones. Every query is asked in all ways in turn; the
first call of each, which also fills caches, is not part of the median.

Fields of a record: `model` is "positions" or "poses", `coordinates` the number of fitted coordinates N m; `query` is
asked for `rows` configurations at once; `way` is "package" or the name of a plain way; `first_ms` is the time of the
first call and `median_ms` that of later ones; `ratio` is the median in units of the package's; `difference` is the
largest difference from the package's result, in m and rad, for covariances in units of the predicted deviations.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from statistics import median

import harness
import torch
from harness import Record
from robot_data import data_folder, find, read
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.measurements.poses import pose_directions
from diffeo_calib.robots.simulated_arm import SimulatedArm

REPEATS, TRAINING_SHARE = 5, 0.7
QUICK_ROWS, QUICK_POSES = 20, 20
TOOL = (0.0, 0.0, 0.15)
"""Tool centre point in the frame of the tip, m."""
PLAIN_ROWS = 64
"""Number of rows at once of the plain formula for covariances."""
COLUMNS = ("model", "coordinates", "query", "rows", "way", "first_ms", "median_ms", "ratio", "difference")

Model = dc.CalibratedKinematics
Ways = dict[str, Callable[[], Tensor]]


@dataclass(frozen=True)
class Query:
    """A question to a model.

    Args:
        name: in the records. rows: number of configurations.
        ways: the package and plain ways to answer it, for a model and configurations (rows, n).
        difference: between the package's answer and another one.
    """

    name: str
    rows: int
    ways: Callable[[Model, Tensor], Ways]
    difference: Callable[[Tensor, Tensor], float]


def covariance(model: Model, q: Tensor) -> Ways:
    """Covariances of markers, or of poses if the model was calibrated with poses."""
    ask = model.predict if model.lever is None else model.predict_poses
    formula = PlainCovariance(model)
    return {"package": lambda: ask(q)[1], f"formula, {PLAIN_ROWS} rows at once": lambda: formula(q)}


class PlainCovariance:
    """G(x, x) - G(x, data) (G + R)^-1 G(data, x) with all coordinates of some rows as columns of one matrix."""

    def __init__(self, model: Model) -> None:
        self.model = model

    @cached_property
    def data(self) -> Linearisation:
        """Linearisation at the data."""
        return self.model.map.geodesic.linearise(self.model.map.x)

    @cached_property
    def factor(self) -> Tensor:
        """Cholesky factor of G + R."""
        return torch.linalg.cholesky(self.model.map.noise.add_to(self.data.gram()))

    def __call__(self, q: Tensor) -> Tensor:
        """(N, P, 3, 3) in m^2, or (N, 6, 6) of poses."""
        blocks = torch.cat([self._blocks(rows) for rows in q.split(PLAIN_ROWS)])
        if self.model.lever is not None:
            wanted = pose_directions(self.model.poses(q), self.model.lever)
            return wanted @ blocks @ wanted.mT
        return torch.stack([blocks[:, k : k + 3, k : k + 3] for k in range(0, blocks.shape[1], 3)], 1)

    def _blocks(self, q: Tensor) -> Tensor:
        fitted = self.model.map
        at = fitted.geodesic.linearise(q)
        cross = self.data.gram(at)
        whole = (at.gram() - cross.T @ torch.cholesky_solve(cross, self.factor)).view(len(q), fitted.m, len(q), -1)
        rows = torch.arange(len(q), device=q.device)
        return whole[rows, :, rows] + fitted.new_noise


def in_deviations(covariance: Tensor, other: Tensor) -> float:
    """Largest difference of two covariances (..., m, m) in units of the product of deviations."""
    deviations = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    return float(((covariance - other) / (deviations[..., :, None] * deviations[..., None, :])).abs().max())


def positions(model: Model, q: Tensor) -> Ways:
    """Markers: by constants in NumPy, and by the flows in torch."""
    return {"package": lambda: model(q), "torch": lambda: model.map(q).unflatten(1, (-1, 3))}


def jacobian(model: Model, q: Tensor) -> Ways:
    """Markers with their Jacobian."""
    return {"package": lambda: model.jacobian(q), "torch": lambda: model.map.jacobian(q).unflatten(1, (-1, 3))}


def tool_pose(model: Model, q: Tensor) -> Ways:
    """Pose of a tool that was not measured."""
    return {"package": lambda: model.tool_poses(q, TOOL)}


def commands(model: Model, q: Tensor) -> Ways:
    """Joint commands for the nominal poses of a tool; rows that are not reached count too."""
    tool = torch.eye(4, dtype=torch.float64)
    tool[:3, 3] = torch.tensor(TOOL, dtype=torch.float64)
    targets = model.robot(q) @ tool
    return {"package": lambda: dc.compensate(model, targets, q, tool=tool).q}


def largest(answer: Tensor, other: Tensor) -> float:
    """Largest difference of two answers, m or m/rad."""
    return float((answer - other).abs().max())


QUERIES = (
    Query("positions", 1, positions, largest),
    Query("positions", 10_000, positions, largest),
    Query("positions and Jacobian", 1, jacobian, largest),
    Query("tool pose", 1, tool_pose, largest),
    Query("tool pose", 10_000, tool_pose, largest),
    Query("compensate poses", 1, commands, largest),
    Query("compensate poses", 10_000, commands, largest),
    Query("covariance", 1000, covariance, in_deviations),
)


def measure(plan: Namespace) -> Iterator[Record]:
    """Yield a record for every model, query and way."""
    torch.set_num_threads(1)
    for model in models(plan):
        for query in QUERIES:
            q = configurations(model, min(query.rows, QUICK_ROWS) if plan.quick else query.rows)
            yield from answers(model, query, q, 1 if plan.quick else plan.repeats)


def answers(model: Model, query: Query, q: Tensor, repeats: int) -> Iterator[Record]:
    """Ask in every way, in turn."""
    ways, first, found = query.ways(model, q), {}, {}
    for way, ask in ways.items():
        begin = time.perf_counter()
        found[way] = ask()
        first[way] = time.perf_counter() - begin
    seconds = {way: median(times) for way, times in harness.interleaved(ways, repeats).items()}
    for way in ways:
        yield {
            "model": "positions" if model.lever is None else "poses",
            "coordinates": model.map.x.shape[0] * model.map.m,
            "query": query.name,
            "rows": len(q),
            "way": way,
            "first_ms": 1e3 * first[way],
            "median_ms": 1e3 * seconds[way],
            "ratio": seconds[way] / seconds["package"],
            "difference": query.difference(found["package"], found[way]),
        }


def models(plan: Namespace) -> Iterator[Model]:
    """Load the given models, or calibrate."""
    for path in plan.models:
        model = dc.load(path)
        if not isinstance(model, Model):
            raise InputError.of(f"'{path}'", expected="a model of a robot", got=type(model).__name__)
        yield model
    if not plan.models:
        for robot, measured in tables(plan):
            train = measured if plan.quick else measured.split(TRAINING_SHARE, seed=0)[0]
            yield dc.calibrate(robot, train).model


def tables(plan: Namespace) -> Iterator[tuple[dc.Chain, dc.Measurements]]:
    """Robots and their measurements: with positions, then with poses."""
    if plan.quick:
        arm = SimulatedArm(seed=1)
        yield arm.nominal, dc.Measurements(*arm.measure(QUICK_POSES, seed=2))
        return
    folder = data_folder(plan.data)
    for name, entries in find(folder, [plan.dataset]).items():
        for poses in (False, True) if "rotation" in entries else (False,):
            data = read(folder / name, entries, poses=poses)
            yield data.robot, data.measurements


def configurations(model: Model, rows: int) -> Tensor:
    """Random configurations within the range of the measured ones: (rows, n)."""
    low, high = model.configurations.amin(0), model.configurations.amax(0)
    generator = torch.Generator(device="cpu").manual_seed(0)
    share = torch.rand(rows, len(low), generator=generator, dtype=low.dtype, device="cpu")
    return low + (high - low) * share.to(low.device)


def arguments(given: list[str] | None = None) -> Namespace:
    """Parse the command line."""
    parser = harness.parser(__doc__)
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="folder of data sets; default: $DIFFEO_CALIB_DATA")
    parser.add_argument("--dataset", default="ipa_ur10", metavar="NAME")
    parser.add_argument(
        "--models", nargs="+", type=Path, default=[], metavar="FILE", help="ask these, do not calibrate"
    )
    parser.add_argument("--repeats", type=harness.count, default=REPEATS, metavar="N", help="timed calls per way")
    return parser.parse_args(given)


def run(plan: Namespace) -> None:
    """Measure and report."""
    harness.report(measure(plan), plan.out, COLUMNS)


if __name__ == "__main__":
    harness.guarded(lambda: run(arguments()))
