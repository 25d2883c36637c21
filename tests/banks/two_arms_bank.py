"""A small robot with two arms on one waist, five joints, and measured poses of both hands."""

from collections.abc import Sequence
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
"""Name, parent, child, origin and axis."""
Joints = Sequence[tuple[str, str, str, str, str]]


def urdf(joints: Joints = JOINTS, end: str = "0.2 0 0.05", limit: float = 1.4) -> str:
    """Arms whose joints begin with the names of their hands, each of them fixed to the last link."""
    last = {side: [child for name, _, child, *_ in joints if name.startswith(side)][-1] for side in HANDS}
    whole = [*joints, *((f"{side}_end", last[side], side, end, "") for side in HANDS)]
    text = "".join(f'<link name="{name}"/>' for name in dict.fromkeys(link for own in whole for link in own[1:3]))
    for name, parent, child, xyz, axis in whole:
        text += f'<joint name="{name}" type="{"revolute" if axis else "fixed"}"><parent link="{parent}"/>'
        text += f'<child link="{child}"/><origin xyz="{xyz}"/>'
        text += f'<axis xyz="{axis}"/><limit lower="-{limit}" upper="{limit}"/></joint>' if axis else "</joint>"
    return f'<robot name="two_arms">{text}</robot>'


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

    def noisy(self, q: Tensor) -> Tensor:
        """Measured poses."""
        poses = self.poses(q)
        turned = rotation(10 * self.noise * self.drawn(len(q), 2, 3)) @ poses[..., :3, :3]
        return transforms(turned, poses[..., :3, 3] + self.noise * self.drawn(len(q), 2, 3))

    def measured(self, rows: int, hidden: int = 0) -> dc.Measurements:
        """Noisy poses, some of which are hidden."""
        q = torch.from_numpy(self.rng.uniform(-1.3, 1.3, (rows, self.nominal.n)))
        poses = self.noisy(q)
        for row in range(hidden):
            poses[2 * row, row % 2] = torch.nan
        return dc.Measurements.from_poses(q, poses, self.nominal.joint_names, on=HANDS)
