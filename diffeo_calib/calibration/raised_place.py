"""Whether it matters that sockets lie near a plane: the error that the model expects with one place raised.

All sockets on one table need not leave anything open: a tool that tilts shows errors of all joints, and the rows reach
as many joint values as with a raised block. So the place is raised in the model: joint values that bring the ball
there, and what rows with these would tell.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.campaign import LIMITS as PATH_LIMITS
from diffeo_calib.common.errors import sentence, warn_user
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.regression.conditional import diagonal_blocks

RAISED = 0.2
"""Distance of the new place from the plane, relative to the largest distance of a socket from the base."""
PLACE_DEVIATION_M = 0.1
"""What is known of the new place before its rows are measured: nothing."""
WORTH = 0.8
"""Expected error with the new place, relative to that without it, below which it is advised."""
STEPS, REACHED_M, LARGEST_STEP_RAD = 30, 1e-4, 0.3


def warn_of_flat_places(fitted: FittedMap, positions: Tensor, socket: Tensor, place: Tensor, now: float) -> None:
    """Warn of sockets near a plane if one place away from it would make the expected error smaller.

    Args:
        fitted: the map, without rigid motions. positions: (S, 3) of the sockets, m.
        socket: (N,) number of the socket of each row of the map, -1 for none. place: (S,) the place of each socket.
        now: the expected error, m.
    """
    _, s, axes = torch.linalg.svd(positions - positions.mean(0), full_matrices=False)
    reach = float(positions.norm(dim=1).max())
    if len(s) < 3 or float(s[2]) > PATH_LIMITS.flat * reach * len(positions) ** 0.5:
        return
    rows = (socket >= 0).nonzero()[:, 0]
    usual = place[socket[rows]].mode().values
    rows = rows[place[socket[rows]] == usual]
    resting = fitted.x[rows], positions[socket[rows]], socket[rows]
    step = RAISED * reach * axes[2]
    tried = (with_raised_place(fitted, *resting, sign * step) for sign in (1.0, -1.0))
    errors = [error for error in tried if error is not None]
    if errors and min(errors) < WORTH * now:
        what = "the sockets lie near a plane"
        expected = (
            f"about {1e3 * min(errors):.2g} mm of error with one place {1e3 * RAISED * reach:.0f} mm away from it"
        )
        fix = "raise or tilt the block at one place, and tilt the tool"
        warn_user(sentence(what, expected=expected, got=f"{1e3 * now:.2g} mm", fix=fix))


def with_raised_place(fitted: FittedMap, q: Tensor, points: Tensor, socket: Tensor, away: Tensor) -> float | None:
    """Root mean square error, m, of the ball that the model expects over its workspace with one more place.

    Args:
        fitted: the map, without rigid motions. q: (M, n) configurations, points: (M, 3) m and socket: (M,) numbers of
            the rows at one place. away: (3,) from there to the new one, m.

    Returns:
        None if the robot does not reach it.
    """
    q, there = _reached(fitted, q, points + away)
    if int(there.sum()) < len(there) / 2:
        return None
    socket = socket[there]
    at, new = fitted.geodesic.linearise(fitted.everywhere), fitted.geodesic.linearise(q[there])
    own, between, m = fitted.covariance_between(new), fitted.covariance_between(at, new), fitted.m
    same = (socket[:, None] == socket).to(own) * PLACE_DEVIATION_M**2
    noise = torch.block_diag(*fitted.new_noise.expand(len(socket), -1, -1))
    K = own + noise + torch.kron(same, torch.eye(m, dtype=own.dtype, device=own.device))
    gain = between @ torch.linalg.solve(K, between.mT)
    after = fitted.covariance_at(at) - diagonal_blocks(gain, len(fitted.everywhere))
    return float(after.diagonal(dim1=1, dim2=2).sum(1).mean().clamp(min=0).sqrt())


def _reached(fitted: FittedMap, q: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Joint values (N, n) near q that bring the ball to points (N, 3), m, and which of them (N,) do."""
    for _ in range(STEPS):
        miss = target - fitted(q).detach()[:, -3:]
        step = (torch.linalg.pinv(fitted.jacobian(q).detach()[:, -3:]) @ miss[..., None])[..., 0]
        q = q + step * (LARGEST_STEP_RAD / step.abs().amax(1, keepdim=True).clamp(min=LARGEST_STEP_RAD))
    return q, (target - fitted(q).detach()[:, -3:]).norm(dim=1) < REACHED_M
