"""A column of payloads on the command line: fit, evaluate, predict, correct, export, report, and the model file."""

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from command_bank import Command
from product_bank import with_usual_scales

import diffeo_calib as dc
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import SimulatedArm

pytestmark = pytest.mark.slow  # several calibrations

UNITS = ("--length", "mm", "--angle", "deg")
POSITION = ("--position", "x,y,z", *UNITS)
ROWS = 40


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Robot, a table with a column "kg", and a model of it."""
    place = tmp_path_factory.mktemp("payload")
    arm = SimulatedArm(seed=2)
    arm.write_urdf(place / "arm.urdf")
    masses = torch.from_numpy(np.random.default_rng(0).choice([0.0, 5.0, 10.0], ROWS))
    data = dc.Measurements(*arm.measure(ROWS, seed=1, payload=masses), arm.nominal.joint_names).with_payload(masses)
    write_measurements(place / "t.csv", data, TableFormat("mm", "deg", payload="kg"))
    dc.save(with_usual_scales(arm.nominal, data).model, place / "m.safetensors")
    return place


@pytest.mark.usefixtures("given_scales", "undrawn")
def test_fit_takes_the_column(folder: Path, tmp_path: Path, command: Command) -> None:
    robot = ("--robot", folder / "arm.urdf", "--base", "base_link", "--tip", "flange")
    files = ("-o", tmp_path / "m.safetensors", "--report", tmp_path / "r.html")
    done = command("--verbose", "fit", folder / "t.csv", *robot, *POSITION, *files, "--payload", "kg")
    assert done.code == 0, done.err
    assert "payload" in done.out
    assert "payload" in (tmp_path / "r.html").read_text(encoding="utf-8")
    report = ("report", tmp_path / "m.safetensors", "--data", folder / "t.csv", "-o", tmp_path / "n.html", *POSITION)
    assert command(*report, "--payload", "kg").code == 0
    refused = command(*report)
    assert refused.code == 1
    assert "calibrated with payloads" in refused.err


def test_evaluate_and_predict_take_the_column(folder: Path, command: Command) -> None:
    done = command("evaluate", folder / "m.safetensors", folder / "t.csv", *POSITION, "--payload", "kg")
    assert done.code == 0, done.err
    files = folder / "m.safetensors", folder / "t.csv", *UNITS, "-o", folder / "p.csv"
    assert command("predict", *files, "--payload", "kg").code == 0
    written = np.genfromtxt(folder / "p.csv", delimiter=",", names=True)
    arm = SimulatedArm(seed=2).nominal
    data = dc.read_measurements(folder / "t.csv", arm, ["x", "y", "z"], length="mm", angle="deg", payload="kg")
    places = np.stack([written[axis] for axis in "xyz"], 1) / 1e3
    away = np.linalg.norm(places - data.points[:, 0].numpy(), axis=1)
    assert np.sqrt((away**2).mean()) < 2e-4
    for name, without in (("evaluate", POSITION), ("predict", (*UNITS, "-o", folder / "q.csv"))):
        refused = command(name, folder / "m.safetensors", folder / "t.csv", *without)
        assert refused.code == 1
        assert "calibrated with payloads" in refused.err


def test_programs_carry_the_mass_that_is_named(folder: Path, command: Command) -> None:
    out = "-o", folder / "c.csv"
    refused = command("correct", folder / "m.safetensors", folder / "t.csv", *UNITS, *out)
    assert refused.code == 1
    assert "--payload" in refused.err
    done = command("correct", folder / "m.safetensors", folder / "t.csv", *UNITS, *out, "--payload", "10")
    assert done.code == 0, done.err
    laden = dc.load(folder / "m.safetensors").with_payload(10.0)  # pyright: ignore[reportAttributeAccessIssue]
    arm = SimulatedArm(seed=2).nominal
    data = dc.read_measurements(folder / "t.csv", arm, ["x", "y", "z"], length="mm", angle="deg")
    with (folder / "c.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    held = torch.tensor([row["status"] == "reached" for row in rows])
    assert int(held.sum()) > ROWS / 2
    q = torch.tensor([[float(row[name]) for name in arm.joint_names] for row in rows], dtype=torch.float64).deg2rad()
    reached = laden.tool_poses(q[held])
    torch.testing.assert_close(reached[:, :3, 3], arm(data.q[held])[:, :3, 3], rtol=0, atol=1e-6)
    export = command("export", folder / "m.safetensors", "--c", folder / "robot.c", "--payload", "10")
    assert export.code == 0, export.err


def test_masses_that_cannot_be(folder: Path, command: Command, tmp_path: Path) -> None:
    text = (folder / "t.csv").read_text().splitlines()
    column = text[0].split(",").index("kg")
    cells = text[2].split(",")
    cells[column] = "-5"
    (tmp_path / "t.csv").write_text("\n".join([*text[:2], ",".join(cells), *text[3:]]) + "\n")
    arguments = folder / "m.safetensors", tmp_path / "t.csv", *POSITION, "--payload", "kg"
    done = command("evaluate", *arguments)
    assert done.code == 1
    assert "line 3, column 'kg': expected a mass of 0 or more, got '-5'" in done.err
    refused = command("recalibrate", folder / "m.safetensors", folder / "t.csv", *POSITION, "-o", tmp_path / "n.st")
    assert refused.code == 1
    assert "with payloads" in refused.err
