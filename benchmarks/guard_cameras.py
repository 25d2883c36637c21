"""Simulated robots that cameras measure, for guard.py; see guard_kinds.py."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from guard_kinds import (
    ELSEWHERE,
    GROWTH,
    JOINT,
    JUDGED,
    LATER,
    NEW,
    NOISE_M,
    NOISE_PX,
    TRAIN,
    WORN,
    Robot,
    Rows,
    drawn,
    flange_poses,
    noisy_poses,
    sampled,
)
from simulated_camera import CameraArm, camera_arm, fixed_camera_arm, images_of_both, poses_of
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm

COUNTS = (45, 25, 15, 25)
POSE_NOISE_M = 1e-4
"""Of a board's pose that a camera's software reports."""


def parts_of(whole: CameraArm, counts: Sequence[int], *, on_tool: bool) -> dict[int, CameraArm]:
    """The four measurements, in configurations of their own; the last of an arm that has worn."""
    found, first = {}, JUDGED
    for part, count in enumerate(counts):
        q = whole.q[first : first + count]
        arm = whole.arm.worn(JOINT, GROWTH) if part == WORN else whole.arm
        seen = poses_of(arm.true_points(q))
        found[part] = replace(whole, arm=arm, q=q, boards=torch.linalg.inv(seen) if on_tool else seen)
        first += count
    return found


def robot_of(whole: CameraArm, arms: dict[int, CameraArm], rows: dict[int, Rows], moved: Tensor | None = None) -> Robot:
    """The robot of these rows; ``moved`` (4, 4) is where the measuring frame is seen from later."""

    def true(part: int, q: Tensor) -> Tensor:
        seen = poses_of(arms[part].arm.true_points(q))[:, None]
        return seen if moved is None or part == TRAIN else moved @ seen

    q, truth = whole.q[:JUDGED], {part: partial(true, part) for part in (TRAIN, LATER, WORN)}
    return Robot(whole.arm.nominal, rows, q, truth, flange_poses(whole.arm, q, None))


def camera_on_tool(seed: int) -> Robot:
    """A camera that reports poses of a board, which stands elsewhere later."""
    whole = camera_arm(JUDGED + 200, seed)
    arms, rows = parts_of(whole, (40, 60, 15, 25), on_tool=True), {}
    for part, own in arms.items():
        seen = noisy_poses(poses_of(own.arm.true_points(own.q))[:, None], (seed, part), POSE_NOISE_M)
        seen = seen if part in (TRAIN, NEW) else ELSEWHERE @ seen
        names, boards = own.arm.nominal.joint_names, torch.linalg.inv(seen[:, 0])
        rows[part] = Rows(dc.Measurements.from_poses(own.q, boards, names, camera_on_tool=True), own.q, {"poses": seen})
    return robot_of(whole, arms, rows, ELSEWHERE)


def images(seed: int, *, on_tool: bool = True) -> Robot:
    """Images of a printed board, by a camera on the tool or a fixed one."""
    whole = (camera_arm if on_tool else fixed_camera_arm)(JUDGED + 150, seed)
    arms = parts_of(whole, COUNTS, on_tool=on_tool)
    rows = {part: _seen(own.images(NOISE_PX, on_tool=on_tool, seed=40 * seed + part)) for part, own in arms.items()}
    return robot_of(whole, arms, rows)


def two_cameras(seed: int, *, on_tool: bool = False) -> Robot:
    """Two cameras that see one board; the first has more images and gives the measuring frame."""
    make = camera_arm if on_tool else fixed_camera_arm
    both = [make(JUDGED + 150, seed, second=second) for second in (False, True)]
    arms = [parts_of(whole, COUNTS, on_tool=on_tool) for whole in both]
    rows = {}
    for part, count in enumerate(COUNTS):
        share = (count // 2, count // 2 - 3)
        own = [each[part] for each in arms]
        rows[part] = _seen(images_of_both(own, share, NOISE_PX, 40 * seed + part, on_tool=on_tool))
    return robot_of(both[0], arms[0], rows)


def images_and_tracker(seed: int) -> Robot:
    """Images of a board, and in other rows a tracker's marker on the same tool."""
    whole, tracker = camera_arm(JUDGED + 150, seed), SimulatedArm(seed)
    arms, rows = parts_of(whole, COUNTS, on_tool=True), {}
    for part, own in arms.items():
        arm = copy.copy(own.arm)
        arm.truth = replace(arm.truth, base=tracker.truth.base, tool=tracker.truth.tool, on=tracker.truth.on)
        q = sampled(arm, COUNTS[part], (seed, part + 30))
        points = arm.true_points(q) + NOISE_M * drawn((seed, part), len(q), 1, 3)
        tracked = dc.Measurements(q, points, arm.nominal.joint_names)
        seen = own.images(NOISE_PX, seed=40 * seed + part)
        rows[part] = _seen(dc.Observations.joined([seen, tracked]))
    return robot_of(whole, arms, rows)


def _seen(table: Any) -> Rows:
    """Images are judged by the truth alone."""
    return Rows(table, table.q, {})


KINDS: dict[str, Callable[[int], Robot]] = {
    "camera on the tool": camera_on_tool,
    "images of a board": images,
    "images of a board on the tool": partial(images, on_tool=False),
    "two cameras": two_cameras,
    "two cameras on the tool": partial(two_cameras, on_tool=True),
    "images and a tracker": images_and_tracker,
}
"""Kind -> the robot of a seed."""
