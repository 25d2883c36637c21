"""Machines with commanded poses or places; rotations against matrix exponentials, SciPy, and their definition."""

import pytest
import torch
from robots_bank import draw
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.robots import se3
from diffeo_calib.robots.se3 import nearest_rotations, right_jacobian, roll_pitch_yaw, rotation, transforms, twist_at
from diffeo_calib.robots.tree import robot_from_config


def turns(vectors: Tensor) -> Tensor:
    return torch.from_numpy(Rotation.from_rotvec(vectors.numpy()).as_matrix())


def poses(count: int = 30, *, spread: float = 0.5, seed: int = 0) -> Tensor:
    """Around a tool that points down."""
    draws = torch.randn(count, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return transforms(turns(torch.tensor([[3.1, 0.2, 0.1]])) @ turns(spread * draws[:, 3:]), draws[:, :3])


@pytest.mark.parametrize("spread", [0.1, 0.5])
def test_the_robot_goes_where_it_is_commanded(spread: float) -> None:
    commanded = poses(spread=spread)
    robot = dc.cartesian(commanded)
    q = dc.pose_inputs(robot, commanded)
    assert_close(robot(q), commanded, rtol=0, atol=1e-12)
    again = robot_from_config(robot.to_config())  # a model file keeps the machine
    assert_close(dc.pose_inputs(again, commanded), q, rtol=0, atol=0)
    low, high = robot.limits.unbind(1)
    assert bool(((q >= low) & (q <= high)).all())
    assert float(q[:, 4].sin().abs().max()) < 0.97


def test_orientations_all_around_and_refused_poses() -> None:
    """A wrist that turns all around while it tilts by up to a quarter turn: the mean would be next to a singularity."""
    angles = torch.linspace(-torch.pi, torch.pi, 25, dtype=torch.float64)
    axes = torch.stack([torch.zeros_like(angles), angles, torch.zeros_like(angles)], 1)
    commanded = transforms(turns(axes), torch.zeros_like(axes))
    robot = dc.cartesian(commanded)
    assert_close(robot(dc.pose_inputs(robot, commanded)), commanded, rtol=0, atol=1e-12)
    with pytest.raises(dc.DiffeoCalibError, match=r"`poses`, row \d+: expected orientations .* got \d+"):
        dc.cartesian(poses(3000, spread=3.0))
    robot, commanded = dc.cartesian(poses()), poses()
    commanded[3, :3, :3] *= 1.1
    with pytest.raises(dc.DiffeoCalibError, match="`poses`, row 3: expected a rotation matrix"):
        dc.cartesian(commanded)
    with pytest.raises(dc.DiffeoCalibError, match=r"`poses`: expected \(N, 4, 4\), got \(30, 3\)"):
        dc.pose_inputs(robot, poses()[:, :3, 3])
    arm = dc.from_dh([dc.DHRow(a=1.0, alpha=0.0, d=0.0, theta=0.0)])
    with pytest.raises(dc.DiffeoCalibError, match="expected a machine with commanded poses"):
        dc.pose_inputs(arm, poses())


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_places(axes: int) -> None:
    places = poses()[:, :axes, 3]
    robot = dc.cartesian(places)
    assert robot.n == axes
    assert_close(robot(dc.pose_inputs(robot, places))[:, :axes, 3], places)
    assert robot.kinds == ("prismatic",) * axes


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


@pytest.mark.parametrize("angles", [(0.1, -0.2, 0.3), (4.0, -5.0, 6.0), (1.0, torch.pi / 2, 2.0), (-torch.pi, 0, 0.5)])
def test_roll_pitch_yaw_turns_about_fixed_axes_and_comes_back(angles: tuple[float, float, float]) -> None:
    expected = torch.from_numpy(Rotation.from_euler("xyz", angles).as_matrix())
    found = roll_pitch_yaw(*angles)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-15)
    torch.testing.assert_close(roll_pitch_yaw(*se3.roll_pitch_yaw_angles(found)), expected, rtol=0, atol=1e-15)


def test_nearest_rotations_are_proper_and_nearest() -> None:
    matrices = draw(6, 3, 3, seed=2)
    assert bool((torch.linalg.det(matrices) < 0).any())  # reflections among them
    found = nearest_rotations(matrices)
    torch.testing.assert_close(found.mT @ found, torch.eye(3, dtype=torch.float64).expand(6, 3, 3), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(6, dtype=torch.float64), rtol=0, atol=1e-14)
    least = (found - matrices).square().sum((-2, -1))
    for others in (rotation(draw(3000, 1, 3, seed=3, size=2.0)), found @ rotation(draw(100, 1, 3, size=1e-3))):
        assert bool(((others - matrices).square().sum((-2, -1)) >= least).all())
