"""Measurements that cannot belong to the robot are refused, with the likely mistake."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from kind_bank import kind_named
from product_bank import simulated, simulated_poses

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError, RobotError

NOT_THIS_ROBOT = "the measurements do not fit this robot"


@dataclass(frozen=True)
class Few:
    """A robot and some of its rows: nothing here is fitted to the end."""

    robot: dc.Chain
    rows: dc.Measurements


@pytest.fixture(scope="module")
def arm() -> Few:
    arm, train, _ = simulated(30)
    return Few(arm.nominal, train)


@pytest.mark.slow
def test_units_and_pairings_that_cannot_be_right_are_refused(arm: Few) -> None:
    q, points = arm.rows.q, arm.rows.points
    for wrong, message in (
        (dc.Measurements(q, 1e3 * points), "do not fit this robot.*positions seem to be 1000 times too large"),
        (dc.Measurements(q, 1e-3 * points), "do not fit this robot.*positions seem to be 1000 times too small"),
        (dc.Measurements(q.deg2rad(), points), "do not fit this robot.*radians that were converted.*angle unit"),
        (dc.Measurements(q, points.roll(1, 0)), "do not fit this robot.*one row too late: pair every configuration"),
    ):
        with pytest.raises(MeasurementError, match=message):
            dc.calibrate(arm.robot, wrong)


def test_points_that_never_move_are_refused(arm: Few) -> None:
    """As of two hands that hold one tool."""
    still = dc.Measurements(arm.rows.q, arm.rows.points[:1].expand_as(arm.rows.points).clone())
    with pytest.raises(MeasurementError, match=r"never move.* got 0 m; .*a ball in one hand that rests in sockets"):
        dc.calibrate(arm.robot, still)


def test_another_number_or_order_of_joints_is_refused(arm: Few) -> None:
    q, points = arm.rows.q, arm.rows.points
    with pytest.raises(MeasurementError, match=r"expected 6 joints .waist_joint.*, got 5; check the base and tip"):
        dc.calibrate(arm.robot, dc.Measurements(q[:, :5], points))
    with pytest.raises(RobotError, match="put the columns in the robot's order"):
        dc.calibrate(arm.robot, dc.Measurements(q, points, joint_names=arm.robot.joint_names[::-1]))
    with pytest.raises(RobotError, match=r"got \S*q1.*joints=.*from_dh\(\.\.\., names="):
        dc.calibrate(arm.robot, dc.Measurements(q, points, joint_names=[f"q{k}" for k in range(1, 7)]))


@pytest.mark.parametrize("rows", [1, 2])
def test_too_few_rows_to_register(rows: int, arm: Few) -> None:
    with pytest.raises(MeasurementError, match=r"at least 3 poses, got .*measure more poses"):
        dc.calibrate(arm.robot, arm.rows.rows(slice(rows)))


def test_one_configuration_measured_many_times_is_refused_for_what_it_is(arm: Few) -> None:
    q = arm.rows.q[:1].repeat(30, 1)
    noise = 1e-5 * torch.randn(30, 1, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with pytest.raises(MeasurementError, match=r"same configuration|does not move"):
        dc.calibrate(arm.robot, dc.Measurements(q, arm.rows.points[:1] + noise))


@pytest.mark.slow
def test_two_joint_columns_swapped(arm: Few) -> None:
    order = list(range(6))
    first, second = 2, 4
    order[first], order[second] = second, first
    words = "the rows fit, in degrees and mm, with joints='waist_joint,shoulder_joint,wrist_bend_joint,"
    with pytest.raises(MeasurementError, match=rf"{NOT_THIS_ROBOT}.*; {words}"):
        dc.calibrate(arm.robot, dc.Measurements(arm.rows.q[:, order], arm.rows.points))


@pytest.mark.slow
@pytest.mark.parametrize("joint", [1, 5])
def test_a_joint_with_the_opposite_sign(joint: int, arm: Few) -> None:
    """The first joint's is another frame of the device and cannot be noticed but by its mirrored errors."""
    q = arm.rows.q.clone()
    q[:, joint] *= -1
    words = f"-.{arm.robot.joint_names[joint]}."
    with pytest.raises(MeasurementError, match=f"{NOT_THIS_ROBOT}.*; the rows fit, .*{words}"):
        dc.calibrate(arm.robot, dc.Measurements(q, arm.rows.points))


@pytest.mark.slow
def test_points_in_a_left_handed_frame(arm: Few) -> None:
    points = arm.rows.points[..., [1, 0, 2]]
    with pytest.raises(MeasurementError, match=f"{NOT_THIS_ROBOT}.*; .* seems to be left-handed"):
        dc.calibrate(arm.robot, dc.Measurements(arm.rows.q, points))


@pytest.mark.slow
def test_a_joint_offset_of_a_right_angle(arm: Few) -> None:
    q = arm.rows.q.clone()
    q[:, 2] += math.pi / 2
    with pytest.raises(MeasurementError, match=rf"{NOT_THIS_ROBOT}.*; the rows fit, .*,.elbow_joint.-90,"):
        dc.calibrate(arm.robot, dc.Measurements(q, arm.rows.points))


@pytest.mark.slow
def test_degrees_instead_of_radians(arm: Few) -> None:
    data = dc.Measurements(180 / math.pi * arm.rows.q, arm.rows.points, doubt=False)
    words = "the joint values seem to be degrees.*check the angle unit"
    with pytest.raises(MeasurementError, match=f"{NOT_THIS_ROBOT}.*; {words}"):
        dc.calibrate(arm.robot, data)


@pytest.mark.slow
def test_inverted_poses() -> None:
    posed, train, _ = simulated_poses(30)
    poses = train.poses
    assert poses is not None
    data = dc.Measurements.from_poses(train.q, torch.linalg.inv(poses))
    with pytest.raises(MeasurementError, match=f"{NOT_THIS_ROBOT}.*; the poses seem to be those .* seen from the tool"):
        dc.calibrate(posed.nominal, data)


@pytest.mark.slow
def test_many_rows_with_the_points_of_others(arm: Few) -> None:
    points = arm.rows.points.clone()
    points[:15] = points[:15].roll(1, 0)
    with pytest.raises(MeasurementError, match=NOT_THIS_ROBOT):
        dc.calibrate(arm.robot, dc.Measurements(arm.rows.q, points))


@pytest.mark.parametrize("name", ["poses", "several tips"])
def test_poses_in_another_unit_of_lengths_are_told_so(name: str) -> None:
    """The points that represent a pose keep a size of their own, which no check of sizes sees."""
    kind = kind_named(name)
    frames = kind.data.frames.clone()
    frames[..., :3, 3] *= 1e-3
    on = None if kind.data.on is None else kind.data.on[::3]
    poses = frames if frames.shape[1] > 1 else frames[:, 0]
    data = dc.Measurements.from_poses(kind.data.q, poses, kind.data.joint_names, on=on)
    with pytest.raises(MeasurementError, match=r"positions seem to be 1000 times too small.*check their unit"):
        dc.calibrate(kind.robot, data, hyperparameters=kind.scales)
