"""A camera on the tool that sees a fixed board, and a head that sees one on its own hand."""

from __future__ import annotations

import pytest
import torch
from commanded_bank import BOARD, CAMERA, flange
from commanded_bank import ROWS as ROWS_OF_ARM
from commanded_bank import seen as seen_by_camera
from numbers_bank import normal, rms, tensor
from product_bank import scales_of, usual_scales
from simulated_camera import CameraArm, camera_arm
from simulated_head import CAMERA as HEAD_CAMERA
from simulated_head import CAMERA_AWAY, SeeingHead
from table_bank import held, says
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.placing.lens import BoardSize
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.kinematics.hand_eye import HandEye, hand_eye_sentences
from diffeo_calib.measurements.poses import inverse_poses
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.robots.simulated_arm import SimulatedArm

ROWS, TEST_ROWS = 60, 100
POSITION_STD, ROTATION_STD = 1e-4, 1e-3
MIDDLE = tensor([-0.2, 0.15, 0.0])
"""Of a board whose origin is in a corner, m."""


@pytest.fixture(scope="module")
def seen() -> CameraArm:
    return camera_arm(ROWS + TEST_ROWS)


def from_corner(data: dc.Measurements) -> dc.Measurements:
    """The same poses of a board whose origin is not in its middle."""
    shift = torch.eye(4, dtype=torch.float64)
    shift[:3, 3] = -MIDDLE
    boards = inverse_poses(held(data.poses)) @ shift
    return dc.Measurements.from_poses(data.q, boards, data.joint_names, camera_on_tool=True)


@pytest.mark.slow
def test_the_errors_of_a_camera_are_those_of_the_board_it_sees(seen: CameraArm) -> None:
    """The same numbers as a table of inverted poses lose a third of the accuracy: the noise is not that of the camera.

    The origin of the board is in its corner, so that its middle has to be found.
    """
    robot, rows, q = seen.arm.nominal, slice(ROWS), seen.q[ROWS:]
    result = dc.calibrate(robot, from_corner(seen.measured(POSITION_STD, ROTATION_STD)[rows]))
    plain = dc.calibrate(robot, seen.measured(POSITION_STD, ROTATION_STD, on_tool=False)[rows])
    assert rms(result.model(q) - MIDDLE - seen.arm.true_points(q)) < 0.75 * seen.error(plain.model, q)
    scales = result.selection.scales
    assert 0.5 * POSITION_STD < float(scales.sensor_noise) < 1.5 * POSITION_STD
    assert 0.7 * ROTATION_STD < float(scales.rotation_noise) < 1.3 * ROTATION_STD
    lines = "\n".join(hand_eye_sentences({"camera": HandEye.of(result.model)}))
    assert "hand-eye transform" in lines
    assert "board in the robot's base: 7" in lines, "mm"


@pytest.mark.slow
def test_the_other_direction_is_named(seen: CameraArm) -> None:
    """A table of the camera's own poses; the commands name the other mistake."""
    data = seen.measured(POSITION_STD, ROTATION_STD)[:ROWS]
    with pytest.raises(MeasurementError, match=says("camera in the board's frame already", "camera_on_tool")):
        dc.calibrate(seen.arm.nominal, dc.Measurements.from_poses(data.q, held(data.poses), camera_on_tool=True))


@pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows
def test_the_optical_frame_is_where_it_is_in_the_link_of_the_camera() -> None:
    head = SeeingHead.drawn(100)
    model = dc.calibrate(head.robot, head.images(50, 0.1), hyperparameters=usual_scales(head.robot)).model
    own = HandEye.of(model, camera_on_tool=False).camera
    truth = twist_transform(tensor(CAMERA_AWAY))
    assert own.link == HEAD_CAMERA
    assert bool(((own.pose - truth)[:3, 3].abs() < 4 * own.deviations[:3]).all())
    assert float(own.deviations[:3].max()) < 3e-3


@pytest.mark.parametrize("size", [3e-3, 0.0])
def test_a_board_of_another_size(size: float) -> None:
    """Its squares are 0.3 % larger than the detector was told: it is said, and the camera stays where it is."""
    commanded = flange()
    machine = dc.cartesian(commanded)
    q, boards = dc.pose_inputs(machine, commanded), seen_by_camera(commanded, camera_on_tool=True)
    boards[:, :3, 3] /= 1.0 + size
    data = dc.Measurements.from_poses(q, boards, camera_on_tool=True, doubt=False)
    smaller = boards.clone()
    smaller[:, :3, 3] /= 1.0 + 1e-6
    (part,) = BoardSize.of_table(data, torch.arange(len(q)))
    moved = dc.Measurements.from_poses(q, smaller, camera_on_tool=True, doubt=False).points - data.points
    assert_close(1e-3 * moved.flatten(1) / 1e-6, part.larger[..., 0], rtol=1e-3, atol=1e-7)
    result = dc.calibrate(machine, data, hyperparameters=usual_scales(machine))
    (line,) = [text for text in result.placement.sentences() if text.startswith("board: scale")]
    assert abs(float(line.split()[2]) - 1e6 * size) < 4 * float(line.split()[4])
    camera = HandEye.of(result.model).camera
    off = (camera.pose - CAMERA)[:3, 3].abs()
    assert bool((off < 3 * camera.deviations[:3]).all())
    assert float(off.norm()) < 2e-4
    assert (float(line.split()[4]) <= 100.0) == (size == 0.0), "of a size that the rows do not doubt"


@pytest.mark.parametrize("camera_on_tool", [True, False])
def test_the_mean_error_of_an_arm_may_be_a_camera_or_a_board_elsewhere(camera_on_tool: bool) -> None:
    """Of an arm with wrong joints, whose errors are noise of its poses; not of a perfect one."""
    arm, posture = Geometry.nominal(SimulatedArm(1).nominal), torch.tensor([0.3, -0.9, 1.2, 0.2, 0.8, 0.1])
    q = posture + normal(ROWS_OF_ARM, 6, seed=1) * torch.tensor([0.15, 0.15, 0.15, 0.4, 0.4, 0.6])
    errors = normal(6, 6, seed=51, size=1e-3) * torch.tensor([0.3, 0.3, 0.3, 1.0, 1.0, 1.0])
    commanded, machine = arm.poses(q), dc.cartesian(arm.poses(q))
    usual = {
        "coupled_lengthscale": 0.3,
        "coupled_amplitude": 4e-4,
        "sensor_noise": 1e-4,
        "transmission_amplitude": 1e-6,
    }
    noise = 3e-4
    for size in (0.0, 1.0):
        theta = torch.zeros(arm.size, dtype=torch.float64)
        theta[arm.slices["joints"]] = size * errors.flatten()
        there = seen_by_camera(arm.absorb(theta).poses(q), camera_on_tool=camera_on_tool)
        data = dc.Measurements.from_poses(
            dc.pose_inputs(machine, commanded), there, camera_on_tool=camera_on_tool, doubt=False
        )
        scales = scales_of(6, 6, joint_noise=max(noise * size, 1e-6), **usual)
        model = dc.calibrate(machine, data, hyperparameters=scales).model
        eye = HandEye.of(model, camera_on_tool=camera_on_tool)
        for own, truth in zip((eye.camera, eye.board), (CAMERA, BOARD)[:: 2 * camera_on_tool - 1], strict=True):
            away = own.pose[:3, 3] - truth[:3, 3]
            assert float((away / own.deviations[:3]).square().mean()) < 1.5**2, (size, own.where)
            assert size > 0.0 or float(own.deviations[:3].max()) < 2e-3
    without = HandEye.of(model.changed(scales=0.0 * held(model.scales)), camera_on_tool=camera_on_tool)
    reach = float(commanded[:, :3, 3].mean(0).norm())
    least = noise * (1.0 + reach**2) ** 0.5 * torch.tensor([1.0, 1.0 / reach]).repeat_interleave(3)
    for own, other in zip((eye.camera, eye.board), (without.camera, without.board), strict=True):
        added = own.covariance - other.covariance
        assert bool((added.diagonal().sqrt() > 0.9 * least).all()), own.where
