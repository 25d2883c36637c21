"""Scales of kernels, priors and noise, and their defaults from the data.

Every joint error field is, per joint l,

    K_V = diag_l( a_l^2 k_l(x_l, x'_l) + c_l^2 k_all(x, x') )

k_l (Matern 5/2) sees joint l alone: its transmission (gear eccentricity, meshing); k_all (Gaussian) sees all
joints with one length scale each: load, coupling. K_W is a Gaussian on R^3. Geometric errors and the coefficients
of the elastic deflection under gravity have Gaussian priors. The noise of a configuration is

    R_i = sigma^2 I + Dk0(x_i) diag(s^2) Dk0(x_i)^T   (for poses with a term for their rotation, sensor.py)

where s is the repeatability of the joints; without it the likelihood calls repeatability "signal".

:func:`defaults` scales all of it by what geometry left over; selection.py starts there and maximises the
marginal likelihood, with a weak log-normal prior around the defaults.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Prior
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.named import Gaussian, PerJoint
from diffeo_calib.kernels.profiles import GaussianProfile, MaternProfile
from diffeo_calib.kernels.radial import RadialKernel
from diffeo_calib.kernels.spaces import Space
from diffeo_calib.kinematics.nominal import GeometryMap

WIDE = 0.1
"""Prior standard deviation of base and markers around their registration, m and rad."""
MESHING = 0.22
"""Default length scale of the transmission kernels, rad on a circle: meshing of a reduction gear."""
COMPARABLE = 3.0
"""Largest default error amplitude of a joint against the best-determined joint's: a joint with no lever
arm in the data would otherwise be granted any error."""
SENSOR_SHARE = 0.2
"""Default of the sensor's noise, as a part of what geometry leaves."""
NEGLIGIBLE = 3e-3
"""Displacements below so much of the noise's deviation, a priori: no data of any size show them."""
WEAKEST_LOAD = 0.05
"""Smallest effect of a family of gravity features, against the strongest, that its default takes into account."""
FIELDS = ("transmission_amplitude", "coupled_amplitude", "joint_noise", "task_amplitude")
ELASTIC = ("compliance", "lateral_compliance")
AMPLITUDES = frozenset((*FIELDS, *ELASTIC, "gravity"))
"""Scales that may shrink to nothing: then the data do not support what they are the size of."""
DEVIATIONS = (*FIELDS, *ELASTIC, "sensor_noise", "rotation_noise", "translation_errors", "rotation_errors")
"""Scales that are standard deviations: together they make the covariance of everything."""


@dataclass(frozen=True)
class Hyperparameters:
    """Scales of kernels, priors and noise; lengths in m, angles in rad; n active, J moving joints.

    Args:
        transmission_lengthscale: (n,) of k_l; on a circle concentration = lengthscale^-2.
        transmission_amplitude: (n,) a_l, rad or m.
        coupled_lengthscale: (n,) of k_all, ARD.
        coupled_amplitude: (n,) c_l, rad or m.
        joint_noise: (n,) s_l, rad or m.
        task_lengthscale: scalar, m. task_amplitude: scalar, m, of K_W.
        sensor_noise: scalar sigma, m, per coordinate. rotation_noise: scalar, rad, of measured poses.
        translation_errors: scalar, m, and rotation_errors: scalar, rad: priors of the joints' error twists.
        compliance: (J,) prior of a joint's deflection about its own axis, rad per m of lever arm.
        lateral_compliance: (J,) the same about the other two axes.
        gravity: (3,) factors on both by the direction of the load in the robot's base.
    """

    transmission_lengthscale: Tensor
    transmission_amplitude: Tensor
    coupled_lengthscale: Tensor
    coupled_amplitude: Tensor
    joint_noise: Tensor
    task_lengthscale: Tensor
    task_amplitude: Tensor
    sensor_noise: Tensor
    rotation_noise: Tensor
    translation_errors: Tensor
    rotation_errors: Tensor
    compliance: Tensor
    lateral_compliance: Tensor
    gravity: Tensor

    def joint_kernel(self, space: Space) -> Kernel:
        """K_V on the joint space."""
        return self.transmission_kernel(space) + self.coupled_kernel(space)

    def transmission_kernel(self, space: Space) -> Kernel:
        """diag_l a_l^2 k_l, Matern 5/2: gears have several harmonics, which a Gaussian is too sure to know."""
        return PerJoint(self.transmission_lengthscale, self.transmission_amplitude**2, space, MaternProfile(2.5))

    def coupled_kernel(self, space: Space) -> Kernel:
        """diag_l c_l^2 k_all."""
        return RadialKernel(
            GaussianProfile(),
            lengthscale=self.coupled_lengthscale,
            variance=self.coupled_amplitude**2,
            periodic=space.periodic,
        )

    def task_kernel(self) -> Kernel:
        """K_W on R^3."""
        return Gaussian(self.task_lengthscale, self.task_amplitude**2)

    def prior_variance(self, nominal: GeometryMap) -> Tensor:
        """Prior variances of theta: errors of the geometry, then coefficients of the elasticity."""
        geometry, elasticity = nominal.geometry, nominal.elasticity
        twist = torch.cat([self.translation_errors.expand(3), self.rotation_errors.expand(3)])
        wide = torch.full((6 + 3 * geometry.markers,), WIDE, dtype=torch.float64)
        deviations = torch.cat([wide[:6], twist.repeat(geometry.chain.moving), wide[6:]])
        if elasticity is not None:
            own, lateral = self.compliance[elasticity.joints], self.lateral_compliance[elasticity.joints]
            elastic = torch.where(elasticity.own, own, lateral) * self.gravity[elasticity.components]
            deviations = torch.cat([deviations, elastic])
        return deviations.square()

    def supported(self, jacobian: Tensor, noise: Tensor) -> Hyperparameters:
        """The same scales, with the amplitudes of fields that stay far below the noise set to zero.

        Args:
            jacobian: (N, m, n) of k0. noise: (N, m, m) blocks R_i, m^2.
        """
        level = NEGLIGIBLE * float(noise.diagonal(dim1=1, dim2=2).mean().sqrt())
        lever = jacobian.square().mean((0, 1)).sqrt()
        transmission, coupled = (
            torch.where(amplitude * lever < level, 0.0, amplitude)
            for amplitude in (self.transmission_amplitude, self.coupled_amplitude)
        )
        task = torch.where(self.task_amplitude < level, 0.0, self.task_amplitude)
        return replace(self, transmission_amplitude=transmission, coupled_amplitude=coupled, task_amplitude=task)

    def geometric(self) -> Hyperparameters:
        """Geometry and white noise only, the noise as large as what geometry is expected to leave."""
        none = {name: torch.zeros_like(getattr(self, name)) for name in (*FIELDS, *ELASTIC)}
        left = self.sensor_noise / SENSOR_SHARE
        return replace(self, **none, sensor_noise=left, rotation_noise=self.rotation_noise / SENSOR_SHARE)

    def widened(self, factor: float) -> Hyperparameters:
        """All standard deviations times a factor: what is fitted stays (but for what is known), less is claimed."""
        return replace(self, **{name: factor * getattr(self, name) for name in DEVIATIONS})

    def logarithms(self) -> Tensor:
        """All scales as one vector of logarithms."""
        return torch.cat([getattr(self, f.name).reshape(-1) for f in fields(self)]).log()

    def from_logarithms(self, vector: Tensor) -> Hyperparameters:
        """The inverse of :meth:`logarithms`, shaped like this object."""
        shapes = [getattr(self, f.name).shape for f in fields(self)]
        parts = torch.split(vector.exp(), [s.numel() for s in shapes])
        return Hyperparameters(*(p.reshape(s) for p, s in zip(parts, shapes, strict=True)))

    def amplitudes(self) -> Tensor:
        """Which entries of the vector of logarithms may shrink to nothing: boolean."""
        return torch.cat([torch.full((getattr(self, f.name).numel(),), f.name in AMPLITUDES) for f in fields(self)])


def defaults(
    nominal: GeometryMap, theta: Tensor, x: Tensor, noise: float, *, prior: Prior, space: Space
) -> Hyperparameters:
    """Scales from the data: what geometry left over, divided by the joints' lever arms.

    Args:
        nominal: k0.
        theta: its parameters after the geometric calibration.
        x: (N, n) configurations.
        noise: standard deviation of the geometric calibration's residual per coordinate, m.
        prior: scales of geometric errors that the geometric calibration found.
        space: which joints are circles.
    """
    lever = nominal.jacobian(x, theta).square().mean((0, 1)).sqrt()  # (n,) per coordinate
    amplitude = noise / lever.clamp(min=1e-12)
    amplitude = amplitude.clamp(max=COMPARABLE * float(amplitude.min()))
    # A line's unit is a metre, which says nothing: measure it in half-ranges, as a circle in radians.
    half_range = (0.5 * (x.amax(0) - x.amin(0))).clamp(min=1e-6)
    unit = torch.where(torch.tensor(space.periodic), torch.ones_like(half_range), half_range)
    values = nominal(x, theta).reshape(-1, 3)
    spread = values.std(0).norm() if len(values) > 1 else torch.tensor(1.0, dtype=x.dtype)
    size = max(float(spread), 1e-3)
    own, lateral = _load_effects(nominal, x, theta)
    return Hyperparameters(
        transmission_lengthscale=MESHING * unit,
        transmission_amplitude=0.5 * amplitude,
        coupled_lengthscale=unit,
        coupled_amplitude=0.5 * amplitude,
        joint_noise=0.2 * amplitude,
        task_lengthscale=torch.tensor(size, dtype=x.dtype),
        task_amplitude=torch.tensor(0.2 * noise, dtype=x.dtype),
        sensor_noise=torch.tensor(SENSOR_SHARE * noise, dtype=x.dtype),
        rotation_noise=torch.tensor(SENSOR_SHARE * noise / size, dtype=x.dtype),
        translation_errors=torch.tensor(prior.translation, dtype=x.dtype),
        rotation_errors=torch.tensor(prior.rotation, dtype=x.dtype),
        compliance=0.3 * noise / own,
        lateral_compliance=0.1 * noise / lateral,
        gravity=torch.ones(3, dtype=x.dtype),
    )


def _load_effects(nominal: GeometryMap, x: Tensor, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Displacement per coordinate, RMS, that coefficients of size 1 make of each joint, own and lateral: (J,) each."""
    joints, elasticity = nominal.geometry.chain.moving, nominal.elasticity
    if elasticity is None:
        return torch.ones(joints, dtype=x.dtype), torch.ones(joints, dtype=x.dtype)
    squares = nominal.sensitivities(x, theta)[..., nominal.geometry.size :].square().mean((0, 1))  # (K,)
    effects = []
    for own in (True, False):
        total = torch.zeros(joints, dtype=x.dtype).index_add(
            0, elasticity.joints, torch.where(elasticity.own == own, squares, 0.0)
        )
        effect = total.sqrt()
        effects.append(effect.clamp(min=max(WEAKEST_LOAD * float(effect.max()), 1e-9)))
    return effects[0], effects[1]
