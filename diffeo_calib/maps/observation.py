"""Observations of a point by devices that measure no position: a distance, a height above a plane, an image.

Row i reports r numbers h_i(z), z = k1(x_i) in R^m, with slopes A_i = Dh_i(z) (r x m). To first order the row is a
measurement of the linear functional A_i k1(x_i): with it the covariance G of k1 becomes A G A^T, and the end condition
(12) becomes P_i(1) = A_i^T R_i^-1 (y_i - h_i(k1(x_i))). Slopes are renewed in every iteration of a solver.

Constants of a device that are not known exactly, such as the fixed end of a ball bar, are errors that all its rows
share: with the derivatives D by them and their prior covariance P, R = blockdiag(R_i) + (D P D^T).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.errors import InputError
from diffeo_calib.maps.noise import Noise

O = TypeVar("O", bound="Observation")  # noqa: E741
Read = Callable[[Tensor, Tensor], Tensor]
Check = Callable[[Tensor, Tensor], None]
UNSEEN_SHARE = 1e-6  # information about coordinates that no row sees, relative to the mean of all coordinates


class Observation(ABC):
    """r numbers that a device reports of every point of N configurations; a subclass names its constants' tensors."""

    constants: tuple[str, ...]
    """Names of attributes, each a tensor with one row per configuration."""
    size: int
    """Numbers per row, r."""
    dim: int
    """Coordinates m of the points that it sees."""

    @abstractmethod
    def value(self, points: Tensor) -> Tensor:
        """h: points (N, m) -> (N, r), differentiable by autograd."""

    @abstractmethod
    def slope(self, points: Tensor) -> Tensor:
        """A = Dh: points (N, m) -> (N, r, m)."""

    def places(self, points: Tensor) -> Tensor:
        """Points (N, m), those that a place holds there."""
        return points

    def __len__(self) -> int:
        return len(getattr(self, self.constants[0]))

    def rows(self: O, index: Tensor) -> O:
        """The observation of some configurations."""
        return self._with({name: getattr(self, name)[index] for name in self.constants})

    def to(self: O, device: torch.device | str) -> O:
        """Return the observation on a device."""
        return self._with({name: getattr(self, name).to(device) for name in self.constants})

    def _with(self: O, tensors: dict[str, Tensor]) -> O:
        other = copy(self)
        vars(other).update(tensors)
        return other


class ReadPoints(Observation):
    """What a function reads of the point of every row, with derivatives by torch.

    Args:
        read: constants (c,) of a row and its point (m,) -> (r,), differentiable by torch.func.
        own: (N, c) the constants of every row. dim: m. size: r.
        check: of the constants (N, c) and points (N, m), raises InputError where readings are not defined.
    """

    constants = ("own",)

    def __init__(
        self, read: Read, own: Tensor, dim: int, size: int = 1, check: Check = lambda own, points: None
    ) -> None:
        self.read, self.own, self.dim, self.size, self.check = read, own, dim, size, check

    def value(self, points: Tensor) -> Tensor:
        self.check(self.own, points)
        return vmap(self.read)(self.own, points)

    def slope(self, points: Tensor) -> Tensor:
        self.check(self.own, points)
        return vmap(jacrev(self.read, argnums=1))(self.own, points)


class LinearFunctionals(Observation):
    """h(z) = A z - b, such as single coordinates.

    Args:
        axes: (N, r, m) rows A_i, such as unit normals. offsets: (N, r) b_i, m; 0 by default.
    """

    constants = ("axes", "offsets")

    def __init__(self, axes: object, offsets: object = None) -> None:
        self.axes = as_tensor(axes, "axes", ("N", "r", "m"), fix="pass r axes for every row").detach()
        self.size, self.dim = self.axes.shape[1:]
        shape = self.axes.shape[:2]
        offsets = self.axes.new_zeros(shape) if offsets is None else offsets
        self.offsets = as_tensor(offsets, "offsets", tuple(shape), fix="pass one offset per axis, in m").detach()

    def value(self, points: Tensor) -> Tensor:
        return (self.axes @ points[:, :, None])[:, :, 0] - self.offsets

    def slope(self, points: Tensor) -> Tensor:
        return self.axes


def single_coordinates(slopes: Tensor) -> bool:
    """Whether all numbers with these slopes (N, r, m) are single coordinates of points, or hidden."""
    return bool(((slopes == 0.0) | (slopes == 1.0)).all())


class FromPlaces(LinearFunctionals):
    """Points minus the places (N, m) that hold them, m."""

    def __init__(self, places: Tensor) -> None:
        m = self.size = self.dim = places.shape[1]
        eye = torch.eye(m, dtype=places.dtype, device=places.device)
        self.axes, self.offsets = eye.expand(len(places), m, m), places

    def places(self, points: Tensor) -> Tensor:
        return self.offsets


@dataclass(frozen=True)
class Part:
    """The rows of one kind in a :class:`Stacked` observation."""

    rows: Tensor  # (M,) numbers of the rows
    points: Tensor  # (k,) numbers of the coordinates that they see, of the m of a row
    numbers: Tensor  # (r,) where the r numbers stand among the R of a row
    observe: Observation  # of these coordinates in these rows, M of them

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
        numbers = place[index]
        kept = (numbers >= 0).nonzero()[:, 0]
        return replace(self, rows=kept, observe=self.observe.rows(numbers[kept])) if len(kept) else None

    def to(self, device: torch.device | str) -> Part:
        """Return the part on a device."""
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
        self.count, self.size, self.dim, self.parts = count, size, dim, tuple(parts)

    def __len__(self) -> int:
        return self.count

    def rows(self, index: Tensor) -> Stacked:
        parts = [part.of_rows(index, self.count) for part in self.parts]
        return Stacked(len(index), self.size, self.dim, [part for part in parts if part is not None])

    def to(self, device: torch.device | str) -> Stacked:
        return Stacked(self.count, self.size, self.dim, [part.to(device) for part in self.parts])

    def value(self, points: Tensor) -> Tensor:
        values = points.new_zeros(len(points), self.size)
        for part in self.parts:
            values[part.rows[:, None], part.numbers] = part.observe.value(part.seen(points))
        return values

    def places(self, points: Tensor) -> Tensor:
        found = points.clone()
        for part in self.parts:
            found[part.rows[:, None], part.points] = part.observe.places(part.seen(points))
        return found

    def slope(self, points: Tensor) -> Tensor:
        slopes = points.new_zeros(len(points), self.size, self.dim)
        for part in self.parts:
            rows = part.rows[:, None, None]
            slopes[rows, part.numbers[:, None], part.points] = part.observe.slope(part.seen(points))
        return slopes


def observed_dim(observe: object, y: Tensor, markers: int) -> int:
    """Coordinates m of the points of an observation; InputError unless y are its numbers (N, r)."""
    if not isinstance(observe, Observation):
        expected, fix = "an Observation", "pass LinearFunctionals(...), or ReadPoints(...) with a function"
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
