"""Rows of several kinds as one table of numbers around a geometric calibration.

A row reports R numbers, those of its bodies side by side, some of which are absent: coordinates of all markers, or the
numbers of a reading in the place of the first body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.calibration.placing.readings import ReadingDevices
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.observation import LinearFunctionals, Part, Stacked


@dataclass(frozen=True)
class _Numbers:
    """What N rows report: numbers (N, R) in m, which are visible, their known covariances (N, R, R) in m^2; weights and
    kinds (N, B) of their bodies; and what is observed."""

    y: Tensor
    visible: Tensor
    known: Tensor
    weights: Tensor
    kinds: Tensor
    parts: list[Part]

    @classmethod
    def none(cls, like: Tensor, bodies: int, size: int) -> _Numbers:
        """All absent, for rows (N, n)."""
        N, R = len(like), bodies * size
        y, kinds = like.new_zeros(N, R), torch.zeros(N, bodies, dtype=torch.int64, device=like.device)
        return cls(y, torch.zeros_like(y, dtype=torch.bool), y.new_zeros(N, R, R), y.new_ones(N, bodies), kinds, [])

    def fill_coordinates(self, own: TangentData, rows: Tensor) -> None:
        """Coordinates of the first markers in some rows (M,)."""
        m, noise = own.y.shape[1], own.noise_model
        whole, eye = torch.arange(m, device=rows.device), torch.eye(m, dtype=own.y.dtype, device=own.y.device)
        axes = eye.expand(len(rows), m, m)
        self.parts.append(Part(rows, whole, whole, LinearFunctionals(axes, torch.zeros_like(own.y))))
        self.y[rows], self.visible[rows], self.weights[rows] = own.y, own.visible, own.tails.weights
        if noise.known is not None:
            self.known[rows] = noise.known
        if noise.kinds is not None:
            self.kinds[rows] = noise.kinds

    def fill_readings(self, one: ReadingDevices, ball: Tensor, kind: int) -> None:
        """Readings of one kind, a kind of noise, of the ball: numbers (3,) of its coordinates."""
        place = one.rows[:, None], one.numbers
        self.parts.append(Part(one.rows, ball, one.numbers, one.devices.observation(one.device)))
        self.y[place], self.visible[place] = one.devices.values(one.data), True
        self.kinds[one.rows, 0] = kind
        if one.data.std is not None:
            metres = one.devices.metres[one.device][:, None]
            self.known[one.rows[:, None], one.numbers, one.numbers] = (one.data.std * metres).square()


def stacked(
    nominal: GeometryMap,
    theta: Tensor,
    q: Tensor,
    tails: Tails,
    readings: Sequence[ReadingDevices],
    *,
    own: TangentData | None,
    own_rows: Tensor | None,
) -> TangentData:
    """Rows of several kinds around a geometric calibration.

    Args:
        nominal: k0 of all markers, the ball last. theta: (K,) its parameters. q: (N, n) configurations.
        tails: of the geometric calibration: of the coordinates, or of the readings in the order of their tables.
        readings: the rows of readings, by kind.
        own: the rows that tell coordinates by themselves, own_rows: (M,) their numbers; None if there are none.
    """
    dim = 3 * nominal.geometry.markers
    bodies, size, first = (
        (1, 0, 0) if own is None else (own.noise_model.bodies, own.noise_model.size, own.noise_model.kind_count)
    )
    size = max(size, *(one.data.values.shape[1] for one in readings))
    found = _Numbers.none(q, bodies, size)
    if own is not None and own_rows is not None:
        found.fill_coordinates(own, own_rows)
    else:
        found.weights[torch.cat([one.rows for one in readings])] = tails.weights
    for kind, one in enumerate(readings, first):
        found.fill_readings(one, torch.arange(dim - 3, dim, device=q.device), kind)
    noise = NoiseModel(
        bodies,
        size,
        found.known if bool(found.known.any()) else None,
        visible=None if bool(found.visible.all()) else found.visible,
        kinds=found.kinds if int(found.kinds.max()) else None,
    )
    observe = Stacked(len(q), bodies * size, dim, found.parts)
    return TangentData(
        nominal, theta, q, found.y, noise, replace(tails, weights=found.weights), observe=observe, beside=own
    )
