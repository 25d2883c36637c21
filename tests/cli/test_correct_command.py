"""`diffeo-calib correct`: programs of commands and of targets, read back and checked against the model."""

import csv
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_bank import VALIDATOR, Command
from deformation_bank import model_of
from kind_bank import table_rows
from product_bank import Case
from table_bank import held
from torch import Tensor
from two_arms_bank import HANDS
from two_arms_bank import robot as two_arms

import diffeo_calib as dc
from diffeo_calib.kinematics.tool import tool_transform
from diffeo_calib.measurements.poses import angle_between, rotation_matrices, transforms

EULER = ["--rotation", "rx,ry,rz", "--convention", "ZYX", "--rotation-angle", "deg"]
UNITS = ["--length", "mm", "--angle", "deg", "--sep", ";", "--decimal", ","]
TOOL = [30.0, -20.0, 150.0, 10.0, 20.0, -30.0]  # mm, and a rotation vector in deg
Rows = list[dict[str, str]]


read = partial(table_rows, sep=";")


def write(path: Path, rows: Rows) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), delimiter=";")
        writer.writeheader()
        writer.writerows(rows)


def written(value: float) -> str:
    return repr(value).replace(".", ",")


def table(rows: Rows, names: list[str]) -> np.ndarray:
    return np.array([[float(row[name].replace(",", ".")) for name in names] for row in rows])


def poses_of(rows: Rows, prefix: str) -> Tensor:
    """mm and rotation vectors in deg -> (N, 4, 4) m."""
    place = torch.from_numpy(table(rows, [prefix + axis for axis in "xyz"])) / 1e3
    turn = table(rows, [f"{prefix}r{axis}" for axis in "xyz"])
    return transforms(rotation_matrices(turn, "rotvec", angle="deg"), place)


@pytest.fixture
def model(arm: Case, tmp_path: Path) -> dc.CalibratedKinematics:
    dc.save(arm.model, tmp_path / "model.safetensors")
    return arm.model


@pytest.fixture
def program(arm: Case, tmp_path: Path) -> Path:
    q = np.degrees(arm.train.q[:12].numpy()) + np.random.default_rng(0).uniform(-1, 1, (12, 6))
    joints = [dict(zip(arm.robot.joint_names, map(written, row), strict=True)) for row in q.round(6).tolist()]
    write(tmp_path / "program.csv", [{"line": str(10 * k), **own, "note": f"a;b {k}"} for k, own in enumerate(joints)])
    return tmp_path / "program.csv"


def test_a_program_of_commands(model: dc.CalibratedKinematics, program: Path, command: Command) -> None:
    """At the new commands the model is where the nominal robot was at the old ones."""
    output, tool = program.with_name("corrected.csv"), ",".join(map(str, TOOL))
    done = command.ran("correct", program.with_name("model.safetensors"), program, *UNITS, "--tool", tool, "-o", output)
    before, after, robot = read(program), read(output), model.robot
    names = list(robot.joint_names)
    added = [f"command_{name}" for name in ("x", "y", "z", "rx", "ry", "rz")]
    added += ["status", "miss_mm", "angle_miss_deg", "std_mm"]
    assert list(after[0]) == ["line", *names, "note", *added]
    assert [(row["line"], row["note"]) for row in after] == [(row["line"], row["note"]) for row in before]
    old, new = (torch.from_numpy(np.radians(table(rows, names))) for rows in (before, after))
    reached = torch.tensor([row["status"] == "reached" for row in after])
    assert int(reached.sum()) > 8
    turn = rotation_matrices([TOOL[3:]], "rotvec", angle="deg")
    frame = transforms(turn, torch.tensor([TOOL[:3]], dtype=torch.float64) / 1e3)[0]
    intended, found = robot(old) @ frame, model.tool_poses(new, frame)
    distance = (intended - found)[:, :3, 3].norm(dim=1)
    assert float(distance[reached].max()) < 1e-9
    assert float(angle_between(intended[:, :3, :3], found[:, :3, :3])[reached].max()) < 1e-9
    np.testing.assert_allclose(table(after, ["miss_mm"])[:, 0], 1e3 * distance.numpy(), atol=1e-8)
    torch.testing.assert_close(poses_of(after, "command_"), robot(new) @ frame, rtol=0, atol=1e-12)
    covariance = model.predict_tool_poses(new, frame)[1].diagonal(dim1=1, dim2=2)[:, :3].sum(1)
    np.testing.assert_allclose(table(after, ["std_mm"])[:, 0], 1e3 * covariance.sqrt().numpy(), rtol=1e-6)
    assert f"in the frame of {robot.base}" in done.out
    assert f"12 rows: {int(reached.sum())} reached" in done.out
    largest = float((robot(new) @ frame - robot(old) @ frame)[:, :3, 3].norm(dim=1).max())
    assert f"{1e3 * largest:.4f}" in done.out
    assert f"{float((new - old)[:, 0].abs().max().rad2deg()):.4f}" in done.out


@pytest.mark.parametrize(("frame", "options"), [("base", []), ("measuring", []), ("base", EULER)])
def test_targets(frame: str, options: list[str], model: Any, program: Path, command: Command) -> None:
    """The poses that one run commands are targets of the next, in both frames and in another convention."""
    path, output, names = program.with_name("model.safetensors"), program.with_name("c.csv"), model.robot.joint_names
    command.ran("correct", path, program, *UNITS, "-o", output)
    first = read(output)
    wanted = poses_of(first, "command_")
    command.ran("correct", path, program, *UNITS, *options[2:4], "-o", output)
    turns = [[own for name, own in row.items() if "command" in name][3:] for row in read(output)]
    seen = wanted if frame == "base" else model.geometry.base @ wanted
    rows = [{name: row[name] for name in names} for row in first]
    for row, pose, turn in zip(rows, seen, turns, strict=True):
        places = map(written, (1e3 * pose[:3, 3]).tolist())
        row |= dict(zip(("x", "y", "z", "rx", "ry", "rz"), (*places, *turn), strict=True))
    write(program.with_name("targets.csv"), rows)
    given = [*UNITS, "--position", "x,y,z", *options, "--frame", frame, "--limit", 2.0]
    command.ran("correct", path, program.with_name("targets.csv"), *given, "-o", output)
    second = read(output)
    q = torch.from_numpy(np.radians(table(second, list(names))))
    reached = torch.tensor([row["status"] == "reached" for row in second])
    assert int(reached.sum()) > 8
    away = (model.tool_poses(q) - wanted)[reached]
    assert float((away if options else away[:, :3, 3:]).abs().max()) < 1e-9
    assert ("angle_miss_deg" in second[0]) == bool(options)


def test_a_target_at_the_origin_stays_and_one_without_numbers_is_named(tmp_path: Path, command: Command) -> None:
    both = model_of(two_arms(tmp_path), dc.RK4(1))
    dc.save(both, tmp_path / "m")
    header, words = ",".join([*both.robot.joint_names, "x,y,z"]), [*UNITS_OF_HANDS, "--tip", "left"]
    given = ["correct", tmp_path / "m", tmp_path / "p.csv", *words, "--position", "x,y,z", "-o", tmp_path / "c.csv"]
    (tmp_path / "p.csv").write_text(f"{header}\n0,0,0,0,0,0,0,0\n0,0,0,0,0,900,1,2\n.1,0,0,0,0,910,1,2\n")
    assert "3 rows:" in command(*given).out
    (tmp_path / "p.csv").write_text(f"{header}\n0,0,0,0,0,,,\n0,0,0,0,0,900,1,2\n")
    assert "line 2: expected a target, got empty cells" in command(*given).error


@pytest.mark.usefixtures("model")
def test_a_path_and_rows_that_miss(model: dc.CalibratedKinematics, program: Path, command: Command) -> None:
    """Far targets and commands beyond the limits: the others are corrected, and the exit code is 0."""
    output = program.with_name("c")
    done = command.ran("correct", program.with_name("model.safetensors"), program, *UNITS, "--rate", 0.01, "-o", output)
    names = list(model.robot.joint_names)
    change = np.diff(table(read(output), names) - table(read(program), names), axis=0)
    assert np.abs(change).max() <= 0.01 + 1e-9
    assert any("the corrections of the path jump" in line for line in done.warnings)
    rows, first = read(program), read(output)
    names = [name for name in rows[0] if name not in ("line", "note")]
    turned = [
        {**row, names[1]: written(360.0 * (k % 3 - 1) + float(row[names[1]].replace(",", ".")))}
        for k, row in enumerate(rows)
    ]
    write(program, turned)
    done = command.ran("correct", program.with_name("model.safetensors"), program, *UNITS, "--rate", 0.01, "-o", output)
    assert f"{names[1]}: whole turns beyond the limits were taken off" in done.out
    np.testing.assert_allclose(table(read(output), names), table(first, names), rtol=0, atol=1e-6)
    rows[3][names[1]] = "900,0"
    write(program, rows)
    output, model = program.with_name("c"), program.with_name("model.safetensors")
    done = command.ran("correct", model, program, *UNITS, "--limit", 0.001, "-o", output)
    after = read(output)
    assert (after[3]["status"], after[3][names[0]], after[3]["command_x"], after[3]["miss_mm"]) == ("limit", "", "", "")
    assert "line 5: limit, no command is allowed: it starts beyond a joint's limit" in done.out
    assert "line 2: unreachable with corrections within --limit, misses by" in done.out
    assert any("most targets are farther from their commands" in line for line in done.warnings)
    assert "and 2 more; see the column `status`" in done.out
    moved = table([after[0]], names) - table([rows[0]], names)
    assert 0.0009 < np.abs(moved).max() <= 0.001 + 1e-9
    done = command.ran("correct", model, program, *UNITS, "--tool", "0,0,3000", "-o", output)
    assert any("--tool is 3 m long, more than the robot reaches" in line for line in done.warnings)


def test_from_the_measured_frame(posed: Case, program: Path, command: Command) -> None:
    model, output = posed.model, program.with_name("corrected.csv")
    dc.save(model, program.with_name("posed"))
    given = "--tool", "measured:30,-20,150"
    command.ran("correct", program.with_name("posed"), program, *UNITS, *given, "-o", output)
    names = list(model.robot.joint_names)
    before, after = (torch.from_numpy(np.radians(table(read(path), names))) for path in (program, output))
    tool = model.measured_frame @ tool_transform([0.03, -0.02, 0.15])
    reached = torch.tensor([row["status"] == "reached" for row in read(output)])
    assert int(reached.sum()) >= 5
    expected = (model.robot(before) @ tool)[reached]
    torch.testing.assert_close(model.tool_poses(after, tool)[reached], expected, rtol=0, atol=1e-8)


UNITS_OF_HANDS = ["--length", "mm", "--angle", "rad", "--limit", 20.0]
TOOLS = [*(word for hand in HANDS for word in ("--tip", hand)), "--tool", "0,0,100", "--tool", "20,50,0"]
PLACES = torch.tensor([[0.0, 0.0, 0.1], [0.02, 0.05, 0.0]], dtype=torch.float64)


def test_targets_and_commands_of_both_hands(tmp_path: Path, command: Command) -> None:
    """Positions from the table, one of them empty; and nominal poses of both."""
    arms = model_of(two_arms(tmp_path), dc.RK4(1))
    path, program, output = tmp_path / "arms.safetensors", tmp_path / "both.csv", tmp_path / "out.csv"
    dc.save(arms, path)
    names, q = list(arms.robot.joint_names), np.random.default_rng(3).uniform(-1, 1, (6, 5))
    wanted = torch.stack([arms.tool_poses(q, PLACES[k], tip=hand)[:, :3, 3] for k, hand in enumerate(HANDS)], dim=1)
    cells: list[list[Any]] = [[*a, *b] for a, b in zip(q.tolist(), (1e3 * wanted).flatten(1).tolist(), strict=True)]
    cells[2][8:] = ["", "", ""]
    columns = [f"{hand}_{axis}" for hand in HANDS for axis in "xyz"]
    program.write_text("\n".join([",".join([*names, *columns]), *(",".join(map(str, row)) for row in cells)]))
    targets = ["--position", "left_x,left_y,left_z", "--position", "right_x,right_y,right_z"]
    given = ["correct", path, program, *UNITS_OF_HANDS, *TOOLS, "-o", output, "--json", tmp_path / "out.json"]
    done = command.ran(*given, *targets, silent=True)
    results = json.loads((tmp_path / "out.json").read_text())
    VALIDATOR.validate(results)
    misses, empty = results["results"]["misses"], [k == 2 for k in range(6)]
    assert [miss is None for miss in misses["right"]["miss_m"]] == empty
    assert misses["left"]["angle_miss_deg"] is None
    assert "6 rows: 6 reached" in done.out
    assert [row["miss_right_mm"] == "" for row in table_rows(output)] == empty
    done = command.ran("correct", path, program, *UNITS_OF_HANDS, "--tip", "left", "-o", output)
    assert "positions are corrected, without orientations: 5 joints cannot hold every orientation" in done.out
    assert "angle_miss_rad" not in table_rows(output)[0]
    done = command.ran(*given)
    assert "a robot with 5 joints cannot hold every orientation of 2 tools" in done.err
    goals = arms.robot(torch.from_numpy(q)) @ torch.stack([tool_transform(place) for place in PLACES])
    expected = dc.compensate(arms, goals, q, tool=PLACES, bound=np.radians(20.0))
    after = table_rows(output)
    np.testing.assert_allclose(table(after, names), expected.q.numpy(), rtol=0, atol=1e-12)
    for k, hand in enumerate(HANDS):
        found = table(after, [f"miss_{hand}_mm", f"angle_miss_{hand}_rad"])
        own = torch.stack([1e3 * expected.miss[:, k], held(expected.angle_miss)[:, k]], 1)
        np.testing.assert_allclose(found, own.numpy(), rtol=1e-9, atol=1e-9)
