"""Rows of several kinds in one layout: the numbers of every row, those of its first body first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.placing.readings import ReadingDevices
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.maps.observation import LinearFunctionals, Part, Stacked


class Told(NamedTuple):
    """Rows that tell the coordinates of the first markers: their numbers (M,), values (M, m), m, and noise."""

    rows: Tensor
    y: Tensor
    noise_model: NoiseModel


class StackedRows(NamedTuple):
    """N rows: what they report (N, R), m, zero where absent, how they were measured, and what that is of the points."""

    y: Tensor
    noise_model: NoiseModel
    observe: Stacked


def stacked(q: Tensor, own: Told | None, readings: Sequence[ReadingDevices], dim: int) -> StackedRows:
    """Rows that tell coordinates, and readings of the last marker, in one layout.

    Args:
        q: (N, n) configurations of all rows. own: the rows that tell coordinates. readings: devices and their rows.
        dim: coordinates m of the points of a row.
    """
    N, size = len(q), max([one.data.values.shape[1] for one in readings] + ([own.noise_model.size] if own else []))
    bodies = own.noise_model.bodies if own else 1
    y, visible = q.new_zeros(N, bodies * size), torch.zeros(N, bodies * size, dtype=torch.bool, device=q.device)
    known = q.new_zeros(N, bodies * size, bodies * size)
    kinds, parts = torch.zeros(N, bodies, dtype=torch.int64, device=q.device), []
    if own is not None:
        rows, m = own.rows, own.y.shape[1]
        parts.append(coordinates_of(rows, m, q))
        y[rows], visible[rows] = own.y, own.noise_model.coordinates(own.y)
        if own.noise_model.known is not None:
            known[rows] = own.noise_model.known
        if own.noise_model.kinds is not None:
            kinds[rows] = own.noise_model.kinds
    first = 0 if own is None else own.noise_model.kind_count
    ball = torch.arange(dim, device=q.device)[-3:]
    for kind, one in enumerate(readings, first):
        place = one.rows[:, None], one.numbers
        parts.append(Part(one.rows, ball, one.numbers, one.devices.observation(one.device)))
        y[place], visible[place] = one.devices.values(one.data), True
        kinds[one.rows, 0] = kind
        if one.data.std is not None:
            metres = one.devices.metres[one.device][:, None]
            known[one.rows[:, None], one.numbers, one.numbers] = (one.data.std * metres).square()
    noise = NoiseModel(
        bodies,
        size,
        known if bool(known.any()) else None,
        None if own is None else _of_rows(own.noise_model.modes, own.rows, N),
        0.0 if own is None else own.noise_model.slack,
        visible=None if bool(visible.all()) else visible,
        kinds=kinds if int(kinds.max()) else None,
    )
    return StackedRows(y, noise, Stacked(N, bodies * size, dim, parts))


def coordinates_of(rows: Tensor, m: int, like: Tensor) -> Part:
    """Rows (M,) that report the first m coordinates as their first m numbers."""
    eye, whole = torch.eye(m, dtype=like.dtype, device=like.device), torch.arange(m, device=like.device)
    return Part(rows, whole, whole, LinearFunctionals(eye.expand(len(rows), m, m), like.new_zeros(len(rows), m)))


def _of_rows(values: Tensor | None, rows: Tensor, count: int) -> Tensor | None:
    """Values (M, ...) of some rows as those of all, zero elsewhere: (N, ...)."""
    if values is None:
        return None
    found = values.new_zeros(count, *values.shape[1:])
    found[rows] = values
    return found
