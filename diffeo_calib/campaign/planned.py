"""The next poses of a campaign: greedily those that lower the variance over the target most, and a forecast.

The gain of a candidate is that of planning/knowledge.py, with the covariance by the accepted rows. Each candidate is
measured like the last row of the campaign, whatever that was; if that was an image, where its camera sees the board.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, log

import torch
from torch import Tensor

from diffeo_calib.campaign.model import CampaignModel

MOST_STEPS = 60
"""Poses that a forecast chooses; beyond them the variance is extrapolated as a power of their number."""
MOST_ROWS = 10_000


@dataclass(frozen=True, eq=False)
class Next:
    """Poses to measure next.

    Args:
        q: (count, n) rad or m: poses to measure again, then the most helpful first.
        rows: numbers of these among the candidates.
        expected: expected error over the target after 0, 1, ... of the best poses, m.
        needed: rows until the expected error is below the goal; None without a goal, or if none is in sight.
        again: rows whose poses are to be measured again.
    """

    q: Tensor
    rows: list[int]
    expected: list[float]
    needed: int | None
    again: Sequence[int] = ()


def planned(model: CampaignModel, count: int, goal: float | None) -> Next:
    """The next poses; arguments as of :meth:`Campaign.next`."""
    candidates = model.asked[0]
    steps = min(int(model.open.sum()), max(count, MOST_STEPS if goal is not None else 0))
    rows, variances = _greedy(model, steps)
    expected = [(3 * value) ** 0.5 for value in variances]
    chosen = rows[:count]
    return Next(candidates[chosen], chosen, expected, None if goal is None else _needed(expected, goal, model.count))


def _greedy(model: CampaignModel, steps: int) -> tuple[list[int], list[float]]:
    """Candidates in the order of their gains, and the mean variance over the target before and after each, m^2."""
    J, options, K = model.compared, model.posterior.asked[1], model.known()
    size, M = J.shape[1], len(options)
    C, own = J @ K[:size, size:], K[size:, size:] + options.noises
    r = len(own) // M  # all are measured like one row
    variances, order = [float(((J @ K[:size, :size]) * J).sum(1).mean())], list[int]()
    index, closed = torch.arange(M, device=K.device), (~model.open).nonzero()[:, 0].tolist()
    for _ in range(steps):
        each = C.view(len(C), M, r).transpose(0, 1)  # (M, targets, r)
        gains = torch.linalg.solve(own.view(M, r, M, r)[index, :, index], each.mT @ each).diagonal(dim1=1, dim2=2)
        out = torch.tensor([*closed, *order], dtype=torch.int64, device=K.device)
        gains = gains.sum(1).index_fill(0, out, -torch.inf)
        best = int(gains.argmax())
        mine = slice(best * r, best * r + r)
        low = torch.linalg.cholesky(own[mine, mine])
        by = torch.linalg.solve_triangular(low, own[mine], upper=False)
        C, own = C - torch.linalg.solve_triangular(low, C[:, mine].T, upper=False).T @ by, own - by.T @ by
        own[mine, mine] = torch.eye(r, dtype=own.dtype, device=own.device)  # it is known now
        order.append(best)
        variances.append(max(variances[-1] - float(gains[best]) / len(J), 0.0))
    return order, variances


def _needed(expected: list[float], goal: float, count: int) -> int | None:
    """Rows until the expected error is below a goal, extrapolated by the last half of the steps."""
    found = next((step for step, value in enumerate(expected) if value <= goal), None)
    if found is not None or len(expected) < 3 or expected[-1] <= 0:
        return found
    half, last = len(expected) // 2, len(expected) - 1
    power = log(expected[half] / expected[last]) / log((count + last) / (count + half))
    if power <= 0:
        return None
    total = (count + last) * (expected[-1] / goal) ** (1 / power)
    return ceil(total - count) if total < MOST_ROWS else None
