"""Where a camera and the board that it sees are, one of them on the tool, with standard deviations.

A calibration finds the robot's base in the frame of what stands, and the three points of a pose in the frame of the
tip. A camera on the tool: the first is the inverse of the board's pose in the base, the second the hand-eye transform.
A fixed camera: the inverse of the camera's pose in the base, and the board on the tool. Each of several fixed cameras
is a session, whose frame is known from that of the model: their errors and those of the base belong together.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.re_registration.registered_map import frame_slopes
from diffeo_calib.measurements.images import ONLY_CAMERA
from diffeo_calib.measurements.pose_frames import inverse_poses
from diffeo_calib.measurements.poses import pose_directions, poses_from_marks, rotation_numbers
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import skew
from diffeo_calib.sensors.places import NUMBERS_OF_A_FRAME, SESSION

RIGID_MOTION_SHARE = 0.01
"""Effects of a frame's shift differ from a rigid motion of the fitted points by less than this share."""


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
        cls,
        model: CalibratedKinematics,
        *,
        camera_on_tool: bool = True,
        geometry: Geometry | None = None,
        camera: str | None = None,
    ) -> HandEye:
        """Camera and board of a model that was calibrated with images or poses of a board.

        Args:
            model: the model. camera_on_tool: whether the camera is on the tool, else the board.
            geometry: rigid kinematics, with the places that belong to them; by default those of the model.
            camera: name of its session, of several fixed ones; by default the one whose frame is the model's.

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
        frame = SessionFrame.of(model, camera)
        standing = inverse_poses((frame.transform @ geometry.base)[None])[0]
        # base T(e) for an error twist e: what stands moves by -e, at its place, seen from the base
        moved = -torch.eye(6, dtype=standing.dtype, device=standing.device)
        moved[:3, 3:] = skew(standing[:3, 3])
        found = moved @ _covariance(fitted, geometry.slices["base"], frame.seen_from(geometry.base)) @ moved.mT
        tip, base = geometry.on[0], model.robot.base
        carried_there = Fixed(KnownPose(carried[0], known), tip, f"in the frame of '{tip}'", "in_tip")
        standing_there = Fixed(KnownPose(standing, found), base, "in the robot's base", "in_base")
        return cls(*((carried_there, standing_there) if camera_on_tool else (standing_there, carried_there)))

    @classmethod
    def of_each(
        cls, model: CalibratedKinematics, *, camera_on_tool: bool, geometry: Geometry | None = None
    ) -> dict[str, HandEye]:
        """That of every camera, of several fixed ones every session's, by name; arguments as of :meth:`of`."""
        cameras = [name for own in model.placement for name in own.cameras] or [ONLY_CAMERA]
        known = {"camera_on_tool": camera_on_tool, "geometry": geometry}
        if len(cameras) == 1:
            return {cameras[0]: cls.of(model, **known)}
        sessions = [name for own in model.placement if own.kind == SESSION for name in own.names]
        return {name: cls.of(model, camera=name, **known) for name in sessions}

    def entry(self) -> dict[str, object]:
        """Both poses for programs."""
        return {f"{name}_{own.key}": own.known.entry() for name, own in vars(self).items()}


def hand_eye_entry(found: Mapping[str, HandEye]) -> dict[str, object]:
    """Camera and board for programs; of several cameras by their names; nothing of none."""
    each = {name: own.entry() for name, own in found.items()}
    return {"hand_eyes": each} if len(each) > 1 else dict(zip(("hand_eye",), each.values(), strict=False))


def hand_eye_sentences(found: Mapping[str, HandEye]) -> Iterator[str]:
    """Every camera and the board with their deviations."""
    for name, own in found.items():
        which = "camera" if len(found) == 1 else f"camera '{name}'"
        yield from own.camera.known.sentences(f"{which} {own.camera.where} (hand-eye transform)")
    yield from (line for own in [*found.values()][:1] for line in own.board.known.sentences(f"board {own.board.where}"))


class SessionFrame(NamedTuple):
    """The measuring frame of a session.

    Args:
        transform: (4, 4) from the model's, m. columns: (c,) boolean, the shifts of the fit that move it; twists: (6, k)
            shift and turn of points about the model's origin, m and rad, by each of them. None for the model's frame.
    """

    transform: Tensor
    columns: Tensor | None = None
    twists: Tensor | None = None

    @classmethod
    def of(cls, model: CalibratedKinematics, name: str | None) -> SessionFrame:
        """By the rows of the session in the fit."""
        eye = torch.eye(4, dtype=model.geometry.base.dtype, device=model.geometry.base.device)
        own = next((own for own in model.placement if own.kind == SESSION and name in own.names), None)
        if name is None or own is None:
            return cls(eye)
        number, fitted = own.names.index(name), model.map
        transform, rows = own.constants[number].view(4, 4), own.rows[own.device == number]
        if bool((transform == eye).all()):
            return cls(eye)
        shared, points = fitted.noise.shared, fitted.fitted_points.unflatten(1, (-1, 3))
        others = torch.ones(len(shared), dtype=torch.bool, device=shared.device)
        others[rows] = False
        columns = (shared[rows] != 0).any(1).any(0) & ~(shared[others] != 0).any(1).any(0)
        effects = shared[rows][..., columns].flatten(0, 1)
        slopes = frame_slopes(points[rows], points.new_zeros(3)).flatten(0, 1)
        twists = torch.linalg.lstsq(slopes, effects, driver="gelsd").solution
        left = (effects - slopes @ twists).norm(dim=0)
        rigid = left < RIGID_MOTION_SHARE * effects.norm(dim=0)
        columns[columns.clone()] = rigid
        if int(rigid.sum()) != NUMBERS_OF_A_FRAME:
            what = f"the hand-eye transform of '{name}'"
            raise InputError.of(what, expected="a model in the place of its fit", fix="calibrate with all rows")
        return cls(transform, columns, twists[:, rigid])

    def seen_from(self, base: Tensor) -> tuple[Tensor, Tensor] | None:
        """The columns, and their twists (6, k) about the origin of a base (4, 4) and along its axes; None for none."""
        if self.columns is None or self.twists is None:
            return None
        shift, turn = self.twists.split(3)
        there = shift + torch.linalg.cross(turn, base[:3, 3:].expand_as(turn), dim=0)
        return self.columns, torch.cat([base[:3, :3].mT @ there, base[:3, :3].mT @ turn])


def _covariance(fitted: FittedMap, part: slice, shifts: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Posterior covariance of some parameters, m^2 and rad^2, what the rows leave open included.

    With ``shifts``, columns (c,) and effects (k', k), that of their sum with shifts that rows of the fit shared.
    """
    numbers = torch.arange(part.start, part.stop, dtype=torch.int64, device=fitted.x.device)
    still_open = fitted.open_directions[numbers]
    if shifts is None:
        known = fitted.parameter_covariance(numbers)
    else:
        columns, effects = shifts
        known = fitted.with_shifts(fitted.parameters_as_points(numbers), effects[None], columns)[0]
    return known + still_open @ still_open.mT


def _numbers(values: Tensor) -> str:
    return " ".join(f"{value:.3f}" for value in values.tolist())
