"""Where a model comes from: kept by every copy, saved and loaded; old files have none."""

from __future__ import annotations

import hashlib
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
import torch
from product_bank import Case

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.provenance import Provenance
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat

ENTRIES: dict[str, str] = {
    "date": "2026-11-22T10:00:00+00:00",
    "version": "0.1.0",
    "table_sha256": "ab" * 32,
    "note": "serial 17",
}


def test_a_calibration_says_when_and_from_what(arm: Case) -> None:
    found = arm.model.provenance
    assert found is not None
    made = datetime.fromisoformat(found.date)
    assert made.tzinfo == timezone.utc
    assert timedelta(0) <= datetime.now(timezone.utc) - made < timedelta(days=1)
    assert found.version == dc.__version__
    assert found.table_sha256 == arm.train.sha256
    assert found.note == ""


def test_every_copy_keeps_it(arm: Case, tmp_path: Path) -> None:
    provenance = Provenance(**ENTRIES)
    model = dc.CalibratedKinematics(
        arm.robot, arm.model.map, arm.model.summary, tool=[0, 0, 0.1], provenance=provenance
    )
    other = model.with_tool([0.1, 0, 0]).to("cpu")
    assert other.provenance == provenance
    assert other.summary == model.summary
    assert other.tool[0, 3] == 0.1
    dc.save(other, tmp_path / "model")
    again: Any = dc.load(tmp_path / "model")
    assert again.provenance == provenance
    dc.save(arm.model.with_tool(None), tmp_path / "model")
    assert dc.load(tmp_path / "model").provenance == arm.model.provenance  # pyright: ignore[reportAttributeAccessIssue]


def test_files_without_it_have_none() -> None:
    old: Any = dc.load(Path(__file__).parents[1] / "interop" / "data" / "robot_format_3.safetensors")
    assert old.provenance is None


def test_the_hash_is_that_of_the_file_or_of_the_arrays(arm: Case, tmp_path: Path) -> None:
    names, table = arm.robot.joint_names, TableFormat("m", "rad")
    write_measurements(tmp_path / "table.csv", arm.train, table, joints=names)
    data = dc.read_measurements(tmp_path / "table.csv", names, ["x", "y", "z"], length="m", angle="rad")
    of_the_file = hashlib.sha256((tmp_path / "table.csv").read_bytes()).hexdigest()
    assert data.sha256 == data.split(0.5)[0].sha256 == data.file_sha256 == of_the_file
    arrays = dc.Measurements(data.q, data.points)  # not read from a file
    assert arrays.file_sha256 is None
    assert arrays.sha256 == dc.Measurements(data.q.clone(), data.points.clone()).sha256
    shifted = dc.Measurements(data.q, data.points + 1e-12)
    others = (shifted, arrays.rows(slice(1, None)), dc.Measurements(data.q, data.points, std=1e-5))
    assert len({arrays.sha256, of_the_file, *(other.sha256 for other in others)}) == 5


def test_one_line_for_people() -> None:
    line = Provenance(**ENTRIES).sentence("ur10", 442)
    assert line == (
        "fitted 2026-11-22 with diffeo_calib 0.1.0 to robot 'ur10', 442 rows, table sha256 abababababab...; "
        "note: serial 17"
    )


def test_entries_that_cannot_be_read() -> None:
    assert Provenance.from_dict(ENTRIES).to_dict() == {**ENTRIES, "command": "", "table": ""}
    for entries in ({}, ENTRIES | {"mood": "good"}, 3):
        with pytest.raises(InputError, match="the entry provenance"):
            Provenance.from_dict(entries)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="the entry 'note' of the provenance: expected text, got 3"):
        Provenance.from_dict(ENTRIES | {"note": 3})


def test_a_note_is_text(arm: Case) -> None:
    with pytest.raises(InputError, match="`note`: expected text, got int"):
        dc.calibrate(arm.robot, arm.train, note=3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="`note`: expected at most 10000 characters, got 20000"):
        dc.calibrate(arm.robot, arm.train, note="ab" * 10_000)
    assert torch.equal(arm.model.configurations, arm.train.q)
