"""Images of a printed board as pixels, against poses of the board and the field's usual ways from these to a robot.

    python benchmarks/real_robots/board_images.py --out board_images.json [--seeds 3] [--rendered]

The simulated arm with a camera on its flange or a fixed one, corners with drawn errors, or rendered images in which
OpenCV finds them (needs OpenCV; before 5 for its hand-eye methods). `--several`: pixels alone, of two fixed cameras
that see the same board, half of the images each, and of a head that sees a board on its own hand. The print is
drawn from its prior, its scale is known to 2e-4. Fields: `case`, `seed`, `images`, `noise_px`, `method`; `true_mm`,
RMS error of three points of the camera's pose (0.1 m) over 200 new configurations in which it sees the board, without
noise, after a rigid fit; `coverage_95` of these points by the model's regions without rigid motions,
`coverage_absolute` with them and without the fit; `expected_mm`, what the model expects of `true_mm`; the same three
`apart_*` from the board's size, one number that all images share: by the print `true_mm` is then right or wrong as a
whole; `size_z`, its error in standard deviations; `seconds`; `memory_mib`, the process's peak so far.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share
sys.path.insert(0, str(Path(__file__).parents[1] / "robustness"))

import resource
import time
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import harness
import numpy as np
import torch
from camera_peers import opencv_poses, peers
from harness import Record
from held_out import covered
from simulated_camera import (
    BOARD_PRIOR,
    FEWEST_SEEN,
    HEIGHT,
    WIDTH,
    CameraArm,
    camera_arm,
    fixed_camera_arm,
    images_of_both,
    seen_corners,
)
from simulated_head import SeeingHead
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.poses import own_blocks
from diffeo_calib.robots.se3 import skew

COUNTS, NOISES_PX, TEST_ROWS = (30, 60, 120), (0.1, 0.3), 200
COLUMNS = ("case", "seed", "images", "noise_px", "method", "true_mm", "expected_mm", "coverage_95", "coverage_absolute")
COLUMNS = (*COLUMNS, "apart_true_mm", "apart_expected_mm", "apart_coverage_95", "size_z", "seconds", "memory_mib")


class Rows(NamedTuple):
    """A robot, its first images by their number and noise, and new configurations with their true points, m."""

    robot: dc.Tree
    images: Callable[[int, float], dc.Measurements]
    new: Tensor
    truth: Tensor


def measure(plan: Namespace) -> Iterator[Record]:
    """A record for every case, seed, number of images, noise and method."""
    if plan.several:
        yield from _several(plan.seeds)
        return
    cases = {"camera on the tool": camera_arm, "fixed camera": fixed_camera_arm}
    for seed in range(1, plan.seeds + 1):
        for case, make in cases.items():
            seen = make(2 * max(COUNTS) + TEST_ROWS, seed, print_seed=seed)
            for noise_px in (None,) if plan.rendered else NOISES_PX:
                corners, shown = _rendered(seen) if noise_px is None else _drawn(seen, noise_px, seed)
                for count in COUNTS:
                    if count <= len(shown):
                        own = {"case": case, "seed": seed, "images": count, "noise_px": noise_px or "rendered"}
                        rows = shown[:count]
                        for record in _judged(seen, corners, rows, case == "fixed camera"):
                            yield {**own, **record}


def _several(seeds: int) -> Iterator[Record]:
    """Two cameras, and head and hand, by pixels alone."""
    for seed in range(1, seeds + 1):
        for case, rows in {"two fixed cameras": _two_cameras(seed), "head and hand": _head(seed)}.items():
            for noise_px in NOISES_PX:
                for count in COUNTS:
                    data = rows.images(count, noise_px)
                    own = {"case": case, "seed": seed, "images": count, "noise_px": noise_px}
                    if len(data) == count:
                        yield {**own, **_pixels(rows.robot, lambda data=data: data, rows.new, rows.truth)}


def _two_cameras(seed: int) -> Rows:
    arms = [fixed_camera_arm(max(COUNTS) + TEST_ROWS, seed, seed, second=second) for second in (False, True)]
    new = torch.cat([arm.q[-TEST_ROWS // 2 :] for arm in arms])
    shown = [replace(arm, q=arm.q[:-TEST_ROWS], boards=arm.boards[:-TEST_ROWS]) for arm in arms]
    images = lambda count, noise_px: images_of_both(shown, [count // 2] * 2, noise_px, 100 + seed)  # noqa: E731
    return Rows(arms[0].arm.nominal, images, new, arms[0].arm.true_points(new))


def _head(seed: int) -> Rows:
    seen = SeeingHead.drawn(2 * max(COUNTS) + TEST_ROWS, seed)
    shown, new = replace(seen, q=seen.q[:-TEST_ROWS]), seen.q[-TEST_ROWS:]
    return Rows(
        seen.robot, lambda count, noise_px: shown.images(count, noise_px, 100 + seed), new, seen.true_points(new)
    )


def _drawn(seen: CameraArm, noise_px: float, seed: int) -> tuple[Tensor, Tensor]:
    corners = seen_corners(seen.boards[:-TEST_ROWS], noise_px, 100 + seed, seen.camera)
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
            numbers, pixels = board.corners(rendered(pose @ FACING, page, seed=k, camera=seen.camera))
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
    known: dict[str, Any] = {"camera_on_tool": not fixed}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few rows
        given: dict[str, Any] = {"camera": (WIDTH, HEIGHT), "joint_names": robot.joint_names, "board": BOARD_PRIOR}
        yield _pixels(robot, lambda: dc.Measurements.from_images(q, corners[rows], **given, **known), new, truth)
        boards = opencv_poses(corners[rows])
        poses = dc.Measurements.from_poses(q, boards, robot.joint_names, **known)
        yield {"method": "poses of boards", **_regions(dc.calibrate(robot, poses).model, new, truth)}
        for name, points in peers(robot, poses, boards, fixed=fixed):
            yield {"method": name, "true_mm": round(1e3 * rigid_rms(points(new), truth), 4)}


def _pixels(robot: dc.Tree, images: Callable[[], dc.Measurements], new: Tensor, truth: Tensor) -> Record:
    """What a model of images makes of new configurations."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few rows
        start = time.perf_counter()
        model = dc.calibrate(robot, images()).model
        seconds = round(time.perf_counter() - start, 1)
    memory = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    return {"method": "pixels", **_regions(model, new, truth), "seconds": seconds, "memory_mib": memory}


def _regions(model: dc.CalibratedKinematics, new: Tensor, truth: Tensor) -> Record:
    """True and expected error, and shares of true points (N, 3, 3) within the model's 95 % regions."""
    mean, fitted = model(new).detach(), model.map
    points = mean.flatten(0, 1)
    R, t = rigid_fit(truth.flatten(0, 1), points)
    error = truth.flatten(0, 1) @ R + t - points
    whole = fitted.conditional.covariance_between(fitted.geodesic.linearise(new))
    motions = rigid_motions(points)
    larger = mean.mean(1, keepdim=True).expand_as(mean).reshape(-1, 1)  # a larger board is farther away as a whole
    free, apart = (without(directions, whole) for directions in (motions, torch.cat([motions, larger], 1)))
    size = torch.linalg.qr(torch.cat([motions, larger], 1)).Q[:, -1]
    left = (error.flatten() - size * (size @ error.flatten())).view_as(error)
    absolute = truth.flatten(0, 1) - points
    return {
        "true_mm": _mm(error.square().sum(1)),
        "expected_mm": _mm(_blocks(free).diagonal(dim1=1, dim2=2).sum(1)),
        "coverage_95": round(covered(error, _blocks(free)), 3),
        "coverage_absolute": round(covered(absolute, _blocks(whole)), 3),
        "apart_true_mm": _mm(left.square().sum(1)),
        "apart_expected_mm": _mm(_blocks(apart).diagonal(dim1=1, dim2=2).sum(1)),
        "apart_coverage_95": round(covered(left, _blocks(apart)), 3),
        "size_z": round(float(size @ error.flatten() / (size @ free @ size).sqrt()), 2),
    }


def _mm(squares: Tensor) -> float:
    return round(1e3 * float(squares.mean().sqrt()), 4)


def _blocks(covariance: Tensor) -> Tensor:
    """Of every point: (3 M, 3 M) -> (M, 3, 3)."""
    return own_blocks(covariance[None], len(covariance) // 3)[0]


def rigid_motions(points: Tensor) -> Tensor:
    """Displacements (3 M, 6) of points (M, 3) by shifts and turns."""
    eye = torch.eye(3, dtype=points.dtype).expand(len(points), 3, 3)
    return torch.cat([eye, -skew(points - points.mean(0))], 2).flatten(0, 1)


def without(directions: Tensor, covariance: Tensor) -> Tensor:
    """The covariance (3 M, 3 M) of what is left after the best combination of directions (3 M, k)."""
    Q = torch.linalg.qr(directions).Q
    less = covariance - Q @ (Q.mT @ covariance)
    return less - (less @ Q) @ Q.mT


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


if __name__ == "__main__":
    rendered = {"action": "store_true", "help": "render the images, and find the corners by OpenCV"}
    several = {"action": "store_true", "help": "two fixed cameras, and head and hand"}
    seeds = harness.number(3, "simulated arms")
    harness.run(__doc__, measure, COLUMNS, quick={"seeds": 1}, seeds=seeds, rendered=rendered, several=several)
