"""Rows in sockets that took no part in a fit, each as the model and the other rows of its socket predict it.

No row says where its socket is: it is an error with a wide prior that the rows of the socket share. With K the
covariance of all errors, the model's posterior and noise included, leaving out row i is closed form:

    mu = K^-1 y,    error of row i = [(K^-1)_ii]^-1 mu_i,    covariance [(K^-1)_ii]^-1.
"""

from __future__ import annotations

import torch

from diffeo_calib.calibration.findings import FALSE_ALARM_PROBABILITY, Outlier, found_outliers
from diffeo_calib.calibration.identification.socket_registration import socket_means
from diffeo_calib.calibration.placing.sockets import PLACE_DEVIATION_M
from diffeo_calib.common.quantiles import chi2_above, chi2_median
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.conditional import diagonal_blocks

FEWEST_BESIDE = 2
"""Rows of a socket besides one that are needed to judge it."""


def contradicted_in_sockets(model: CalibratedKinematics, data: Measurements) -> list[Outlier]:
    """Rows whose ball the model excludes from the middle of their socket, the worst first.

    The median distance says in which unit the model's deviations are to be taken: they hold for errors elsewhere, and
    the rows of a socket share most of these.

    Args:
        model: of rows in sockets. data: rows in sockets that took no part in its fit; rows of other kinds are left out.
    """
    if data.places is None or not bool((data.places >= 0).any()):
        return []
    resting = data.socket_rows().with_sockets_of_rows()
    if resting.socket is None:
        return []
    seen, socket = model.map, resting.socket.to(resting.q.device)
    predicted = seen(resting.q).detach()[:, -3:]
    middles = socket_means(predicted, socket)[socket]
    at = seen.geodesic.linearise(resting.q)
    last = torch.eye(seen.m, dtype=predicted.dtype, device=predicted.device)[-3:].expand(len(resting), -1, -1)
    own = seen.covariance_between(at.projected(last))
    eye = torch.eye(3, dtype=own.dtype, device=own.device)
    same = (socket[:, None] == socket).to(own)
    K = own + torch.kron(PLACE_DEVIATION_M**2 * same, eye)
    K = K + torch.block_diag(*seen.new_noise[-3:, -3:].expand(len(resting), -1, -1))
    inverse = torch.linalg.inv(K)
    mu = (inverse @ (middles - predicted).flatten()).view(-1, 3)
    errors = torch.linalg.solve(diagonal_blocks(inverse, len(resting)), mu[..., None])[..., 0]
    squares = (mu * errors).sum(1)
    judged = same.sum(1) > FEWEST_BESIDE
    if not bool(judged.any()):
        return []
    size = float(squares[judged].median()) / chi2_median(3)
    limit = size * chi2_above(FALSE_ALARM_PROBABILITY / int(judged.sum()), 3)
    bad = torch.zeros(len(resting), model.markers, dtype=torch.bool, device=own.device)
    bad[:, -1] = judged & (squares > limit)
    distances = errors.norm(dim=1)[:, None].expand(-1, model.markers)
    placed = with_attributes(resting, points=middles[:, None])
    return found_outliers(model, placed.with_hidden_markers(model.markers - 1), bad, distances)
