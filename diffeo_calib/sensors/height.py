"""Heights above planes: a dial gauge, or the ball that touches a surface.

With the tip's poses (R_i, t_i) and the ball c, z_i = R_i c + t_i, the heights h above the plane of unit normal n give

    n.z - d = h:    n.t + tr(R^T n c^T) - d = h,    |n| = 1,

linear in (n, n c^T, d).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.common.errors import few
from diffeo_calib.measurements.readings import Readings
from diffeo_calib.sensors.devices import (
    Devices,
    across,
    least_squares,
    numbers_text,
    unit_least_squares,
)

LEAST_SHARE = 1e-4
"""Directions of the unknowns that data determine less than this, relative to the best one, are left at zero."""
UNIT_RATIO, CORRELATED = 10.0, 0.5
"""Factor between measured and found heights that is doubted, and their correlation that shows it."""
FLAT_SHARE = 0.2
"""Smallest singular value of the planes' normals, relative to the largest, from which directions differ."""
PARALLEL_SINE = 0.1
"""Of the angle between planes below which they are parallel."""


@dataclass(frozen=True, eq=False)
class Planes(Devices):
    """Planes: constants are the unit normal and the distance from the origin [m]."""

    kind = "height"
    stated_as = "NX,NY,NZ,D"
    increments_each = 3
    size_fix = "touch a gauge block of known height on the same planes too and give its height"

    @classmethod
    def columns(cls) -> dict[str, tuple[str, ...]]:
        return {"height": ("height", "gauge", "dial", "dial_gauge", "indicator")}

    @classmethod
    def stated(cls, numbers: Tensor) -> Tensor:
        """Normals of any length, and distances from the origin along them."""
        normals = numbers[:, :3] / numbers[:, :3].norm(dim=1, keepdim=True)
        return torch.cat([normals, numbers[:, 3:]], 1)

    @classmethod
    def start(cls, values: Tensor, points: Tensor) -> Tensor:
        """The unit normal n and the distance d of least squares of n.z - d - h."""
        values = values[:, 0]
        normal = unit_least_squares(points - points.mean(0), values - values.mean())
        return torch.cat([normal, (points @ normal - values).mean()[None]])

    @staticmethod
    def read(constants: Tensor, body: Tensor) -> Tensor:
        return (body @ constants[:3] - constants[3])[None]

    @staticmethod
    def changed(constants: Tensor, increments: Tensor) -> Tensor:
        """Turned about two directions across the normal, and shifted along it."""
        normal = constants[:3] + increments[:2] @ across(constants[:3])
        return torch.cat([normal / normal.norm(), constants[3:] + increments[2:]])

    def where(self, number: int) -> str:
        return f"above the plane of normal {numbers_text(self.constants[number, :3].tolist())}"

    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        *normal, distance = self.constants[number].tolist()
        turn, shift = 1e3 * float(deviations[:2].norm()), 1e3 * float(deviations[2])
        what = f"plane '{self.names[number]}' in {frame}: normal {numbers_text(normal)} +- {turn:.2f} mrad"
        return f"{what}, {1e3 * distance:.3f} +- {shift:.3f} mm from the origin"

    @classmethod
    def alone(cls, data: Readings, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        values, one = data.values[:, 0], torch.ones_like(data.values)
        others = torch.cat([R.flatten(1), -one], 1)  # their unknowns follow from the normal
        basis = torch.linalg.svd(others, full_matrices=False)
        Q = basis.U[:, LEAST_SHARE * basis.S[0] < basis.S]
        t_left, values_left = t - Q @ (Q.mT @ t), values - Q @ (Q.mT @ values)
        n = unit_least_squares(t_left, values_left)
        found = least_squares(others, values - t @ n)
        return found[:9].view(3, 3).mT @ n, torch.cat([n, found[9:]])

    @classmethod
    def doubts_unit(cls, data: Readings, errors: Tensor) -> bool:
        """By how much the ball's heights change per change of the measured ones, where they change together."""
        measured, predicted = data.values[:, 0], (data.values + errors)[:, 0]
        whose = torch.nn.functional.one_hot(data.device, len(data.names)).to(measured)
        mean = whose / whose.sum(0)
        measured, predicted = (values - whose @ (mean.mT @ values) for values in (measured, predicted))
        together, size = float(measured @ predicted), float(measured.norm() * predicted.norm())
        if together < CORRELATED * size or size == 0.0:
            return False
        return not 1 / UNIT_RATIO < together / float(measured.square().sum()) < UNIT_RATIO

    def open_sentences(self) -> Iterator[tuple[str, str]]:
        """Directions that no plane faces."""
        normals = self.constants[:, :3]
        every = len(normals), len(normals), 3
        across = torch.linalg.cross(normals[:, None].expand(every), normals[None].expand(every))
        alike = [
            f"'{self.names[a]}' and '{self.names[b]}'"
            for a, b in (across.norm(dim=2) < PARALLEL_SINE).triu(1).nonzero().tolist()
        ]
        spread = torch.linalg.svdvals(normals)
        if len(normals) < 3 or float(spread[-1]) < FLAT_SHARE * float(spread[0]):
            parallel = f" ({few(alike)} are parallel)" * bool(alike)
            what = f"no plane faces some directions{parallel}: errors of the ball along them are not measured"
            yield what, "add planes in other directions, best three at right angles"
