"""Measurements and the tangent model of the robot around its geometric calibration, for any scales.

k0 is linearised once, at the parameters theta of the geometric calibration; scales only change the prior
covariance G and the noise R around it. The prior of theta stays centred at the registered nominal robot, hence

    k1 = k0 + Dk0 v + w + S theta,    target = y - k0(x; theta) + S theta.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.hyperparameters import PLACE_DEVIATION, Hyperparameters
from diffeo_calib.calibration.scales.sensor import Sensor
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.kernels.spaces import Space
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.deformation import ModelSpec
from diffeo_calib.maps.linearisation import Linearisation, NodeSensitivity
from diffeo_calib.maps.noise import Noise
from diffeo_calib.regression.cholesky import CholeskyRegression, factorise
from diffeo_calib.regression.conditional import diagonal_blocks

LINEARISED = ("values", "jacobian", "sensitivities")
"""Cached properties that depend on the configurations and theta only."""


@dataclass(frozen=True, eq=False)
class TangentData:
    """Measurements around a geometric calibration. k0 and its derivatives are computed once, when first used.

    Args:
        nominal: k0.
        theta: (K,) its parameters, where it is linearised.
        x: (N, n) configurations. y: (N, m) measured coordinates, m.
        sensor: how they were measured.
        tails: weights of the measurements.
        place_deviation: prior standard deviation of base and markers, m and rad.
    """

    nominal: GeometryMap
    theta: Tensor
    x: Tensor
    y: Tensor
    sensor: Sensor
    tails: Tails
    place_deviation: float = PLACE_DEVIATION

    @property
    def space(self) -> Space:
        """The joint space."""
        return Space(self.nominal.geometry.chain.periodic)

    @cached_property
    def values(self) -> Tensor:
        """(N, m) k0, m."""
        return self.nominal(self.x, self.theta)

    @cached_property
    def jacobian(self) -> Tensor:
        """(N, m, n) Dk0, m/rad or m/m."""
        return self.nominal.jacobian(self.x, self.theta)

    @cached_property
    def sensitivities(self) -> Tensor:
        """(N, m, K) S, derivatives by theta."""
        return self.nominal.sensitivities(self.x, self.theta)

    @cached_property
    def target(self) -> Tensor:
        """(N, m) measured minus model at zero fields and zero theta, m."""
        return self.y - self.values + self.sensitivities @ self.theta

    # --- parts and variants, which share the linearisation ---

    def rows(self, index: Tensor) -> TangentData:
        """Some of the measurements."""
        sensor, tails = self.sensor.rows(index), self.tails.rows(index)
        changes = {"x": self.x[index], "y": self.y[index], "sensor": sensor, "tails": tails}
        return self._variant(lambda values: values[index], **changes)

    def sample(self, poses: int, coordinates: int, seed: int) -> tuple[Tensor, TangentData]:
        """A random subset of at most ``poses`` poses and ``coordinates`` coordinates, at least one pose.

        Returns:
            its sorted row numbers, and the subset.
        """
        count = min(len(self.x), poses, max(1, coordinates // self.y.shape[1]))
        drawn = torch.randperm(len(self.x), generator=seeded(seed), device=HOST)[:count]
        rows = drawn.sort().values.to(self.x.device)
        return rows, self.rows(rows)

    def with_tails(self, tails: Tails) -> TangentData:
        """The same measurements with other weights."""
        return self._variant(tails=tails)

    def with_measured(self, y: Tensor) -> TangentData:
        """The same configurations with other measured coordinates (N, m), m."""
        return self._variant(y=y)

    def _variant(self, share: Callable[[Tensor], Tensor] = lambda values: values, **changes: Any) -> TangentData:
        """A copy with changes, which takes over its share of the cached properties."""
        other = replace(self, **changes)
        vars(other).update({name: share(vars(self)[name]) for name in LINEARISED if name in vars(self)})
        return other

    # --- the model with given scales ---

    def linearisation(self, scales: Hyperparameters) -> Linearisation:
        """The prior of fields and theta with these scales."""
        kernels = scales.joint_kernel(self.space), scales.task_kernel()
        spec = ModelSpec(self.nominal, *kernels, self.prior_variance(scales), 3)
        points = self.values.reshape(-1, 3)
        eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(len(points), 3, 3)
        joint, task = NodeSensitivity(1.0, self.x, self.jacobian), NodeSensitivity(1.0, points, eye)
        return Linearisation(spec, [joint], [task], self.sensitivities)

    def prior_variance(self, scales: Hyperparameters) -> Tensor:
        """Prior variances (K,) of theta."""
        return scales.prior_variance(self.nominal, self.place_deviation)

    def noise(self, scales: Hyperparameters) -> Tensor:
        """R_i with all weights 1: (N, m, m), m^2."""
        return self.sensor.covariance(scales, self.jacobian)

    def weighted_noise(self, scales: Hyperparameters) -> Tensor:
        """R_i with the weights of the tails: (N, m, m), m^2."""
        return self.sensor.weighted(self.noise(scales), self.tails)

    def factorised(self, scales: Hyperparameters) -> CholeskyRegression:
        """G + R with weighted noise, factorised."""
        return factorise(self.linearisation(scales), Noise(self.weighted_noise(scales)))

    def covariance(self, scales: Hyperparameters) -> Tensor:
        """G + R with weighted noise: (N m, N m), m^2."""
        return Noise(self.weighted_noise(scales)).add_to(self.linearisation(scales).gram())

    def inner(self, scales: Hyperparameters, weights: Tensor) -> Tensor:
        """sum(weights * covariance(scales)), differentiable in the scales: scalar."""
        noise = self.weighted_noise(scales)
        own = diagonal_blocks(weights, len(noise))
        return self.linearisation(scales).inner(weights) + (own * noise).sum()
