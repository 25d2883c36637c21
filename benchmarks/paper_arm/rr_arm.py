"""The RR arm with geometric errors, gravity sag, and frozen joints on which deformations may act."""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.maps.nominal import NominalMap
from diffeo_calib.robots.elastic_rr import NOMINAL_LENGTHS

JOINTS, LENGTHS, BASE = (0, 1), (2, 3), (4, 5)
"""Columns of an extended configuration: joint angles [rad], errors of the lengths, shift of the base [length units]."""
COORDINATES = 6
LOADED, LOADS = 4, 4
"""Gravity may move the first four coordinates, in proportion to each of four features."""


class ExtendedArm(NominalMap):
    """k0 of the RR arm at extended configurations (N, 6).

    A measured configuration is extended by zeros, the values of frozen joints. phi may act on all six coordinates; on
    the two of the base it is an error field in task space that depends on the configuration.

    theta is added to the coordinates. Its first six entries are constants, the geometric errors. The remaining entries
    are coefficients of gravity, as for robots (robots/gravity.py): joint angles and lengths sag in proportion to the
    directions of the two links, to which all torques of unknown weights are proportional.

    Args:
        geometry: whether theta has the geometric errors.
        gravity: whether theta has coefficients of gravity.
    """

    def __init__(self, *, geometry: bool, gravity: bool = False) -> None:
        self.gravity = gravity
        self.parameters = COORDINATES * geometry + LOADED * LOADS * gravity

    def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
        """Tip (N, 2)."""
        x1, x2, d1, d2, u, v = self._at(x, theta).unbind(-1)
        l1, l2 = NOMINAL_LENGTHS[0] + d1, NOMINAL_LENGTHS[1] + d2
        return torch.stack([u + l1 * x1.cos() + l2 * (x1 + x2).cos(), v + l1 * x1.sin() + l2 * (x1 + x2).sin()], -1)

    def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
        """Derivatives by the six coordinates: (N, 2, 6)."""
        own = self._own_jacobian(self._at(x, theta))
        if not self.gravity:
            return own
        first, second = _directions(x)
        zero = torch.zeros_like(first)
        by_x1 = torch.cat([_quarter(first), _quarter(second)], -1)
        by_x2 = torch.cat([zero, _quarter(second)], -1)
        slopes = torch.stack([by_x1, by_x2], -1)  # (N, 4 features, 2)
        moved = self._coefficients(theta) @ slopes  # (N, 4 coordinates, 2)
        return torch.cat([own[..., :2] + own[..., :LOADED] @ moved, own[..., 2:]], -1)

    def sensitivities(self, x: Tensor, theta: Tensor) -> Tensor:
        """Derivatives by theta: (N, 2, K)."""
        if not self.parameters:
            return x.new_zeros(len(x), 2, 0)
        own = self._own_jacobian(self._at(x, theta))
        if not self.gravity:
            return own
        loads = torch.cat(_directions(x), -1)
        by_load = own[:, :, :LOADED, None] * loads[:, None, None, :]
        return torch.cat([own, by_load.flatten(2)], -1)

    def _at(self, x: Tensor, theta: Tensor) -> Tensor:
        if not self.parameters:
            return x
        moved = x + theta[:COORDINATES]
        if not self.gravity:
            return moved
        sag = torch.cat(_directions(x), -1) @ self._coefficients(theta).mT
        return moved + torch.nn.functional.pad(sag, (0, COORDINATES - LOADED))

    def _coefficients(self, theta: Tensor) -> Tensor:
        return theta[COORDINATES:].view(LOADED, LOADS)

    def _own_jacobian(self, at: Tensor) -> Tensor:
        _, _, d1, d2, _, _ = at.unbind(-1)
        first, second = _directions(at)
        by_x2 = (NOMINAL_LENGTHS[1] + d2)[:, None] * _quarter(second)
        by_x1 = (NOMINAL_LENGTHS[0] + d1)[:, None] * _quarter(first) + by_x2
        base = torch.eye(2, dtype=at.dtype).expand(len(at), 2, 2)
        return torch.cat([torch.stack([by_x1, by_x2, first, second], -1), base], -1)


def extended(x: Tensor) -> Tensor:
    """Joint angles (N, 2) as extended configurations (N, 6)."""
    return torch.nn.functional.pad(x, (0, COORDINATES - len(JOINTS)))


def _directions(x: Tensor) -> tuple[Tensor, Tensor]:
    """Directions of the two links: (N, 2) each."""
    t1, t2 = x[..., 0], x[..., 0] + x[..., 1]
    return torch.stack([t1.cos(), t1.sin()], -1), torch.stack([t2.cos(), t2.sin()], -1)


def _quarter(v: Tensor) -> Tensor:
    """Turned by a quarter turn: (N, 2)."""
    return torch.stack([-v[..., 1], v[..., 0]], -1)
