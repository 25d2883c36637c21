"""Control points of a coarse model: a few of the measured configurations, chosen to explain all of them."""

from __future__ import annotations

from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.flows.integrators import RK4
from diffeo_calib.regression.conjugate_gradients import pivots


def choose_controls(problem: Problem, count: int) -> Tensor:
    """Row numbers of the measured configurations that carry momenta, in increasing order: (M,).

    The rows are the pivots of a randomly pivoted Cholesky factorisation of the tangent model's covariance G.

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
    tangent = at_rest.deform(at_rest.zero(), RK4(1)).linearise(problem.x)
    return pivots(tangent, count).sort().values
