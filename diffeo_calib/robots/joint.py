"""Joints of a robot: frame, axis and limits; mimic joints. Their motions are in runtime/chain.py.

Every motion is ``J_l(q) = C + S sin q + D cos q + L q`` with constant 4 x 4 matrices (Rodrigues for a rotation, ``L``
for a slide), so that neither values nor types of joints are branched on: autograd, ``torch.func`` and ``vmap`` all pass
through. The value of a mimic joint is an affine function of the values of active joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from math import inf, isfinite, isnan
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.errors import RobotError, as_written
from diffeo_calib.robots.se3 import rigid
from diffeo_calib.runtime.build import ROTARY

KINDS = (*ROTARY, "prismatic", "fixed")
LARGEST_OFFSET = 1e6  # no joint is farther from the one before it [m], and none is geared by more
UNIT_ROUNDING = 1e-15  # of the length of a vector that was divided by it
SQUARABLE = 1e-100  # smaller numbers have squares that may be 0


@dataclass(frozen=True, eq=False)
class Joint:
    """One joint: a constant transform followed by a motion about or along an axis.

    Args:
        name: unique within its chain.
        kind: ``"revolute"``, ``"continuous"``, ``"prismatic"`` or ``"fixed"``.
        origin: (4, 4) pose of the joint's frame in the previous joint's frame [m].
        axis: (3,) axis in the joint's own frame, of any non-zero length; stored with length 1.
        lower: lower limit [rad or m], ``-inf`` without one.
        upper: upper limit [rad or m], ``inf`` without one.
        mimic: None for an active joint. The value of a mimic joint is ``mimic_offset`` plus the sum of multiplier
            times value over these joints (names and multipliers), which may be mimic joints themselves.
        mimic_offset: value of a mimic joint where the joints that drive it are at zero [rad or m].

    Raises:
        RobotError: unknown kind, ``origin`` not a rigid transform or more than 1e6 m away, zero axis, lower limit above
            the upper one; a fixed joint with a mimic, an empty mimic, multipliers or an offset that are not finite or
            above 1e6, an offset without a mimic.
    """

    name: str
    kind: str
    origin: Tensor
    axis: Tensor = field(default_factory=lambda: torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device="cpu"))
    lower: float = -inf
    upper: float = inf
    mimic: Mapping[str, float] | None = None
    mimic_offset: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise RobotError.of("the name of a joint", expected="text", got=as_written(self.name))
        what = f"joint '{self.name}'"
        if self.kind not in KINDS:
            raise RobotError.of(f"the kind of {what}", expected=f"one of {', '.join(KINDS)}", got=as_written(self.kind))
        object.__setattr__(self, "origin", rigid(self.origin, f"the origin of {what}"))
        if (largest := float(self.origin[:3, 3].abs().max())) > LARGEST_OFFSET:
            expected = f"a place within {LARGEST_OFFSET:g} m of the joint before it"
            fix = "check the unit of the lengths, which are in m"
            raise RobotError.of(f"the origin of {what}", expected=expected, got=f"{largest:g} m", fix=fix)
        axis = as_tensor(self.axis, f"axis of {what}", (3,))
        if not float(axis.abs().max()) > 0:
            fix = "give the joint an axis, or make it fixed"
            raise RobotError.of(f"the axis of {what}", expected="a non-zero vector", got="(0, 0, 0)", fix=fix)
        axis = axis / axis.abs().max() if float(axis.abs().max()) < SQUARABLE else axis
        # a unit vector stays as it is, so that models come back from files bit for bit
        object.__setattr__(self, "axis", axis if abs(float(axis.norm()) - 1.0) < UNIT_ROUNDING else axis / axis.norm())
        if isnan(self.lower) or isnan(self.upper) or self.lower > self.upper:
            got = f"lower {self.lower}, upper {self.upper}"
            raise RobotError.of(f"the limits of {what}", expected="lower <= upper", got=got, fix="correct them")
        object.__setattr__(self, "mimic_offset", _finite_number(self.mimic_offset, f"the mimic offset of {what}"))
        if self.mimic is not None:
            object.__setattr__(self, "mimic", self._multipliers(self.mimic, what))
        elif self.mimic_offset:
            fix = "name the joints that drive it, or leave the offset out"
            raise RobotError.of(f"{what} has a mimic offset but mimics no joint", fix=fix)

    def to_config(self) -> dict[str, Any]:
        """The constructor's arguments as JSON values; None stands for an infinite limit."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        values |= {name: values[name].tolist() for name in ("origin", "axis")}
        return values | {name: values[name] if isfinite(values[name]) else None for name in ("lower", "upper")}

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Joint:
        """The inverse of :meth:`to_config`.

        Raises:
            KeyError: an argument is missing.
        """
        arguments = {each.name: config[each.name] for each in fields(cls)}
        for name in ("origin", "axis"):
            arguments[name] = torch.tensor(arguments[name], dtype=torch.float64, device="cpu")
        for name, infinite in (("lower", -inf), ("upper", inf)):
            arguments[name] = infinite if arguments[name] is None else arguments[name]
        return cls(**arguments)

    def _multipliers(self, mimic: object, what: str) -> dict[str, float]:
        if self.kind == "fixed":
            raise RobotError.of(f"{what} is fixed and cannot mimic", fix="give it a moving kind, or no mimic")
        if not isinstance(mimic, Mapping) or not mimic or not all(isinstance(name, str) for name in mimic):
            expected = "a mapping from names of joints to multipliers, such as {'elbow': -1.0}"
            raise RobotError.of(f"the mimic of {what}", expected=expected, got=as_written(mimic))
        return {name: _finite_number(value, f"the multiplier of '{name}' in {what}") for name, value in mimic.items()}


def _finite_number(value: Any, what: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = inf
    if not abs(number) <= LARGEST_OFFSET:
        expected = f"a number of at most {LARGEST_OFFSET:g}" if isfinite(number) else "a finite number"
        raise RobotError.of(what, expected=expected, got=as_written(value), fix="correct it")
    return number


def turned_axes(frames: Tensor, axes: Tensor) -> Tensor:
    """Joint axes in the base: frames (N, n, 4, 4), axes (n, 3) -> (N, n, 3)."""
    return (frames[..., :3, :3] @ axes.to(frames.device)[..., None]).squeeze(-1)
