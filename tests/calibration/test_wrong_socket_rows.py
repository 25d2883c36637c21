"""Single rows in sockets that are wrong by less than a millimetre are named; clean rows and flat tables are not."""

from __future__ import annotations

import warnings

import pytest
import torch
from simulated_sockets import rest_in_sockets

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.socket_plausibility import warn_of_flat_places, with_raised_place
from diffeo_calib.calibration.placing.sockets import contradicted_in_sockets
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots import SimulatedArm

WRONG = [10, 45]
SHIFT_M = 8e-4


@pytest.fixture(scope="module")
def arm() -> SimulatedArm:
    return SimulatedArm(seed=2)


@pytest.fixture(scope="module")
def clean(arm: SimulatedArm) -> dc.Measurements:
    """Three places, whose sockets lie near a plane as those of any three do."""
    rows = rest_in_sockets(arm, seed=2, places=3, rows=10)
    names = arm.nominal.joint_names
    return dc.Measurements.from_sockets(rows.q, rows.names, names, distances={("0", "1"): 0.05}, distance_std=1e-5)


@pytest.fixture(scope="module")
def result(arm: SimulatedArm, clean: dc.Measurements) -> dc.CalibrationResult:
    """Of rows two of which are wrong; nobody says that a plane is too little for the workspace."""
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*lie near.*")
        return dc.calibrate(arm.nominal, moved(arm, clean, WRONG))


def moved(arm: SimulatedArm, data: dc.Measurements, rows: list[int]) -> dc.Measurements:
    """Some rows with joint values at which the ball is 0.8 mm beside its socket."""
    q = data.q.clone()
    slopes = arm.truth.jacobian(q[rows])[:, 0]
    away = torch.tensor([0.0, SHIFT_M, 0.0], dtype=q.dtype)
    q[rows] += torch.linalg.pinv(slopes) @ away
    return with_attributes(data, q=q)


def test_rows_of_the_fit_are_named(result: dc.CalibrationResult) -> None:
    assert sorted(one.row for one in result.outliers) == WRONG
    for one in result.outliers:
        assert one.distance == pytest.approx(SHIFT_M, rel=0.4)
        assert one.weight is not None
        assert one.weight < 0.3


def test_rows_that_took_no_part_are_named(arm: SimulatedArm, result: dc.CalibrationResult) -> None:
    rows = rest_in_sockets(arm, seed=7, places=1, rows=10)
    new = dc.Measurements.from_sockets(rows.q, rows.names, arm.nominal.joint_names)
    assert contradicted_in_sockets(result.model, new) == []
    wrong = contradicted_in_sockets(result.model, moved(arm, new, [7]))
    assert [one.row for one in wrong] == [7]
    assert wrong[0].weight is None
    assert wrong[0].distance == pytest.approx(SHIFT_M, rel=0.4)
    two = moved(arm, new, [7]).rows([0, 7])
    assert contradicted_in_sockets(result.model, two) == [], "two rows cannot tell which of them is wrong"


def test_a_raised_place_tells_something_if_it_is_reached(result: dc.CalibrationResult, clean: dc.Measurements) -> None:
    fitted = result.model.map
    assert result.sockets is not None
    assert clean.places is not None
    assert clean.socket is not None
    away = torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    rows = clean.places == clean.places.mode().values
    socket = clean.socket[rows]
    resting = clean.q[rows], result.sockets.positions[socket], socket
    found = with_raised_place(fitted, *resting, away)
    assert found is not None
    assert found < result.sockets.workspace_deviation
    far = with_raised_place(fitted, *resting, 20 * away)
    assert far is None, "nobody reaches 2 m"


def test_a_plane_is_named_where_it_matters(result: dc.CalibrationResult, clean: dc.Measurements) -> None:
    assert result.sockets is not None
    assert clean.socket is not None
    found = result.sockets
    flat = found.positions.clone()
    flat[:, 2] = 0.2

    def warned(positions: torch.Tensor, expected_error: float) -> list[str]:
        with warnings.catch_warnings(record=True) as texts:
            warnings.simplefilter("always")
            warn_of_flat_places(result.model.map, positions, found.socket, found.sockets.place, expected_error)
        return [str(text.message) for text in texts]

    assert warned(flat, found.workspace_deviation) == []
    large = warned(flat, 10 * found.workspace_deviation)
    assert len(large) == 1
    assert "the sockets lie near a plane" in large[0]
    assert "raise or tilt the block at one place" in large[0]
    tall = flat.clone()
    tall[[0, 3], 2] = 0.9
    assert warned(tall, 10 * found.workspace_deviation) == []
