"""The errors that a calibrated model expects over the joint ranges of its rows, and what they consist of.

Without a measuring device rigid motions that remain in the fields say nothing about the robot, and are taken out of all
covariances (regression/rigid_motions.py). A device that measured other rows holds the frame.

Scales are chosen, and the model is fitted, with base and markers near their registration and with joint errors of the
size that the rows show. Where the rows cannot show them (a tool that never turns, joints that stand still) this is no
knowledge. The covariances of the model then start from what is known of any robot and tool; its mean stays.

Joints sag under the weight of the robot. In a small part of the workspace the sag hardly varies, and the rows tell it
from geometric errors as little as they tell how large it is elsewhere. It then counts as that of any robot.

Rows that leave the place of base or markers open show the errors of few joints, and the size that they have in common
is known as poorly: that of all joints is then no smaller than that of any robot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.campaign import sampled_configurations, undetermined_places
from diffeo_calib.calibration.identification.identification import Identification, Prior
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.placement import PLACES, rigid_fit


def workspace_deviation(fitted: FittedMap) -> float:
    """Root mean square distance, m, between modelled and true positions that the model expects over its workspace.

    Of the last marker, the ball.
    """
    covariance = fitted.posterior(fitted.everywhere, noise=False)[1]
    return float(covariance.diagonal(dim1=1, dim2=2)[:, -3:].sum(1).mean().sqrt())


def stands_free(model: CalibratedKinematics) -> bool:
    """Whether no device measured positions in the fit of a model: its frame is the robot's base."""
    return model.map.unregistered.workspace is not None


def expected_of(model: CalibratedKinematics) -> float:
    """See :func:`workspace_deviation`."""
    return workspace_deviation(model.map.unregistered)


@dataclass(frozen=True)
class ExpectedError:
    """What a model expects of its own errors.

    Args:
        workspace: root mean square distance, m, between its positions of the last marker and the true ones over the
            joint ranges of the rows; without a measuring device after the best rigid motion.
        size: standard deviation of the robot's size, relative. size_share: its part of ``workspace``, from 0 to 1.
    """

    workspace: float
    size: float
    size_share: float

    @classmethod
    def of(cls, fitted: FittedMap) -> ExpectedError:
        """That of a fitted map."""
        points, at = fitted.geodesic.linearised_value(fitted.everywhere)
        own = torch.eye(fitted.m, dtype=points.dtype, device=points.device)[-3:].expand(len(points), -1, -1)
        away = points[:, -3:] - points[:, -3:].mean(0)
        covariance = fitted.covariance_between(at.projected(own))
        weight = (away / away.square().sum()).flatten()
        deviation = float((weight @ covariance @ weight).clamp(min=0).sqrt())
        spread, expected = float(away.square().sum(1).mean().sqrt()), workspace_deviation(fitted)
        return cls(expected, deviation, min(deviation * spread / max(expected, 1e-12), 1.0))

    def entry(self) -> dict[str, object]:
        """For programs."""
        return {"expected_error_m": self.workspace, "size_deviation": self.size}


def expected_errors(model: CalibratedKinematics, stages: Mapping[str, Callable[[Tensor], Tensor]]) -> dict[str, float]:
    """Root mean square distances, m, of the ball from its true places over the joint ranges of the rows, by stage.

    sqrt(d^2 + s^2) with d the distance between the places of a stage and those of the model, and s the one that the
    model expects of its own; without a measuring device after the best rigid motion.

    Args:
        model: of rows in sockets or of readings.
        stages: name -> kinematics, (N, n) -> (N, P, 3) in m, the ball last.
    """
    fitted, own = model.map, workspace_deviation(model.map)
    q = fitted.everywhere
    places = model(q).detach()[:, -1]

    def expected(points: Tensor) -> float:
        points = fitted.conditional.compared(points, places, rigid_fit)
        return float(((points - places).square().sum(1).mean() + own**2).sqrt())

    return {name: expected(kinematics(q).detach()[:, -1]) for name, kinematics in stages.items()}


STILL_RANGE = 0.05
"""Range of a joint, rad or m, below which the rows do not show its errors."""
SAG_DEVIATION = 5e-4
"""What is known of the sag of any robot's joints, rad or m: 100 N m on a gear of 2e5 N m/rad."""
SHOWN_SHARE = 0.5
"""Share of the variance of its features in any poses, from which the rows show the sag of a joint."""
SMALLEST_SPREAD = 0.1
"""Spread of features, relative to the largest, below which a combination of them does not count."""
SMALLEST_EFFECT = 1e-12
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
    return fitted.with_deformation(fitted.geodesic.with_prior(variance))


def _variances(
    before: Tensor, nominal: GeometryMap, registration: Identification, q: Tensor, *, every_joint: bool
) -> Tensor:
    """Prior variances (K,) of theta, none smaller than before; ``every_joint``: those of all joints count as unseen."""
    parts, chain, prior = nominal.geometry.slices, nominal.geometry.chain, Prior()
    found = registration.deviations.to(before)
    after = before.clone()
    most = before.new_tensor([PLACES.open_base_m] * 3 + [PLACES.open_base_rad] * 3)
    base = torch.minimum(BASE_PER_DEVIATION * found[parts["base"]], most)
    after[parts["base"]] = torch.maximum(before[parts["base"]], base.square())
    after[parts["tool"]] = torch.maximum(before[parts["tool"]], found[parts["tool"]].square())
    still = (q.amax(0) - q.amin(0)) < STILL_RANGE
    driven = (chain.coupling.to(before) != 0) & ~still  # (n_all, n)
    twist = before.new_tensor([prior.translation] * 3 + [prior.rotation] * 3)
    joints = after[parts["joints"]].view(-1, 6)
    seen = driven.any(1)[:, None] & (not every_joint)
    after[parts["joints"]] = torch.where(seen, joints, torch.maximum(joints, twist.square())).flatten()
    after[nominal.sag] = torch.maximum(after[nominal.sag], _unseen_sag(nominal, q))
    return after


def _unseen_sag(nominal: GeometryMap, q: Tensor) -> Tensor:
    """Variances of the coefficients of sag: those of any robot for joints whose sag the rows do not show, else zero.

    Where the features of a joint's sag vary little in the rows, sag is nearly constant there, and geometric errors take
    its place. How large it is elsewhere the rows do not say. Joints whose sag varies as in any poses keep their scale.
    """
    sag = nominal.elasticity
    if sag is None:
        return q.new_zeros(0)
    anywhere = sag.features(sampled_configurations(nominal.geometry.chain)).to(q)
    rows, after = sag.features(q), q.new_zeros(sag.size)
    own, joints = sag.own.to(q.device), sag.joints.to(q.device)
    for joint in range(nominal.geometry.chain.moving):
        mine = own & (joints == joint) & ~sag.loaded.to(q.device)
        if bool(mine.any()) and _share(rows[:, mine], anywhere[:, mine]) < SHOWN_SHARE:
            effect = float(anywhere[:, mine].square().sum(1).mean())
            after[mine] = SAG_DEVIATION**2 / max(effect, SMALLEST_EFFECT)
    return after


def _share(rows: Tensor, anywhere: Tensor) -> float:
    """Share of the variance of features anywhere (S, k) that they have in the rows (N, k), at most 1 per direction."""
    _, s, Vt = torch.linalg.svd((anywhere - anywhere.mean(0)) / len(anywhere) ** 0.5, full_matrices=False)
    kept = s > max(SMALLEST_SPREAD * float(s[0]), SMALLEST_EFFECT)
    if not bool(kept.any()):  # the same wherever the robot goes
        return 1.0
    white = (rows - rows.mean(0)) @ (Vt[kept].mT / s[kept]) / len(rows) ** 0.5
    return float(torch.linalg.svdvals(white).square().clamp(max=1.0).sum()) / int(kept.sum())
