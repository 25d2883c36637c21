"""A device that sees a frame, in one file: an inclinometer on the tool, which reports two angles against gravity.

    python scripts/examples/inclinometer.py

How it is mounted and where gravity points in the measuring frame are found. Beside measured poses it is fitted,
evaluated, planned and written like the package's own devices.
"""

from __future__ import annotations

import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.bodies import triple
from diffeo_calib.measurements.poses import poses_of_triangles
from diffeo_calib.robots.se3 import rotation
from diffeo_calib.robots.simulated_arm import SimulatedArm
from diffeo_calib.sensors.devices import Devices, across, least_squares
from diffeo_calib.sensors.kinds import register

RANGE_RAD, SQUARE_RAD = 1.0, 0.01
"""Largest angle that it measures; how far its axes may be from a right angle."""


@register
class Inclinometers(Devices):
    """Inclinometers: constants are their axes x and y in the tool's frame, and the upward direction.

    An angle is that of an axis above the horizontal. Increments: turns of the axes about x, y and z, of y towards x,
    and of the upward direction towards two others [rad].
    """

    kind = "inclination"
    size_fix = "measure poses too: angles hold no lengths"
    stated_as = "XX,XY,XZ,YX,YY,YZ,UX,UY,UZ"
    seen_points, numbers_each, increments_each = 3, 2, 6
    metres_each, unit = 0.1, ("mrad", 1e3)

    @classmethod
    def prior(cls, offset_std: float = 0.0) -> list[float]:
        """Mounted anyhow, with axes at about a right angle."""
        turns = super().prior(offset_std)
        return [*turns[:3], SQUARE_RAD, *turns[4:]]

    @staticmethod
    def read(constants: Tensor, body: Tensor) -> Tensor:
        """Two angles."""
        axes, up = constants[:6].view(2, 3), constants[6:]
        return (axes @ (body[:3, :3].mT @ up)).asin()

    @staticmethod
    def changed(constants: Tensor, increments: Tensor) -> Tensor:
        """Turned."""
        axes, up = constants[:6].view(2, 3), constants[6:]
        (x, y), up = axes @ rotation(increments[:3]).mT, up + increments[4:] @ across(up)
        return torch.cat([x, *(torch.nn.functional.normalize(own, dim=0) for own in (y + increments[3] * x, up))])

    @classmethod
    def stated(cls, numbers: Tensor) -> Tensor:
        """Directions of any length."""
        return torch.nn.functional.normalize(numbers.view(-1, 3, 3), dim=2).flatten(1)

    @classmethod
    def start(cls, values: Tensor, bodies: Tensor) -> Tensor:
        """sin a = x^T R^T u is linear in x u^T, and so is that of y: both have the factor u."""
        columns = bodies[:, :3, :3].mT.flatten(1)
        products = torch.stack([least_squares(columns, sine).view(3, 3) for sine in values.sin().unbind(1)])
        up = torch.linalg.svd(products.flatten(0, 1)).Vh[0]
        up = up * up[2].sign()  # the other sign reads the same with axes turned by 180 degrees
        x, y = torch.nn.functional.normalize(products @ up, dim=1)
        return cls.stated(torch.cat([x, y - (x @ y) * x, up])[None])[0]

    def sees(self, points: Tensor, device: Tensor) -> Tensor:
        """Within its range."""
        return (self.observation(device).value(points) / self.metres_each).abs().amax(1) < RANGE_RAD

    def sentence(self, number: int, deviations: Tensor, frame: str) -> str:
        """Axes, and the upward direction."""
        x, y, up = (triple(part) for part in self.constants[number].split(3))
        mounted, level = (1e3 * float(part.norm()) for part in deviations.split((4, 2)))
        what = f"inclinometer '{self.names[number]}': axes {x} and {y} of the tool +- {mounted:.2f} mrad"
        return f"{what}, up is {up} in {frame} +- {level:.2f} mrad"


AXES = torch.tensor([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]], dtype=torch.float64)  # of the inclinometer, in the tool's frame
UP = torch.tensor([0.01, -0.02, 1.0], dtype=torch.float64)  # in the measuring frame


def frames(arm: SimulatedArm, q: Tensor) -> Tensor:
    """True poses (N, 4, 4) of a frame on three markers, m."""
    return poses_of_triangles(arm.true_points(q))


def readings(arm: SimulatedArm, q: Tensor) -> dc.Readings:
    """Angles of the configurations of q that it can measure, with errors of 0.1 mrad."""
    up = torch.nn.functional.normalize(UP, dim=0)
    angles = torch.einsum("ab,nb->na", AXES, frames(arm, q)[:, :3, :3].mT @ up).asin()
    inside = angles.abs().amax(1) < RANGE_RAD
    angles = angles + 1e-4 * torch.randn(angles.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    names, unit = arm.nominal.joint_names, Inclinometers.unit
    return dc.Readings.of("inclination", q[inside], angles[inside], None, names, unit=unit, numbers=2)


def main() -> None:
    """Twenty poses, and what the inclinometer says between them."""
    arm = SimulatedArm(seed=0, markers=3)
    q = arm.sample(20, seed=5)
    poses = dc.Measurements.from_poses(q, frames(arm, q), arm.nominal.joint_names)
    result = dc.calibrate(arm.nominal, dc.Observations.joined([poses, readings(arm, arm.sample(100, seed=6))]))
    print(*result.placement.sentences(), f"expected error {1e3 * result.expected.workspace:.3f} mm", sep="\n")
    print(dc.evaluate(result.model, readings(arm, arm.sample(50, seed=7))))


if __name__ == "__main__":
    main()
