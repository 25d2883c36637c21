"""`diffeo-calib demo`."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from command_bank import Command


@pytest.mark.slow
@pytest.mark.usefixtures("given_scales")
def test_demo(command: Command, tmp_path: Path) -> None:
    done = command("demo", "--output", tmp_path / "demo", "--count", 30)
    assert (done.code, done.err.strip()) == (0, "")
    names = {path.name for path in (tmp_path / "demo").iterdir()}
    assert names == {"arm.urdf", "measurements.csv", "model.safetensors", "calibration.png", "report.html"}
    assert done.numbers("calibrated", "held out")[0] < done.numbers("geometric", "held out")[0]
    # the command that it shows is one that works
    shown = re.search(r"  diffeo-calib (fit .*?)\n\n", done.out, re.DOTALL)
    assert shown is not None
    arguments = shown.group(1).replace("\\\n", " ").replace("'", "").split()
    again = command(*arguments[: arguments.index("--figure")])  # figure and report are those of the demo
    assert again.code == 0
    assert again.numbers("calibrated", "held out") == done.numbers("calibrated", "held out")
