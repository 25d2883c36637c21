"""Section 5 of the paper: the elastic RR arm on a grid of joint space, with the kernels printed there.

R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel approach", 2025.
"""

from __future__ import annotations

from diffeo_calib.common.checks import check_count
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.kernels.radial import Gaussian, RadialKernel, VonMises
from diffeo_calib.robots import elastic_rr

CONCENTRATION = 1.0186
"""Concentration of K_V in section 5, for both joints."""
JOINT_VARIANCE = 8.0
"""Variance of K_V in section 5, rad^2."""
TASK_LENGTH = 0.5135**0.5
"""Length scale of K_W in section 5, length units: exp(-|y - y'|^2 / 1.027)."""
SIGMA = 0.01
"""sigma of (5), length units, with which the exact model reaches the accuracy that section 5 reports."""
GRID = 16
"""Grid points per joint in section 5."""


def section_5_kernels() -> tuple[RadialKernel, RadialKernel]:
    """K_V and K_W of section 5: von Mises on the torus, Gaussian in the plane."""
    joint = VonMises(concentration=(CONCENTRATION,) * 2, variance=JOINT_VARIANCE)
    return joint, Gaussian(lengthscale=TASK_LENGTH)


def section_5(sigma: float = SIGMA, k: int = GRID) -> Problem:
    """The problem of section 5: the elastic RR arm, measured without noise on a k x k grid of joint space.

    Args:
        sigma: of (5), length units. k: grid points per joint.

    Raises:
        InputError: wrong values.
    """
    check_count(k, "`k`")
    x = elastic_rr.grid(k)
    K_V, K_W = section_5_kernels()
    return Problem(elastic_rr.nominal, x, elastic_rr.real(x), joint_kernel=K_V, task_kernel=K_W, noise=sigma)
