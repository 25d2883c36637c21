"""The benchmark of queries: every way gives the same answer, and the program runs."""

from __future__ import annotations

import json
from pathlib import Path

import queries
from real_robots_bank import arm_data

import diffeo_calib as dc


def test_program_on_a_saved_model(tmp_path: Path) -> None:
    robot, train, _ = arm_data(20)
    dc.save(dc.calibrate(robot, train).model, tmp_path / "model.safetensors")
    out = tmp_path / "queries.json"
    queries.run(queries.arguments(["--quick", "--models", str(tmp_path / "model.safetensors"), "--out", str(out)]))
    records = json.loads(out.read_text())["records"]
    assert {record["way"] for record in records} >= {"package", "formula, 64 rows at once"}
    for record in records:
        assert set(queries.COLUMNS) == set(record)
        assert record["coordinates"] == 60
        assert record["difference"] < 1e-6
