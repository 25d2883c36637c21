"""Distances |z - f| + o of a ball at z from fixed points f: a ball bar, a wire, an interferometer, whose zero o is
absolute or unknown.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.common.errors import MeasurementError, few, sentence, warn_user
from diffeo_calib.measurements.bodies import triple
from diffeo_calib.sensors.devices import SMALLEST_DISTANCE_M, Devices, Hypothesis, least_squares, refuse_first

FIXED_DEVIATION_M = 1e-9  # prior standard deviation of an offset that is known to be zero
UNKNOWN_ZERO_M = 1.0
ZERO_WARNED, ZERO_REFUSED = 1.35, 5.0
"""Factors by which a free zero lowers the noise that the geometric calibration leaves, from which the zero is warned
about, and the readings refused. Simulated arms: 0.9 to 1.33 with the right zero, 1.1 to 24 with one that is 3 mm off,
2.9 to 5.2 with 10 mm; of a real UR10 or Franka 0.6 to 1.1, 0.6 to 1.1, and 0.8 to 1.5."""


@dataclass(frozen=True, eq=False)
class FixedPoints(Devices):
    """Fixed ends of bars, wires or beams: constants are a point [m] and the offset of the zero [m]."""

    kind = "distance"
    stated_as = "X,Y,Z"
    increments_each = 4
    size_fix = "measure longer and more different distances, or with a known zero"

    @classmethod
    def prior(cls, offset_std: float = 0.0) -> list[float]:
        return [*super().prior()[:3], offset_std or FIXED_DEVIATION_M]

    @classmethod
    def columns(cls) -> dict[str, tuple[str, ...]]:
        """Columns of absolute lengths, and of those with an unknown zero."""
        zero = "displacement", "wire", "draw_wire", "wire_length", "string_pot", "ballbar", "dbb", "interferometer"
        return {"distance": ("distance", "dist", "range", "bar"), "displacement": zero}

    @classmethod
    def stated(cls, numbers: Tensor) -> Tensor:
        return torch.cat([numbers, torch.zeros_like(numbers[:, :1])], 1)

    @classmethod
    def start(cls, values: Tensor, points: Tensor) -> Tensor:
        """|z|^2 - 2 z.f + |f|^2 = l^2 is linear in f and |f|^2."""
        ones = torch.ones_like(values)
        solution = least_squares(torch.cat([-2 * points, ones], 1), (values**2)[:, 0] - points.square().sum(1))
        return torch.cat([solution[:3], solution.new_zeros(1)])

    @staticmethod
    def read(constants: Tensor, body: Tensor) -> Tensor:
        return (body - constants[:3]).norm()[None] + constants[3:]

    @classmethod
    def check_seen(cls, constants: Tensor, points: Tensor) -> None:
        near = (points - constants[:, :3]).norm(dim=1) < SMALLEST_DISTANCE_M
        fix = "move the fixed point, or leave the row out"
        refuse_first(near, "is at its fixed point, where a distance has no direction", fix)

    def where(self, number: int) -> str:
        return f"from {triple(1e3 * self.constants[number, :3])} mm"

    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        sizes, std = 1e3 * self.constants[number], 1e3 * deviations
        zero = f", its zero at {sizes[3]:.3f} +- {std[3]:.3f} mm" * bool(self.deviations[number, 3] > FIXED_DEVIATION_M)
        place = f"{triple(sizes[:3])} +- {triple(std[:3])} mm in {frame}"
        return f"fixed point '{self.names[number]}': {place}{zero}"

    def freed(self) -> FixedPoints | None:
        if float(self.deviations[:, 3].max()) > FIXED_DEVIATION_M:
            return None
        free = self.deviations.clone()
        free[:, 3] = UNKNOWN_ZERO_M
        return replace(self, deviations=free)

    def hypotheses(self, points: Tensor, device: Tensor) -> Iterator[Hypothesis]:
        effects = self.by_increments(points, device)
        yield Hypothesis("the zero of all devices", effects[..., 3:], ("mm", 1e-3))
        for name, effect in self._of_each(effects, device):
            yield Hypothesis(f"the zero of '{name}'", effect[..., 3:], ("mm", 1e-3))
            yield Hypothesis(f"the fixed end of '{name}'", effect[..., :3])

    def check_freed(self, noise: float, free_noise: float) -> None:
        """Lengths whose zero seems to be another one than the device's."""
        factor = noise / free_noise
        if factor < ZERO_WARNED:
            return
        offsets = zip(self.names, self.constants[:, 3].tolist(), strict=True)
        listed = few([f"{1e3 * offset:+.1f} mm at '{name}'" for name, offset in offsets])
        what = f"the distances seem to count from another zero: with a free one, {listed}, geometry explains them "
        what += f"{factor:.2g} times better"
        fix = "check the device's zero, the column and its unit, or give lengths from an unknown zero (`--reading "
        fix += "displacement=COLUMN`, in Python `offset_std=`)"
        if factor >= ZERO_REFUSED:
            raise MeasurementError.of(what, fix=fix)
        warn_user(sentence(what, fix=fix))
