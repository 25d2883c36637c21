"""A head that sees a board on its own hand: the camera's link, which the neck moves, is the base of the chain."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
import torch
from golden_bank import usual_scales
from kind_bank import rigid_rms
from simulated_head import CAMERA, CAMERA_AWAY, HAND, SeeingHead

import diffeo_calib as dc
from diffeo_calib.kinematics.hand_eye import HandEye
from diffeo_calib.robots.se3 import twist_transform

pytestmark = pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows

TEST_ROWS = 40


@cache
def head() -> SeeingHead:
    return SeeingHead.drawn(60 + TEST_ROWS)


@cache
def calibrated() -> Any:
    return dc.calibrate(head().robot, head().images(50, 0.1), hyperparameters=usual_scales(head().robot))


def test_the_chain_leads_from_the_camera_over_the_neck_to_the_hand() -> None:
    robot = head().robot
    assert (robot.base, robot.tips) == (CAMERA, (HAND,))
    assert robot.joint_names[:2] == ("neck_pitch", "neck_yaw")


def test_errors_of_neck_and_arm_are_found() -> None:
    new = head().q[-TEST_ROWS:]
    truth = head().true_points(new)
    nominal, found = (
        1e3 * rigid_rms(points.detach(), truth)
        for points in (calibrated().registration.geometry.points(new), calibrated().model(new))
    )
    assert nominal > 0.5
    assert found < 0.2 * nominal


def test_the_optical_frame_is_where_it_is_in_the_link_of_the_camera() -> None:
    own = HandEye.of(calibrated().model, camera_on_tool=False).camera
    truth = twist_transform(torch.tensor(CAMERA_AWAY, dtype=torch.float64))
    assert own.link == CAMERA
    assert bool(((own.pose - truth)[:3, 3].abs() < 4 * own.deviations[:3]).all())
    assert float(own.deviations[:3].max()) < 3e-3
