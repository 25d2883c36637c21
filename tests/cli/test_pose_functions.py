"""Functions of one's own in place of a robot: `--robot-pose A,B,...=FILE.py:NAME`."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest
import torch
from command_bank import Command
from commanded_bank import cells, without_frames, write_columns
from documentation_bank import write_commanded_tables
from torch.testing import assert_close


@pytest.fixture(scope="module")
def delta(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a delta robot, its table and its program."""
    place = tmp_path_factory.mktemp("delta")
    write_commanded_tables(place)
    return place


MEASURED = ["--position", "x,y,z", "--length", "mm", "--angle", "deg"]


def test_a_function_in_place_of_a_robot(
    delta: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(delta)
    pose, model = ["--robot-pose", "q1,q2,q3=my_delta.py:kinematics"], tmp_path / "m.safetensors"
    done = command("fit", "delta.csv", *pose, *MEASURED, "--json", tmp_path / "f.json", "-o", model)
    assert done.code == 0, done.error
    done = command("evaluate", model, "delta.csv")
    assert done.code == 1
    assert "type it again, a model file starts no program: --robot-pose q1,q2,q3=my_delta.py:kinematics" in done.error
    done = command("predict", model, "delta.csv", *pose, "-o", tmp_path / "p.csv")
    assert done.code == 0, done.error
    done = command("predict", model, "delta.csv", "--robot-pose", "q1,q2,q3", "-o", tmp_path / "q.csv")
    assert "type it again, a model file starts no program" in done.error  # joint values are no places
    (header, *rows), (_, *measured) = cells(tmp_path / "p.csv"), cells(delta / "delta.csv")
    assert header[:6] == ["x", "y", "z", "predicted_x", "predicted_y", "predicted_z"]
    found = torch.tensor([[float(cell) for cell in row[:6]] for row in rows], dtype=torch.float64)
    q = torch.tensor([[float(cell) for cell in row[:3]] for row in measured], dtype=torch.float64)
    kinematics = runpy.run_path("my_delta.py")["kinematics"]
    nominal, exact = kinematics(q), 1.001 * kinematics(q + torch.tensor([0.1, -0.05, 0.08]))  # without noise
    assert_close(found[:, :3], nominal, rtol=0, atol=1e-6)
    assert float((found[:, 3:] - exact).norm(dim=1).mean()) < 0.2 * without_frames(nominal, exact)
    assert command("plan", model, "-n", "3", *pose, "-o", tmp_path / "n.csv").code == 0
    assert cells(tmp_path / "n.csv")[0] == ["x", "y", "z", "rank"]
    done = command("correct", model, "targets.csv", *pose, "-o", tmp_path / "c.csv")
    assert done.code == 0, done.error
    header, *rows = cells(tmp_path / "c.csv")
    assert {row[header.index("status")] for row in rows} == {"reached"}
    corrected = [[float(row[header.index(axis)]) for axis in "xyz"] for row in rows]
    assert "q1" not in header  # of the program before
    again = write_columns(tmp_path / "again.csv", x_y_z=torch.tensor(corrected, dtype=torch.float64))
    places = ["--robot-pose", "x,y,z", "--length", "mm", "--angle", "deg"]
    assert command("predict", model, again, *places, "-o", tmp_path / "a.csv").code == 0
    reached = [[float(cell) for cell in row[3:6]] for row in cells(tmp_path / "a.csv")[1:]]
    wanted = nominal[:5] - nominal[:5].mean(0)
    away = torch.tensor(reached, dtype=torch.float64)
    assert without_frames(wanted, away) < 0.05  # of the frame of the device


def test_a_campaign_file_names_a_function_beside_it(delta: Path, tmp_path: Path, command: Command) -> None:
    entries = {"csv": "delta.csv", "robot-pose": "q1,q2,q3=my_delta.py:kinematics", "position": "x,y,z"}
    lines = [f'{name} = "{value}"' for name, value in {**entries, "length": "mm", "angle": "deg"}.items()]
    (delta / "c.toml").write_text("\n".join(lines), encoding="utf-8")
    done = command("fit", delta / "c.toml", "-o", tmp_path / "m.safetensors")
    assert done.code == 0, done.error
    done = command("evaluate", tmp_path / "m.safetensors", delta / "delta.csv", *MEASURED)
    assert "type it again" in done.error
