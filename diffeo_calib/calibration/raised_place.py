"""Whether it matters that sockets lie near a plane: the error that the model expects with one place raised.

All sockets on one table need not leave anything open: a tool that tilts shows errors of all joints, and the rows reach
as many joint values as with a raised block. So the place is raised in the model: joint values that bring the ball
there, and what rows with these would tell.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.campaign import LIMITS as PATH_LIMITS
from diffeo_calib.calibration.sockets import FoundSockets
from diffeo_calib.common.errors import sentence, warn_user
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.conditional import diagonal_blocks

RAISED = 0.2
"""Distance of the new place from the plane, relative to the largest distance of a socket from the base."""
PLACE_DEVIATION_M = 0.1
"""What is known of the new place before its rows are measured: nothing."""
WORTH = 0.8
"""Expected error with the new place, relative to that without it, below which it is advised."""
STEPS, REACHED_M, LARGEST_STEP_RAD = 30, 1e-4, 0.3


def warn_of_flat_places(fitted: FittedMap, data: Measurements, found: FoundSockets) -> None:
    """Warn of sockets near a plane if one place away from it would make the expected error smaller.

    Args:
        fitted: the map, without rigid motions. data: its rows, with measured positions of the ball. found: the sockets.
    """
    _, s, axes = torch.linalg.svd(found.positions - found.positions.mean(0), full_matrices=False)
    reach = float(found.positions.norm(dim=1).max())
    if fitted.workspace is None or len(s) < 3 or float(s[2]) > PATH_LIMITS.flat * reach * len(found.positions) ** 0.5:
        return
    step = RAISED * reach * axes[2]
    errors = [error for sign in (1.0, -1.0) if (error := with_raised_place(fitted, data, sign * step)) is not None]
    now = found.workspace_deviation
    if errors and min(errors) < WORTH * now:
        what = "the sockets lie near a plane"
        expected = (
            f"about {1e3 * min(errors):.2g} mm of error with one place {1e3 * RAISED * reach:.0f} mm away from it"
        )
        fix = "raise or tilt the block at one place, and tilt the tool"
        warn_user(sentence(what, expected=expected, got=f"{1e3 * now:.2g} mm", fix=fix))


def with_raised_place(fitted: FittedMap, data: Measurements, away: Tensor) -> float | None:
    """Root mean square error, m, of the ball that the model expects over its workspace with one more place.

    Args:
        fitted: the map, without rigid motions. data: its rows, with measured positions of the ball.
        away: (3,) from the place of most rows to the new one, m.

    Returns:
        None if the robot does not reach it.
    """
    if data.places is None or data.socket is None or fitted.workspace is None:
        return None
    place = int(torch.bincount(data.places).argmax())
    rows = (data.places == place).nonzero()[:, 0]
    q, there = _reached(fitted, data.q[rows], data.points[rows, -1] + away)
    if int(there.sum()) < len(rows) / 2:
        return None
    socket = data.socket[rows][there]
    at, new = fitted.geodesic.linearise(fitted.workspace), fitted.geodesic.linearise(q[there])
    own, between, m = fitted.covariance_between(new), fitted.covariance_between(at, new), fitted.m
    same = (socket[:, None] == socket).to(own) * PLACE_DEVIATION_M**2
    noise = torch.block_diag(*fitted.new_noise.expand(len(socket), -1, -1))
    K = own + noise + torch.kron(same, torch.eye(m, dtype=own.dtype, device=own.device))
    gain = between @ torch.linalg.solve(K, between.mT)
    after = fitted.covariance_at(at) - diagonal_blocks(gain, len(fitted.workspace))
    return float(after.diagonal(dim1=1, dim2=2).sum(1).mean().clamp(min=0).sqrt())


def _reached(fitted: FittedMap, q: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Joint values (N, n) near q that bring the ball to points (N, 3), m, and which of them (N,) do."""
    for _ in range(STEPS):
        miss = target - fitted(q).detach()[:, -3:]
        step = (torch.linalg.pinv(fitted.jacobian(q).detach()[:, -3:]) @ miss[..., None])[..., 0]
        q = q + step * (LARGEST_STEP_RAD / step.abs().amax(1, keepdim=True).clamp(min=LARGEST_STEP_RAD))
    return q, (target - fitted(q).detach()[:, -3:]).norm(dim=1) < REACHED_M
