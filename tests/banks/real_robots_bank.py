"""Small robots and measurements for the tests of the benchmark on real robots."""

from __future__ import annotations

import math

import numpy as np
import torch

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm

QUARTER = math.pi / 2
TABLE = [[0.0, QUARTER, 0.3], [0.0, -QUARTER, 0.4], [0.0, 0.0, 0.2, 0.3, "prismatic"], [0.1, QUARTER, 0.1], [0, 0, 0.1]]
COLUMNS = ["q1", "q2", "q3", "q4", "q5"]
DH = {
    "robot": {"dh": TABLE, "convention": "standard"},
    "csv": "table.csv",
    "joints": COLUMNS,
    "position": [["ax", "ay", "az"], ["bx", "by", "bz"]],
    "length": "mm",
    "angle": "deg",
    "sep": ";",
    "decimal": ",",
}


def sliding() -> tuple[dc.Chain, dc.Measurements]:
    """A robot with a slide and two markers on its tool."""
    robot = dc.from_dh(TABLE, names=COLUMNS)
    rng = np.random.default_rng(0)
    q = torch.from_numpy(rng.uniform((-2, -2, 0.1, -2, -2), (2, 2, 0.6, 2, 2), (40, 5)))
    tool = torch.tensor([[0.05, 0.02, 0.1], [-0.04, 0.0, 0.06]], dtype=torch.float64)
    points = tool @ robot(q)[:, :3, :3].mT + robot(q)[:, None, :3, 3]
    return robot, dc.Measurements(q, points, COLUMNS)


def arm_data(rows: int, **options: int) -> tuple[dc.Chain, dc.Measurements, dc.Measurements]:
    arm = SimulatedArm(seed=1, **options)
    q, points = arm.measure(rows + 100, seed=2)
    return arm.nominal, dc.Measurements(q[:rows], points[:rows]), dc.Measurements(q[rows:], points[rows:])
