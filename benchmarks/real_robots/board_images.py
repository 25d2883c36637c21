"""Images of a printed board as pixels, against poses of the board, OpenCV's hand-eye methods and a rigid nominal arm.

    python benchmarks/real_robots/board_images.py --out board_images.json [--seeds 3] [--rendered]

The simulated arm with a camera on its flange or a fixed one, corners with drawn errors, or rendered images in which
OpenCV finds them (needs OpenCV). The board's scale is known to 2e-4. Fields: `case`, `seed`, `images`, `noise_px`,
`method`; `true_mm`, RMS error of three points of the camera's pose (0.1 m) over 200 new configurations in which it sees
the board, without noise, after a rigid fit; `coverage_95` of these points by the model's deviations; `seconds`.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import time
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import harness
import numpy as np
import torch
from harness import Record
from simulated_camera import FEWEST_SEEN, HEIGHT, WIDTH, CameraArm, camera_arm, fixed_camera_arm, seen_corners
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.cameras.board import BoardPrior
from diffeo_calib.measurements.poses import LEVER, mark_points
from diffeo_calib.robots.geometry import Geometry

COUNTS, NOISES_PX, TEST_ROWS = (30, 60, 120), (0.1, 0.3), 200
METHODS = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
COLUMNS = ("case", "seed", "images", "noise_px", "method", "true_mm", "coverage_95", "seconds")


def measure(plan: Namespace) -> Iterator[Record]:
    """A record for every case, seed, number of images, noise and method."""
    cases = {"camera on the tool": camera_arm, "fixed camera": fixed_camera_arm}
    for seed in range(1, plan.seeds + 1):
        for case, make in cases.items():
            seen = make(2 * max(COUNTS) + TEST_ROWS, seed)
            for noise_px in (None,) if plan.rendered else NOISES_PX:
                corners, shown = _rendered(seen) if noise_px is None else _drawn(seen, noise_px)
                for count in COUNTS:
                    if count <= len(shown):
                        own = {"case": case, "seed": seed, "images": count, "noise_px": noise_px or "rendered"}
                        rows = shown[:count]
                        for record in _judged(seen, corners[rows], rows, case == "fixed camera"):
                            yield {**own, **record}


def _drawn(seen: CameraArm, noise_px: float) -> tuple[Tensor, Tensor]:
    corners = seen_corners(seen.boards[:-TEST_ROWS], noise_px)
    return corners, ((~corners[..., 3].isnan()).sum(1) >= FEWEST_SEEN).nonzero()[:, 0]


def _rendered(seen: CameraArm) -> tuple[Tensor, Tensor]:
    """Corners that OpenCV finds in 60 rendered images."""
    from rendered_board import BOARD, FACING, rendered, texture  # noqa: PLC0415

    from diffeo_calib.cameras.detection import Board  # noqa: PLC0415
    from diffeo_calib.common.errors import InputError  # noqa: PLC0415

    board, page, found = Board.of(BOARD), texture(), []
    corners = torch.full((len(seen.q), len(board.points), 5), torch.nan, dtype=torch.float64)
    for k, pose in enumerate(seen.boards[:-TEST_ROWS]):
        try:
            numbers, pixels = board.corners(rendered(pose @ FACING, page, seed=k))
        except InputError:
            continue
        whole = np.concatenate([board.points[numbers], pixels], 1)
        corners[k, : len(whole)] = torch.from_numpy(whole)
        found.append(k)
        if len(found) == COUNTS[1]:
            break
    return corners, torch.tensor(found)


def _judged(seen: CameraArm, corners: Tensor, rows: Tensor, fixed: bool) -> Iterator[Record]:
    """What every method makes of the same corners."""
    robot, q, new = seen.arm.nominal, seen.q[rows], seen.q[-TEST_ROWS:]
    truth = seen.arm.true_points(new)
    board = BoardPrior(scale=2e-4)

    def error_mm(points: Tensor) -> float:
        return round(1e3 * rigid_rms(points.detach(), truth), 4)

    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few rows
        known: dict[str, Any] = {"camera_on_tool": not fixed}
        data = dc.Measurements.from_images(q, corners, (WIDTH, HEIGHT), robot.joint_names, board=board, **known)
        model = dc.calibrate(robot, data).model
        coverage = _coverage(model, new, truth)
        seconds = round(time.perf_counter() - start, 1)
        yield {"method": "pixels", "true_mm": error_mm(model(new)), "coverage_95": coverage, "seconds": seconds}
        boards = _opencv_poses(corners)
        poses = dc.Measurements.from_poses(q, boards, robot.joint_names, **known)
        model = dc.calibrate(robot, poses).model
        coverage = _coverage(model, new, truth)
        yield {"method": "poses of boards", "true_mm": error_mm(model(new)), "coverage_95": coverage}
        found = register(robot, poses.q, poses.points)
        yield {"method": "rigid nominal arm, joint adjustment", "true_mm": error_mm(found.geometry.points(new))}
    if not fixed and hasattr(cv2, "calibrateHandEye"):  # OpenCV 5 has it no more
        for name in METHODS:
            yield {"method": f"OpenCV {name}", "true_mm": error_mm(_hand_eye(robot, q, boards, name)(new))}


def _coverage(model: dc.CalibratedKinematics, new: Tensor, truth: Tensor) -> float:
    """Share of true coordinates within 1.96 standard deviations of the model, its frame fitted to the truth."""
    mean = model(new).detach()
    covariance = model.map.posterior(new)[1]
    R, t = rigid_fit(truth.flatten(0, 1), mean.flatten(0, 1))
    std = covariance.diagonal(dim1=1, dim2=2).sqrt().view_as(mean)
    return round(float(((truth @ R + t - mean).abs() < 1.96 * std).double().mean()), 3)


def _opencv_poses(corners: Tensor) -> Tensor:
    """Poses (N, 4, 4) of the board by OpenCV alone: calibrateCamera, then solvePnP."""
    shown = [~own[:, 3].isnan() for own in corners]
    points = [own[seen, :3].float().numpy() for own, seen in zip(corners, shown, strict=True)]
    pixels = [own[seen, 3:].float().numpy() for own, seen in zip(corners, shown, strict=True)]
    none: Any = None
    _, K, distortion, *_ = cv2.calibrateCamera(points, pixels, (WIDTH, HEIGHT), none, none)
    found = torch.eye(4, dtype=torch.float64).repeat(len(corners), 1, 1)
    for k, (at, uv) in enumerate(zip(points, pixels, strict=True)):
        _, turn, place = cv2.solvePnP(at, uv, K, distortion)
        found[k, :3, :3] = torch.from_numpy(cv2.Rodrigues(turn)[0])
        found[k, :3, 3] = torch.from_numpy(place.ravel())
    return found


def _hand_eye(robot: dc.Tree, q: Tensor, boards: Tensor, name: str) -> Callable[[Tensor], Tensor]:
    """The camera's points by the nominal arm and one of OpenCV's hand-eye methods."""
    flange = Geometry.nominal(robot, 1)
    arm, seen = flange.marker_poses(q)[:, 0].numpy(), boards.numpy()
    method = getattr(cv2, f"CALIB_HAND_EYE_{name}")
    own: Any = cv2
    R, t = own.calibrateHandEye(arm[:, :3, :3], arm[:, :3, 3], seen[:, :3, :3], seen[:, :3, 3], method=method)
    X = torch.eye(4, dtype=torch.float64)
    X[:3, :3], X[:3, 3] = torch.from_numpy(R), torch.from_numpy(t.ravel())
    return lambda new: mark_points(flange.marker_poses(new)[:, 0] @ X, LEVER)


def rigid_fit(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """R, t with a R + t nearest to b: points (M, 3)."""
    U, _, Vh = torch.linalg.svd((a - a.mean(0)).mT @ (b - b.mean(0)))
    turn = torch.eye(3, dtype=a.dtype)
    turn[2, 2] = torch.linalg.det(U @ Vh)
    R = U @ turn @ Vh
    return R, b.mean(0) - a.mean(0) @ R


def rigid_rms(points: Tensor, truth: Tensor) -> float:
    """RMS distance after the best rigid motion, m."""
    R, t = rigid_fit(points.flatten(0, 1), truth.flatten(0, 1))
    return float((points.flatten(0, 1) @ R + t - truth.flatten(0, 1)).square().sum(1).mean().sqrt())


def arguments() -> Namespace:
    """Parse the command line."""
    parser = harness.parser(__doc__)
    parser.add_argument("--seeds", type=harness.count, default=3, metavar="N", help="simulated arms")
    parser.add_argument("--rendered", action="store_true", help="render the images, and find the corners by OpenCV")
    plan = parser.parse_args()
    plan.seeds = 1 if plan.quick else plan.seeds
    return plan


def run(plan: Namespace) -> None:
    """Measure."""
    harness.report(measure(plan), plan.out, COLUMNS)


if __name__ == "__main__":
    harness.guarded(lambda: run(arguments()))
