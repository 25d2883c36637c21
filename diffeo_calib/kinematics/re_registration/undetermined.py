"""Directions of base and markers that measurements hardly determine, in sentences.

The place of the measuring frame is judged with the markers given: where both move together, the marker is what is not
known, and turning the tool determines it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import degrees

import torch
from torch import Tensor

from diffeo_calib.measurements.pose_frames import POINTS, own_blocks
from diffeo_calib.robots.se3 import skew

WELL_KNOWN_M = 1e-4
"""Smaller deviations are never named, whatever the noise."""
HARDLY = 10.0
"""A direction is hardly determined if its deviation is so many times that of a predicted row."""
SPREAD, TURN = "spread the poses over the workspace", "turn the tool about several axes between the poses"


def undetermined(
    covariance: Tensor, markers: Tensor, arm: float, usual: float, tips: Sequence[str], *, rigid: bool
) -> tuple[str, ...]:
    """Sentences about the directions of frame and markers whose deviations are large.

    Args:
        covariance: (6 + 3 P, 6 + 3 P) of shift and turn of the measuring frame about the middle of the rows, then of
            the markers in the tip's frame, m and rad.
        markers: (P, 3) in the tip's frame, m.
        arm: distance from the middle of the rows at which a turn of the frame matters, m.
        usual: deviation of a coordinate of a predicted row, m. tips: names of those of the markers.
        rigid: whether the markers are the points of measured frames, three of each.
    """
    limit = max(HARDLY * usual, WELL_KNOWN_M)
    together = covariance[:6, 6:]
    frame = covariance[:6, :6] - together @ torch.linalg.pinv(covariance[6:, 6:], hermitian=True) @ together.mT
    found = [
        _sentence("the place of the measuring frame", frame[:3, :3], limit, "mm", SPREAD),
        _sentence("the turn of the measuring frame", frame[3:, 3:], limit / max(arm, usual), "degrees", SPREAD),
        *(_frame_on_tip if rigid else _markers_on_tip)(covariance[6:, 6:], markers, limit, tips),
    ]
    return tuple(text for text in found if text)


def _markers_on_tip(covariance: Tensor, markers: Tensor, limit: float, tips: Sequence[str]) -> list[str]:
    """About each of the markers."""
    places = covariance.unflatten(0, (-1, 3)).unflatten(2, (-1, 3)).diagonal(dim1=0, dim2=2).movedim(-1, 0)  # (P, 3, 3)
    names = [f"marker {k}" for k in range(len(markers))] if len(markers) > 1 else ["the marker"]
    named = zip(names, tips, places, strict=True)
    return [_sentence(f"the place of {name} on '{tip}'", place, limit, "mm", TURN) for name, tip, place in named]


def _frame_on_tip(covariance: Tensor, markers: Tensor, limit: float, tips: Sequence[str]) -> list[str]:
    """About each of the frames that three points represent."""
    blocks = own_blocks(covariance[None], len(markers) // POINTS)[0]
    each = zip(blocks, markers.split(POINTS), tips[::POINTS], strict=True)
    return [text for one in each for text in _about_frame(*one, limit)]


def _about_frame(covariance: Tensor, markers: Tensor, tip: str, limit: float) -> list[str]:
    """About one frame, covariance (9, 9) and points (3, 3)."""
    arms = markers - markers.mean(0)
    eye = torch.eye(3, dtype=markers.dtype, device=markers.device).expand(len(arms), 3, 3)
    motion = torch.linalg.pinv(torch.cat([eye, -skew(arms)], 2).flatten(0, 1))  # (6, 3 P)
    frame = motion @ covariance @ motion.mT
    lever = float(arms.square().sum(1).mean().sqrt())
    return [
        _sentence(f"the place of the measured frame on '{tip}'", frame[:3, :3], limit, "mm", TURN),
        _sentence(f"the turn of the measured frame on '{tip}'", frame[3:, 3:], limit / lever, "degrees", TURN),
    ]


def _sentence(what: str, covariance: Tensor, limit: float, unit: str, fix: str) -> str:
    """A sentence about the directions with large deviations; empty if there are none."""
    large = _large(covariance, limit)
    if not large:
        return ""
    to = ", ".join(_number(degrees(s) if unit == "degrees" else 1e3 * s) for s, _ in large)
    along = ", ".join(_direction(v) for _, v in large)
    if len(large) == len(covariance):
        return f"{what} is known to {to} {unit} only: {fix}"
    return f"{what} {'about' if unit == 'degrees' else 'along'} {along} is known to {to} {unit} only: {fix}"


def _large(covariance: Tensor, limit: float) -> list[tuple[float, Tensor]]:
    """Deviations above the limit, and their directions, the largest first."""
    values, vectors = torch.linalg.eigh(covariance)
    deviations = values.clamp(min=0).sqrt()
    return [(float(s), v) for s, v in zip(deviations.flip(0), vectors.mT.flip(0), strict=True) if float(s) > limit]


def _number(value: float) -> str:
    """Two digits."""
    return f"{value:.2g}" if value < 99.5 else f"{round(value, -1):.0f}"


def _direction(vector: Tensor) -> str:
    """A unit vector, its largest component positive."""
    signed = vector * vector[vector.abs().argmax()].sign()
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in signed.tolist()) + ")"
