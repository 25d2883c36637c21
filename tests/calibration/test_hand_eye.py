"""A camera on the tool that sees a fixed board, and a head that sees one on its own hand."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import torch
from command_bank import Command
from kind_bank import rigid_rms
from product_bank import usual_scales
from simulated_camera import BOARD, CAMERA, CameraArm, camera_arm
from simulated_head import CAMERA as HEAD_CAMERA
from simulated_head import CAMERA_AWAY, SeeingHead
from table_bank import held, says
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.identification.identification import identify
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.calibration.scales.noise_model import with_best_seen_point
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.kinematics.hand_eye import HandEye, hand_eye_sentences
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.poses import inverse_poses
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.reports.results import SCHEMA
from diffeo_calib.robots.se3 import rotation, twist_transform

ROWS, TEST_ROWS = 60, 100
POSITION_STD, ROTATION_STD = 1e-4, 1e-3
MIDDLE = (-0.2, 0.15, 0.0)
"""Of a board whose origin is in a corner, m."""
TABLE = TableFormat("mm", "deg", rotation=["a", "b", "c"], convention="rotvec", camera_on_tool=True)
OPTIONS = ["--position", "x,y,z", "--rotation", "a,b,c", "--convention", "rotvec", "--rotation-angle", "deg"]
OPTIONS += ["--length", "mm", "--angle", "deg", "--base", "base_link", "--tip", "flange"]


@pytest.fixture(scope="module")
def seen() -> CameraArm:
    return camera_arm(ROWS + TEST_ROWS)


def from_corner(data: dc.Measurements) -> dc.Measurements:
    """The same poses of a board whose origin is not in its middle."""
    shift = torch.eye(4, dtype=torch.float64, device=HOST)
    shift[:3, 3] = -torch.tensor(MIDDLE, dtype=torch.float64, device=HOST)
    boards = inverse_poses(held(data.poses)) @ shift
    return dc.Measurements.from_poses(data.q, boards, data.joint_names, camera_on_tool=True)


@pytest.mark.slow
def test_the_best_seen_point_is_where_position_and_rotation_err_independently(seen: CameraArm) -> None:
    data = from_corner(seen.measured(POSITION_STD, ROTATION_STD))
    found = identify(register(seen.arm.nominal, data.q, data.points).geometry, data.q, data.points)
    moved = held(with_best_seen_point(data, found).board) - held(data.board)
    points = (held(data.poses)[:, :3, :3] @ moved[..., None])[..., 0]
    assert_close(points, points[:1].expand_as(points), rtol=0, atol=1e-12)
    assert float((points[0] - torch.tensor(MIDDLE, dtype=torch.float64)).norm()) < 0.05
    known = dc.Measurements.from_poses(data.q, held(data.poses), camera_on_tool=True, position_std=1e-4)
    assert with_best_seen_point(known, found) is known, "known deviations are those of the origin"


@pytest.mark.slow
def test_the_errors_of_a_camera_are_those_of_the_board_it_sees(seen: CameraArm) -> None:
    """The same numbers as a table of inverted poses lose a third of the accuracy: the noise is not that of the camera.

    The origin of the board is in its corner, so that its middle has to be found.
    """
    robot, rows, q = seen.arm.nominal, slice(ROWS), seen.q[ROWS:]
    result = dc.calibrate(robot, from_corner(seen.measured(POSITION_STD, ROTATION_STD)[rows]))
    plain = dc.calibrate(robot, seen.measured(POSITION_STD, ROTATION_STD, on_tool=False)[rows])
    middle = torch.tensor(MIDDLE, dtype=torch.float64, device=HOST)
    away = result.model(q) - middle - seen.arm.true_points(q)
    assert float(away.square().sum(-1).mean().sqrt()) < 0.75 * seen.error(plain.model, q)
    scales = result.selection.scales
    assert 0.5 * POSITION_STD < float(scales.sensor_noise) < 1.5 * POSITION_STD
    assert 0.7 * ROTATION_STD < float(scales.rotation_noise) < 1.3 * ROTATION_STD
    found = HandEye.of(result.model)
    given = torch.tensor(CAMERA, dtype=torch.float64, device=HOST)
    corner = torch.tensor(BOARD, dtype=torch.float64, device=HOST) - middle
    for one, place, turn in ((found.camera, given[:3], given[3:]), (found.board, corner, torch.zeros_like(corner))):
        shift = one.pose[:3, 3] - place
        away = rotation(turn).mT @ one.pose[:3, :3]
        small = torch.stack([away[2, 1], away[0, 2], away[1, 0]])
        assert bool((torch.cat([shift, rotation(turn) @ small]).abs() < 4 * one.deviations).all())
    lines = "\n".join(hand_eye_sentences({"camera": found}))
    assert "hand-eye transform" in lines
    assert "board in the robot's base: 7" in lines, "mm"


@pytest.mark.slow
def test_the_other_direction_is_named(seen: CameraArm) -> None:
    """A table of the camera's own poses; the commands name the other mistake."""
    data = seen.measured(POSITION_STD, ROTATION_STD)[:ROWS]
    with pytest.raises(MeasurementError, match=says("camera in the board's frame already", "camera_on_tool")):
        dc.calibrate(seen.arm.nominal, dc.Measurements.from_poses(data.q, held(data.poses), camera_on_tool=True))


@pytest.mark.slow
def test_the_commands_read_boards(seen: CameraArm, command: Command, tmp_path: Path) -> None:
    csv, urdf, model, found = (tmp_path / name for name in ("a.csv", "a.urdf", "a.safetensors", "a.json"))
    seen.arm.write_urdf(urdf)
    write_measurements(csv, seen.measured(POSITION_STD, ROTATION_STD)[:40], TABLE)
    done = command("fit", csv, "--robot", urdf, *OPTIONS, "--camera-on-tool", "-o", model, "--json", found)
    assert done.code == 0, done.err
    assert "camera in the frame of 'flange' (hand-eye transform): " in done.out
    assert done.out.count("(standard deviations)") == 2
    written = json.loads(found.read_text(encoding="utf-8"))
    jsonschema.validate(written, SCHEMA)
    written = written["results"]["hand_eye"]
    board = torch.tensor(written["board_in_base"]["pose_m"], dtype=torch.float64)
    away = (board[:3, 3] - torch.tensor(BOARD, dtype=torch.float64)).abs()
    assert bool((away < 5 * torch.tensor(written["board_in_base"]["position_std_m"])).all())
    done = command("fit", csv, "--robot", urdf, *OPTIONS, "-o", model)
    assert done.code == 1
    assert "--camera-on-tool" in done.error
    done = command("fit", csv, "--robot", urdf, *OPTIONS[:2], *OPTIONS[8:], "--camera-on-tool", "-o", model)
    assert "--camera-on-tool without --rotation" in done.error


NEW_ROWS = 40


@cache
def head() -> SeeingHead:
    return SeeingHead.drawn(60 + NEW_ROWS)


@cache
def calibrated() -> Any:
    return dc.calibrate(head().robot, head().images(50, 0.1), hyperparameters=usual_scales(head().robot))


@pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows
def test_errors_of_neck_and_arm_are_found() -> None:
    new = head().q[-NEW_ROWS:]
    truth = head().true_points(new)
    nominal, found = (
        1e3 * rigid_rms(points.detach(), truth)
        for points in (calibrated().registration.geometry.points(new), calibrated().model(new))
    )
    assert nominal > 0.5
    assert found < 0.2 * nominal


@pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows
def test_the_optical_frame_is_where_it_is_in_the_link_of_the_camera() -> None:
    own = HandEye.of(calibrated().model, camera_on_tool=False).camera
    truth = twist_transform(torch.tensor(CAMERA_AWAY, dtype=torch.float64))
    assert own.link == HEAD_CAMERA
    assert bool(((own.pose - truth)[:3, 3].abs() < 4 * own.deviations[:3]).all())
    assert float(own.deviations[:3].max()) < 3e-3
