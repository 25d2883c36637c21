"""Heights above planes, n.z - d of unit normal n and a ball at z: a dial gauge, or the ball that touches a surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.common.errors import few
from diffeo_calib.measurements.bodies import triple
from diffeo_calib.sensors.devices import Devices, across, least_squares

LEAST_NORMAL = 0.5  # length of a normal by least squares from which heights tell the points apart
FLAT_SHARE = 0.2
"""Smallest singular value of the planes' normals, relative to the largest, from which directions differ."""
PARALLEL_SINE = 0.1  # of the angle between planes below which they are parallel


@dataclass(frozen=True, eq=False)
class Planes(Devices):
    """Planes: constants are the unit normal and the distance from the origin [m]."""

    kind = "height"
    stated_as = "NX,NY,NZ,D"
    increments_each = 3
    size_fix = "touch a gauge block of known height on the same planes too and give its height"

    @classmethod
    def columns(cls) -> dict[str, tuple[str, ...]]:
        return {"height": ("height", "gauge", "dial", "dial_gauge", "indicator", "messuhr")}

    @classmethod
    def stated(cls, numbers: Tensor) -> Tensor:
        """Normals of any length, and distances from the origin along them."""
        normals = numbers[:, :3] / numbers[:, :3].norm(dim=1, keepdim=True)
        return torch.cat([normals, numbers[:, 3:]], 1)

    @classmethod
    def start(cls, values: Tensor, points: Tensor) -> Tensor:
        """n and d of least squares of n.z - d - h; of heights that hardly differ the direction of least variance."""
        values, away = values[:, 0], points - points.mean(0)
        normal, flat = least_squares(away, values - values.mean()), torch.linalg.svd(away).Vh[-1]
        if float(normal.norm()) < LEAST_NORMAL:
            normal = flat if float(flat @ normal) >= 0 else -flat
        normal = normal / normal.norm()
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
        return f"above the plane of normal {triple(self.constants[number, :3])}"

    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        normal, distance = self.constants[number, :3], float(self.constants[number, 3])
        turn, shift = 1e3 * float(deviations[:2].norm()), 1e3 * float(deviations[2])
        what = f"plane '{self.names[number]}' in {frame}: normal {triple(normal)} +- {turn:.2f} mrad"
        return f"{what}, {1e3 * distance:.3f} +- {shift:.3f} mm from the origin"

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
