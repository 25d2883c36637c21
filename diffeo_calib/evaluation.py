"""Position errors of any kinematics on measurements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.errors import InputError, sentence
from diffeo_calib.measurements import Measurements


@dataclass(frozen=True, repr=False)
class Evaluation:
    """Distances between predicted and measured markers.

    Args:
        errors: (N, P) distances in m.
    """

    errors: Tensor

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={getattr(self, name):.4g}" for name in ("rms", "median", "p95", "max"))
        return f"Evaluation({self.errors.numel()} distances in m: {values})"

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


def evaluate(kinematics: Callable[[Tensor], Tensor], data: Measurements) -> Evaluation:
    """Compare kinematics with measurements.

    Args:
        kinematics: (N, n) joint configurations -> (N, P, 3) marker positions in m in the measuring
            frame: a calibrated model, or the method ``points`` of a geometry.
        data: measured configurations and markers.

    Raises:
        InputError: another number of joints or markers.
    """
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
    return Evaluation((predicted - data.points).norm(dim=-1))
