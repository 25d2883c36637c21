"""Where a model comes from: kept by every copy, saved and loaded; old files have none."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from math import inf
from pathlib import Path
from typing import Any

import pytest
from product_bank import Case
from safetensors import safe_open

import diffeo_calib as dc
from diffeo_calib.kinematics.provenance import Provenance, Summary
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat

ORIGIN: dict[str, str] = {
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
    provenance = Provenance(**ORIGIN)
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


# --- the summary of a calibration: as a dictionary, from dictionaries of every age, and in model files --------------

SUMMARY = Summary(
    registration_rms=8e-4,
    geometry_rms=4e-4,
    diffeomorphic_rms=6e-5,
    leave_one_out_rms=1.1e-4,
    outliers=2,
    noise_degrees_of_freedom=7.5,
    coupling_residual=1e-6,
    end_residual=2e-6,
    energy=640.0,
    status="converged",
    scales="given",
    rows=60,
    parts={"geometry": 3e-4, "task space": 1e-5},
    effective_parameters=88.0,
)
ENTRIES = {
    "registration rms [m]": 8e-4,
    "geometry rms [m]": 4e-4,
    "diffeomorphic rms [m]": 6e-5,
    "leave-one-out rms [m]": 1.1e-4,
    "outliers": 2,
    "noise degrees of freedom": 7.5,
    "coupling residual": 1e-6,
    "end residual": 2e-6,
    "energy": 640.0,
    "status": "converged",
    "scales": "given",
    "rows": 60,
    "geometry [m]": 3e-4,
    "task space [m]": 1e-5,
    "effective parameters": 88.0,
}
"""As model files of version 3 hold them."""


@pytest.mark.parametrize("changed", [{}, {"noise_degrees_of_freedom": inf, "effective_parameters": None}])
def test_entries_are_named_with_their_units(changed: dict[str, float | None]) -> None:
    """Unknown numbers are left out, as the first files of version 3 did; JSON knows no infinity."""
    summary, entries = replace(SUMMARY, **changed), dict(ENTRIES)
    if changed:
        entries |= {"noise degrees of freedom": "infinite"}
        del entries["effective parameters"]
    assert summary.to_dict() == entries
    assert Summary.from_dict(json.loads(json.dumps(entries))) == summary
    del entries["noise degrees of freedom"]
    assert Summary.from_dict(entries) == replace(summary, noise_degrees_of_freedom=None)
    for wrong in ({}, ENTRIES | {"mood": "good"}, ENTRIES | {"rows": "many"}):
        with pytest.raises(TypeError, match=r"argument|the entry 'rows' is 'many'"):
            Summary.from_dict(wrong)


def header(path: Path) -> dict[str, Any]:
    with safe_open(path, framework="pt") as file:
        return json.loads(file.metadata()["diffeo_calib"])


@pytest.mark.parametrize("summary", [SUMMARY, None])
def test_a_model_file_holds_the_summary(summary: Summary | None, arm: Case, tmp_path: Path) -> None:
    """Format version 3: readers of any age find the entries they know."""
    path = tmp_path / "model.safetensors"
    dc.save(dc.CalibratedKinematics(arm.robot, arm.model.map, summary), path)
    assert header(path)["format"] == 3
    again: Any = dc.load(path)
    assert again.summary == summary
    assert again.report == header(path)["report"] == ({} if summary is None else summary.to_dict())
