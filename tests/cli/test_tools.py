"""Tool centre points of `correct` and `export`: in the tip's frame, or in the measured frame of a model of poses."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch
from command_bank import Command
from product_bank import Case

import diffeo_calib as dc

TOOL = [0.03, -0.02, 0.15]


@pytest.fixture
def files(posed: Case, tmp_path: Path) -> Path:
    """A model of poses and a program of commands."""
    dc.save(posed.model, tmp_path / "model.safetensors")
    with (tmp_path / "program.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(posed.model.robot.joint_names)
        rows.writerows(posed.test.q[:8].tolist())
    return tmp_path


def arguments(folder: Path, *more: str) -> list[str]:
    program = [str(folder / "model.safetensors"), str(folder / "program.csv"), "-o", str(folder / "corrected.csv")]
    return ["correct", *program, "--length", "m", "--angle", "rad", *more]


def test_from_the_measured_frame(posed: Case, files: Path, command: Command) -> None:
    model, text = posed.model, ",".join(map(str, TOOL))
    done = command(*arguments(files, "--tool", f"measured:{text}"))
    assert done.code == 0, done.err
    with (files / "corrected.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    q = torch.tensor([[float(row[name]) for name in model.robot.joint_names] for row in rows], dtype=torch.float64)
    tool = torch.eye(4, dtype=torch.float64)
    tool[:3, 3] = torch.tensor(TOOL, dtype=torch.float64)
    tool = model.measured_frame @ tool
    reached = torch.tensor([row["status"] == "reached" for row in rows])
    assert int(reached.sum()) >= 5
    expected = (posed.model.robot(posed.test.q[:8]) @ tool)[reached]
    torch.testing.assert_close(model.tool_poses(q, tool)[reached], expected, rtol=0, atol=1e-8)


def test_bad_tools(arm: Case, files: Path, command: Command) -> None:
    dc.save(arm.model, files / "model.safetensors")
    points = command(*arguments(files, "--tool", "measured:0,0,0.1"))
    assert points.code == 1
    assert "calibrated with points, which have no measured frame" in points.err
    alone = command("export", str(files / "model.safetensors"), "--urdf", str(files / "x.urdf"), "--tool", "0,0,0.1")
    assert alone.code == 1
    assert "--tool without --c or --torch or --onnx" in alone.err
    assert not (files / "x.urdf").exists()


def test_a_header_counts_as_an_output(arm: Case, files: Path, command: Command) -> None:
    dc.save(arm.model, files / "model.safetensors")
    done = command("export", str(files / "model.safetensors"), "--c", str(files / "u.c"), "--dh", str(files / "u.h"))
    assert done.code == 1
    assert "is the file of" in done.err
    assert not (files / "u.c").exists()


def test_tools_in_the_wrong_unit(arm: Case, files: Path, command: Command) -> None:
    dc.save(arm.model, files / "model.safetensors")
    long = command(*arguments(files, "--tool", "0,0,3"))
    assert any("--tool is 3 m long, more than the robot reaches" in line for line in long.warnings)
    wrong = command(*arguments(files, "--tool", "0,0,150"))
    assert wrong.code == 1
    assert "--tool is 150 m long, more than the robot reaches" in wrong.err
    absurd = command(*arguments(files, "--tool", "0,0,1e30"))
    assert absurd.code == 1
    assert "more than the robot reaches" in absurd.err
