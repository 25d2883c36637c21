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
    """The map F of the module docstring on some coordinates of a space.

    Args:
        columns: the coordinates of x that it depends on, in increasing order.
        periodic: for each of these columns, whether it is a circle.
        lengthscale: scalar or one positive value per column; unit of the coordinate for a line,
            a pure number for a circle (concentration = lengthscale^-2).
    """

    columns: tuple[int, ...]
    periodic: tuple[bool, ...]
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
    def lines(self) -> list[int]:
        """Columns of x that are lines."""
        return [c for c, p in zip(self.columns, self.periodic, strict=True) if not p]

    @cached_property
    def circles(self) -> list[int]:
        """Columns of x that are circles."""
        return [c for c, p in zip(self.columns, self.periodic, strict=True) if p]

    @cached_property
    def _selections(self) -> tuple[slice | list[int], ...]:
        """Indices of lines and of circles in the columns of x, then in the length scales."""
        positions = [[k for k, p in enumerate(self.periodic) if p == wanted] for wanted in (False, True)]
        return tuple(_as_slice(s) for s in (self.lines, self.circles, *positions))

    def _lines(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The lines of x and their inverse scales."""
        lines, _, scaled, _ = self._selections
        return x[..., lines], self._inverse_scales(x)[scaled]

    def _circles(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The angles of x and their inverse scales."""
        _, circles, _, scaled = self._selections
        return x[..., circles], self._inverse_scales(x)[scaled]

    def _inverse_scales(self, x: Tensor) -> Tensor:
        if self.lengthscale.requires_grad:
            return (1.0 / self.lengthscale).to(x).expand(len(self.columns))
        return self._fixed_inverse_scales.to(x)

    @cached_property
    def _fixed_inverse_scales(self) -> Tensor:
        with torch.inference_mode(False):  # kept, and used in derivatives later
            return (1.0 / self.lengthscale).expand(len(self.columns))

    def lift(self, x: Tensor) -> Tensor:
        """F(x): (..., n) -> (..., D), ordered lines, cosines, sines."""
        parts = []
        if self.lines:
            value, scale = self._lines(x)
            parts.append(value * scale)
        if self.circles:
            angle, scale = self._circles(x)
            parts += [angle.cos() * scale, angle.sin() * scale]
        return parts[0] if len(parts) == 1 else torch.cat(parts, -1)

    def push(self, x: Tensor, dx: Tensor) -> Tensor:
        """DF(x) dx: (..., n), (..., n) -> (..., D)."""
        parts = []
        if self.lines:
            value, scale = self._lines(dx)
            parts.append(value * scale)
        if self.circles:
            (angle, scale), (turn, _) = self._circles(x), self._circles(dx)
            parts += [-angle.sin() * turn * scale, angle.cos() * turn * scale]
        return torch.cat(parts, -1)

    def pull(self, x: Tensor, g: Tensor) -> Tensor:
        """DF(x)^T g: (..., n), (..., D) -> (..., n)."""
        g_line, g_cos, g_sin = self._split(g)
        parts = []
        if self.lines:
            parts.append(g_line * self._lines(x)[1])
        if self.circles:
            angle, scale = self._circles(x)
            parts.append((angle.cos() * g_sin - angle.sin() * g_cos) * scale)
        return self._scatter(x, parts)

    def pull_derivative(self, x: Tensor, dx: Tensor, g: Tensor) -> Tensor:
        """(D^2F(x)[dx])^T g: the derivative of ``pull(x, g)`` along dx at fixed g; (..., n)."""
        g_line, g_cos, g_sin = self._split(g)
        parts = []
        if self.lines:
            parts.append(torch.zeros_like(g_line))
        if self.circles:
            (angle, scale), (turn, _) = self._circles(x), self._circles(dx)
            parts.append(-(angle.cos() * g_cos + angle.sin() * g_sin) * scale * turn)
        return self._scatter(x, parts)

    def _split(self, g: Tensor) -> Sequence[Tensor]:
        n_line, n_circle = len(self.lines), len(self.circles)
        return torch.split(g, [n_line, n_circle, n_circle], dim=-1)

    def _scatter(self, x: Tensor, parts: list[Tensor]) -> Tensor:
        """Values on lines and circles as a vector of all n coordinates, zero elsewhere."""
        values, columns = torch.cat(parts, -1), self.lines + self.circles
        if isinstance(where := _as_slice(columns), slice):  # without a copy of the indices to the device
            before, after = where.start, x.shape[-1] - where.stop
            return torch.nn.functional.pad(values, (before, after)) if before or after else values
        out = torch.zeros((*values.shape[:-1], x.shape[-1]), dtype=values.dtype, device=values.device)
        return out.index_copy(-1, torch.tensor(columns, dtype=torch.int64, device=out.device), values)


def _as_slice(columns: list[int]) -> slice | list[int]:
    """Consecutive columns as a slice, which indexes without a copy."""
    consecutive = columns == list(range(columns[0], columns[0] + len(columns))) if columns else False
    return slice(columns[0], columns[-1] + 1) if consecutive else columns
