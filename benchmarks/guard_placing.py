"""How often does a calibration find device, tool and targets that may be anywhere? On simulated arms.

    python benchmarks/guard_placing.py --count 1000 --jobs 2 --out placing.json

The device stands anywhere within 10 m and is turned in any way; a marker, a frame or a ball is up to 0.5 m from the
flange, a frame turned in any way; fixed points, planes, cameras and sockets are anywhere. The arm has its usual errors.
A place is right if the geometric calibration predicts true places of 100 other configurations to 5 mm RMS (a frame's
turns as those of a point at 0.1 m; after a rigid motion where no device measured a place); a wrong one is off by far.

Fields of a record: `case`, `rows`, `placements`, `right`, `refused` with an error, `wrong`, the `seeds` of those that
were not right, and `seconds` of the processor for each.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before torch
for _folder in ("benchmarks/robustness", "benchmarks/real_robots", "tests/banks", "scripts/examples"):
    sys.path.append(str(Path(__file__).parents[1] / _folder))

import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from math import pi
from multiprocessing import get_context
from typing import Any

import harness
import numpy as np
import torch
from guard_kinds import CENTRE, FOCAL, NOISE_M, NOISE_PX, drawn, noisy_poses
from guard_verbs import TURNS, aligned, errors_of, rms
from harness import Record
from simulated_camera import marks_of, poses_of
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation, transforms

AWAY_M, TOOL_M, RIGHT_M, TESTED, CHUNK = 10.0, 0.5, 5e-3, 100, 20
ROWS = {"positions": 20, "poses": 12, "camera on the tool": 20, "ball in sockets": 40}
READINGS = 60
"""Rows of the kinds of readings."""


def placed(robot: dc.Tree, table: Any) -> Callable[[Tensor], Tensor]:
    """The adapter to the package: (N, n) -> points (N, P, 3) of the robot as it was placed by rows of any kind."""
    from diffeo_calib.calibration.placing.place import place  # noqa: PLC0415
    from diffeo_calib.fitting.result import silent  # noqa: PLC0415

    return place(robot, table, silent).identification.geometry.points


def somewhere(rng: np.random.Generator, reach: float) -> Tensor:
    """A random pose (4, 4) within a distance, m."""
    axis, shift = rng.standard_normal((2, 3))
    turn = torch.from_numpy(axis / np.linalg.norm(axis) * rng.uniform(0, pi))
    return transforms(
        rotation(turn), torch.from_numpy(shift / np.linalg.norm(shift) * reach * rng.uniform() ** (1 / 3))
    )


def anywhere(seed: int, frame: bool) -> SimulatedArm:
    """An arm with device and marker, or the marks of a frame, anywhere."""
    arm, rng = SimulatedArm(seed, markers=3 if frame else 1), np.random.default_rng([seed, 40])
    base, tool = somewhere(rng, AWAY_M), somewhere(rng, TOOL_M)
    marks = marks_of(tool) if frame else tool[None, :3, 3]
    arm.truth = replace(arm.truth, base=base, tool=marks)
    return arm


def table_of(kind: str, arm: SimulatedArm, seed: int) -> Any:
    """Rows of a kind."""
    rng, names, count = np.random.default_rng([seed, 41]), arm.nominal.joint_names, ROWS.get(kind, READINGS)
    if kind == "ball in sockets":
        q, sockets = resting(arm, rng)
        return dc.Measurements.from_sockets(q, sockets, names, distances={("0", "1"): 0.05}, distance_std=1e-5)
    q = arm.sample(count, seed=seed + 1)
    points = arm.true_points(q)
    if kind == "positions":
        return dc.Measurements(q, points + NOISE_M * drawn((seed, 1), *points.shape), names)
    if kind in ("poses", "camera on the tool"):
        seen = noisy_poses(poses_of(points)[:, None], (seed, 1))[:, 0]
        on_tool = kind != "poses"
        return dc.Measurements.from_poses(q, torch.linalg.inv(seen) if on_tool else seen, names, camera_on_tool=on_tool)
    return read(kind, q, (points[:, 0] - arm.truth.base[:3, 3]) @ arm.truth.base[:3, :3], rng, names)


def read(kind: str, q: Tensor, z: Tensor, rng: np.random.Generator, names: Any) -> dc.Readings:
    """Readings of a ball at z (N, 3) in the base by three devices in turn, which are anywhere."""
    which, draws = torch.arange(len(q)) % 3, torch.from_numpy(rng.standard_normal((len(q), 2)))
    own, far = [f"device {k}" for k in which.tolist()], rng.uniform(1.0, 5.0, (3, 1))
    away = torch.nn.functional.normalize(torch.from_numpy(rng.standard_normal((3, 3))), dim=1)
    if kind == "heights":
        return dc.Readings.heights(q, (z * away[which]).sum(1) + 0.3 + NOISE_M * draws[:, 0], own, names)
    places = torch.from_numpy(far) * away
    if kind != "images":
        zero = 0.03 if kind == "distances of unknown zero" else 0.0
        lengths = (z - places[which]).norm(dim=1) + zero + NOISE_M * draws[:, 0]
        return dc.Readings.distances(q, lengths, own, names, offset_std=0.1 if zero else 0.0)
    places = 1.5 * away + places  # the robot is in view
    x = torch.nn.functional.normalize(torch.linalg.cross(away, torch.from_numpy(rng.standard_normal((3, 3)))), dim=1)
    R = torch.stack([x, torch.linalg.cross(-away, x), -away], 1)[which]
    seen = (R @ (z - places[which])[..., None])[..., 0]
    pixels = seen[:, :2] / seen[:, 2:] * z.new_tensor(FOCAL) + z.new_tensor(CENTRE)
    return dc.Readings.images(q, pixels + 0.25 * NOISE_PX * draws, own, names, focal=FOCAL, centre=CENTRE)


def resting(arm: SimulatedArm, rng: np.random.Generator) -> tuple[Tensor, list[str]]:
    """Configurations with the ball in two sockets, 50 mm apart, at four places that the arm reaches."""
    found, names, low, high = [], [], *arm.nominal.limits.unbind(1)
    while len(found) < 8:
        along = torch.nn.functional.normalize(torch.from_numpy(rng.standard_normal(3)), dim=0)
        middle = low + (high - low) * torch.from_numpy(rng.uniform(0.2, 0.8, 6))
        pair = []
        for socket in range(2):
            target = arm.true_points(middle[None])[0, 0] + 0.05 * socket * along
            q = middle + 0.6 * torch.from_numpy(rng.standard_normal((40, 6)))
            for _ in range(25):
                miss = target - arm.true_points(q)[:, 0]
                step = (torch.linalg.pinv(arm.truth.jacobian(q)[:, 0]) @ miss[..., None])[..., 0]
                q = q + step * (0.3 / step.abs().amax(1, keepdim=True).clamp(min=0.3))
            q = q[((target - arm.true_points(q)[:, 0]).norm(dim=1) < 1e-9) & ((q > low) & (q < high)).all(1)][:5]
            pair.append(q)
        if min(map(len, pair)) == 5:
            found += pair
    names = [f"{k // 10}/{k // 5 % 2}" for k in range(40)]
    q = torch.cat(found)
    return q + 2e-5 * torch.from_numpy(rng.standard_normal(tuple(q.shape))), names


def outcome(kind: str, seed: int) -> tuple[str, float]:
    """Whether a placement is "right", "wrong" or "refused", and the processor's seconds."""
    frame = kind in ("poses", "camera on the tool")
    arm = anywhere(seed, frame)
    table, q, begin = table_of(kind, arm, seed), arm.sample(TESTED, seed=seed + 2), time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = placed(arm.nominal, table)(q)
    except dc.DiffeoCalibError:
        return "refused", time.process_time() - begin
    seconds, truth = time.process_time() - begin, arm.true_points(q)
    if frame:
        found, truth = poses_of(found), poses_of(truth)
    elif kind != "positions":
        truth = aligned(truth, found)
    errors = errors_of(found, truth)
    return "right" if rms(errors * TURNS[0, : errors.shape[-1]]) < RIGHT_M else "wrong", seconds


CASES = (*ROWS, "distances", "distances of unknown zero", "heights", "images")


def some(kind: str, seeds: range) -> list[tuple[str, float]]:
    """Outcomes of some placements."""
    torch.set_num_threads(1)
    return [outcome(kind, seed) for seed in seeds]


def measure(plan: Any) -> Iterator[Record]:
    """A record for every kind."""
    count = 2 if plan.quick else plan.count
    chunks = [range(first, min(first + CHUNK, count)) for first in range(0, count, CHUNK)]
    with ProcessPoolExecutor(plan.jobs, get_context("spawn")) as pool:
        for kind in plan.cases:
            found = [one for part in pool.map(some, [kind] * len(chunks), chunks) for one in part]
            words = [word for word, _ in found]
            missed = [str(seed) for seed, word in enumerate(words) if word != "right"]
            yield {
                **{"case": kind, "rows": ROWS.get(kind, READINGS), "placements": count},
                **{name: words.count(name) for name in ("right", "refused", "wrong")},
                **{"seeds": " ".join(missed), "seconds": sum(seconds for _, seconds in found) / count},
            }


if __name__ == "__main__":
    count, jobs = harness.number(1000, "placements of every kind"), harness.number(1, "processes")
    columns = ("case", "rows", "placements", "right", "refused", "wrong", "seconds")
    harness.run(__doc__, measure, columns, count=count, jobs=jobs, cases=harness.names(CASES))
