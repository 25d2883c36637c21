"""Tables are read in blocks, and judged as a whole."""

from __future__ import annotations

import os
import re
import threading
from pathlib import Path

import pytest
from table_bank import HEADER, JOINTS, says
from torch.testing import assert_close

from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.csv import tables as csv_tables
from diffeo_calib.measurements.csv.files import read_joints
from diffeo_calib.measurements.table_format import TableFormat

SI = TableFormat("m", "rad")
ROWS = 25


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_tables, "ROWS_AT_ONCE", 4)


def lines(count: int = ROWS) -> list[str]:
    return [f"{0.1 * k!r},-0.5,{k},2,3" for k in range(count)]


def written(folder: Path, rows: list[str], header: str = HEADER) -> Path:
    (folder / "table.csv").write_text(header + "\n".join(rows) + "\n")
    return folder / "table.csv"


def test_blocks_are_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, [*lines()[:7], "", *lines()[7:]], "\ufeff" + HEADER)
    blocks = read_joints(path, JOINTS, SI)
    monkeypatch.setattr(csv_tables, "ROWS_AT_ONCE", 1000)
    assert_close(read_joints(path, JOINTS, SI), blocks, rtol=0, atol=0)
    assert len(blocks) == ROWS


def changed(place: int, text: str) -> list[str]:
    rows = lines()
    rows[place] = text
    return rows


MISTAKES = {
    "ragged": [*changed(3, "1"), "1,2", *lines(9), "1"],
    "word": [*changed(14, "0,0,far,2,3"), "0,near,1,2,3", "0,0,,2,3"],
    "missing": [*changed(2, "0,0,,2,3"), "0,nan,inf,2,3"],
    "comma": changed(24, "0,0,'1;5',2,3"),
    "no rows": [],
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_those_of_the_whole_table(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A mistake of a kind is found in the first block that has one."""
    path, joints = written(tmp_path, MISTAKES[name]), [*JOINTS, "x", "y"]
    with pytest.raises(MeasurementError) as blocks:
        read_joints(path, joints, SI)
    monkeypatch.setattr(csv_tables, "ROWS_AT_ONCE", 1000)
    with pytest.raises(MeasurementError) as whole:
        read_joints(path, joints, SI)
    assert re.findall(r"line \d+|rows", str(blocks.value))[:1] == re.findall(r"line \d+|rows", str(whole.value))[:1]


def test_units_are_judged_by_all_rows(tmp_path: Path) -> None:
    path = written(tmp_path, [*lines(), "90,0,1,2,3", *lines()])
    with pytest.warns(DiffeoCalibWarning, match="90 rad"):
        read_joints(path, JOINTS, SI)


def test_a_cell_with_a_line_break_does_not_shift_the_columns(tmp_path: Path) -> None:
    path = written(tmp_path, ['"0\n1",0,1,2,3', *lines()])
    with pytest.raises(MeasurementError, match=says("line 2, column 'q1'", "a number")):
        read_joints(path, JOINTS, SI)


def test_a_pipe_is_read_once(tmp_path: Path) -> None:
    path, pipe = written(tmp_path, lines()), tmp_path / "pipe"
    os.mkfifo(pipe)
    feeder = threading.Thread(target=lambda: pipe.write_bytes(path.read_bytes()))
    feeder.start()
    q = read_joints(pipe, JOINTS, SI)
    feeder.join()
    assert_close(q, read_joints(path, JOINTS, SI), rtol=0, atol=0)


def test_a_pipe_that_is_no_text(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    feeder = threading.Thread(target=lambda: pipe.write_bytes(b"PK\x03\x04\xff\xfe"))
    feeder.start()
    with pytest.raises(MeasurementError, match=says("no text", "export the table as CSV")):
        read_joints(pipe, JOINTS, SI)
    feeder.join()


def test_a_device_without_an_end_is_refused() -> None:
    with pytest.raises(MeasurementError, match="'/dev/zero' is no text but binary"):
        read_joints("/dev/zero", JOINTS, SI)
