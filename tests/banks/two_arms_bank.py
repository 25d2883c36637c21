"""A small robot with two arms on one waist, five joints, and measured poses of both hands."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import rotation, transforms

HANDS = ("left", "right")
JOINTS = (
    ("waist", "base", "torso", "0 0 0.4", "0 0 1"),
    ("left_shoulder", "torso", "left_arm", "0 0.2 0.3", "0 1 0"),
    ("left_wrist", "left_arm", "left_forearm", "0.3 0 0", "1 0 0"),
    ("right_shoulder", "torso", "right_arm", "0 -0.2 0.3", "0 1 0"),
    ("right_wrist", "right_arm", "right_forearm", "0.3 0 0", "1 0 0"),
)
LINKS = ("base", "torso", "left_arm", "left_forearm", "right_arm", "right_forearm", *HANDS)


def urdf() -> str:
    links = "".join(f'<link name="{name}"/>' for name in LINKS)
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/><limit lower="-1.4" upper="1.4"/></joint>'
        for name, parent, child, xyz, axis in JOINTS
    )
    hands = "".join(
        f'<joint name="{side}_end" type="fixed"><parent link="{side}_forearm"/><child link="{side}"/>'
        '<origin xyz="0.2 0 0.05"/></joint>'
        for side in HANDS
    )
    return f'<robot name="two_arms">{links}{joints}{hands}</robot>'


def robot(folder: Path) -> dc.Tree:
    path = folder / "two_arms.urdf"
    path.write_text(urdf())
    return dc.load_urdf(path, "base", list(HANDS))


class TwoArms:
    """The robot with geometric and transmission errors, and a device that measures both hands."""

    def __init__(self, nominal: dc.Tree, noise: float = 2e-5, seed: int = 4) -> None:
        self.nominal, self.noise = nominal, noise
        self.rng = np.random.default_rng(seed)
        placed = Geometry.nominal(nominal, 2, HANDS)
        theta = self.drawn(placed.size) * 1e-3
        theta[:6] = torch.tensor([0.5, -0.3, 0.8, 0.4, 0.2, 1.0], dtype=torch.float64)
        self.truth = placed.absorb(theta)
        self.frames = transforms(rotation(0.5 * self.drawn(2, 3)), 0.05 * self.drawn(2, 3))
        self.amplitudes = 1e-3 * self.drawn(nominal.n)

    def drawn(self, *shape: int) -> Tensor:
        return torch.from_numpy(self.rng.standard_normal(shape))

    def poses(self, q: Tensor) -> Tensor:
        """True poses of the measured frames (N, 2, 4, 4), m."""
        return self.truth.marker_poses(q + self.amplitudes * torch.sin(2 * q)) @ self.frames

    def measured(self, rows: int, hidden: int = 0) -> dc.Measurements:
        """Noisy poses, some of which are hidden."""
        q = torch.from_numpy(self.rng.uniform(-1.3, 1.3, (rows, self.nominal.n)))
        poses = self.poses(q)
        turned = rotation(10 * self.noise * self.drawn(rows, 2, 3)) @ poses[..., :3, :3]
        poses = transforms(turned, poses[..., :3, 3] + self.noise * self.drawn(rows, 2, 3))
        for row in range(hidden):
            poses[2 * row, row % 2] = torch.nan
        return dc.Measurements.from_poses(q, poses, self.nominal.joint_names, on=HANDS)
