"""Configurations at which a deformed map takes given values."""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.common.errors import NumericalError, sentence
from diffeo_calib.maps.deformation import Deformation

INVERSE_ITERATIONS = 50
LONGEST_JOINT_STEP = 0.5
"""Longest step of a joint in the search for an inverse, rad or m."""
SETTLED_JOINT_STEP = 1e-12
"""The search for an inverse has settled when no joint moves by more than this, rad or m."""
MAX_INVERSE_RESIDUAL = 1e-9
"""Largest distance from a target, m, at which it counts as reached."""


def inverse_of(deformation: Deformation, target: Tensor, x: Tensor) -> Tensor:
    """Configurations x with k1(x) = target: compensation of a commanded target.

    Gauss-Newton with the exact Jacobian and steps of minimal norm. With more joints than coordinates the result is the
    solution nearest to the start to first order; with more coordinates than joints (several markers) it is the
    least-squares solution. Joint limits are not enforced: for the commands of a robot use ``dc.compensate``.

    Args:
        deformation: k1. target: (M, m) in m. x: (M, n) where the search starts.

    Returns:
        (M, n).

    Raises:
        NumericalError: some target is out of reach from its start, or the search did not settle.
    """
    residual = target
    for _ in range(INVERSE_ITERATIONS):
        residual = target - deformation(x)
        step = (torch.linalg.pinv(deformation.jacobian(x), rtol=1e-8) @ residual[:, :, None])[:, :, 0]
        if not bool((step.abs() > SETTLED_JOINT_STEP).any()):
            break
        x = x + step * (LONGEST_JOINT_STEP / step.abs().amax(1, keepdim=True).clamp(min=LONGEST_JOINT_STEP))
    else:
        raise NumericalError(_unreachable(residual, f"the search has not settled after {INVERSE_ITERATIONS} steps"))
    if target.shape[1] <= x.shape[1] and bool((residual.abs() > MAX_INVERSE_RESIDUAL).any()):
        raise NumericalError(_unreachable(residual, "the nearest configuration does not reach it"))
    return x


def _unreachable(residual: Tensor, what: str) -> str:
    """Message naming the target with the largest residual."""
    miss = residual.norm(dim=1)
    row = int(miss.argmax())
    return sentence(
        f"no configuration was found for target {row}: {what}",
        got=f"a distance of {float(miss[row]):.2e} m",
        fix="start nearer to the target, which may be out of reach or near a singularity",
    )
