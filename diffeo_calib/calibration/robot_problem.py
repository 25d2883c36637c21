"""The fitting problem of the exact model of a robot."""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.differing_noise import differing_factor
from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.calibration.student_t import region_factor
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.maps.noise import Noise

RESIDUAL_TOLERANCE = 1e-5
"""Of coupling and end residual: the remaining error is far below the noise."""


def robot_problem(data: TangentData, scales: Hyperparameters) -> Problem:
    """Measurements of a robot, with the kernels, priors and noise that the scales determine.

    Rows that carry payloads have a nominal map of their own; elsewhere the robot carries the median of them.
    """
    problem = Problem(
        data.nominal.typical,
        data.x,
        data.y,
        joint_kernel=scales.joint_kernel(data.space),
        task_kernel=scales.task_kernel(),
        noise=Noise(data.weighted_noise(scales), data.shared),
        markers=data.nominal.geometry.markers,
        prior_variance=data.prior_variance(scales),
        new_noise=_new_noise(data, scales),
        observe=data.observe,
    )
    return problem.with_nominal_of_rows(data.nominal)


def _new_noise(data: TangentData, scales: Hyperparameters) -> Tensor:
    """Covariance (m, m) of a new measurement of all coordinates, m^2, inflated so that its 95 % region holds 95 %.

    It is the mean over the rows. Heavy tails widen it, and that the noise differs between rows. Points of which only
    functionals were measured have the noise of these in each coordinate.
    """
    if data.observe is None:
        return _typical(data, data.noise_model, data.jacobian, scales)
    whole = data.nominal.jacobian(data.x, data.theta)
    if data.beside is None:
        return _typical(data, NoiseModel(whole.shape[1] // 3), whole, scales)
    known, ball = _new_noise(data.beside, scales), _typical(data, NoiseModel(1), whole[:, -3:], scales)
    return known if len(known) == whole.shape[1] else torch.block_diag(known, ball)


def _typical(data: TangentData, noise: NoiseModel, jacobian: Tensor, scales: Hyperparameters) -> Tensor:
    """The same for a noise model of coordinates with their derivatives (N, m, n)."""
    mean, seen = noise.mean_covariance(scales, jacobian), noise.coordinates(jacobian[..., 0])
    between_rows = differing_factor(noise.covariance(scales, jacobian), mean, seen)
    return mean * between_rows * region_factor(data.tails.freedom, noise.largest_freedom)
