"""Rotations: against matrix exponentials and SciPy, and the nearest rotation by its definition."""

import pytest
import torch
from robots_bank import draw
from scipy.spatial.transform import Rotation

from diffeo_calib.robots.se3 import (
    nearest_rotations,
    right_jacobian,
    roll_pitch_yaw,
    roll_pitch_yaw_angles,
    rotation,
    twist_at,
)


@pytest.mark.parametrize("angle", [0.0, 1e-200, 1e-12, 1e-4, 0.3, 0.999999, 1.000001, 2.0, 3.1, 6.5])
def test_rotation_and_its_jacobian_at_every_angle(angle: float) -> None:
    w = angle * torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    x, y, z = w.tolist()
    W = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    torch.testing.assert_close(rotation(w), torch.linalg.matrix_exp(W), rtol=0, atol=2e-15)
    torch.testing.assert_close(twist_at(w.roll(1)) @ torch.cat([w, w]), torch.cat([w + W @ w.roll(1), w]))
    # Jr(w) = int_0^1 exp(-s [w]x) ds: the corner of the exponential of [[-W, 1], [0, 0]]
    block = torch.zeros(6, 6, dtype=torch.float64)
    block[:3, :3], block[:3, 3:] = -W, torch.eye(3)
    torch.testing.assert_close(right_jacobian(w), torch.linalg.matrix_exp(block)[:3, 3:], rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "angles", [(0.1, -0.2, 0.3), (4.0, -5.0, 6.0), (1.0, torch.pi / 2, 2.0), (-torch.pi, 0.0, 0.5)]
)
def test_roll_pitch_yaw_turns_about_fixed_axes_and_comes_back(angles: tuple[float, float, float]) -> None:
    expected = torch.from_numpy(Rotation.from_euler("xyz", angles).as_matrix())
    found = roll_pitch_yaw(*angles)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-15)
    torch.testing.assert_close(roll_pitch_yaw(*roll_pitch_yaw_angles(found)), expected, rtol=0, atol=1e-15)


def test_nearest_rotations_are_proper_and_nearest() -> None:
    matrices = draw(6, 3, 3, seed=2)
    assert bool((torch.linalg.det(matrices) < 0).any())  # reflections among them
    found = nearest_rotations(matrices)
    torch.testing.assert_close(found.mT @ found, torch.eye(3, dtype=torch.float64).expand(6, 3, 3), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(6, dtype=torch.float64), rtol=0, atol=1e-14)
    least = (found - matrices).square().sum((-2, -1))
    for others in (rotation(draw(3000, 1, 3, seed=3, size=2.0)), found @ rotation(draw(100, 1, 3, size=1e-3))):
        assert bool(((others - matrices).square().sum((-2, -1)) >= least).all())
