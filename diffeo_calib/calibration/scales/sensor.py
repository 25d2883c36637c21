"""Noise of the measurements: blocks R_i from the scales, a known part, and the weights of heavy tails.

Markers are measured independently: sigma^2 I. A pose is one measurement of a rigid body that is represented by three
points (poses.py), so that these share their errors: a shift (sigma) and a turn (rho). A small noise of the single
points, the slack, sets how exactly the deformed model has to keep the body rigid; it cannot be estimated, since the
points of a pose are exactly rigid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.maps.noise import mean_block, without_hidden
from diffeo_calib.measurements.poses import mark_jacobian
from diffeo_calib.measurements.table import Measurements

SMALLEST_NOISE_M = 1e-7
"""Independent noise that is always present: with less, exact data would make G + R singular in float64."""
SLACK_SHARE = 0.1
"""Noise of the single points of a pose, relative to the residual of the geometric calibration."""


@dataclass(frozen=True)
class Sensor:
    """How N configurations were measured.

    Args:
        markers: P points per configuration.
        known: (N, 3 P, 3 P) covariance that is known beforehand, m^2, or None.
        modes: (N, 3 P, 6) displacements of the points by a shift and a turn of the body if poses were measured, or
            None.
        slack: standard deviation of the single points of a pose, m.
        smallest_noise: standard deviation that is added to every coordinate, m.
        visible: (N, P) boolean: the markers that were seen; None if all were.
    """

    markers: int
    known: Tensor | None = None
    modes: Tensor | None = None
    slack: float = 0.0
    smallest_noise: float = SMALLEST_NOISE_M
    visible: Tensor | None = None

    @classmethod
    def of(cls, data: Measurements, residual: float) -> Sensor:
        """The sensor of some measurements; ``residual`` is that of the geometric calibration per coordinate, m."""
        modes = None
        if data.poses is not None and data.lever is not None:
            modes = mark_jacobian(data.poses, data.lever)
        visible = None if bool(data.visible.all()) else data.visible
        return cls(data.markers, data.covariance, modes, SLACK_SHARE * residual, visible=visible)

    def rows(self, index: Tensor) -> Sensor:
        """The sensor of some configurations."""
        parts = (self.known, self.modes, self.visible)
        known, modes, visible = (None if part is None else part[index] for part in parts)
        return replace(self, known=known, modes=modes, visible=visible)

    def coordinates(self, values: Tensor) -> Tensor:
        """(N, m) boolean: the measured ones of coordinates (N, m)."""
        if self.visible is None:
            return torch.ones_like(values, dtype=torch.bool)
        return self.visible.repeat_interleave(3, 1)

    @property
    def bodies(self) -> int:
        """Number of bodies with independent noise: the markers, or one pose."""
        return self.markers if self.modes is None else 1

    @property
    def freedom(self) -> int:
        """Coordinates of each body: 3 of a point, 6 of a pose."""
        return 3 if self.modes is None else 6

    def covariance(self, scales: Hyperparameters, jacobian: Tensor) -> Tensor:
        """R_i without tails: Jacobian of k0 (N, m, n) -> (N, m, m) in m^2; hidden markers carry no information."""
        total = self._of_all(scales, jacobian)
        total = total if self.known is None else total + self.known
        return total if self.visible is None else without_hidden(total, self.coordinates(jacobian[..., 0]))

    def mean_covariance(self, scales: Hyperparameters, jacobian: Tensor) -> Tensor:
        """The mean of R_i without tails, all markers visible: (m, m) in m^2."""
        mean = self._of_all(scales, jacobian).mean(0)
        return mean if self.known is None else mean + mean_block(self.known, self.coordinates(jacobian[..., 0]))

    def _of_all(self, scales: Hyperparameters, jacobian: Tensor) -> Tensor:
        """R_i without what is known, as if all markers were visible."""
        m = jacobian.shape[1]
        eye = torch.eye(m, dtype=jacobian.dtype, device=jacobian.device)
        total = jacobian * scales.joint_noise.square() @ jacobian.mT + self.smallest_noise**2 * eye
        if self.modes is None:
            total = total + scales.sensor_noise**2 * eye
        else:
            size = torch.cat([scales.sensor_noise.expand(3), scales.rotation_noise.expand(3)])
            total = total + (self.modes * size.square()) @ self.modes.mT + self.slack**2 * eye
        return total

    def weighted(self, covariance: Tensor, tails: Tails) -> Tensor:
        """R_i with every body's noise divided by its weight, 1 where hidden; correlations are kept."""
        per_coordinate = tails.weights.rsqrt().repeat_interleave(covariance.shape[1] // self.bodies, 1)
        return per_coordinate[:, :, None] * covariance * per_coordinate[:, None, :]

    def squares(self, covariance: Tensor, errors: Tensor) -> Tensor:
        """Squared distances (N, bodies), in units of the noise, of errors with second moments (N, m, m).

        NaN for hidden markers.
        """
        if self.modes is None:
            blocks = [_own_blocks(matrix, self.markers) for matrix in (covariance, errors)]
        else:
            to_body = torch.linalg.pinv(self.modes)  # (N, 6, m)
            blocks = [(to_body @ matrix @ to_body.mT)[:, None] for matrix in (covariance, errors)]
        found = torch.linalg.solve(*blocks).diagonal(dim1=-2, dim2=-1).sum(-1)
        return found if self.visible is None else found.masked_fill(~self.visible, nan)


def _own_blocks(matrix: Tensor, markers: int) -> Tensor:
    """(N, 3 P, 3 P) -> (N, P, 3, 3)."""
    index = torch.arange(markers, device=matrix.device)
    return matrix.view(len(matrix), markers, 3, markers, 3)[:, index, :, index, :].movedim(0, 1)
