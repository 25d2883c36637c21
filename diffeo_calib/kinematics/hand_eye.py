"""Where a camera and the board that it sees are, one of them on the tool, with standard deviations.

A calibration finds the robot's base in the frame of what stands, and the three points of a pose in the frame of the
tip. A camera on the tool: the first is the inverse of the board's pose in the base, the second the hand-eye transform.
A fixed camera: the inverse of the camera's pose in the base, and the board on the tool. Each of several fixed cameras
is a session, whose frame is known from that of the model: their errors and those of the base belong together.

What errors of a machine with commanded poses have in common in all rows is a base, or a tool, elsewhere: no row tells
them apart. An arm that is wrong by a joint's zero or a link's length errs by more on average than it varies over the
rows, and a field of zero mean does not expect that. So a motion of all poses is added, as large as the machine's errors
are that its fields do not resolve: those of such arms change with joints, too fast for fields over poses.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.device_readings import own_shifts
from diffeo_calib.measurements.bodies import transform_words, triple
from diffeo_calib.measurements.images import ONLY_CAMERA
from diffeo_calib.measurements.poses import inverse_poses, pose_directions, poses_from_marks
from diffeo_calib.robots.cartesian import is_cartesian, turns_nowhere
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import twist_at
from diffeo_calib.sensors.set_ups import NUMBERS_OF_A_FRAME, SESSION, TRANSFORMS, frame_slopes, own_slopes

IN_TIP = "in_tip"
COMMON = torch.tensor([[4.0, 4.0], [1.0, 2.25]], dtype=torch.float64, device="cpu")
"""Variances of shift and turn that all poses share, at base and tip, relative to the size of a machine's errors and to
that over its reach: of arms with wrong zeros, or links too, 95 % of regions by 20 poses hold."""
SMOOTH = 0.02  # share of the fields' variances in that size


@dataclass(frozen=True, eq=False)
class KnownPose:
    """A pose (4, 4) [m] and the covariance (6, 6) of its shift and turn [m, rad], in the axes of a link."""

    pose: Tensor
    covariance: Tensor
    link: str
    where: str  # this frame in messages
    key: str  # and in files

    @property
    def deviations(self) -> Tensor:
        """(6,) standard deviations of the position, m, and of the rotation, rad."""
        return self.covariance.diagonal().clamp(min=0).sqrt()

    def entry(self) -> dict[str, object]:
        """For programs: the pose as four rows, and the deviations."""
        position, rotation = (part.tolist() for part in self.deviations.split(3))
        return {"pose_m": self.pose.tolist(), "position_std_m": position, "rotation_std_rad": rotation}

    def sentences(self, what: str) -> Iterator[str]:
        """Pose and deviations in mm and degrees."""
        position, rotation = self.deviations.split(3)
        yield f"{what}: {transform_words(self.pose)}"
        yield f"  known to {triple(1e3 * position)} mm and {triple(rotation.rad2deg())} deg (standard deviations)"


@dataclass(frozen=True, eq=False)
class HandEye:
    """A camera and its board: one of them is fixed to the robot's tip, the other stands."""

    camera: KnownPose
    board: KnownPose

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

        Raises InputError: a model of points, or one that was registered again.
        """
        if model.registration is not None:
            raise InputError.of("the hand-eye transform", expected="a model in the place of its fit")
        geometry, lever = geometry or model.geometry, model.bodies.pose_lever()
        set_up, tool = SetUp.of(model, camera), poses_from_marks(geometry.tool[None], lever)
        carried = (tool @ set_up.mount)[0]
        from_tool = twist_at(carried[:3, 3] - tool[0, :3, 3])
        arm = from_tool @ torch.block_diag(*[tool[0, :3, :3]] * 2)  # by a shift and a turn along the axes of the tool
        by_tool = from_tool @ pose_directions(tool, lever)[0]
        in_tip = _covariance(model.map, geometry.slices["tool"], by_tool, set_up.columns, arm @ set_up.of_mount)
        in_tip = in_tip + arm @ torch.diag(set_up.mount_std.square()) @ arm.mT
        # base T(e) for an error twist e: what stands moves by -e, at its place, seen from the base
        standing = inverse_poses((set_up.transform @ geometry.base)[None])[0]
        by_base, back = -twist_at(standing[:3, 3]), geometry.base[:3, :3].mT
        of_base = torch.block_diag(back, back) @ twist_at(geometry.base[:3, 3]) @ set_up.of_frame
        in_base = _covariance(model.map, geometry.slices["base"], by_base, set_up.columns, by_base @ of_base)
        tip, base = geometry.on[0], model.robot.base
        if is_cartesian(geometry.chain):
            (at_base, at_tip), middle = _common_motions(model, geometry)
            of_tip, of_middle = twist_at(carried[:3, 3]), twist_at(standing[:3, 3] - middle)
            in_tip, in_base = in_tip + of_tip * at_tip @ of_tip.mT, in_base + of_middle * at_base @ of_middle.mT
        there = KnownPose(carried, in_tip, tip, f"in the frame of '{tip}'", IN_TIP)
        poses = there, KnownPose(standing, in_base, base, "in the robot's base", "in_base")
        return cls(*(poses if camera_on_tool else reversed(poses)))

    @classmethod
    def of_each(
        cls, model: CalibratedKinematics, *, camera_on_tool: bool, geometry: Geometry | None = None
    ) -> dict[str, HandEye]:
        """Result for every camera, of several fixed ones every session's, by name; arguments as of :meth:`of`."""
        named = {name: None for devices in model.placement for name in devices.cameras} or {ONLY_CAMERA: None}
        if len(named) > 1:
            named = {name: name for group in model.placement if group.kind in TRANSFORMS for name in group.names}
        options = {"camera_on_tool": camera_on_tool, "geometry": geometry}
        return {name: cls.of(model, camera=camera, **options) for name, camera in named.items()}

    @classmethod
    def of_fit(cls, model: CalibratedKinematics) -> dict[str, HandEye]:
        """Result where the model's images, or the command that made it, say where the camera is; else nothing.

        Beside commanded poses, measured ones are of a frame on the tool that a camera sees.
        """
        made, cameras = model.provenance, [camera for devices in model.placement for camera in devices.cameras.values()]
        words = shlex.split(made.command or "") if made is not None else []
        on_tool = cameras[0].on_tool if cameras else "--camera-on-tool" in words
        commanded = is_cartesian(model.robot) and not turns_nowhere(model.robot)
        seen_board = bool(model.lever) and bool(cameras or on_tool or commanded)
        if not seen_board or model.registration:
            return {}
        return cls.of_each(model, camera_on_tool=on_tool)

    def entry(self) -> dict[str, object]:
        """Both poses for programs."""
        return {f"{name}_{pose.key}": pose.entry() for name, pose in vars(self).items()}


def hand_eye_sentences(results: Mapping[str, HandEye]) -> Iterator[str]:
    """Every camera and the board with their deviations."""
    for name, eye in results.items():
        which = "camera" if len(results) == 1 else f"camera '{name}'"
        yield from eye.camera.sentences(f"{which} {eye.camera.where} (hand-eye transform)")
    yield from (line for eye in [*results.values()][:1] for line in eye.board.sentences(f"board {eye.board.where}"))


class SetUp(NamedTuple):
    """A set-up of a model: where it measured, and what was on the tool."""

    transform: Tensor  # (4, 4) from the model's measuring frame to its own, m
    mount: Tensor  # (4, 4) from what it had on the tool to that of the model, m
    columns: Tensor  # (c,) boolean, the shifts of the fit that move its rows, not those of the others
    # (6, k) shift and turn by each of them, m and rad: of the measuring frame about the model's origin, and of what is
    # on the tool along the axes of the model's tool
    of_frame: Tensor
    of_mount: Tensor
    mount_std: Tensor  # (6,) deviations of what is on the tool where no row of the fit tells of them, else zero

    @classmethod
    def of(cls, model: CalibratedKinematics, name: str | None) -> SetUp:
        """By the rows of the set-up in the fit."""
        shared, points = model.map.noise.shared, model.map.fitted_points.unflatten(1, (-1, 3))
        eye, none = torch.eye(4, dtype=points.dtype, device=points.device), points.new_zeros(6, 0)
        columns = torch.zeros(shared.shape[2], dtype=torch.bool, device=shared.device)
        here = cls(eye, eye, columns, none, none, points.new_zeros(6))
        group = next((group for group in model.placement if group.kind in TRANSFORMS and name in group.names), None)
        if name is None or group is None:
            return here
        number = group.names.index(name)
        transform, rows = group.constants[number].view(4, 4), group.rows[group.device == number]
        if transform.equal(eye):
            return here
        framed, others = group.kind == SESSION, torch.ones(len(shared), dtype=torch.bool, device=shared.device)
        others[rows] = False
        alone = shared[rows] * ~(shared[others] != 0).any(1).any(0)
        slopes = frame_slopes(points[rows], points.new_zeros(3)) if framed else own_slopes(points[rows])
        columns, twists = own_shifts(alone, slopes)
        rigid, still = int(columns.sum()), torch.zeros_like(twists)
        if rigid != NUMBERS_OF_A_FRAME and bool((alone != 0).any()) and (framed or rigid):
            what = "the hand-eye transform of one of several cameras"
            raise InputError.of(what, expected="a model in the place of its fit", fix="calibrate with all rows")
        if framed:
            return here._replace(transform=transform, columns=columns, of_frame=twists, of_mount=still)
        std = here.mount_std if rigid else group.deviations[number]
        return here._replace(mount=transform, columns=columns, of_frame=still, of_mount=twists, mount_std=std)

    def view(self, poses: Tensor) -> Tensor:
        """What is measured of poses (M, 4, 4) of the model's tool, m."""
        return self.transform @ poses @ self.mount

    def shifted(self, points: Tensor) -> Tensor:
        """(M, 9, k) what its shifts do to points (M, 9) of the model's tool, m."""
        places = points.unflatten(1, (-1, 3))
        return frame_slopes(places, points.new_zeros(3)) @ self.of_frame + own_slopes(places) @ self.of_mount


def _common_motions(model: CalibratedKinematics, geometry: Geometry) -> tuple[Tensor, Tensor]:
    """Variances (2, 6) of what all poses share at base and tip, m^2 and rad^2; (3,) their middle in the base, m."""
    chain, places = geometry.chain, geometry.chain.tip_poses(model.map.x).view(-1, 4, 4)[:, :3, 3]
    middle = places.mean(0)
    reach = torch.maximum(middle.norm(), (places - middle).square().sum(1).mean().sqrt())
    _, smooth, _, coupled, noise = model.scales.to(places)[: 5 * chain.n].view(5, chain.n).square()
    errors = noise + SMOOTH * (smooth + coupled)
    turning = torch.tensor(chain.periodic, dtype=torch.bool, device=places.device)
    size = errors[~turning].mean() + reach.square() * errors[turning].mean().nan_to_num()
    return (COMMON.to(size) * torch.stack([size, size / reach.square()])).repeat_interleave(3, 1), middle


def _covariance(fitted: FittedMap, part: slice, slopes: Tensor, columns: Tensor, effects: Tensor) -> Tensor:
    """(6, 6) of a pose, by some parameters (6, p), open ones too, and by shared shifts, columns (c,) (6, k)."""
    numbers = torch.arange(part.start, part.stop, dtype=torch.int64, device=fitted.x.device)
    left = slopes @ fitted.open_directions[numbers]
    at = fitted.parameters_as_points(numbers).projected(slopes[None])
    return fitted.with_shifts(at, effects[None], columns)[0] + left @ left.mT
