"""The field's usual ways from poses of a board to a robot: OpenCV alone, hand-eye methods, joint offsets."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, cast

import cv2
import torch
from simulated_camera import HEIGHT, WIDTH
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.identification.registration import find_joint_offsets, register, with_joint_offsets
from diffeo_calib.measurements.poses import inverse_poses, mark_points
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import nearest_rotations, transforms

METHODS = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
"""Of OpenCV's `calibrateHandEye`, which OpenCV 5 has no more."""
Points = Callable[[Tensor], Tensor]
"""Three points of the camera's pose (fixed camera: the board's) at configurations: (N, n) -> (N, 3, 3) m."""


def opencv_poses(corners: Tensor) -> Tensor:
    """Poses (N, 4, 4) of the board in the camera by OpenCV alone: calibrateCamera, then solvePnP."""
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


def peers(robot: dc.Tree, poses: dc.Measurements, boards: Tensor, *, fixed: bool) -> Iterator[tuple[str, Points]]:
    """Every method and its points, from poses of the board (N, 4, 4) in the camera."""
    joint = register(robot, poses.q, poses.points)
    yield "rigid nominal arm, joint adjustment", joint.geometry.points
    yield "joint offsets, joint adjustment", _offsets(joint.geometry, poses)
    if hasattr(cv2, "calibrateHandEye"):
        flange = Geometry.nominal(robot, 1)
        for name in METHODS:
            X = _hand_eye(flange.marker_poses(poses.q)[:, 0], boards, name, fixed=fixed)
            yield f"OpenCV {name}", _of_flange(flange, X)


def _offsets(geometry: Geometry, poses: dc.Measurements) -> Points:
    """Joint offsets, base and hand-eye by least squares."""
    offsets = find_joint_offsets(geometry, poses.q, poses.points)
    return register(with_joint_offsets(geometry, offsets), poses.q, poses.points).geometry.points


def _of_flange(flange: Geometry, X: Tensor) -> Points:
    return lambda q: mark_points(flange.marker_poses(q)[:, 0] @ X, LEVER)


def _hand_eye(arm: Tensor, boards: Tensor, name: str, *, fixed: bool) -> Tensor:
    """Camera (4, 4) in the flange; of a fixed camera, the board in the flange where it is on average."""
    method, known = getattr(cv2, f"CALIB_HAND_EYE_{name}"), cast("Any", cv2)
    moved = inverse_poses(arm) if fixed else arm
    one, other = moved.numpy(), boards.numpy()
    R, t = known.calibrateHandEye(one[:, :3, :3], one[:, :3, 3], other[:, :3, :3], other[:, :3, 3], method=method)
    X = transforms(torch.from_numpy(R), torch.from_numpy(t.ravel()))
    if not fixed:
        return X
    found = inverse_poses(arm) @ X @ boards
    return transforms(nearest_rotations(found[:, :3, :3].mean(0)), found[:, :3, 3].mean(0))
