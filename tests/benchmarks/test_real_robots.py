"""The benchmark on real robots: data sets, the program and its records, splits."""

from __future__ import annotations

import json
import math
from pathlib import Path

import harness
import numpy as np
import protocols
import pytest
import real_robots
import torch
from robot_data import DESCRIPTOR

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibError
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm

QUARTER = math.pi / 2
TABLE = [[0.0, QUARTER, 0.3], [0.0, -QUARTER, 0.4], [0.0, 0.0, 0.2, 0.3, "prismatic"], [0.1, QUARTER, 0.1], [0, 0, 0.1]]
COLUMNS = ["q1", "q2", "q3", "q4", "q5"]
DH = {
    "robot": {"dh": TABLE, "convention": "standard"},
    "csv": "table.csv",
    "joints": COLUMNS,
    "position": [["ax", "ay", "az"], ["bx", "by", "bz"]],
    "length": "mm",
    "angle": "deg",
    "sep": ";",
    "decimal": ",",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two data sets: a DH table with two markers, a URDF with columns of other names."""
    for name in ("dh", "urdf"):
        (tmp_path / name).mkdir()
    robot, rng = dc.from_dh(TABLE, names=COLUMNS), np.random.default_rng(0)
    q = torch.from_numpy(rng.uniform((-2, -2, 0.1, -2, -2), (2, 2, 0.6, 2, 2), (40, 5)))
    tool = torch.tensor([[0.05, 0.02, 0.1], [-0.04, 0.0, 0.06]], dtype=torch.float64)
    data = dc.Measurements(q, tool @ robot(q)[:, :3, :3].mT + robot(q)[:, None, :3, 3], COLUMNS)
    table = TableFormat("mm", "deg", ";", ",")
    write_measurements(tmp_path / "dh" / "table.csv", data, table, joints=robot, position=DH["position"])
    (tmp_path / "dh" / DESCRIPTOR).write_text(json.dumps(DH))
    arm, columns = SimulatedArm(seed=3), [f"angle {k}" for k in range(6)]
    arm.write_urdf(tmp_path / "urdf" / "arm.urdf")
    write_measurements(
        tmp_path / "urdf" / "table.csv", dc.Measurements(*arm.measure(30)), TableFormat("m", "rad"), joints=columns
    )
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


def test_the_program(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Measure, write, and draw from the file again."""
    out = tmp_path / "out.json"
    given = ["--data", str(folder), "--protocol", "curve", "--methods", "registration", "geometry", "--seeds", "1"]
    real_robots.run(real_robots.arguments([*given, "--sizes", "15", "all", "--out", str(out)]))
    records = json.loads(out.read_text())["records"]
    assert len(records) == 2 * 2 * 2
    assert {record["dataset"] for record in records} == {"dh", "urdf"}
    assert "Means" in capsys.readouterr().out
    figure = tmp_path / "curves.svg"
    real_robots.run(real_robots.arguments(["--from", str(out), str(out), "--figure", str(figure)]))
    assert all(f"<!-- {name} -->" in figure.read_text() for name in ("dh", "urdf", "registration", "geometry"))
    assert harness.earlier([out, out], real_robots.KEY) == records  # counted once
    out.write_text('{"records": [{"backend": "tiled"}]}')
    with pytest.raises(DiffeoCalibError, match="records of this program"):
        harness.earlier([out], real_robots.KEY)


def test_repeats_stay_on_one_side_and_all_rows_are_used() -> None:
    """50 configurations, each measured twice."""
    q, points = SimulatedArm(seed=1).measure(50)
    data = dc.Measurements(torch.cat([q, q + 1e-5]), torch.cat([points, points + 1e-6]))
    found = list(protocols.splits(data, protocols.PROTOCOLS, [30, None], seeds=2))
    assert [(split.protocol, split.size, split.index) for split in found] == [
        *(("kfold", "all", fold) for fold in range(5)),
        *(("curve", size, seed) for seed in range(2) for size in ("30", "all")),
        ("extrapolate", "all", 0),
    ]
    for split in found:
        train, test = ({tuple(row) for row in each.q.mul(1e3).round().tolist()} for each in (split.train, split.test))
        assert train.isdisjoint(test)
        assert len(split.train) == (30 if split.size == "30" else 100 - len(split.test))
