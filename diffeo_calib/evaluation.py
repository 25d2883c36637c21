"""Errors of any kinematics on measurements: of positions, and of orientations where poses were measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.errors import InputError, sentence
from diffeo_calib.measurements import Measurements
from diffeo_calib.model import CalibratedKinematics
from diffeo_calib.rotations import angle_between, poses_from_marks


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
        InputError: another number of joints or markers, or poses on one side and points on the other.
    """
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
