"""Rotations and rigid transforms: against matrix exponentials and SciPy, and the nearest rotation by its definition."""

import pytest
import torch
from robots_bank import draw
from scipy.spatial.transform import Rotation
from torch import Tensor

from diffeo_calib.common.errors import RobotError
from diffeo_calib.robots.se3 import (
    nearest_rotations,
    right_jacobian,
    rigid,
    roll_pitch_yaw,
    rotation,
    skew,
    transforms,
    twist_transform,
)


@pytest.mark.parametrize("angle", [0.0, 1e-200, 1e-12, 1e-4, 0.3, 0.999999, 1.000001, 2.0, 3.1, 6.5])
def test_rotation_and_its_jacobian_at_every_angle(angle: float) -> None:
    w = angle * torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3
    x, y, z = w.tolist()
    W = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    torch.testing.assert_close(rotation(w), torch.linalg.matrix_exp(W), rtol=0, atol=2e-15)
    # Jr(w) = int_0^1 exp(-s [w]x) ds: the corner of the exponential of [[-W, 1], [0, 0]]
    block = torch.zeros(6, 6, dtype=torch.float64)
    block[:3, :3], block[:3, 3:] = -W, torch.eye(3)
    torch.testing.assert_close(right_jacobian(w), torch.linalg.matrix_exp(block)[:3, 3:], rtol=0, atol=1e-14)


def test_a_twist_translates_first() -> None:
    twist = draw(5, 2, 6)
    found = twist_transform(twist)
    assert found.shape == (5, 2, 4, 4)
    assert torch.equal(found[..., :3, 3], twist[..., :3])
    torch.testing.assert_close(found[..., :3, :3], torch.linalg.matrix_exp(skew(twist[..., 3:])), rtol=0, atol=1e-13)
    assert torch.equal(found[..., 3, :], torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).expand(5, 2, 4))
    assert torch.equal(found, transforms(rotation(twist[..., 3:]), twist[..., :3]))


TURNS = [(0.1, -0.2, 0.3), (4.0, -5.0, 6.0), (1.0, torch.pi / 2, 2.0), (-torch.pi, 0.0, 0.5)]


@pytest.mark.parametrize("angles", TURNS)
def test_roll_pitch_yaw_turns_about_fixed_axes(angles: tuple[float, float, float]) -> None:
    expected = torch.from_numpy(Rotation.from_euler("xyz", angles).as_matrix())
    torch.testing.assert_close(roll_pitch_yaw(*angles), expected, rtol=0, atol=1e-15)


def distance(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).square().sum((-2, -1))


def test_nearest_rotations_are_proper_and_nearest() -> None:
    matrices = draw(6, 3, 3, seed=2)
    assert bool((torch.linalg.det(matrices) < 0).any())  # reflections among them
    found = nearest_rotations(matrices)
    torch.testing.assert_close(found.mT @ found, torch.eye(3, dtype=torch.float64).expand(6, 3, 3), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(6, dtype=torch.float64), rtol=0, atol=1e-14)
    others = rotation(draw(3000, 1, 3, seed=3, size=2.0))
    assert bool((distance(others, matrices) >= distance(found, matrices)).all())
    near = found @ rotation(draw(100, 1, 3, seed=4, size=1e-3))
    assert bool((distance(near, matrices) >= distance(found, matrices)).all())


@pytest.mark.parametrize("entry", [(0, 0, 1.1), (2, 2, -1.0), (3, 0, 0.1), (3, 3, 2.0)])
def test_only_rigid_transforms_pass(entry: tuple[int, int, float]) -> None:
    row, column, value = entry
    assert torch.equal(rigid(torch.eye(4).tolist(), "pose"), torch.eye(4, dtype=torch.float64))
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[row, column] = value
    with pytest.raises(RobotError, match=r"^pose: expected a rigid transform .*; correct the matrix\.$"):
        rigid(matrix, "pose")
