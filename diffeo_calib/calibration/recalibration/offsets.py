"""Joint offsets that a moved device or marker would hide."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.hypotheses import Evidence
from diffeo_calib.calibration.recalibration.changes import LEVEL, Changes
from diffeo_calib.calibration.recalibration.new_set_up import Before
from diffeo_calib.common.errors import with_deviation
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.kinematics.re_registration.registered_map import RegisteredMap, Registration, moved
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.robots.tree import Tree

RANK_TOLERANCE = 1e-9
"""Smallest eigenvalue of correlations, relative to the largest, that is not rounding."""
PRISMATIC = "prismatic"


class HiddenOffset(NamedTuple):
    """An offset that explains a new place as well.

    Args:
        joint: its name. size, deviation: of the offset, rad or m, which is added to a reading as that of a
            :class:`Change`. angle: whether it is in rad.
        instead: what has moved otherwise, in words.
    """

    joint: str
    size: float
    deviation: float
    angle: bool
    instead: str

    def __str__(self) -> str:
        unit = "mrad" if self.angle else "mm"
        size = f"{with_deviation(1e3 * self.size, 1e3 * self.deviation)} {unit}"
        return f"{self.instead}, or the offset of {self.joint} has changed by {size}: these rows cannot tell which"


def hidden_offsets(robot: Tree, before: Before, changes: Changes) -> tuple[HiddenOffset, ...]:
    """Offsets that explain where a registration found device or markers; none where a change of the robot is named.

    Args:
        robot: with n joints. before: the old map and the new rows. changes: of the robot, as these show them.
    """
    found = before.registration
    if found is None or changes.found:
        return ()
    old = before.fitted
    S, J = _slopes(RegisteredMap(moved(old, found.transform), found), found.q)
    noise = float(found.noise.diagonal().mean().sqrt())
    places = {"the measuring device has moved": (slice(0, 6), _motion(found))}
    if found.shift is not None:
        places["the markers have moved"] = (slice(6, None), found.shift.flatten())
    hidden = []
    for instead, (own, place) in places.items():
        K, free = found.covariance[own, own], found.covariance.diagonal()[own] > 0
        if not bool(free.all()):
            continue
        white = _whitening(K)
        away = white @ place
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
                hidden.append(HiddenOffset(name, size, deviation, robot.kinds[joint] != PRISMATIC, instead))
    return tuple(hidden)


def _whitening(K: Tensor) -> Tensor:
    """(k, K) root of the pseudo-inverse of a covariance of rank k: markers that moved together leave it singular."""
    scale = K.diagonal().sqrt()
    values, Q = torch.linalg.eigh(K / scale / scale[:, None])
    kept = values > RANK_TOLERANCE * values[-1]
    return (Q[:, kept] / scale[:, None] / values[kept].sqrt()).mT


def _motion(found: Registration) -> Tensor:
    """(6,) shift at the centre and small turn of the measuring frame."""
    T, centre = found.transform, found.centre
    before = T[:3, :3].mT @ (centre - T[:3, 3])
    return torch.cat([centre - before, rotation_numbers(T[None, :3, :3], "rotvec", angle="rad")[0]])


def _slopes(placed: RegisteredMap, q: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of the points at q by places (M m, 6 + 3 P) and by joint offsets (M m, n)."""
    return placed.place_slopes(q), placed.geodesic.linearise(q).joint_to_start.flatten(0, 1)
