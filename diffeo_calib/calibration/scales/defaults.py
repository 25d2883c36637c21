"""Default scales: the residual of the geometric calibration, divided by the lever arms of the joints."""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Prior
from diffeo_calib.calibration.scales.hyperparameters import SENSOR_SHARE, Hyperparameters
from diffeo_calib.calibration.scales.tangent_data import TangentData

MESHING_LENGTHSCALE_RAD = 0.22
"""Default length scale of the transmission kernels on a circle: meshing of a reduction gear."""
LARGEST_AMPLITUDE_RATIO = 3.0
"""Largest default error amplitude of a joint, relative to the smallest of all joints. It bounds joints that have
hardly any lever arm in the data."""
SMALLEST_LOAD_RATIO = 0.05
"""Smallest effect of a family of gravity features, relative to the largest, that its default takes into account."""
SMALLEST_LEVER = 1e-12
SMALLEST_HALF_RANGE = 1e-6
"""Of a joint's values, rad or m."""
SMALLEST_SPREAD_M = 1e-3
"""Of the markers."""
SMALLEST_LOAD_M = 1e-9
"""Displacement per unit coefficient."""


def defaults(data: TangentData, noise: float, prior: Prior) -> Hyperparameters:
    """Scales from the residual of the geometric calibration.

    Args:
        data: the measurements around the geometric calibration.
        noise: standard deviation of that calibration's residual per coordinate, m.
        prior: deviations of geometric errors that it estimated.
    """
    x = data.x
    lever = data.jacobian.square().mean((0, 1)).sqrt()  # (n,) per coordinate
    amplitude = noise / lever.clamp(min=SMALLEST_LEVER)
    amplitude = amplitude.clamp(max=LARGEST_AMPLITUDE_RATIO * float(amplitude.min()))
    # The metre is no natural unit of a slide: measure it in half-ranges, as a circle in radians.
    half_range = (0.5 * (x.amax(0) - x.amin(0))).clamp(min=SMALLEST_HALF_RANGE)
    unit = torch.where(
        torch.tensor(data.space.periodic, dtype=torch.bool, device=x.device), torch.ones_like(half_range), half_range
    )
    size = _size(data.points.reshape(-1, 3))
    own, lateral = _load_effects(data)
    others = data.noise_model.kind_count - 1
    return Hyperparameters(
        transmission_lengthscale=MESHING_LENGTHSCALE_RAD * unit,
        transmission_amplitude=0.5 * amplitude,
        coupled_lengthscale=unit,
        coupled_amplitude=0.5 * amplitude,
        joint_noise=0.2 * amplitude,
        task_lengthscale=x.new_tensor(size),
        task_amplitude=x.new_tensor(0.2 * noise),
        sensor_noise=x.new_tensor(SENSOR_SHARE * noise),
        rotation_noise=x.new_tensor(SENSOR_SHARE * noise / size),
        translation_errors=x.new_tensor(prior.translation),
        rotation_errors=x.new_tensor(prior.rotation),
        compliance=0.3 * noise / own,
        lateral_compliance=0.1 * noise / lateral,
        gravity=x.new_ones(3),
        other_noise=x.new_full((others,), SENSOR_SHARE * noise) if others else None,
    )


def _size(points: Tensor) -> float:
    """Spread of points (N P, 3), m; one metre for a single point."""
    spread = float(points.std(0).norm()) if len(points) > 1 else 1.0
    return max(spread, SMALLEST_SPREAD_M)


def _load_effects(data: TangentData) -> tuple[Tensor, Tensor]:
    """RMS displacement per coordinate for unit coefficients of each joint, own and lateral compliance: (J,) each."""
    geometry, elasticity = data.nominal.geometry, data.nominal.elasticity
    nothing = data.x.new_zeros(geometry.chain.moving)
    if elasticity is None:
        return nothing + 1.0, nothing + 1.0
    squares = data.sensitivities[..., data.nominal.sag].square().mean((0, 1))  # (K,)
    effects = []
    for own in (True, False):
        of_this_kind = torch.where((elasticity.own == own) & ~elasticity.loaded, squares, 0.0)
        effect = nothing.index_add(0, elasticity.joints, of_this_kind).sqrt()
        effects.append(effect.clamp(min=max(SMALLEST_LOAD_RATIO * float(effect.max()), SMALLEST_LOAD_M)))
    return effects[0], effects[1]
