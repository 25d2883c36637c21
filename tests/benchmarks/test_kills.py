"""A handful of kills and faults: no file is lost or damaged, and no row that was answered."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from command_bank import environment

PROGRAM = """
import sys, kills, campaign_faults, product_bank
kills.fit.calibrate = product_bank.with_usual_scales
kills.ROWS = {"measured.csv": 12, "joints.csv": 300, "program.csv": 10}
for program, count in ((kills, "4"), (campaign_faults, "1")):
    sys.argv = [program.__name__, "--count", count, "--seed", "1", "--out", program.__name__ + ".json"]
    program.harness.guarded(program.program)
"""
"""With small tables and given scales: whether files are whole does not depend on them."""
TESTS, BENCHMARKS = Path(__file__).parents[1], Path(__file__).parents[2] / "benchmarks"
FOLDERS = [BENCHMARKS / "robustness", BENCHMARKS / "real_robots", TESTS / "banks"]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder, env = tmp_path_factory.mktemp("kills"), environment()
    env["PYTHONPATH"] = os.pathsep.join([*map(str, FOLDERS), env["PYTHONPATH"]])
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=env, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return {name: json.loads((folder / f"{name}.json").read_text())["records"] for name in ("kills", "campaign_faults")}


def test_killed_commands_leave_whole_files(records: dict[str, Any]) -> None:
    assert [record["command"] for record in records["kills"]] == ["fit", "predict", "correct", "export"]
    assert sum(record["killed"] + record["ended_before"] for record in records["kills"]) == 4
    for record in records["kills"]:
        assert (record["lost"], record["damaged"], record["failed_again"]) == (0, 0, 0)


def test_campaigns_under_faults_lose_no_row(records: dict[str, Any]) -> None:
    faults = ["kill", "full disk", "cut pipe", "half a line", "two writers"]
    assert [record["fault"] for record in records["campaign_faults"]] == faults
    assert sum(record["faults"] for record in records["campaign_faults"]) >= 3  # two may come too late
    for record in records["campaign_faults"]:
        assert (record["lost"], record["twice"], record["torn"], record["failed"]) == (0, 0, 0, 0), record
