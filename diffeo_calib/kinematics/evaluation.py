"""Errors of any kinematics on measurements: of positions, and of orientations where poses were measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import degrees, inf, radians

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError, sentence
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.measurements.poses import angle_between, poses_from_marks
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.chain import Chain

OF_THE_REACH, OF_THE_EXPECTED = 0.1, 20.0
"""Median errors above this part of the robot's reach, or this multiple of what the model expects, are doubted."""


@dataclass(frozen=True, repr=False)
class Evaluation:
    """Distances between predicted and measured markers, or the errors of poses in position and orientation.

    Args:
        errors: (N, P) distances in m; of poses (N, 1) those of the frame's origin.
        angles: (N,) angles in rad between predicted and measured orientations; None if only points were measured.
    """

    errors: Tensor
    angles: Tensor | None = None

    def __repr__(self) -> str:
        names = ("rms", "median", "p95", "max")
        text = f"{self.errors.numel()} distances in m: " + ", ".join(f"{n}={getattr(self, n):.4g}" for n in names)
        if self.angles is not None:
            turns = ", ".join(f"{n}={getattr(self, f'angle_{n}'):.4g}" for n in names)
            text = f"{text}; {self.angles.numel()} angles in deg: {turns}"
        return f"Evaluation({text})"

    @property
    def rms(self) -> float:
        """Root mean square distance, m."""
        return float(self.errors.square().mean().sqrt())

    @property
    def mean(self) -> float:
        """Mean distance, m."""
        return float(self.errors.mean())

    @property
    def median(self) -> float:
        """Median distance, m."""
        return self.quantile(0.5)

    @property
    def p95(self) -> float:
        """95th percentile of the distances, m."""
        return self.quantile(0.95)

    @property
    def max(self) -> float:
        """Largest distance, m."""
        return float(self.errors.max())

    def quantile(self, fraction: float) -> float:
        """The distance, m, that the given fraction of markers does not exceed."""
        return float(torch.quantile(self.errors, fraction))

    @property
    def angle_rms(self) -> float | None:
        """Root mean square angle, **degrees**; None without orientations."""
        return None if self.angles is None else float(self.angles.rad2deg().square().mean().sqrt())

    @property
    def angle_median(self) -> float | None:
        """Median angle, **degrees**; None without orientations."""
        return self.angle_quantile(0.5)

    @property
    def angle_p95(self) -> float | None:
        """95th percentile of the angles, **degrees**; None without orientations."""
        return self.angle_quantile(0.95)

    @property
    def angle_max(self) -> float | None:
        """Largest angle, **degrees**; None without orientations."""
        return None if self.angles is None else float(self.angles.max().rad2deg())

    def angle_quantile(self, fraction: float) -> float | None:
        """The angle, **degrees**, that the given fraction of poses does not exceed; None without orientations."""
        return None if self.angles is None else float(torch.quantile(self.angles.rad2deg(), fraction))


def evaluate(kinematics: Callable[[Tensor], Tensor], data: Measurements) -> Evaluation:
    """Compare kinematics with measurements.

    Args:
        kinematics: (N, n) joint configurations -> (N, P, 3) marker positions in m in the measuring
            frame: a calibrated model, or the method ``points`` of a geometry. For measured poses it gives the
            three points that stand for each.
        data: measured configurations and markers or poses.

    Raises:
        InputError: arguments of another kind, another number of joints or markers, or poses on one side and points
            on the other.
    """
    if not callable(kinematics) or isinstance(kinematics, Chain):
        expected = "a calibrated model or another function of joint values"
        raise InputError(sentence("`kinematics`", expected=expected, got=type(kinematics).__name__))
    if not isinstance(data, Measurements):
        raise InputError(sentence("`data`", expected="dc.Measurements", got=type(data).__name__))
    if isinstance(kinematics, CalibratedKinematics):
        _check_kind(kinematics, data)
    predicted = kinematics(data.q).detach()
    if predicted.shape != data.points.shape:
        raise InputError(
            sentence(
                "the model and the measurements do not have the same markers",
                expected=f"predictions of shape {tuple(data.points.shape)}",
                got=tuple(predicted.shape),
                fix="evaluate on the markers that the model was calibrated with, in the same order",
            )
        )
    if data.poses is None or data.lever is None:
        return Evaluation((predicted - data.points).norm(dim=-1))
    poses = poses_from_marks(predicted, data.lever)
    distances = (poses[:, :3, 3] - data.poses[:, :3, 3]).norm(dim=-1, keepdim=True)
    return Evaluation(distances, angle_between(poses[:, :3, :3], data.poses[:, :3, :3]))


def doubt(model: CalibratedKinematics, data: Measurements, errors: Evaluation) -> str | None:
    """A sentence about errors so large that the measurements cannot be read as they are meant; None if they can.

    Args:
        model: the model that was evaluated. data: the measurements. errors: what :func:`evaluate` found.
    """
    pairs = [(errors.median, _expected(model, data), 1e3, "mm", model.robot.reach * OF_THE_REACH)]
    if errors.angle_median is not None:
        covariance = model.predict_poses(data.q)[1][:, 3:, 3:]
        pairs.append((radians(errors.angle_median), _typical(covariance), degrees(1.0), "degrees", inf))
    for median, expected, per_unit, unit, most in pairs:
        if median > min(most, OF_THE_EXPECTED * expected):
            return sentence(
                "these errors are not those of a calibrated robot",
                expected=f"a median of about {per_unit * expected:.2g} {unit} by the model's own uncertainty",
                got=f"{per_unit * median:.3g} {unit}",
                fix="check `length` and `angle`, the order of the columns"
                + ", `convention` and `rotation_angle`" * (data.poses is not None)
                + ", and that measuring device and markers are where they were: a model predicts in the measuring "
                "frame of its fit",
            )
    return None


def _expected(model: CalibratedKinematics, data: Measurements) -> float:
    """Typical distance, m, between a new measurement and its prediction."""
    if model.lever is None:
        return _typical(model.predict(data.q)[1].flatten(0, 1))
    return _typical(model.predict_poses(data.q)[1][:, :3, :3])


def _typical(covariance: Tensor) -> float:
    """Median of the root of the traces of covariances (N, 3, 3)."""
    return float(covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt().median())


def _check_kind(model: CalibratedKinematics, data: Measurements) -> None:
    """Three markers are no pose, although both are three points."""
    if (model.lever is None) == (data.poses is None):
        return
    kinds = ("points", "poses")
    fix = "name the columns of the rotation too" if data.poses is None else "leave the rotation out"
    raise InputError(
        sentence(
            f"the model was calibrated with {kinds[model.lever is not None]}",
            expected=f"measured {kinds[model.lever is not None]}",
            got=kinds[data.poses is not None],
            fix=fix,
        )
    )
