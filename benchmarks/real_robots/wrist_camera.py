"""A camera on the wrist and a fixed board: poses of the board in the camera, against the same numbers inverted by hand.

    python benchmarks/real_robots/wrist_camera.py --data FOLDER --out wrist_camera.json

`board` reads poses of the board in the camera's frame (`camera_on_tool`), `inverted` the poses of the camera in the
board's frame, with errors as of any device: the noise is all that differs. Robots: the Franka FR3 (five folds of its
114 rows), and the simulated arm (60 rows, errors 0.1 mm and 1 mrad of the board's pose) whose truth is known.

Fields of a record: `robot`, `case`, `fold_or_seed`; of held-out rows `rms_mm`, `median_mm` (of the camera's position in
the board's frame) and `rms_deg`, `board_mm`, the RMS error of the middle of the board in the camera's frame, and
`coverage_95` of the three points of the camera's pose; `true_mm` without noise (arm); `position_noise_mm` and
`rotation_noise_mrad` as estimated; `outliers`; `seconds` of the calibration.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import time
import warnings
from argparse import Namespace
from collections.abc import Iterator, Sequence

import harness
import torch
from harness import Record
from held_out import covered
from protocols import splits
from robot_data import BUILT_IN, data_folder, read
from simulated_camera import camera_arm

import diffeo_calib as dc
from diffeo_calib.measurements.poses import inverse_poses, poses_from_marks
from diffeo_calib.robots.tree import Tree

FRANKA = "franka_fr3"
MIDDLES = {FRANKA: (-0.22, 0.15, 0.0), "arm": (0.0, 0.0, 0.0)}
"""Places on the boards, m, where the cameras look."""
POSITION_STD, ROTATION_STD = 1e-4, 1e-3
ROWS, TEST_ROWS = 60, 200
COLUMNS = ("robot", "case", "fold_or_seed", "rms_mm", "median_mm", "rms_deg", "board_mm", "coverage_95", "true_mm")
COLUMNS = (*COLUMNS, "position_noise_mm", "rotation_noise_mrad", "outliers", "seconds")


def measure(plan: Namespace) -> Iterator[Record]:
    """A record for every robot, fold or seed, and case."""
    for seed in range(1, plan.seeds + 1):
        arm = camera_arm(ROWS + TEST_ROWS, seed)
        for case in ("inverted", "board"):
            data = arm.measured(POSITION_STD, ROTATION_STD, on_tool=case == "board")
            result, record = judged("arm", arm.arm.nominal, data[:ROWS], data[ROWS:])
            record["true_mm"] = 1e3 * arm.error(result.model, arm.q[ROWS:])
            yield {"robot": "arm", "case": case, "fold_or_seed": seed} | record
    if plan.quick:
        return
    franka = read(data_folder(plan.data) / FRANKA, BUILT_IN[FRANKA], poses=True)
    for split in splits(franka.measurements, ["kfold"], [None], 1):
        for case in ("inverted", "board"):
            train, test = (seen(rows) if case == "board" else rows for rows in (split.train, split.test))
            record = judged(FRANKA, franka.robot, train, test)[1]
            yield {"robot": FRANKA, "case": case, "fold_or_seed": split.index} | record


def seen(data: dc.Measurements) -> dc.Measurements:
    """Poses of the camera in the board's frame, as the poses of the board that the camera has seen."""
    poses = data.points if data.poses is None else inverse_poses(data.poses)
    return dc.Measurements.from_poses(data.q, poses, data.joint_names, camera_on_tool=True)


def judged(
    name: str, robot: Tree, train: dc.Measurements, test: dc.Measurements
) -> tuple[dc.CalibrationResult, Record]:
    """A calibration and its errors on held-out rows."""
    begin = time.perf_counter()
    result = dc.calibrate(robot, train)
    seconds = time.perf_counter() - begin
    found, scales = dc.evaluate(result.model, test), result.selection.scales
    mean, covariance = result.model.predict(test.q)
    record: Record = {
        "rms_mm": 1e3 * found.rms,
        "median_mm": 1e3 * found.median,
        "rms_deg": found.orientation.rms,
        "board_mm": board_error(mean, test, MIDDLES[name]),
        "coverage_95": covered(test.points - mean, covariance),
        "true_mm": None,
        "position_noise_mm": 1e3 * float(scales.sensor_noise),
        "rotation_noise_mrad": 1e3 * float(scales.rotation_noise),
        "outliers": len({one.row for one in result.outliers}),
        "seconds": seconds,
    }
    return result, record


def board_error(mean: torch.Tensor, test: dc.Measurements, middle: Sequence[float]) -> float:
    """RMS error of a point of the board in the camera's frame, mm, where the camera's poses are predicted (N, 3, 3)."""
    point = torch.tensor([*middle, 1.0], dtype=mean.dtype)
    predicted, measured = mean, test.points
    places = [(inverse_poses(poses_from_marks(p, test.lever or 0.1)) @ point)[:, :3] for p in (predicted, measured)]
    return 1e3 * float((places[0] - places[1]).square().sum(1).mean().sqrt())


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    seeds = harness.number(3, "simulated arms")
    harness.run(__doc__, measure, COLUMNS, quick={"seeds": 1}, data=harness.DATA, seeds=seeds)
