"""Markers that nobody measured: refused with the proof, warned of with evidence; right ones are neither."""

from __future__ import annotations

import warnings

import pytest
import torch

import diffeo_calib as dc
from diffeo_calib.calibration.diagnostics.plausibility import check_markers, unmeasured_markers
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.robots.joint import Joint
from diffeo_calib.robots.simulated_arm import SimulatedArm

ARM = SimulatedArm(seed=5, markers=2)
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def rows(count: int = 40) -> dc.Measurements:
    q, points = ARM.measure(count, seed=1)
    return dc.Measurements(q, points, ARM.nominal.joint_names)


def with_second(points: torch.Tensor) -> dc.Measurements:
    data = rows(len(points))
    return dc.Measurements(data.q, torch.stack([data.points[:, 0], points], 1), data.joint_names)


def wished(digits: int, reached: float = 0.0) -> torch.Tensor:
    """Places of the nominal robot in another frame, to so many digits of a mm, at joint values reached so well, rad."""
    q = rows().q
    q = q + reached * torch.randn(q.shape, generator=torch.Generator().manual_seed(0), dtype=q.dtype)
    poses = ARM.nominal(q)
    at = poses[:, :3, :3] @ poses.new_tensor([0.02, 0.03, 0.1]) + poses[:, :3, 3]
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.3, 0.1], [0.3, 0.0, 0.2], [-0.1, -0.2, 0.0]], dtype=q.dtype))
    return ((at @ turn.mT + 0.4) * 10.0 ** (3 + digits)).round() / 10.0 ** (3 + digits)


def test_measured_markers_are_silent() -> None:
    assert not list(unmeasured_markers(ARM.nominal, rows()))
    assert not list(unmeasured_markers(ARM.nominal, rows(8)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_markers(ARM.nominal, rows())


@pytest.mark.parametrize("digits", [2, 4, 9])
def test_places_of_the_nominal_robot_are_refused(digits: int) -> None:
    data = with_second(wished(digits))
    with pytest.raises(MeasurementError, match=r"marker 1 follows the nominal robot to 0\.00.* mm, another one to"):
        dc.calibrate(ARM.nominal, data)


def test_places_of_almost_the_nominal_robot_are_doubted() -> None:
    data = with_second(wished(4, reached=3e-5))
    with pytest.warns(DiffeoCalibWarning, match="marker 1 follows the nominal robot"):
        check_markers(ARM.nominal, data)


def test_a_marker_that_is_near_the_nominal_robot_is_measured_where_the_other_one_does_not_belong() -> None:
    """A robot with errors of micrometres, and a marker that is not on its tip: no proof against the first."""
    data = with_second(wished(4, reached=3e-5))
    elsewhere = ARM.nominal(data.q.roll(1, 0))[:, :3, 3]
    points = torch.stack([elsewhere, data.points[:, 1]], 1)
    assert not list(unmeasured_markers(ARM.nominal, dc.Measurements(data.q, points, data.joint_names)))


def test_markers_above_each_other_on_a_robot_that_turns_about_one_axis_are_two() -> None:
    joints = [
        Joint(f"j{k}", "revolute", torch.eye(4, dtype=torch.float64), UP, lower=-2.0, upper=2.0) for k in range(2)
    ]
    joints[1].origin[0, 3] = 0.4
    robot, shift = dc.Chain("planar", "base", "tip", joints), torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    q = 4.0 * torch.rand(40, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 2.0
    poses = robot(q)
    first = poses[:, :3, 3] + 0.3 * poses[:, :3, 0] + 1e-3 * torch.sin(q[:, :1])
    assert not list(unmeasured_markers(robot, dc.Measurements(q, torch.stack([first, first + shift], 1))))


def test_copies_are_refused_also_shifted_ones() -> None:
    first = rows().points[:, 0]
    with pytest.raises(MeasurementError, match="marker 1 is a copy of marker 0"):
        dc.calibrate(ARM.nominal, with_second(first.clone()))
    with pytest.raises(MeasurementError, match="copy of marker 0, shifted by the same"):
        check_markers(ARM.nominal, with_second(first + torch.tensor([0.1, 0.0, 0.2], dtype=first.dtype)))
    hidden = first.clone()
    hidden[::2] = torch.nan
    assert [one.proved for one in unmeasured_markers(ARM.nominal, with_second(hidden))] == [True]
