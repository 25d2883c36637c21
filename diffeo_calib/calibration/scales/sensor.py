"""Noise of the measurements: blocks R_i from the scales, a known part, and the weights of heavy tails.

Markers are measured independently: sigma^2 I. A pose is one measurement of a rigid body that is represented by three
points (poses.py), so that these share their errors: a shift (sigma) and a turn (rho). A small noise of the single
points, the slack, sets how exactly the deformed model has to keep the body rigid; it cannot be estimated, since the
points of a pose are exactly rigid. The poses of several tips are measured independently.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.common.errors import InputError
from diffeo_calib.maps.noise import mean_block, without_hidden
from diffeo_calib.measurements.pose_frames import block_diagonal, own_blocks
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.tool_camera import pose_jacobian

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
        modes: (N, T, 9, 6) displacements of the points of each of T poses by a shift and a turn, zero where it is
            hidden; None if points were measured.
        slack: standard deviation of the single points of a pose, m.
        smallest_noise: standard deviation that is added to every coordinate, m.
        visible: (N, P) boolean: the markers that were seen; None if all were.
        size: numbers measured of each marker, its coordinates or those of an :class:`Observation`.
        resting: (N,) boolean: the rows that show the last marker alone, a ball in a socket, beside rows that a device
            measured; None if all rows are of one kind.
    """

    markers: int
    known: Tensor | None = None
    modes: Tensor | None = None
    slack: float = 0.0
    smallest_noise: float = SMALLEST_NOISE_M
    visible: Tensor | None = None
    size: int = 3
    resting: Tensor | None = None

    @classmethod
    def of(cls, data: Measurements, residual: float) -> Sensor:
        """The sensor of some measurements; ``residual`` is that of the geometric calibration per coordinate, m."""
        modes = pose_modes(data.frames, data.lever, data.board)
        visible = None if bool(data.visible.all()) else data.visible
        resting = None if data.places is None or data.without_device else (data.places >= 0).to(data.q.device)
        return cls(data.markers, data.covariance, modes, SLACK_SHARE * residual, visible=visible, resting=resting)

    def rows(self, index: Tensor) -> Sensor:
        """The sensor of some configurations."""
        parts = {name: getattr(self, name) for name in ("known", "modes", "visible", "resting")}
        return replace(self, **{name: part[index] for name, part in parts.items() if part is not None})

    def coordinates(self, values: Tensor) -> Tensor:
        """(N, m) boolean: the measured ones of coordinates (N, m)."""
        if self.visible is None:
            return torch.ones_like(values, dtype=torch.bool)
        return self.visible.repeat_interleave(3, 1)

    @property
    def bodies(self) -> int:
        """Number of bodies with independent noise: the markers, or the poses of a row."""
        return self.markers if self.modes is None else self.modes.shape[1]

    @property
    def seen(self) -> Tensor | None:
        """(N, bodies) boolean: the bodies that were seen; None if all were."""
        return None if self.visible is None else self.visible.unflatten(1, (self.bodies, -1)).all(2)

    @property
    def freedom(self) -> int:
        """Numbers measured of each body: 3 coordinates of a point, 6 of a pose."""
        return self.size if self.modes is None else 6

    def covariance(self, scales: Hyperparameters, jacobian: Tensor) -> Tensor:
        """R_i without tails: Jacobian of k0 (N, m, n) -> (N, m, m) in m^2; hidden markers carry no information."""
        total = self._of_all(scales, jacobian)
        total = total if self.known is None else total + self.known
        return total if self.visible is None else without_hidden(total, self.coordinates(jacobian[..., 0]))

    def mean_covariance(self, scales: Hyperparameters, jacobian: Tensor) -> Tensor:
        """The mean of R_i without tails, all markers visible: (m, m) in m^2."""
        mean = self._of_all(scales, jacobian).mean(0)
        seen = self.coordinates(jacobian[..., 0])
        if self.modes is not None and self.visible is not None:  # modes of hidden poses are not known
            own = self._of_poses(scales)
            mean = mean - own.mean(0) + mean_block(own, seen)
        return mean if self.known is None else mean + mean_block(self.known, seen)

    def _of_all(self, scales: Hyperparameters, jacobian: Tensor) -> Tensor:
        """R_i without what is known, as if all markers were visible."""
        m = jacobian.shape[1]
        eye = torch.eye(m, dtype=jacobian.dtype, device=jacobian.device)
        total = jacobian * scales.joint_noise.square() @ jacobian.mT + self.smallest_noise**2 * eye
        if self.modes is None:
            own = scales.sensor_noise**2 * eye
            if self.resting is not None and scales.socket_noise is not None:
                ball = eye * (torch.arange(m, device=eye.device) >= m - 3)
                own = own + (scales.socket_noise**2 - scales.sensor_noise**2) * ball
            return total + own
        return total + self._of_poses(scales) + self.slack**2 * eye

    def _of_poses(self, scales: Hyperparameters) -> Tensor:
        """Covariance (N, m, m) of the shifts and turns of poses."""
        if self.modes is None:
            raise InputError.of("the noise of poses", expected="measured poses", got="points")
        size = torch.cat([scales.sensor_noise.expand(3), scales.rotation_noise.expand(3)])
        return block_diagonal((self.modes * size.square()) @ self.modes.mT)

    def weighted(self, covariance: Tensor, tails: Tails) -> Tensor:
        """R_i with every body's noise divided by its weight, 1 where hidden; correlations are kept."""
        per_coordinate = tails.weights.rsqrt().repeat_interleave(covariance.shape[1] // self.bodies, 1)
        return per_coordinate[:, :, None] * covariance * per_coordinate[:, None, :]

    def squares(self, covariance: Tensor, errors: Tensor) -> Tensor:
        """Squared distances (N, bodies), in units of the noise, of errors with second moments (N, m, m).

        NaN for hidden markers.
        """
        blocks = [own_blocks(matrix, self.bodies) for matrix in (covariance, errors)]
        if self.modes is not None:
            to_body = torch.linalg.pinv(self.modes)  # (N, T, 6, 9)
            blocks = [to_body @ matrix @ to_body.mT for matrix in blocks]
        seen = self.seen
        if seen is not None:
            eye = torch.eye(self.freedom, dtype=covariance.dtype, device=covariance.device)
            blocks[0] = torch.where(seen[..., None, None], blocks[0], eye)
        found = torch.linalg.solve(*blocks).diagonal(dim1=-2, dim2=-1).sum(-1)
        return found if seen is None else found.masked_fill(~seen, nan)


def pose_modes(frames: Tensor | None, lever: float | None, board: Tensor | None) -> Tensor | None:
    """Displacements (N, T, 9, 6) of the points of frames (N, T, 4, 4), zero where hidden; None without frames.

    See :func:`pose_jacobian`.
    """
    return None if frames is None or lever is None else pose_jacobian(frames, lever, board).nan_to_num(0.0)
