"""`diffeo-calib fit`: what it prints and writes; `demo`."""

import re
from pathlib import Path
from typing import Any

import pytest
import torch
from command_bank import STAGES, Command, Outcome, Site

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import twist_transform


def test_three_stages_in_training_and_held_out(fitted: Outcome, site: Site, model: dc.CalibratedKinematics) -> None:
    assert fitted.err.strip() == ""
    parts = dict(zip(("28 training", "12 held out"), site.data.split(0.7, seed=0), strict=True))
    rms = {label: [fitted.numbers(stage, label)[0] for stage in STAGES] for label in parts}
    assert rms["12 held out"][0] > rms["12 held out"][1] > rms["12 held out"][2]
    for label, data in parts.items():
        found = dc.evaluate(model, data)
        expected = [1e3 * value for value in (found.rms, found.median, found.p95, found.max)]
        assert fitted.numbers(STAGES[2], label) == pytest.approx(expected, abs=1.01e-4)
    assert "look wrong" not in fitted.out
    assert model.report["outliers"] == 0
    (before, *_), (after, _, most, _) = (fitted.numbers(stage, "12 held out") for stage in STAGES[1:])
    words = f"held out: {after:.3f} mm RMS, 95 % below {most:.3f} (12 rows; geometry alone {before:.3f} mm RMS)"
    assert fitted.out.startswith(words)


@pytest.mark.usefixtures("given_scales")
def test_without_held_out_rows_and_all_that_can_be_printed(site: Site, command: Command, tmp_path: Path) -> None:
    """Joint columns of other names; other points and commas; a wrong row by its line; the solver, what parts do."""
    table, model, names = tmp_path / "t.csv", tmp_path / "all.safetensors", list("abcdef")
    (data := site.data.rows([*range(20)])).points[7] += 0.03  # of a copy
    write_measurements(table, data, TableFormat("m", "rad", "\t"), joints=names)
    given = ["--position", "x,y,z", "--length", "m", "--angle", "rad", "--joints", ",".join(names), "--sep", "\\t"]
    done = command.ran("--verbose", "fit", table, *site.robot(), *given, "--holdout", 0, "-o", model)
    assert not done.warnings
    assert "no row was held out: these are errors on rows that were fitted" in done.out
    assert re.search(r"leave-one-out RMS: position \d+\.\d+ mm", done.out) is not None
    for stage in STAGES:
        assert len(done.numbers(stage, "20 training")) == 4
    loaded: Any = dc.load(model)
    assert "1 of 20 training rows look wrong (numbers are lines of the file); none was dropped:\n  row 9: " in done.out
    assert (loaded.report["rows"], loaded.report["outliers"]) == (20, 1)
    assert loaded.robot.joint_names == site.arm.nominal.joint_names


@pytest.mark.usefixtures("given_scales")
def test_a_device_that_moved_half_way_fails_the_fit(tmp_path: Path, command: Command) -> None:
    arm = SimulatedArm(seed=0)
    q, points = arm.measure(90, seed=3)
    turn = twist_transform(torch.tensor([0.1, -0.05, 0.02, 0.03, 0.05, 0.1], dtype=torch.float64))
    points[55:] = points[55:] @ turn[:3, :3].mT + turn[:3, 3]
    table = tmp_path / "moved.csv"
    write_measurements(table, dc.Measurements(q, points, arm.nominal.joint_names), TableFormat("mm", "deg"))
    arm.write_urdf(tmp_path / "arm.urdf")
    robot = ["--robot", tmp_path / "arm.urdf", "--base", arm.nominal.base, "--tip", arm.nominal.tip]
    given = [*robot, "--position", "x,y,z", "--length", "mm", "--angle", "deg", "-o", tmp_path / "m.safetensors"]
    done = command("fit", table, *given)
    assert done.code == 1
    assert any("near row 57" in line for line in done.warnings)
    assert "from the model" in done.error
    assert "session" in done.error


@pytest.mark.slow
@pytest.mark.usefixtures("given_scales")
def test_demo(command: Command, tmp_path: Path) -> None:
    done = command.ran("demo", "--output", tmp_path / "demo", "--count", 30, silent=True)
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    assert names == {"arm.urdf", "measurements.csv", "model.safetensors", "report.html"}
    assert done.numbers("calibrated", "held out")[0] < done.numbers("geometric", "held out")[0]
    shown = re.search(r"  diffeo-calib (fit .*?)\n\n", done.out, re.DOTALL)
    model: Any = dc.load(tmp_path / "demo" / "model.safetensors")
    assert shown is not None, "the command that it runs"
    assert model.provenance.command == " ".join(f"diffeo-calib {shown[1]}".replace("\\\n", " ").split())
