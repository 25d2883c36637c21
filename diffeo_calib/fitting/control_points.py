"""Control points of a coarse model: a few of the measured configurations, chosen to explain all of them."""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.flows.integrators import RK4
from diffeo_calib.regression.conjugate_gradients import pivots

SAMPLE_COORDINATES = 8000
"""Measured coordinates of the random rows that stand for all rows where these are many: in the choice of control
points, and in the fit that starts the fit of all rows."""


def sample(problem: Problem) -> Tensor | None:
    """Sorted numbers of random rows that stand for all rows of a problem; None if there are not so many."""
    count = max(1, SAMPLE_COORDINATES // problem.y.shape[1])
    if len(problem.x) <= count:
        return None
    drawn = torch.randperm(len(problem.x), generator=seeded(0), device=HOST)[:count]
    return drawn.sort().values.to(problem.x.device)


def choose_controls(problem: Problem, count: int) -> Tensor:
    """Row numbers of the measured configurations that carry momenta, in increasing order: (M,).

    The rows are the pivots of a randomly pivoted Cholesky factorisation of the tangent model's covariance G, of a
    sample of the rows if there are many and the sample is larger than ``count``.

    Args:
        problem: a problem with N data.
        count: M, from 1 to N.

    Raises:
        InputError: ``count`` is out of range.
    """
    if not 1 <= count <= len(problem.x):
        expected = f"1 to {len(problem.x)}, the number of measured configurations"
        raise InputError.of("`controls`", expected=expected, got=count)
    at_rest = problem.with_controls(problem.x[:1])  # one control without momentum, so that flows are the identity
    rows = sample(problem)
    if rows is None or len(rows) <= count:
        rows = torch.arange(len(problem.x), device=problem.x.device)
    tangent = at_rest.deform(at_rest.zero(), RK4(1)).linearise(problem.x[rows])
    return rows[pivots(tangent, count)].sort().values
