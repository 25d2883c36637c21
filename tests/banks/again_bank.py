"""A simulated arm measured in every way, and measured again: as it was, or with a worn joint."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import reading_bank
import torch
from reading_bank import DISTANCES
from shared_bank import shared
from simulated_sockets import rest_in_sockets
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.se3 import twist_transform

WORN, FACTOR = 1, 3.0
"""The joint that wears, and the factor on its transmission error."""
OLD, NEW = 60, 30
Rows = Callable[[SimulatedArm, int, int], Any]
"""Arm, number of rows, seed -> rows."""


def one(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


ELSEWHERE = twist_transform(one(0.4, -0.2, 0.3, 0.2, 0.5, -0.3))
TRIPOD = twist_transform(one(2e-3, -1e-3, 0.5e-3, 1e-3, -2e-3, 0.5e-3))


def positions(arm: SimulatedArm, rows: int, seed: int, T: Tensor = ELSEWHERE) -> dc.Measurements:
    q, points = arm.measure(rows, seed=seed)
    return dc.Measurements(q, points @ T[:3, :3].mT + T[:3, 3], arm.nominal.joint_names)


def sessions(arm: SimulatedArm, rows: int, seed: int) -> dc.Measurements:
    """The tripod is moved by 2 mm after half of the rows."""
    parts = positions(arm, rows // 2, seed), positions(arm, rows - rows // 2, seed + 50, ELSEWHERE @ TRIPOD)
    names = ["before"] * len(parts[0]) + ["after"] * len(parts[1])
    return dc.Measurements.joined(parts).with_sessions(names)


def payloads(arm: SimulatedArm, rows: int, seed: int) -> dc.Measurements:
    masses = one(0.0, 4.0, 10.0)[torch.arange(rows) % 3]
    q, points = arm.measure(rows, seed=seed, payload=masses)
    return dc.Measurements(q, points @ ELSEWHERE[:3, :3].mT + ELSEWHERE[:3, 3]).with_payload(masses)


def sockets(arm: SimulatedArm, rows: int, seed: int) -> dc.Measurements:
    places = max(rows // 12, 3)
    found = rest_in_sockets(arm, seed=seed, places=places, rows=rows // (2 * places))
    joints = arm.nominal.joint_names
    return dc.Measurements.from_sockets(found.q, found.names, joints, distances=DISTANCES, distance_std=1e-5)


def reading(kind: str, arm: SimulatedArm, rows: int, seed: int) -> dc.Readings:
    whole = reading_bank.readings(arm, kind, 100 + rows, noise=2e-5)
    return whole.rows(slice(0, rows) if seed == 1 else slice(100, 100 + rows))


def height(arm: SimulatedArm, rows: int, seed: int) -> dc.Readings:
    return reading("height", arm, rows, seed)


def laden_height(arm: SimulatedArm, rows: int, seed: int) -> dc.Readings:
    """Heights of a ball under payloads that change from row to row."""
    masses = one(0.0, 4.0, 10.0)[torch.arange(rows) // 3 % 3]
    whole = reading_bank.readings(arm, "height", rows, noise=2e-5, seed=seed, payload=masses)
    return whole.with_payload(masses)


def distance(arm: SimulatedArm, rows: int, seed: int) -> dc.Readings:
    return reading("distance", arm, rows, seed)


class Again(NamedTuple):
    """How the arm is measured at first, how again, and by how many rows."""

    old: Rows
    new: Rows
    count: int = NEW


OTHERWISE = {
    "positions, then two sessions": Again(positions, sessions),
    "positions, then sockets": Again(positions, sockets),
    "positions, then heights": Again(positions, height, 60),
    "heights, then a tracker": Again(height, positions),
    "sockets, then distances": Again(sockets, distance, 60),
}
"""Measured in one way and then in another."""


def arm(markers: int = 1) -> SimulatedArm:
    return SimulatedArm(seed=0, markers=markers)


@cache
def model(old: Rows, markers: int = 1) -> dc.CalibratedKinematics:
    return shared(f"again by {old.__name__} of {markers}", lambda: _fitted(old, markers))  # pyright: ignore


def _fitted(old: Rows, markers: int) -> dc.CalibratedKinematics:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few rows
        return dc.calibrate(
            arm(markers).nominal, old(arm(markers), OLD, 1), hyperparameters=reading_bank.scales()
        ).model


def true_error(model: dc.CalibratedKinematics, robot: SimulatedArm, payload: float | None = None) -> float:
    """RMS distance, m, of the first point of a model from the truth over the joint ranges, after a rigid fit."""
    q = robot.sample(300, seed=99)
    found, truth = model(q).detach()[:, 0], robot.true_points(q, payload)[:, 0]
    T = rigid_fit(found, truth)
    return float((found @ T[:3, :3].mT + T[:3, 3] - truth).square().sum(1).mean().sqrt())
