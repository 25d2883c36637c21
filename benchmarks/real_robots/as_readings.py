"""What a distance meter, dial gauges or a camera would have told of a robot that a tracker has measured.

    python benchmarks/real_robots/as_readings.py --data FOLDER --robot ipa_ur10 --out as_readings.json

Readings are made of the measured positions of a real robot, errors of the tracker included: distances to three points,
heights over three planes, pixels of two cameras; each row is one reading of one device, in turn. Models of these
readings are judged by the held-out positions, beside a model of the positions of the same rows and of a third of them
(as many numbers). `rms_mm` and `median_mm`: errors of held-out positions after the best rigid motion, which readings do
not determine; `scaled_mm`: RMS after the best motion and scale. `--rows` are drawn from the 70 % that train.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import time
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator

import harness
import torch
from harness import Record
from held_out import rms_mm
from robot_data import BUILT_IN, RobotData, data_folder, find, read
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots.placement import rigid_fit

COLUMNS = ("robot", "case", "rows", "seed", "stage", "rms_mm", "median_mm", "scaled_mm", "seconds")
FOCAL, CENTRE, AWAY = 3500.0, 1500.0, 3.0
"""Of the cameras in pixels; distance of stations and cameras from the middle, in RMS radii of the measured points."""


class Devices:
    """Devices around the middle of the measured points (N, 3), in the tracker's frame, m."""

    def __init__(self, points: Tensor) -> None:
        self.middle = points.mean(0)
        self.reach = AWAY * float((points - self.middle).square().sum(1).mean().sqrt())
        self.axes = torch.linalg.svd(points - self.middle, full_matrices=False).Vh
        self.axes[2] *= torch.linalg.det(self.axes)
        """Rows: principal directions, a right-handed frame."""

    def distances(self, points: Tensor, which: Tensor) -> Tensor:
        """Distances (N,) to points on the principal axes, m."""
        return (points - self.middle - self.reach * self.axes[which]).norm(dim=1)

    def heights(self, points: Tensor, which: Tensor) -> Tensor:
        """Heights (N,) over planes across the principal axes, m."""
        return ((points - self.middle) * self.axes[which]).sum(1)

    def pixels(self, points: Tensor, which: Tensor) -> Tensor:
        """Image points (N, 2) of cameras on the first two principal axes that look at the middle."""
        turned = torch.stack([self.axes.roll(-1 - number, 0) for number in range(2)])[which]
        x, y, z = (turned @ (points - self.middle)[:, :, None])[:, :, 0].unbind(1)
        return FOCAL * torch.stack([x, y], 1) / (z + self.reach)[:, None] + CENTRE


def readings(case: str, devices: Devices, data: dc.Measurements) -> dc.Readings:
    """The rows as the devices read them in turn."""
    points, which = data.points[:, 0], torch.arange(len(data)) % (2 if case == "image" else 3)
    names = [f"{case} {number}" for number in which.tolist()]
    if case == "distance":
        return dc.Readings.distances(data.q, devices.distances(points, which), names)
    if case == "height":
        return dc.Readings.heights(data.q, devices.heights(points, which), names)
    pixels = devices.pixels(points, which)
    return dc.Readings.images(data.q, pixels, names, focal=(FOCAL, FOCAL), centre=(CENTRE, CENTRE))


def judged(points: Callable[[Tensor], Tensor], test: dc.Measurements) -> Record:
    """Errors of held-out positions after a rigid motion."""
    predicted, truth = points(test.q)[:, 0].detach(), test.points[:, 0]
    T = rigid_fit(predicted, truth)
    moved = predicted @ T[:3, :3].mT + T[:3, 3]
    away = moved - moved.mean(0)
    scale = float((away * (truth - truth.mean(0))).sum() / away.square().sum())
    record: Record = {"rms_mm": rms_mm(moved - truth), "median_mm": 1e3 * float((moved - truth).norm(dim=1).median())}
    record["scaled_mm"] = rms_mm(scale * away - truth + truth.mean(0))
    return record


def measure(plan: Namespace) -> Iterator[Record]:
    """A record for every case, number of rows, and stage."""
    folder = data_folder(plan.data)
    entries = find(folder, [plan.robot]).get(plan.robot) or BUILT_IN[plan.robot]
    robot = read(folder / plan.robot, entries)
    for seed in range(plan.seeds):
        train, test = robot.measurements.split(0.7, seed=seed)
        for rows in plan.rows:
            some = train if rows >= len(train) else train.split(rows / len(train), seed=seed)[0]
            yield from compared(robot, some, test, {"robot": plan.robot, "seed": seed})


def compared(robot: RobotData, train: dc.Measurements, test: dc.Measurements, common: Record) -> Iterator[Record]:
    """Readings of all devices, and positions."""
    devices = Devices(train.points[:, 0])
    for case in ("distance", "height", "image", "positions", "positions of a third"):
        rows = train[::3] if case == "positions of a third" else train
        data = rows if case.startswith("positions") else readings(case, devices, rows)
        begin = time.process_time()
        result = dc.calibrate(robot.robot, data)
        seconds = time.process_time() - begin
        record = common | {"case": case, "rows": len(rows)}
        for stage in ("nominal", "geometric"):
            yield record | {"stage": stage} | judged(result.stages[stage], test)
        yield record | {"stage": "full", "seconds": seconds} | judged(result.model, test)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    options = {"data": harness.DATA, "robot": {"default": "ipa_ur10", "metavar": "NAME"}}
    options |= {"seeds": harness.number(1), "rows": harness.numbers([150, 1000])}
    harness.run(__doc__, measure, COLUMNS, quick={"seeds": 1, "rows": [60]}, **options)
