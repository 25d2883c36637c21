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

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import sqrt
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import SMALLEST_NOISE_M, Identification, Prior, identify
from diffeo_calib.calibration.identification.registration import find_joint_offsets, register, with_joint_offsets
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.robots.geometry import Geometry

RANGE_ROWS = 200  # least number of configurations in the joint ranges of rows that show no positions
GEOMETRIC, PROJECTION, NOMINAL = "geometric calibration", "projection of the model", "nominal kinematics"
FOLDS = 5  # of the cross-validation
OFFSET_STD, LOOSE_STD = 2e-3, 0.5
"""Prior standard deviations of joint offsets, and of those that only tell the noise, rad or m.

What offsets and base explain equally well goes to the base. Offsets that hardly matter stay small: of a wrist joint
near its marker, say, which least squares alone puts off by degrees for micrometres.
"""
PLACE_STD = 1e-2  # prior standard deviation of base and markers around the model's own, m or rad
FIXED_STD = 1e-9  # prior standard deviation of joint errors that are to stay, m or rad
TOLERATED_RMS_RATIO = 1.01
"""Relative increase of the RMS distance at which base and markers close to the model's are no good fit."""


@dataclass(frozen=True, eq=False)
class RigidKinematics:
    """Rigid kinematics in place of a calibrated model, and how far they are from it."""

    geometry: Geometry  # chain, joint errors, base in the measuring frame and markers
    how: str  # what they are, in words
    # rms, largest: distances of the markers from the model's at the configurations that are compared, m
    rms: float
    largest: float
    # name of each candidate -> its RMS distance from the model at configurations left out, m (fivefold
    # cross-validation; the geometric calibration had seen the measurements of all of them)
    validated: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class JointOffsets:
    """The best joint offsets alone, all other geometry nominal."""

    # (n,) to be added to the joints' readings before nominal kinematics [rad or m]; zero where the base or the markers
    # could explain the same
    offsets: Tensor
    rigid: RigidKinematics  # the kinematics with these offsets, and how far they are from the model


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
    on, geometry, start = Compared.of(model, transmission=transmission), model.geometry, model.nominal.geometry
    if start.markers != geometry.markers:  # a registration found others
        start = start.with_tool(geometry.tool, geometry.on)
    first = identify(start, on.x, on.y)  # prior deviations by maximum likelihood
    fits: dict[str, Callable[[Compared], Geometry]] = {PROJECTION: lambda rows: _refit(model, rows, like=first)}
    if model.rigid_errors is not None and not transmission:
        fits[GEOMETRIC] = lambda rows: _placed(model, model.rigid_errors, rows)
    fold, validated = torch.randperm(len(on.x), generator=seeded(0), device=HOST) % FOLDS, dict[str, float]()
    for name, fit in fits.items():
        parts = [on.rows(fold == k).distances(fit(on.rows(fold != k))) for k in range(min(FOLDS, len(fold)))]
        validated[name] = float(torch.cat([part.square().flatten() for part in parts]).mean().sqrt())
    how = min(validated, key=lambda name: validated[name])
    return on.compared(fits[how](on), how, validated)


def geometry_of(kinematics: CalibratedKinematics | Geometry) -> Geometry:
    """The best rigid kinematics of a calibrated model; a geometry as it is."""
    return kinematics if isinstance(kinematics, Geometry) else rigid_kinematics(kinematics).geometry


def with_errors(
    model: CalibratedKinematics, errors: Tensor | None, how: str = NOMINAL, *, transmission: bool = False
) -> RigidKinematics:
    """Kinematics with these joint errors (n_all, 4, 4), m, or none, and the base and markers that fit the model best.

    Args:
        model, transmission: see :func:`rigid_kinematics`. how: what they are, in words.
    """
    on = Compared.of(model, transmission=transmission)
    return on.compared(_placed(model, errors, on), how, {})


def best_joint_offsets(model: CalibratedKinematics) -> JointOffsets:
    """The joint offsets that bring the nominal kinematics closest to the model at the measured configurations."""
    on = Compared.of(model)
    start = geometry = _placed(model, None, on)
    offsets = on.x.new_zeros(on.x.shape[1])
    for std in (LOOSE_STD, LOOSE_STD, LOOSE_STD, OFFSET_STD):  # large offsets first: they look like noise
        noise = _noise(float((geometry.points(on.x) - on.y).square().sum(-1).mean().sqrt()))
        offsets = find_joint_offsets(start, on.x, on.y, std, noise)
        geometry = _placed(model, with_joint_offsets(start, offsets).joint_errors, on)
    return JointOffsets(offsets, on.compared(geometry, "joint offsets", {}))


def joint_motion(model: CalibratedKinematics, q: Tensor) -> Tensor:
    """Joint values including transmission errors: q (N, n) -> (N, n) [rad or m]."""
    errors = [model.transmission(name, q[:, index]) for index, name in enumerate(model.robot.joint_names)]
    return q + torch.stack(errors, 1)


class Compared(NamedTuple):
    """What rigid kinematics are fitted to and compared with.

    Where nothing measured positions, rows are at a few places, such as sockets, at which kinematics agree that differ
    elsewhere: there the model's joint ranges take part, too, and distances are those over the ranges.
    """

    x: Tensor  # (N, n) joint values for the geometry, rad or m
    y: Tensor  # (N, P, 3) the model's points, m
    judged: Tensor  # (N,) boolean, where distances count
    where: str  # these configurations, in words

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

    def rows(self, some: Tensor) -> Compared:
        """Some of them, (N,) boolean."""
        return self._replace(x=self.x[some], y=self.y[some], judged=self.judged[some])

    def distances(self, geometry: Geometry) -> Tensor:
        """Distances (N, P) of markers from the model's where these count [m]."""
        return (geometry.points(self.x[self.judged]) - self.y[self.judged]).norm(dim=-1)

    def compared(self, geometry: Geometry, how: str, validated: Mapping[str, float]) -> RigidKinematics:
        """A geometry with its distances from the model."""
        d = self.distances(geometry)
        return RigidKinematics(geometry, how, float(d.square().mean().sqrt()), float(d.max()), dict(validated))


def _noise(rms: float) -> float:
    """The RMS of one coordinate, m."""
    return max(rms / sqrt(3), SMALLEST_NOISE_M)


def _refit(model: CalibratedKinematics, on: Compared, *, like: Identification) -> Geometry:
    """The geometry that is closest, by plain least squares: nothing in a prediction is an outlier.

    Noise and prior deviations are those of another fit.
    """
    geometry = model.geometry
    start = replace(model.nominal.geometry.with_tool(geometry.tool, geometry.on), base=geometry.base)
    prior = replace(like.prior, base_translation=PLACE_STD, base_rotation=PLACE_STD, tool=PLACE_STD)
    return identify(start, on.x, on.y, noise=_noise(like.rms), prior=prior).geometry


def _placed(model: CalibratedKinematics, joint_errors: Tensor | None, on: Compared) -> Geometry:
    """A geometry with given joint errors, or none: base and markers close to the model's, unless others fit better."""
    errors = Geometry.nominal(model.robot).joint_errors if joint_errors is None else joint_errors
    start = replace(model.geometry, joint_errors=errors)
    best = register(start, on.x, on.y)
    prior = Prior(FIXED_STD, FIXED_STD, base_translation=PLACE_STD, base_rotation=PLACE_STD, tool=PLACE_STD)
    near = identify(start, on.x, on.y, noise=_noise(best.rms), prior=prior)
    fitted = near if near.rms < TOLERATED_RMS_RATIO * best.rms + SMALLEST_NOISE_M else best
    return replace(fitted.geometry, joint_errors=start.joint_errors)
