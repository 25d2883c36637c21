"""A handful of kills: no file is lost or damaged."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_bank import environment

PROGRAM = """
import sys, kills
kills.ROWS = {"measured.csv": 12, "joints.csv": 300, "program.csv": 10}
sys.argv[0] = "kills.py"
kills.harness.guarded(kills.program)
"""
"""With small tables: whether files are whole does not depend on their rows."""
FOLDER = Path(__file__).parents[2] / "benchmarks" / "robustness"


@pytest.mark.slow
def test_killed_commands_leave_whole_files(tmp_path: Path) -> None:
    out, env = tmp_path / "kills.json", environment()
    env["PYTHONPATH"] = os.pathsep.join([str(FOLDER), env["PYTHONPATH"]])
    command = [sys.executable, "-c", PROGRAM, "--count", "4", "--seed", "1", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, env=env, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    records = json.loads(out.read_text())["records"]
    assert [record["command"] for record in records] == ["fit", "predict", "correct", "export"]
    assert sum(record["killed"] + record["ended_before"] for record in records) == 4
    for record in records:
        assert (record["lost"], record["damaged"], record["failed_again"]) == (0, 0, 0)
