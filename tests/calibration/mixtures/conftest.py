"""A simulated arm whose ball rests in sockets in some rows, and whose marker a tracker sees in others."""

from __future__ import annotations

import pytest
from mixture_bank import DISTANCES, TRACKED
from simulated_sockets import SocketRows, rest_in_sockets

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm


@pytest.fixture(scope="package")
def arm() -> SimulatedArm:
    """Marker 0 is the ball; the tracker sees marker 1."""
    return SimulatedArm(seed=3, markers=2)


@pytest.fixture(scope="package")
def rows(arm: SimulatedArm) -> SocketRows:
    return rest_in_sockets(arm, seed=3, places=4, rows=8)


@pytest.fixture(scope="package")
def resting(rows: SocketRows, arm: SimulatedArm) -> dc.Measurements:
    names = arm.nominal.joint_names
    return dc.Measurements.from_sockets(rows.q, rows.names, names, distances=DISTANCES, distance_std=1e-5)


@pytest.fixture(scope="package")
def tracked(arm: SimulatedArm) -> dc.Measurements:
    q, points = arm.measure(TRACKED + 20, seed=5)
    return dc.Measurements(q, points[:, 1:], arm.nominal.joint_names)


@pytest.fixture(scope="package")
def mixture(tracked: dc.Measurements, resting: dc.Measurements) -> dc.Measurements:
    return dc.Measurements.joined([tracked.rows(slice(TRACKED)), resting])
