"""The simulated arm with a camera on its flange that looks at a board on the floor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.measurements.pose_frames import inverse_poses
from diffeo_calib.measurements.poses import LEVER, mark_points, poses_from_marks
from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.robots.simulated_arm import SimulatedArm

BOARD = (0.55, 0.1, 0.05)
"""Place of the board in the arm's base, m."""
CAMERA = (0.06, 0.01, 0.04, 0.1, -0.2, 0.3)
"""Place of the camera in the flange, m, and its rotation vector, rad."""
NEAR, FAR, VIEW = 0.25, 0.6, 0.85
"""Distances of the board that the camera sees, m, and cosine of half its angle of view."""


@dataclass(frozen=True)
class CameraArm:
    """An arm, configurations in which its camera sees the board, and the true poses of the board in the camera."""

    arm: SimulatedArm
    q: Tensor
    boards: Tensor

    def measured(self, position_std: float, rotation_std: float, *, on_tool: bool = True) -> dc.Measurements:
        """Measured poses with drawn errors [m, rad]; not ``on_tool``: inverted by hand, as of any device."""
        N, dtype = len(self.q), torch.float64
        shifts, turns = (torch.randn(N, 3, dtype=dtype, device=HOST, generator=seeded(k)) for k in (5, 6))
        seen = rotation(rotation_std * turns) @ self.boards[:, :3, :3]
        boards = transforms(seen, self.boards[:, :3, 3] + position_std * shifts)
        poses = boards if on_tool else inverse_poses(boards)
        return dc.Measurements.from_poses(self.q, poses, self.arm.nominal.joint_names, camera_on_tool=on_tool)

    def error(self, kinematics: dc.CalibratedKinematics, q: Tensor) -> float:
        """Root mean square distance to the truth of the three points of the camera's pose, m."""
        return float((kinematics(q) - self.arm.true_points(q)).square().sum(-1).mean().sqrt())


def camera_arm(rows: int, seed: int = 1) -> CameraArm:
    """An arm whose camera sees the board in random configurations."""
    arm = SimulatedArm(seed=seed, markers=3)
    given = torch.tensor(CAMERA, dtype=torch.float64, device=HOST)
    camera = transforms(rotation(given[None, 3:]), given[None, :3])
    base = torch.eye(4, dtype=torch.float64, device=HOST)
    base[:3, 3] = -torch.tensor(BOARD, dtype=torch.float64, device=HOST)
    arm.truth = replace(arm.truth, base=base, tool=mark_points(camera, LEVER)[0])
    found: list[tuple[Tensor, Tensor]] = []
    for draw in range(200):
        q = arm.sample(20_000, seed=1000 * seed + draw)
        boards = inverse_poses(poses_from_marks(arm.true_points(q), LEVER))
        away = boards[:, :3, 3].norm(dim=1)
        ahead = boards[:, 2, 3] > VIEW * away
        above = inverse_poses(boards)[:, 2, 3] > 0.15
        seen = ahead & above & (away > NEAR) & (away < FAR)
        found.append((q[seen], boards[seen]))
        if sum(len(part) for part, _ in found) >= rows:
            break
    q, boards = (torch.cat(parts)[:rows] for parts in zip(*found, strict=True))
    return CameraArm(arm, q, boards)
