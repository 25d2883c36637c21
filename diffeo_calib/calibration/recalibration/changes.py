"""What has changed since a robot was calibrated, in sizes and sentences; offsets that a moved device would hide."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import degrees, inf
from typing import NamedTuple

import torch

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.recalibration.new_rows import NewSetUp
from diffeo_calib.common.errors import with_deviation
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.process.evidence import Evidence
from diffeo_calib.regression.conditional import roots
from diffeo_calib.robots.tree import Tree

LEVEL = 0.01
"""Probability that anything is named although nothing has changed."""


RANK_TOLERANCE = 1e-9
"""Smallest eigenvalue of correlations, relative to the largest, that is not rounding."""


@dataclass(frozen=True)
class Change:
    """Something that has changed.

    Args:
        part: name of the joint, "gravity" or "geometry".
        size: RMS of the change over the new rows: rad or m of a joint, m of the markers for other parts. Of an offset
            what must be added to a reading of the joint beyond what was added at the old date: a joint that is at q by
            its encoder is at q + size where the old model has it at q.
        angle: whether the size is in rad.
        displacement: RMS displacement of the markers by it, m.
        probability: that chance makes any likelihood ratio as large.
        deviation: standard deviation of an offset; None for other parts.
        others: offsets that explain the rows as well.
        where: the rows that show it, in words; empty if all do.
    """

    part: str
    size: float
    angle: bool
    displacement: float
    probability: float
    deviation: float | None = None
    others: tuple[str, ...] = ()
    where: str = ""

    def __str__(self) -> str:
        return f"{self.where}: {self._what}" if self.where else self._what

    @property
    def _what(self) -> str:
        size = f"{1e3 * self.size:.2g}"
        if self.deviation is not None:
            size = with_deviation(1e3 * self.size, 1e3 * self.deviation)
        size = f"{size} mrad ({degrees(self.size):.2g} degrees)" if self.angle else f"{size} mm"
        by = f", which moves the markers by {1e3 * self.displacement:.2g} mm" if self.angle else ""
        part = " or ".join((self.part, *self.others)) + " (these rows do not tell which)" * bool(self.others)
        return f"{part} has changed by {size}{by} (by chance with a probability of at most {self.probability:.2g})"


class Offset(NamedTuple):
    """A change of a joint's offset: the smallest that rows show in nine cases of ten, or one that they may hide."""

    joint: str  # its name
    angle: bool  # whether the others are in rad, else in m
    size: float  # is added to a reading as that of a :class:`Change`; infinite if places hide any
    deviation: float = 0.0  # of the size; zero of the smallest one
    instead: str = ""  # what has moved otherwise, in words; empty for those

    def __str__(self) -> str:
        unit = "mrad" if self.angle else "mm"
        if not self.instead:
            return f"{self.joint} none" if self.size == inf else f"{self.joint} {1e3 * self.size:.2g} {unit}"
        size = f"{with_deviation(1e3 * self.size, 1e3 * self.deviation)} {unit}"
        return f"{self.instead}, or the offset of {self.joint} has changed by {size}: these rows cannot tell which"


@dataclass(frozen=True)
class Changes:
    """Changes, the clearest first.

    Args:
        found: the changes.
        probabilities: name of every part -> that chance makes any likelihood ratio as large as this part's.
        noise: standard deviation of the new rows' noise relative to that of the old rows.
        rows: number of rows that were tested: those within the old joint ranges.
        level: probability of a false alarm; None if nothing was tested on request.
        smallest: of every joint, the smallest change of its offset that the rows would show; empty once one was found.
    """

    found: tuple[Change, ...] = ()
    probabilities: dict[str, float] = field(default_factory=dict)
    noise: float = 1.0
    rows: int = 0
    level: float | None = None
    smallest: tuple[Offset, ...] = ()

    @property
    def tested(self) -> bool:
        """Whether the robot was tested: else a change of it may be in new places of device and markers."""
        return bool(self.probabilities)

    @property
    def few(self) -> str:
        """How many rows could be tested, in words."""
        return f"only {self.rows} rows lie within the joint ranges that the model knows"

    def __str__(self) -> str:
        if self.level is None:
            return "changes of the robot were not tested"
        if not self.tested:
            return f"{self.few}: changes were not tested, and what has changed is not known"
        if not self.found:
            places = "the places of device and markers, which may hide an offset of the first or the last joint"
            rows = f", {self.rows} rows" * bool(self.rows)
            return f"no change was found but {places} (tested at {100 * self.level:g} %{rows})"
        return "; ".join(map(str, self.found))


def hidden_offsets(robot: Tree, set_up: NewSetUp, changes: Changes) -> tuple[Offset, ...]:
    """Offsets that explain where a registration found device or markers; none where a change of the robot is named.

    Args:
        robot: with n joints. set_up: where device and markers are. changes: as the rows show them.
    """
    rows, found = set_up.registered, set_up.registration
    if rows is None or found is None or changes.found:
        return ()
    S, J = rows.by_places.flatten(0, 1), rows.at.joint_to_start.flatten(0, 1)  # (M m, 6 + 3 P), (M m, n)
    covariance, noise = rows.inflation * rows.given.covariance, float(found.noise.diagonal().mean().sqrt())
    T, centre = rows.transform, rows.centre
    turn = rotation_numbers(T[None, :3, :3], "rotvec", angle="rad")[0]
    moved = torch.cat([T[:3, :3] @ centre + T[:3, 3] - centre, turn])  # m and rad, of the frame in that of the map
    places = {"the measuring device has moved": (slice(0, 6), moved)}
    if found.shift is not None:
        places["the markers have moved"] = (slice(6, S.shape[1]), found.shift.flatten())
    hidden = []
    for instead, (own, shift) in places.items():
        white = roots(covariance[own, own], RANK_TOLERANCE)[1]
        white = white[white.any(1)]  # markers that moved together leave it singular
        away = white @ shift
        count, total = len(away), float(away @ away)
        if total < chi2_above(LEVEL, count):
            continue
        for joint, name in enumerate(robot.joint_names):
            d = torch.linalg.lstsq(S[:, own], J[:, joint, None]).solution
            evidence = Evidence((white @ d).T @ away, (white @ d).T @ white @ d)
            if float(evidence.H) <= 0.0:  # It moves the places only as they are known not to move.
                continue
            size, deviation = float(evidence.size), float(evidence.H) ** -0.5
            unseen = abs(size) * float((J[:, joint, None] - S[:, own] @ d).square().mean().sqrt())
            left = total - float(evidence.gain)
            if unseen < gates.HIDDEN_SHARE * noise and left < chi2_above(LEVEL, max(count - 1, 1)):
                hidden.append(Offset(name, robot.kinds[joint] != "prismatic", size, deviation, instead))
    return tuple(hidden)
