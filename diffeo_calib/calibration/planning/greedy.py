"""Greedy choice of poses: each is the one whose measurement lowers the mean variance over the targets most.

With V the main directions of the targets' covariance and C_i = V^T K(targets, x_i), a measurement at x_i lowers their
variance by

    gain_i = tr[(K_ii + R_i)^-1 C_i^T C_i],

where K is the covariance after the poses chosen before (Cohn, Ghahramani, Jordan, "Active learning with statistical
models", 1996; sequential A-optimal design for predictions). Taking a pose costs one row of K and an update of rank m.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.planning.knowledge import Knowledge

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
