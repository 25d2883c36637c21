"""Devices that report distances, heights or image points of a ball: where they stand, and what they see.

A device has constants, which change by increments: shifts of a fixed point and of its zero [m], two turns of a normal
[rad] and a shift of its plane [m], or a shift [m] and a turn [rad] of a camera in its own frame.

What cameras see is converted to metres at their mean distance from the ball, so that errors of all kinds of readings
are errors of positions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.common.errors import MeasurementError, few
from diffeo_calib.maps.observation import CameraPoints, Distances, LinearFunctionals, Observation
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.robots.se3 import nearest_rotations, transforms, twist_transform

PLACE_DEVIATION_M, TURN_DEVIATION_RAD = 0.1, 0.1
"""Prior standard deviations of a device around the place where it was found: wide."""
FIXED_DEVIATION_M = 1e-9
"""Prior standard deviation of an offset that is known to be zero."""
SMALLEST_M = 1e-12
"""Of a column of a linear system, against division by zero."""
ROUNDS = 20
"""Steps of a refinement."""
TAIL = 3.0
"""Errors, in medians, from which rows lose their weight in a refinement."""
SMALLEST_MEDIAN_M = 1e-7
BISECTIONS = 100
FEWEST_PER_DEVICE = 8
"""Rows of each device: a plane, a fixed point or a camera takes three to six numbers of them."""


@dataclass(frozen=True, eq=False)
class Devices(ABC):
    """The devices of some readings, all of one kind.

    Args:
        names: D names. constants: (D, c). deviations: (k,) of the prior of the increments, m or rad.
    """

    names: tuple[str, ...]
    constants: Tensor
    deviations: Tensor

    @classmethod
    @abstractmethod
    def start(cls, values: Tensor, points: Tensor) -> Tensor:
        """Constants (c,) of one device in closed form, from readings (N, r) of known points (N, 3), m."""

    @classmethod
    @abstractmethod
    def prior(cls, data: Readings) -> list[float]:
        """Standard deviations of the k increments, m or rad."""

    @abstractmethod
    def observation(self, device: Tensor) -> Observation:
        """What rows of these devices (N,) observe, m."""

    @abstractmethod
    def moved(self, increments: Tensor) -> Devices:
        """The devices after increments (D, k)."""

    @abstractmethod
    def sentence(self, number: int, deviations: Tensor) -> str:
        """Where a device is in the robot's base, with standard deviations of its increments (k,)."""

    @classmethod
    def of(cls, data: Readings, constants: Tensor) -> Devices:
        """Devices with wide priors around constants (D, c)."""
        return cls(data.names, constants, constants.new_tensor(cls.prior(data)))

    @property
    def freedom(self) -> int:
        """Increments of all devices."""
        return len(self.constants) * len(self.deviations)

    @property
    def metres(self) -> Tensor:
        """(D,) metres of displacement per unit of a reading."""
        return torch.ones_like(self.constants[:, 0])

    def values(self, data: Readings) -> Tensor:
        """Readings (N, r) of devices under their names here, m.

        Raises:
            MeasurementError: readings of another kind or of other devices.
        """
        return data.values * self.metres[self.numbers(data)][:, None]

    def numbers(self, data: Readings) -> Tensor:
        """(N,) numbers here of the devices of some readings; MeasurementError for others than these."""
        if KINDS[data.kind] is not type(self) or not set(data.names) <= set(self.names):
            kind = next(name for name, its in KINDS.items() if its is type(self))
            expected, got = f"{kind}s of {few(self.names)}", f"{data.kind}s of {few(data.names)}"
            raise MeasurementError.of("`data`", expected=expected, got=got, fix="pass rows of the same devices")
        own = [self.names.index(name) for name in data.names]
        return torch.tensor(own, dtype=torch.int64, device=data.device.device)[data.device]

    def errors(self, data: Readings, points: Tensor) -> Tensor:
        """Measured minus predicted readings (N, r), m, of the ball at points (N, 3), m."""
        return self.values(data) - self.observation(self.numbers(data)).value(points)

    def distances(self, data: Readings, model: Callable[[Tensor], Tensor]) -> Tensor:
        """Absolute errors (N, 1), m, of a model of the ball: (N, n) joint values -> (N, 1, 3) m."""
        return self.errors(data, model(data.q).detach()[:, 0]).norm(dim=1, keepdim=True)

    def in_unit(self, data: Readings, values: Tensor) -> Tensor:
        """Values (N, r) in m as readings in the unit in which these are shown."""
        return values / self.metres[self.numbers(data)][:, None] * data.unit[1]

    def shared(self, points: Tensor, device: Tensor) -> Tensor:
        """What is not known of the devices, as effects of unit variance that rows share: (N, r, D k)."""
        own = self.observation(device).by_constants(points) * self.deviations  # (N, r, k)
        whose = torch.nn.functional.one_hot(device, len(self.constants)).to(own)
        return (whose[:, None, :, None] * own[:, :, None]).flatten(2)

    def refined(self, data: Readings, points: Tensor) -> Devices:
        """The places that fit readings of known points (N, 3), m, best, by reweighted least squares."""
        devices = self
        for _ in range(ROUNDS):
            errors, slopes = devices.errors(data, points), devices.shared(points, devices.numbers(data))
            size = errors.norm(dim=1, keepdim=True)
            level = size.median().clamp(min=SMALLEST_MEDIAN_M)
            weight = (1 / (1 + (size / (TAIL * level)) ** 2).sqrt() / level)[..., None]
            eye = torch.eye(slopes.shape[2], dtype=slopes.dtype, device=slopes.device)
            matrix = torch.cat([(weight * slopes).flatten(0, 1), eye])
            target = torch.cat([(weight[..., 0] * errors).flatten(), eye[0] * 0.0])
            step = torch.linalg.lstsq(matrix, target[:, None]).solution
            devices = devices.moved(step.view(len(self.names), -1) * self.deviations)
        return devices


@dataclass(frozen=True, eq=False)
class FixedPoints(Devices):
    """Fixed ends of bars, wires or beams: constants are a point [m] and the offset of the zero [m]."""

    @classmethod
    def prior(cls, data: Readings) -> list[float]:
        """Of the point, and of the offset."""
        return [PLACE_DEVIATION_M] * 3 + [data.offset_std or FIXED_DEVIATION_M]

    @classmethod
    def start(cls, values: Tensor, points: Tensor) -> Tensor:
        """|z|^2 - 2 z.f + |f|^2 = l^2 is linear in f and |f|^2."""
        one = torch.ones_like(values)
        found = least_squares(torch.cat([-2 * points, one], 1), (values**2)[:, 0] - points.square().sum(1))
        return torch.cat([found[:3], found.new_zeros(1)])

    def observation(self, device: Tensor) -> Distances:
        """Distances."""
        own = self.constants[device]
        return Distances(own[:, :3], own[:, 3:])

    def moved(self, increments: Tensor) -> Devices:
        """Sums."""
        return replace(self, constants=self.constants + increments)

    def sentence(self, number: int, deviations: Tensor) -> str:
        """Place, and zero where it was unknown."""
        found, std = (1e3 * self.constants[number]).tolist(), (1e3 * deviations).tolist()
        zero = f", its zero at {found[3]:.3f} +- {std[3]:.3f} mm" * bool(self.deviations[3] > FIXED_DEVIATION_M)
        place = f"{_numbers(found[:3])} +- {_numbers(std[:3])} mm in the robot's base"
        return f"fixed point '{self.names[number]}': {place}{zero}"


@dataclass(frozen=True, eq=False)
class Planes(Devices):
    """Planes: constants are the unit normal and the distance from the origin [m]."""

    @classmethod
    def prior(cls, data: Readings) -> list[float]:
        """Of two turns and a shift."""
        return [TURN_DEVIATION_RAD] * 2 + [PLACE_DEVIATION_M]

    @classmethod
    def start(cls, values: Tensor, points: Tensor) -> Tensor:
        """The unit normal n and the distance d of least squares of n.z - d - h."""
        values = values[:, 0]
        normal = unit_least_squares(points - points.mean(0), values - values.mean())
        return torch.cat([normal, (points @ normal - values).mean()[None]])

    def observation(self, device: Tensor) -> LinearFunctionals:
        """Heights."""
        own = self.constants[device]
        return LinearFunctionals(own[:, None, :3], own[:, 3:])

    def moved(self, increments: Tensor) -> Devices:
        """Turned about two directions across the normal, those of :meth:`LinearFunctionals.by_constants`."""
        across = torch.linalg.svd(self.constants[:, None, :3], full_matrices=True).Vh[:, 1:]
        normals = self.constants[:, :3] + (across * increments[:, :2, None]).sum(1)
        normals = normals / normals.norm(dim=1, keepdim=True)
        return replace(self, constants=torch.cat([normals, self.constants[:, 3:] + increments[:, 2:]], 1))

    def sentence(self, number: int, deviations: Tensor) -> str:
        """Normal and distance."""
        *normal, distance = self.constants[number].tolist()
        turn, shift = 1e3 * float(deviations[:2].norm()), 1e3 * float(deviations[2])
        what = f"plane '{self.names[number]}' in the robot's base: normal {_numbers(normal)} +- {turn:.2f} mrad"
        return f"{what}, {1e3 * distance:.3f} +- {shift:.3f} mm from the origin"


@dataclass(frozen=True, eq=False)
class Cameras(Devices):
    """Cameras: constants are the rows of the transform to the camera's frame (12), and the ball's mean depth [m]."""

    @classmethod
    def prior(cls, data: Readings) -> list[float]:
        """Of a shift and a turn."""
        return [PLACE_DEVIATION_M] * 3 + [TURN_DEVIATION_RAD] * 3

    @classmethod
    def start(cls, values: Tensor, points: Tensor) -> Tensor:
        """Direct linear transformation: (P z) x (u, v, 1) = 0, linear in P; its nearest rigid transform.

        Source: R. Hartley, A. Zisserman, "Multiple view geometry in computer vision", 2003, section 7.1.
        """
        middle = points.mean(0)
        size = (points - middle).square().sum(1).mean().sqrt()
        one = torch.ones_like(points[:, :1])
        at = torch.cat([(points - middle) / size, one], 1)
        none = torch.zeros_like(at)
        above = torch.cat([at, none, -values[:, :1] * at], 1)
        matrix = torch.cat([above, torch.cat([none, at, -values[:, 1:] * at], 1)])
        P = torch.linalg.svd(matrix, full_matrices=True).Vh[-1].view(3, 4)
        P = P * (1.0 if float((at @ P[2]).mean()) >= 0 else -1.0)  # in front of the camera
        length = torch.linalg.svdvals(P[:, :3]).mean().clamp(min=SMALLEST_M)
        R = nearest_rotations(P[:, :3])
        t = P[:, 3] * size / length - R @ middle
        return torch.cat([transforms(R, t)[:3].flatten(), ((points @ R.mT + t)[:, 2]).mean()[None]])

    @property
    def metres(self) -> Tensor:
        """The mean depth of the ball."""
        return self.constants[:, 12]

    @property
    def poses(self) -> Tensor:
        """(D, 4, 4) transforms from the robot's base to the cameras, m."""
        rows = self.constants[:, :12].view(-1, 3, 4)
        return transforms(rows[..., :3], rows[..., 3])

    def observation(self, device: Tensor) -> CameraPoints:
        """Image points times the mean depth."""
        return CameraPoints(self.poses[device], self.metres[device][:, None])

    def moved(self, increments: Tensor) -> Devices:
        """Shifted and turned in the cameras' own frames."""
        moved = twist_transform(increments) @ self.poses
        return replace(self, constants=torch.cat([moved[:, :3].flatten(1), self.constants[:, 12:]], 1))

    def sentence(self, number: int, deviations: Tensor) -> str:
        """Place and direction of view."""
        pose = self.poses[number]
        place = (-1e3 * pose[:3, :3].mT @ pose[:3, 3]).tolist()
        shift, turn = 1e3 * float(deviations[:3].norm()), 1e3 * float(deviations[3:].norm())
        what = f"camera '{self.names[number]}': {_numbers(place)} +- {shift:.3f} mm in the robot's base"
        return f"{what}, looks along {_numbers(pose[2, :3].tolist())} +- {turn:.2f} mrad"


KINDS: dict[str, type[Devices]] = {"distance": FixedPoints, "height": Planes, "image": Cameras}


def devices_at(data: Readings, points: Tensor) -> Devices:
    """The devices of readings of a ball at known points (N, 3), m, in closed form."""
    kind = KINDS[data.kind]
    rows = [data.device == number for number in range(len(data.names))]
    return kind.of(data, torch.stack([kind.start(data.values[own], points[own]) for own in rows]))


def check_devices(data: Readings) -> None:
    """Refuse devices with too few rows to be placed."""
    counts = torch.bincount(data.device, minlength=len(data.names)).tolist()
    short = [f"'{name}' {n}" for name, n in zip(data.names, counts, strict=True) if n < FEWEST_PER_DEVICE]
    if short:
        fix, expected = (
            "measure more rows of them, or leave them out",
            f"at least {FEWEST_PER_DEVICE} rows of each device",
        )
        raise MeasurementError.of("`readings`", expected=expected, got=few(short), fix=fix)


def least_squares(matrix: Tensor, target: Tensor) -> Tensor:
    """Least squares with columns of equal size, small directions left at zero."""
    scale = matrix.square().mean(0).sqrt().clamp(min=SMALLEST_M)
    found = torch.linalg.lstsq(matrix / scale, target[:, None], rcond=1e-4, driver="gelsd").solution[:, 0]
    return found / scale


def unit_least_squares(matrix: Tensor, target: Tensor) -> Tensor:
    """The unit vector x (k,) of least |matrix x - target|; for a target of zeros the direction of least variance.

    (M^T M + mu) x = M^T target with the mu above minus the smallest eigenvalue that gives x its length, by bisection.
    """
    values, vectors = torch.linalg.eigh(matrix.mT @ matrix)
    along = vectors.mT @ (matrix.mT @ target)
    low, high = 0.0, float(along.norm()) + SMALLEST_M**2
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        longer = float((along / (values - values[0] + middle)).norm()) > 1.0
        low, high = (middle, high) if longer else (low, middle)
    x = along / (values - values[0] + high)
    rest = (1.0 - x.square().sum()).clamp(min=0.0).sqrt()  # where the target has no part along the first direction
    x[0] = x[0] + (rest if float(x[0]) >= 0 else -rest)
    return vectors @ (x / x.norm())


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:.3f}" for value in values)
