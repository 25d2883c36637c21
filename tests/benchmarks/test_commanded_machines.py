"""The benchmark of machines with commanded poses or places: its machines, and that they are calibrated."""

from __future__ import annotations

import commanded_machines
import numpy as np
import pytest

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")]


def test_least_squares_find_what_has_no_noise() -> None:
    commanded = commanded_machines.flange_poses(np.random.default_rng(0), 12)
    seen = np.linalg.inv(commanded @ commanded_machines.CAMERA) @ commanded_machines.BOARD
    camera, board = commanded_machines.squares(commanded, seen)
    np.testing.assert_allclose(camera, commanded_machines.CAMERA, atol=1e-9)
    np.testing.assert_allclose(board, commanded_machines.BOARD, atol=1e-9)


def test_the_bound_is_the_error_of_least_squares_where_the_arm_is_perfect() -> None:
    rng = np.random.default_rng(1)
    flange = commanded_machines.flange_poses(rng, 20)
    exact = np.linalg.inv(flange @ commanded_machines.CAMERA) @ commanded_machines.BOARD
    found = []
    for _ in range(60):
        seen = commanded_machines.transform(commanded_machines.TURN_NOISE_RAD * rng.normal(size=(20, 3))) @ exact
        seen[:, :3, 3] = exact[:, :3, 3] + commanded_machines.SHIFT_NOISE_M * rng.normal(size=(20, 3))
        camera, _ = commanded_machines.squares(flange, seen)
        found.append(np.square(camera[:3, 3] - commanded_machines.CAMERA[:3, 3]).sum())
    bound = commanded_machines.bound_mm(flange, 0.0)
    assert 1e3 * np.mean(found) ** 0.5 == pytest.approx(bound, rel=0.2)
    assert commanded_machines.bound_mm(flange, 1e-3) > 3.0 * bound


@pytest.mark.parametrize("machine", commanded_machines.MACHINES)
def test_an_error_field_is_found(machine: str) -> None:
    found = commanded_machines.field(machine, 120, 0)
    assert float(found["after_mm"] or 0.0) < 0.4 * float(found["before_mm"] or 0.0)
    assert float(found["inside"] or 0.0) > 0.85


@pytest.mark.parametrize("arm_mm", [0.0, 0.3])
def test_images_of_a_board(arm_mm: float) -> None:
    """A bundle adjustment takes an arm's errors for the lens."""
    found = commanded_machines.hand_eye(20, arm_mm, 0, 0.1)
    assert float(found["camera_mm"] or 0.0) < 0.1 + 2.0 * arm_mm
    assert (float(found["peer_mm"] or 0.0) < 0.1) is (arm_mm == 0.0)
