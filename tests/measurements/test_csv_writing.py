"""Measurements and predictions are written as CSV files, and read back."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from table_bank import POSITION, says, some

from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.measurements.csv.files import write_measurements, write_predictions
from diffeo_calib.measurements.poses import rotation_matrices
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.measurements.table_format import TableFormat

SI = TableFormat("m", "rad")


def write(path: Path, data: Measurements, **options: Any) -> None:
    """Write in rad and m, with options of the format and of the columns mixed."""
    columns = {name: options.pop(name) for name in ("joints", "position") if name in options}
    table: dict[str, Any] = {"length": "m", "angle": "rad"} | options
    write_measurements(path, data, TableFormat(**table), **columns)


def test_written_columns(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write_measurements(path, Measurements([[0.5]], [[1, 2, 3]]), TableFormat("mm", "rad", ";", ","))
    assert path.read_text().splitlines() == ["q1;x;y;z", "0,5;1000,0;2000,0;3000,0"]
    write_measurements(path, Measurements([[0.5]], [[[1, 2, 3]] * 2]), SI)
    assert path.read_text().splitlines()[0] == "q1,marker1_x,marker1_y,marker1_z,marker2_x,marker2_y,marker2_z"
    write_measurements(path, some(2), TableFormat("m", "deg"), joints=["a", "b"], position=["u", "v", "w"])
    assert path.read_text().splitlines()[0] == "a,b,u,v,w"


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=says("none", "cannot be written", "No such file or directory", "folder")):
        write_measurements(tmp_path / "none" / "table.csv", some(2), SI)


# --- poses ----------------------------------------------------------------------------------------


WRITTEN_ROTATIONS = {
    "rotvec": ["rx", "ry", "rz"],
    "quat_xyzw": ["qx", "qy", "qz", "qw"],
    "quat_wxyz": ["qw", "qx", "qy", "qz"],
    "matrix": ["r11", "r12", "r13", "r21", "r22", "r23", "r31", "r32", "r33"],
    "ZYX": ["euler1", "euler2", "euler3"],
}


@pytest.mark.parametrize("convention", WRITTEN_ROTATIONS)
def test_written_columns_of_poses(convention: str, tmp_path: Path) -> None:
    path, pose = tmp_path / "table.csv", torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_matrices([[0, 0, 90]], "rotvec", angle="deg")[0]
    data = Measurements.from_poses([[0.5]], pose[None], rotation_std=0.5)
    write_measurements(path, data, TableFormat("mm", "deg", convention=convention))
    header, row = (line.split(",") for line in path.read_text().splitlines())
    assert header == ["q1", "x", "y", "z", *WRITTEN_ROTATIONS[convention], "std_rx", "std_ry", "std_rz"]
    assert float(row[-1]) == pytest.approx(math.degrees(0.5))
    if convention == "rotvec":
        assert [float(cell) for cell in row[4:7]] == pytest.approx([0, 0, 90])
        write_measurements(path, data, TableFormat("mm", "deg", rotation_angle="rad"))  # the default convention
        assert [float(cell) for cell in path.read_text().splitlines()[1].split(",")[4:7]] == pytest.approx(
            [0, 0, math.pi / 2]
        )


def test_own_names_of_written_columns(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    pose = torch.eye(4, dtype=torch.float64)[None]
    data = Measurements.from_poses([[0.5]], pose, position_std=1e-3, rotation_std=1.0)
    names: dict[str, Any] = {"position": "xyz", "rotation": "abc", "std": "uvw", "rotation_std": "klm"}
    options: dict[str, Any] = {name: list(letters) for name, letters in names.items()}
    write(path, data, joints=["j"], **options)
    assert path.read_text().splitlines() == [
        "j,x,y,z,a,b,c,u,v,w,k,l,m",
        "0.5" + ",0.0" * 6 + ",0.001" * 3 + ",1.0" * 3,
    ]


@pytest.mark.parametrize(
    ("poses", "options", "message"),
    [
        (False, {"convention": "rotvec"}, ("`convention` without `rotation`", "leave this out")),
        (False, {"std": ["a", "b", "c"]}, ("['a', 'b', 'c']", "without these values")),
        (True, {"rotation_std": ["a", "b", "c"]}, ("['a', 'b', 'c']", "without these values")),
        (True, {"convention": "euler"}, ("`convention`", "got 'euler'")),
        (True, {"rotation_angle": "turns"}, ("`rotation_angle`", "'rad' or 'deg'")),
        (True, {"rotation": ["a", "b"]}, ("`rotation`", "3 names")),
        (True, {"std": ["s"]}, ("standard deviations", "expected 3", "got 1")),
        (True, {"position": [POSITION, ["u", "v", "w"]]}, ("position triples", "expected 1", "got 2")),
    ],
)
def test_wrong_option_of_written_poses_is_one_clear_error(
    poses: bool, options: dict[str, Any], message: tuple[str, ...], tmp_path: Path
) -> None:
    frames = torch.eye(4, dtype=torch.float64).expand(2, 4, 4)
    data = Measurements.from_poses([[0.0], [1.0]], frames, position_std=1.0) if poses else some(2)
    with pytest.raises(MeasurementError, match=says(*message)):
        write(tmp_path / "table.csv", data, **options)
    assert not (tmp_path / "table.csv").exists()


def test_predicted_poses_are_written(tmp_path: Path) -> None:
    path, pose = tmp_path / "p.csv", torch.eye(4, dtype=torch.float64)[None].clone()
    pose[0, :3, :3] = rotation_matrices([[0, 90, 0]], "rotvec", angle="deg")[0]
    pose[0, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
    q, std = torch.tensor([[0.5]], dtype=torch.float64), torch.full((1, 6), 1e-3, dtype=torch.float64)
    std[:, 3:] = math.radians(0.25)
    write_predictions(path, [(q, pose, std)], TableFormat("mm", "deg"), joints=["j"], poses=True)
    header, row = path.read_text().splitlines()
    assert header == "j,x,y,z,std_x,std_y,std_z,rx,ry,rz,std_rx,std_ry,std_rz"
    expected = [math.degrees(0.5), 1000, 2000, 3000, 1, 1, 1, 0, 90, 0, 0.25, 0.25, 0.25]
    assert [float(cell) for cell in row.split(",")] == pytest.approx(expected, abs=1e-12)
    write_predictions(
        path, [(q, pose, std)], TableFormat("mm", "deg", convention="quat_wxyz"), joints=["j"], poses=True
    )
    assert path.read_text().splitlines()[0] == "j,x,y,z,std_x,std_y,std_z,qw,qx,qy,qz,std_rx,std_ry,std_rz"
    wrong = TableFormat("mm", "deg", convention="euler")
    with pytest.raises(MeasurementError, match=says("`convention`", "got 'euler'")):
        write_predictions(path, [(q, pose, std)], wrong, joints=["j"], poses=True)


def test_predicted_markers_are_written(tmp_path: Path) -> None:
    path, q = tmp_path / "p.csv", torch.tensor([[0.5, 0.25]], dtype=torch.float64)
    points, std = torch.tensor([[[1.0, 2, 3], [4, 5, 6]]]).double(), torch.full((1, 2, 3), 1e-3, dtype=torch.float64)
    table = TableFormat("mm", "deg", ";", ",")
    kinds, prefixes = ["revolute", "prismatic"], ["left_", "ball_"]
    write_predictions(path, [(q, points, std)], table, joints=["a", "b"], kinds=kinds, prefixes=prefixes)
    header, row = path.read_text().splitlines()
    markers = [f"{prefix}{kind}{axis}" for prefix in prefixes for kind in ("", "std_") for axis in "xyz"]
    assert header.split(";") == ["a", "b", *markers]
    expected = [math.degrees(0.5), 250, 1000, 2000, 3000, 1, 1, 1, 4000, 5000, 6000, 1, 1, 1]
    assert [float(cell.replace(",", ".")) for cell in row.split(";")] == pytest.approx(expected, rel=1e-12)
    write_predictions(path, [(q, points[:, :1], std[:, :1])], table, joints=["a", "b"])
    assert path.read_text().splitlines()[0] == "a;b;x;y;z;std_x;std_y;std_z"
