"""Tables that are read in blocks: the same rows, errors and warnings as when they are read at once."""

from __future__ import annotations

import os
import threading
import tracemalloc
from pathlib import Path

import pytest
import torch
from table_bank import HEADER, JOINTS, says
from torch.testing import assert_close

from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.csv import tables as csv_tables
from diffeo_calib.measurements.csv.files import open_joints, read_joints
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


def test_blocks_are_the_table(tmp_path: Path) -> None:
    path = written(tmp_path, [*lines()[:7], "", *lines()[7:]], "\ufeff" + HEADER)
    whole = read_joints(path, JOINTS, SI)
    seen: list[float] = []
    with open_joints(path, JOINTS, SI) as file:
        file.check(progress=seen.append)
        for _ in range(2):  # as often as needed
            blocks = [q for q, _ in file.laden_joints()]
            assert_close(torch.cat(blocks), whole, rtol=0, atol=0)
    assert [len(block) for block in blocks] == [4] * 6 + [1]
    assert file.rows == ROWS
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


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
def test_mistakes_are_those_of_the_whole_table(name: str, tmp_path: Path) -> None:
    """With the same counts and lines, before the first row is used."""
    path, joints = written(tmp_path, MISTAKES[name]), [*JOINTS, "x", "y"]
    with pytest.raises(MeasurementError) as whole:
        read_joints(path, joints, SI)
    with open_joints(path, joints, SI) as file, pytest.raises(MeasurementError) as blocks:
        file.check()
    assert str(blocks.value) == str(whole.value)


def test_units_are_judged_by_all_rows(tmp_path: Path) -> None:
    path = written(tmp_path, [*lines(), "90,0,1,2,3", *lines()])
    with pytest.warns(DiffeoCalibWarning, match="90 rad") as whole:
        read_joints(path, JOINTS, SI)
    with pytest.warns(DiffeoCalibWarning, match="90 rad") as blocks, open_joints(path, JOINTS, SI) as file:
        file.check()
    assert [str(warning.message) for warning in blocks] == [str(warning.message) for warning in whole]


def test_a_cell_with_a_line_break_does_not_shift_the_columns(tmp_path: Path) -> None:
    path = written(tmp_path, ['"0\n1",0,1,2,3', *lines()])
    with pytest.raises(MeasurementError, match=says("line 2, column 'q1'", "a number")):
        read_joints(path, JOINTS, SI)


def test_a_pipe_is_read_twice(tmp_path: Path) -> None:
    path, pipe = written(tmp_path, lines()), tmp_path / "pipe"
    os.mkfifo(pipe)
    feeder = threading.Thread(target=lambda: pipe.write_bytes(path.read_bytes()))
    feeder.start()
    with open_joints(pipe, JOINTS, SI) as file:
        file.check()
        q = torch.cat([q for q, _ in file.laden_joints()])
    feeder.join()
    assert_close(q, read_joints(path, JOINTS, SI), rtol=0, atol=0)


def test_a_pipe_that_is_no_text(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    feeder = threading.Thread(target=lambda: pipe.write_bytes(b"PK\x03\x04\xff\xfe"))
    feeder.start()
    with (
        pytest.raises(MeasurementError, match=says("no text", "export the table as CSV")),
        open_joints(pipe, JOINTS, SI),
    ):
        pass
    feeder.join()


def test_a_file_that_changes_between_the_passes(tmp_path: Path) -> None:
    path = written(tmp_path, lines())
    with open_joints(path, JOINTS, SI) as file:
        file.check()
        with path.open("a") as more:
            more.write("0,0,1,2,3\n")
        with pytest.raises(MeasurementError, match=says("changed while it was read", "expected 25 rows", "got 26")):
            list(file.laden_joints())


def test_a_device_without_an_end_is_refused() -> None:
    with pytest.raises(MeasurementError, match="'/dev/zero' is no text but binary"):
        read_joints("/dev/zero", JOINTS, SI)


def test_memory_does_not_grow_with_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_tables, "ROWS_AT_ONCE", 100)
    peaks = []
    for count in (500, 5000):
        path = written(tmp_path, ["0.125,-0.5,1,2,3"] * count)
        tracemalloc.start()
        with open_joints(path, JOINTS, SI) as file:
            file.check()
            for _ in file.laden_joints():
                pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]
