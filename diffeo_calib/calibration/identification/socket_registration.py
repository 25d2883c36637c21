"""Find the ball on the tool and the sockets that held it, in the robot's base, from joint values alone: closed form.

In all rows of socket s the ball c, carried by the tip's poses (R_i, t_i), is at one point, so that

    (R_i - mean_s R) c + (t_i - mean_s t) = 0,    p_s = mean_s (R_i c + t_i),

linear in the ball c and then in the sockets p_s. Rows are weighed by their distance in units of the median, so that
rows in a wrong socket lose their influence.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import LIMITS, Identification, Prior
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.placement import TOOL_DEVIATION_M, UNDETERMINED_MOTION_M
from diffeo_calib.robots.tree import Tree

ROUNDS = 30
"""Most rounds of weighing rows."""
SETTLED = 1e-6
"""Largest change of a weight at which these rounds end."""
MEDIANS = 2.0
"""Distance, in medians, at which a row has half its weight."""


@dataclass(frozen=True, eq=False)
class SocketRegistration:
    """Ball and sockets of a robot without errors.

    Args:
        identification: geometry with the ball as its marker; where the base is not known, it is the measuring frame.
        positions: (S, 3) the sockets in the measuring frame, m.
        distances: (N,) from the ball to its socket, m.
        tilt: (3,) root mean square motion of the ball's place, per unit of its offset from the tip, by turns of the
            tool in the sockets, along three principal directions, largest first: 0 where the tool never turns.
    """

    identification: Identification
    positions: Tensor
    distances: Tensor
    tilt: Tensor


def register_sockets(robot: Tree | Geometry, q: Tensor, socket: Tensor) -> SocketRegistration:
    """Find ball and sockets, joint errors untouched.

    Args:
        robot: n joints, with one tip; or a geometry, whose base and joint errors are kept: places are then in its
            measuring frame. q: (N, n) joint values, rad or m. socket: (N,) number of the socket of each row.
    """
    bare = robot.with_tool(robot.tool[:1], robot.on[:1]) if isinstance(robot, Geometry) else Geometry.nominal(robot, 1)
    poses = bare.marker_poses(q)[:, 0]
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    weights = torch.ones_like(t[:, 0])
    for _ in range(ROUNDS):
        A = R - _means(R, socket, weights)[socket]
        b = t - _means(t, socket, weights)[socket]
        root = weights.sqrt()
        ball = _determined_part((root[:, None, None] * A).flatten(0, 1), -(root[:, None] * b).flatten())
        distances = (A @ ball + b).norm(dim=1)
        before, weights = weights, median_weights(distances)
        if float((weights - before).abs().max()) < SETTLED:
            break
    seen = R @ ball + t
    tilt = torch.linalg.svdvals(A.flatten(0, 1)) / len(A) ** 0.5
    found = _identification(bare.with_tool(ball[None]), A, distances, int(weights.numel()))
    return SocketRegistration(found, _means(seen, socket, weights), distances, tilt)


def socket_means(points: Tensor, socket: Tensor) -> Tensor:
    """The middle (S, 3) of points (N, 3) in each socket; rows far from it hardly count; NaN without rows."""
    weights = torch.ones_like(points[:, 0])
    for _ in range(ROUNDS):
        means = _means(points, socket, weights)
        weights = median_weights((points - means[socket]).norm(dim=1))
    return means


def median_weights(distances: Tensor) -> Tensor:
    """Weights (N,) of rows by their distances (N,) in medians: 1 / (1 + (d / 2 medians)^2)."""
    scale = MEDIANS * distances.median().clamp(min=LIMITS.smallest_noise_m)
    return 1.0 / (1.0 + (distances / scale).square())


def _means(values: Tensor, socket: Tensor, weights: Tensor) -> Tensor:
    """Weighted means of values (N, ...) of each socket: (S, ...)."""
    count = int(socket.max()) + 1
    shape = (-1, *[1] * (values.ndim - 1))
    total = values.new_zeros(count, *values.shape[1:]).index_add(0, socket, values * weights.view(shape))
    return total / weights.new_zeros(count).index_add(0, socket, weights).view(shape)


def _determined_part(A: Tensor, b: Tensor) -> Tensor:
    """The smallest x that minimises |A x - b|: directions that the rows leave open stay at the tip."""
    U, s, Vt = torch.linalg.svd(A, full_matrices=False)
    kept = s > UNDETERMINED_MOTION_M * len(A) ** 0.5
    return Vt[kept].mT @ ((U[:, kept].mT @ b) / s[kept])


def _identification(geometry: Geometry, A: Tensor, distances: Tensor, rows: int) -> Identification:
    """The registration as other registrations are described. Errors of the robot do not average out over its rows."""
    rms = float(distances.square().mean().sqrt())
    median = float(distances.median())
    noise = max(median / sqrt(2.37), LIMITS.smallest_noise_m)
    white = A.flatten(0, 1) * TOOL_DEVIATION_M / (noise * sqrt(rows))
    eye = torch.eye(3, dtype=A.dtype, device=A.device)
    covariance = A.new_zeros(geometry.size, geometry.size)
    tool = geometry.slices["tool"]
    covariance[tool, tool] = TOOL_DEVIATION_M**2 * torch.linalg.inv(eye + white.mT @ white)
    status = f"spread within sockets {1e3 * rms:.4g} mm RMS, median {1e3 * median:.4g} mm."
    theta, tails = A.new_zeros(geometry.size), Tails.none(rows, 1, device=A.device)
    return Identification(geometry, rms, noise, covariance, 0, status, theta, Prior(), tails)
