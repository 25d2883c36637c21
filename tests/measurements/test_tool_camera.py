"""Poses of a board in the frame of a camera on the tool: their inverse, and how its errors arise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from table_bank import held, random_poses, says
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.files import read_measurements, write_measurements
from diffeo_calib.measurements.poses import camera_jacobian, inverse_poses, mark_points
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.se3 import rotation, transforms

ROWS = 6


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, device=HOST, generator=seeded(seed))


def seen(**options: Any) -> tuple[Tensor, dc.Measurements]:
    """Poses of the board in the camera, and the measurements that they are."""
    boards = random_poses(ROWS, seed=3)
    return boards, dc.Measurements.from_poses(draw(ROWS, 4), boards, camera_on_tool=True, **options)


def test_derivatives_of_the_points_are_those_of_the_inverted_pose() -> None:
    """Finite differences of the inverse of (exp(w) R, t + dt) by dt and w, in the camera's axes."""
    boards, data = seen(lever=0.07)
    found = camera_jacobian(held(data.poses), 0.07, held(data.board))
    step = 1e-6
    for k, change in enumerate(step * torch.eye(6, dtype=torch.float64, device=HOST)):

        def points(e: Tensor) -> Tensor:
            turned = rotation(e[3:]) @ boards[:, :3, :3]
            return mark_points(inverse_poses(transforms(turned, boards[:, :3, 3] + e[:3])), 0.07).flatten(1)

        slope = (points(change) - points(-change)) / (2 * step)
        assert_close(
            found[..., k], -slope, rtol=0, atol=1e-9
        )  # the errors of the camera are those of the board, negated


def test_covariance_is_that_of_drawn_errors_of_the_board() -> None:
    position, turn = 1e-5 * (1 + draw(ROWS, 3, seed=1).abs()), 1e-5 * (1 + draw(ROWS, 3, seed=2).abs())
    boards, data = seen(position_std=position, rotation_std=turn)
    draws = 20_000
    shifts, turns = position[:, None] * draw(ROWS, draws, 3, seed=4), turn[:, None] * draw(ROWS, draws, 3, seed=5)
    wrong = transforms(rotation(turns) @ boards[:, None, :3, :3], boards[:, None, :3, 3] + shifts).flatten(0, 1)
    away = mark_points(inverse_poses(wrong), 0.1).view(ROWS, draws, 9) - data.points.view(ROWS, 1, 9)
    known = held(data.covariance)
    assert_close(away.mT @ away / draws, known, rtol=0, atol=0.03 * float(known.abs().max()))


def test_errors_move_with_the_board_to_another_frame() -> None:
    """A board in another frame is another name of the same errors: their covariance turns, and nothing else."""
    _, data = seen(position_std=1e-4 * (1 + draw(ROWS, 3, seed=8).abs()), rotation_std=1e-3 * (1 + draw(ROWS, 3).abs()))
    T = random_poses(1, seed=9)
    moved, R = data.in_frames(T.expand(ROWS, 4, 4)), torch.block_diag(*[T[0, :3, :3]] * 3)
    assert_close(held(moved.covariance), R @ held(data.covariance) @ R.T, rtol=0, atol=1e-14)
    assert_close(inverse_poses(held(data.poses)), random_poses(ROWS, seed=3), rtol=0, atol=1e-13)


def test_tables_keep_the_direction_in_which_the_camera_sees(tmp_path: Path) -> None:
    boards, data = seen(position_std=2e-4, rotation_std=1e-3)
    path, plain = tmp_path / "boards.csv", TableFormat("mm", "rad")
    table = TableFormat("mm", "rad", rotation=["a", "b", "c"], convention="rotvec", camera_on_tool=True)
    with pytest.raises(MeasurementError, match=says("camera_on_tool", "pass camera_on_tool=True")):
        write_measurements(path, data, plain)
    with pytest.raises(MeasurementError, match=says("camera_on_tool", "without such a camera")):
        write_measurements(path, dc.Measurements.from_poses(data.q, boards), table)
    write_measurements(path, data, table)
    given = {"length": "mm", "angle": "rad", "rotation": ["a", "b", "c"], "convention": "rotvec"}
    given |= {
        "std": ["std_x", "std_y", "std_z"],
        "rotation_std": ["std_rx", "std_ry", "std_rz"],
        "rotation_angle": "rad",
    }
    joints = [f"q{k + 1}" for k in range(4)]
    as_written = read_measurements(path, joints, ["x", "y", "z"], **given)  # the numbers are those of the board
    assert_close(held(as_written.poses), boards, rtol=0, atol=1e-12)
    again = read_measurements(path, joints, ["x", "y", "z"], **given, camera_on_tool=True)
    assert_close(held(again.poses), held(data.poses), rtol=0, atol=1e-12)
    assert_close(held(again.covariance), held(data.covariance), rtol=1e-9, atol=0)
    assert again.rows([2]).sha256 == again.sha256, "of the file"
    assert data.sha256 != dc.Measurements.from_poses(data.q, held(data.poses)).sha256


def test_a_camera_on_the_tool_measures_poses(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("q1,q2,x,y,z\n0,0,1,2,3\n", encoding="utf-8")
    with pytest.raises(MeasurementError, match=says("`camera_on_tool` without `rotation`", "name the columns")):
        read_measurements(
            tmp_path / "a.csv", ["q1", "q2"], ["x", "y", "z"], length="m", angle="rad", camera_on_tool=True
        )
