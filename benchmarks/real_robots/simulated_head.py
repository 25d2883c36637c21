"""A head that sees a printed board on its own hand: the simulated upper body with a neck of two joints and a camera.

The camera's link is the base of the chain, so that the measuring frame is one that the neck moves against gravity. True
errors: of all joints' frames (0.5 mm, 0.5 mrad), two harmonics of every encoder, sag by gravity, lens and print.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path

import numpy as np
import torch
from simulated_body import ARM_COMPLIANCE, TRANSMISSION_RAD, TWIST_DEVIATION, URDF_FILE
from simulated_camera import BOARD_PRIOR, FEWEST_SEEN, HEIGHT, VIEW, WIDTH, seen_corners, true_camera
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.cameras.images import Camera
from diffeo_calib.common.device import HOST
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.measurements.poses import inverse_poses, mark_points, poses_from_marks
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.gravity import GravitySag
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import load_urdf

CAMERA, HAND = "head_camera", "left_hand"
NECK = """
  <link name="neck"/>
  <joint name="neck_yaw" type="revolute"><parent link="chest"/><child link="neck"/><origin xyz="0.02 0 0.3"/>
    <axis xyz="0 0 1"/><limit lower="-1.2" upper="1.2" effort="20" velocity="2"/></joint>
  <link name="head"/>
  <joint name="neck_pitch" type="revolute"><parent link="neck"/><child link="head"/><origin xyz="0 0 0.08"/>
    <axis xyz="0 1 0"/><limit lower="-0.5" upper="1.0" effort="20" velocity="2"/></joint>
  <link name="head_camera"/>
  <joint name="lens" type="fixed"><parent link="head"/><child link="head_camera"/>
    <origin xyz="0.08 0 0.06" rpy="-1.5707963 0 -1.5707963"/></joint>
"""
"""The camera's link looks along its z axis, forwards."""
CAMERA_AWAY = (0.004, -0.003, 0.005, 0.02, -0.01, 0.015)
"""True place of the optical frame in the camera's link, m and rad."""
BOARD_ON_HAND = (0.03, 0.0, -0.04, 0.0, pi / 2, 0.0)
"""Place of the board in the hand, m and rad: on the back of it."""
NEAR_M, FAR_M, MASS_KG = 0.25, 0.75, 1.0


def head_and_hand() -> Tree:
    """The chain from the camera over neck, chest and arm to the hand."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "body.urdf"
        path.write_text(URDF_FILE.read_text().replace("</robot>", f"{NECK}</robot>"))
        return load_urdf(path, CAMERA, HAND)


@dataclass(frozen=True, eq=False)
class SeeingHead:
    """A head and its hand: configurations in which the camera sees the board, lens, and the true robot."""

    robot: Tree
    truth: GeometryMap
    theta: Tensor
    waves: Tensor
    camera: Camera
    q: Tensor

    @classmethod
    def drawn(cls, rows: int, seed: int = 1) -> SeeingHead:
        """With errors of one seed, in random configurations in which the camera sees the board's printed side."""
        robot, rng = head_and_hand(), np.random.default_rng([seed, 20])
        place = torch.tensor(BOARD_ON_HAND, dtype=torch.float64, device=HOST)
        base, tool = torch.linalg.inv(twist_transform(place.new_tensor(CAMERA_AWAY))), twist_transform(place)
        geometry = Geometry.nominal(robot, 3)
        geometry = replace(geometry, base=base, tool=mark_points(tool[None], LEVER)[0])
        truth = GeometryMap(geometry, elastic=True)
        theta = torch.zeros(truth.parameters, dtype=torch.float64, device=HOST)
        joints = geometry.slices["joints"]
        theta[joints] = TWIST_DEVIATION * torch.from_numpy(rng.standard_normal(joints.stop - joints.start))
        sag = GravitySag(robot)
        pull = MASS_KG * 9.81 * ARM_COMPLIANCE * torch.from_numpy(rng.uniform(0.6, 1.4, sag.size))
        theta[geometry.size :] = -pull * (sag.own & (sag.components == 2))
        sizes = rng.uniform(*TRANSMISSION_RAD, (2, robot.n)), rng.uniform(0, 2 * pi, (2, robot.n))
        found = cls(robot, truth, theta, torch.from_numpy(np.stack(sizes)), true_camera(seed), theta[:0])
        return replace(found, q=found._seeing(rows, seed))

    def true_points(self, q: Tensor) -> Tensor:
        """Three points of the board's frame in the camera's, without noise: (N, n) rad -> (N, 3, 3) m."""
        harmonics = torch.tensor([[1.0], [2.0]], dtype=torch.float64, device=HOST)
        errors = (self.waves[0] * torch.sin(harmonics * q[:, None] + self.waves[1])).sum(1)
        return self.truth(q + errors, self.theta).unflatten(1, (-1, 3))

    def boards(self, q: Tensor) -> Tensor:
        """True poses (N, 4, 4) of the board in the camera's frame, m."""
        return poses_from_marks(self.true_points(q), LEVER)

    def images(self, count: int, noise_px: float, seed: int = 7) -> dc.Measurements:
        """The first images that show enough corners."""
        corners = seen_corners(self.boards(self.q), noise_px, seed, self.camera)
        shown = ((~corners[..., 3].isnan()).sum(1) >= FEWEST_SEEN).nonzero()[:count, 0]
        known = {"camera_on_tool": False, "board": BOARD_PRIOR}
        names = self.robot.joint_names
        return dc.Measurements.from_images(self.q[shown], corners[shown], (WIDTH, HEIGHT), names, **known)

    def _seeing(self, rows: int, seed: int) -> Tensor:
        found, low, high = [], *self.robot.limits.unbind(1)
        for draw in range(200):
            unit = np.random.default_rng([seed, 21, draw]).random((20_000, self.robot.n))
            q = low + (high - low) * torch.from_numpy(unit)
            boards = self.boards(q)
            away = boards[:, :3, 3].norm(dim=1)
            seen = (boards[:, 2, 3] > VIEW * away) & (away > NEAR_M) & (away < FAR_M)
            found.append(q[seen & (inverse_poses(boards)[:, 2, 3] > 0.15)])
            if sum(map(len, found)) >= rows:
                break
        return torch.cat(found)[:rows]
