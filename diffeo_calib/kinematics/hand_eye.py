"""Where a camera and the board that it sees are, one of them on the tool, with standard deviations.

A calibration finds the robot's base in the frame of what stands, and the three points of a pose in the frame of the
tip. A camera on the tool: the first is the inverse of the board's pose in the base, the second the hand-eye transform.
A fixed camera: the inverse of the camera's pose in the base, and the board on the tool.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.pose_frames import inverse_poses
from diffeo_calib.measurements.poses import pose_directions, poses_from_marks, rotation_numbers
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import skew


@dataclass(frozen=True, eq=False)
class KnownPose:
    """A pose (4, 4) [m] and the covariance (6, 6) of its shift and turn [m, rad], in the axes of the frame it is in."""

    pose: Tensor
    covariance: Tensor

    @property
    def deviations(self) -> Tensor:
        """(6,) standard deviations of the position, m, and of the rotation, rad."""
        return self.covariance.diagonal().clamp(min=0).sqrt()

    def entry(self) -> dict[str, object]:
        """For programs: the pose as four rows, and the deviations."""
        position, rotation = self.deviations.split(3)
        return {
            "pose_m": self.pose.tolist(),
            "position_std_m": position.tolist(),
            "rotation_std_rad": rotation.tolist(),
        }

    def sentences(self, what: str) -> Iterator[str]:
        """Pose and deviations in mm and degrees."""
        turn = rotation_numbers(self.pose[None, :3, :3], "rotvec", angle="deg")[0]
        position, rotation = self.deviations.split(3)
        yield f"{what}: {_numbers(1e3 * self.pose[:3, 3])} mm, rotation vector {_numbers(turn)} deg"
        yield f"  known to {_numbers(1e3 * position)} mm and {_numbers(rotation.rad2deg())} deg (standard deviations)"


class Fixed(NamedTuple):
    """A pose in the frame of a link, and what messages and files call this frame."""

    known: KnownPose
    link: str
    where: str
    key: str


@dataclass(frozen=True, eq=False)
class HandEye:
    """A camera and its board: one of them is fixed to the robot's tip, the other stands."""

    camera: Fixed
    board: Fixed

    @classmethod
    def of(
        cls, model: CalibratedKinematics, *, camera_on_tool: bool = True, geometry: Geometry | None = None
    ) -> HandEye:
        """Camera and board of a model that was calibrated with images or poses of a board.

        Args:
            model: the model. camera_on_tool: whether the camera is on the tool, else the board.
            geometry: rigid kinematics, with the places that belong to them; by default those of the model.

        Raises:
            InputError: a model of points, or one that was registered again.
        """
        fitted, lever = model.map, model.bodies.pose_lever()
        if model.registration is not None:
            raise InputError.of("the hand-eye transform", expected="a model in the place of its fit")
        geometry = geometry or model.geometry
        carried = poses_from_marks(geometry.tool[None], lever)
        to_pose = pose_directions(carried, lever)[0]  # (6, 9)
        known = to_pose @ _covariance(fitted, geometry.slices["tool"]) @ to_pose.mT
        standing = inverse_poses(geometry.base[None])[0]
        # base T(e) for an error twist e: what stands moves by -e, at its place, seen from the base
        moved = -torch.eye(6, dtype=standing.dtype, device=standing.device)
        moved[:3, 3:] = skew(standing[:3, 3])
        found = moved @ _covariance(fitted, geometry.slices["base"]) @ moved.mT
        tip, base = geometry.on[0], model.robot.base
        carried_there = Fixed(KnownPose(carried[0], known), tip, f"in the frame of '{tip}'", "in_tip")
        standing_there = Fixed(KnownPose(standing, found), base, "in the robot's base", "in_base")
        return cls(*((carried_there, standing_there) if camera_on_tool else (standing_there, carried_there)))

    def entry(self) -> dict[str, object]:
        """Both poses for programs."""
        return {f"{name}_{own.key}": own.known.entry() for name, own in vars(self).items()}

    def sentences(self) -> Iterator[str]:
        """Both poses with their deviations."""
        yield from self.camera.known.sentences(f"camera {self.camera.where} (hand-eye transform)")
        yield from self.board.known.sentences(f"board {self.board.where}")


def _covariance(fitted: FittedMap, part: slice) -> Tensor:
    """Posterior covariance of some parameters, m^2 and rad^2, what the rows leave open included."""
    numbers = torch.arange(part.start, part.stop, dtype=torch.int64, device=fitted.x.device)
    still_open = fitted.open_directions[numbers]
    return fitted.parameter_covariance(numbers) + still_open @ still_open.mT


def _numbers(values: Tensor) -> str:
    return " ".join(f"{value:.3f}" for value in values.tolist())
