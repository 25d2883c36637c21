"""The rigid kinematics that come closest to a calibrated model: all that other formats can hold.

A URDF, a DH table and a controller's kinematic parameters hold joint axes and the transforms between them. They hold
neither gravity sag nor transmission errors nor other deformations, which is why leaving these parts out of the model
(``model.geometry``) describes the robot badly: the parts were fitted to work together. Two candidates are better,

    geometric calibration   the joint errors of the calibration's own geometry stage, fitted to the measurements
    projection              joint errors fitted to the model's predictions at the measured configurations,

    min over theta   sum_ik |y_k(q_i; theta) - k1_k(q_i)|^2 / s^2 + sum_j (theta_j / s_j)^2,

and cross-validation against the model chooses between them. Base and markers are refined with them. They stay close to
the model's where the measured poses can hardly tell one from the other (a tool that was never turned).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import sqrt
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import LIMITS, PRECISE, Identification, Prior, identify
from diffeo_calib.calibration.identification.registration import fit_joint_offsets, register, with_joint_offsets
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.robots.geometry import Geometry

RANGE_ROWS = 200
"""Least number of configurations in the joint ranges of rows that show no positions."""
GEOMETRIC, PROJECTION = "geometric calibration", "projection of the model"
FOLDS = 5
"""Of the cross-validation."""
OFFSET_STD, LOOSE_STD = 2e-3, 0.5
"""Prior standard deviations of joint offsets, and of those that only tell the noise, rad or m.

What offsets and base explain equally well goes to the base. Offsets that hardly matter stay small: of a wrist joint
near its marker, say, which least squares alone puts off by degrees for micrometres.
"""
PLACE_STD = 1e-2
"""Prior standard deviation of base and markers around the model's own, m or rad."""
FIXED_STD = 1e-9
"""Prior standard deviation of joint errors that are to stay, m or rad."""
TOLERATED_RMS_RATIO = 1.01
"""Relative increase of the RMS distance at which base and markers close to the model's are no good fit."""


@dataclass(frozen=True, eq=False)
class RigidKinematics:
    """Rigid kinematics in place of a calibrated model, and how far they are from it.

    Args:
        geometry: chain, joint errors, base in the measuring frame and markers. how: what they are, in words.
        rms: root mean square distance of the markers from the model's at the configurations that are compared, m.
        largest: largest such distance, m.
        validated: name of each candidate -> its RMS distance from the model at configurations left out, m (fivefold
            cross-validation; the geometric calibration had seen the measurements of all of them).
    """

    geometry: Geometry
    how: str
    rms: float
    largest: float
    validated: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class JointOffsets:
    """The best joint offsets alone, all other geometry nominal.

    Args:
        offsets: (n,) to be added to the joints' readings before nominal kinematics [rad or m]; zero where the base or
            the markers could explain the same.
        rigid: the kinematics with these offsets, and how far they are from the model.
    """

    offsets: Tensor
    rigid: RigidKinematics


def rigid_kinematics(model: CalibratedKinematics, *, transmission: bool = False) -> RigidKinematics:
    """The best rigid kinematics, by cross-validation against the model.

    Args:
        model: calibrated kinematics of any robot.
        transmission: whether they are for use together with :func:`correction_tables`: their joint values are then the
            readings plus transmission errors.

    Note:
        A model that was fitted to positions of one marker knows the tool's roll about the last axis from priors alone,
        and so do its rigid kinematics. Cost: some ten least-squares fits of 6 + 6 n_all + 3 P parameters, one to two
        seconds for 400 configurations.
    """
    on = Compared.of(model, transmission=transmission)
    found = _project(model, on.x, on.y)
    candidates = {PROJECTION: found.geometry}
    if model.rigid_errors is not None and not transmission:
        candidates[GEOMETRIC] = _placed(model, model.rigid_errors, on.x, on.y)
    validated = _validate(model, candidates, found, on)
    how = min(validated, key=lambda name: validated[name])
    return _compared(candidates[how], how, on, validated)


def nominal_kinematics(model: CalibratedKinematics, *, transmission: bool = False) -> RigidKinematics:
    """The nominal robot with the base and the markers that fit the model best; for comparison."""
    nominal = Geometry.nominal(model.robot).joint_errors
    return _with_errors(model, nominal, "nominal kinematics", transmission=transmission)


def geometric_kinematics(model: CalibratedKinematics) -> RigidKinematics:
    """The geometric calibration that the model was fitted from; without one, the projection of the model."""
    if model.rigid_errors is None:
        return rigid_kinematics(model)
    return _with_errors(model, model.rigid_errors, GEOMETRIC)


def applied_with_tables(model: CalibratedKinematics, rigid: RigidKinematics, *, applied: bool) -> RigidKinematics:
    """Rigid kinematics used with correction tables (``applied``) or without, whatever they were fitted for.

    Joint errors are kept; base and markers are those that fit best.
    """
    return _with_errors(model, rigid.geometry.joint_errors, rigid.how, transmission=applied)


def best_joint_offsets(model: CalibratedKinematics) -> JointOffsets:
    """The joint offsets that bring the nominal kinematics closest to the model at the measured configurations."""
    on = Compared.of(model)
    points = on.x, on.y
    start = _placed(model, Geometry.nominal(model.robot).joint_errors, *points)
    noise = _noise(start, *points)
    for std in (LOOSE_STD, LOOSE_STD, LOOSE_STD, OFFSET_STD):  # large offsets first: they look like noise
        offsets = fit_joint_offsets(start, *points, std, noise, **PRECISE)
        geometry = _placed(model, with_joint_offsets(start, offsets).joint_errors, *points)
        noise = _noise(geometry, *points)
    return JointOffsets(offsets, _compared(geometry, "joint offsets", on, {}))


def distances(geometry: Geometry, x: Tensor, y: Tensor) -> Tensor:
    """Distances (N, P) of markers at joint values x (N, n) from points y (N, P, 3) [m]."""
    return (geometry.points(x) - y).norm(dim=-1)


def joint_motion(model: CalibratedKinematics, q: Tensor) -> Tensor:
    """Joint values including transmission errors: q (N, n) -> (N, n) [rad or m]."""
    errors = [model.transmission(name, q[:, index]) for index, name in enumerate(model.robot.joint_names)]
    return q + torch.stack(errors, 1)


class Compared(NamedTuple):
    """What rigid kinematics are fitted to and compared with.

    Where nothing measured positions, rows are at a few places, such as sockets, at which kinematics agree that differ
    elsewhere: there the model's joint ranges take part, too, and distances are those over the ranges.

    Args:
        x: (N, n) joint values for the geometry, rad or m. y: (N, P, 3) the model's points, m.
        judged: (N,) boolean, where distances count. where: these configurations, in words.
    """

    x: Tensor
    y: Tensor
    judged: Tensor
    where: str

    @classmethod
    def of(cls, model: CalibratedKinematics, *, transmission: bool = False) -> Compared:
        """The measured configurations of a model without repeats, and more for some."""
        q = torch.unique(model.configurations, dim=0)
        judged, where = torch.ones(len(q), dtype=torch.bool, device=q.device), "measured configurations"
        if model.map.unregistered.workspace is not None:
            low, high = model.configurations.amin(0), model.configurations.amax(0)
            draws = torch.rand(max(RANGE_ROWS, len(q)), len(low), dtype=q.dtype, generator=seeded(0), device=HOST)
            q = torch.cat([q, low + (high - low) * draws.to(q)])
            judged, where = torch.arange(len(q), device=q.device) >= len(judged), "configurations in the joint ranges"
        x = joint_motion(model, q) if transmission else q
        return cls(x.detach().to(HOST), model(q).detach().to(HOST), judged.to(HOST), f"{int(judged.sum())} {where}")


def _compared(geometry: Geometry, how: str, on: Compared, validated: Mapping[str, float]) -> RigidKinematics:
    d = distances(geometry, on.x[on.judged], on.y[on.judged])
    return RigidKinematics(geometry, how, float(d.square().mean().sqrt()), float(d.max()), dict(validated))


def _with_errors(
    model: CalibratedKinematics, joint_errors: Tensor, how: str, *, transmission: bool = False
) -> RigidKinematics:
    on = Compared.of(model, transmission=transmission)
    return _compared(_placed(model, joint_errors, on.x, on.y), how, on, {})


def _project(model: CalibratedKinematics, x: Tensor, y: Tensor) -> Identification:
    """Prior deviations by maximum likelihood, then plain least squares: nothing in a prediction is an outlier."""
    start, own = model.nominal.geometry, model.geometry
    if start.markers != own.markers:  # a registration found others
        start = start.with_tool(own.tool, own.on)
    first = identify(start, x, y)
    return _refit(model, x, y, like=first)


def _refit(model: CalibratedKinematics, x: Tensor, y: Tensor, *, like: Identification) -> Identification:
    """The geometry that is closest to points, for the noise and the prior deviations of another fit."""
    own = model.geometry
    start = replace(model.nominal.geometry.with_tool(own.tool, own.on), base=own.base)
    noise = max(like.rms / sqrt(3), LIMITS.smallest_noise_m)
    prior = replace(like.prior, base_translation=PLACE_STD, base_rotation=PLACE_STD, tool=PLACE_STD)
    return identify(start, x, y, noise=noise, prior=prior)


def _placed(model: CalibratedKinematics, joint_errors: Tensor, x: Tensor, y: Tensor) -> Geometry:
    """A geometry with given joint errors: its base and markers close to the model's, unless others fit better."""
    start = replace(model.geometry, joint_errors=joint_errors)
    best = register(start, x, y)
    noise = max(best.rms / sqrt(3), LIMITS.smallest_noise_m)
    prior = Prior(FIXED_STD, FIXED_STD, base_translation=PLACE_STD, base_rotation=PLACE_STD, tool=PLACE_STD)
    near = identify(start, x, y, noise=noise, prior=prior)
    found = near if near.rms < TOLERATED_RMS_RATIO * best.rms + LIMITS.smallest_noise_m else best
    return replace(found.geometry, joint_errors=start.joint_errors)


def _validate(
    model: CalibratedKinematics, candidates: Mapping[str, Geometry], found: Identification, on: Compared
) -> dict[str, float]:
    """RMS distance of each candidate from the model at configurations left out of its fit, m."""
    x, y = on.x, on.y
    fold = torch.randperm(len(x), generator=seeded(0), device=HOST) % FOLDS
    squares: dict[str, list[Tensor]] = {name: [] for name in candidates}
    for out in (fold == k for k in range(min(FOLDS, len(x)))):
        for name, geometry in candidates.items():
            kept = x[~out], y[~out]
            if name == PROJECTION:
                fitted = _refit(model, *kept, like=found).geometry
            else:
                fitted = _placed(model, geometry.joint_errors, *kept)
            own = out & on.judged
            squares[name].append(distances(fitted, x[own], y[own]).square().flatten())
    return {name: float(torch.cat(parts).mean().sqrt()) for name, parts in squares.items()}


def _noise(geometry: Geometry, x: Tensor, y: Tensor) -> float:
    """RMS of one coordinate of what a geometry leaves, m."""
    return max(float(distances(geometry, x, y).square().mean().sqrt()) / sqrt(3), LIMITS.smallest_noise_m)
