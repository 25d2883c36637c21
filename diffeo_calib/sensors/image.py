"""Points in the images of fixed cameras with known intrinsics, as tangents of angles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import cos

import torch
from torch import Tensor

from diffeo_calib.cameras.images import projection
from diffeo_calib.measurements.bodies import triple
from diffeo_calib.robots.se3 import nearest_rotations, transforms
from diffeo_calib.sensors.devices import (
    SMALLEST_DISTANCE_M,
    SMALLEST_M,
    VALUE,
    Devices,
    Hypothesis,
    moved_pose,
    refuse_first,
)

VIEW_HALF_ANGLE_RAD = 0.5  # of the field of view of a camera whose poses are planned: 57 degrees in all


@dataclass(frozen=True, eq=False)
class Cameras(Devices):
    """Cameras: constants are the rows of the transform to the camera's frame (12), and the ball's mean depth [m]."""

    kind = "image"
    stated_as = "X,Y,Z,TX,TY,TZ"
    increments_each = 6
    size_fix = "trust angles and shapes only, or measure distances, which hold lengths"

    @classmethod
    def columns(cls) -> dict[str, tuple[str, ...]]:
        """None: images need a lens too."""
        return {}

    @classmethod
    def stated(cls, numbers: Tensor) -> Tensor:
        """Places of the cameras, and points that they look at; their turn about that line tells nothing."""
        line = numbers[:, 3:] - numbers[:, :3]
        depth = line.norm(dim=1, keepdim=True)
        z = line / depth
        across = torch.eye(3, dtype=z.dtype, device=z.device)[z.abs().argmin(1)]
        x = torch.nn.functional.normalize(torch.linalg.cross(across, z), dim=1)
        R = torch.stack([x, torch.linalg.cross(z, x), z], 1)
        t = -(R @ numbers[:, :3, None])
        return torch.cat([torch.cat([R, t], 2).flatten(1), depth], 1)

    def sees(self, points: Tensor, device: Tensor) -> Tensor:
        rays = self._seen(self.constants[device], points)
        return rays[:, 2] > cos(VIEW_HALF_ANGLE_RAD) * rays.norm(dim=1)

    @classmethod
    def start(cls, values: Tensor, points: Tensor) -> Tensor:
        """By projection; by parallel rays where few rows, or points that are not those, put some behind the camera."""
        middle = points.mean(0)
        size = (points - middle).square().sum(1).mean().sqrt().clamp(min=SMALLEST_M)
        at = (points - middle) / size
        R, t = _by_projection(values, at)
        if float((at @ R[2]).min() + t[2]) <= 0:
            R, t = _by_parallel_rays(values, at)
        t = t * size - R @ middle
        return torch.cat([transforms(R, t)[:3].flatten(), ((points @ R.mT + t)[:, 2]).mean()[None]])

    @property
    def metres(self) -> Tensor:
        return self.constants[:, 12]

    @property
    def poses(self) -> Tensor:
        """(D, 4, 4) transforms from the robot's base to the cameras, m."""
        rows = self.constants[:, :12].view(-1, 3, 4)
        return transforms(rows[..., :3], rows[..., 3])

    @staticmethod
    def _seen(constants: Tensor, points: Tensor) -> Tensor:
        """Points (..., 3) in the frame of cameras with constants (..., 13), m."""
        rows = constants[..., :12].unflatten(-1, (3, 4))
        return (rows[..., :3] @ points[..., None])[..., 0] + rows[..., 3]

    @classmethod
    def read(cls, constants: Tensor, body: Tensor) -> Tensor:
        """Image points times the mean depth, m."""
        ray = cls._seen(constants, body)
        return constants[12] * ray[:2] / ray[2]

    @staticmethod
    def changed(constants: Tensor, increments: Tensor) -> Tensor:
        """Shifted and turned in the camera's own frame."""
        return torch.cat([moved_pose(constants[:12], increments), constants[12:]])

    @classmethod
    def check_seen(cls, constants: Tensor, points: Tensor) -> None:
        behind = cls._seen(constants, points)[:, 2] < SMALLEST_DISTANCE_M
        refuse_first(behind, "is behind its camera", "check the camera's pose, and which camera each row names")

    def hypotheses(self, points: Tensor, device: Tensor) -> Iterator[Hypothesis]:
        """Also focal lengths, which stretch the image, and principal points, which shift it, both in focal lengths."""
        yield from super().hypotheses(points, device)
        image = self.observation(device).value(points)
        fix = "check the intrinsic parameters, and the size of the images"
        for name, effect in self._of_each(image[..., None], device):
            yield Hypothesis(f"the focal length of '{name}'", effect, ("%", 1e-2), fix, about=VALUE)
        for axis in range(2):
            shift = torch.zeros_like(image[..., None])
            shift[:, axis, 0] = self.metres[device]
            for name, effect in self._of_each(shift, device):
                words = f"the principal point of '{name}' along {'uv'[axis]} (in focal lengths)"
                yield Hypothesis(words, effect, ("%", 1e-2), fix, about=VALUE)

    def where(self, number: int) -> str:
        pose = self.poses[number]
        return f"of the camera at {triple(-1e3 * pose[:3, :3].mT @ pose[:3, 3])} mm"

    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        pose = self.poses[number]
        place = triple(-1e3 * pose[:3, :3].mT @ pose[:3, 3])
        shift, turn = 1e3 * float(deviations[:3].norm()), 1e3 * float(deviations[3:].norm())
        what = f"camera '{self.names[number]}': {place} +- {shift:.3f} mm in {frame}"
        return f"{what}, looks along {triple(pose[2, :3])} +- {turn:.2f} mrad"


def _by_projection(values: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Turn (3, 3) and shift (3,) of a camera by images (N, 2) of points (N, 3): the nearest rigid transform."""
    P = projection(values, at)
    P = P * (1.0 if float((at @ P[2, :3] + P[2, 3]).mean()) >= 0 else -1.0)  # in front of the camera
    length = torch.linalg.svdvals(P[:, :3]).mean().clamp(min=SMALLEST_M)
    return nearest_rotations(P[:, :3]), P[:, 3] / length


def _by_parallel_rays(values: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """Start by a camera far away (scaled orthography), whose images are linear in points around zero.

    Source: D. DeMenthon, L. Davis, "Model-based object pose in 25 lines of code", IJCV 15, 1995, section 2.
    """
    middle = values.mean(0)
    rows = torch.linalg.lstsq(at, values - middle, driver="gelsd").solution.mT  # (2, 3)
    scale = torch.linalg.svdvals(rows).mean().clamp(min=SMALLEST_M)
    R = nearest_rotations(torch.cat([rows / scale, torch.linalg.cross(rows[0], rows[1])[None] / scale**2]))
    return R, torch.cat([middle, torch.ones_like(middle[:1])]) / scale
