"""The benchmark of machines that are told poses or places: its machines, and that they are calibrated."""

from __future__ import annotations

import numpy as np
import pytest
import told_machines

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")]


def test_least_squares_find_what_has_no_noise() -> None:
    told = told_machines.flange_poses(np.random.default_rng(0), 12)
    seen = np.linalg.inv(told @ told_machines.CAMERA) @ told_machines.BOARD
    camera, board = told_machines.squares(told, seen)
    np.testing.assert_allclose(camera, told_machines.CAMERA, atol=1e-9)
    np.testing.assert_allclose(board, told_machines.BOARD, atol=1e-9)


@pytest.mark.parametrize("machine", told_machines.MACHINES)
def test_an_error_field_is_found(machine: str) -> None:
    found = told_machines.field(machine, 120, 0)
    assert float(found["after_mm"] or 0.0) < 0.4 * float(found["before_mm"] or 0.0)
    assert float(found["inside"] or 0.0) > 0.85


def test_a_perfect_arm() -> None:
    found = told_machines.hand_eye(20, 0.0, 0)
    assert float(found["camera_mm"] or 0.0) < 0.3
    assert float(found["sigmas"] or 0.0) < 4.0
