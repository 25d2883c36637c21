"""Spreadsheets, arrays of NumPy and variables of MATLAB hold the same rows as a CSV file."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import openpyxl
import pytest
import torch
from scipy.io import savemat
from table_bank import warned

from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv.files import read_measurements
from diffeo_calib.measurements.csv.lines import CsvLines

ROWS = np.random.default_rng(0).uniform(-1.0, 1.0, (7, 5))
ROWS[0, :2] = 0.0
JOINTS, PLACES = ROWS[:, :2], ROWS[:, 2:]
UNITS = {"length": "m", "angle": "rad"}
NAMES = "q_1,q_2", "p_x,p_y,p_z"


def _book(path: Path) -> None:
    book = openpyxl.Workbook()
    sheet = book.worksheets[0]
    for row in ([], [None, "measured on Monday"], [None, "q_1", "q_2", "p_x", "p_y", "p_z"], *ROWS.tolist()):
        sheet.append([None, *row] if len(row) == 5 else row)
    book.save(path)


def _two_sheets(path: Path) -> None:
    _book(path)
    book = openpyxl.load_workbook(path)
    book.create_sheet("notes", 0).append(["see the other one"])
    book.save(path)


def _joined_sheets(path: Path) -> None:
    """Joints and places of the same stops, in another order; the first is at zero, and no line has a remark."""
    book = openpyxl.Workbook()
    both = ("robot", ["q_1", "q_2", "remark"], JOINTS), ("tracker", ["p_x", "p_y", "p_z"], PLACES[::-1])
    for title, names, values in both:
        stops = range(7) if title == "robot" else reversed(range(7))
        rows = [["stop", *names], *([k, *own] for k, own in zip(stops, values.tolist(), strict=True))]
        sheet = book.create_sheet(title)
        for row in rows:
            sheet.append(row)
    book.save(path)


def _named(path: Path) -> None:
    names = ["q_1", "q_2", "p_x", "p_y", "p_z"]
    np.save(path, np.array([tuple(row) for row in ROWS], dtype=[(name, float) for name in names]))


def _struct(path: Path) -> None:
    savemat(path, {"log": {"q": JOINTS, "p": PLACES}})


RECORDS = [{"q": q, "log": {"p": p, "note": "a,b"}} for q, p in zip(JOINTS.tolist(), PLACES.tolist(), strict=True)]
LOG = "log_p_x,log_p_y,log_p_z"
WRITERS: dict[str, tuple[str, Callable[[Path], object], str, str]] = {
    "a spreadsheet": ("t.xlsx", _book, *NAMES),
    "the sheet with rows": ("t.xlsx", _two_sheets, *NAMES),
    "two sheets of the same stops": ("t.xlsx", _joined_sheets, *NAMES),
    "an array": ("t.npy", lambda path: np.save(path, ROWS), "1,2", "3,4,5"),
    "an array with names": ("t.npy", _named, *NAMES),
    "arrays": ("t.npz", lambda path: np.savez(path, q=JOINTS, p=PLACES, gain=np.ones((2, 4)), dh=np.eye(3)), *NAMES),
    "arrays of columns": ("t.npz", lambda path: np.savez(path, q=JOINTS.T, p=PLACES.T, s=np.eye(3)), *NAMES),
    "variables": ("t.mat", lambda path: savemat(path, {"q": JOINTS, "p": PLACES}), *NAMES),
    "variables of old": ("t.mat", lambda path: savemat(path, {"q": JOINTS, "p": PLACES}, format="4"), *NAMES),
    "a structure": ("t.mat", _struct, "log_q_1,log_q_2", "log_p_x,log_p_y,log_p_z"),
    "lines of JSON": ("t.jsonl", lambda path: path.write_text("\n".join(map(json.dumps, RECORDS))), "q_1,q_2", LOG),
    "a list of JSON": ("t.json", lambda path: path.write_text(json.dumps(RECORDS, indent=1)), "q_1,q_2", LOG),
}


NOTES = {
    "a spreadsheet": "line 1, 2 before the header skipped",
    "the sheet with rows": "sheet 'Sheet' read, not notes",
    "two sheets of the same stops": "sheets 'robot' and 'tracker' joined by 'stop'",
    "an array": "no header line",
    "arrays of columns": "arrays s left out",
    "arrays": "arrays gain, dh left out: no numbers or texts of 7 rows",
}


@pytest.mark.parametrize("kind", WRITERS)
def test_the_rows_are_those_of_a_csv_file(tmp_path: Path, kind: str) -> None:
    name, write, joints, places = WRITERS[kind]
    write(tmp_path / name)
    for sep in ",;":
        how: Any = {"sep": sep, **UNITS}
        data, said = warned(read_measurements, tmp_path / name, joints.split(","), places.split(","), **how)
        torch.testing.assert_close(data.q, torch.from_numpy(JOINTS), rtol=1e-15, atol=0.0)  # sheets have 16 digits
        torch.testing.assert_close(data.points[:, 0], torch.from_numpy(PLACES), rtol=1e-15, atol=0.0)
        assert NOTES.get(kind, "") in " ".join(said)
        assert bool(said) == (kind in NOTES)


@pytest.mark.parametrize(("length", "metres"), [("mm", 1e-3), ("cm", 1e-2), ("um", 1e-6), ("inch", 0.0254)])
def test_lengths_in_every_unit(length: str, metres: float, tmp_path: Path) -> None:
    np.save(tmp_path / "t.npy", ROWS / np.array([1, 1, metres, metres, metres]))
    data = warned(read_measurements, tmp_path / "t.npy", ["1", "2"], ["3", "4", "5"], length=length, angle="rad")[0]
    torch.testing.assert_close(data.points[:, 0], torch.from_numpy(PLACES))


def test_lines_columns_and_a_missing_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever size the file says that the sheet has: some programs write that of one cell."""
    _book(tmp_path / "t.xlsx")
    with ZipFile(tmp_path / "t.xlsx") as book, ZipFile(tmp_path / "one.xlsx", "w") as other:
        for name in book.namelist():
            other.writestr(name, re.sub(b'<dimension ref="[^"]*"', b'<dimension ref="A1"', book.read(name)))
    for name in ("t.xlsx", "one.xlsx"):
        rows = CsvLines(tmp_path / name, ",").rows()
        assert [line for line, _ in rows] == list(range(4, 11))
    poses = np.tile(np.eye(4), (3, 1, 1))
    np.savez(tmp_path / "t.npz", q=np.arange(6).reshape(3, 2), T=poses, day=np.array(["mon", "tue", "wed"]))
    file = CsvLines(tmp_path / "t.npz", ",")
    (_, first), *_ = file.rows()
    assert file.header == ["q_1", "q_2", *(f"T_{row}{k}" for row in range(4) for k in range(4)), "day"]
    assert first == ["0", "1", *map(repr, poses[0].flatten().tolist()), "mon"]
    _book(tmp_path / "t.xlsx")
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(MeasurementError, match=r"pip install 'diffeo_calib\[excel\]'"):
        read_measurements(tmp_path / "t.xlsx", ["q_1", "q_2"], ["p_x", "p_y", "p_z"], **UNITS)


BAD: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "one array of one axis": ("t.npy", lambda path: np.save(path, ROWS[0]), "of shape .5,."),
    "objects": ("t.npy", lambda path: np.save(path, np.array([{}, []], dtype=object)), "cannot be read"),
    "no rows": ("t.npz", lambda path: np.savez(path, gain=1.0), "the arrays gain"),
    "arrays without rows": ("t.npz", lambda path: np.savez(path, q=JOINTS[:0], p=PLACES[:0]), "no column"),
    "damaged archive": ("t.xlsx", lambda path: path.write_bytes(b"PK\x03\x04 and no more"), "cannot be read"),
    "no cells": ("t.xlsx", lambda path: openpyxl.Workbook().save(path), "without cells"),
    "old spreadsheet": ("t.xls", lambda path: path.write_bytes(b"\xd0\xcf\x11\xe0" + bytes(60)), "save it as .xlsx"),
    "MATLAB 7.3": ("t.mat", lambda path: path.write_bytes(b"MATLAB 7.3 MAT-file" + bytes(600)), "-v7"),
}


@pytest.mark.parametrize("kind", BAD)
def test_other_files_are_one_clear_error(tmp_path: Path, kind: str) -> None:
    name, write, message = BAD[kind]
    write(tmp_path / name)
    with pytest.raises(MeasurementError, match=message) as caught:
        read_measurements(tmp_path / name, ["1", "2"], ["3", "4", "5"], **UNITS)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
