"""Spaces of coordinates: products of lines and circles, and the feature map of kernels on them.

Every kernel of the package is radial in a feature map F (one or two features per coordinate):

    line    F(x) = x / l                     |F - F'|^2 = (x - x')^2 / l^2
    circle  F(x) = (cos x, sin x) / l        |F - F'|^2 = 2 (1 - cos(x - x')) / l^2

so the Gaussian exp(-|F - F'|^2 / 2) on a circle is the von Mises kernel exp(b (cos(x - x') - 1))
with concentration b = 1 / l^2. The wrapped geodesic distance is never used: kernels of it are not
positive definite.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    def _places(self) -> list[list[int]]:
        """Where lines and circles stand among the columns."""
        return [[k for k, p in enumerate(self.periodic) if p == wanted] for wanted in (False, True)]

    @cached_property
    def _selections(self) -> list[tuple[slice | list[int], slice | list[int]]]:
        """Indices of lines and of circles in the coordinates of x, and in the length scales."""
        return [(as_index([self.columns[k] for k in places]), as_index(places)) for places in self._places]

    def _parts(self, *points: Sequence[Tensor]) -> list[list[Tensor] | None]:
        """The lines of some points and the circles of others, with their inverse scales; None where there are none."""
        scales = (self._scales() if self.lengthscale.requires_grad else self._fixed_scales).to(points[1][0])
        return [
            [*(t[..., own] for t in some), scales[scaled]] if places else None
            for some, places, (own, scaled) in zip(points, self._places, self._selections, strict=True)
        ]

    def _scales(self) -> Tensor:
        return (1.0 / self.lengthscale).expand(len(self.columns))

    @cached_property
    def _fixed_scales(self) -> Tensor:
        with torch.inference_mode(False):  # kept, and used in derivatives later
            return self._scales()

    def lift(self, x: Tensor) -> Tensor:
        """F(x): (..., n) -> (..., D)."""
        lines, circles, found = *self._parts([x], [x]), []
        if lines is not None:
            found.append(lines[0] * lines[1])
        if circles is not None:
            angle, scale = circles
            found += [angle.cos() * scale, angle.sin() * scale]
        return _joined(found)

    def push(self, x: Tensor, dx: Tensor) -> Tensor:
        """DF(x) dx: (..., n), (..., n) -> (..., D)."""
        lines, circles, found = *self._parts([dx], [x, dx]), []
        if lines is not None:
            found.append(lines[0] * lines[1])
        if circles is not None:
            angle, turn, scale = circles
            found += [-angle.sin() * turn * scale, angle.cos() * turn * scale]
        return _joined(found)

    def pull(self, x: Tensor, g: Tensor) -> Tensor:
        """DF(x)^T g: (..., n), (..., D) -> (..., n)."""
        lines, circles, found = *self._parts([], [x]), []
        g_line, g_cos, g_sin = self._split(g)
        if lines is not None:
            found.append(g_line * lines[0])
        if circles is not None:
            angle, scale = circles
            found.append((angle.cos() * g_sin - angle.sin() * g_cos) * scale)
        return self._scatter(x, found)

    def pull_derivative(self, x: Tensor, dx: Tensor, g: Tensor) -> Tensor:
        """(D^2F(x)[dx])^T g: the derivative of ``pull(x, g)`` along dx at fixed g; (..., n)."""
        g_line, g_cos, g_sin = self._split(g)
        found = [torch.zeros_like(g_line)]
        _, circles = self._parts([], [x, dx])
        if circles is not None:
            angle, turn, scale = circles
            found.append(-(angle.cos() * g_cos + angle.sin() * g_sin) * scale * turn)
        return self._scatter(x, found)

    @cached_property
    def _ordered(self) -> list[int]:
        return [self.columns[k] for places in self._places for k in places]

    def _split(self, g: Tensor) -> Sequence[Tensor]:
        lines, circles = map(len, self._places)
        return torch.split(g, [lines, circles, circles], dim=-1)

    def _scatter(self, x: Tensor, parts: list[Tensor]) -> Tensor:
        """Values on lines and circles as a vector of all n coordinates, zero elsewhere."""
        values, columns = _joined(parts), self._ordered
        if isinstance(where := as_index(columns), slice):  # without a copy of the indices to the device
            before, after = where.start, x.shape[-1] - where.stop
            return torch.nn.functional.pad(values, (before, after)) if before or after else values
        out = torch.zeros((*values.shape[:-1], x.shape[-1]), dtype=values.dtype, device=values.device)
        return out.index_copy(-1, torch.tensor(columns, dtype=torch.int64, device=out.device), values)


def _joined(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts, -1)
