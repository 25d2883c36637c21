"""How many rows until a simulated arm is accurate, by the poses of a campaign, planned beforehand or at random?

    python benchmarks/robustness/campaign_targets.py --seeds 10 --out campaign_targets.json

An arm with one marker, .02 mm of noise, candidates and target (200 configurations each) drawn within the limits. By a
campaign: 12 poses at random, then each pose that `dc.Campaign` proposes. Planned beforehand: 20 poses by `dc.plan`, a
calibration, 40 more by its plan, and so on. The true error is that of the calibration of the rows over the target; its
row is found by bisection between 20 and 160 in steps of 4, and by interpolation between these.

Fields of a record: `seed`, `poses`, `target_mm`; `rows`: first row at which the true error is below the target; none:
not within 160. Of a campaign with this goal `stopped`: row at which it is reached, and `true_mm` there; `expected`: row
at which the expected error is below it, which may be too early.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from math import exp, log

import harness
import numpy as np
import torch
from harness import Record
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm

MOST, FIRST, STEP = 160, 20, 4
TARGETS_MM = (0.1, 0.05)
POSES = ("random", "beforehand", "campaign")
COLUMNS = ("seed", "poses", "target_mm", "rows", "stopped", "true_mm", "expected")


def measured(arm: SimulatedArm, q: Tensor, seed: int) -> Tensor:
    """The marker as the tracker sees it, m."""
    noise = np.random.default_rng([seed, len(q), round(1e6 * abs(float(q[0, 0])))])
    return arm.true_points(q) + arm.noise * torch.from_numpy(noise.standard_normal((len(q), 1, 3)))


def by_campaign(
    arm: SimulatedArm, seed: int, candidates: Tensor, target: Tensor, goal: float
) -> tuple[Tensor, Tensor, int | None, int | None]:
    """Joint values, positions, and the rows at which the goal [mm] is reached, and expected."""
    campaign = dc.Campaign(arm.nominal, candidates=candidates, target=target, goal=1e-3 * goal)
    first, q, y, expected = arm.sample(12, seed=seed + 4000), [], [], None
    while len(q) < MOST and not campaign.reached:
        found = campaign.next(1)
        q.append(first[len(q)] if found is None else found.q[0])
        y.append(measured(arm, q[-1][None], seed + len(q))[0])
        campaign.add(q[-1], y[-1])
        if expected is None and 1e3 * (campaign.expected_error or 1.0) <= goal:
            expected = len(q)
    return torch.stack(q), torch.stack(y), len(q) if campaign.reached else None, expected


def beforehand(arm: SimulatedArm, seed: int, candidates: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """20 planned poses, then steps of 40."""
    q = dc.plan(arm.nominal, candidates, 20, target=target).q
    y = measured(arm, q, seed)
    while len(q) < MOST:
        model = dc.calibrate(arm.nominal, dc.Measurements(q, y, doubt=False)).model
        more = dc.plan(model, candidates, 40, target=target).q
        q, y = torch.cat([q, more]), torch.cat([y, measured(arm, more, seed)])
    return q, y


def error_mm(arm: SimulatedArm, target: Tensor, q: Tensor, y: Tensor) -> float:
    """RMS error over the target of a calibration, mm."""
    model = dc.calibrate(arm.nominal, dc.Measurements(q, y, doubt=False)).model
    return 1e3 * float((model(target) - arm.true_points(target)).square().sum(-1).mean().sqrt())


def first_below(error: Callable[[int], float], goal: float, most: int) -> float | None:
    """The number of rows at which an error falls below a goal, if it falls steadily."""
    low, high = FIRST, most
    if error(high) > goal:
        return None
    while high - low > STEP:
        middle = (low + high) // 2
        low, high = (low, middle) if error(middle) <= goal else (middle, high)
    if error(low) <= goal:
        return low
    share = log(error(low) / goal) / log(error(low) / error(high))
    return exp(log(low) + share * log(high / low))


def arms(seed: int, names: Sequence[str]) -> Iterator[Record]:
    """One arm, measured in some ways."""
    arm = SimulatedArm(seed)
    candidates, target = arm.sample(200, seed=seed + 2000), arm.sample(200, seed=seed + 3000)
    random = arm.sample(MOST, seed=seed + 5000)
    ways = {"random": lambda _: (random, measured(arm, random, seed), None, None)}
    once = cache(lambda: beforehand(arm, seed, candidates, target))
    ways["beforehand"] = lambda _: (*once(), None, None)
    ways["campaign"] = lambda goal: by_campaign(arm, seed, candidates, target, goal)
    for name in names:
        for goal in TARGETS_MM:
            q, y, stopped, expected = ways[name](goal)
            error = cache(partial(lambda q, y, rows: error_mm(arm, target, q[:rows], y[:rows]), q, y))
            yield {
                "seed": seed,
                "poses": name,
                "target_mm": goal,
                "rows": first_below(error, goal, len(q)),
                "stopped": stopped,
                "true_mm": None if stopped is None else error(stopped),
                "expected": expected,
            }


if __name__ == "__main__":
    parser = harness.parser(__doc__)
    parser.add_argument("--seeds", type=harness.count, default=10, help="number of arms")
    parser.add_argument("--first", type=int, default=0, help="the first of them")
    parser.add_argument("--poses", choices=POSES, action="append", help="only these; may be repeated")
    given = parser.parse_args()
    warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
    seeds = range(given.first, given.first + (1 if given.quick else given.seeds))
    harness.guarded(
        partial(harness.report, (one for seed in seeds for one in arms(seed, given.poses or POSES)), given.out, COLUMNS)
    )  # pyright: ignore[reportArgumentType]
