"""Spaces of coordinates: products of lines and circles, and the feature map of kernels on them.

Every kernel of the package is radial in a feature map F (one or two features per coordinate):

    line    F(x) = x / l                     |F - F'|^2 = (x - x')^2 / l^2
    circle  F(x) = (cos x, sin x) / l        |F - F'|^2 = 2 (1 - cos(x - x')) / l^2

so the Gaussian exp(-|F - F'|^2 / 2) on a circle is the von Mises kernel exp(b (cos(x - x') - 1))
with concentration b = 1 / l^2. The wrapped geodesic distance is never used: kernels of it are not
positive definite.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.runtime.arrays import as_index


@dataclass(frozen=True)
class Space:
    """A product of lines and circles, e.g. ``Space((False, True))``: one prismatic and one revolute joint.

    Args:
        periodic: for each coordinate, whether it is an angle in radians (a circle).
    """

    periodic: tuple[bool, ...]

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        return len(self.periodic)

    def __mul__(self, other: Space) -> Space:
        return Space(self.periodic + other.periodic)

    def squared_distances(self, x: Tensor, y: Tensor) -> Tensor:
        """|F_l - F'_l|^2 of every coordinate l by itself, at length scale 1: (M, n), (N, n) -> (n, M, N)."""
        apart = x.T[:, :, None] - y.T[:, None]
        circle = torch.tensor(self.periodic, dtype=torch.bool, device=x.device)[:, None, None]
        return torch.where(circle, 2.0 * (0.5 * apart).sin(), apart).square()


@dataclass(frozen=True)
class FeatureMap:
    """The map F of the module docstring on some coordinates of a space; D features: lines, cosines, sines."""

    columns: tuple[int, ...]  # the coordinates of x that it depends on, in increasing order
    periodic: tuple[bool, ...]  # for each of these columns, whether it is a circle
    # scalar or one positive value per column; unit of the coordinate for a line, a pure number for a circle
    # (concentration = lengthscale^-2)
    lengthscale: Tensor

    def __post_init__(self) -> None:
        if self.lengthscale.ndim > 1 or self.lengthscale.numel() not in (1, len(self.columns)):
            raise InputError.of(
                "the number of length scales (or concentrations) of a kernel",
                expected=f"1 or {len(self.columns)}",
                got=self.lengthscale.numel(),
                fix="pass one value, or one per coordinate that the kernel acts on",
            )

    @cached_property
    def _sides(self) -> list[tuple[slice | list[int], slice | list[int], int]]:
        """Indices of lines and of circles in the coordinates of x, and in the length scales, and their number."""
        sides = []
        for wanted in (False, True):
            places = [k for k, circle in enumerate(self.periodic) if circle == wanted]
            sides.append((as_index([self.columns[k] for k in places]), as_index(places), len(places)))
        return sides

    def _scales(self) -> Tensor:
        return (1.0 / self.lengthscale).expand(len(self.columns))

    @cached_property
    def _fixed_scales(self) -> Tensor:
        with torch.inference_mode(False):  # kept, and used in derivatives later
            return self._scales()

    def _derivatives(self, x: Tensor, order: int) -> Tensor:
        """The derivative of this order of every feature by its own coordinate: (..., n) -> (..., D)."""
        scales = (self._scales() if self.lengthscale.requires_grad else self._fixed_scales).to(x)
        (lines, of_lines, L), (circles, of_circles, C) = self._sides
        columns: list[Tensor] = []
        if L:
            at, scale = x[..., lines], scales[of_lines]
            columns.append(at * scale if order == 0 else (scale if order == 1 else 0.0 * scale).expand_as(at))
        if C:
            angle, scale = x[..., circles], scales[of_circles]
            cosine, sine = angle.cos() * scale, angle.sin() * scale
            columns += ([cosine, sine], [-sine, cosine], [-cosine, -sine])[order]
        return _joined(columns)

    def lift(self, x: Tensor) -> Tensor:
        """F(x): (..., n) -> (..., D)."""
        return self._derivatives(x, 0)

    def push(self, x: Tensor, dx: Tensor) -> Tensor:
        """DF(x) dx: (..., n), (..., n) -> (..., D)."""
        return self._derivatives(x, 1) * self._of_features(dx)

    def pull(self, x: Tensor, g: Tensor) -> Tensor:
        """DF(x)^T g: (..., n), (..., D) -> (..., n)."""
        return self._gathered(x, self._derivatives(x, 1) * g)

    def pull_derivative(self, x: Tensor, dx: Tensor, g: Tensor) -> Tensor:
        """(D^2F(x)[dx])^T g: the derivative of ``pull(x, g)`` along dx at fixed g; (..., n)."""
        return self._gathered(x, self._derivatives(x, 2) * self._of_features(dx) * g)

    def _of_features(self, dx: Tensor) -> Tensor:
        """The change of every feature's own coordinate: (..., n) -> (..., D)."""
        (lines, _, L), (circles, _, C) = self._sides
        turned = [dx[..., circles]] * 2 if C else []
        return _joined([dx[..., lines], *turned] if L else turned)

    def _gathered(self, x: Tensor, values: Tensor) -> Tensor:
        """Sums of the features of every coordinate, as a vector of all n coordinates, zero elsewhere."""
        L, C = self._sides[0][2], self._sides[1][2]
        if C:
            lines, cosines, sines = values.split([L, C, C], dim=-1)
            values = torch.cat([lines, cosines + sines], -1) if L else cosines + sines
        if isinstance(where := self._ordered, slice):  # without a copy of the indices to the device
            before, after = where.start, x.shape[-1] - where.stop
            return torch.nn.functional.pad(values, (before, after)) if before or after else values
        out = torch.zeros((*values.shape[:-1], x.shape[-1]), dtype=values.dtype, device=values.device)
        return out.index_copy(-1, torch.tensor(where, dtype=torch.int64, device=out.device), values)

    @cached_property
    def _ordered(self) -> slice | list[int]:
        """Coordinates of lines, then of circles, as an index."""
        return as_index(sorted(self.columns, key=lambda c: self.periodic[self.columns.index(c)]))


def _joined(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts, -1)
