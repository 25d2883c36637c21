"""The benchmark on real robots: data sets, splits, methods, records, means, and the program."""

from __future__ import annotations

import json
import math
from pathlib import Path

import baselines
import harness
import numpy as np
import protocols
import pytest
import real_robots
import torch
from robot_data import DESCRIPTOR, RobotData

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


def sliding() -> tuple[dc.Chain, dc.Measurements]:
    """A robot with a slide and two markers on its tool."""
    robot = dc.from_dh(TABLE, names=COLUMNS)
    rng = np.random.default_rng(0)
    q = torch.from_numpy(rng.uniform((-2, -2, 0.1, -2, -2), (2, 2, 0.6, 2, 2), (40, 5)))
    tool = torch.tensor([[0.05, 0.02, 0.1], [-0.04, 0.0, 0.06]], dtype=torch.float64)
    points = tool @ robot(q)[:, :3, :3].mT + robot(q)[:, None, :3, 3]
    return robot, dc.Measurements(q, points, COLUMNS)


def arm_data(rows: int, **options: int) -> tuple[dc.Chain, dc.Measurements, dc.Measurements]:
    arm = SimulatedArm(seed=1, **options)
    q, points = arm.measure(rows + 100, seed=2)
    return arm.nominal, dc.Measurements(q[:rows], points[:rows]), dc.Measurements(q[rows:], points[rows:])


# --- fixtures -------------------------------------------------------------------------------------------------------


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


# --- methods, records, the program ----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_every_method_on_a_small_arm() -> None:
    robot, train, test = arm_data(60)
    split = protocols.Split("curve", "60", 0, train, test)
    records = {
        method: real_robots.attempt(RobotData("arm", robot, train), split, method) for method in baselines.METHODS
    }
    assert [record["note"] for record in records.values()] == [None] * len(records)
    rms = {method: record["rms_mm"] for method, record in records.items()}
    assert all(isinstance(value, float) for value in rms.values())
    error = {method: float(str(value)) for method, value in rms.items()}
    assert error["registration"] > error["joint offsets"] > error["geometry"] > error["diffeo_calib"]
    for learner in ("GP", "boosting", "network"):
        assert error[f"geometry + {learner}"] < 1.05 * error["geometry"]
    assert error["GP alone"] > error["registration"]  # without a robot, 60 poses are few
    assert 0.7 < float(str(records["diffeo_calib"]["coverage_95"])) <= 1.0
    assert set(real_robots.COLUMNS) - set(records["geometry"]) == set()


def test_coverage_counts_markers_inside_the_ellipsoids() -> None:
    q, points = torch.zeros(4, 2), torch.zeros(4, 1, 3)
    points[:, 0, 0] = torch.tensor([0.0, 2.7, 2.9, 30.0])  # sqrt(7.8147) = 2.795
    covariance = torch.eye(3, dtype=torch.float64).expand(4, 1, 3, 3)
    data = dc.Measurements(q, points, doubt=False)
    assert real_robots.coverage(torch.zeros(4, 1, 3, dtype=torch.float64), covariance, data) == 0.5


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


# --- splits ---------------------------------------------------------------------------------------------------------


def repeated() -> dc.Measurements:
    """50 configurations, each measured twice."""
    q, points = SimulatedArm(seed=1).measure(50)
    return dc.Measurements(torch.cat([q, q + 1e-5]), torch.cat([points, points + 1e-6]))


def keys(data: dc.Measurements) -> set[tuple[float, ...]]:
    return {tuple(row) for row in data.q.mul(1e3).round().tolist()}


def test_repeats_stay_on_one_side_and_all_rows_are_used() -> None:
    data = repeated()
    found = list(protocols.splits(data, protocols.PROTOCOLS, [30, None], seeds=2))
    assert [(split.protocol, split.size, split.index) for split in found] == [
        *(("kfold", "all", fold) for fold in range(5)),
        *(("curve", size, seed) for seed in range(2) for size in ("30", "all")),
        ("extrapolate", "all", 0),
    ]
    for split in found:
        assert keys(split.train).isdisjoint(keys(split.test))
        assert len(split.train) == (30 if split.size == "30" else 100 - len(split.test))
