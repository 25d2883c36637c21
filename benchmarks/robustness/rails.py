"""Is a rail that is not straight part of the model, with regions that hold? An arm on a rail of 4 m.

    python benchmarks/robustness/rails.py --rows 60 120 240 300 --seeds 3 --out rails.json
    python benchmarks/robustness/rails.py --rows 60 120 --shift 0 --turn 0 --out straight.json

The rail's straightness in both directions, and its roll, pitch and yaw, are sums of three waves of 0.5 to 3 periods.
Fields of a record: `rows`, `seed`; `error_mm`, RMS error of the true places of 300 other poses; `inside`, their share
in the 95 % regions; `said_mm`, RMS of the predicted deviations; `axes`, those whose errors are part of the model.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOMS = Path(__file__).parents[1]
sys.path[:0] = [str(ROOMS), str(ROOMS / "robustness")]  # for the modules that benchmarks share

import argparse
import tempfile
import warnings
from collections.abc import Iterator
from math import pi

import harness
import numpy as np
import torch
from harness import Record
from torch import Tensor
from varied_arms import Kind, VariedArm

import diffeo_calib as dc
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.robots.simulated_arm import URDF_FILE

LENGTH_M, NEW_POSES = 4.0, 300
RAIL = (
    '<link name="ground"/><joint name="rail" type="prismatic"><parent link="ground"/><child link="base_link"/>'
    '<axis xyz="0 1 0"/><limit lower="-2" upper="2"/></joint><link name="base_link">'
)
COLUMNS = "rows", "seed", "error_mm", "inside", "said_mm", "axes"


def arm_on_rail() -> dc.Tree:
    """The simulated arm on a rail."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rail.urdf"
        path.write_text(URDF_FILE.read_text(encoding="utf-8").replace('<link name="base_link">', RAIL))
        return dc.load_urdf(path, "ground", "flange")


class ArmOnRail(VariedArm):
    """Shifts and turns of the rail have these RMS sizes, m and rad."""

    def __init__(self, seed: int, shift: float, turn: float) -> None:
        super().__init__(arm_on_rail(), Kind(), seed)
        self.sag = self.sag * torch.tensor(self.nominal.periodic)  # a slide is level
        rng = np.random.default_rng([seed, 77])
        periods = rng.uniform(0.5, 3.0, (6, 3))
        sizes = rng.standard_normal((6, 3)) / periods
        sizes *= np.array([shift, 0, shift, turn, turn, turn])[:, None] / np.sqrt(0.5 * (sizes**2).sum(1))[:, None]
        self.rail = [torch.from_numpy(each) for each in (periods, sizes, rng.uniform(0, 2 * pi, (6, 3)))]

    def true_points(self, q: Tensor) -> Tensor:
        """True markers (N, 1, 3), m."""
        periods, sizes, phases = self.rail
        twists = (sizes * torch.sin(2 * pi * periods * q[:, :1, None] / LENGTH_M + phases)).sum(-1)
        smooth = (self.waves * torch.sin(self.harmonics * q[..., None] + self.phases[:, :3])).sum(-1)
        geometry = self._geometry()
        theta = torch.zeros(len(q), geometry.size, dtype=torch.float64)
        theta[:, 6:12] = twists
        return geometry.points(q + smooth + self.sag * self._torques(q), theta)


def measure(arguments: argparse.Namespace) -> Iterator[Record]:
    """A record for every number of rows and seed."""
    warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
    for rows in arguments.rows[:1] if arguments.quick else arguments.rows:
        for seed in range(1 if arguments.quick else arguments.seeds):
            arm = ArmOnRail(seed, arguments.shift, arguments.turn)
            q, new = arm.rows(rows, seed), arm.rows(NEW_POSES, 1000 + seed)
            model = dc.calibrate(arm.nominal, dc.Measurements(q, arm.measured(q, seed), arm.nominal.joint_names)).model
            mean, covariance = model.predict(new, noise=False)
            errors, covariance = (mean - arm.true_points(new)).flatten(1), covariance.view(NEW_POSES, 3, 3)
            squares = (errors * torch.linalg.solve(covariance, errors)).sum(1)
            variances = covariance.diagonal(dim1=1, dim2=2).sum(1)
            yield {
                "rows": rows,
                "seed": seed,
                "error_mm": 1e3 * float(errors.square().sum(1).mean().sqrt()),
                "inside": float((squares < chi2_above(0.05, 3)).double().mean()),
                "said_mm": 1e3 * float(variances.mean().sqrt()),
                "axes": ", ".join(model.robot.moving_names[axis[0]] for axis in model.nominal.own.axes),
            }


if __name__ == "__main__":
    shift = {"type": float, "default": 3e-4, "metavar": "M", "help": "straightness"}
    turn = {"type": float, "default": 1e-4, "metavar": "RAD", "help": "roll, pitch and yaw"}
    rows, seeds = harness.numbers([60, 120, 240, 300]), harness.number(3, "arms")
    harness.run(__doc__, measure, COLUMNS, rows=rows, seeds=seeds, shift=shift, turn=turn)
