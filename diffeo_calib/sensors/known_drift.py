"""Slow drift with a column of a table, such as time or temperature, that a model found at its fit and keeps.

Between the lowest and the highest value of a column in the rows of the fit the measuring frame shifts and turns,
lengths grow, and every joint offset changes; the model itself holds for the middle. Beyond these values nothing is
known: the drift stays as it is at the nearer end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, with_deviation
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots.se3 import skew
from diffeo_calib.sensors.devices import Extrinsics

FRAME, GROWTH, OFFSETS = 6, 6, 7
"""Of the unknowns: shift and turn of the frame come first, then growth, then the joint offsets."""
ENDS_AND_CENTRE = 5
SURE = 3.0  # standard deviations from which an unknown is reported


@dataclass(frozen=True, eq=False)
class KnownDrift(Extrinsics):
    """Drift with K columns of a robot with n joints.

    Args:
        constants: (K, 12 + n) the range of every column in the rows of the fit, the point about which the frame turns
            and lengths grow, m, and what changes over the whole range: shift [m], turn [rad], growth, joint offsets
            [rad or m].
        deviations: (K, 7 + n) of these changes.
        joints: names, and whether each turns; a file does not say it.
    """

    kind = "drift"
    joints: tuple[tuple[str, bool], ...] = ()

    @classmethod
    def of(cls, model: Any) -> KnownDrift | None:
        """Drift of a model; None without one, and for other kinematics.

        Raises:
            InputError: numbers that do not fit the robot's joints.
        """
        sets = getattr(model, "placement", None) or ()
        drift: Any = next((drift for drift in sets if drift.kind == cls.kind), None)
        if drift is None:
            return None
        joints = tuple(zip(model.robot.joint_names, model.robot.periodic, strict=True))
        size = OFFSETS + len(joints)
        if drift.constants.shape[1] != ENDS_AND_CENTRE + size or drift.deviations.shape[1] != size:
            got = f"{drift.constants.shape[1]} and {drift.deviations.shape[1]}"
            raise InputError.of(
                "the drift of a model", expected=f"{ENDS_AND_CENTRE + size} and {size} numbers", got=got
            )
        return replace(drift, joints=joints)

    @property
    def ends(self) -> dict[str, tuple[float, float]]:
        """The lowest and the highest value of each column."""
        return {name: (low, high) for name, (low, high, *_) in zip(self.names, self.constants.tolist(), strict=True)}

    @property
    def centre(self) -> Tensor:
        """(3,) about which the frame turns and lengths grow, m."""
        return self.constants[0, 2:ENDS_AND_CENTRE]

    @property
    def sizes(self) -> Tensor:
        """(K, 7 + n) changes over the whole range."""
        return self.constants[:, ENDS_AND_CENTRE:]

    def ramp(self, data: Any) -> Tensor:
        """From -1/2 at the lowest value of each column to 1/2 at the highest: (N, K); 0 where rows do not tell it."""
        ends, middle = self.ends.items(), data.q.new_full((len(data),), 0.5)
        shares = [(data.drifting[k] - low) / (high - low) if k in data.drifting else middle for k, (low, high) in ends]
        return torch.stack(shares, 1).clamp(0.0, 1.0) - 0.5

    def points(self, kinematics: Callable[[Tensor], Tensor], data: Any) -> Tensor:
        """Points (N, P, 3) of a model at rows, as the drift moved them, m."""
        moved = self.ramp(data) @ self.sizes.to(data.q)
        centre, R = self.centre.to(moved), torch.linalg.matrix_exp(skew(moved[:, 3:FRAME]))
        away = kinematics(data.q + moved[:, OFFSETS:]).detach() - centre
        return centre + moved[:, None, :3] + (1.0 + moved[:, GROWTH, None, None]) * (away @ R.mT)

    def undone(self, data: Any) -> Any:
        """Measured positions as they would be in the middle of the columns, which they then do not tell any more."""
        moved = self.ramp(data) @ self.sizes.to(data.q)
        centre = self.centre.to(moved)
        T = torch.eye(4, dtype=moved.dtype, device=moved.device).repeat(len(moved), 1, 1)
        R, away = torch.linalg.matrix_exp(-skew(moved[:, 3:FRAME])), data.points.nanmean(1) - centre
        shrunk = moved[:, GROWTH : GROWTH + 1] * away
        T[:, :3, :3] = R
        T[:, :3, 3] = centre - (R @ (centre + moved[:, :3])[..., None])[..., 0] - shrunk
        return with_attributes(data.in_frames(T), q=data.q + moved[:, OFFSETS:]).with_covariates()

    def holds(self) -> str:
        """For which values the model itself holds."""
        return " and ".join(f"{name} {0.5 * (low + high):g}" for name, (low, high) in self.ends.items())

    def of_joints(self) -> Iterator[str]:
        """How much drifted with each column, of what is known well, and for what the model holds."""
        for number, (name, (low, high)) in enumerate(self.ends.items()):
            what = ", ".join(self._known(number)) or "no single cause stands out"
            yield f"drift with {name} from {low:g} to {high:g}: {what}; the model holds for {0.5 * (low + high):g}"

    def in_rows(self, data: Any) -> Iterator[str]:
        """Sentence on how the drift is treated in rows that are judged."""
        present = [name for name in self.names if name in data.drifting]
        if present:
            yield f"the drift with {' and '.join(present)} that the fit found is part of the predictions of these rows"
        if len(present) < len(self.names):
            yield f"rows without {' and '.join(self.names)} are judged as if measured at {self.holds()}"
        for name, (low, high) in self.ends.items():
            values = data.drifting.get(name)
            outside = 0 if values is None else int(((values < low) | (values > high)).sum())
            if outside:
                yield (
                    f"{outside} rows have {name} outside of {low:g} to {high:g}, the rows of the fit: "
                    "the drift is taken to stay as it was at the nearer end"
                )

    def _known(self, column: int) -> Iterator[str]:
        """The unknowns that differ from zero."""
        u, sd = self.sizes[column], self.deviations[column]
        for part, what, unit in ((slice(0, 3), "shift", "mm"), (slice(3, FRAME), "turn", "mrad")):
            if float((u[part] / sd[part]).abs().max()) > SURE:
                yield f"the measuring frame by a {what} of {1e3 * float(u[part].norm()):.2g} {unit}"
        if float(u[GROWTH].abs()) > SURE * float(sd[GROWTH]):
            yield f"lengths by {1e6 * float(u[GROWTH]):+.2g} ppm"
        offsets = zip(self.joints, u[OFFSETS:].tolist(), sd[OFFSETS:].tolist(), strict=True)
        for (name, turns), shift, deviation in offsets:
            if abs(shift) > SURE * deviation:
                size = with_deviation(1e3 * shift, 1e3 * deviation)
                yield f"the offset of {name} by {size} {'mrad' if turns else 'mm'}"
