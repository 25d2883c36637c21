"""A payload whose mass is known: the one load of a robot that changes between measurements, and is weighed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, RobotError, listed, sentence, warn_user
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.tree import Ends, Tree

ABSURD, BEYOND = 1000.0, 1.1  # masses, relative to the largest of the fit, that are refused and that are warned about


@dataclass(frozen=True, eq=False)
class Payload:
    """Masses at one place of a robot; false where none is known, see :data:`NO_PAYLOAD`."""

    link: str  # name of the tip, or of the branch without markers (`load`), at whose origin the mass sits
    masses: Tensor  # of the robot everywhere (), or of N rows (N,), in any unit
    unit: float  # the mass, in the same unit, that counts as one: coefficients are sags under it. Positive.

    @classmethod
    def of_rows(cls, robot: Tree, masses: Tensor | None, at: str | None) -> Payload:
        """The masses (N,) that a robot carried in N rows, the largest of which counts as one; NO_PAYLOAD if not known.

        Args:
            robot: n joints. masses: in any unit. at: name of the link that carried them; by default the only tip.

        Raises MeasurementError: no mass at all, or several tips and no link named. InputError: a link that is no tip
        and no load of the robot. Warns DiffeoCalibWarning: the payload never changes.
        """
        if masses is None:
            return NO_PAYLOAD
        largest, link = float(masses.max()), robot.tip if at is None else at
        if largest == 0:
            raise MeasurementError.of("all payloads are 0", fix="leave them out")
        if at is None and len(robot.tips) > 1:
            fix = "name its link: with_payload(masses, at=...)"
            raise MeasurementError.of(f"the payload of a robot with the tips {listed(robot.tips)}", fix=fix)
        if link not in robot.ends:
            fix = "load the robot with it as a further `load`"
            raise InputError.of("the link of the payload", expected=listed(list(robot.ends)), got=link, fix=fix)
        if bool((masses == largest).all()):
            what = f"all rows carry the same payload ({largest:g}): its sag cannot be told from that under the robot's"
            warn_user(sentence(f"{what} weight", fix="measure with different payloads if the robot will carry others"))
        return cls(link, masses, largest)

    def __bool__(self) -> bool:
        return bool(self.link)

    @property
    def by_row(self) -> bool:
        """Whether every row has a mass of its own."""
        return self.masses.ndim > 0

    def amounts(self, q: Tensor) -> Tensor:
        """The masses in units, one for each configuration (N, n) or one for all: (N, 1) or (1, 1)."""
        if self.by_row and len(self.masses) != len(q):
            got, fix = f"{len(q)} configurations", "pass one mass for all configurations"
            raise InputError.of(f"payloads of {len(self.masses)} rows", expected="one for each", got=got, fix=fix)
        return (self.masses.to(q) / self.unit).reshape(-1, 1)

    def rows(self, index: Tensor | slice) -> Payload:
        """The masses of some rows."""
        some = index.to(self.masses.device) if isinstance(index, Tensor) else index
        return replace(self, masses=self.masses[some]) if self.by_row else self

    @property
    def typical(self) -> Payload:
        """The median mass of all rows."""
        return self.weighing(self.masses.median()) if self.by_row else self

    def weighing(self, mass: Tensor) -> Payload:
        """Another mass at the same place; InputError where the sag under a payload is not known."""
        if not self:
            what = "this model was calibrated without payloads: it does not know the sag under one"
            fix = "calibrate with measurements that name their payload, Measurements.with_payload"
            raise InputError.of(what, fix=fix)
        return replace(self, masses=mass)

    @property
    def mass(self) -> float | None:
        """The mass, the median of rows; None if none is known."""
        return float(self.masses.median()) if self else None

    def under(self, masses: Tensor | None) -> Payload:
        """Return the place with the masses () or (N,) of new rows; MeasurementError for payloads on one side only."""
        if not self:
            what, fix = (
                "the measurements have payloads, the model was calibrated without",
                "calibrate with payloads too",
            )
            check_unladen(masses, what, fix=f"{fix}, or leave them out")
            return self
        if masses is None:
            fix = "name their column (`payload`), or pass data.with_payload(mass)"
            raise MeasurementError.of("the model was calibrated with payloads, the measurements have none", fix=fix)
        return self.weighing(masses)

    def checked(self) -> Payload:
        """Return the payload; InputError for masses far above those of the fit, a warning for masses above them."""
        largest = float(self.masses.max()) if self.masses.numel() else 0.0
        got, measured = f"{largest:g}", f"0 to {self.unit:g} in the measurements of the fit"
        if largest > ABSURD * self.unit:
            raise InputError.of("`mass` of the payload", expected=measured, got=got, fix="check its unit")
        if largest > BEYOND * self.unit:
            what = f"a payload of {got} is beyond the {measured}: errors are larger than the predicted deviations say"
            warn_user(sentence(what, fix="measure rows with such a payload too"))
        return self


NO_PAYLOAD = Payload("", torch.zeros((), dtype=torch.float64, device=HOST), 1.0)


def check_same_load(masses: Tensor | None, what: str, got: object, *, fix: str) -> None:
    """Raise InputError for what rows with payloads of their own do not allow."""
    if masses is not None:
        raise InputError.of(f"{what} of measurements with payloads", expected="'all'", got=got, fix=fix)


def check_unladen(masses: Tensor | None, what: str, *, fix: str) -> None:
    """Raise MeasurementError for masses of rows that cannot have any."""
    if masses is not None:
        raise MeasurementError.of(what, expected="no payloads", got="a column of masses", fix=fix)


def under_mass(model: Any, mass: float | None) -> Any:
    """A model that carries a mass; unchanged if it knows of no payload."""
    return model if model.payload is None else model.with_payload(mass)


def words_of_mass(mass: float | None) -> str:
    """Such as ``with a payload of 3 ``; nothing for none."""
    return "" if mass is None else f"with a payload of {mass:g} "


def with_load(robot: Tree, name: str, place: object, on: str | None = None) -> Tree:
    """Return the robot with a weight beside the links of its description, for the place of a payload.

    It is a branch without markers whose weight bends the robot, as `load` of :func:`load_urdf`: exports that know
    serial robots only refuse it.

    Args:
        robot: the robot. name: of the new place, for :meth:`Measurements.with_payload`.
        place: (3,) in the frame of a tip, m. on: name of that tip; the only one by default.

    Raises RobotError: a name that is taken, or an unknown tip. InputError: no three numbers.
    """
    tip = robot.tip if on is None else on
    if tip not in robot.ends:
        raise RobotError.of("`on`", expected=listed(list(robot.ends)), got=tip, fix="name the tip that carries it")
    if name in robot.ends:
        raise RobotError.of("`name` of the load", expected="a new name", got=name)
    origin = torch.eye(4, dtype=torch.float64, device=HOST)
    origin[:3, 3] = as_tensor(place, "place", (3,))
    loads = {load: robot.ends[load] for load in robot.loads} | {name: len(robot.joints)}
    ends = Ends({end: robot.ends[end] for end in robot.tips}, loads, robot.ground)
    joints, parents = [*robot.joints, Joint(f"{name} (load)", "fixed", origin)], [*robot.parents, robot.ends[tip]]
    return Tree(robot.name, robot.base, joints, parents, ends, drivers=robot.drivers, source=robot.source)


def payload_sentence(payload: Payload) -> str:
    """For which payload a model holds: that of its fit where none was known."""
    if not payload:
        return "the model holds for the payload of the fit"
    heaviest = f"payloads up to {payload.unit:g} are part of the model"
    return heaviest if payload.by_row else f"{heaviest}, and the pictures are for {float(payload.masses):g}"
