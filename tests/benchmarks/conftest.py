"""Fixtures that the tests of the benchmarks share."""

from __future__ import annotations

import json
from pathlib import Path

import baselines
import pytest
from real_robots_bank import DH, sliding
from robot_data import DESCRIPTOR

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three data sets: a DH table with two markers, a URDF with columns of other names, and no data set."""
    robot, data = sliding()
    for name in ("dh", "urdf", "neither"):
        (tmp_path / name).mkdir()
    table = TableFormat("mm", "deg", ";", ",")
    write_measurements(tmp_path / "dh" / "table.csv", data, table, joints=robot, position=DH["position"])
    (tmp_path / "dh" / DESCRIPTOR).write_text(json.dumps(DH))
    arm = SimulatedArm(seed=3)
    arm.write_urdf(tmp_path / "urdf" / "arm.urdf")
    columns = [f"angle {k}" for k in range(6)]
    measured = dc.Measurements(*arm.measure(30))
    write_measurements(tmp_path / "urdf" / "table.csv", measured, TableFormat("m", "rad"), joints=columns)
    entries = {
        "robot": {"urdf": "arm.urdf", "base": "base_link", "tip": "flange"},
        "csv": "table.csv",
        "joints": columns,
        "position": ["x", "y", "z"],
        "length": "m",
        "angle": "rad",
    }
    (tmp_path / "urdf" / DESCRIPTOR).write_text(json.dumps(entries))
    return tmp_path


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Learners of little effort."""
    monkeypatch.setattr(baselines, "RESTARTS", 0)
    monkeypatch.setattr(baselines, "TREES", baselines.TREES | {"n_estimators": 30})
    monkeypatch.setattr(baselines, "GRID_TREES", {"max_depth": (3,)})
    monkeypatch.setattr(baselines, "GRID_NETWORK", {"hidden_layer_sizes": ((8,),), "alpha": (1.0, 10.0)})
    monkeypatch.setattr(baselines, "NETWORK_STEPS", 50)
