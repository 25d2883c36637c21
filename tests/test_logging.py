"""The library logs its steps and shows them only to those who ask."""

from __future__ import annotations

import logging
import subprocess
import sys
from pathlib import Path

import pytest
from command_bank import Command
from product_bank import simulated

import diffeo_calib as dc


def messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name.startswith("diffeo_calib.")]


@pytest.mark.usefixtures("undrawn")
def test_the_steps_of_a_calibration_and_of_a_report(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    arm, train, test = simulated(30)
    points = train.points.clone()
    points[7] += 0.01
    with caplog.at_level(logging.INFO, logger="diffeo_calib"):
        result = dc.calibrate(arm.nominal, dc.Measurements(train.q, points))
        dc.save(result.model, tmp_path / "arm.safetensors")
        both = dc.Measurements.joined([train[:20], test[:20]])
        dc.write_report(result.model, tmp_path / "arm.html", both)
    found = messages(caplog)
    assert {record.levelname for record in caplog.records} == {"INFO"}
    begins = ("calibrating", "registration: ", "scales: ", "fit of 30 rows: converged", "rows that look")
    places = [next(k for k, text in enumerate(found) if text.startswith(begin)) for begin in begins]
    assert places == sorted(places)
    assert found[places[-1]] == "rows that look wrong and hardly count: 7"
    assert f"model written to {tmp_path}/arm.safetensors" in found
    assert "judged by 20 rows it has not seen, 20 were used before" in found


def test_nothing_is_shown_unasked(tmp_path: Path) -> None:
    code = (
        "import diffeo_calib as dc, torch, logging\n"
        "q = torch.rand(5, 1); dc.Measurements(q, torch.rand(5, 3))\n"
        "log = logging.getLogger('diffeo_calib'); log.warning('heard by nobody')\n"
        "print(log.level, [type(one).__name__ for one in log.handlers])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert (done.stdout.strip(), done.stderr) == ("0 ['NullHandler']", "")


def test_the_command_line_shows_them_with_verbose(command: Command, tmp_path: Path) -> None:
    arm, *_ = simulated(1)
    arm.write_urdf(tmp_path / "arm.urdf")
    plan = ["plan", "--robot", tmp_path / "arm.urdf", "--base", "base_link", "--tip", "flange", "-n", 5, "--draw", 50]
    quiet = command(*plan, "--length", "mm", "--angle", "deg", "-o", tmp_path / "a.csv")
    asked = command("--verbose", *plan, "--length", "mm", "--angle", "deg", "-o", tmp_path / "b.csv")
    assert (quiet.code, asked.code) == (0, 0)
    assert "5 poses chosen of 50" not in quiet.err
    assert "5 poses chosen of 50" in asked.err
    assert not logging.getLogger("diffeo_calib").isEnabledFor(logging.INFO)
    assert len(logging.getLogger("diffeo_calib").handlers) == 1
