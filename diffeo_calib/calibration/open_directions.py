"""The deviations that a model deserves where its measurements leave something open.

Scales are chosen, and the model is fitted, with base and markers near their registration and with joint errors of the
size that the rows show. Where the rows cannot show them (a tool that never turns, joints that stand still) this is no
knowledge. The covariances of the model then start from what is known of any robot and tool; its mean stays.

Rows that leave the place of base or markers open show the errors of few joints, and the size that they have in common
is known as poorly: that of all joints is then no smaller than that of any robot.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.campaign import undetermined_places
from diffeo_calib.calibration.identification.identification import Identification, Prior
from diffeo_calib.calibration.identification.registration import BASE_DEVIATION_M, BASE_DEVIATION_RAD
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.measurements.table import Measurements

STILL_RANGE = 0.05
"""Range of a joint, rad or m, below which the rows do not show its errors."""
BASE_PER_DEVIATION = 3.0
"""The base moves along with an undetermined marker and must not hold it."""


def with_open_directions(fitted: FittedMap, measurements: Measurements, registration: Identification) -> FittedMap:
    """The same map whose covariances hold in directions that the rows leave open; the map itself if there are none.

    Args:
        fitted: the fitted model of a robot. measurements: what it was fitted to.
        registration: base and markers by themselves, with deviations.
    """
    nominal = fitted.geodesic.spec.nominal
    before = fitted.geodesic.spec.prior_variance
    if not isinstance(nominal, GeometryMap):
        return fitted
    some_open = bool(undetermined_places(nominal.geometry.chain, measurements, registration))
    variance = _variances(before, nominal, registration, measurements.q, every_joint=some_open)
    if torch.equal(variance, before):
        return fitted
    return FittedMap(fitted.geodesic.with_prior(variance), fitted.noise, fitted.data, fitted.new_noise)


def _variances(
    before: Tensor, nominal: GeometryMap, registration: Identification, q: Tensor, *, every_joint: bool
) -> Tensor:
    """Prior variances (K,) of theta, none smaller than before; ``every_joint``: those of all joints count as unseen."""
    parts, chain, prior = nominal.geometry.slices, nominal.geometry.chain, Prior()
    found = registration.deviations.to(before)
    after = before.clone()
    most = before.new_tensor([BASE_DEVIATION_M] * 3 + [BASE_DEVIATION_RAD] * 3)
    base = torch.minimum(BASE_PER_DEVIATION * found[parts["base"]], most)
    after[parts["base"]] = torch.maximum(before[parts["base"]], base.square())
    after[parts["tool"]] = torch.maximum(before[parts["tool"]], found[parts["tool"]].square())
    still = (q.amax(0) - q.amin(0)) < STILL_RANGE
    driven = (chain.coupling.to(before) != 0) & ~still  # (n_all, n)
    twist = before.new_tensor([prior.translation] * 3 + [prior.rotation] * 3)
    joints = after[parts["joints"]].view(-1, 6)
    seen = driven.any(1)[:, None] & (not every_joint)
    after[parts["joints"]] = torch.where(seen, joints, torch.maximum(joints, twist.square())).flatten()
    return after
