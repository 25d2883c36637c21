"""The fitting problem of the exact model of a robot."""

from __future__ import annotations

from diffeo_calib.calibration.scales.cross_validation import new_noise
from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.scales.tangent_data import TangentData
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
        new_noise=new_noise(data, scales),
        observe=data.observe,
    )
    return problem.with_nominal_of_rows(data.nominal)
