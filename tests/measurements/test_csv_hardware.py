"""Tables of robots that were measured with a laser tracker or a camera."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from table_bank import held
from torch.testing import assert_close

from diffeo_calib.measurements.csv.files import read_measurements
from diffeo_calib.measurements.poses import angle_between

UR10_JOINTS = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", *(f"wrist_{k}_joint" for k in (1, 2, 3))]


UR10_POSES: dict[str, Any] = {
    "rotation": ["measurement_rx", "measurement_ry", "measurement_rz"],
    "convention": "XYZ",
    "rotation_angle": "deg",
    "std": ["measurement_std_x", "measurement_std_y", "measurement_std_z"],
    "rotation_std": ["measurement_std_rx", "measurement_std_ry", "measurement_std_rz"],
}


def relative_spread(measured: torch.Tensor, nominal: torch.Tensor) -> torch.Tensor:
    """How far turns between poses differ, measured against nominal: neither base nor tool frame matters for angles."""
    first, others = measured[:1, :3, :3], measured[1:, :3, :3]
    start, rest = nominal[:1, :3, :3], nominal[1:, :3, :3]
    turned = angle_between(first.expand_as(others), others) - angle_between(start.expand_as(rest), rest)
    return turned.abs()


def test_ur10_poses_are_read(ur10_folder: Path) -> None:
    """The convention is right: turns between poses are those between the commanded flange poses."""
    path = ur10_folder / "measurements_iso_cubes.csv"
    position = ["measurement_x", "measurement_y", "measurement_z"]
    options: dict[str, Any] = {"length": "mm", "angle": "rad", "sep": ";", "decimal": ","}
    data = read_measurements(path, UR10_JOINTS, position, **options, **UR10_POSES)
    poses = held(data.poses)
    assert_close(poses[:, :3, 3], read_measurements(path, UR10_JOINTS, position, **options).points[:, 0])
    goal: dict[str, Any] = {"rotation": ["Goal roll", "Goal pitch", "Goal yaw"], "convention": "xyz"}
    goal |= {"rotation_angle": "rad", "duplicates": "keep"}
    commanded = read_measurements(
        path, UR10_JOINTS, ["Goal x", "Goal y", "Goal z"], **(options | {"length": "m"}), **goal
    )
    assert float(relative_spread(poses, held(commanded.poses)).max()) < math.radians(0.3)
    options |= UR10_POSES | {"convention": "xyz"}
    wrong = read_measurements(path, UR10_JOINTS, position, **options)
    assert float(relative_spread(held(wrong.poses), held(commanded.poses)).max()) > math.radians(0.5)
    assert_close(held(data.std)[0, 0] * 1e3, torch.tensor([0.00095905, 0.0022901, 0.0019936]).double())
    assert_close(held(data.rotation_std)[0].rad2deg(), torch.tensor([0.00094925, 0.0014176, 0.0011736]).double())
    assert torch.linalg.matrix_rank(held(data.covariance), rtol=1e-12).unique().tolist() == [6]
    train, test = data.split(0.7, seed=0)
    assert len(held(train.poses)) + len(held(test.covariance)) == 632


def test_fr3_poses_are_read(ur10_folder: Path) -> None:
    """Matrices of a camera, against those that the controller reports."""
    path = ur10_folder.parent / "franka_fr3" / "franka_fr3_camera.csv"
    joints = [f"q{i}_rad" for i in range(1, 8)]
    matrix = [f"cam_T{i}{j}" for i in range(3) for j in range(3)]
    options: dict[str, Any] = {"length": "m", "angle": "rad", "convention": "matrix"}
    data = read_measurements(path, joints, ["cam_T03", "cam_T13", "cam_T23"], rotation=matrix, **options)
    assert len(data) == 114
    reported = [f"tcp_{4 * i + j}" for i in range(3) for j in range(3)]
    tcp = read_measurements(path, joints, ["tcp_3", "tcp_7", "tcp_11"], rotation=reported, **options)
    assert float(relative_spread(held(data.poses), held(tcp.poses)).median()) < math.radians(1.0)
