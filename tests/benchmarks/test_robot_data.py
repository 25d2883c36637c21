"""Data sets of the benchmark on real robots: descriptors and tables."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from real_robots_bank import DH, sliding
from robot_data import BUILT_IN, DESCRIPTOR, check, data_folder, find, read

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm


def test_data_sets_of_a_folder(folder: Path) -> None:
    found = find(folder)
    assert list(found) == ["dh", "urdf"]
    robot, data = sliding()
    two = read(folder / "dh", found["dh"])
    assert two.robot.kinds == robot.kinds
    torch.testing.assert_close(two.measurements.points, data.points, rtol=0, atol=1e-12)
    torch.testing.assert_close(two.measurements.q, data.q, rtol=0, atol=1e-12)
    arm = read(folder / "urdf", found["urdf"])
    assert arm.measurements.joint_names == arm.robot.joint_names
    assert list(find(folder, ["urdf"])) == ["urdf"]


@pytest.mark.parametrize(
    "change",
    [
        "csv",
        {"lenght": "mm"},
        {"sep": 1},
        {"robot": {"dh": []}},
        {"robot": []},
        {"robot": {"dh": 3, "convention": "craig"}},
        {"rotation": {"columns": []}},
    ],
)
def test_bad_descriptors(folder: Path, change: str | dict[str, object]) -> None:
    entries = {name: value for name, value in DH.items() if name != change}
    (folder / "dh" / DESCRIPTOR).write_text(json.dumps(entries | (change if isinstance(change, dict) else {})))
    word = change if isinstance(change, str) else next(iter(change))
    with pytest.raises(InputError, match=f"(?s){word}.*dataset.json|dataset.json.*{word}|'dh' in .*dataset.json"):
        find(folder)


@pytest.mark.parametrize("text", ["{", "[1]", ""])
def test_descriptors_that_are_no_objects(folder: Path, text: str) -> None:
    (folder / "dh" / DESCRIPTOR).write_text(text)
    with pytest.raises(InputError, match=r"dataset\.json"):
        find(folder)


def test_a_table_without_joint_columns(folder: Path) -> None:
    entries = {name: value for name, value in DH.items() if name != "joints"}
    (folder / "dh" / DESCRIPTOR).write_text(json.dumps(entries))
    with pytest.raises(InputError, match="joints"):
        find(folder)


def test_too_few_joint_columns(folder: Path) -> None:
    entries = find(folder)["urdf"] | {"joints": ["angle 0"]}
    with pytest.raises(RobotError, match="joints"):
        read(folder / "urdf", entries)


def test_unknown_data_sets(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none_such"):
        find(folder, ["none_such"])
    with pytest.raises(InputError, match="data sets"):
        find(folder / "neither")


def test_where_the_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DIFFEO_CALIB_DATA", str(tmp_path))
    assert data_folder(None) == tmp_path
    with pytest.raises(InputError, match="existing folder"):
        data_folder(tmp_path / "none")
    monkeypatch.delenv("DIFFEO_CALIB_DATA")
    with pytest.raises(InputError, match="DIFFEO_CALIB_DATA"):
        data_folder(None)


def test_built_in_descriptors_follow_the_format() -> None:
    for name, entries in BUILT_IN.items():
        check(Path(name), json.loads(json.dumps(entries)))


@pytest.mark.parametrize("convention", ["XYZ", "matrix"])
def test_orientations_are_read_on_request(tmp_path: Path, convention: str) -> None:
    arm = SimulatedArm(seed=3)
    arm.write_urdf(tmp_path / "arm.urdf")
    q = arm.sample(20)
    poses = dc.Measurements.from_poses(q, arm.truth.poses(q))
    euler = convention == "XYZ"
    columns = ["rx", "ry", "rz"] if euler else [f"r{row}{column}" for row in range(3) for column in range(3)]
    angle = {"angle": "deg"} if euler else {}
    unit = "deg" if euler else None
    layout = TableFormat("m", "rad", rotation=columns, convention=convention, rotation_angle=unit)
    names = arm.nominal.joint_names
    table, position = tmp_path / "table.csv", ["x", "y", "z"]
    write_measurements(table, poses, layout, joints=names, position=position)
    entries = {
        "robot": {"urdf": "arm.urdf", "base": "base_link", "tip": "flange"},
        "csv": "table.csv",
        "position": position,
        "length": "m",
        "angle": "rad",
        "rotation": {"columns": columns, "convention": convention, **angle},
    }
    check(tmp_path, entries)
    assert read(tmp_path, entries).measurements.poses is None
    found = read(tmp_path, entries, poses=True).measurements.poses
    assert found is not None
    torch.testing.assert_close(found, arm.truth.poses(q), rtol=0, atol=1e-9)
