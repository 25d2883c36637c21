"""Tables in CSV files: units, separators, joints alone, and files with every kind of mistake in them."""

from __future__ import annotations

import csv
import math
import os
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from product_bank import sliding_measurements, sliding_robot
from table_bank import HEADER, JOINTS, POSITION, ROWS, Reader, read_table, says
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.cli.options import Units
from diffeo_calib.cli.tables import MeasuredTable, of_robot, table_format
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.csv.files import read_joints, read_measurements, write_measurements, write_predictions
from diffeo_calib.measurements.table_format import TableFormat


def test_reads_si(read: Reader) -> None:
    data = read(
        "\ufeffname, z,q2 ,y,x,q1\r\nA,3,0.2,2,1,.1\r\n\r\n'B',-3.5,4e-1,2.5,1.5,0.3\r\n"
    )  # BOM, blank line, order
    assert_close(data.q, torch.tensor([[0.1, 0.2], [0.3, 0.4]], dtype=torch.float64), rtol=0, atol=0)
    assert_close(data.points[:, 0], torch.tensor([[1, 2, 3], [1.5, 2.5, -3.5]], dtype=torch.float64), rtol=0, atol=0)
    assert data.joint_names == ("q1", "q2")


def test_columns_may_have_other_names_than_the_robot_s_joints(read: Reader, tmp_path: Path) -> None:
    robot = SimpleNamespace(joint_names=("slide", "turn"), kinds=("prismatic", "revolute"))
    expected = read(HEADER + "250,90,1000,0,500\n", kinds=robot.kinds, length="mm", angle="deg")
    how: dict[str, Any] = {"length": "mm", "angle": "deg"}
    data = read_measurements(tmp_path / "table.csv", robot, POSITION, joints=JOINTS, **how)
    assert data.joint_names == robot.joint_names
    assert torch.equal(data.q, expected.q)
    with pytest.raises(MeasurementError, match="`joints`"):
        read_measurements(tmp_path / "table.csv", robot, POSITION, joints=JOINTS[:1], **how)


def test_columns_of_other_joints_are_not_suggested(tmp_path: Path) -> None:
    joints = ["wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
    (tmp_path / "table.csv").write_text("wrist_1_joint,wrist_2_joint,Wrist3,x,y,z\n1,2,3,4,5,6\n")
    with pytest.raises(MeasurementError, match=r"for 'wrist_3_joint', did you mean Wrist3\.$"):
        read_measurements(tmp_path / "table.csv", joints, POSITION, length="m", angle="rad")


def test_prismatic_joints_take_the_unit_of_length(read: Reader) -> None:
    robot = SimpleNamespace(joint_names=("q1", "q2"), kinds=("prismatic", "revolute"))
    for joints, kinds, unit, slide in (
        (robot, None, None, 250),
        (JOINTS, ["prismatic", "continuous"], None, 250),
        (robot, None, "m", 0.25),
    ):
        text = HEADER + f"{slide},90,1000,0,500\n"
        data = read(text, joints=joints, kinds=kinds, length="mm", angle="deg", joint_length=unit)
        assert_close(data.q, torch.tensor([[0.25, math.pi / 2]], dtype=torch.float64))
        assert data.points.tolist() == [[[1.0, 0.0, 0.5]]]


SEMICOLONS = HEADER.replace(",", ";")
WRONG_FILES: dict[str, tuple[str | bytes, dict[str, Any], tuple[str, ...]]] = {
    "empty": ("", {}, ("empty", "header")),
    "header only": (HEADER, {}, ("header but no rows", "at least one row")),
    "ragged": (HEADER + ROWS + "1,2,3\n", {}, ("line 4:", "expected 5 cells", "got 3")),
    "many ragged": (HEADER + "1\n" * 9, {}, ("line 2, 3, 4, 5, 6 and 4 more",)),
    "ragged after a quoted line break": ('"q1",q2,x,y,z\n"1\n",2,3,4,5\n1,2\n', {}, ("line 4:", "got 2")),
    "duplicated header": ("q1,q2,x,y,z,q2\n", {}, ("header", "q2", "more than once")),
    "misspelt": (HEADER, {"joints": ["Q1", "q22"]}, ("no column ['Q1', 'q22']", "['q1', 'q2'", "mean q1", "mean q2")),
    "missing": (HEADER, {"position": ["x", "y", "height"]}, ("no column ['height']", "written in the header")),
    "separator": (SEMICOLONS + "1;2;3;4;5\n", {}, ("single column", "q1;q2;x", "pass sep=';'")),
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
    "thousands": (SEMICOLONS + "1;2;1.234;4;5\n", {"sep": ";", "decimal": ","}, ("column 'x'", "thousands")),
    "word": (HEADER + "1,2,far,4,5\n", {}, ("line 2, column 'x'", "a number", "got 'far'")),
    "empty cell": (HEADER + ROWS + "1,2,,4,5\n", {}, ("line 4, column 'x'", "finite", "an empty cell")),
    "nan": (
        HEADER + "1,2,3,4,NaN\n" * 8,
        {},
        ("line 2, column 'z' (and 7 more, on line 3, 4, 5, 6, 7 and 2 more)", "'NaN'"),
    ),
    "mark of a missing reading": (HEADER + "1,2,3,1e30,5\n", {}, ("line 2, column 'y'", "below 1e+12", "1e30")),
    "duplicates": (
        HEADER + ROWS + "9,9,9,9,9\n" + ROWS.replace("0.1,", "0.10,"),
        {},
        ("2 line(s)", "5 repeats 2, 6 repeats 3", "duplicates='drop'"),
    ),
    "quote": (HEADER + '1,2,"3,4,5\n6,7,8,9,10\n', {}, ("line 2", "not valid CSV", "quotes")),
    "not text": (b"PK\x03\x04\xff\xfe", {}, ("no text but a spreadsheet", "save it as .xlsx or CSV")),
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
        ({"length": "km"}, ("`length`", "'m' or 'mm' or 'cm' or 'inch'", "got 'km'")),
        ({"angle": "degrees"}, ("`angle`", "'rad' or 'deg'", "got 'degrees'")),
        ({"decimal": "."}, ()),
        ({"decimal": ";"}, ("`decimal`", "';'")),
        ({"decimal": ","}, ("`sep` and `decimal`", "different", "sep=';'")),
        ({"sep": "::"}, ("`sep`", "one character", "'::'")),
        ({"duplicates": "ignore"}, ("`duplicates`", "'error' or 'keep' or 'drop'")),
        ({"joints": "q1"}, ("`joints`", "'q1'")),
        ({"joints": ["q1", "x"]}, ("distinct columns", "x")),
        ({"position": [["x", "y", "z"]] * 2}, ("`joints` and `position`", "distinct columns", "x")),
        ({"position": "xyz"}, ("`position`", "three names")),
        ({"position": [["x", "y", "z"], ["x", "y"]]}, ("`position`",)),
        (
            {"kinds": ["revolute"]},
            ("`joints`: expected 1 columns of joints, one for each of `kinds`, got 2 (['q1', 'q2'])",),
        ),
        ({"kinds": ["revolute", "planar"]}, ("`kinds`", "'prismatic'", "got 'planar'")),
        ({"joint_length": "km"}, ("`joint_length`: expected 'm' or 'mm' or 'cm' or 'inch', got 'km'",)),
        ({"joint_length": "m"}, ("`joint_length` without the kinds of the joints", "pass the robot, or `kinds`")),
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
    with pytest.raises(MeasurementError, match="is a folder"):
        read_measurements(tmp_path, JOINTS, POSITION, length="m", angle="rad")


def test_duplicates_kept_or_dropped_on_request(read: Reader) -> None:
    text = HEADER + ROWS + ROWS + "9,9,9,9,9\n"
    assert len(read(text, duplicates="keep")) == 5  # asked for: no warning, and warnings are errors here
    with pytest.warns(DiffeoCalibWarning, match=says("dropped 2 line(s)", "line 4, 5")) as record:
        data = read(text, duplicates="drop")
    assert len(record) == 1
    assert data.q[:, 0].tolist() == [0.1, 0.3, 9.0]


MIXED: dict[str, Any] = {"kinds": ["prismatic", "revolute"], "angle": "deg"}


@pytest.mark.parametrize(
    ("row", "options", "message"),
    [
        ("0,90,1,2,3", {}, ("90 rad", "look like degrees", "angle='deg'")),
        ("0,1.5,1,2,3", {"angle": "deg"}, ("1.5 deg", "look like radians", "angle='rad'")),
        ("0,1.5,1000,2,3", {}, ("1000 m", "look like millimetres", "length='mm'")),
        ("0,1.5,1,2,3", {"length": "mm"}, ("3 mm", "look like metres", "length='m'")),
        ("0.25,90,1000,0,500", MIXED | {"length": "mm"}, ("joints reach only 0.25 mm: they look like metres; pass j",)),
        ("250,90,1,0,0.5", MIXED | {"length": "m"}, ("250 m: they look like millimetres; pass joint_length='mm'",)),
    ],
)
def test_unlikely_units_cause_a_warning(
    row: str, options: dict[str, str], message: tuple[str, ...], read: Reader
) -> None:
    with pytest.warns(DiffeoCalibWarning, match=says("table.csv", *message)) as record:
        read(HEADER + row, **options)
    assert len(record) == 1
    assert Path(record[0].filename).name == "conftest.py"  # where `read` calls the package


def test_prismatic_joints_are_not_taken_for_degrees(read: Reader) -> None:
    read(HEADER + "90,0.1,1000,0,500\n", kinds=["prismatic", "revolute"], length="mm", angle="rad")
    message = says("look like degrees, or like millimetres of a prismatic joint; pass the robot, which knows")
    with pytest.warns(DiffeoCalibWarning, match=message):  # the kinds of the joints are not known
        read(HEADER + "90,0.1,1000,0,500\n", length="mm", angle="rad")
    with pytest.warns(DiffeoCalibWarning, match=says("look like degrees; pass angle='deg' if they are")):
        read(HEADER + "90,0.1,1000,0,500\n", kinds=["revolute", "revolute"], length="mm", angle="rad")


# --- joints alone ---------------------------------------------------------------------------------


def test_joints_alone(tmp_path: Path) -> None:
    path = tmp_path / "path.csv"
    path.write_text("slide;time;turn\n250,5;noon;90\n-100;;-45\n")
    robot: Any = SimpleNamespace(joint_names=("turn", "slide"), kinds=("revolute", "prismatic"))
    expected = torch.tensor([[math.pi / 2, 0.2505], [-math.pi / 4, -0.1]], dtype=torch.float64)
    q = read_joints(path, TableFormat("mm", "deg", ";", ",", joints=robot))
    assert_close(q, expected, rtol=1e-15, atol=0)
    with pytest.warns(DiffeoCalibWarning, match=r"prismatic joints reach 250.5 m: they look like millimetres"):
        metres = read_joints(path, TableFormat("m", "deg", ";", ",", joints=["slide"], kinds=["prismatic"]))
    assert_close(metres, torch.tensor([[250.5], [-100.0]], dtype=torch.float64), rtol=0, atol=0)


SI = TableFormat("m", "rad", joints=JOINTS)


@pytest.mark.parametrize("content", [(HEADER + ROWS + ROWS).encode(), b"PK\x03\x04\xff\xfe"])
def test_a_pipe_is_read_once(content: bytes, tmp_path: Path, read: Reader) -> None:
    """Joints alone may repeat."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    feeder = threading.Thread(target=lambda: pipe.write_bytes(content))
    feeder.start()
    if content.startswith(b"PK"):
        with pytest.raises(MeasurementError, match=says("no text", "save it as .xlsx or CSV")):
            read_joints(pipe, SI)
    else:
        assert_close(read_joints(pipe, SI), read(content, duplicates="keep").q, rtol=0, atol=0)
    feeder.join()


def test_a_device_without_an_end_is_refused() -> None:
    with pytest.raises(MeasurementError, match="'/dev/zero' is no text but binary"):
        read_joints("/dev/zero", SI)


@pytest.mark.parametrize("units", [("mm", "m"), ("m", "mm")])
def test_what_is_written_is_read_back(units: tuple[str, str], tmp_path: Path) -> None:
    robot = sliding_robot()
    data = sliding_measurements(robot, 12)
    table = TableFormat(units[0], "deg", joint_length=units[1])
    write_measurements(tmp_path / "t.csv", data, table, joints=robot)
    again = read_table(tmp_path / "t.csv", robot, ["x", "y", "z"], table)
    assert_close(again.q, data.q, rtol=1e-14, atol=1e-15)
    assert_close(again.points, data.points, rtol=1e-14, atol=1e-15)


def test_programs_and_predictions_keep_the_unit(tmp_path: Path) -> None:
    robot, q = sliding_robot(), sliding_measurements(sliding_robot(), 3).q
    path, table = (tmp_path / "program.csv", table_format(Units(length="mm", angle="deg", joint_length="m")))
    assert table == TableFormat("mm", "deg", joint_length="m")
    points = torch.ones(3, 1, 3, dtype=torch.float64)
    write_predictions(path, [(q, points, 1e-3 * points)], table, joints=robot.joint_names, kinds=robot.kinds)
    assert_close(read_joints(path, of_robot(table, robot)), q, rtol=1e-14, atol=1e-15)
    header, first, *_ = list(csv.reader(path.read_text().splitlines()))
    cells = dict(zip(header, first, strict=True))
    assert float(cells["slide"]) == pytest.approx(float(q[0, 2]))
    assert float(cells["x"]) == 1000.0
    measured = MeasuredTable(path, replace(table, position=[["x", "y", "z"]])).read(robot)
    assert_close(measured.q, q, rtol=1e-14, atol=1e-15)


@pytest.mark.slow
def test_slides_in_the_wrong_unit_are_refused_with_the_unit_named() -> None:
    robot = sliding_robot()
    data = sliding_measurements(robot, 15)
    q = data.q.clone()
    q[:, 2] *= 1e3
    with pytest.raises(
        MeasurementError, match=r"values of prismatic joints seem to be 1000 times too .*\(`joint_length`\)"
    ):
        dc.calibrate(robot, dc.Measurements(q, data.points, doubt=False))


def test_tables_with_too_many_columns_are_refused(read: Any) -> None:
    with pytest.raises(MeasurementError, match="expected at most 50000 columns, got 60000"):
        read(",".join(["1"] * 60_000) + "\n")
