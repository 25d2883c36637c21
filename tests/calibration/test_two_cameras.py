"""A robot by images of two cameras, fixed or on the tool: truth, places of both, and what is refused."""

from __future__ import annotations

import shutil
from collections import Counter
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from command_bank import Command
from kind_bank import Kind, kind_named
from numbers_bank import tensor
from simulated_camera import BOARD_PRIOR, CAMERA, CAMERA_BESIDE, fixed_camera_arm, images_of_both
from table_bank import refused
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.cameras.files import camera_text, read_camera
from diffeo_calib.fitting.result import silent
from diffeo_calib.interop.camera_files import camera_files
from diffeo_calib.kinematics.hand_eye import HandEye
from diffeo_calib.robots.se3 import twist_transform

pytestmark = [
    pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning"),  # few rows
    pytest.mark.slow,
]

ARMS = fixed_camera_arm(70), fixed_camera_arm(70, second=True)


@cache
def kind() -> Kind:
    return kind_named("two cameras")


@cache
def data() -> Any:
    return images_of_both(ARMS, (33, 27), 0.1)


def of_corners(**known: Any) -> Any:
    """The same images with other arguments."""
    own = {"corners": data().corners, "camera": (1280, 960), "seen_by": data().camera_names, **known}
    return dc.Measurements.from_images(data().q, board=BOARD_PRIOR, camera_on_tool=False, **own)  # pyright: ignore


def check_hand_eyes(model: Any, largest_std: float, *, on_tool: bool = True) -> None:
    """Every camera is where it is, in the robot's base or on the tool, by the deviations that are told of it."""
    found = HandEye.of_each(model, camera_on_tool=on_tool)
    assert sorted(found) == ["left", "right"]
    held, standing = (
        [twist_transform(tensor(own)) for own in (CAMERA, CAMERA_BESIDE)],
        [each.arm.truth for each in ARMS],
    )
    for name, truth in zip(found, held if on_tool else [torch.linalg.inv(own.base) for own in standing], strict=True):
        known = found[name].camera
        away = known.pose[:3, :3] @ truth[:3, :3].mT
        turn = 0.5 * (away - away.mT)[[2, 0, 1], [1, 2, 0]]
        errors = torch.cat([known.pose[:3, 3] - truth[:3, 3], turn])
        assert bool((errors.abs() < 4 * known.deviations).all()), (name, errors, known.deviations)
        assert float(known.deviations[:2].max()) < largest_std


def test_every_camera_is_where_it_is_and_has_its_lens() -> None:
    swapped = images_of_both(ARMS, (30, 33), 0.1)  # the other one holds the frame
    for model in (kind().model, dc.calibrate(kind().robot, swapped, hyperparameters=kind().scales).model):
        check_hand_eyes(model, 2e-3, on_tool=False)
    check_hand_eyes(kind_named("two cameras on the tool").model, 1e-4)
    placed = next(own for own in kind().model.placement if own.cameras)
    lenses = [placed.cameras[name].camera for name in ("left", "right")]
    assert_close(lenses[0].board, lenses[1].board, rtol=0, atol=0)
    for lens, arm in zip(lenses, ARMS, strict=True):
        assert float(((lens.unknowns - arm.camera.unknowns) / lens.deviations).abs().max()) < 4.5


def test_every_camera_of_a_recalibrated_model_is_where_it_is(tmp_path: Path) -> None:
    own = kind_named("two cameras on the tool")
    again: Any = own.recalibrated.model
    check_hand_eyes(again, 1.5e-4)
    dc.save(again, tmp_path / "again.safetensors")
    assert len(camera_files(dc.load(tmp_path / "again.safetensors"))) == 12  # pyright: ignore
    alone = own.moved.rows([name == "right" for name in own.moved.camera_names])
    check_hand_eyes(dc.recalibrate(own.model, alone).model, 1e-4)


def test_the_files_of_each_camera_begin_with_its_name(tmp_path: Path) -> None:
    files = camera_files(kind().model)
    assert Counter(name.partition("_")[0] for name in files) == {"left": 6, "right": 6}
    for name in ("left", "right"):
        (tmp_path / name).write_text(files[f"{name}_camera.yaml"])
        assert f'child link="{name}_optical_frame"' in files[f"{name}_camera.xacro"]
    one, other = (read_camera(tmp_path / name) for name in ("left", "right"))
    assert float((one.lens[0] - 1200).abs()) < 5
    assert float((other.lens[0] - 1000).abs()) < 5
    assert len({files[f"{name}_hand_eye.yaml"] for name in ("left", "right")}) == 2


def test_sessions_of_a_camera_are_set_ups_of_their_own() -> None:
    named = data().with_sessions(["day 1"] * 30 + ["day 2"] * 30)
    assert set(named.session_names) == {f"{camera}/day {k}" for camera in ("left", "right") for k in (1, 2)}
    assert named.with_sessions(named.device_names).device_names == named.device_names
    assert data().with_sessions(["left"] * 60).device_names == [
        "left" if name == "left" else "right/left" for name in data().camera_names
    ]


def test_tables_of_several_cameras_that_cannot_be() -> None:
    known, tool, days = data().cameras, kind_named("two cameras on the tool").data, ["day 1"] * 20 + ["day 2"] * 100
    lens = replace(known["right"], half_size=0.0)
    few = data().rows([name == "left" or k < 7 for k, name in enumerate(data().camera_names)])
    refused(
        (r"`camera`.*right.*left", lambda: of_corners(camera={"left": (1280, 960)})),
        (r"`camera`.*\['left', 'right'\].*one camera", lambda: of_corners(camera=known["left"])),
        (r"camera 'right'.*640 x 480", lambda: of_corners(camera={"left": (1280, 960), "right": (640, 480)})),
        ("given camera 'left'", lambda: of_corners(camera={"left": lens, "right": lens})),
        ("60", lambda: of_corners(seen_by=["left"] * 7)),
        ("cameras", lambda: dc.Measurements.joined([data(), of_corners()])),
        (r"several cameras on the tool.*no set-ups", lambda: tool.with_sessions(days[: len(tool)])),
        (r"'right'.*expected 4 rows, got 'right' in 3 rows", lambda: dc.calibrate(kind().robot, few)),
    )


def test_every_camera_and_session_warns_of_a_board_of_another_size() -> None:
    rows = of_corners(corners=data().corners * tensor([1.04] * 3 + [1.0] * 2)).with_sessions(
        ["day 1"] * 30 + ["day 2"] * 30
    )
    with pytest.warns(dc.DiffeoCalibWarning, match=r"size of the board.*[34].\d % larger"):
        place(kind().robot, rows, silent)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With a file of each camera."""
    for name, camera in kind().data.cameras.items():
        (tmp_path / f"{name}.yaml").write_text(camera_text(camera))
    return tmp_path


def test_each_camera_has_a_file_of_its_own(command: Command, folder: Path) -> None:
    table, options = kind().table()
    files = [f"--reading=corners={folder / f'{name}.yaml'}" for name in ("left", "right")]
    others = [word for word in options if "corners" not in word and word != "--reading"]
    words = ["fit", table, *kind().robot_options, *others, "--holdout", "0", "-o", folder / "m.safetensors"]
    command.monkeypatch.setattr("diffeo_calib.cli.commands.fit.calibrate", lambda *_, **__: kind().result)
    assert "camera 'right' in the robot's base (hand-eye transform)" in command.ran(*words, *files).out
    assert "1280,960" in command.failed(*words, files[0], "--reading=corners=1280,960")


def test_init_proposes_the_files_of_the_cameras(command: Command, folder: Path) -> None:
    tmp_path = Path(shutil.copy(kind().table("new")[0], folder / "corners.csv")).parent
    command.ran("init", tmp_path / "corners.csv", kind().urdf, "-o", tmp_path / "campaign.toml")
    text = (tmp_path / "campaign.toml").read_text()
    assert "left.yaml" in text
    assert "right.yaml" in text
    assert "session" not in text
    assert "all columns are used" in text
