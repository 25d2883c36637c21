"""The RR test bed: held-out error against the number of measurements, the noise and the size of the deformation.

    python benchmarks/paper_arm/sample_efficiency.py --out samples.json --figure samples.png
    python benchmarks/paper_arm/sample_efficiency.py --from samples.json --figure samples.png

Protocols:

    samples        random configurations, several noises
    deformation    arms with smaller and larger differences from the nominal one
    extrapolation  joint 1 measured in the lower 70 % of its turn, tested in the remaining 30 %
    grid           the paper's 16 x 16 grid without noise

Fields of a record: `method`, see rr_methods.py; `ours` marks the package's models; `train` measurements were fitted,
drawn with `seed` by `design` (random, part, grid) with `noise` [length units; the reach is 1.5]; `deformation` is the
nominal arm's mean error (0.1: the paper's arm, exactly 0.108; other values scale that arm); `rms`, `median` and `max`
are distances to the noise-free tip over 2000 random held-out configurations; `seconds` include the choice of scales
(for a flow, its tangent model too); `note` says why a fit failed or did not converge.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import time
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import inf, pi
from statistics import quantiles

import harness
import sample_curves
import torch
from harness import Record
from rich.console import Console
from rr_methods import METHODS, NAMES, OURS
from torch import Tensor

from diffeo_calib.robots import elastic_rr

SIZES = (6, 10, 20, 40, 80, 160, 320)
NOISES = (0.0, 1e-5, 1e-4, 1e-3)
DEFORMATIONS, DEFORMED_SIZES = (0.01, 0.1, 0.3), (20, 40, 80, 160)
PART, PART_SIZES = 0.7, (40, 160)
NOISE, PAPER_DEFORMATION = 1e-4, 0.1
SEEDS, FEW_SEEDS = 10, 5
GRID = 16
TEST_ROWS, TEST_SEED = 2000, 10_000
PROTOCOLS = ("samples", "deformation", "extrapolation", "grid")
KEY = ("protocol", "deformation", "noise", "train", "seed", "design", "method")
COLUMNS = ("protocol", "deformation", "noise", "train", "method", "runs", "rms", "lower", "upper", "seconds", "failed")


@dataclass(frozen=True)
class Case:
    """One set of measurements: fields as in a record."""

    protocol: str
    train: int
    noise: float = NOISE
    seed: int = 0
    deformation: float = PAPER_DEFORMATION
    design: str = "random"

    def measure(self) -> tuple[Tensor, Tensor]:
        """Configurations (N, 2) and measured tips (N, 2)."""
        generator = torch.Generator().manual_seed(self.seed)
        x = elastic_rr.grid(GRID) if self.design == "grid" else _draw(self.train, generator)
        if self.design == "part":
            x[:, 0] = -pi + PART * (x[:, 0] + pi)
        return x, self.truth(x) + self.noise * torch.randn(x.shape, generator=generator, dtype=x.dtype)

    def test(self) -> Tensor:
        """Held-out configurations (M, 2)."""
        x = _draw(TEST_ROWS, torch.Generator().manual_seed(TEST_SEED))
        if self.design == "part":
            x[:, 0] = pi - (1.0 - PART) * (x[:, 0] + pi)
        return x

    def truth(self, x: Tensor) -> Tensor:
        """The real arm: (M, 2)."""
        return elastic_rr.real(x, self.deformation / PAPER_DEFORMATION)


def _draw(count: int, generator: torch.Generator) -> Tensor:
    return pi * (2.0 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 1.0)


def cases(plan: Namespace) -> Iterator[Case]:
    """Yield all sets of measurements, seed by seed: if the program is stopped, whole seeds are complete."""
    for seed in range(plan.seeds):
        few = seed < FEW_SEEDS
        if "samples" in plan.protocol:
            yield from (Case("samples", size, noise, seed) for noise in plan.noises for size in plan.sizes)
        if "deformation" in plan.protocol and few:
            for deformation in DEFORMATIONS:
                yield from (Case("deformation", size, NOISE, seed, deformation) for size in DEFORMED_SIZES)
        if "extrapolation" in plan.protocol and few:
            yield from (Case("extrapolation", size, NOISE, seed, design="part") for size in PART_SIZES)
    if "grid" in plan.protocol:
        yield Case("grid", GRID**2, 0.0, design="grid")


def measure(plan: Namespace) -> Iterator[Record]:
    """Yield a record for every case and method."""
    for case in cases(plan):
        for group in METHODS:
            if any(name in plan.methods for name in group):
                yield from (record for record in attempt(case, group) if record["method"] in plan.methods)


def attempt(case: Case, group: tuple[str, ...]) -> Iterator[Record]:
    """Calibrate once by a group of methods; a failure becomes a record with the reason."""
    x, y = case.measure()
    left = list(group)
    fits = METHODS[group](x, y, case.seed)
    begin = time.perf_counter()
    while left:
        record: Record = {"method": left[0], "ours": left[0] in OURS, **vars(case)}
        try:
            _, predict, note = next(fits)
            seconds = time.perf_counter() - begin
            record |= {"seconds": seconds, **errors(predict(case.test()) - case.truth(case.test())), "note": note}
        except ModuleNotFoundError as error:
            record["note"] = f"needs {error.name}: pip install '.[bench]'"
        except Exception as error:  # the remaining methods are still measured
            record["note"] = f"{type(error).__name__}: {error}"
        yield record
        left.pop(0)
        if "rms" not in record:
            yield from ({"method": name, "ours": name in OURS, **vars(case), "note": record["note"]} for name in left)
            return


def errors(difference: Tensor) -> Record:
    """Distances of (M, 2) from the truth."""
    distance = difference.norm(dim=1)
    rms = distance.square().mean().sqrt()
    return {"rms": float(rms), "median": float(distance.median()), "max": float(distance.max())}


def summary(records: Sequence[Record]) -> list[Record]:
    """Medians and quartiles of `rms` over seeds; failures are counted and left out."""
    groups: dict[tuple[object, ...], list[Record]] = {}
    for record in records:
        key = tuple(record[name] for name in COLUMNS[:5])
        groups.setdefault(key, []).append(record)
    rows: list[Record] = []
    for group in groups.values():
        good = [record for record in group if record.get("rms") is not None]
        row: Record = {name: group[0][name] for name in COLUMNS[:5]} | {"runs": len(good)}
        if good:
            row |= dict(zip(("lower", "rms", "upper"), quartiles(good, "rms"), strict=True))
            row["seconds"] = quartiles(good, "seconds")[1]
        rows.append(row | {"failed": len(group) - len(good)})
    return rows


def quartiles(records: Sequence[Record], name: str) -> list[float]:
    """Lower quartile, median and upper quartile of a field."""
    values = [float(record[name] or 0.0) for record in records]
    return quantiles(values, n=4, method="inclusive") if len(values) > 1 else values * 3


def arguments(given: list[str] | None = None) -> Namespace:
    """Parse the command line; --quick overrides protocols, sizes, noises and seeds."""
    parser = harness.parser(__doc__)
    parser.add_argument("--protocol", nargs="+", choices=PROTOCOLS, default=list(PROTOCOLS))
    parser.add_argument("--methods", nargs="+", choices=NAMES, default=list(NAMES))
    parser.add_argument(
        "--seeds",
        type=harness.count,
        default=SEEDS,
        metavar="N",
        help=f"at most {FEW_SEEDS} unless `samples`",
    )
    parser.add_argument("--sizes", nargs="+", type=harness.count, default=list(SIZES), metavar="N", help="of `samples`")
    parser.add_argument("--noises", nargs="+", type=noise, default=list(NOISES), metavar="S", help="of `samples`")
    parser.add_argument("--figure", type=Path, metavar="FILE.png", help="draw the protocol `samples`")
    parser.add_argument(
        "--from", dest="earlier", nargs="+", type=Path, metavar="FILE.json", help="read, do not measure"
    )
    plan = parser.parse_args(given)
    if plan.quick:
        plan.protocol, plan.sizes, plan.noises, plan.seeds = ["samples"], [20, 40], [NOISE], 1
    return plan


def noise(text: str) -> float:
    """Read a standard deviation from the command line."""
    value = float(text)
    if not 0.0 <= value < inf:
        raise ValueError(text)
    return value


def run(plan: Namespace) -> None:
    """Measure or read, print medians, draw."""
    if plan.earlier:
        records = harness.earlier(plan.earlier, KEY)
    else:
        records = harness.report(
            measure(plan), plan.out, ("protocol", "train", "noise", "seed", "method", "rms", "note")
        )
    rows = summary(records)
    console = Console(width=None if sys.stdout.isatty() else harness.WIDTH)
    console.print("Medians and quartiles over seeds")
    console.print(harness.table(rows, COLUMNS))
    if plan.figure is not None:
        sample_curves.draw(rows, plan.figure)
        console.print(f"wrote {plan.figure}")


if __name__ == "__main__":
    harness.guarded(lambda: run(arguments()))
