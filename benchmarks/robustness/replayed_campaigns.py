"""Measured tables replayed into a campaign in random order: is the error that it expects the error that it has?

    python benchmarks/robustness/replayed_campaigns.py --data FOLDER --seeds 10 --out replayed_campaigns.json

150 rows, or 70 % of a smaller table, go into `dc.Campaign` one by one. The target is at most 200 of the other rows,
which are held out. Robots: series A and D of the UR10, the Franka, and panda_3, whose ball rests in sockets: nobody
measured where it is, so that it has no held-out error.

Fields of a record: `robot`, `seed`, `rows`, `expected_mm`: RMS error of the robot over the target, without the noise of
a measurement; `limit_mm`: what it exceeds with 5 % probability; `noise_mm`: RMS noise of a measurement as the fit finds
it; `held_out_mm`: RMS error of `dc.calibrate` of these rows on the held-out ones, which have that noise; `forecast_mm`:
the held-out error that expected error and noise make together; `refused`: rows so far that looked wrong.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share
sys.path.insert(0, str(Path(__file__).parents[1] / "real_robots"))

import warnings
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import harness
import numpy as np
import sockets
from harness import Record
from held_out import rms_mm
from planning import robots
from robot_data import data_folder

import diffeo_calib as dc

ROBOTS = ("ur10_a", "ur10_d", "franka", "panda_3")
SIZES, MOST, TARGETS, SHARE = (20, 40, 80, 150), 150, 200, 0.7
COLUMNS = ("robot", "seed", "rows", "expected_mm", "limit_mm", "noise_mm", "held_out_mm", "forecast_mm", "refused")


def tables(folder: Path | None, wanted: Sequence[str]) -> Iterator[tuple[str, dc.Tree, Any]]:
    """Yield name, robot and rows."""
    yield from robots(folder, [name for name in wanted if name not in sockets.ROBOTS])
    for name in (each for each in wanted if each in sockets.ROBOTS):
        yield name, *sockets.read(name, data_folder(folder) / "mukca")


def replayed(name: str, robot: dc.Tree, rows: Any, seed: int) -> Iterator[Record]:
    """One table in one order."""
    order = np.random.default_rng(seed).permutation(len(rows)).tolist()
    count = min(MOST, int(SHARE * len(rows)))
    held_out = rows.rows(order[count : count + TARGETS])
    campaign = dc.Campaign(robot, target=held_out.q, goal=1e-6)
    for number, row in enumerate(order[:count], start=1):
        campaign.add(rows.rows([row]))
        if number in SIZES or number == count:
            expected = campaign.expected_error
            found: Record = {"robot": name, "seed": seed, "rows": number, "refused": number - len(campaign.accepted)}
            found["expected_mm"] = None if expected is None else 1e3 * expected
            found["limit_mm"] = None if campaign.error_limit is None else 1e3 * campaign.error_limit
            if isinstance(held_out, dc.Measurements) and name not in sockets.ROBOTS:
                result = campaign.result()
                noise = 1e3 * float(result.model.map.new_noise.trace().sqrt())
                found |= {"noise_mm": noise, "held_out_mm": rms_mm(result.model(held_out.q) - held_out.points)}
                found["forecast_mm"] = None if expected is None else float(np.hypot(1e3 * expected, noise))
            yield found


if __name__ == "__main__":
    parser = harness.parser(__doc__)
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="folder of data sets; default: $DIFFEO_CALIB_DATA")
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=ROBOTS)
    parser.add_argument("--seeds", type=harness.count, default=10, metavar="N", help="orders of the rows")
    given = parser.parse_args()
    warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
    seeds = range(1 if given.quick else given.seeds)
    found = (one for table in tables(given.data, given.robots) for seed in seeds for one in replayed(*table, seed))
    harness.guarded(partial(harness.report, found, given.out, COLUMNS))  # pyright: ignore[reportArgumentType]
