"""The fitting problem of the exact model of a robot."""

from __future__ import annotations

from torch import Tensor

from diffeo_calib.calibration.scales.differing_noise import differing_factor
from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
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
    payload = data.nominal.payload
    typical = None if payload is None else payload.weighing(payload.masses.median())
    problem = Problem(
        data.nominal.with_payload(typical),
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
    return problem if payload is None else problem.with_nominal_of_rows(data.nominal)


def _new_noise(data: TangentData, scales: Hyperparameters) -> Tensor:
    """Covariance (m, m) of a new measurement, m^2, inflated so that its 95 % region holds 95 %.

    It is the mean over the rows. Heavy tails widen it, and that the noise differs between rows. Of all coordinates,
    with the same noise each, where only functionals of them were measured.
    """
    jacobian, sensor = data.jacobian, data.noise_model
    if sensor.points is not None:
        jacobian, sensor = data.nominal.jacobian(data.x, data.theta), sensor.points
    mean, seen = sensor.mean_covariance(scales, jacobian), sensor.coordinates(jacobian[..., 0])
    between_rows = differing_factor(sensor.covariance(scales, jacobian), mean, seen)
    return mean * between_rows * region_factor(data.tails.freedom, sensor.largest_freedom)
