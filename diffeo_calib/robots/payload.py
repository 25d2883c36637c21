"""A payload whose mass is known: the one load of a robot that changes between measurements, and is weighed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, RobotError, listed
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.tree import Ends, Tree


@dataclass(frozen=True, eq=False)
class Payload:
    """Masses at one place of a robot.

    Args:
        link: name of the tip, or of the branch that only weighs, at whose origin the mass sits.
        masses: of the robot everywhere (), or of N rows (N,), in any unit.
        unit: the mass, in the same unit, that counts as one: coefficients are sags under it.

    Raises:
        InputError: a unit that is not positive.
    """

    link: str
    masses: Tensor
    unit: float

    def __post_init__(self) -> None:
        if not self.unit > 0:
            raise InputError.of("the unit of a payload", expected="a positive mass", got=self.unit)

    @property
    def by_row(self) -> bool:
        """Whether every row has a mass of its own."""
        return self.masses.ndim > 0

    def amounts(self, q: Tensor) -> Tensor:
        """The masses in units, one for each configuration (N, n) or one for all: (N, 1) or (1, 1).

        Raises:
            InputError: masses of another number of rows.
        """
        if self.by_row and len(self.masses) != len(q):
            got, fix = f"{len(q)} configurations", "pass one mass for all configurations"
            raise InputError.of(f"payloads of {len(self.masses)} rows", expected="one for each", got=got, fix=fix)
        return (self.masses.to(q) / self.unit).reshape(-1, 1)

    def rows(self, index: Tensor) -> Payload:
        """The masses of some rows."""
        return replace(self, masses=self.masses[index.to(self.masses.device)]) if self.by_row else self

    def weighing(self, mass: Tensor) -> Payload:
        """Another mass at the same place."""
        return replace(self, masses=mass)


def with_load(robot: Tree, name: str, place: object, on: str | None = None) -> Tree:
    """The same robot with a weight beside the links of its description, for the place of a payload.

    It is a branch that only weighs, as `load` of :func:`load_urdf`: exports that know serial robots only refuse it.

    Args:
        robot: the robot. name: of the new place, for :meth:`Measurements.with_payload`.
        place: (3,) in the frame of a tip, m.
        on: name of that tip; the only one by default.

    Raises:
        RobotError: a name that is taken, or an unknown tip.
        InputError: no three numbers.
    """
    tip = robot.tip if on is None else on
    if tip not in robot.ends:
        raise RobotError.of("`on`", expected=listed(list(robot.ends)), got=tip, fix="name the tip that carries it")
    if name in robot.ends:
        raise RobotError.of("`name` of the load", expected="a new name", got=name)
    origin = torch.eye(4, dtype=torch.float64, device=HOST)
    origin[:3, 3] = as_tensor(place, "place", (3,))
    loads = {load: robot.ends[load] for load in robot.loads} | {name: len(robot.joints)}
    ends = Ends({own: robot.ends[own] for own in robot.tips}, loads, robot.ground)
    joints, parents = [*robot.joints, Joint(f"{name} (load)", "fixed", origin)], [*robot.parents, robot.ends[tip]]
    return Tree(robot.name, robot.base, joints, parents, ends, drivers=robot.drivers, source=robot.source)


def payload_sentence(payload: Payload | None) -> str:
    """For which payload a model holds: that of its fit where none was known."""
    if payload is None:
        return "the model holds for the payload of the fit"
    heaviest = f"payloads up to {payload.unit:g} are part of the model"
    return heaviest if payload.by_row else f"{heaviest}, and the pictures are for {float(payload.masses):g}"
