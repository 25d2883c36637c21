"""A payload whose mass is known: the one load of a robot that changes between measurements, and is weighed."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from diffeo_calib.common.errors import InputError


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
