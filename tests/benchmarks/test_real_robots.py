"""The benchmark on real robots: methods, records, and the program."""

from __future__ import annotations

import json
from pathlib import Path

import baselines
import harness
import protocols
import pytest
import real_robots
import torch
from real_robots_bank import arm_data
from robot_data import RobotData

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibError
from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.robots.simulated_arm import SimulatedArm


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


def test_a_failure_is_a_record(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> baselines.Fitted:
        raise ValueError("not today")

    def missing(*_: object) -> baselines.Fitted:
        raise ModuleNotFoundError("No module named 'sklearn'", name="sklearn")

    robot, train, test = arm_data(20)
    split = protocols.Split("curve", "20", 0, train, test)
    for method, word in ((broken, "not today"), (missing, "pip install")):
        monkeypatch.setitem(baselines.METHODS, "geometry", method)
        record = real_robots.attempt(RobotData("arm", robot, train), split, "geometry")
        assert word in str(record["note"])
        assert "rms_mm" not in record


def test_errors_of_orientations_are_recorded() -> None:
    arm = SimulatedArm(seed=1)
    q = arm.sample(20)
    poses = arm.truth.poses(q)
    axis = torch.tensor([0.0, 0.0, 0.25 * torch.pi / 180], dtype=torch.float64)
    turned = poses @ transforms(rotation(axis), torch.zeros_like(axis))
    measured, predicted = (dc.Measurements.from_poses(q, frames) for frames in (poses, turned))
    fitted = baselines.Fitted(lambda _: predicted.points)
    assert real_robots.errors(fitted, measured)["rms_deg"] == pytest.approx(0.25)
    assert real_robots.errors(fitted, dc.Measurements(q, measured.points))["rms_deg"] is None


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
    out.write_text("[]")
    with pytest.raises(DiffeoCalibError, match="cannot be read"):
        harness.earlier([out], real_robots.KEY)


def test_an_unwritable_figure_is_refused_before_the_work(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["real_robots.py", "--data", str(folder), "--figure", str(folder / "x" / "y.png")])
    with pytest.raises(SystemExit, match="error: the figure cannot be written"):
        harness.guarded(lambda: real_robots.run(real_robots.arguments()))


def test_unwritable_records_are_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(DiffeoCalibError, match="cannot be written"):
        harness.report(iter([]), tmp_path / "none" / "x.json")


def test_quick() -> None:
    plan = real_robots.arguments(["--quick"])
    assert (plan.protocol, plan.sizes, plan.seeds) == (["curve"], [60, 150], 1)
    assert plan.methods == ["registration", "geometry", "diffeo_calib"]
