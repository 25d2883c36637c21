"""Tables that are read in blocks: the same rows, errors and warnings as when they are read at once."""

from __future__ import annotations

import os
import threading
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
import torch
from table_bank import HEADER, JOINTS, POSITION, says
from torch.testing import assert_close

from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.csv import tables as csv_tables
from diffeo_calib.measurements.csv.files import open_joints, open_measurements, read_joints, read_table
from diffeo_calib.measurements.table import Measurements
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
    whole = read_table(path, JOINTS, POSITION, SI)
    seen: list[float] = []
    with open_measurements(path, JOINTS, POSITION, SI) as file:
        file.check(progress=seen.append)
        for _ in range(2):  # as often as needed
            blocks = list(file.measurements())
            joined = Measurements.joined(blocks)
            assert_close((joined.q, joined.points), (whole.q, whole.points), rtol=0, atol=0)
            assert joined.line_numbers.tolist() == whole.line_numbers.tolist() == [*range(2, 9), *range(10, 28)]
    assert [len(block) for block in blocks] == [4] * 6 + [1]
    assert file.rows == ROWS
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    with open_joints(path, JOINTS, SI) as file:
        file.check()
        assert_close(torch.cat(list(file.joints())), whole.q, rtol=0, atol=0)


def test_poses_in_blocks(tmp_path: Path) -> None:
    table = TableFormat("m", "rad", rotation=["a", "b", "c"], convention="rotvec", rotation_angle="rad")
    header = "q1,q2,x,y,z,a,b,c\n"
    path = written(tmp_path, [f"{line},0.1,{0.05 * k!r},0.3" for k, line in enumerate(lines())], header)
    with open_measurements(path, JOINTS, POSITION, table) as file:
        file.check()
        joined = Measurements.joined(list(file.measurements()))
    whole = read_table(path, JOINTS, POSITION, table)
    assert joined.lever == whole.lever
    assert_close(joined.poses, whole.poses, rtol=0, atol=1e-15)


def changed(place: int, text: str) -> list[str]:
    rows = lines()
    rows[place] = text
    return rows


MISTAKES: dict[str, tuple[list[str], dict[str, Any]]] = {
    "ragged": ([*changed(3, "1"), "1,2", *lines(9), "1"], {}),
    "word": ([*changed(14, "0,0,far,2,3"), "0,near,1,2,3", "0,0,,2,3"], {}),
    "missing": ([*changed(2, "0,0,,2,3"), "0,nan,inf,2,3"], {}),
    "comma": ([*changed(24, "0,0,'1;5',2,3")], {}),
    "deviations": ([*changed(20, "0,0,1,0,3"), "0,0,1,-1,3"], {"std": ["y"]}),
    "quaternion": (changed(22, "0,0,1,0.5,3"), {"rotation": ["q1", "q2", "y", "z"], "convention": "quat_xyzw"}),
    "no rows": ([], {}),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_those_of_the_whole_table(name: str, tmp_path: Path) -> None:
    """With the same counts and lines, before the first row is used."""
    rows, options = MISTAKES[name]
    if name == "quaternion":
        header = "j,k,x,y,z,qx,qy,qz,qw\n"
        good = ["0,0,1,2,3,0,0,0,1"] * ROWS
        path = written(tmp_path, [*good[:22], "0,0,1,2,3,0,0,0,2", *good[23:]], header)
        joints, position = ["j", "k"], ["x", "y", "z"]
        options = {"rotation": ["qx", "qy", "qz", "qw"], "convention": "quat_xyzw"}
    else:
        path, joints, position = written(tmp_path, rows), JOINTS, POSITION
        if "std" in options:
            position = ["x", "x2", "z"]
            path.write_text("q1,q2,x,y,z,x2\n" + "\n".join(f"{row},1" for row in rows) + "\n")
    table = TableFormat("m", "rad", **options)
    with pytest.raises(MeasurementError) as whole:
        read_table(path, joints, position, table, duplicates="keep")
    with open_measurements(path, joints, position, table) as file, pytest.raises(MeasurementError) as blocks:
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
        q = torch.cat(list(file.joints()))
    feeder.join()
    assert_close(q, read_joints(path, JOINTS, SI), rtol=0, atol=0)


def test_a_file_that_changes_between_the_passes(tmp_path: Path) -> None:
    path = written(tmp_path, lines())
    with open_joints(path, JOINTS, SI) as file:
        file.check()
        with path.open("a") as more:
            more.write("0,0,1,2,3\n")
        with pytest.raises(MeasurementError, match=says("changed while it was read", "expected 25 rows", "got 26")):
            list(file.joints())


def test_endless_lines_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("diffeo_calib.measurements.csv.cells.LONGEST_LINE", 10_000)
    with pytest.raises(MeasurementError, match="'/dev/zero', line 1 has more than 10000 characters"):
        read_joints("/dev/zero", JOINTS, SI)


def test_memory_does_not_grow_with_the_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_tables, "ROWS_AT_ONCE", 100)
    peaks = []
    for count in (500, 5000):
        path = written(tmp_path, ["0.125,-0.5,1,2,3"] * count)
        tracemalloc.start()
        with open_measurements(path, JOINTS, POSITION, SI) as file:
            file.check()
            for _ in file.measurements():
                pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]
