"""The point of a board that a camera on the tool sees most precisely.

Errors of a board's rotation and of the position of one of its points are independent for one point only, usually the
middle of the board: the position of any other point errs by the rotation's error times its distance from there. Sensor
noise is modelled as independent errors about this point. It is estimated: that of the points b of the board's plane,
z = 0 in its frame, whose position in the camera's frame is predicted best,

    min over b   sum_i w_i |t_i + R_i b - (t^_i + R^_i b)|^2 + |b|^2 s^2 / PRIOR^2,

(R_i, t_i) measured and (R^_i, t^_i) predicted poses of the board in the camera, s^2 the mean square at b = 0.
"""

from __future__ import annotations

import logging

import torch

from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.measurements.pose_frames import inverse_poses
from diffeo_calib.measurements.poses import poses_from_marks
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table import Measurements

LOG = logging.getLogger(__name__)
PRIOR_M = 0.3
"""Prior standard deviation of the point around the board's origin, m: the size of usual boards."""
SAME_BOARD_M = 1e-6
"""Boards of several sessions, brought into one frame, are farther apart than this."""


def with_best_seen_point(data: Measurements, found: Identification) -> Measurements:
    """The measurements with the point in the place of the board's origin; unchanged unless a camera is on the tool.

    Known deviations are those of the origin, and boards of several sessions have no point in common: the origin stays.

    Args:
        data: N rows. found: their geometric calibration.
    """
    if data.board is None or data.poses is None or data.lever is None:
        return data
    S = data.poses[:, :3, :3]
    origins = data.poses[:, :3, 3] + (S @ data.board[..., None])[..., 0]
    known = data.std is not None or data.rotation_std is not None
    if known or float((origins - origins[0]).abs().max()) > SAME_BOARD_M:
        return data
    predicted = poses_from_marks(found.geometry.points(data.q), data.lever)
    turned = S.mT - predicted[:, :3, :3].mT  # R_i - R^_i
    away = data.board - (inverse_poses(predicted) @ _homogeneous(origins[0]))[:, :3]
    weights = found.tails.weights.amin(1)
    size = float((weights * away.square().mean(1)).sum() / weights.sum())
    eye = torch.eye(3, dtype=away.dtype, device=away.device)
    normal = torch.einsum("n,nki,nkj->ij", weights, turned, turned) + size / PRIOR_M**2 * eye
    push, point = -torch.einsum("n,nki,nk->i", weights, turned, away), torch.zeros_like(origins[0])
    point[:2] = torch.linalg.solve(normal[:2, :2], push[:2])
    LOG.info("the board is seen best at %s mm from its origin", [round(v, 1) for v in (1e3 * point).tolist()])
    return with_attributes(data, board=data.board + (S.mT @ point))


def _homogeneous(point: torch.Tensor) -> torch.Tensor:
    return torch.cat([point, torch.ones_like(point[:1])])
