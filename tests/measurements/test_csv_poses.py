"""Poses and standard deviations in CSV files, those of a laser tracker and of a camera too."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from table_bank import Reader, held, says
from torch.testing import assert_close

from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.csv.files import read_measurements
from diffeo_calib.measurements.poses import angle_between, rotation_matrices, transforms

POSE_HEADER = "q1,q2,x,y,z,a,b,c,d\n"
POSE: dict[str, Any] = {"rotation": ["a", "b", "c"], "convention": "XYZ", "rotation_angle": "deg"}


def test_poses_are_read(read: Reader) -> None:
    data = read(POSE_HEADER + "1,2,1000,2000,3000,10,20,-170,\n3,4,0,0,0,30,40,50,\n", length="mm", **POSE)
    rotations = rotation_matrices(np.radians([[10, 20, -170], [30, 40, 50]]), "XYZ")
    expected = transforms(rotations, torch.tensor([[1, 2, 3], [0, 0, 0]], dtype=torch.float64))
    assert_close(held(data.poses), expected, rtol=0, atol=1e-15)
    assert (data.lever, data.joint_names, data.std, data.rotation_std) == (0.1, ("q1", "q2"), None, None)
    other = read(POSE_HEADER + "1,2,1000,2000,3000,10,20,-170,\n", length="mm", lever=0.25, **POSE)
    assert other.lever == 0.25  # in m, whatever the file's unit


@pytest.mark.parametrize(
    ("std", "expected"),
    [
        (["s"], [[[3, 3, 3], [3, 3, 3]]]),
        (["s", "t"], [[[3, 3, 3], [4, 4, 4]]]),
        (["s", "t", "u", "v", "w", "k"], [[[3, 4, 5], [6, 7, 8]]]),
        ([["s", "t", "u"], ["v", "w", "k"]], [[[3, 4, 5], [6, 7, 8]]]),
    ],
)
def test_standard_deviations_are_read(std: Any, expected: Any, read: Reader) -> None:
    text = "q1,x,y,z,X,Y,Z,s,t,u,v,w,k\n0.1,1000,2,3,4,5,6,3,4,5,6,7,8\n"
    data = read(text, joints=["q1"], position=[["x", "y", "z"], ["X", "Y", "Z"]], length="mm", std=std)
    assert_close(held(data.std), torch.tensor(expected, dtype=torch.float64) / 1e3)
    assert_close(held(data.covariance)[0].diagonal().sqrt(), held(data.std).flatten())


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["s"], [[3, 3, 3], [3, 3, 3]]),
        ([["s"], ["t"]], [[3, 3, 3], [4, 4, 4]]),
        ([["s", "t", "u"], ["v", "w", "k"]], [[3, 4, 5], [6, 7, 8]]),
    ],
)
def test_deviations_of_rotations_are_read(names: Any, expected: Any, read: Reader) -> None:
    """One column for all, one per frame, three per frame; the second frame is hidden in the second row."""
    text = "q1,x,y,z,a,b,c,X,Y,Z,A,B,C,s,t,u,v,w,k\n0.1,1,2,3,10,20,30,4,5,6,40,50,60,3,4,5,6,7,8\n"
    flat = names if isinstance(names[0], str) else [name for group in names for name in group]
    own = dict(zip("stuvwk", "345678", strict=True))
    hidden = [own[name] if len(flat) == 1 or name in flat[: len(flat) // 2] or name not in flat else "" for name in own]
    text += f"0.2,1,2,3,10,20,30,,,,,,,{','.join(hidden)}\n"
    turned = {"rotation": [["a", "b", "c"], ["A", "B", "C"]], "convention": "XYZ", "rotation_angle": "deg"}
    data = read(text, joints=["q1"], position=[["x", "y", "z"], ["X", "Y", "Z"]], rotation_std=names, **turned)
    found = held(data.rotation_std).rad2deg()
    assert_close(found[0], torch.tensor(expected, dtype=torch.float64))
    assert_close(found[1, 0], torch.tensor(expected[0], dtype=torch.float64))
    assert held(data.poses)[1, 1].isnan().all()
    assert held(data.covariance).isfinite().all()


POSE_ROW = "0.1,0.2,1.0,2.0,3.0,10,20,30,1\n"
QUATERNION = {"rotation": ["a", "b", "c", "d"], "convention": "quat_xyzw", "rotation_angle": None}
MATRIX_HEADER = "q1,q2,x,y,z," + ",".join(f"r{i}" for i in range(9)) + "\n"
MATRIX = {"rotation": [f"r{i}" for i in range(9)], "convention": "matrix", "rotation_angle": None}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"convention": None}, ("`rotation` is given", "`convention`", "'quat_xyzw'", "never guessed")),
        ({"rotation": None}, ("`convention` and `rotation_angle` without `rotation`", "leave")),
        (
            {"rotation": None, "convention": None, "rotation_angle": None, "rotation_std": ["d"] * 3},
            ("`rotation_std` without `rotation`",),
        ),
        ({"rotation_angle": None}, ("`rotation_angle` is missing", "'rad' or 'deg'", "unit of the joints")),
        ({"rotation_angle": "grad"}, ("`rotation_angle`", "'rad' or 'deg'", "got 'grad'")),
        ({"convention": "roll-pitch-yaw"}, ("`convention`", "got 'roll-pitch-yaw'")),
        ({"rotation": ["a", "b"]}, ("`rotation`", "3 names of columns for 'XYZ'", "got ['a', 'b']")),
        ({"rotation": [1, 2, 3]}, ("`rotation`", "got [1, 2, 3]")),
        ({"convention": "quat_xyzw", "rotation_angle": None}, ("`rotation`", "4 names of columns for 'quat_xyzw'")),
        (QUATERNION | {"rotation_angle": "deg"}, ("`rotation_angle` beside convention 'quat_xyzw'", "leave it out")),
        (QUATERNION, ("table.csv', line 2, columns a, b, c, d", "length 1", "got 37.4299", "order of the columns")),
        ({"rotation": ["a", "b", "x"]}, ("distinct columns", "x")),
        ({"position": [["x", "y", "z"], ["a", "b", "c"]], "rotation": ["q1"] * 3}, ("one triple", "got 2 triples")),
        ({"std": ["d", "q1"]}, ("`std`", "one per marker", "got ['d', 'q1']")),
        ({"std": ["a"]}, ("distinct columns", "a")),
        ({"rotation_std": ["d", "e"]}, ("`rotation_std`", "three, or one for all three axes", "got ['d', 'e']")),
        ({"rotation_std": ["d", "d", "d"]}, ("distinct columns", "d", "the deviations of all axes alone")),
        ({"rotation_std": [["d"], ["e", "f", "g"]]}, ("`rotation_std`", "as many names for every frame", "1 and 3")),
        (QUATERNION | {"rotation_std": ["u", "v", "w"]}, ("`rotation_angle` is missing", "`rotation_std`")),
    ],
)
def test_wrong_pose_option_is_one_clear_error(options: dict[str, Any], message: tuple[str, ...], read: Reader) -> None:
    with pytest.raises(MeasurementError, match=says(*message)) as caught:
        read(POSE_HEADER + POSE_ROW, **(POSE | options))
    assert str(caught.value).endswith(".")


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (POSE_HEADER + POSE_ROW + "0,0,1,2,3,10,,30,1\n", {}, ("line 3, column 'b'", "an empty cell")),
        (POSE_HEADER + POSE_ROW + "\n0,0,1,2,3,10,2,30,0\n", {"std": ["d"]}, ("line 4, column 'd'", "got '0'")),
        (
            POSE_HEADER + "0,0,1,2,3,10,2,30,-1\n" * 2,
            {"std": ["d"], "duplicates": "keep"},
            ("line 2, column 'd' (and 1 more, on line 3)", "got '-1'"),
        ),
        (
            MATRIX_HEADER + "0,0,1,2,3,1,0,0,0,1,0,0,0,1\n0,0,1,2,3,1,0,0,0,1,0,0,0,-1\n",
            MATRIX,
            ("line 3, columns r0, r1", "mirrored"),
        ),
        (MATRIX_HEADER + "0,0,1,2,3,2,0,0,0,2,0,0,0,2\n", MATRIX, ("line 2", "orthonormal", "without a scale")),
    ],
)
def test_wrong_pose_file_is_one_clear_error(
    text: str, options: dict[str, Any], message: tuple[str, ...], read: Reader
) -> None:
    with pytest.raises(MeasurementError, match=says("table.csv", *message)):
        read(text, **(POSE | options))


@pytest.mark.parametrize(
    ("row", "options", "message"),
    [
        ("0,1,1,2,3,10,20,30,1", {"rotation_angle": "rad"}, ("30 rad", "degrees", "rotation_angle='deg'")),
        ("0,1,1,2,3,1,-2,3,1", {}, ("rotations reach only 3 deg", "radians", "rotation_angle='rad'")),
        ("0,1,1,2,3,0,4,0,1", {"convention": "rotvec"}, ("4 deg", "radians")),
    ],
)
def test_unlikely_units_of_rotations_cause_a_warning(
    row: str, options: dict[str, Any], message: tuple[str, ...], read: Reader
) -> None:
    with pytest.warns(DiffeoCalibWarning, match=says("table.csv", *message)) as record:
        read(POSE_HEADER + row, **(POSE | options))
    assert len(record) == 1
    assert Path(record[0].filename).name == "conftest.py"  # where `read` calls the package


def test_a_stated_unit_of_a_rotation_is_compared(read: Reader) -> None:
    names = ["a [rad]", "b [rad]", "c [rad]"]
    text = POSE_HEADER + "0,1,1,2,3,0,0,0,1"
    for name in "abc":
        text = text.replace(f",{name},", f",{name} [rad],", 1)
    with pytest.raises(
        MeasurementError, match=says("column 'a [rad]'", "expected deg, as stated", "rad in its header")
    ):
        read(text, **(POSE | {"rotation": names}))


def test_likely_rotations_cause_no_warning(read: Reader) -> None:
    read(POSE_HEADER + "0,1,1,2,3,0,0,0,1", **POSE)
    read(POSE_HEADER + "0,1,1,2,3,0,6.2832,0,1", **(POSE | {"rotation_angle": "rad"}))
    read(POSE_HEADER + "0,1,1,2,3,0,0,0,1", **(POSE | QUATERNION))  # quaternions have no unit


# --- real robots ---


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
