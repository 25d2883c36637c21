"""Does a campaign that watches itself name what goes wrong, and leave right rows alone? On simulated arms.

    python benchmarks/robustness/live_campaigns.py --seeds 33 --first 500 --out live_campaigns.json
    python benchmarks/robustness/live_campaigns.py --seeds 67 --first 533 --clean --out clean_campaigns.json

A campaign of 100 rows of one marker, or two for odd seeds, drawn at random, 0.02 mm of noise. At a random row from 40
to 90 it is copied, and the copies go on with one fault each: the device is 0.3 mm away in a random direction, marker 0
has slipped by 0.3 mm on the flange, the offset of one joint (of each) has changed by 0.5 mrad, the row's unit is mm as
m, the two markers are exchanged. With `--clean` there are no faults.

Fields of a record: `case`, `seed`, `row` of the fault, `rows` after it until the fault is named (1: at once; none:
never among the rows that it has), `named`: what was named; `wrongly`: what was named before without the fault, if
anything was; for `none`: `alarms`, the rows that looked wrong, `error_mm`
and `expected_mm`, true and expected over 200 other configurations at the end, `slowest_ms` of a verdict that makes no
new model.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import copy
import time
from collections.abc import Iterator
from functools import partial

import harness
import numpy as np
import torch
from harness import Record
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm

ROWS, FIRST, LAST = 100, 40, 90
MOVED_M, TURNED_RAD = 3e-4, 5e-4
WITHIN = {"device": 3, "marker": 5, "joint": 8, "unit": 1, "exchanged": 1}
WORDS = {"device": "device", "marker": "marker", "unit": "mm as m", "exchanged": "exchanged"}
COLUMNS = ("case", "seed", "row", "rows", "named", "wrongly", "alarms", "error_mm", "expected_mm", "slowest_ms")


def faults(arm: SimulatedArm, rng: np.random.Generator, q: Tensor, y: Tensor) -> Iterator[tuple[str, str, Tensor]]:
    """Name of every fault, words by which it is known, and the measured rows with it."""
    away = torch.from_numpy(rng.standard_normal(3))
    away = MOVED_M * away / away.norm()
    yield "device", WORDS["device"], y + away
    turned = arm.truth.marker_poses(q)[:, 0, :3, :3] @ away
    slipped = y.clone()
    slipped[:, 0] += turned
    yield "marker", WORDS["marker"], slipped
    for joint, name in enumerate(arm.nominal.joint_names):
        off = q.clone()
        off[:, joint] += TURNED_RAD
        yield "joint", name, y + arm.true_points(off) - arm.true_points(q)
    yield "unit", WORDS["unit"], 1e3 * y
    if y.shape[1] > 1:
        yield "exchanged", WORDS["exchanged"], y.flip(1)


def named(campaign: dc.Campaign, q: Tensor, y: Tensor, words: str) -> tuple[int | None, str, str]:
    """After how many faulty rows the fault is named, what was named last, and first without it."""
    text = wrongly = ""
    for row in range(len(q)):
        (verdict,) = campaign.add(q[row], y[row])
        change = verdict.change
        text = verdict.cause or ("" if change is None else ", ".join((change.cause, *change.others)))
        if words in text:
            return row + 1, text, wrongly
        wrongly = wrongly or text
    return None, text, wrongly


def campaigns(seed: int, clean: bool) -> Iterator[Record]:
    """One campaign without fault and, unless all shall be clean, its copies with one each."""
    rng, arm = np.random.default_rng(seed), SimulatedArm(seed, markers=1 + seed % 2)
    q, y = arm.measure(ROWS, seed=seed + 1000)
    at, times, wrong = int(rng.integers(FIRST, LAST)), [], []
    campaign = dc.Campaign(arm.nominal, target=arm.sample(200, seed=seed + 2000))
    for row in range(ROWS):
        if row == at and not clean:
            for case, words, faulty in faults(arm, rng, q[at:], y[at:]):
                most = slice(0, WITHIN[case])
                rows, text, wrongly = named(copy.deepcopy(campaign), q[at:][most], faulty[most], words)
                name = f"{case} {words}" if case == "joint" else case
                yield {"case": name, "seed": seed, "row": at, "rows": rows, "named": text, "wrongly": wrongly}
        start, expected = time.perf_counter(), campaign.models
        campaign.add(q[row], y[row])
        times += [time.perf_counter() - start] * (campaign.models == expected)
    wrong = [str(one) for one in campaign.verdicts if not one.accepted]
    result = campaign.result()
    away = (result.model(campaign.target) - arm.true_points(campaign.target)).square().sum(-1).mean().sqrt()
    yield {
        "case": "none",
        "seed": seed,
        "row": None,
        "rows": None,
        "named": "; ".join(wrong),
        "alarms": len(wrong),
        "error_mm": 1e3 * float(away),
        "expected_mm": 1e3 * float(campaign.expected_error or 0.0),
        "slowest_ms": 1e3 * max(times),
    }


if __name__ == "__main__":
    parser = harness.parser(__doc__)
    parser.add_argument("--seeds", type=harness.count, default=100, help="number of arms")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    parser.add_argument("--clean", action="store_true", help="no faults")
    given = parser.parse_args()
    seeds = range(given.first, given.first + (1 if given.quick else given.seeds))
    found = (one for seed in seeds for one in campaigns(seed, given.clean))
    harness.guarded(partial(harness.report, found, given.out, COLUMNS))  # pyright: ignore[reportArgumentType]
