"""The arm of the bank's readings by a tracker that stands elsewhere, and its model; measured again it may be worn."""

import warnings
from functools import cache

import reading_bank
from numbers_bank import rigid_rms, tensor
from shared_bank import shared
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import twist_transform

WORN, FACTOR = 1, 3.0
"""The joint that wears, and the factor on its transmission error."""
ELSEWHERE = twist_transform(tensor([0.4, -0.2, 0.3, 0.2, 0.5, -0.3]))


def arm(markers: int = 1) -> SimulatedArm:
    return SimulatedArm(seed=0, markers=markers)


def positions(arm: SimulatedArm, rows: int, seed: int, T: Tensor = ELSEWHERE) -> dc.Measurements:
    q, points = arm.measure(rows, seed=seed)
    return dc.Measurements(q, points @ T[:3, :3].mT + T[:3, 3], arm.nominal.joint_names)


def fitted(rows: dc.Measurements | dc.Readings) -> dc.CalibratedKinematics:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few rows
        return dc.calibrate(arm().nominal, rows, hyperparameters=reading_bank.scales()).model


@cache
def model(markers: int = 1) -> dc.CalibratedKinematics:
    """Of 60 poses."""
    return shared(f"positions of {markers}", lambda: fitted(positions(arm(markers), 60, 1)))


def true_error(model: dc.CalibratedKinematics, robot: SimulatedArm, payload: float | None = None) -> float:
    """RMS distance, m, of the first point of a model from the truth over the joint ranges, after a rigid fit."""
    q = robot.sample(300, seed=99)
    return rigid_rms(model(q)[:, 0], robot.true_points(q, payload)[:, 0])
