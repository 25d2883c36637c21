"""The camera of a model in files of other programs: read back, they are its lens and its place, and these are true."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from command_bank import Command
from kind_bank import kind_named
from product_bank import usual_scales
from scipy.spatial.transform import Rotation
from simulated_camera import BOARD_ON_FLANGE, CAMERA, FIXED_CAMERA, fixed_camera_arm
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.cameras.files import read_camera
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop.camera_files import camera_files
from diffeo_calib.kinematics.hand_eye import HandEye, KnownPose, hand_eye_sentences
from diffeo_calib.robots.se3 import roll_pitch_yaw, rotation
from diffeo_calib.sensors.board_camera import BoardCamera

pytestmark = pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows


@cache
def on_tool() -> dc.CalibratedKinematics:
    return kind_named("images of a board").model


@cache
def fixed() -> dc.CalibratedKinematics:
    seen = fixed_camera_arm(25)
    data = seen.images(0.1, on_tool=False)
    return dc.calibrate(seen.arm.nominal, data, hyperparameters=usual_scales(seen.arm.nominal)).model


def camera_of(model: dc.CalibratedKinematics) -> BoardCamera:
    (found,) = [own for each in model.placement for own in each.cameras.values()]
    return found


def check(known: KnownPose, place: Any, turn: Tensor | None = None) -> None:
    away = known.pose[:3, 3] - torch.tensor(place, dtype=torch.float64)
    assert bool((away.abs() < 4 * known.deviations[:3]).all())
    assert float(known.deviations[:3].max()) < 2e-3
    if turn is not None:
        small = Rotation.from_matrix((known.pose[:3, :3] @ turn.mT).numpy()).as_rotvec()
        assert bool((torch.from_numpy(small).abs() < 4 * known.deviations[3:]).all())


def test_cameras_are_where_they_are() -> None:
    found = HandEye.of(on_tool())
    check(found.camera, CAMERA[:3], rotation(torch.tensor(CAMERA[3:], dtype=torch.float64)))
    assert set(found.entry()) == {"camera_in_tip", "board_in_base"}
    assert camera_of(on_tool()).on_tool
    found = HandEye.of(fixed(), camera_on_tool=False)
    check(found.camera, FIXED_CAMERA[0])
    check(found.board, BOARD_ON_FLANGE, torch.eye(3, dtype=torch.float64))
    assert found.camera.link == fixed().robot.base
    assert not camera_of(fixed()).on_tool
    assert "camera in the robot's base (hand-eye transform)" in "\n".join(hand_eye_sentences({"camera": found}))


@pytest.mark.parametrize("model", [on_tool, fixed])
def test_files_read_back_are_lens_and_place(model: Any, tmp_path: Path) -> None:
    files, own = camera_files(model()), camera_of(model())
    for name in ("camera.yaml", "camera_info.yaml"):
        (tmp_path / name).write_text(files[name])
        assert_close(read_camera(tmp_path / name).lens, own.camera.lens)
    known = read_camera(tmp_path / "camera.yaml")
    assert_close(known.root @ known.root.mT, own.camera.root @ own.camera.root.mT)
    found = HandEye.of(model(), camera_on_tool=own.on_tool)
    joint = ET.fromstring(files["camera.xacro"]).find("joint")
    assert joint is not None
    origin, parent = joint.find("origin"), joint.find("parent")
    assert origin is not None
    assert parent is not None
    xyz, rpy = ([float(word) for word in origin.attrib[name].split()] for name in ("xyz", "rpy"))
    assert_close(torch.tensor(xyz, dtype=torch.float64), found.camera.pose[:3, 3])
    assert_close(roll_pitch_yaw(*rpy), found.camera.pose[:3, :3])
    assert parent.attrib["link"] == found.camera.link
    words = ET.fromstring(files["static_transform.launch.xml"])[0].attrib["args"].split()
    said = dict(zip(words[::2], words[1::2], strict=True))
    turn = Rotation.from_quat([float(said[f"--q{axis}"]) for axis in "xyzw"]).as_matrix()
    assert_close(torch.from_numpy(turn), found.camera.pose[:3, :3])
    assert said["--frame-id"] == found.camera.link


def test_opencv_reads_the_files(tmp_path: Path) -> None:
    cv2: Any = pytest.importorskip("cv2")
    for name, text in camera_files(on_tool()).items():
        (tmp_path / name).write_text(text)
    lens = camera_of(on_tool()).camera.lens
    read = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_READ)
    assert_close(torch.from_numpy(read.getNode("distortion_coefficients").mat())[0], lens[4:])
    read = cv2.FileStorage(str(tmp_path / "hand_eye.yaml"), cv2.FILE_STORAGE_READ)
    own = HandEye.of(on_tool()).camera
    for name, values in {"R": own.pose[:3, :3], "t": own.pose[:3, 3:], "covariance": own.covariance}.items():
        assert_close(torch.from_numpy(read.getNode(f"camera_{name}").mat()), values)
    assert read.getNode("camera_parent").string() == "flange"


def test_the_command_writes_them(command: Command, tmp_path: Path) -> None:
    kind, folder = kind_named("images of a board"), tmp_path / "camera"
    command.ran("export", kind.file, "--camera", folder)
    assert {path.name for path in folder.iterdir()} == set(camera_files(on_tool()))
    rigid = command.ran("export", kind.file, "--camera", folder, "--urdf", tmp_path / "a.urdf", "--robot", kind.urdf)
    assert "the rigid kinematics" in rigid.out
    other = (folder / "hand_eye.yaml").read_text()
    assert other != camera_files(on_tool())["hand_eye.yaml"]
    numbers = re.search(r"camera_t:.*?\[(.*?)\]", other, re.S)
    assert numbers is not None
    away = torch.tensor([float(word) for word in numbers[1].split(",")], dtype=torch.float64)
    assert float((away - HandEye.of(on_tool()).camera.pose[:3, 3]).norm()) < 5e-3
    wrong = command("export", kind_named("positions").file, "--camera", folder)
    assert wrong.code == 1
    assert "expected one that saw a board, got none" in wrong.error


def test_what_explains_the_errors_and_models_of_earlier_versions() -> None:
    own = camera_of(on_tool()).explained
    parts = [own.arm, own.lens, own.board, own.corners]
    assert abs(sum(part**2 for part in parts) ** 0.5 / own.nominal - 1) < 1e-9
    assert own.arm > max(parts[1:]), "errors of a mm, and a good camera"
    assert 0 < own.lens_std < own.corners
    assert 0 < own.board_std < own.corners
    lines = "\n".join(on_tool().placement[0].sentences())
    assert f"arm {1e3 * own.arm:.3f}" in lines
    placed = on_tool().placement[0]
    old = replace(placed, constants=camera_of(on_tool()).camera.unknowns[None])
    assert not old.cameras
    assert old.sentences() == []
    model = on_tool()
    poor = dc.CalibratedKinematics(model.robot, model.map, lever=model.lever, placement=(old,))
    with pytest.raises(InputError, match=r"camera of the model.*none"):
        camera_files(poor)
