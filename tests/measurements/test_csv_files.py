"""Tables in CSV files: units, separators, round trips, and files with every kind of mistake in them."""

from __future__ import annotations

import math
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from diffeo_calib.cli.options import reading_options
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.csv_files import read_joints, read_measurements, write_measurements, write_predictions
from diffeo_calib.measurements.poses import angle_between, rotation_matrices, transforms
from diffeo_calib.measurements.table import REPEAT_TOLERANCE, Measurements

ORDERS = [a + b + c for axes in ("xyz", "XYZ") for a in axes for b in axes for c in axes if b not in (a, c)]
CONVENTIONS = ["rotvec", "quat_xyzw", "quat_wxyz", "matrix", *ORDERS]
JOINTS, POSITION = ["q1", "q2"], ["x", "y", "z"]
HEADER = "q1,q2,x,y,z\n"
ROWS = "0.1,0.2,1.0,2.0,3.0\n0.3,0.4,1.5,2.5,3.5\n"

Reader = Callable[..., Measurements]


def some(rows: int, n: int = 2, markers: int = 1, seed: int = 0) -> Measurements:
    """Distinct random measurements."""
    rng = np.random.default_rng(seed)
    return Measurements(rng.uniform(-3, 3, (rows, n)), rng.uniform(-2, 2, (rows, markers, 3)))


@pytest.fixture
def read(tmp_path: Path) -> Reader:
    """Write a text to a file and read it as q1, q2, x, y, z in m and rad, unless told otherwise."""

    def read_text(text: str | bytes, joints: Any = JOINTS, position: Any = POSITION, **options: Any) -> Measurements:
        path = tmp_path / "table.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        arguments: dict[str, Any] = {"length": "m", "angle": "rad"} | options
        return read_measurements(path, joints, position, **arguments)

    return read_text


def says(*parts: str) -> str:
    """Pattern of a message that holds all parts, in any order."""
    return "(?s)" + "".join(f"(?=.*{re.escape(part)})" for part in parts)


# --- reading --------------------------------------------------------------------------------------


def test_reads_si(read: Reader) -> None:
    data = read(
        "\ufeffname, z,q2 ,y,x,q1\r\nA,3,0.2,2,1,.1\r\n\r\n'B',-3.5,4e-1,2.5,1.5,0.3\r\n"
    )  # BOM, blank line, order
    assert_close(data.q, torch.tensor([[0.1, 0.2], [0.3, 0.4]], dtype=torch.float64), rtol=0, atol=0)
    assert_close(data.points[:, 0], torch.tensor([[1, 2, 3], [1.5, 2.5, -3.5]], dtype=torch.float64), rtol=0, atol=0)
    assert data.joint_names == ("q1", "q2")


def test_converts_degrees_millimetres_and_decimal_commas(read: Reader) -> None:
    expected = read(HEADER + "0.5,1.5,1.2345,-2.0,0.25\n")
    text = f"q1;q2;x;y;z\n{math.degrees(0.5)!r};{math.degrees(1.5)!r};1234,5;-2,0e3;250\n".replace(".", ",")
    data = read(text, sep=";", decimal=",", length="mm", angle="deg")
    assert_close(data.q, expected.q, rtol=1e-15, atol=0)
    assert_close(data.points, expected.points, rtol=1e-15, atol=0)


def test_prismatic_joints_take_the_unit_of_length(read: Reader) -> None:
    robot = SimpleNamespace(joint_names=("q1", "q2"), kinds=("prismatic", "revolute"))
    text = HEADER + "250,90,1000,0,500\n"
    for joints, kinds in ((robot, None), (JOINTS, ["prismatic", "continuous"])):
        data = read(text, joints=joints, kinds=kinds, length="mm", angle="deg")
        assert_close(data.q, torch.tensor([[0.25, math.pi / 2]], dtype=torch.float64))


def test_several_markers(read: Reader) -> None:
    data = read(
        "q1,ax,ay,az,bx,by,bz\n0,1,2,3,4,5,6\n", joints=["q1"], position=[("bx", "by", "bz"), ("ax", "ay", "az")]
    )
    assert data.points.tolist() == [[[4, 5, 6], [1, 2, 3]]]


def test_separator_in_quotes_and_unused_columns_may_hold_anything(read: Reader) -> None:
    assert len(read('note,q1,q2,x,y,z\n"warm, loaded\nagain",0.1,0.2,1,2,3\n,0.3,0.4,1,2,3\n')) == 2


def test_one_row_can_be_read(read: Reader) -> None:
    assert len(read(HEADER + "0.1,0.2,1,2,3")) == 1


SEMICOLONS = HEADER.replace(",", ";")
WRONG_FILES: dict[str, tuple[str | bytes, dict[str, Any], tuple[str, ...]]] = {
    "empty": ("", {}, ("empty", "header")),
    "blank lines only": ("\n\n", {}, ("empty",)),
    "header only": (HEADER, {}, ("header but no rows", "at least one row")),
    "ragged": (HEADER + ROWS + "1,2,3\n", {}, ("line 4:", "expected 5 cells", "got 3")),
    "ragged after a blank line": (HEADER + "\n1,2,3\n", {}, ("line 3:",)),
    "many ragged": (HEADER + "1\n" * 9, {}, ("line 2, 3, 4, 5, 6 and 4 more",)),
    "ragged after a quoted line break": ('"q1",q2,x,y,z\n"1\n",2,3,4,5\n1,2\n', {}, ("line 4:", "got 2")),
    "blank header": ("q1,,q2,x,y,z,\n", {}, ("header", "column 2, 7 has no name")),
    "duplicated header": ("q1,q2,x,y,z,q2\n", {}, ("header", "q2", "more than once")),
    "misspelt": (HEADER, {"joints": ["Q1", "q22"]}, ("no column ['Q1', 'q22']", "['q1', 'q2'", "mean q1", "mean q2")),
    "missing": (HEADER, {"position": ["x", "y", "height"]}, ("no column ['height']", "stand in the header")),
    "separator": (SEMICOLONS + "1;2;3;4;5\n", {}, ("single column", "q1;q2;x", "pass sep=';'")),
    "comment": (
        "# by a tracker, today\nq1,q2,x,y,z\n1,2,3,4,5\n",
        {},
        ("begins with a comment", "names of the columns"),
    ),
    "one column": ("nothing\n1\n", {}, ("single column", "check the file")),
    "decimal comma": (
        SEMICOLONS + "1;2;3;4;5\n1,5;2;3;4;5\n1;2;3,5;4;5,5\n",
        {"sep": ";"},
        ("line 3, column 'q1' (and 2 more, on line 4)", "'1,5'", "decimal comma", "decimal=','"),
    ),
    "decimal point": (
        SEMICOLONS + "1.5;2;3;4;5\n",
        {"sep": ";", "decimal": ","},
        ("line 2, column 'q1'", "got '1.5'", "decimal point", "decimal='.'"),
    ),
    "thousands": (SEMICOLONS + "1;2;1.234,5;4;5\n", {"sep": ";", "decimal": ","}, ("column 'x'", "thousands")),
    "word": (HEADER + "1,2,far,4,5\n", {}, ("line 2, column 'x'", "a number", "got 'far'")),
    "underscore": (HEADER + "1_0,2,3,4,5\n", {}, ("a number", "got '1_0'")),
    "empty cell": (HEADER + ROWS + "1,2,,4,5\n", {}, ("line 4, column 'x'", "finite", "an empty cell")),
    "nan": (
        HEADER + "1,2,3,4,NaN\n" * 8,
        {},
        ("line 2, column 'z' (and 7 more, on line 3, 4, 5, 6, 7 and 2 more)", "'NaN'"),
    ),
    "infinite": (HEADER + "1,-inf,3,4,5\n", {}, ("line 2, column 'q2'", "got '-inf'")),
    "overflow": (HEADER + "1,2,3,1e999,5\n", {}, ("line 2, column 'y'", "finite", "1e999")),
    "only separators": (HEADER + ",,,,\n", {}, ("line 2, column 'q1' (and 4 more, on line 2)", "an empty cell")),
    "duplicates": (
        HEADER + ROWS + "9,9,9,9,9\n" + ROWS.replace("0.1,", "0.10,"),
        {},
        ("2 line(s)", "5 repeats 2, 6 repeats 3", "duplicates='drop'"),
    ),
    "quote": (HEADER + '1,2,"3,4,5\n6,7,8,9,10\n', {}, ("line 2", "not valid CSV", "quotes")),
    "not text": (b"PK\x03\x04\xff\xfe", {}, ("not UTF-8", "CSV")),
}


@pytest.mark.parametrize("name", WRONG_FILES)
def test_wrong_file_is_one_clear_error(name: str, read: Reader) -> None:
    text, options, message = WRONG_FILES[name]
    with pytest.raises(MeasurementError, match=says("table.csv", *message)) as caught:
        read(text, **options)
    assert str(caught.value).endswith(".")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"length": "cm"}, ("`length`", "'m' or 'mm'", "got 'cm'")),
        ({"angle": "degrees"}, ("`angle`", "'rad' or 'deg'", "got 'degrees'")),
        ({"decimal": "."}, ()),
        ({"decimal": ";"}, ("`decimal`", "';'")),
        ({"decimal": ","}, ("`sep` and `decimal`", "different", "sep=';'")),
        ({"sep": "::"}, ("`sep`", "one character", "'::'")),
        ({"duplicates": "ignore"}, ("`duplicates`", "'error' or 'keep' or 'drop'")),
        ({"joints": "q1"}, ("`joints`", "'q1'")),
        ({"joints": []}, ("`joints`",)),
        ({"joints": [1, 2]}, ("`joints`",)),
        ({"joints": ["q1", "x"]}, ("distinct columns", "x")),
        ({"position": "xyz"}, ("`position`", "three names")),
        ({"position": ["x", "y"]}, ("`position`", "three names")),
        ({"position": [["x", "y", "z"], ["x", "y"]]}, ("`position`",)),
        ({"position": []}, ("`position`",)),
        ({"kinds": ["revolute"]}, ("`kinds`", "expected 2", "got 1")),
        ({"kinds": ["revolute", "planar"]}, ("`kinds`", "'prismatic'", "got 'planar'")),
    ],
)
def test_wrong_option_is_one_clear_error(options: dict[str, Any], message: tuple[str, ...], read: Reader) -> None:
    if not message:
        assert len(read(HEADER + ROWS, **options)) == 2
        return
    with pytest.raises(MeasurementError, match=says(*message)):
        read(HEADER + ROWS, **options)


def test_units_must_be_named(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="length"):
        read_measurements(tmp_path, JOINTS, POSITION, angle="rad")  # pyright: ignore[reportCallIssue]
    with pytest.raises(TypeError, match="angle"):
        read_measurements(tmp_path, JOINTS, POSITION, length="m")  # pyright: ignore[reportCallIssue]


def test_a_file_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=says("nowhere.csv", "does not exist", "folder")):
        read_measurements(tmp_path / "nowhere.csv", JOINTS, POSITION, length="m", angle="rad")
    with pytest.raises(MeasurementError, match="cannot be opened"):
        read_measurements(tmp_path, JOINTS, POSITION, length="m", angle="rad")


def test_duplicates_kept_or_dropped_on_request(read: Reader) -> None:
    text = HEADER + ROWS + ROWS + "9,9,9,9,9\n"
    assert len(read(text, duplicates="keep")) == 5  # asked for: no warning, and warnings are errors here
    with pytest.warns(DiffeoCalibWarning, match=says("dropped 2 line(s)", "line 4, 5")) as record:
        data = read(text, duplicates="drop")
    assert len(record) == 1
    assert data.q[:, 0].tolist() == [0.1, 0.3, 9.0]


@pytest.mark.parametrize(
    ("row", "options", "message"),
    [
        ("0,90,1,2,3", {}, ("90 rad", "look like degrees", "angle='deg'")),
        ("0,1.5,1,2,3", {"angle": "deg"}, ("1.5 deg", "look like radians", "angle='rad'")),
        ("0,1.5,1000,2,3", {}, ("1000 m", "look like millimetres", "length='mm'")),
        ("0,1.5,1,2,3", {"length": "mm"}, ("3 mm", "look like metres", "length='m'")),
    ],
)
def test_unlikely_units_are_doubted(row: str, options: dict[str, str], message: tuple[str, ...], read: Reader) -> None:
    with pytest.warns(DiffeoCalibWarning, match=says("table.csv", *message)) as record:
        read(HEADER + row, **options)
    assert len(record) == 1
    assert record[0].filename == __file__


def test_prismatic_joints_are_not_taken_for_degrees(read: Reader) -> None:
    read(HEADER + "90,0.1,1000,0,500\n", kinds=["prismatic", "revolute"], length="mm", angle="rad")
    told = says("look like degrees, or like millimetres of a slide; pass the robot, which knows its slides")
    with pytest.warns(DiffeoCalibWarning, match=told):  # nobody said that it slides
        read(HEADER + "90,0.1,1000,0,500\n", length="mm", angle="rad")
    with pytest.warns(DiffeoCalibWarning, match=says("look like degrees; pass angle='deg' if they are")):
        read(HEADER + "90,0.1,1000,0,500\n", kinds=["revolute", "revolute"], length="mm", angle="rad")


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_predicted_poses_are_read_back_as_measurements(convention: str, tmp_path: Path) -> None:
    """In every convention, with the columns in the order in which they stand, names and unit as `predict` says."""
    rng = np.random.default_rng(0)
    q, shifts = torch.from_numpy(rng.uniform(-3, 3, (9, 2))), torch.from_numpy(rng.uniform(-1, 1, (9, 3)))
    turns = rotation_matrices(torch.from_numpy(rng.uniform(-1.5, 1.5, (9, 3))), "rotvec")
    poses, std = transforms(turns, shifts), torch.full((9, 3), 1e-5, dtype=torch.float64)
    path, units = tmp_path / "p.csv", {"length": "mm", "angle": "deg", "sep": ";", "decimal": ","}
    options: Any = {"joints": ["a", "b"], "convention": convention, "rotation_angle": "deg", **units}
    write_predictions(path, q, shifts[:, None], std[:, None], poses=poses, rotation_deviations=std, **options)
    header = path.read_text().splitlines()[0].split(";")
    columns = header[header.index("std_z") + 1 : header.index("std_rx")]
    stds: Any = {"std": ["std_x", "std_y", "std_z"], "rotation_std": ["std_rx", "std_ry", "std_rz"]}
    reading: Any = {"rotation": columns, "convention": convention, "rotation_angle": "deg", **stds, **units}
    data = read_measurements(path, ["a", "b"], ["x", "y", "z"], **reading)
    assert_close(data.poses, poses, rtol=0, atol=1e-12)
    assert_close(data.q, q, rtol=1e-14, atol=0)
    assert_close(data.rotation_std, std, rtol=1e-12, atol=0)
    words = reading_options(convention, "deg").split()
    assert words[words.index("--rotation") + 1] == ",".join(columns)
    assert ("--rotation-angle" in words) == (len(columns) == 3)


# --- joints alone ---------------------------------------------------------------------------------


def test_joints_alone(tmp_path: Path) -> None:
    path = tmp_path / "path.csv"
    path.write_text("slide;time;turn\n250,5;noon;90\n-100;;-45\n")
    robot: Any = SimpleNamespace(joint_names=("turn", "slide"), kinds=("revolute", "prismatic"))
    expected = torch.tensor([[math.pi / 2, 0.2505], [-math.pi / 4, -0.1]], dtype=torch.float64)
    q = read_joints(path, robot, length="mm", angle="deg", sep=";", decimal=",")
    assert_close(q, expected, rtol=1e-15, atol=0)
    metres = read_joints(path, ["slide"], angle="deg", sep=";", decimal=",", kinds=["prismatic"])
    assert_close(metres, torch.tensor([[250.5], [-100.0]], dtype=torch.float64), rtol=0, atol=0)


def test_joints_alone_may_repeat_and_are_those_of_the_measurements(tmp_path: Path, read: Reader) -> None:
    data = read(HEADER + ROWS + ROWS, duplicates="keep")
    q = read_joints(tmp_path / "table.csv", JOINTS, angle="rad")
    assert q.dtype == torch.float64
    assert_close(q, data.q, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("q1,q2\n1,two\n", {}, ("line 2, column 'q2'", "a number", "'two'")),
        ("q1,q3\n1,2\n", {}, ("no column ['q2']", "['q1', 'q3']")),
        ("q1,q2\n", {}, ("header but no rows",)),
        ("q1,q2\n1,2\n", {"angle": "turns"}, ("`angle`", "'turns'")),
        ("q1,q2\n1,2\n", {"length": "cm"}, ("`length`", "'cm'")),
    ],
)
def test_wrong_joints_are_one_clear_error(
    text: str, options: dict[str, Any], message: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "path.csv").write_text(text)
    with pytest.raises(MeasurementError, match=says(*message)):
        read_joints(tmp_path / "path.csv", JOINTS, **({"angle": "rad"} | options))


def test_joints_like_degrees_are_doubted(tmp_path: Path) -> None:
    (tmp_path / "path.csv").write_text("q1,q2\n0,90\n")
    with pytest.warns(DiffeoCalibWarning, match=says("path.csv", "90 rad", "look like degrees")) as record:
        read_joints(tmp_path / "path.csv", JOINTS, angle="rad")
    assert record[0].filename == __file__


# --- poses and standard deviations ----------------------------------------------------------------

POSE_HEADER = "q1,q2,x,y,z,a,b,c,d\n"
POSE: dict[str, Any] = {"rotation": ["a", "b", "c"], "convention": "XYZ", "rotation_angle": "deg"}


def held(tensor: torch.Tensor | None) -> torch.Tensor:
    assert tensor is not None
    return tensor


def test_poses_are_read(read: Reader) -> None:
    data = read(POSE_HEADER + "1,2,1000,2000,3000,10,20,-170,\n3,4,0,0,0,30,40,50,\n", length="mm", **POSE)
    rotations = rotation_matrices(np.radians([[10, 20, -170], [30, 40, 50]]), "XYZ")
    expected = transforms(rotations, torch.tensor([[1, 2, 3], [0, 0, 0]], dtype=torch.float64))
    assert_close(held(data.poses), expected, rtol=0, atol=1e-15)
    assert (data.lever, data.joint_names, data.std, data.rotation_std) == (0.1, ("q1", "q2"), None, None)
    other = read(POSE_HEADER + "1,2,1000,2000,3000,10,20,-170,\n", length="mm", lever=0.25, **POSE)
    assert other.lever == 0.25  # in m, whatever the file's unit


@pytest.mark.parametrize("angle", ["rad", "deg"])
@pytest.mark.parametrize("convention", ["rotvec", "quat_xyzw", "quat_wxyz", "matrix", "xyz", "ZYZ"])
def test_poses_are_written_and_read_back(convention: str, angle: str, tmp_path: Path) -> None:
    rng, path = np.random.default_rng(0), tmp_path / "poses.csv"
    rotations = rotation_matrices(rng.uniform(-3, 3, (9, 3)), "rotvec")
    poses = transforms(rotations, torch.from_numpy(rng.uniform(-2, 2, (9, 3))))
    std, turns = rng.uniform(1e-5, 1e-4, (9, 3)), rng.uniform(1e-5, 1e-4, (9, 3))
    q = rng.uniform(-3, 3, (9, 2))
    data = Measurements.from_poses(q, poses, JOINTS, lever=0.3, position_std=std, rotation_std=turns)
    units: dict[str, Any] = {"length": "mm", "angle": "rad", "sep": ";", "decimal": ","}
    write_measurements(path, data, convention=convention, rotation_angle=angle, **units)
    header = path.read_text().splitlines()[0].split(";")
    rotation = header[5 : len(header) - 6]
    again = read_measurements(
        *(path, JOINTS, POSITION),
        rotation=rotation,
        convention=convention,
        rotation_angle=angle,
        std=["std_x", "std_y", "std_z"],
        rotation_std=["std_rx", "std_ry", "std_rz"],
        lever=0.3,
        **units,
    )
    assert_close(held(again.poses), poses, rtol=0, atol=1e-13)
    assert_close(again.points, data.points, rtol=0, atol=1e-13)
    assert_close(held(again.std)[:, 0], torch.from_numpy(std), rtol=1e-15, atol=0)
    assert_close(held(again.rotation_std), torch.from_numpy(turns), rtol=1e-15, atol=0)
    assert_close(held(again.covariance), held(data.covariance))


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
    write_measurements(path, data, length="mm", angle="deg", convention=convention)
    header, row = (line.split(",") for line in path.read_text().splitlines())
    assert header == ["q1", "x", "y", "z", *WRITTEN_ROTATIONS[convention], "std_rx", "std_ry", "std_rz"]
    assert float(row[-1]) == pytest.approx(math.degrees(0.5))
    if convention == "rotvec":
        assert [float(cell) for cell in row[4:7]] == pytest.approx([0, 0, 90])
        write_measurements(path, data, length="mm", angle="deg", rotation_angle="rad")  # the default convention
        assert [float(cell) for cell in path.read_text().splitlines()[1].split(",")[4:7]] == pytest.approx(
            [0, 0, math.pi / 2]
        )


def test_own_names_of_written_columns(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    pose = torch.eye(4, dtype=torch.float64)[None]
    data = Measurements.from_poses([[0.5]], pose, position_std=1e-3, rotation_std=1.0)
    names: dict[str, Any] = {"position": "xyz", "rotation": "abc", "std": "uvw", "rotation_std": "klm"}
    options: dict[str, Any] = {name: list(letters) for name, letters in names.items()}
    write_measurements(path, data, length="m", angle="rad", joints=["j"], **options)
    assert path.read_text().splitlines() == [
        "j,x,y,z,a,b,c,u,v,w,k,l,m",
        "0.5" + ",0.0" * 6 + ",0.001" * 3 + ",1.0" * 3,
    ]


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


def test_standard_deviations_of_points_come_back(tmp_path: Path) -> None:
    data, path = some(5, markers=2), tmp_path / "table.csv"
    std = np.random.default_rng(0).uniform(1e-6, 1e-3, (5, 2, 3))
    known = Measurements(data.q, data.points, std=std)
    write_measurements(path, known, length="m", angle="rad")
    header = path.read_text().splitlines()[0].split(",")
    assert header[-6:] == [f"std_marker{k}_{axis}" for k in (1, 2) for axis in "xyz"]
    again = read_measurements(path, header[:2], [header[2:5], header[5:8]], length="m", angle="rad", std=header[8:])
    assert_close(held(again.std), held(known.std), rtol=0, atol=0)


POSE_ROW = "0.1,0.2,1.0,2.0,3.0,10,20,30,1\n"
QUATERNION = {"rotation": ["a", "b", "c", "d"], "convention": "quat_xyzw", "rotation_angle": None}
MATRIX_HEADER = "q1,q2,x,y,z," + ",".join(f"r{i}" for i in range(9)) + "\n"
MATRIX = {"rotation": [f"r{i}" for i in range(9)], "convention": "matrix", "rotation_angle": None}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"convention": None}, ("`rotation` is given", "`convention`", "'quat_xyzw'", "never guessed")),
        ({"rotation": None}, ("`convention` and `rotation_angle` without `rotation`", "leave")),
        ({"rotation": None, "convention": None}, ("`rotation_angle` without `rotation`",)),
        (
            {"rotation": None, "convention": None, "rotation_angle": None, "rotation_std": ["d"] * 3},
            ("`rotation_std` without `rotation`",),
        ),
        ({"rotation_angle": None}, ("`rotation_angle` is missing", "'rad' or 'deg'", "unit of the joints")),
        ({"convention": "rotvec", "rotation_angle": None}, ("`rotation_angle` is missing",)),
        ({"rotation_angle": "grad"}, ("`rotation_angle`", "'rad' or 'deg'", "got 'grad'")),
        ({"convention": "roll-pitch-yaw"}, ("`convention`", "got 'roll-pitch-yaw'")),
        ({"rotation": ["a", "b"]}, ("`rotation`", "3 names of columns for 'XYZ'", "got ['a', 'b']")),
        ({"rotation": "abc"}, ("`rotation`", "got 'abc'")),
        ({"rotation": [1, 2, 3]}, ("`rotation`", "got [1, 2, 3]")),
        ({"convention": "quat_xyzw", "rotation_angle": None}, ("`rotation`", "4 names of columns for 'quat_xyzw'")),
        (QUATERNION | {"rotation_angle": "deg"}, ("`rotation_angle` beside convention 'quat_xyzw'", "leave it out")),
        (QUATERNION, ("table.csv', line 2, columns a, b, c, d", "length 1", "got 37.4299", "order of the columns")),
        ({"rotation": ["a", "b", "x"]}, ("distinct columns", "x")),
        ({"rotation": ["a", "b", "e"]}, ("no column ['e']",)),
        ({"position": [["x", "y", "z"], ["a", "b", "c"]], "rotation": ["q1"] * 3}, ("one triple", "got 2 triples")),
        ({"lever": 0}, ("`lever`", "above 0", "got 0")),
        ({"std": ["d", "q1"]}, ("`std`", "one per marker", "got ['d', 'q1']")),
        ({"std": "d"}, ("`std`", "got 'd'")),
        ({"std": []}, ("`std`", "got []")),
        ({"std": ["a"]}, ("distinct columns", "a")),
        ({"std": [["d"], "d"]}, ("`std`",)),
        ({"rotation_std": ["d"]}, ("`rotation_std`", "three names", "got ['d']")),
        ({"rotation_std": ["d", "d", "d"]}, ("distinct columns", "d")),
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
        (POSE_HEADER + POSE_ROW + "0,0,1,2,3,10,nan,30,1\n", {}, ("line 3, column 'b'", "'nan'")),
        (POSE_HEADER + POSE_ROW + "\n0,0,1,2,3,10,2,30,0\n", {"std": ["d"]}, ("line 4, column 'd'", "positive", "0;")),
        (
            POSE_HEADER + "0,0,1,2,3,10,2,30,-1\n" * 2,
            {"std": ["d"], "duplicates": "keep"},
            ("line 2, column 'd'", "got -1 (2 such cells)"),
        ),
        (
            MATRIX_HEADER + "0,0,1,2,3,1,0,0,0,1,0,0,0,1\n0,0,1,2,3,1,0,0,0,1,0,0,0,-1\n",
            MATRIX,
            ("line 3, columns r0, r1", "mirrored"),
        ),
        (MATRIX_HEADER + "0,0,1,2,3,2,0,0,0,2,0,0,0,2\n", MATRIX, ("line 2", "orthonormal", "without a scale")),
        (POSE_HEADER + POSE_ROW * 2, {}, ("1 line(s)", "3 repeats 2")),
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
def test_unlikely_units_of_rotations_are_doubted(
    row: str, options: dict[str, Any], message: tuple[str, ...], read: Reader
) -> None:
    with pytest.warns(DiffeoCalibWarning, match=says("table.csv", *message)) as record:
        read(POSE_HEADER + row, **(POSE | options))
    assert len(record) == 1
    assert record[0].filename == __file__


def test_likely_rotations_are_not_doubted(read: Reader) -> None:
    read(POSE_HEADER + "0,1,1,2,3,0,0,0,1", **POSE)
    read(POSE_HEADER + "0,1,1,2,3,0,6.2832,0,1", **(POSE | {"rotation_angle": "rad"}))
    read(POSE_HEADER + "0,1,1,2,3,0,0,0,1", **(POSE | QUATERNION))  # quaternions have no unit


@pytest.mark.parametrize(
    ("poses", "options", "message"),
    [
        (False, {"convention": "rotvec"}, ("`convention`", "without poses", "leave it out")),
        (False, {"rotation": ["a", "b", "c"], "rotation_angle": "deg"}, ("`rotation` and `rotation_angle`",)),
        (False, {"std": ["a", "b", "c"]}, ("`std`", "without standard deviations")),
        (True, {"rotation_std": ["a", "b", "c"]}, ("`rotation_std`", "without standard deviations")),
        (True, {"convention": "euler"}, ("`convention`", "got 'euler'")),
        (True, {"rotation_angle": "turns"}, ("`rotation_angle`", "'rad' or 'deg'")),
        (True, {"rotation": ["a", "b"]}, ("`rotation`", "3 names")),
        (True, {"rotation": ["a", "b", "x"]}, ("distinct columns", "x")),
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
        write_measurements(tmp_path / "table.csv", data, length="m", angle="rad", **options)
    assert not (tmp_path / "table.csv").exists()


def test_predicted_poses_are_written(tmp_path: Path) -> None:
    path, pose = tmp_path / "p.csv", torch.eye(4, dtype=torch.float64)[None].clone()
    pose[0, :3, :3] = rotation_matrices([[0, 90, 0]], "rotvec", angle="deg")[0]
    pose[0, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
    q, std = torch.tensor([[0.5]], dtype=torch.float64), torch.full((1, 3), 1e-3, dtype=torch.float64)
    units: dict[str, Any] = {"length": "mm", "angle": "deg"}
    points = pose[:, None, :3, 3]
    turns = torch.full((1, 3), math.radians(0.25), dtype=torch.float64)
    write_predictions(path, q, points, std[:, None], joints=["j"], poses=pose, rotation_deviations=turns, **units)
    header, row = path.read_text().splitlines()
    assert header == "j,x,y,z,std_x,std_y,std_z,rx,ry,rz,std_rx,std_ry,std_rz"
    expected = [math.degrees(0.5), 1000, 2000, 3000, 1, 1, 1, 0, 90, 0, 0.25, 0.25, 0.25]
    assert [float(cell) for cell in row.split(",")] == pytest.approx(expected, abs=1e-12)
    write_predictions(path, q, points, std[:, None], joints=["j"], poses=pose, convention="quat_wxyz", **units)
    assert path.read_text().splitlines()[0] == "j,x,y,z,std_x,std_y,std_z,qw,qx,qy,qz"


# --- writing --------------------------------------------------------------------------------------

numbers = st.floats(-6.0, 6.0, allow_nan=False, allow_subnormal=False)


@settings(suppress_health_check=[HealthCheck.too_slow], deadline=None, max_examples=50)
@given(st.data(), st.integers(1, 4), st.integers(1, 3), st.integers(1, 5))
# random values may look like anything
@pytest.mark.filterwarnings("ignore::diffeo_calib.common.errors.DiffeoCalibWarning")
def test_round_trip(draw: st.DataObject, n: int, markers: int, rows: int) -> None:
    table = np.array(draw.draw(st.lists(numbers, min_size=rows * (n + 3 * markers), max_size=rows * (n + 3 * markers))))
    q, points = np.split(table.reshape(rows, -1), [n], axis=1)
    names = [f"axis {i}, tilted" for i in range(n)]  # the separator in a name
    data = Measurements(q, points.reshape(rows, markers, 3), names, [f"ball{k}" for k in range(markers)])
    position = [(f"ball{k}_x", f"ball{k}_y", f"ball{k}_z") for k in range(markers)]
    sep, decimal = draw.draw(st.sampled_from([(",", "."), (";", ","), ("\t", ".")]))
    length, angle = draw.draw(st.sampled_from(["m", "mm"])), draw.draw(st.sampled_from(["rad", "deg"]))
    kinds = draw.draw(st.lists(st.sampled_from(["revolute", "prismatic"]), min_size=n, max_size=n))
    options: dict[str, Any] = {"length": length, "angle": angle, "sep": sep, "decimal": decimal, "kinds": kinds}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.csv"
        write_measurements(path, data, **options)
        again = read_measurements(path, names, position, duplicates="keep", **options)
    rtol = 0.0 if (length, angle) == ("m", "rad") else 1e-15
    assert_close(again.q, data.q, rtol=rtol, atol=0)
    assert_close(again.points, data.points, rtol=rtol, atol=0)
    assert again.joint_names == data.joint_names


def test_written_columns(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write_measurements(path, Measurements([[0.5]], [[1, 2, 3]]), length="mm", angle="rad", sep=";", decimal=",")
    assert path.read_text().splitlines() == ["q1;x;y;z", "0,5;1000,0;2000,0;3000,0"]
    write_measurements(path, Measurements([[0.5]], [[[1, 2, 3]] * 2]), length="m", angle="rad")
    assert path.read_text().splitlines()[0] == "q1,marker1_x,marker1_y,marker1_z,marker2_x,marker2_y,marker2_z"
    write_measurements(path, some(2), length="m", angle="deg", joints=["a", "b"], position=["u", "v", "w"])
    assert path.read_text().splitlines()[0] == "a,b,u,v,w"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"length": "inch"}, ("`length`", "'m' or 'mm'")),
        ({"joints": ["a"]}, ("joint columns", "expected 2", "got 1")),
        ({"position": [POSITION, ["u", "v", "w"]]}, ("position triples", "expected 1", "got 2")),
        ({"joints": ["x", "b"]}, ("distinct columns", "x")),
    ],
)
def test_wrong_writing_option_is_one_clear_error(
    options: dict[str, Any], message: tuple[str, ...], tmp_path: Path
) -> None:
    with pytest.raises(MeasurementError, match=says(*message)):
        write_measurements(tmp_path / "table.csv", some(2), **({"length": "m", "angle": "rad"} | options))
    assert not (tmp_path / "table.csv").exists()


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=says("none", "cannot be written", "folder")):
        write_measurements(tmp_path / "none" / "table.csv", some(2), length="m", angle="rad")


# --- hardware -------------------------------------------------------------------------------------

UR10_JOINTS = [
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
]


@pytest.fixture(scope="module")
def ur10() -> Measurements:
    """632 poses of a UR10, measured with a laser tracker."""
    folder = os.environ.get("DIFFEO_CALIB_DATA")
    if not folder or not (Path(folder) / "ipa_ur10").is_dir():
        pytest.skip("needs real measurements: set DIFFEO_CALIB_DATA to the folder that holds ipa_ur10/")
    path = Path(folder) / "ipa_ur10" / "measurements_iso_cubes.csv"
    position = ["measurement_x", "measurement_y", "measurement_z"]
    return read_measurements(path, UR10_JOINTS, position, length="mm", angle="rad", sep=";", decimal=",")


UR10_POSES: dict[str, Any] = {
    "rotation": ["measurement_rx", "measurement_ry", "measurement_rz"],
    "convention": "XYZ",
    "rotation_angle": "deg",
    "std": ["measurement_std_x", "measurement_std_y", "measurement_std_z"],
    "rotation_std": ["measurement_std_rx", "measurement_std_ry", "measurement_std_rz"],
}


def hardware_folder(name: str) -> Path:
    folder = os.environ.get("DIFFEO_CALIB_DATA")
    if not folder or not (Path(folder) / name).is_dir():
        pytest.skip(f"needs real measurements: set DIFFEO_CALIB_DATA to the folder that holds {name}/")
    return Path(folder) / name


def relative_spread(measured: torch.Tensor, nominal: torch.Tensor) -> torch.Tensor:
    """How far turns between poses differ, measured against nominal: neither base nor tool frame matters for angles."""
    first, others = measured[:1, :3, :3], measured[1:, :3, :3]
    start, rest = nominal[:1, :3, :3], nominal[1:, :3, :3]
    turned = angle_between(first.expand_as(others), others) - angle_between(start.expand_as(rest), rest)
    return turned.abs()


def test_ur10_poses_are_read(ur10: Measurements) -> None:
    """The convention is right: turns between poses are those between the commanded flange poses."""
    path = hardware_folder("ipa_ur10") / "measurements_iso_cubes.csv"
    position = ["measurement_x", "measurement_y", "measurement_z"]
    options: dict[str, Any] = {"length": "mm", "angle": "rad", "sep": ";", "decimal": ","}
    data = read_measurements(path, UR10_JOINTS, position, **options, **UR10_POSES)
    poses = held(data.poses)
    assert_close(poses[:, :3, 3], ur10.points[:, 0], rtol=0, atol=1e-15)
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


def test_fr3_poses_are_read() -> None:
    """Matrices of a camera, against those that the controller reports."""
    path = hardware_folder("franka_fr3") / "franka_fr3_camera.csv"
    joints = [f"q{i}_rad" for i in range(1, 8)]
    matrix = [f"cam_T{i}{j}" for i in range(3) for j in range(3)]
    options: dict[str, Any] = {"length": "m", "angle": "rad", "convention": "matrix"}
    data = read_measurements(path, joints, ["cam_T03", "cam_T13", "cam_T23"], rotation=matrix, **options)
    assert len(data) == 114
    reported = [f"tcp_{4 * i + j}" for i in range(3) for j in range(3)]
    tcp = read_measurements(path, joints, ["tcp_3", "tcp_7", "tcp_11"], rotation=reported, **options)
    assert float(relative_spread(held(data.poses), held(tcp.poses)).median()) < math.radians(1.0)


def test_ur10_is_read(ur10: Measurements) -> None:
    assert (len(ur10), ur10.n, ur10.markers) == (632, 6, 1)
    assert_close(ur10.points[0, 0], torch.tensor([2.3367643, -0.90576441, -0.45463664], dtype=torch.float64))
    assert_close(ur10.q[0, :2], torch.tensor([0.934319, -1.79251], dtype=torch.float64))
    assert cast(tuple[str, ...], ur10.joint_names)[2] == "elbow_joint"


def test_ur10_repeats_stay_together(ur10: Measurements) -> None:
    assert len(ur10.groups().unique()) < 632  # some configurations do repeat
    for seed in range(4):
        train, test = ur10.split(0.7, seed)
        assert len(train) + len(test) == 632
        assert abs(len(train) - 442) <= 1
        nearest = torch.cdist(train.q, test.q, p=math.inf).min()
        assert float(nearest) > REPEAT_TOLERANCE
