"""Tables of several kinds, and positions beside rows in sockets: accuracy, frames, devices, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from kind_bank import kind_named, rigid_rms
from reading_bank import DISTANCES, readings
from reading_bank import scales as usual
from simulated_sockets import rest_in_sockets
from table_bank import refused
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.identification.identification import (
    KindRows,
    Rows,
    estimated,
    held_parameters,
)
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.fitting.result import silent
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.sensors.coordinates import fitting_devices

MIXED = kind_named("mixture")
"""Marker 0 is the ball; the tracker sees marker 1."""


def rms(errors: Tensor) -> float:
    return float(errors.square().sum(-1).mean().sqrt())


def test_several_set_ups_of_the_device() -> None:
    """Rows in sockets belong to no set-up, and the places of the robot to all."""
    T = twist_transform(torch.tensor([0.1, -0.05, 0.02, 0.0, 0.2, 0.1], dtype=torch.float64))
    device, resting = MIXED.source.rows.parts
    second, truth = torch.arange(len(device)) % 3 == 1, MIXED.source.truth
    points = torch.where(second[:, None, None], device.points @ T[:3, :3].mT + T[:3, 3], device.points)
    moved = with_attributes(device, points=points).with_sessions(["ab"[int(flag)] for flag in second])
    found = dc.calibrate(MIXED.robot, dc.Measurements.joined([moved, resting]), hyperparameters=MIXED.scales)
    torch.testing.assert_close(found.sessions.transforms[1], T, rtol=0, atol=5e-4)
    q = MIXED.q(100)
    assert rms(found.model(q) - truth(q)) < 1.5 * rms(MIXED.model(q) - truth(q))


@pytest.mark.filterwarnings("ignore:the place of marker 1 on 'flange'")
def test_rows_of_another_robot() -> None:
    bend = torch.zeros(6, dtype=torch.float64)
    bend[4] = 0.05
    tracked, resting = MIXED.source.rows.parts
    other = with_attributes(resting, q=resting.q + bend, distances=())
    with pytest.warns(dc.DiffeoCalibWarning, match="do not fit the robot whose positions were measured"):
        place(MIXED.robot, dc.Measurements.joined([tracked, other]), silent)


def test_refused() -> None:
    def staged(*tables: Any) -> Callable[[], object]:
        return lambda: place(MIXED.robot, dc.Measurements.joined(tables), silent)

    tracked, resting = MIXED.source.rows.parts
    large, renamed = with_attributes(tracked, points=1e3 * tracked.points), [f"q{k}" for k in range(6)]
    loaded = tracked.with_payload(1.0)
    refused(
        ("9 unknowns .* expected at least 3 poses", staged(tracked.rows([0, 1]), resting)),
        ("positions seem to be 1000 times too large", staged(large, resting)),
        ("the tables differ in payload", staged(loaded, resting)),
        ("the tables differ in joint_names", staged(tracked, resting.with_joint_names(renamed))),
    )


def test_rows_of_a_noisy_kind_take_nothing_from_precise_ones() -> None:
    """Every kind of rows has a noise of its own: 2 mm of distances, 0.02 mm of positions of the same marker."""
    arm = SimulatedArm(seed=2, transmission=0, gravity=0, noise=2e-5)
    q, points = arm.measure(30)
    data, test = readings(arm, "distance", 120, noise=2e-3), arm.sample(200, 9)
    start = register(arm.nominal, q, points).geometry
    parts = KindRows.positions(q, points), KindRows.read(data, fitting_devices(data, start.points(data.q)))
    found = [estimated(Rows(start, some), held_parameters(start)) for some in (parts[:1], parts)]
    alone, both = (rms(one.geometry.points(test) - arm.true_points(test)) for one in found)
    assert both < 1.1 * alone
    for weights in found[1].weights:
        assert 0.5 < float(weights.median()) < 1.5


# --- tables of several kinds ------------------------------------------------------------------------------------------

PLAIN = SimulatedArm(3)
NAMES = PLAIN.nominal.joint_names
NOISE = 2e-5


def read(kind: str, count: int) -> dc.Readings:
    return readings(PLAIN, kind, count, noise=NOISE)


def fit_of(data: dc.Observations) -> Any:
    """With the noise of each kind given."""
    other = torch.full((len(data.parts) - 1,), NOISE, dtype=torch.float64)
    return dc.calibrate(PLAIN.nominal, data, hyperparameters=replace(usual(), other_noise=other))  # type: ignore[arg-type]


def test_sockets_and_distances_alone() -> None:
    """As good as the model says; errors of every kind are judged by themselves, and better than by geometry."""
    rows = rest_in_sockets(PLAIN, seed=3, places=4, rows=5)
    sockets = dc.Measurements.from_sockets(rows.q, rows.names, NAMES, distances=DISTANCES, distance_std=1e-5)
    data: Any = dc.Observations.joined([sockets, read("distance", 36)])
    result, q = fit_of(data), PLAIN.sample(200, 9)
    error = rigid_rms(result.model(q).detach(), PLAIN.true_points(q))
    assert 0.5 * result.expected.workspace < error < 1.8 * result.expected.workspace
    assert result.fit.converged
    kinds = result.errors(data)
    assert len(kinds) == 2
    for one in kinds.values():
        assert one["calibrated"].rms < one["geometric"].rms


@pytest.mark.slow
def test_the_order_of_the_rows_does_not_matter() -> None:
    tracked = dc.Measurements(*PLAIN.measure(20, seed=4), NAMES)
    data: Any = dc.Observations.joined([tracked, read("distance", 24), read("height", 24)])
    order = torch.randperm(len(data), generator=torch.Generator().manual_seed(2))
    order[order.argmin()], order[0] = order[0].clone(), 0  # positions stay the first kind
    mixed = data.rows(order.tolist())
    assert [part.kind for part in data.parts] != [part.kind for part in mixed.parts]
    one, other = (fit_of(rows).model(PLAIN.sample(20, 9)) for rows in (data, mixed))
    torch.testing.assert_close(other, one, rtol=0, atol=1e-6)
