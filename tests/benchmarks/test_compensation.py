"""The benchmark of compensation: where the true arm goes, and the program."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import compensation
import pytest
import torch

import diffeo_calib as dc


def test_true_errors_of_perfect_commands_are_zero() -> None:
    """Targets where the true arm is anyway."""
    bench = compensation.Bench("poses", 20)
    tool = compensation.mark_points(bench.tool(bench.arm.truth.tool)[None], compensation.LEVER)[0]
    bench.arm.truth = compensation.replace(bench.arm.truth, tool=tool)
    there = compensation.poses_from_marks(bench.arm.true_points(bench.start), compensation.LEVER)
    again = compensation.Bench("poses", 20)
    again.targets = there
    found = again.true_errors(again.start, torch.ones(len(there), dtype=torch.bool))
    assert max(float(str(found[name])) for name in ("rms_mm", "max_mm", "rms_deg")) < 1e-6


@pytest.mark.slow
def test_the_true_tool_is_as_good_as_the_held_out_frame() -> None:
    """0.25 m from the measured frame: little worse than there, and far better than geometry."""
    records = {
        str(record["method"]): record for record in compensation.compared(compensation.Bench("poses", 60), "poses")
    }
    rms = {name: float(str(record["rms_mm"])) for name, record in records.items()}
    assert rms["registration"] > 2 * rms["geometry"] > 10 * rms["diffeo_calib"]
    ours = records["diffeo_calib"]
    assert rms["diffeo_calib"] < 1.5 * float(str(ours["held_out_mm"]))
    assert float(str(ours["rms_deg"])) < 1.15 * float(str(ours["held_out_deg"]))
    assert int(str(ours["rows"])) > 500


@pytest.mark.slow
def test_the_speed_of_a_saved_model(arm: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = getattr(arm, "model", None)
    assert isinstance(model, dc.CalibratedKinematics)
    dc.save(model, tmp_path / "m.safetensors")
    arguments = ["compensation.py", "--model", tmp_path / "m.safetensors", "--quick", "--out", tmp_path / "speed.json"]
    monkeypatch.setattr(sys, "argv", [str(argument) for argument in arguments])
    compensation.main()
    records = json.loads((tmp_path / "speed.json").read_text())["records"]
    assert [(record["targets"], record["rows"]) for record in records] == [
        ("poses", 1),
        ("positions", 1),
        ("poses", 100),
        ("positions", 100),
    ]
    assert all(record["seconds"] > 0 for record in records)
    assert "reached" in records[-1]["status"]
