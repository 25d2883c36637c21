"""`fit` and `evaluate` on tables of measured positions and of rows in sockets, and lines that are neither or both."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch
from command_bank import Command
from simulated_sockets import rest_in_sockets

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm

UNITS = ["--length", "mm", "--angle", "rad"]
ROBOT = ["--robot", "arm.urdf", "--base", "base_link", "--tip", "flange", *UNITS]
SOCKETS = ["--socket", "place,socket", "--distance", "a,b=50", "--distance-std", "0.01"]
POSITION = ["--position", "x,y,z"]
TRACKED = 11
"""Too few to search for scales: defaults are quick."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table of 11 positions and 2 places x 2 sockets x 3 rows, shuffled, and its robot."""
    where, arm = tmp_path_factory.mktemp("mixture"), SimulatedArm(seed=1, markers=2)
    rows = rest_in_sockets(arm, seed=1, places=2, rows=3)
    arm.write_urdf(where / "arm.urdf")
    q, points = arm.measure(TRACKED, seed=3)
    seen = zip(q.tolist(), (1e3 * points[:, 1]).tolist(), strict=True)
    lines = [["", "", *map(repr, angles), *map(repr, place)] for angles, place in seen]
    for angles, name in zip(rows.q.tolist(), rows.names, strict=True):
        place, socket = name.split("/")
        lines.insert(3, [f"spot {place}", "ab"[int(socket)], *map(repr, angles), "", "", ""])
    header = ["place", "socket", *arm.nominal.joint_names, "x", "y", "z"]
    (where / "t.csv").write_text("\n".join(map(",".join, [header, *lines])))
    return where


def read(path: Path | str = "t.csv", **options: object) -> dc.Measurements:
    robot = dc.load_urdf("arm.urdf", "base_link", "flange")
    given = {"socket": ["place", "socket"], "length": "mm", "angle": "rad"} | options
    return dc.read_measurements(path, robot, ["x", "y", "z"], **given)  # pyright: ignore[reportArgumentType]


def test_other_commands_name_the_ball_and_what_was_measured(
    folder: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    model = dc.calibrate(dc.load_urdf("arm.urdf", "base_link", "flange"), read()).model
    dc.save(model, "other.safetensors")
    assert command("predict", "other.safetensors", "t.csv", *UNITS, "-o", "p.csv").code == 0
    header = Path("p.csv").read_text().splitlines()[0].split(",")[6:]
    prefixes = ("marker_", "ball_")
    assert header == [f"{prefix}{kind}{axis}" for prefix in prefixes for kind in ("", "std_") for axis in "xyz"]
    places = [f"{prefix}{axis}" for prefix in prefixes for axis in "xyz"]
    assert list(model.to_frame(model.configurations[:2]).columns) == [*places, *(f"std_{name}" for name in places)]
    planned = command("plan", "other.safetensors", "-n", 3, "--draw", 20, *UNITS, "-o", "next.csv")
    assert planned.code == 0, planned.err
    assert Path("next.csv").read_text().splitlines()[0].endswith(",rank,device")
    assert "socket 1: " in planned.out
    assert "held out" not in planned.out
    corrected = command("correct", "other.safetensors", "p.csv", *UNITS, "-o", "c.csv")
    assert corrected.code == 0, corrected.err
    text = " ".join(corrected.out.split())
    said = re.search(r"robot's base to ([\d.]+) mm.* on its flange.* to ([\d.]+) mm", text)
    assert said is not None
    assert 0 < float(said[2]) < 0.5 * float(said[1])


def test_set_ups_are_evaluated_each_in_its_place(
    folder: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The device moves by 100 mm before the rows of b: errors stay what they are, and so does the spread in sockets."""
    monkeypatch.chdir(folder)
    model = "placed.safetensors"
    assert command("fit", "t.csv", *ROBOT, *POSITION, *SOCKETS, "--holdout", "0", "-o", model).code == 0
    header, *lines = (folder / "t.csv").read_text().split("\n")
    moved = []
    for number, line in enumerate(lines):
        cells, day = line.split(","), "" if line.startswith("spot") else "ab"[number % 2]
        if day == "b":
            cells[-3] = repr(float(cells[-3]) + 100.0)
        moved.append(",".join([*cells, day]))
    (folder / "moved.csv").write_text("\n".join([f"{header},day", *moved]))
    written = []
    for options in (["t.csv"], ["moved.csv", "--session", "day"]):
        done = command("evaluate", model, *options, *POSITION, *SOCKETS, *UNITS, "--json", "e.json")
        assert done.code == 0, done.err
        written.append(json.loads(Path("e.json").read_text())["results"])
    assert "the frames of 2 sessions were found from these rows, 12 numbers in all" in " ".join(done.out.split())
    still, placed = written
    assert placed["kinds"]["socket"] == still["kinds"]["socket"]
    assert placed["errors"]["all"]["rows"] == TRACKED
    assert placed["errors"]["all"]["rms_m"] <= still["errors"]["all"]["rms_m"]
    a, b = (torch.tensor(placed["session_transforms"][name], dtype=torch.float64) for name in "ab")
    torch.testing.assert_close(
        b[:3, 3] - a[:3, 3], torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64), rtol=0, atol=2e-3
    )
