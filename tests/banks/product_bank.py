"""Shared by the product tests: simulated robots whose truth is known, and formulas written a second time."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import robot_data
import torch
from numbers_bank import drawn, inside, normal, tensor
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.poses import mark_points, poses_from_marks
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.simulated_arm import SimulatedArm

TEST_ROWS = 300


@dataclass(frozen=True)
class Case:
    """A robot, its training and held-out measurements, and the calibration."""

    robot: dc.Chain
    train: dc.Measurements
    test: dc.Measurements
    result: dc.CalibrationResult

    @property
    def model(self) -> dc.CalibratedKinematics:
        return self.result.model

    def held_out(self) -> list[float]:
        """RMS of every stage on the held-out rows, m."""
        return [dc.evaluate(stage, self.test).rms for stage in self.result.stages.values()]


def simulated(rows: int, **errors: float) -> tuple[SimulatedArm, dc.Measurements, dc.Measurements]:
    """The six-axis arm, training rows, and rows to test."""
    arm = SimulatedArm(seed=1, **errors)  # pyright: ignore[reportArgumentType]
    q, points = arm.measure(rows + TEST_ROWS, seed=2)
    return arm, dc.Measurements(q[:rows], points[:rows]), dc.Measurements(q[rows:], points[rows:])


def covered(model: dc.CalibratedKinematics, data: dc.Measurements) -> float:
    """Share of the markers inside their 95 % regions."""
    mean, covariance = model.predict(data.q)
    return inside(mean - data.points, covariance)


USUAL: dict[str, float | tuple[float, ...]] = {
    "transmission_lengthscale": 0.7,
    "transmission_amplitude": 3e-4,
    "coupled_lengthscale": 1.5,
    "coupled_amplitude": 3e-5,
    "joint_noise": 1e-5,
    "task_lengthscale": 1.0,
    "task_amplitude": 1e-5,
    "sensor_noise": 1.5e-5,
    "rotation_noise": 5e-5,
    "translation_errors": 5e-4,
    "rotation_errors": 3e-4,
    "compliance": 5e-4,
    "lateral_compliance": 1e-4,
    "gravity": (0.1, 0.1, 1.8),
}
ONE = ("task_lengthscale", "task_amplitude", "sensor_noise", "rotation_noise", "translation_errors", "rotation_errors")
"""Scales of which a robot has one."""


def scales_of(joints: int, moving: int, **changed: float | tuple[float, ...]) -> dc.Hyperparameters:
    """Usual scales of a robot, some of them changed."""

    def sized(name: str, value: float | tuple[float, ...]) -> Tensor:
        count = moving if name.endswith("compliance") else joints
        return tensor(value) if name in ONE or isinstance(value, tuple) else tensor(value).repeat(count)

    return dc.Hyperparameters(**{name: sized(name, value) for name, value in {**USUAL, **changed}.items()})


def usual_scales(robot: dc.Tree) -> dc.Hyperparameters:
    """Scales such as the search finds for the simulated robots; with these a calibration takes a third of the time."""
    return scales_of(robot.n, robot.moving)


def ur10_scales() -> dc.Hyperparameters:
    """Scales such as the search finds for the measured UR10; tests/calibration/test_hardware.py searches them."""
    return scales_of(
        6,
        6,
        transmission_lengthscale=(0.08, 0.07, 0.06, 0.1, 0.05, 0.2),
        transmission_amplitude=(4e-4, 4e-4, 3e-4, 5e-4, 5e-4, 6e-4),
        coupled_lengthscale=(2.0, 1.2, 1.5, 1.0, 2.0, 1.3),
        coupled_amplitude=(3e-5, 7e-5, 2e-4, 2e-4, 1e-4, 6e-4),
        joint_noise=(2e-5, 6e-5, 5e-5, 1e-4, 3e-5, 3e-4),
        **{"task_lengthscale": 0.8, "task_amplitude": 1.5e-5, "sensor_noise": 2e-5, "rotation_noise": 7e-5},
        **{"translation_errors": 4e-4, "rotation_errors": 6e-4},
        compliance=(7e-5, 1.5e-4, 1.7e-4, 7e-4, 1.3e-3, 1.3e-3),
        lateral_compliance=(2e-5, 3e-5, 3e-5, 1e-4, 3e-4, 4e-4),
        gravity=(0.2, 0.2, 2.9),
    )


def with_usual_scales(robot: dc.Tree, *data: Any, **options: Any) -> Any:
    """:func:`calibrate` with :func:`usual_scales`."""
    return dc.calibrate(robot, *data, **options, hyperparameters=usual_scales(robot))


def calibrated(rows: int, **errors: float) -> Case:
    arm, train, test = simulated(rows, **errors)
    return Case(arm.nominal, train, test, dc.calibrate(arm.nominal, train))


def simulated_poses(rows: int, lever: float = 0.1) -> tuple[SimulatedArm, dc.Measurements, dc.Measurements]:
    """The six-axis arm with a frame on its tool whose poses are measured, training rows, and rows to test."""
    arm = SimulatedArm(seed=1, markers=3)
    frame = torch.eye(4, dtype=torch.float64)
    frame[:3, 3] = arm.truth.tool[0]
    arm.truth = replace(arm.truth, tool=mark_points(frame[None], lever)[0])
    q, points = arm.measure(rows + TEST_ROWS, seed=2)
    data = dc.Measurements.from_poses(q, poses_from_marks(points, lever), arm.nominal.joint_names, lever=lever)
    return arm, data[:rows], data[rows:]


def calibrated_poses(rows: int) -> Case:
    arm, train, test = simulated_poses(rows)
    return Case(arm.nominal, train, test, dc.calibrate(arm.nominal, train))


def ur10_measurements(folder: Path) -> tuple[dc.Chain, dc.Measurements]:
    """The UR10 and its 632 rows."""
    found = robot_data.read(folder, robot_data.BUILT_IN["ipa_ur10"])
    return found.robot, found.measurements


def sliding_robot() -> dc.Chain:
    """Two turning joints, a slide of 0.6 m, a wrist: one prismatic joint among six."""
    quarter = math.pi / 2
    rows = [
        (0.0, quarter, 0.3),
        (0.0, -quarter, 0.4),
        (0.0, 0.0, 0.2, 0.3, "prismatic"),
        (0.1, quarter, 0.1),
        (0.05, -quarter, 0.15),
        (0.0, 0.0, 0.12),
    ]
    return dc.from_dh(rows, names=["pan", "tilt", "slide", "roll", "bend", "turn"], name="slider")


def erring(robot: dc.Tree, rows: int, seed: int = 0, noise: float = 1e-5) -> dc.Measurements:
    """Of any robot: geometric errors; two waves per turn of every joint, or a spindle's with a period of 0.3 m."""
    truth = replace(Geometry.nominal(robot), tool=tensor([[0.05, 0.02, 0.1]]))
    theta = normal(truth.size, seed=7, size=5e-4)
    theta[:6] = tensor([1.0, 2.0, 0.5, 0.3, 0.2, 0.1])
    turning = torch.tensor(robot.periodic)
    q = torch.where(turning, 4.0 * drawn(rows, robot.n, seed=seed) - 2.0, 0.6 * drawn(rows, robot.n, seed=seed))
    waves = (torch.where(turning, 2.0, 2 * math.pi / 0.3) * q + torch.arange(robot.n)).sin()
    points = truth.absorb(theta).points(q + torch.where(turning, 2e-4, 4e-4) * waves)
    return dc.Measurements(q, points + normal(*points.shape, seed=seed, size=noise), robot.joint_names)


def joint_covariance(scales: dc.Hyperparameters, x: Tensor, other: Tensor, periodic: tuple[bool, ...]) -> Tensor:
    """K_V = diag_l(a_l^2 k_l + c_l^2 k_all), Matern 5/2 and Gaussian: (M, n), (N, n) -> (M, N, n)."""
    d = x[:, None] - other[None]
    circles = torch.tensor(periodic)
    s = (5 * torch.where(circles, 2 - 2 * d.cos(), d**2)).sqrt() / scales.transmission_lengthscale
    own = (1 + s + s**2 / 3) * (-s).exp()
    every = (torch.where(circles, 2 - 2 * d.cos(), d**2) / scales.coupled_lengthscale**2).sum(-1, keepdim=True)
    return scales.transmission_amplitude**2 * own + scales.coupled_amplitude**2 * (-every / 2).exp()


def noise_blocks(scales: dc.Hyperparameters, geometry: Geometry, x: Tensor) -> Tensor:
    """R_i = (sigma^2 + (0.1 um)^2) I + Dk0 diag(s^2) Dk0^T: (N, m, m)."""
    J = geometry.jacobian(x).flatten(1, 2)
    eye = torch.eye(J.shape[1], dtype=torch.float64)
    return (scales.sensor_noise**2 + 1e-7**2) * eye + torch.einsum("ial,l,ibl->iab", J, scales.joint_noise**2, J)
