"""The table of measurements: validation, splits, and CSV files with every kind of mistake in them."""

from __future__ import annotations

import copy
import dataclasses
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

from diffeo_calib.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements import REPEAT_TOLERANCE, Measurements, read_measurements, write_measurements

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


# --- the table ------------------------------------------------------------------------------------


def test_holds_detached_float64_copies() -> None:
    q = torch.tensor([[0.5, 1.0]], dtype=torch.float32, requires_grad=True)
    points = np.array([[1, 2, 3]])
    data = Measurements(q, points, joint_names=["a", "b"], marker_names=["tip"])
    points[0, 0] = 99
    assert data.q.dtype == data.points.dtype == torch.float64
    assert not data.q.requires_grad
    assert_close(data.points, torch.tensor([[[1.0, 2.0, 3.0]]], dtype=torch.float64))
    assert (len(data), data.n, data.markers) == (1, 2, 1)
    assert data.joint_names == ("a", "b")
    assert data.marker_names == ("tip",)
    assert repr(data) == "Measurements(1 row, 2 joints, 1 marker)"
    assert repr(some(4, n=3, markers=2)) == "Measurements(4 rows, 3 joints, 2 markers)"


def test_is_frozen_and_can_be_copied() -> None:
    data = some(3)
    with pytest.raises(dataclasses.FrozenInstanceError):
        data.q = torch.zeros(3, 2)  # pyright: ignore[reportAttributeAccessIssue]
    assert_close(copy.deepcopy(data).points, data.points)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[0.0, math.nan]], [[1, 2, 3]], ["a", "b"]), ("`q`", "row 0", "column 1", "b", "finite", "nan")),
        (([[0.0]] * 2, [[1, 2, 3], [1, 2, math.inf]]), ("`points`", "row 1", "column 2", "z", "inf")),
        (([[0.0]], [[[1, 2, 3], [math.nan, math.nan, 6]]]), ("row 0", "marker 1, x", "2 such values")),
        (([[0.0]], [[1, 2, 3]] * 2), ("rows", "expected 1", "got 2")),
        (([0.0, 1.0], [1, 2, 3]), ("`q`", "(N, n)", "(2,)")),
        (([[0.0]], [[1, 2]]), ("`points`", "(N, P, 3)", "(1, 2)")),
        (([[0.0]], [1, 2, 3]), ("`points`", "(N, P, 3)", "(3,)")),
        ((np.empty((0, 2)), np.empty((0, 3))), ("`q`", "at least one row", "(0, 2)")),
        (([[0.0, 1.0], [2.0]], [[1, 2, 3]] * 2), ("`q`", "numbers", "rows of equal length")),
        (([["zero"]], [[1, 2, 3]]), ("`q`", "numbers")),
        (([[0.0, 1.0]], [[1, 2, 3]], ["a"]), ("`joint_names`", "expected 2", "got 1")),
        (([[0.0, 1.0]], [[1, 2, 3]], ["a", "a"]), ("`joint_names`", "distinct")),
        (([[0.0]], [[1, 2, 3]], None, ["a", "b"]), ("`marker_names`", "expected 1", "got 2")),
    ],
)
def test_wrong_input_is_one_clear_error(arguments: tuple[Any, ...], message: tuple[str, ...]) -> None:
    with pytest.raises(MeasurementError, match=says(*message)):
        Measurements(*arguments)


def test_exact_duplicates_are_reported_not_dropped() -> None:
    q, points = [[0.0], [1.0], [-0.0], [1.0]], [[1, 2, 3], [4, 5, 6], [1, 2, 3], [4, 5, 7]]
    with pytest.warns(DiffeoCalibWarning, match=says("1 of 4 rows", "row 2, of row 0")) as record:
        data = Measurements(q, points)
    assert len(data) == 4
    assert record[0].filename == __file__  # the warning points at the user's line
    assert len(data[[0, 2]]) == 2  # a subset does not warn again


def test_values_like_degrees_are_doubted() -> None:
    with pytest.warns(DiffeoCalibWarning, match=says("column 1 ('b')", "90", "degrees")) as record:
        Measurements([[0.0, 90.0]], [[1, 2, 3]], ["a", "b"])
    assert record[0].filename == __file__
    Measurements([[0.0, -4 * math.pi]], [[1, 2, 3]])  # two whole turns are no reason for doubt


def test_rows() -> None:
    data = some(5)
    for index, expected in [
        (2, [2]),
        (-1, [4]),
        (slice(1, 4, 2), [1, 3]),
        ([3, 0, 3], [3, 0, 3]),
        (np.array([True, False, False, False, True]), [0, 4]),
        (torch.tensor([1, 2]), [1, 2]),
    ]:
        part = data[index]
        assert_close(part.q, data.q[expected])
        assert_close(part.points, data.points[expected])
        assert_close(data.rows(index).q, part.q)
    assert [len(row) for row in data] == [1] * 5
    for empty in ([], slice(0, 0), [False] * 5):
        with pytest.raises(MeasurementError, match="no row"):
            data[empty]
    for outside in (5, [0, 9], [True, False]):
        with pytest.raises(IndexError):
            data[outside]


# --- repeats, splits, folds -----------------------------------------------------------------------


def test_groups_are_chains_of_close_rows_in_order_of_appearance() -> None:
    step = 0.9 * REPEAT_TOLERANCE
    q = [[2.0, 0.0], [0.0, 0.0], [step, -step], [2 * step, 0.0], [2.0, 1.1 * REPEAT_TOLERANCE]]
    data = Measurements(q, np.arange(15.0).reshape(5, 3))
    assert data.groups().tolist() == [0, 1, 1, 1, 2]
    assert data.groups(tolerance=0.5 * step).tolist() == [0, 1, 2, 3, 4]
    assert data.groups().dtype == torch.int64


@st.composite
def repeated_measurements(draw: st.DrawFn) -> Measurements:
    """Between 2 and 8 configurations, each measured 1 to 6 times with some jitter, in random order."""
    sizes = draw(st.lists(st.integers(1, 6), min_size=2, max_size=8))
    rng = np.random.default_rng(draw(st.integers(0, 2**16)))
    label = rng.permutation(np.repeat(np.arange(len(sizes)), sizes))
    q = np.stack([label * 0.5, label % 3], axis=1) + rng.uniform(-4e-4, 4e-4, (len(label), 2))
    points = np.stack([np.arange(len(label)), label, 0 * label], axis=1)  # x: the row, y: its group
    return Measurements(q, points)


def identity(data: Measurements) -> list[int]:
    return data.points[:, 0, 0].int().tolist()


def configuration(data: Measurements) -> list[int]:
    return data.points[:, 0, 1].int().tolist()


@given(repeated_measurements(), st.floats(0.05, 0.95), st.integers(0, 5))
def test_split_is_complete_disjoint_and_cuts_no_group(data: Measurements, fraction: float, seed: int) -> None:
    train, test = data.split(fraction, seed)
    assert sorted(identity(train) + identity(test)) == list(range(len(data)))
    assert identity(train) == sorted(identity(train))
    assert not set(configuration(train)) & set(configuration(test))
    assert len(train) > 0
    assert len(test) > 0
    largest = int(torch.bincount(data.groups()).max())
    assert abs(len(train) - round(fraction * len(data))) <= largest
    assert identity(data.split(fraction, seed)[0]) == identity(train)


@given(repeated_measurements(), st.integers(2, 4), st.integers(0, 5))
def test_folds_cover_every_row_once_and_cut_no_group(data: Measurements, k: int, seed: int) -> None:
    distinct = len(set(configuration(data)))
    if distinct < k:
        with pytest.raises(MeasurementError, match=says(f"{k} folds", f"got {distinct}")):
            data.folds(k, seed)
        return
    folds = data.folds(k, seed)
    assert len(folds) == k
    assert sorted(row for _, test in folds for row in identity(test)) == list(range(len(data)))
    for train, test in folds:
        assert sorted(identity(train) + identity(test)) == list(range(len(data)))
        assert not set(configuration(train)) & set(configuration(test))
    sizes = [len(test) for _, test in folds]
    assert max(sizes) - min(sizes) <= int(torch.bincount(data.groups()).max())


def test_split_without_repeats_is_exact_and_depends_on_the_seed() -> None:
    data = some(100)
    first, second = data.split(0.7, seed=0)[0], data.split(0.7, seed=1)[0]
    assert len(first) == len(second) == 70
    assert not torch.equal(first.q, second.q)
    assert [len(test) for _, test in data.folds(4)] == [25] * 4


def test_split_refuses_what_cannot_be_split() -> None:
    repeated = Measurements(np.full((3, 2), 0.5), np.arange(9.0).reshape(3, 3))
    for data in (repeated, some(1)):
        with pytest.raises(MeasurementError, match=says("cannot split", "2 distinct configurations", "got 1")):
            data.split()
    for fraction in (0.0, 1.0, 70, math.nan):
        with pytest.raises(MeasurementError, match=says("`fraction`", "between 0 and 1")):
            some(10).split(fraction)
    with pytest.raises(MeasurementError, match=says("`k`", "at least 2")):
        some(10).folds(1)


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


# --- writing --------------------------------------------------------------------------------------

numbers = st.floats(-6.0, 6.0, allow_nan=False, allow_subnormal=False)


@settings(suppress_health_check=[HealthCheck.too_slow], deadline=None, max_examples=50)
@given(st.data(), st.integers(1, 4), st.integers(1, 3), st.integers(1, 5))
@pytest.mark.filterwarnings("ignore::diffeo_calib.errors.DiffeoCalibWarning")  # random values may look like anything
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
