"""A rigid tool that a robot's two hands hold at once: whatever the joints do, the hands do not move to each other.

With the poses T_1 and T_2 of the frames measured on the hands and the transform X between them, which is not known,

    X^-1 T_1^-1 T_2 = 1.

The shift of that transform and its turn, times the lever of measured poses, are readings whose value is zero. They are
rows without any device that measures, beside rows in which one measured the poses of both hands.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.measurements.poses import LEVER, POINTS
from diffeo_calib.robots.se3 import nearest_rotations
from diffeo_calib.sensors.devices import Devices, moved_pose, numbers_text


@dataclass(frozen=True, eq=False)
class HeldTools(Devices):
    """Tools: constants are the rows (12) of the transform from the second hand to the first."""

    kind = "held tool"
    size_fix = "measure poses too: a held tool holds no lengths"
    seen_points, numbers_each, increments_each = 2 * POINTS, 6, 6

    @staticmethod
    def read(constants: Tensor, body: Tensor) -> Tensor:
        """Shift and, to first order, turn of the second hand from where the tool would have it, m."""
        left, right, held = body[0], body[1], constants.view(3, 4)
        R = left[:3, :3].mT @ right[:3, :3]
        shift = left[:3, :3].mT @ (right[:3, 3] - left[:3, 3]) - held[:, 3]
        turned = held[:, :3].mT @ R
        skewed = turned - turned.mT
        return torch.cat(
            [held[:, :3].mT @ shift, 0.5 * LEVER * torch.stack([skewed[2, 1], skewed[0, 2], skewed[1, 0]])]
        )

    @staticmethod
    def changed(constants: Tensor, increments: Tensor) -> Tensor:
        """Shifted and turned in the first hand's frame."""
        return moved_pose(constants, increments)

    @classmethod
    def start(cls, values: Tensor, bodies: Tensor) -> Tensor:
        """The mean of T_1^-1 T_2."""
        left, right = bodies[:, 0], bodies[:, 1]
        R = nearest_rotations((left[:, :3, :3].mT @ right[:, :3, :3]).mean(0))
        shift = (left[:, :3, :3].mT @ (right[:, :3, 3:] - left[:, :3, 3:])).mean(0)
        return torch.cat([R, shift], 1).flatten()

    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        place = (1e3 * self.constants[number].view(3, 4)[:, 3]).tolist()
        shift, turn = 1e3 * float(deviations[:3].norm()), 1e3 * float(deviations[3:].norm())
        what = f"held tool '{self.names[number]}': the second hand at {numbers_text(place)} +- {shift:.3f} mm"
        return f"{what}, +- {turn:.2f} mrad in the frame of the first"
