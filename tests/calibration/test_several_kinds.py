"""Tables of several kinds: devices and ball are found within their deviations, each table as a user joins it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from reading_bank import POINTS, readings, scales
from simulated_sockets import rest_in_sockets
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.result import errors_by_kind
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.placement import rigid_fit

ARM = SimulatedArm(3)
NAMES = ARM.nominal.joint_names
NOISE = 2e-5


def positions(count: int) -> dc.Measurements:
    return dc.Measurements(*ARM.measure(count, seed=4), NAMES)


def sockets() -> dc.Measurements:
    rows = rest_in_sockets(ARM, seed=3, places=4, rows=5)
    return dc.Measurements.from_sockets(rows.q, rows.names, NAMES, distances={("0", "1"): 0.05}, distance_std=1e-5)


def read(kind: str, count: int, zero: float = 0.0) -> dc.Readings:
    return readings(ARM, kind, count, zero, noise=NOISE)


def calibrated(parts: list[object], **options: object) -> Any:
    """Of the joined tables, with the noise of each kind given."""
    data = dc.Observations.joined(parts)
    other = torch.full((len({part.kind for part in data.parts}) - 1,), NOISE, dtype=torch.float64)
    given = replace(scales(), other_noise=other if len(other) else None)
    return dc.calibrate(ARM.nominal, data, hyperparameters=given, **options)  # type: ignore[arg-type]


def ball_errors(result: Any, *, free: bool, q: Tensor | None = None) -> Tensor:
    """Errors (N, 3) of the ball, m; after a rigid fit if no device says where the robot stands."""
    q = ARM.sample(200, 9) if q is None else q
    truth, found = ARM.true_points(q)[:, 0], result.model(q).detach()[:, -1]
    T = rigid_fit(found, truth) if free else torch.eye(4, dtype=torch.float64)
    return found @ T[:3, :3].mT + T[:3, 3] - truth


def rms(errors: Tensor) -> float:
    return float(errors.square().sum(-1).mean().sqrt())


CASES = {
    "sockets, distances": lambda: [sockets(), read("distance", 36)],
    "positions, distances from another zero": lambda: [positions(25), read("distance", 36, 0.03)],
    "positions, sockets, images": lambda: [positions(20), sockets(), read("image", 24)],
}


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * ("images" in name)) for name in CASES])
def test_as_accurate_as_expected(name: str) -> None:
    """Better than geometry, and as good as the model says; errors of every kind are judged by themselves."""
    parts = CASES[name]()
    result = calibrated(parts)
    free = not any(part.kind == "position" for part in parts)
    error = rms(ball_errors(result, free=free))
    assert 0.5 * result.expected.workspace < error < 1.8 * result.expected.workspace
    assert result.fit.converged
    kinds = errors_by_kind(result, dc.Observations.joined(parts))
    assert len(kinds) == len(parts)
    for one in kinds.values():
        assert one.stages["calibrated"].rms < one.stages["geometric"].rms


@pytest.fixture(scope="module")
def joint() -> Any:
    return calibrated([positions(25), read("distance", 36)])


@pytest.mark.slow
def test_devices_are_where_they_are_within_their_deviations(joint: Any) -> None:
    """Three fixed points in the tracker's frame, and the ball as a marker of its own."""
    base = ARM.truth.base
    ranges = joint.readings[0]
    errors = ranges.devices.constants[:, :3] - (POINTS @ base[:3, :3].mT + base[:3, 3])
    away = errors / ranges.known[:, :3]
    assert float(away.square().mean()) < 4.0
    assert 1e-6 < float(ranges.known[:, :3].max()) < 1e-3
    assert float((joint.model.geometry.tool[1] - ARM.truth.tool[0]).norm()) < 1e-3
    assert joint.model.markers == 2
    assert "mm in the measuring frame" in joint.placement.sentences()[0]


@pytest.mark.slow
def test_the_order_of_the_rows_does_not_matter() -> None:
    data = dc.Observations.joined([positions(20), read("distance", 24), read("height", 24)])
    order = torch.randperm(len(data), generator=torch.Generator().manual_seed(2))
    order[order.argmin()], order[0] = order[0].clone(), 0  # positions stay the first kind
    mixed = data.rows(order.tolist())
    assert [part.kind for part in data.parts] != [part.kind for part in mixed.parts]
    q, given = ARM.sample(20, 9), replace(scales(), other_noise=torch.full((2,), NOISE, dtype=torch.float64))
    one, other = (dc.calibrate(ARM.nominal, rows, hyperparameters=given).model(q) for rows in (data, mixed))
    torch.testing.assert_close(other, one, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_payloads() -> None:
    def laden(data: dc.Measurements | dc.Readings) -> object:
        return data.with_payload(torch.tensor([0.0, 2.0, 5.0], dtype=torch.float64)[torch.arange(len(data)) % 3])

    result = calibrated([laden(positions(25)), laden(read("distance", 36))])
    assert rms(ball_errors(result, free=False)) < 2 * result.expected.workspace


def test_sessions() -> None:
    """The tracker stood twice; readings belong to no set-up."""
    shift = torch.tensor([0.01, -0.02, 0.005], dtype=torch.float64)
    data = positions(30)
    moved = data.points + shift * (torch.arange(30) % 2)[:, None, None]
    twice = dc.Measurements(data.q, moved, NAMES).with_sessions(["first", "second"] * 15)
    result = calibrated([twice, read("distance", 36)])
    T = result.sessions.transforms[1]
    place = data.points[:, 0].mean(0)
    torch.testing.assert_close(T[:3, :3] @ place + T[:3, 3], place + shift, rtol=0, atol=1.5e-4)
    assert rms(ball_errors(result, free=False)) < 2 * result.expected.workspace


@pytest.mark.slow
def test_controls(joint: Any) -> None:
    """Fewer momenta than rows: the deviations of devices are found as well."""
    coarse = calibrated([positions(25), read("distance", 36)], controls=40)
    for one, other in zip(joint.readings, coarse.readings, strict=True):
        torch.testing.assert_close(other.known, one.known, rtol=0.1, atol=1e-6)
    assert rms(joint.model(ARM.sample(50, 2)).detach() - coarse.model(ARM.sample(50, 2)).detach()) < 1e-4


def test_poses_in_a_table_of_several_kinds_are_refused() -> None:
    q = ARM.sample(30, 2)
    posed = dc.Measurements.from_poses(q, ARM.truth.marker_poses(q)[:, 0], NAMES)
    for rows, kind in ((read("distance", 36), "distances"), (sockets(), "sockets")):
        with pytest.raises(MeasurementError, match=f"expected positions, got poses and {kind}"):
            calibrated([posed, rows])
