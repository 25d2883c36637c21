"""Observations of a point by devices that measure no position: a distance, a height above a plane, an image.

Row i reports r numbers h_i(z), z = k1(x_i) in R^m, with slopes A_i = Dh_i(z) (r x m). To first order the row is a
measurement of the linear functional A_i k1(x_i): with it the covariance G of k1 becomes A G A^T, and the end condition
(12) becomes P_i(1) = A_i^T R_i^-1 (y_i - h_i(k1(x_i))). Slopes are renewed in every iteration of a solver.

Constants of a device that are not known exactly, such as the fixed end of a ball bar, are errors that all its rows
share: with :meth:`Observation.by_constants` = D and their prior covariance P, R = blockdiag(R_i) + (D P D^T).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.errors import InputError
from diffeo_calib.maps.noise import Noise

O = TypeVar("O", bound="Observation")  # noqa: E741
SMALLEST_DISTANCE_M = 1e-6
"""Nearer to its fixed end the direction of a distance, and nearer to its lens the image of a camera, is undefined."""
UNSEEN_SHARE = 1e-6  # information about coordinates that no row sees, relative to the mean of all coordinates


class Observation(ABC):
    """r numbers that a device reports of every point of N configurations; a subclass names its constants' tensors."""

    constants: tuple[str, ...]
    """Names of attributes, each a tensor with one row per configuration."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Numbers per row, r."""

    @abstractmethod
    def value(self, points: Tensor) -> Tensor:
        """h: points (N, m) -> (N, r), differentiable by autograd."""

    @abstractmethod
    def slope(self, points: Tensor) -> Tensor:
        """A = Dh: points (N, m) -> (N, r, m)."""

    @abstractmethod
    def by_constants(self, points: Tensor) -> Tensor:
        """Derivatives of h by the device's constants: points (N, m) -> (N, r, c)."""

    @property
    def dim(self) -> int:
        """Coordinates m of the points that it sees."""
        return getattr(self, self.constants[0]).shape[-1]

    def __len__(self) -> int:
        return len(getattr(self, self.constants[0]))

    def rows(self: O, index: Tensor) -> O:
        """The observation of some configurations."""
        return self._with({name: getattr(self, name)[index] for name in self.constants})

    def to(self: O, device: torch.device | str) -> O:
        """The same observation on a device."""
        return self._with({name: getattr(self, name).to(device) for name in self.constants})

    def _with(self: O, tensors: dict[str, Tensor]) -> O:
        other = copy(self)
        vars(other).update(tensors)
        return other


class Distances(Observation):
    """h(z) = |z - c| + o: a ball bar, a wire or an interferometer from a fixed point c, with the offset o of its zero.

    Args:
        fixed: (N, m) the fixed point of every row, m.
        offsets: (N, 1) o, m; zero by default.

    Constants of :meth:`by_constants`: the m coordinates of c, then o.
    """

    constants = ("fixed", "offsets")
    size = 1

    def __init__(self, fixed: object, offsets: object = None) -> None:
        self.fixed = as_tensor(fixed, "fixed", ("N", "m"), fix="pass the fixed point of every row, in m").detach()
        none = self.fixed.new_zeros(len(self.fixed), 1)
        given = none if offsets is None else as_tensor(offsets, "offsets", (len(self.fixed), 1))
        self.offsets = given.detach()

    def value(self, points: Tensor) -> Tensor:
        return (points - self.fixed).norm(dim=1, keepdim=True) + self.offsets

    def slope(self, points: Tensor) -> Tensor:
        """Unit vectors from the fixed point: (N, 1, m)."""
        away = points - self.fixed
        length = away.norm(dim=1, keepdim=True)
        near = (length[:, 0] < SMALLEST_DISTANCE_M).nonzero()[:, 0]
        if len(near):
            fix = "move the fixed point, or leave the row out"
            raise InputError.of(f"row {int(near[0])} is at its fixed point, where a distance has no direction", fix=fix)
        return (away / length)[:, None]

    def by_constants(self, points: Tensor) -> Tensor:
        """(N, 1, m + 1)."""
        slope = self.slope(points)
        return torch.cat([-slope, torch.ones_like(slope[..., :1])], 2)


class LinearFunctionals(Observation):
    """h(z) = A z - b: heights above planes, readings of dial gauges, single coordinates.

    Args:
        axes: (N, r, m) rows A_i, such as unit normals. offsets: (N, r) b_i, m; 0 by default.

    Constants of :meth:`by_constants`: for r = 1 the m - 1 turns of the axis by radians, then b; else only the r of b.
    """

    constants = ("axes", "offsets")

    def __init__(self, axes: object, offsets: object = None) -> None:
        self.axes = as_tensor(axes, "axes", ("N", "r", "m"), fix="pass r axes for every row").detach()
        shape = self.axes.shape[:2]
        offsets = self.axes.new_zeros(shape) if offsets is None else offsets
        self.offsets = as_tensor(offsets, "offsets", tuple(shape), fix="pass one offset per axis, in m").detach()

    @property
    def size(self) -> int:
        return self.axes.shape[1]

    def value(self, points: Tensor) -> Tensor:
        return (self.axes @ points[:, :, None])[:, :, 0] - self.offsets

    def slope(self, points: Tensor) -> Tensor:
        return self.axes

    def by_constants(self, points: Tensor) -> Tensor:
        """(N, 1, m), or (N, r, r)."""
        N, r, _ = self.axes.shape
        own = -torch.eye(r, dtype=points.dtype, device=points.device).expand(N, r, r)
        if r > 1:
            return own
        across = torch.linalg.svd(self.axes, full_matrices=True).Vh[:, 1:]  # (N, m - 1, m), orthogonal to the axis
        return torch.cat([(across @ points[:, :, None]).mT, own], 2)


class CameraPoints(Observation):
    """h(z) = f (X / Z, Y / Z) with (X, Y, Z) = R z + t: a point in the image of a calibrated camera.

    Args:
        poses: (N, 4, 4) transforms from the measuring frame to the camera's, which looks along its z axis, m.
        focal: (N, 1) f, in the unit of the image; 1 by default, for tangents of two angles.

    Constants of :meth:`by_constants`: a shift (3, m) and a turn (3, rad) of the camera, in its own frame.
    """

    constants = ("poses", "focal")
    dim, size = 3, 2

    def __init__(self, poses: object, focal: object = None) -> None:
        self.poses = as_tensor(poses, "poses", ("N", 4, 4), fix="pass one rigid transform per row").detach()
        one = self.poses.new_ones(len(self.poses), 1)
        self.focal = one if focal is None else as_tensor(focal, "focal", (len(one), 1)).detach()

    def _seen(self, points: Tensor) -> Tensor:
        """Points in the camera's frame (N, 3), m."""
        return (self.poses[:, :3, :3] @ points[:, :, None])[:, :, 0] + self.poses[:, :3, 3]

    def _in_front(self, points: Tensor) -> Tensor:
        """Points in the camera's frame (N, 3), m; InputError if one of them is behind its camera."""
        seen = self._seen(points)
        behind = (seen[:, 2] < SMALLEST_DISTANCE_M).nonzero()[:, 0]
        if len(behind):
            fix = "check the camera's pose: it is the transform from the measuring frame to the camera"
            raise InputError.of(f"row {int(behind[0])} is behind its camera", fix=fix)
        return seen

    def value(self, points: Tensor) -> Tensor:
        seen = self._in_front(points)
        return self.focal * seen[:, :2] / seen[:, 2:]

    def slope(self, points: Tensor) -> Tensor:
        """(N, 2, 3), in the unit of the image per m."""
        return self._projection(points) @ self.poses[:, :3, :3]

    def by_constants(self, points: Tensor) -> Tensor:
        """(N, 2, 6)."""
        seen = self._seen(points)
        eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(len(points), 3, 3)
        turned = torch.linalg.cross(eye, seen[:, None].expand(-1, 3, 3)).mT  # columns e_k x seen
        return self._projection(points) @ torch.cat([eye, turned], 2)

    def _projection(self, points: Tensor) -> Tensor:
        """Derivatives (N, 2, 3) of the image by the point in the camera's frame."""
        X, Y, Z = self._in_front(points).unbind(1)
        zero = torch.zeros_like(X)
        rows = [torch.stack([1 / Z, zero, -X / Z**2], 1), torch.stack([zero, 1 / Z, -Y / Z**2], 1)]
        return self.focal[:, None] * torch.stack(rows, 1)


@dataclass(frozen=True)
class Part:
    """The rows of one kind in a :class:`Stacked` observation.

    Args:
        rows: (M,) numbers of the rows. points: (k,) numbers of the coordinates that they see, of the m of a row.
        numbers: (r,) where the r numbers stand among the R of a row.
        observe: of these coordinates in these rows, M of them.
    """

    rows: Tensor
    points: Tensor
    numbers: Tensor
    observe: Observation

    @classmethod
    def of_coordinates(cls, rows: Tensor, count: int) -> Part:
        """Rows (M,) that report the first coordinates as their first numbers."""
        first = torch.arange(count, device=rows.device)
        eye = torch.eye(count, dtype=torch.float64, device=rows.device)
        return cls(rows, first, first, LinearFunctionals(eye.expand(len(rows), count, count)))

    def seen(self, points: Tensor) -> Tensor:
        """The coordinates (M, k) that it sees of points (N, m)."""
        return points[self.rows[:, None], self.points]

    def of_rows(self, index: Tensor, count: int) -> Part | None:
        """The part of some of ``count`` rows, (K,); None if it has none of them."""
        place = torch.full((count,), -1, dtype=torch.int64, device=index.device)
        place[self.rows] = torch.arange(len(self.rows), device=index.device)
        own = place[index]
        kept = (own >= 0).nonzero()[:, 0]
        return replace(self, rows=kept, observe=self.observe.rows(own[kept])) if len(kept) else None

    def to(self, device: torch.device | str) -> Part:
        """The same part on a device."""
        rows, points, numbers = (part.to(device) for part in (self.rows, self.points, self.numbers))
        return Part(rows, points, numbers, self.observe.to(device))


class Stacked(Observation):
    """Rows that report different things of several points: a table of R numbers a row, some of which are absent.

    Absent numbers are zero whatever the points are; their noise must be :data:`HIDDEN_VARIANCE`.

    Args:
        count: N rows. size: R. dim: m coordinates of the points of a row.
        parts: what is reported.
    """

    constants = ()

    def __init__(self, count: int, size: int, dim: int, parts: Sequence[Part]) -> None:
        self.count, self._size, self._dim, self.parts = count, size, dim, tuple(parts)

    @property
    def size(self) -> int:
        return self._size

    @property
    def dim(self) -> int:
        return self._dim

    def __len__(self) -> int:
        return self.count

    def rows(self, index: Tensor) -> Stacked:
        parts = [part.of_rows(index, self.count) for part in self.parts]
        return Stacked(len(index), self.size, self.dim, [part for part in parts if part is not None])

    def to(self, device: torch.device | str) -> Stacked:
        return Stacked(self.count, self.size, self.dim, [part.to(device) for part in self.parts])

    def value(self, points: Tensor) -> Tensor:
        found = points.new_zeros(len(points), self.size)
        for part in self.parts:
            found[part.rows[:, None], part.numbers] = part.observe.value(part.seen(points))
        return found

    def slope(self, points: Tensor) -> Tensor:
        found = points.new_zeros(len(points), self.size, self.dim)
        for part in self.parts:
            rows = part.rows[:, None, None]
            found[rows, part.numbers[:, None], part.points] = part.observe.slope(part.seen(points))
        return found

    def by_constants(self, points: Tensor) -> Tensor:
        columns = []
        for part in self.parts:
            own = part.observe.by_constants(part.seen(points))
            column = points.new_zeros(len(points), self.size, own.shape[2])
            column[part.rows[:, None], part.numbers] = own
            columns.append(column)
        return torch.cat(columns, 2)


def observed_dim(observe: object, y: Tensor, markers: int) -> int:
    """Coordinates m of the points of an observation; InputError unless y are its numbers (N, r)."""
    if not isinstance(observe, Observation):
        expected, fix = "an Observation", "pass Distances(...), LinearFunctionals(...) or CameraPoints(...)"
        raise InputError.of("`observe`", expected=expected, got=type(observe).__name__, fix=fix)
    if observe.dim % markers:
        raise InputError.of("`markers` with `observe`", expected=f"a divisor of {observe.dim}", got=markers)
    if y.shape != (len(observe), observe.size):
        fix = "pass what was observed in each row"
        raise InputError.of("`y`", expected=f"({len(observe)}, {observe.size})", got=tuple(y.shape), fix=fix)
    return observe.dim


def coordinate_noise(noise: Noise, slopes: Tensor) -> Tensor:
    """Noise (m, m), m^2, of coordinates that would tell as much as a mean row: slopes (N, r, m) -> (A^T R^-1 A)^-1."""
    white = noise.whiten(slopes)
    information = (white.mT @ white).mean(0)
    eye = torch.eye(len(information), dtype=slopes.dtype, device=slopes.device)
    return torch.linalg.inv(information + UNSEEN_SHARE * information.diagonal().mean() * eye)
