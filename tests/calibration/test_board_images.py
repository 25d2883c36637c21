"""A robot by images of a printed board: truth, both places of the camera, and tables that are not what they seem."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from golden_bank import camera_on_tool
from kind_bank import rigid_rms
from simulated_camera import HEIGHT, WIDTH, CameraArm, camera_arm, fixed_camera_arm, true_camera
from table_bank import refused
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.cameras.board import BoardPrior
from diffeo_calib.cameras.images import UNKNOWNS
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.fitting.result import silent
from diffeo_calib.measurements.csv.files import read_observations, write_measurements
from diffeo_calib.measurements.table_format import TableFormat

pytestmark = pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows

SCALES = camera_on_tool().scales
NOISE_PX = 0.1


@cache
def arm() -> CameraArm:
    return camera_arm(60)


@cache
def data() -> dc.Measurements:
    return arm().images(NOISE_PX)


@cache
def calibrated() -> Any:
    return dc.calibrate(arm().arm.nominal, data(), hyperparameters=SCALES)


def of_corners(corners: Tensor, q: Tensor | None = None, **known: Any) -> dc.Measurements:
    q = data().q if q is None else q
    known = {"board": BoardPrior(scale=2e-4), "camera": (WIDTH, HEIGHT), **known}
    return dc.Measurements.from_images(q, corners, joint_names=arm().arm.nominal.joint_names, **known)


def error_mm(model: Any, seen: CameraArm | None = None) -> float:
    seen = seen or arm()
    return 1e3 * rigid_rms(model(seen.q).detach(), seen.arm.true_points(seen.q))


# --- truth ----------------------------------------------------------------------------------------------------------


def test_pixels_are_better_than_poses() -> None:
    camera: Any = data().poses
    poses = dc.Measurements.from_poses(data().q, torch.linalg.inv(camera), data().joint_names, camera_on_tool=True)
    by_poses = dc.calibrate(arm().arm.nominal, poses, hyperparameters=SCALES)
    assert error_mm(calibrated().model) < 0.85 * error_mm(by_poses.model)


def test_lens_and_board_are_found_with_the_robot() -> None:
    camera = calibrated().model.placement[0].cameras["camera"].camera
    truth, deviations = true_camera().unknowns, camera.deviations
    assert float(((camera.unknowns - truth) / deviations).abs().max()) < 4.5
    before = data().camera
    assert bool((deviations <= 1.001 * before.deviations).all())  # rows of the robot can only add
    assert float(deviations[UNKNOWNS.index("scale")]) < 0.999 * float(before.deviations[UNKNOWNS.index("scale")])


def test_a_fixed_camera_sees_the_board_on_the_tool() -> None:
    seen = fixed_camera_arm(60, seed=2)
    rows = seen.images(NOISE_PX, on_tool=False)
    assert rows.board is None
    found = dc.calibrate(seen.arm.nominal, rows, hyperparameters=SCALES)
    nominal = error_mm(found.registration.geometry.points, seen)
    assert error_mm(found.model, seen) < min(0.25 * nominal, 0.3)


# --- a table that is not what it seems ------------------------------------------------------------------------------


def test_a_mirrored_board_is_the_same_board_from_behind() -> None:
    corners: Any = data().corners
    mirrored = corners.clone()
    mirrored[..., 0] *= -1
    found = dc.calibrate(arm().arm.nominal, of_corners(mirrored), hyperparameters=SCALES)
    assert abs(error_mm(found.model) / error_mm(calibrated().model) - 1) < 0.02


@pytest.mark.parametrize("factor", [0.97, 1.04])
def test_a_board_of_another_size_is_warned_about(factor: float) -> None:
    corners: Any = data().corners
    wrong = corners.clone()
    wrong[..., :3] *= factor
    percent = "smaller" if factor < 1 else "larger"
    with pytest.warns(dc.DiffeoCalibWarning, match=rf"size of the board.*{percent}.*caliper"):
        place(arm().arm.nominal, of_corners(wrong), silent)


def test_a_board_of_nearly_the_right_size_is_named() -> None:
    corners: Any = data().corners
    wrong = corners.clone()
    wrong[..., :3] *= 0.988
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DiffeoCalibWarning)
        found = dc.calibrate(arm().arm.nominal, of_corners(wrong), hyperparameters=SCALES)
    assert any("size of the board" in str(one.message) for one in caught)
    assert any(line.startswith("not decided: lengths that differ by 1.") for line in found.placement.sentences())
    assert not any(line.startswith("not decided") for line in calibrated().placement.sentences())


def test_tables_that_cannot_be() -> None:
    corners: Any = data().corners
    small = replace(true_camera(), half_size=0.0, width=640, height=480)
    refused(
        ("row", lambda: dc.calibrate(arm().arm.nominal, of_corners(corners.roll(1, 0)))),
        ("640 x 480", lambda: of_corners(corners, camera=small)),
        ("640 x 480", lambda: dc.Measurements.from_images(data().q, corners, (640, 480))),
        (r"corners.*\(N, K, 5\)", lambda: of_corners(torch.zeros(60, 35))),
        (r"corners.*\(N, K, 5\)", lambda: of_corners(torch.zeros(60, 35, 4))),
    )


def test_joints_that_still_moved_are_warned_about() -> None:
    q = data().q.clone()
    q[1:] = 0.9 * data().q[1:] + 0.1 * data().q[:-1]
    corners: Any = data().corners
    with pytest.warns(dc.DiffeoCalibWarning, match="do not fit this robot"):
        place(arm().arm.nominal, of_corners(corners, q), silent)


def test_the_lens_of_another_camera_is_refused() -> None:
    corners, camera = data().corners, true_camera()
    other = camera.unknowns.clone()
    known = replace(camera, half_size=0.0)
    of_corners(corners, camera=known)
    other[:2] *= 1.05
    with pytest.warns(dc.DiffeoCalibWarning, match=r"given camera does not quite fit.*1260"):
        of_corners(corners, camera=replace(known, unknowns=other))
    other[:2] *= 1.5
    with pytest.raises(MeasurementError, match=r"with the given camera.*1890"):
        of_corners(corners, camera=replace(known, unknowns=other))


# --- files ----------------------------------------------------------------------------------------------------------


def test_lines_of_an_image_with_other_joints_are_refused(tmp_path: Any) -> None:
    path = tmp_path / "corners.csv"
    table = write_measurements(path, data(), TableFormat("mm", "deg", camera_on_tool=True))
    lines = path.read_text().splitlines()
    cells = lines[3].split(",")
    cells[1] = "12.5"
    path.write_text("\n".join([*lines[:3], ",".join(cells), *lines[4:]]))
    with pytest.raises(MeasurementError, match=r"image '0'.*line 4"):
        read_observations(path, table)
