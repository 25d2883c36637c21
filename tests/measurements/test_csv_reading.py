"""Tables as devices, spreadsheets and programs write them: what is unmistakable is read and said."""

import math
import os
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from table_bank import HEADER, JOINTS, POSITION, ROWS, Reader, held, in_order
from torch.testing import assert_close

from diffeo_calib.cli.guesses import guess_sheet
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.csv.files import read_joints, read_measurements, read_observations
from diffeo_calib.measurements.table_format import TableFormat

quietly = pytest.mark.filterwarnings("ignore::diffeo_calib.common.errors.DiffeoCalibWarning")
NAMES = [*JOINTS, *POSITION]
CELLS = [[f"{0.1 * k:.3f}", f"{-0.2 * k:.4f}", f"{1000.5 + k:.2f}", f"{k - 3.25}", f"{2.0 + k % 3}"] for k in range(8)]
EXPECTED = [[float(cell) for cell in row] for row in CELLS]
FORMAT: dict[str, Any] = {"length": "mm", "angle": "rad"}


def separated(mark: str, rows: list[list[str]]) -> str:
    return "".join(mark.join(row) + "\n" for row in rows)


PLAIN = separated(",", [NAMES, *CELLS])
BARE = PLAIN.partition("\n")[2]
GERMAN = [[cell.replace(".", ",") for cell in row] for row in CELLS]
GROUPED = [[*row[:2], f"{1000.5 + k:,.2f}", *row[3:]] for k, row in enumerate(CELLS)]
SWISS = [[cell.replace(",", "\u2019") for cell in row] for row in GROUPED]
SPACED = [[*own[:2], row[2].translate({44: 8239, 46: 44}), *own[3:]] for own, row in zip(GERMAN, GROUPED, strict=True)]
MIXED = [[*own[:2], row[2], *own[3:]] for own, row in zip(CELLS, GERMAN, strict=True)]
ALIGNED = "".join("".join(f"{cell:>12}" for cell in row) + "\n" for row in [NAMES, *CELLS])


def _lists(each: str, mark: str) -> str:
    rows = ([str(k), each.format(mark.join(row[:2])), each.format(mark.join(row[2:]))] for k, row in enumerate(CELLS))
    return "n,q,seen_pos\n" + "".join(f'{number},"{q}","{place}"\n' for number, q, place in rows)


LISTED = ["q_1", "q_2", "seen_pos_x", "seen_pos_y", "seen_pos_z"]
SEMICOLONS, COMMAS = {"sep": ";"}, {"sep": ";", "decimal": ","}
READ: dict[str, tuple[str | bytes, dict[str, Any], str]] = {
    "byte order mark": ("\ufeff" + PLAIN.replace("\n", "\r\n"), {}, ""),
    "UTF-16": (PLAIN.encode("utf-16"), {}, ""),
    "Windows": (("Kraft, größe\n" + PLAIN).encode("cp1252"), {}, "line 1 before the header skipped"),
    "Windows' letters": (PLAIN.replace("q1", "größe").encode("cp1252"), {"names": ["größe", *NAMES[1:]]}, "in cp1252"),
    "Windows' marks": (PLAIN.replace("q1", "Tom’s").encode("cp1252"), {"names": ["Tom’s", *NAMES[1:]]}, "in cp1252"),
    "Chinese": (PLAIN.replace("q1", "关节").encode("gb18030"), {"names": ["关节", *NAMES[1:]]}, "in gb18030"),
    "Japanese": (PLAIN.replace("q1", "測定").encode("cp932"), {"names": ["測定", *NAMES[1:]]}, "in cp932"),
    "a number sign before the names": ("# " + PLAIN, {}, ""),
    "as numpy.savetxt writes": ("# " + separated(" ", [NAMES, *CELLS]), {"sep": " "}, ""),
    "aligned columns": (ALIGNED, {"sep": " "}, ""),
    "comments": ("# cell 4\n// by hand, today\n" + PLAIN, {}, "line 1, 2 before the header skipped"),
    "a commented header above the header": ("# q1,q2,x,y,z\n" + PLAIN, {}, "line 1 before the header skipped"),
    "a preamble": ("Trial,17\nOperator,A. B.,100,Hz\n\n100\n" + PLAIN, {}, "line 1, 2, 4 before the header skipped"),
    "units": (PLAIN.replace("z\n", "z\nrad,(rad),[mm],mm,mm\n"), {}, "line 2 holds units"),
    "comments between rows": (
        PLAIN.replace("0.200,", "# moved the tripod\n0.200,") + "#9,9,9,9,9\n",
        {},
        "2 line(s) with comments, names, statistics or nothing skipped (line 4, 11)",
    ),
    "lines of separators": (PLAIN + ",,,,\n" * 3, {}, "3 line(s) with comments, names, statistics or nothing skipped"),
    "statistics below": (
        separated(",", [["pose", *NAMES], *([f"p{k}", *row] for k, row in enumerate(CELLS)), ["Mean:", *CELLS[0]]])
        + "Std. dev.,0,0,0,0,0\n",
        {},
        "statistics or nothing skipped (line 10, 11)",
    ),
    "lists in cells": (_lists("[{}]", ", "), {"names": LISTED}, ""),
    "arrays of ROS in cells": (_lists("array('d', [{}])", ", "), {"names": LISTED}, ""),
    "lists of NumPy, with spaces": (_lists("[{} ]", "  "), {"names": LISTED}, ""),
    "trailing separators": (PLAIN.replace("\n", ",\n"), {}, ""),
    "decimal commas": (separated(";", [NAMES, *GERMAN]), COMMAS, ""),
    "thousands": (separated(";", [NAMES, *GROUPED]), SEMICOLONS, ""),
    "thousands in quotes": (PLAIN.replace("1000.50", '"1,000.50"'), {}, ""),
    "Swiss thousands": (separated("\t", [NAMES, *SWISS]), {"sep": "\t"}, ""),
    "thousands and decimal commas": (separated(";", [NAMES, *SPACED]), COMMAS, ""),
    "decimal commas in one column": (separated(";", [NAMES, *MIXED]), SEMICOLONS, ""),
    "minus signs": (PLAIN.replace("-", "\u2212"), {}, ""),
    "spaces that do not break": (PLAIN.replace(",", "\u00a0,\u00a0"), {}, ""),
    "columns that spaces align": (separated("   ", [NAMES, *CELLS]), {"sep": " "}, ""),
    "a column without a name": (separated(",", [["", *NAMES], *(["7", *row] for row in CELLS)]), {}, ""),
    "labels that begin as comments do": (separated(",", [["pose", *NAMES], *(["#7", *row] for row in CELLS)]), {}, ""),
    "names again between the rows": (PLAIN + PLAIN, {"duplicates": "drop"}, "or nothing skipped (line 10)"),
    "another name twice": (separated(",", [[*NAMES, "t", "t"], *([*row, "1", "2"] for row in CELLS)]), {}, ""),
    "columns that are counted": ("0,1,2,3,4\n" + BARE, {"names": "01234"}, ""),
    "no names": (BARE, {"names": "12345"}, "no header line: columns are named by their places, 1 to 5"),
}


@quietly
@pytest.mark.parametrize("name", READ)
def test_what_is_unmistakable_is_read_and_proposed(name: str, read: Reader, tmp_path: Path) -> None:
    """With the separator and the decimal mark that `init` finds, which sees the same columns."""
    content, how, note = READ[name]
    names = [*how.get("names", NAMES)]
    with pytest.warns(DiffeoCalibWarning) if note else pytest.MonkeyPatch.context() as said:
        given = {name: own for name, own in how.items() if name != "names"}
        data = read(content, names[:2], names[2:], **FORMAT | given)
    assert_close(torch.cat([data.q, 1e3 * data.points[:, 0]], 1).tolist(), EXPECTED, rtol=1e-12, atol=1e-12)
    if note:
        assert note in str(said[0].message)  # pyright: ignore[reportIndexIssue]
    sheet = guess_sheet(tmp_path / "table.csv")
    assert (sheet.sep, sheet.decimal) == (how.get("sep", ","), how.get("decimal", "."))
    assert {*names} <= {*sheet.numbers} or "counted" in name


MARKERS = {
    "names above the first of three": ",,M1,,,M 2,,\nq1,q2,X,Y,Z,X,Y,Z\n,,mm,mm,mm,mm,mm,mm\n",
    "names above each": ",,M,M,M,M,M,M\n,,M1,M1,M1,M 2,M 2,M 2\n,,a0,a0,a0,b1,b1,b1\nq1,q2,X,Y,Z,X,Y,Z\n",
}


@pytest.mark.parametrize("name", MARKERS)
def test_two_lines_of_names_are_joined(name: str, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("Trajectories\n100\n" + MARKERS[name] + separated(",", [[*row, *row[2:]] for row in CELLS]))
    triples = [[f"{marker}_{axis}" for axis in "XYZ"] for marker in ("M1", "M 2")]
    with pytest.warns(DiffeoCalibWarning, match="line 1, 2"):
        data = read_measurements(path, JOINTS, triples, **FORMAT)
    assert_close(data.points[:, 0], data.points[:, 1], rtol=0, atol=0)
    assert {name for triple in triples for name in triple} <= {*guess_sheet(path).numbers}


def test_marks_of_rows_are_labels_where_all_have_them(read: Reader) -> None:
    assert len(read(separated(",", [["id", *NAMES], ["#1", *CELLS[0]]]), **FORMAT)) == 1
    disabled = [NAMES, *([f"#{row[0]}", *row[1:]] for row in CELLS[:6]), *CELLS[6:]]
    with pytest.warns(DiffeoCalibWarning, match="6 line"):
        assert len(read(separated(",", disabled), **FORMAT)) == 2
    assert len(read(separated(",", [["id", *NAMES], ["P1", *CELLS[0]], ["max", *CELLS[1]]]), **FORMAT)) == 2
    named = ["mean", "A", "Mittelpunkt", "mean"]
    rows = [[name, *row] for name, row in zip(named, CELLS, strict=False)]
    assert len(read(separated(",", [["id", *NAMES], *rows]), **FORMAT)) == 4
    damaged = [NAMES, *CELLS[:2], ["#VALUE!", *CELLS[2][1:]], *CELLS[3:]]
    with pytest.raises(MeasurementError, match="line 4, column 'q1': expected a number, got '#VALUE!'"):
        read(separated(",", damaged), **FORMAT)


def test_joints_have_names_of_their_own(tmp_path: Path) -> None:
    """And units: tests/measurements/test_csv_writing.py."""
    robot = SimpleNamespace(joint_names=("slide", "turn"), kinds=("prismatic", "revolute"))
    how: dict[str, Any] = {"length": "mm", "angle": "deg"}
    (tmp_path / "table.csv").write_text(HEADER + "250,90,1000,0,500\n")
    data = read_measurements(tmp_path / "table.csv", robot, POSITION, joints=JOINTS, **how)  # pyright: ignore
    assert data.joint_names == robot.joint_names
    assert_close(data.q, torch.tensor([[0.25, math.pi / 2]], dtype=torch.float64))
    with pytest.raises(MeasurementError, match="`joints`"):
        read_measurements(tmp_path / "table.csv", robot, POSITION, joints=JOINTS[:1], **how)  # pyright: ignore


SLIDE: dict[str, Any] = {"kinds": ["prismatic", "revolute"], "angle": "deg"}
POSED: dict[str, Any] = {"rotation": ["a", "b", "c"], "convention": "XYZ", "rotation_angle": "deg"}
UNKNOWN = "look like degrees; pass angle='deg' if they are, or pass the robot, which knows"
ODD: list[tuple[str, dict[str, Any], str]] = [
    ("0,90,1,2,3", {}, "90 rad: they " + UNKNOWN),
    ("0,90,1,2,3", {"kinds": ["revolute"] * 2}, "90 rad: they look like degrees; pass angle='deg'"),
    ("0,1.5,1,2,3", {"angle": "deg"}, "1.5 deg: they look like radians; pass angle='rad'"),
    ("0,1.5,1000,2,3", {}, "1000 m: they look like millimetres; pass length='mm'"),
    ("0,1.5,1,2,3", {"length": "mm"}, "3 mm: they look like metres; pass length='m'"),
    ("0.25,90,1000,0,500", SLIDE | {"length": "mm"}, "joints reach only 0.25 mm: they look like metres; pass joint"),
    ("250,90,1,0,0.5", SLIDE | {"length": "m"}, "250 m: they look like millimetres; pass joint_length='mm'"),
    ("0,1,1,2,3,10,20,30,1", POSED | {"rotation_angle": "rad"}, "30 rad: they look like degrees; pass rotation_"),
    ("0,1,1,2,3,1,-2,3,1", POSED, "rotations reach only 3 deg: they look like radians; pass rotation_angle='rad'"),
    ("0,1,1,2,3,0,4,0,1", POSED | {"convention": "rotvec"}, "only 4 deg: they look like radians"),
]


@pytest.mark.parametrize(("row", "how", "message"), ODD)
def test_unlikely_units_cause_a_warning(row: str, how: dict[str, Any], message: str, read: Reader) -> None:
    header = HEADER.rstrip() + ",a,b,c,d\n" if "rotation" in how else HEADER
    with pytest.warns(DiffeoCalibWarning, match=in_order("table.csv' ... " + message)) as record:
        read(header + row, **how)
    assert len(record) == 1
    assert Path(record[0].filename).name == "conftest.py"  # where `read` calls the package


def test_likely_units_and_angles_in_minutes(read: Reader) -> None:
    read(HEADER + "90,0.1,1000,0,500\n", kinds=["prismatic", "revolute"], length="mm")
    header, row = HEADER.rstrip() + ",a,b,c,d\n", "0,1,1,2,3,0,{},0,1"
    read(header + row.format(0), **POSED)
    read(header + row.format(6.2832), **POSED | {"rotation_angle": "rad"})
    read(header + row.format(0), rotation=["a", "b", "c", "d"], convention="quat_xyzw")  # quaternions have no unit
    text = "q1;q2;sd;hz;v\n0;0;2;270°;90°\n0;1;2;0°0'0\";0\n1;1;2;45° 30' 36,0\";120°\n"
    how: dict[str, Any] = {"sep": ";", "decimal": ",", "spherical": "zenith_clockwise_deg"}
    data = read(text, JOINTS, ["sd", "hz", "v"], length="m", angle="rad", **how)
    turn, up = math.radians(-45.51), math.radians(-30.0)
    last = [2 * math.cos(up) * math.cos(turn), 2 * math.cos(up) * math.sin(turn), 2 * math.sin(up)]
    assert_close(data.points[:, 0].tolist(), [[0.0, 2.0, 0.0], [0.0, 0.0, 2.0], last], rtol=1e-14, atol=1e-14)
    assert "--position zenith_clockwise_deg=sd,hz,v" in data.origin.options
    assert "--spherical" not in data.origin.options


def test_joints_alone_and_records(tmp_path: Path) -> None:
    path = tmp_path / "path.csv"
    path.write_text("slide;time;turn\n250,5;noon;90\n-100;;-45\n")
    robot: Any = SimpleNamespace(joint_names=("turn", "slide"), kinds=("revolute", "prismatic"))
    expected = torch.tensor([[math.pi / 2, 0.2505], [-math.pi / 4, -0.1]], dtype=torch.float64)
    assert_close(read_joints(path, TableFormat("mm", "deg", ";", ",", joints=robot)), expected, rtol=1e-15, atol=0)
    with pytest.warns(DiffeoCalibWarning, match=r"prismatic joints reach 250.5 m: they look like millimetres"):
        metres = read_joints(path, TableFormat("m", "deg", ";", ",", joints=["slide"], kinds=["prismatic"]))
    assert_close(metres, torch.tensor([[250.5], [-100.0]], dtype=torch.float64), rtol=0, atol=0)
    for name in ("t.json", "t.ls"):
        (tmp_path / name).write_text('{"joints": [0.1')
        with pytest.raises(MeasurementError, match=rf"{name}' is no table: expected CSV, .*, got .{name[2:]}; write"):
            read_joints(tmp_path / name, TableFormat("m", "rad", joints=JOINTS))


@pytest.mark.parametrize("content", [(HEADER + ROWS + ROWS).encode(), b"PK\x03\x04\xff\xfe"])
def test_a_pipe_is_read_once(content: bytes, tmp_path: Path) -> None:
    pipe, table = tmp_path / "pipe", TableFormat("m", "rad", joints=JOINTS)
    os.mkfifo(pipe)
    feeder = threading.Thread(target=lambda: pipe.write_bytes(content))
    feeder.start()
    if content.startswith(b"PK"):
        with pytest.raises(MeasurementError, match=r"no text.*save it as .xlsx or CSV"):
            read_joints(pipe, table)
    else:
        assert read_joints(pipe, table).tolist() == 2 * [[0.1, 0.2], [0.3, 0.4]]
    feeder.join()
    with pytest.raises(MeasurementError, match="'/dev/zero' is no text but binary"):
        read_joints("/dev/zero", table)


TWO = [("ax", "ay", "az"), ("bx", "by", "bz")]
PAIR = "q1,q2,ax,ay,az,bx,by,bz\n"
SEEN = [[True, True], [True, False], [False, True]]
HIDDEN = PAIR + "0.1,0.2,1,2,3,4,5,6\n0.3,0.4,1.5,2.5,3.5,{0},{0},{0}\n0.5,0.6,{1},{1},{1},4.5,5.5,6.5\n"
LOST = ["inf", "1e13", "-3.697314E+28", "-", "----", "hidden", "MISSING", "#N/A", "NULL", "Out of View", "-1.#IND00"]


@pytest.mark.parametrize("cell", ["", "nan", " ", *LOST])
def test_empty_cells_and_usual_marks_hide_a_marker(read: Reader, cell: str) -> None:
    with pytest.warns(DiffeoCalibWarning) if cell in LOST else pytest.MonkeyPatch.context() as said:
        data = read(HIDDEN.format(cell, "" if cell in LOST else cell), position=TWO)
    assert data.visible.tolist() == SEEN
    assert data.points[0].tolist() == [[1, 2, 3], [4, 5, 6]]
    if cell in LOST:
        assert f"'{cell}' (3)" in str(said[0].message)  # pyright: ignore[reportIndexIssue]
        assert "line 3" in str(said[0].message)  # pyright: ignore[reportIndexIssue]


def test_lines_without_joint_values_or_markers(read: Reader) -> None:
    rows = [[*NAMES, "ball"], *([*row, "a"] for row in CELLS[:2]), ["", "", "5", "6", "7", "b"], [*CELLS[2], "a"]]
    with pytest.warns(DiffeoCalibWarning, match="no joint values in line 4: 1 row"):
        assert read(separated(",", rows), **FORMAT).line_numbers.tolist() == [2, 3, 5]
    data = read(separated(",", rows), marker="ball", **FORMAT)
    assert_close(1e3 * data.points[1, 1], torch.tensor([5.0, 6.0, 7.0], dtype=torch.float64))
    assert (len(data), data.markers) == (3, 2)
    again = separated(",", [*rows[:4], ["", "", "5", "6", "7", "b"], rows[4]])
    with pytest.raises(MeasurementError, match="line 5, column 'q1'"):  # of a pose without joint values
        read(again, marker="ball", **FORMAT)
    with pytest.warns(DiffeoCalibWarning, match="no marker was seen in line 5: 1 row"):
        assert read(HIDDEN.format("", "") + "0.7,0.8,,,,,,\n", position=TWO).visible.tolist() == SEEN
    with pytest.warns(DiffeoCalibWarning, match="no marker was seen in line 3"):
        data = read(PAIR + "0.1,0.2,1,2,3,4,5,6\n0.3,0.4,,,,4,5,6\n", position=TWO[0])  # of a single marker
    assert data.line_numbers.tolist() == [2]


def lost(*rows: int, mark: str = "0") -> str:
    cells = [mark, f"{mark}.0", mark]
    return separated(",", [NAMES, *([*row[:2], *cells] if k in rows else row for k, row in enumerate(CELLS))])


@pytest.mark.parametrize(("rows", "mark"), [((3,), "0"), ((2, 5), "0"), ((2, 5), "-9999")])
def test_a_marker_at_the_origin_far_from_all_rows_was_not_seen(rows: tuple[int, ...], mark: str, read: Reader) -> None:
    at = ", ".join(str(row + 2) for row in rows)
    with pytest.warns(DiffeoCalibWarning) as said:
        data = read(lost(*rows, mark=mark), **FORMAT)
    assert [text.split(".csv': ")[1] for text in map(str, (one.message for one in said))] == [
        f"x, y, z are {mark}, {mark}, {mark} in line {at}, far from other rows: taken as not seen",
        f"no marker was seen in line {at}: {len(rows)} row(s) left out",
    ]
    assert data.line_numbers.tolist() == [k + 2 for k in range(8) if k not in rows]


def test_a_marker_near_the_origin_or_a_single_one_not_clearly_far_away_stays(read: Reader, tmp_path: Path) -> None:
    """Tables relative to the first pose begin with it; repeated rows hide no origin either."""
    near = [[*row[:2], f"{30 * (k - 3)}", f"{(k - 3) ** 2}", "0"] for k, row in enumerate(CELLS)]
    first = [[*row[:2], f"{30 * k}", f"{k**2}", "0"] for k, row in enumerate(CELLS) if k != 1]
    beside = [[*row[:2], f"{k - 9999}", f"{k * k - 9999}", "-9999"] for k, row in enumerate(CELLS)]
    beside[5][2:] = ["-9999", "-9999", "-9999"]  # as in line 2: where rows are
    for rows in (near, first, beside):
        assert len(read(separated(",", [NAMES, *rows]), **FORMAT)) == len(rows)
    assert len(read(lost(3, mark="-9999"), **FORMAT)) == 8
    (tmp_path / "table.csv").write_text(lost(3))  # rows that come one by one cannot be judged by those that come later
    table = TableFormat(**FORMAT, joints=JOINTS, position=[tuple(POSITION)])
    assert len(read_observations(tmp_path / "table.csv", table, growing=True)) == 8
    (tmp_path / "table.csv").write_text(READ["decimal commas in one column"][0])  # as later ones may have points there
    with pytest.raises(MeasurementError, match="looks like a decimal comma"):
        read_observations(tmp_path / "table.csv", replace(table, sep=";"), growing=True)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["s"], [[3, 3, 3], [3, 3, 3]]),
        ([["s"], ["t"]], [[3, 3, 3], [4, 4, 4]]),
        (["s", "t", "u", "v", "w", "k"], [[3, 4, 5], [6, 7, 8]]),
        ([["s", "t", "u"], ["v", "w", "k"]], [[3, 4, 5], [6, 7, 8]]),
    ],
)
def test_deviations_are_read(names: Any, expected: Any, read: Reader) -> None:
    """One column for all, one per marker or frame, three per frame; the second frame is hidden in the second row."""
    text = "q1,x,y,z,a,b,c,X,Y,Z,A,B,C,s,t,u,v,w,k\n0.1,1,2,3,10,20,30,4,5,6,40,50,60,3,4,5,6,7,8\n"
    flat = [name for group in names for name in group]
    own = dict(zip("stuvwk", "345678", strict=True))
    seen = [own[name] if len(flat) == 1 or name in flat[: len(flat) // 2] or name not in flat else "" for name in own]
    text += f"0.2,1,2,3,10,20,30,,,,,,,{','.join(seen)}\n"
    both: dict[str, Any] = {"joints": ["q1"], "position": [["x", "y", "z"], ["X", "Y", "Z"]]}
    turned = POSED | {"rotation": [["a", "b", "c"], ["A", "B", "C"]]}
    posed = None if len(names) == 6 else read(text, rotation_std=names, **both, **turned)
    plain = read(text, std=flat, **both)
    for data, found in ((plain, plain.std), *([(posed, held(posed.rotation_std).rad2deg())] if posed else [])):
        assert_close(held(found)[0], torch.tensor(expected, dtype=torch.float64))
        assert_close(held(found)[1, 0], torch.tensor(expected[0], dtype=torch.float64))
        assert data.points[1, -1].isnan().all()
        assert held(data.covariance).isfinite().all()
