"""Where a model comes from, and its summary: kept by every copy, saved and loaded, from files of every age."""

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

import diffeo_calib as dc
from diffeo_calib.kinematics.provenance import Provenance, Summary
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat

OLD = Path(__file__).parents[1] / "interop" / "data" / "robot_format_3.safetensors"
"""Of version 3, without provenance."""


def test_a_calibration_says_when_and_from_what(arm: Case) -> None:
    found = arm.model.provenance
    assert found is not None
    made = datetime.fromisoformat(found.date)
    assert made.tzinfo == timezone.utc
    assert timedelta(0) <= datetime.now(timezone.utc) - made < timedelta(days=1)
    assert (found.version, found.table_sha256, found.note) == (dc.__version__, arm.train.sha256, "")


def test_every_copy_and_file_keeps_it(arm: Case, tmp_path: Path) -> None:
    provenance = Provenance("2026-11-22T10:00:00+00:00", "0.1.0", "ab" * 32, "serial 17")
    summary = replace(arm.model.summary, noise_degrees_of_freedom=inf, effective_parameters=None)
    model = dc.CalibratedKinematics(arm.robot, arm.model.map, summary, tool=[0, 0, 0.1], provenance=provenance)
    other = model.with_tool([0.1, 0, 0]).to("cpu")
    dc.save(other, tmp_path / "model")
    for copy in (other, dc.load(tmp_path / "model")):
        assert isinstance(copy, dc.CalibratedKinematics)
        assert (copy.provenance, copy.summary) == (provenance, summary)
        assert copy.tool[0, 3] == 0.1
    dc.save(arm.model.changed(summary=None), tmp_path / "model")
    again: Any = dc.load(tmp_path / "model")
    assert (again.summary, again.report) == (None, {})


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


def test_entries_of_a_summary_are_named_with_their_units() -> None:
    """Unknown numbers are left out, as the first files of version 3 did; JSON knows no infinity."""
    old: Any = dc.load(OLD)
    entries = old.summary.to_dict()  # all of them: tests/interop/test_model_file.py
    assert old.provenance is None
    assert {"registration rms [m]", "geometry rms [m]", "task space [m]", "rows", "noise degrees of freedom"} < {
        *entries
    }
    for changes in ({}, {"noise_degrees_of_freedom": inf}, {"noise_degrees_of_freedom": None}):
        summary = replace(old.summary, **changes)
        assert Summary.from_dict(json.loads(json.dumps(summary.to_dict()))) == summary
    assert "noise degrees of freedom" not in summary.to_dict()
    for wrong in ({}, entries | {"mood": "good"}, entries | {"rows": "many"}):
        with pytest.raises(TypeError, match=r"argument|the entry 'rows' is 'many'"):
            Summary.from_dict(wrong)
