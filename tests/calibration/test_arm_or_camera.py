"""What changes between images is told from errors of the arm: the focus of the camera, and its mount."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from simulated_camera import BOARD_PRIOR, HEIGHT, LENS, WIDTH, CameraArm, camera_arm
from table_bank import says, warned

import diffeo_calib as dc
from diffeo_calib.common.device import seeded
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.files import read_observations
from diffeo_calib.measurements.csv.sensors import ImageColumns
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.se3 import twist_transform

IMAGES, NOISE_PX = 40, 0.1
ARM = camera_arm(IMAGES, 2)


def calibrated(arm: CameraArm, focus: float = 0.0) -> tuple[dc.CalibrationResult, list[str]]:
    """With a focal length of each image that differs by this share, and the warnings."""
    q, corners = arm.shown(NOISE_PX, 2)
    own = 1.0 + focus * torch.randn(len(q), 1, 1, dtype=q.dtype, generator=seeded(1))
    middle = torch.tensor(LENS[2:4], dtype=q.dtype)
    pixels = middle + own * (corners[..., 3:] - middle)
    outside = (pixels < 0).any(2) | (pixels > torch.tensor([WIDTH - 1, HEIGHT - 1])).any(2)
    corners = torch.cat([corners[..., :3], pixels], 2).masked_fill(outside[..., None], torch.nan)
    data = dc.Measurements.from_images(q, corners, (WIDTH, HEIGHT), arm.arm.nominal.joint_names, board=BOARD_PRIOR)
    data = data.with_columns(image_names={row: f"{row}.png" for row in range(len(data))}, file_sha256="of a table")
    return warned(dc.calibrate, arm.arm.nominal, data)


def error(result: dc.CalibrationResult) -> float:
    return ARM.error(result.model, ARM.arm.sample(200, seed=9))


def test_a_camera_that_focuses_is_no_error_of_the_arm() -> None:
    (clean, silent), (focusing, said) = calibrated(ARM), calibrated(ARM, 0.004)
    assert not silent
    assert len(said) == 1
    assert "the focal length of the images seems to differ" in said[0]
    assert "lock focus" in said[0]
    assert "got about 0.34 %, which moves the tool by 1.4 mm" in said[0]  # of 0.35 % drawn, 0.4 m away
    # with this noise in all directions the error was twice as large
    assert error(focusing) < 1.3 * error(clean)
    arm = [next(iter(one.placement.entry().values()))["explained_m"] for one in (clean, focusing)]  # type: ignore[index]
    assert arm[1]["corners"] > 2.0 * arm[0]["corners"]


@pytest.mark.slow
def test_a_camera_that_slips_on_its_mount_is_named() -> None:
    slipped = ARM.boards.clone()
    twist = 5e-4 * torch.tensor([[1.0, 0.0, 0.0, 3.0, 0.0, 0.0]], dtype=torch.float64)
    slipped[IMAGES // 2 :] = twist_transform(twist) @ slipped[IMAGES // 2 :]
    _, said = calibrated(replace(ARM, boards=slipped))
    assert len(said) == 1
    assert re.search(r"camera on the tool seems to have moved by about .* near row (\d+) \(\1.png\)", said[0])


def test_rows_of_a_table_of_corners_are_named_by_their_images(tmp_path: Path) -> None:
    q, corners = ARM.shown(NOISE_PX, 2)
    lines = ["a,b,c,d,e,f,image,board_x,board_y,u,v"]
    for row, (angles, seen) in enumerate(zip(q.tolist(), corners, strict=True)):
        shown = seen[~seen.isnan().any(1)][:, [0, 1, 3, 4]].tolist()
        lines += [",".join([*map(repr, angles), f"{row}.png", *map(repr, corner)]) for corner in shown]
    (tmp_path / "t.csv").write_text("\n".join(lines))
    table = TableFormat(
        "m", "rad", joints=tuple("abcdef"), readings=(ImageColumns((WIDTH, HEIGHT), camera_on_tool=True),)
    )
    found = read_observations(tmp_path / "t.csv", table)
    first, last = found.line_numbers[[0, -1]].tolist()
    assert found.rows([-1]).row_names == [f"row {last} ({len(q) - 1}.png)"]
    assert dc.Observations.joined([found]).row_names[0] == f"row {first} (0.png)"


@pytest.mark.parametrize(("column", "cells"), [("u", "s,0,0,,"), ("board_x", "s,,,5,5"), ("board_y", "s,0,,5,5")])
def test_a_corner_without_a_number_is_named(column: str, cells: str, tmp_path: Path) -> None:
    """Beside other kinds of rows, too, where an empty cell may mean that a line holds another kind."""
    path = tmp_path / "t.csv"
    path.write_text(f"a,b,x,y,z,image,board_x,board_y,u,v\n1,2,3,4,5,,,,,\n1,2,,,,s,1,1,5,5\n1,2,,,,{cells}\n")
    table = TableFormat("m", "rad", joints=("a", "b"), position=list("xyz"), readings=(ImageColumns((640, 480)),))
    with pytest.raises(MeasurementError, match=says("line 4", f"column '{column}'", "an empty cell")):
        read_observations(path, table)
