"""Every command and every snippet of the README runs, on files of the names that it uses."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import get_ur10_data
import pytest
from command_bank import Command
from product_bank import simulated, simulated_poses
from trackerless_bank import write_socket_table, write_wire_table

from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
COMMANDS = [
    " ".join(command.split())
    for command in re.findall(r"^    (diffeo-calib (?:.*\\\n)*.*)$", TEXT.replace("\\\n", " "), re.MULTILINE)
]
MOST_LINES = 259


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated arm and tables of its measurements under the names of the README."""
    place = tmp_path_factory.mktemp("readme")
    arm, train, test = simulated(40)
    arm.write_urdf(place / "robot.urdf")
    names, table = arm.nominal.joint_names, TableFormat("mm", "deg")
    for name, data in (
        ("measurements", train),
        ("other", test[:60]),
        ("joints", test[:60]),
        ("program", test[:40]),
        ("new", test[:15]),
    ):
        write_measurements(place / f"{name}.csv", data.with_joint_names(names), table)
    write_socket_table(place / "block.csv", arm, "01", 0)
    write_wire_table(place / "wire.csv", arm, 0)
    posed = simulated_poses(30)[1]
    rotation = replace(table, rotation=["rx", "ry", "rz"], convention="XYZ", rotation_angle="deg")
    write_measurements(place / "poses.csv", posed, rotation)
    source = os.environ.get("DIFFEO_CALIB_DATA")
    if source:
        get_ur10_data.main([str(place / "data"), "--from", str(Path(source) / "ipa_ur10")])
    return place


def test_is_a_front_door() -> None:
    assert TEXT.count("\n") <= MOST_LINES
    assert len(SNIPPETS) == 3
    assert len(COMMANDS) == 15


def test_links_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)]+)\)", TEXT):
        assert (ROOT / target).is_file(), target
    for target in re.findall(r"(?<![\w/])((?:scripts|benchmarks|tests)/[\w./]+\w)", TEXT):
        assert (ROOT / target).exists(), target


@pytest.mark.slow
def test_snippets_run_one_after_the_other(folder: Path) -> None:
    code = "\n".join(SNIPPETS)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "converged" in done.stdout


@pytest.mark.filterwarnings("ignore:the place of the marker on 'tool0' along")  # the tool's x axis is always vertical
@pytest.mark.slow
def test_commands_run_one_after_the_other(folder: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the accuracy of the UR10 is what the text says."""
    monkeypatch.chdir(folder)
    found = re.search(r"632 poses; ([0-9.]+) mm RMS on the held-out rows of this split, geometry ([0-9.]+)", TEXT)
    assert found is not None
    ran = 0
    for line in COMMANDS:
        program, *arguments = shlex.split(line)
        assert program == "diffeo-calib"
        real = any(word.startswith("data/") for word in arguments)
        if real and not (folder / "data").is_dir():
            continue
        done = command(*arguments)
        assert done.code == 0, done.err
        if real:
            rms = [done.numbers(stage, "190 held out")[0] for stage in ("diffeomorphic", "geometry")]
            assert [f"{value:.3f}" for value in rms] == [found[1], found[2]]
        ran += 1
    assert ran >= len(COMMANDS) - 1
