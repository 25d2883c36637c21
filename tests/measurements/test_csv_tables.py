"""Tables are judged as a whole, and read once."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest
from table_bank import HEADER, JOINTS, says
from torch.testing import assert_close

from diffeo_calib.common.errors import DiffeoCalibWarning, MeasurementError
from diffeo_calib.measurements.csv.files import read_joints
from diffeo_calib.measurements.table_format import TableFormat

SI = TableFormat("m", "rad")
ROWS = 25


def lines(count: int = ROWS) -> list[str]:
    return [f"{0.1 * k!r},-0.5,{k},2,3" for k in range(count)]


def written(folder: Path, rows: list[str], header: str = HEADER) -> Path:
    (folder / "table.csv").write_text(header + "\n".join(rows) + "\n")
    return folder / "table.csv"


def test_units_are_judged_by_all_rows(tmp_path: Path) -> None:
    path = written(tmp_path, [*lines(), "90,0,1,2,3", *lines()])
    with pytest.warns(DiffeoCalibWarning, match="90 rad"):
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
    with pytest.raises(MeasurementError, match=says("no text", "save it as .xlsx or CSV")):
        read_joints(pipe, JOINTS, SI)
    feeder.join()


def test_a_device_without_an_end_is_refused() -> None:
    with pytest.raises(MeasurementError, match="'/dev/zero' is no text but binary"):
        read_joints("/dev/zero", JOINTS, SI)
