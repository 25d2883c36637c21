"""What is known about the markers at many configurations before the next measurement, and the best one to measure.

    K(x, x') = F(x, x') + sum_k sign_k f_k(x) f_k(x')^T

F is the covariance of the fields. The features f hold the parameters with their priors, what earlier data tell, and
what may have moved since. A measurement at x adds m features with sign -1, the rows of L^-1 K(x, .) with
L L^T = K(x, x) + R.

Poses are chosen greedily: each is the one whose measurement lowers the mean variance over the targets most. With V the
main directions of the targets' covariance and C_i = V^T K(targets, x_i), a measurement at x_i lowers their variance by

    gain_i = tr[(K_ii + R_i)^-1 C_i^T C_i],

where K is the covariance after the poses chosen before (Cohn, Ghahramani, Jordan, "Active learning with statistical
models", 1996; sequential A-optimal design for predictions). Taking a pose costs one row of K and an update of rank m.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.common.threads import large_work
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.regression.choose import BYTES_PER_FLOAT, BYTES_PER_GIB, free_memory
from diffeo_calib.regression.conditional import NOISE_ADVICE, Features


class Knowledge:
    """Covariances of the markers at M configurations, and how measurements there change them.

    Args:
        at: first-order response of the markers there; only its fields are used.
        features: everything else, see the module, for one group of configurations after the other.
        noise: (M, m, m) covariance of a measurement at each of the configurations, m^2.
        room: how many configurations will be measured; memory is set aside for them.

    Attributes:
        blocks: (M, m, m) covariance of each configuration, m^2.

    Raises:
        InputError: the features need more memory than is free.
    """

    def __init__(self, at: Linearisation, features: Iterable[Features], noise: Tensor, room: int) -> None:
        self.noise, self._fields, self._known = noise, at.fields, 0
        self._values = self._signs = noise.new_empty(0)
        eye = torch.eye(self.m, dtype=noise.dtype, device=noise.device).expand(len(noise), self.m, self.m)
        self.blocks = self._fields.projected(eye).own_blocks()
        filled = 0
        for values, signs in features:
            if not filled:
                self._make_room(signs, room)
            count = values.shape[1] // self.m
            self._values[: self._known, filled * self.m : (filled + count) * self.m] = values
            each = values.view(self._known, count, self.m).movedim(0, 1)  # (count, k, m)
            self.blocks[filled : filled + count] += (each.mT * signs) @ each
            filled += count

    def _make_room(self, signs: Tensor, room: int) -> None:
        """Memory for the features with these signs and for those of ``room`` measured configurations."""
        self._known, coordinates = len(signs), len(self.noise) * self.m
        total = self._known + room * self.m
        needed, free = BYTES_PER_FLOAT * total * coordinates, free_memory()
        if free is not None and needed > free:
            what = f"{total} features of {len(self.noise)} configurations need more memory than is free"
            expected, got = (f"{count / BYTES_PER_GIB:.1f} GiB" for count in (needed, free))
            raise InputError.of(what, expected=expected, got=got, fix="pass fewer candidates")
        self._values = self.noise.new_empty(total, coordinates)
        self._signs = self.noise.new_full((total,), -1.0)
        self._signs[: self._known] = signs

    @property
    def m(self) -> int:
        """Coordinates of each configuration."""
        return self.noise.shape[1]

    def coordinates(self, rows: Tensor) -> Tensor:
        """Numbers of the coordinates of some configurations: (B,) -> (B m,)."""
        return (rows[:, None] * self.m + torch.arange(self.m, device=rows.device)).flatten()

    def between(self, rows: Tensor, directions: Tensor | None = None) -> Tensor:
        """K between some configurations and all, or between linear functions of these and all.

        Args:
            rows: (B,) row numbers. directions: (k, B m) linear functions.

        Returns:
            (B m, M m), or (k, M m), in m^2.
        """
        values, signs = self._values[: self._known], self._signs[: self._known]
        own = values[:, self.coordinates(rows)].T * signs  # (B m, features)
        fields = self._fields.rows(rows).gram(self._fields)
        with large_work(fields.numel()):
            if directions is not None:
                own, fields = directions @ own, directions @ fields
            return fields.addmm_(own, values)

    def measure(self, rows: Tensor) -> Tensor:
        """Take one measurement at each of some configurations: (B,) -> the features (B m, M m) that they add.

        Raises:
            NumericalError: K + R is not positive definite.
        """
        cross = self.between(rows)
        inner = cross[:, self.coordinates(rows)] + torch.block_diag(*self.noise[rows])
        factor, info = torch.linalg.cholesky_ex(0.5 * (inner + inner.T))
        if int(info):
            raise NumericalError.of("the covariance of the planned measurements is singular", fix=NOISE_ADVICE)
        with large_work(cross.numel()):
            added = torch.linalg.solve_triangular(factor, cross, upper=False)
        self._values[self._known : self._known + len(added)] = added
        self._known += len(added)
        each = added.view(len(added), -1, self.m).movedim(0, 1)  # (M, B m, m)
        self.blocks = self.blocks - each.mT @ each
        return added


MAIN_DIRECTIONS = 150
"""Directions of the targets whose variance is followed; the rest of it is far below the noise."""


class Choice(NamedTuple):
    """Chosen candidates in the order in which they were taken, and what they leave unknown.

    Args:
        order: (count,) numbers of candidates. variance: (count + 1,) mean variance of the targets' coordinates after
            0, 1, ... poses, m^2.
    """

    order: Tensor
    variance: Tensor


def choose(
    knowledge: Knowledge, targets: Tensor, candidates: Tensor, count: int, *, averaged: Tensor | None = None
) -> Choice:
    """Choose ``count`` of the candidates.

    Args:
        knowledge: before the first pose; it takes the measurements at the chosen poses.
        targets: (T,) row numbers of the configurations where the robot shall be known.
        candidates: (C,) row numbers of the configurations that can be measured, at least ``count``.
        averaged: (r, m) linear functions of a configuration's coordinates whose variance is reported; all by default.
    """
    m, rows = knowledge.m, knowledge.coordinates(targets)
    own = knowledge.between(targets)[:, rows]
    _, V = torch.linalg.eigh(0.5 * (own + own.T))
    main = V[:, -MAIN_DIRECTIONS:].T  # (k, T m)
    columns = knowledge.coordinates(candidates)
    C = knowledge.between(targets, main)[:, columns].T.contiguous()  # (C m, k), transposed
    kind = torch.eye(m, dtype=C.dtype, device=C.device) if averaged is None else averaged
    variance = [(kind @ knowledge.blocks[targets] @ kind.mT).diagonal(dim1=1, dim2=2).mean()]
    open_ = torch.ones(len(candidates), dtype=torch.bool, device=C.device)
    order = []
    for _ in range(count):
        best = int(torch.where(open_, _gains(knowledge, C, candidates), -torch.inf).argmax())
        order.append(best)
        open_[best] = False
        added = knowledge.measure(candidates[best : best + 1])  # (m, M m)
        C.addmm_(added[:, columns].T, added[:, rows] @ main.T, alpha=-1.0)
        seen = kind @ added[:, rows].view(m, len(targets), m, 1)  # (m, T, r, 1)
        variance.append(variance[-1] - seen.square().sum(0).mean())
    return Choice(torch.tensor(order, dtype=torch.int64, device=C.device), torch.stack(variance).clamp(min=0))


def _gains(knowledge: Knowledge, C: Tensor, candidates: Tensor) -> Tensor:
    """Fall of the targets' summed variance by a measurement at each candidate: (C,) m^2."""
    each = C.view(len(candidates), knowledge.m, -1)  # (C, m, k)
    total = knowledge.blocks[candidates] + knowledge.noise[candidates]
    return torch.linalg.solve(total, each @ each.mT).diagonal(dim1=1, dim2=2).sum(1)
