"""Machines with commanded poses or places: the identity as a chain, wherever the poses are."""

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.robots.se3 import transforms
from diffeo_calib.robots.tree import robot_from_config


def turns(vectors: Tensor) -> Tensor:
    """(N, 3, 3) of rotation vectors (N, 3), rad."""
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


def test_orientations_all_around_one_axis_and_far_about_another() -> None:
    """A wrist that turns all around while it tilts by up to a quarter turn: the mean would be next to a singularity."""
    angles = torch.linspace(-torch.pi, torch.pi, 25, dtype=torch.float64)
    axes = torch.stack([torch.zeros_like(angles), angles, torch.zeros_like(angles)], 1)
    commanded = transforms(turns(axes), torch.zeros_like(axes))
    robot = dc.cartesian(commanded)
    assert_close(robot(dc.pose_inputs(robot, commanded)), commanded, rtol=0, atol=1e-12)


def test_orientations_that_no_middle_holds() -> None:
    with pytest.raises(dc.DiffeoCalibError, match=r"`poses`, row \d+: expected orientations .* got \d+"):
        dc.cartesian(poses(3000, spread=3.0))


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_places(axes: int) -> None:
    places = poses()[:, :axes, 3]
    robot = dc.cartesian(places)
    assert robot.n == axes
    assert_close(robot(dc.pose_inputs(robot, places))[:, :axes, 3], places)
    assert robot.kinds == ("prismatic",) * axes


def test_bad_poses() -> None:
    robot, commanded = dc.cartesian(poses()), poses()
    commanded[3, :3, :3] *= 1.1
    with pytest.raises(dc.DiffeoCalibError, match="`poses`, row 3: expected a rotation matrix"):
        dc.cartesian(commanded)
    with pytest.raises(dc.DiffeoCalibError, match=r"`poses`: expected \(N, 4, 4\), got \(30, 3\)"):
        dc.pose_inputs(robot, poses()[:, :3, 3])
    arm = dc.from_dh([dc.DHRow(a=1.0, alpha=0.0, d=0.0, theta=0.0)])
    with pytest.raises(dc.DiffeoCalibError, match="expected a machine with commanded poses"):
        dc.pose_inputs(arm, poses())
