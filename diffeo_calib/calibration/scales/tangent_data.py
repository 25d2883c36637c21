"""The tangent model of a robot as a function of its scales: what likelihood, tails and cross-validation look at.

k0 is linearised once, at the parameters theta of the geometric calibration; scales only change the prior
covariance G and the noise R around it. The prior of theta stays centred at the registered nominal robot, hence

    target = y - k0(x; theta) + S theta.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.scales.sensor import Sensor
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.kernels.spaces import Space
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.deformation import ModelSpec
from diffeo_calib.maps.linearisation import Linearisation, NodeSensitivity
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.cholesky import CholeskyRegression, factorise
from diffeo_calib.regression.conditional import diagonal_blocks


@dataclass(frozen=True)
class TangentData:
    """Measurements around a geometric calibration.

    Args:
        nominal: k0.
        theta: (K,) its parameters, where it is linearised.
        x: (N, n) configurations. y: (N, m) measured coordinates, m.
        sensor: how they were measured.
        tails: weights of the measurements.
    """

    nominal: GeometryMap
    theta: Tensor
    x: Tensor
    y: Tensor
    sensor: Sensor
    tails: Tails

    @property
    def space(self) -> Space:
        """The joint space."""
        return Space(self.nominal.geometry.chain.periodic)

    def rows(self, index: Tensor) -> TangentData:
        """Some of the measurements."""
        sensor, tails = self.sensor.rows(index), self.tails.rows(index)
        return replace(self, x=self.x[index], y=self.y[index], sensor=sensor, tails=tails)

    def sample(self, poses: int, coordinates: int, seed: int) -> tuple[Tensor, TangentData]:
        """At most so many poses with at most so many coordinates, drawn at random: their rows, in order, and they."""
        count = min(len(self.x), poses, max(1, coordinates // self.y.shape[1]))
        drawn = torch.randperm(len(self.x), generator=torch.Generator().manual_seed(seed))[:count]
        rows = drawn.sort().values
        return rows, self.rows(rows)

    def linearised(self) -> TangentModel:
        """The linearisation, computed once."""
        z = self.nominal(self.x, self.theta)
        S = self.nominal.sensitivities(self.x, self.theta)
        return TangentModel(self, z, self.nominal.jacobian(self.x, self.theta), S, self.y - z + S @ self.theta)


@dataclass(frozen=True)
class TangentModel:
    """k1 = k0 + Dk0 v + w + S theta at the measurements, for any scales.

    Args:
        evidence: the measurements.
        z: (N, m) k0. jacobian: (N, m, n) Dk0. sensitivity: (N, m, K) S.
        target: (N, m) measured minus model at zero fields and zero theta, m.
    """

    evidence: TangentData
    z: Tensor
    jacobian: Tensor
    sensitivity: Tensor
    target: Tensor

    def linearisation(self, scales: Hyperparameters) -> Linearisation:
        """The prior of fields and theta with these scales."""
        nominal, space = self.evidence.nominal, self.evidence.space
        kernels = scales.joint_kernel(space), scales.task_kernel()
        model = ModelSpec(nominal, *kernels, scales.prior_variance(nominal), 3)
        points = self.z.reshape(-1, 3)
        eye = torch.eye(3, dtype=points.dtype).expand(len(points), 3, 3)
        joint, task = NodeSensitivity(1.0, self.evidence.x, self.jacobian), NodeSensitivity(1.0, points, eye)
        return Linearisation(model, [joint], [task], self.sensitivity)

    def noise(self, scales: Hyperparameters) -> Tensor:
        """R_i without tails: (N, m, m)."""
        return self.evidence.sensor.covariance(scales, self.jacobian)

    def factorised(self, scales: Hyperparameters) -> CholeskyRegression:
        """G + R, tails included, factorised."""
        return factorise(self.linearisation(scales), self._noise(scales))

    def covariance(self, scales: Hyperparameters) -> Tensor:
        """G + R, tails included: (N m, N m)."""
        return self._noise(scales).add_to(self.linearisation(scales).gram())

    def inner(self, scales: Hyperparameters, weights: Tensor) -> Tensor:
        """sum(weights * covariance(scales)), differentiable in the scales: scalar."""
        noise = self.evidence.sensor.weighted(self.noise(scales), self.evidence.tails)
        own = diagonal_blocks(weights, len(noise))
        return self.linearisation(scales).inner(weights) + (own * noise).sum()

    def _noise(self, scales: Hyperparameters) -> Noise:
        return Noise(self.evidence.sensor.weighted(self.noise(scales), self.evidence.tails))
