"""Tables as devices, spreadsheets and programs write them: what is unmistakable is read and said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from table_bank import Reader, says
from torch.testing import assert_close

from diffeo_calib.cli.guesses import guess_sheet
from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.csv.files import read_measurements, read_observations
from diffeo_calib.measurements.csv.lines import read_cells
from diffeo_calib.measurements.table_format import TableFormat

NAMES = ["q1", "q2", "x", "y", "z"]
CELLS = [
    [f"{0.1 * k:.3f}", f"{-0.2 * k:.4f}", f"{1000.5 + k:.2f}", f"{k - 3.25:.3f}", f"{2 + k % 3:.1f}"] for k in range(8)
]
PLAIN = "".join(",".join(row) + "\n" for row in [NAMES, *CELLS])
ROWS = PLAIN.partition("\n")[2]
FORMAT: dict[str, Any] = {"length": "mm", "angle": "rad"}


def numbers(read: Reader, content: str | bytes, names: list[str] = NAMES, **how: str) -> list[list[float]]:
    data = read(content, names[:2], names[2:], **FORMAT | how)
    return [[*q, *(1e3 * point[0])] for q, point in zip(data.q.tolist(), data.points.numpy(), strict=True)]


@pytest.fixture
def expected() -> list[list[float]]:
    return [[float(cell) for cell in row] for row in CELLS]


def separated(mark: str, rows: list[list[str]] | None = None) -> str:
    return "".join(mark.join(row) + "\n" for row in rows or [NAMES, *CELLS])


GERMAN = [[cell.replace(".", ",") for cell in row] for row in CELLS]
GROUPED = [[*row[:2], f"{1000.5 + k:,.2f}", *row[3:]] for k, row in enumerate(CELLS)]
SWISS = [[*row[:2], f"{1000.5 + k:,.2f}".replace(",", "\u2019"), *row[3:]] for k, row in enumerate(CELLS)]
SPACED = [
    [*row[:2], f"{1000.5 + k:,.2f}".replace(",", "\u202f").replace(".", ","), *row[3:]] for k, row in enumerate(GERMAN)
]
READ = {
    "byte order mark": ("\ufeff" + PLAIN, {}, ""),
    "UTF-16": (PLAIN.encode("utf-16"), {}, "text in utf-16"),
    "Windows": (("Kraft (°), größe\n" + PLAIN).encode("cp1252"), {}, "text in cp1252, not UTF-8"),
    "Chinese": (("# 关节(度), 坐标(毫米)\n" + PLAIN).encode("gb18030"), {}, "text in gb18030, not UTF-8"),
    "Japanese": (("# 関節, X座標, 測定\n" + PLAIN).encode("cp932"), {}, "text in cp932, not UTF-8"),
    "a number sign before the names": ("# " + PLAIN, {}, ""),
    "as numpy.savetxt writes": ("# " + separated(" "), {"sep": " "}, ""),
    "aligned columns": (
        "".join("".join(f"{cell:>12}" for cell in row) + "\n" for row in [NAMES, *CELLS]),
        {"sep": " "},
        "",
    ),
    "comments": ("# cell 4\n// by hand, today\n" + PLAIN, {}, "line 1, 2 before the header skipped"),
    "a commented header above the header": ("# q1,q2,x,y,z\n" + PLAIN, {}, "line 1 before the header skipped"),
    "a preamble": (
        "Trial,17\nOperator,A. B.,Rate,100,Hz\n\n100\n" + PLAIN,
        {},
        "line 1, 2, 4 before the header skipped",
    ),
    "a preamble of a spreadsheet": ("Trial,17,,,\nSite,hall,,,\n,,,,\n" + PLAIN, {}, "line 1, 2, 3 before the header"),
    "units": (separated(",", [NAMES, ["rad", "(rad)", "[mm]", "mm", "mm"], *CELLS]), {}, "line 2 holds units"),
    "comments between rows": (
        PLAIN.replace("0.200,", "# moved the tripod\n0.200,") + "#9,9,9,9,9\n",
        {},
        "2 line(s) with comments, names or nothing skipped (line 4, 11)",
    ),
    "lines of separators": (PLAIN + ",,,,\n" * 3, {}, "3 line(s) with comments, names or nothing skipped"),
    "trailing separators": (PLAIN.replace("\n", ",\n"), {}, ""),
    "trailing separators of rows alone": (
        PLAIN.replace("\n", ";\n").replace("z;", "z").replace(",", ";"),
        {"sep": ";"},
        "",
    ),
    "decimal commas": (separated(";", [NAMES, *GERMAN]), {"sep": ";", "decimal": ","}, ""),
    "thousands": (separated(";", [NAMES, *GROUPED]), {"sep": ";"}, ""),
    "thousands in quotes": (PLAIN.replace("1000.50", '"1,000.50"'), {}, ""),
    "Swiss thousands": (separated("\t", [NAMES, *SWISS]), {"sep": "\t"}, ""),
    "thousands and decimal commas": (separated(";", [NAMES, *SPACED]), {"sep": ";", "decimal": ","}, ""),
    "minus signs": (PLAIN.replace("-", "\u2212"), {}, ""),
    "spaces that do not break": (PLAIN.replace(",", "\u00a0,\u00a0"), {}, ""),
    "columns that spaces align": (separated("   ", [NAMES, *CELLS]), {"sep": " "}, ""),
    "a column without a name": (
        separated(",", [["", *NAMES], *([str(k), *row] for k, row in enumerate(CELLS))]),
        {},
        "",
    ),
    "labels that begin as comments do": (
        separated(",", [["pose", *NAMES], *([f"#{k}", *row] for k, row in enumerate(CELLS))]),
        {},
        "",
    ),
    "names again between the rows": (
        PLAIN + PLAIN,
        {"duplicates": "drop"},
        "with comments, names or nothing skipped (line 10)",
    ),
    "another name twice": (separated(",", [[*NAMES, "t", "t"], *([*row, "1", "2"] for row in CELLS)]), {}, ""),
}


@pytest.mark.filterwarnings("ignore::diffeo_calib.common.errors.DiffeoCalibWarning")
@pytest.mark.parametrize("name", READ)
def test_what_is_unmistakable_is_read_and_proposed(
    name: str, read: Reader, tmp_path: Path, expected: list[list[float]]
) -> None:
    """With the separator and the decimal mark that `init` finds, which sees the same columns."""
    content, how, note = READ[name]
    with pytest.warns(DiffeoCalibWarning) if note else pytest.MonkeyPatch.context() as said:
        assert_close(numbers(read, content, **how), expected, rtol=1e-12, atol=1e-12)
    if note:
        assert note in str(said[0].message)  # pyright: ignore[reportIndexIssue]
    sheet = guess_sheet(tmp_path / "table.csv")
    assert (sheet.sep, sheet.decimal) == (how.get("sep", ","), how.get("decimal", "."))
    assert {*NAMES} <= {*sheet.numbers}


@pytest.mark.parametrize("name", ["plain", "comments", "trailing separators"])
def test_columns_without_names_are_named_by_their_places(name: str, read: Reader, expected: list[list[float]]) -> None:
    content = {"plain": ROWS, "comments": "# by hand\n" + ROWS, "trailing separators": ROWS.replace("\n", ",\n")}[name]
    with pytest.warns(DiffeoCalibWarning, match="no header line: columns are named by their places, 1 to 5"):
        assert_close(numbers(read, content, ["1", "2", "3", "4", "5"]), expected, rtol=1e-12, atol=1e-12)
    with pytest.raises(MeasurementError, match=says("no column ['q1'", "no header line", "'1', '2', '3'")):
        numbers(read, content, NAMES)


def test_a_column_that_numbers_the_rows_is_no_joint(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("".join(f"{k},{line}\n" for k, line in enumerate(ROWS.splitlines())))
    assert guess_sheet(tmp_path / "t.csv").numbers == ("2", "3", "4", "5", "6")


MARKERS = {
    "names above the first of three": ",,M1,,,M 2,,\nq1,q2,X,Y,Z,X,Y,Z\n,,mm,mm,mm,mm,mm,mm\n",
    "names above each": (
        ",,Marker,Marker,Marker,Marker,Marker,Marker\n,,M1,M1,M1,M 2,M 2,M 2\n,,a0,a0,a0,b1,b1,b1\nq1,q2,X,Y,Z,X,Y,Z\n"
    ),
}


@pytest.mark.parametrize("name", MARKERS)
def test_two_lines_of_names_are_joined(name: str, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("Trajectories\n100\n" + MARKERS[name] + "".join(",".join([*row, *row[2:]]) + "\n" for row in CELLS))
    triples = [[f"{marker}_{axis}" for axis in "XYZ"] for marker in ("M1", "M 2")]
    with pytest.warns(DiffeoCalibWarning, match="line 1, 2"):
        data = read_measurements(path, NAMES[:2], triples, **FORMAT)
    assert_close(data.points[:, 0], data.points[:, 1], rtol=0, atol=0)
    assert {name for triple in triples for name in triple} <= {*guess_sheet(path).numbers}


@pytest.mark.filterwarnings("ignore::diffeo_calib.common.errors.DiffeoCalibWarning")
@pytest.mark.parametrize(
    ("content", "how", "parts"),
    [
        (PLAIN.replace("x,y", "x (cm),y"), {"names": ["q1", "q2", "x (cm)", "y", "z"]}, ["'x (cm)'", "cm", "convert"]),
        (PLAIN.replace("q1", "q1 [°]"), {"names": ["q1 [°]", *NAMES[1:]]}, ["'q1 [°]'", "expected rad", "got deg"]),
        (
            separated(",", [NAMES, ["rad"] * 2 + ["m"] * 3, *CELLS]),
            {},
            ["'x'", "expected mm", "got m", "state the unit"],
        ),
        (PLAIN.replace("y,z", "x,z"), {"names": ["q1", "q2", "x", "x", "z"]}, ["'x'"]),
        (PLAIN.replace("q1,q2,x,y,z", "q1,q2,x,x,z,"), {"names": [*NAMES[:3], "z", "q3"]}, ["no column ['q3']"]),
        (
            PLAIN.replace(",", ";").replace("1000.50", "1,000"),
            {"sep": ";"},
            ["line 2", "'x'", "thousands", "decimal=','"],
        ),
        (b"\0\1" + PLAIN.encode(), {}, ["no text but binary"]),
    ],
)
def test_what_is_mistakable_is_an_error(
    content: str | bytes, how: dict[str, Any], parts: list[str], read: Reader
) -> None:
    with pytest.raises(MeasurementError, match=says(*parts)):
        numbers(read, content, **how)


@pytest.mark.parametrize(
    "content", [b"PK\x03\x04\0\0", PLAIN.replace("0.200,", "0.200,,").encode(), PLAIN.encode() + b'9,"']
)
def test_the_reason_of_the_reader_is_that_of_the_proposal(content: bytes, read: Reader, tmp_path: Path) -> None:
    with pytest.raises(MeasurementError) as reading:
        numbers(read, content)
    with pytest.raises(MeasurementError) as proposing:
        guess_sheet(tmp_path / "table.csv")
    assert str(proposing.value) == str(reading.value)


def lost(*rows: int, cells: str = "0,0.000,0") -> str:
    return separated(
        ",", [NAMES, *([*row[:2], *cells.split(",")] if k in rows else row for k, row in enumerate(CELLS))]
    )


@pytest.mark.parametrize(("rows", "mark"), [((3,), "0"), ((2, 5), "0"), ((2, 5), "-9999")])
def test_a_marker_at_the_origin_far_from_all_rows_was_not_seen(rows: tuple[int, ...], mark: str, read: Reader) -> None:
    at = ", ".join(str(row + 2) for row in rows)
    with pytest.warns(DiffeoCalibWarning) as said:
        data = read(lost(*rows, cells=f"{mark},{mark}.0,{mark}"), NAMES[:2], NAMES[2:], **FORMAT)
    assert [text.split(".csv': ")[1] for text in map(str, (one.message for one in said))] == [
        f"x, y, z are {mark}, {mark}, {mark} in line {at}, far from other rows: taken as not seen",
        f"no marker was seen in line {at}: {len(rows)} row(s) left out",
    ]
    assert data.line_numbers.tolist() == [k + 2 for k in range(8) if k not in rows]


def test_a_marker_near_the_origin_or_a_single_one_not_clearly_far_away_stays(read: Reader) -> None:
    """Tables relative to the first pose begin with it; repeated rows hide no origin either."""
    near = [[*row[:2], f"{30 * (k - 3)}", f"{(k - 3) ** 2}", "0"] for k, row in enumerate(CELLS)]
    assert len(read(separated(",", [NAMES, *near]), NAMES[:2], NAMES[2:], **FORMAT)) == 8
    first = [[*row[:2], f"{30 * k}", f"{k**2}", "0"] for k, row in enumerate(CELLS) if k != 1]
    assert len(read(separated(",", [NAMES, *first]), NAMES[:2], NAMES[2:], **FORMAT)) == 7
    assert len(read(lost(3, cells="-9999,-9999,-9999"), NAMES[:2], NAMES[2:], **FORMAT)) == 8
    beside = [[*row[:2], f"{k - 9999}", f"{k * k - 9999}", "-9999"] for k, row in enumerate(CELLS)]
    beside[5][2:] = ["-9999", "-9999", "-9999"]  # as in line 2: where rows are
    assert len(read(separated(",", [NAMES, *beside]), NAMES[:2], NAMES[2:], **FORMAT)) == 8


def test_marks_of_rows_are_labels_where_all_have_them(read: Reader) -> None:
    labelled = [["id", *NAMES], ["#1", *CELLS[0]]]
    assert len(read(separated(",", labelled), NAMES[:2], NAMES[2:], **FORMAT)) == 1
    disabled = [NAMES, *([f"#{row[0]}", *row[1:]] for row in CELLS[:6]), *CELLS[6:]]
    with pytest.warns(DiffeoCalibWarning, match="6 line"):
        assert len(read(separated(",", disabled), NAMES[:2], NAMES[2:], **FORMAT)) == 2
    damaged = [NAMES, *CELLS[:2], ["#VALUE!", *CELLS[2][1:]], *CELLS[3:]]
    with pytest.raises(MeasurementError, match="line 4, column 'q1': expected a number, got '#VALUE!'"):
        read(separated(",", damaged), NAMES[:2], NAMES[2:], **FORMAT)


def test_rows_that_count_the_columns_and_empty_headers(
    read: Reader, tmp_path: Path, expected: list[list[float]]
) -> None:
    assert_close(numbers(read, "0,1,2,3,4\n" + ROWS, [*"01234"]), expected, rtol=1e-12, atol=1e-12)
    (tmp_path / "rows.csv").write_text("3,2,1\n1,2,3\n")
    assert read_cells(tmp_path / "rows.csv", ",") == ([*"123"], [(1, [*"321"]), (2, [*"123"])])
    with pytest.raises(MeasurementError, match="is empty"):
        read(",,\n,,\n", ["q"], ["x", "y", "z"], **FORMAT)
    with pytest.raises(MeasurementError, match="no column"):
        read(",,\n1,2,3\n", ["q"], ["x", "y", "z"], **FORMAT)


def test_a_growing_table_keeps_every_row(tmp_path: Path) -> None:
    """Rows that come one by one cannot be judged by those that come later."""
    (tmp_path / "table.csv").write_text(lost(3))
    table = TableFormat(**FORMAT, joints=NAMES[:2], position=[tuple(NAMES[2:])])
    assert len(read_observations(tmp_path / "table.csv", table, growing=True)) == 8


def test_a_cell_that_hides_a_column_from_the_proposal_is_named(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text(separated(";", [NAMES, *CELLS]).replace("1002.50", "1002,50"))
    sheet = guess_sheet(tmp_path / "table.csv")
    assert "x" not in sheet.numbers
    assert "line 4, column 'x': expected a number, got '1002,50'; looks like a decimal comma" in sheet.odd
