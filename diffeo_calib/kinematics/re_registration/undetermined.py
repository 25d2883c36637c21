"""Directions that the rows of a registration hardly determine, in sentences."""

from __future__ import annotations

from math import degrees

import torch
from torch import Tensor

HARDLY = 10.0
"""A direction is hardly determined if its deviation is so many times that of a predicted row."""


def undetermined(covariance: Tensor, arm: float, usual: float, tip: str, *, rigid: bool) -> tuple[str, ...]:
    """Sentences about the directions of frame and markers whose deviations are large.

    Args:
        covariance: (6 + 3 P, 6 + 3 P) of a :class:`Registration`. arm: RMS distance of the rows from its centre, m.
        usual: deviation of a coordinate of a predicted row, m. tip: name of the tip.
        rigid: whether the markers are the points of one measured frame.
    """
    limit = HARDLY * usual
    spread, turn = "spread the poses over the workspace", "turn the tool about several axes between the poses"
    blocks = covariance[6:, 6:].unflatten(0, (-1, 3)).unflatten(2, (-1, 3))  # (P, 3, P, 3)
    places = [blocks.mean((0, 2))] if rigid else list(blocks.diagonal(dim1=0, dim2=2).movedim(-1, 0))
    names = ["the measured frame"] if rigid else [f"marker {k}" for k in range(len(places))]
    names = ["the marker"] if len(names) == 1 and not rigid else names
    named = zip(names, places, strict=True)
    found = [
        _sentence("the place of the measuring frame", covariance[:3, :3], limit, "mm", spread),
        _sentence("the turn of the measuring frame", covariance[3:6, 3:6], limit / max(arm, usual), "degrees", spread),
        *(_sentence(f"the place of {name} on '{tip}'", place, limit, "mm", turn) for name, place in named),
    ]
    return tuple(text for text in found if text)


def _sentence(what: str, covariance: Tensor, limit: float, unit: str, fix: str) -> str:
    """A sentence about the directions with large deviations; empty if there are none."""
    large = _large(covariance, limit)
    if not large:
        return ""
    to = ", ".join(f"{degrees(s) if unit == 'degrees' else 1e3 * s:.2g}" for s, _ in large)
    along = ", ".join(_direction(v) for _, v in large)
    if len(large) == len(covariance):
        return f"{what} is known to {to} {unit} only: {fix}"
    return f"{what} along {along} is known to {to} {unit} only: {fix}"


def _large(covariance: Tensor, limit: float) -> list[tuple[float, Tensor]]:
    """Deviations above the limit, and their directions, the largest first."""
    values, vectors = torch.linalg.eigh(covariance)
    deviations = values.clamp(min=0).sqrt()
    return [(float(s), v) for s, v in zip(deviations.flip(0), vectors.mT.flip(0), strict=True) if float(s) > limit]


def _direction(vector: Tensor) -> str:
    """A unit vector, its largest component positive."""
    signed = vector * vector[vector.abs().argmax()].sign()
    return "(" + ", ".join(f"{value + 0.0:.2f}" for value in signed.tolist()) + ")"
