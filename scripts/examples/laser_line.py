"""A device of your own in one file: a laser beam, and how far the ball on the tool is from it.

    python scripts/examples/laser_line.py

Registered, it is fitted, evaluated and written like the package's own, beside measured positions or alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.bodies import triple
from diffeo_calib.robots.simulated_arm import SimulatedArm
from diffeo_calib.sensors.devices import Devices, across, least_squares
from diffeo_calib.sensors.kinds import register


@register
class Beams(Devices):
    """Laser beams: constants are a point [m] and the direction."""

    kind = "line distance"
    stated_as = "PX,PY,PZ,DX,DY,DZ"
    increments_each = 4
    size_fix = "measure distances, which hold lengths"

    @staticmethod
    def read(constants: Tensor, body: Tensor) -> Tensor:
        """|(z - p) x d|."""
        point, direction = constants.split(3)
        return torch.linalg.cross(body - point, direction, dim=0).norm()[None]

    @staticmethod
    def changed(constants: Tensor, increments: Tensor) -> Tensor:
        """Shifted and turned across the beam."""
        point, direction = constants.split(3)
        shift, turn = increments.view(2, 2) @ across(direction)
        return torch.cat([point + shift, torch.nn.functional.normalize(direction + turn, dim=0)])

    @classmethod
    def stated(cls, numbers: Tensor) -> Tensor:
        """Points and directions of any length."""
        return torch.cat([numbers[:, :3], torch.nn.functional.normalize(numbers[:, 3:], dim=1)], 1)

    @classmethod
    def start(cls, values: Tensor, bodies: Tensor) -> Tensor:
        """z^T A z - 2 b.z + c = h^2 is linear in A = I - d d^T, b = A p and c."""
        middle = bodies.mean(0)
        x, y, z = (bodies - middle).unbind(1)
        columns = x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, -2 * x, -2 * y, -2 * z, torch.ones_like(x)
        found = least_squares(torch.stack(columns, 1), values[:, 0] ** 2)
        A = found[[0, 3, 4, 3, 1, 5, 4, 5, 2]].view(3, 3)
        vectors = torch.linalg.eigh(A).eigenvectors
        return torch.cat([middle + vectors[:, 1:] @ (vectors[:, 1:].mT @ found[6:9]), vectors[:, 0]])

    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        """Point and direction."""
        place, shift, turn = 1e3 * self.constants[number, :3], 1e3 * deviations[:2].norm(), 1e3 * deviations[2:].norm()
        what = f"beam '{self.names[number]}' in {frame} through {triple(place)} +- {shift:.3f} mm"
        return f"{what} along {triple(self.constants[number, 3:])} +- {turn:.2f} mrad"


POINTS = torch.tensor([[0.3, 0.9, 0.2], [-0.9, 0.2, 0.5]], dtype=torch.float64)  # beams in the robot's base, m
DIRECTIONS = torch.tensor([[0.8, 0.0, 0.6], [0.0, 0.6, 0.8]], dtype=torch.float64)


def readings(arm: SimulatedArm, q: Tensor) -> dc.Readings:
    """Distances (N,) of the arm's first marker from two beams in turn, m, with errors of 0.02 mm."""
    which = torch.arange(len(q)) % 2
    z = (arm.true_points(q)[:, 0] - arm.truth.base[:3, 3]) @ arm.truth.base[:3, :3]
    lengths = torch.linalg.cross(z - POINTS[which], DIRECTIONS[which]).norm(dim=1)
    lengths += 2e-5 * torch.randn(len(q), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return dc.Readings.of("line distance", q, lengths, ["AB"[k] for k in which], arm.nominal.joint_names)


def main() -> None:
    """Twenty positions of a tracker, and sixty readings."""
    arm = SimulatedArm(seed=0, markers=2)
    q, points = arm.measure(20, seed=5)
    tracked = dc.Measurements(q, points[:, 1:], arm.nominal.joint_names)
    result = dc.calibrate(arm.nominal, dc.Observations.joined([tracked, readings(arm, arm.sample(60, seed=6))]))
    print(*result.placement.sentences(), f"expected error {1e3 * result.expected.workspace:.3f} mm", sep="\n")
    print(dc.evaluate(result.model, readings(arm, arm.sample(30, seed=7))))


if __name__ == "__main__":
    main()
