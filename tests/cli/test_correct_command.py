"""`diffeo-calib correct`: programs of commands and of targets, read back and checked against the model."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import torch
from command_bank import Command, Site
from deformation_bank import model_of
from product_bank import Case
from table_bank import held
from torch import Tensor
from two_arms_bank import HANDS
from two_arms_bank import robot as two_arms

import diffeo_calib as dc
from diffeo_calib.cli.options import Targets
from diffeo_calib.cli.tables import of_robot, targets_of
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.tool import tool_transform
from diffeo_calib.measurements.poses import angle_between, rotation_matrices, transforms
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.reports.results import SCHEMA

UNITS = ["--length", "mm", "--angle", "deg", "--sep", ";", "--decimal", ","]
TOOL = [30.0, -20.0, 150.0, 10.0, 20.0, -30.0]  # mm, and a rotation vector in deg


def number(text: str) -> float:
    return float(text.replace(",", "."))


def cells(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file, delimiter=";"))


def table(rows: list[dict[str, str]], names: list[str]) -> np.ndarray:
    return np.array([[number(row[name]) for name in names] for row in rows])


def poses_of(rows: list[dict[str, str]], prefix: str) -> Tensor:
    """mm and rotation vectors in deg -> (N, 4, 4) m."""
    place = torch.from_numpy(table(rows, [prefix + axis for axis in "xyz"])) / 1e3
    turn = table(rows, [f"{prefix}r{axis}" for axis in "xyz"])
    return transforms(rotation_matrices(turn, "rotvec", angle="deg"), place)


def tool_frame() -> Tensor:
    turn = rotation_matrices([TOOL[3:]], "rotvec", angle="deg")
    return transforms(turn, torch.tensor([TOOL[:3]], dtype=torch.float64) / 1e3)[0]


@pytest.fixture
def program(site: Site, model: dc.CalibratedKinematics, tmp_path: Path) -> Path:
    """Commands around the measured ones, between columns that mean nothing here."""
    names, rng = model.robot.joint_names, np.random.default_rng(0)
    q = np.degrees(site.data.q[:12].numpy()) + rng.uniform(-1, 1, (12, 6))
    lines = [["line", *names, "note"]]
    lines += [
        [str(10 * k), *(f"{value:.6f}".replace(".", ",") for value in row), f"a;b {k}"] for k, row in enumerate(q)
    ]
    path = tmp_path / "program.csv"
    with path.open("w", newline="") as file:
        csv.writer(file, delimiter=";").writerows(lines)
    return path


@pytest.mark.slow
def test_a_program_of_commands(
    site: Site, model: dc.CalibratedKinematics, program: Path, tmp_path: Path, command: Command
) -> None:
    """At the new commands the model is where the nominal robot was at the old ones."""
    output, tool = tmp_path / "corrected.csv", ",".join(map(str, TOOL))
    done = command("correct", site.folder / "model.safetensors", program, *UNITS, "--tool", tool, "-o", output)
    assert done.code == 0, done.err
    before, after = cells(program), cells(output)
    names, robot = list(site.arm.nominal.joint_names), site.arm.nominal
    added = ["command_x", "command_y", "command_z", "command_rx", "command_ry", "command_rz"]
    added += ["status", "miss_mm", "angle_miss_deg", "std_mm"]
    assert list(after[0]) == ["line", *names, "note", *added]
    assert [(row["line"], row["note"]) for row in after] == [(row["line"], row["note"]) for row in before]
    old, new = (torch.from_numpy(np.radians(table(rows, names))) for rows in (before, after))
    reached = torch.tensor([row["status"] == "reached" for row in after])
    assert int(reached.sum()) > 8
    intended, found = robot(old) @ tool_frame(), model.tool_poses(new, tool_frame())
    distance = (intended - found)[:, :3, 3].norm(dim=1)
    assert float(distance[reached].max()) < 1e-9
    assert float(angle_between(intended[:, :3, :3], found[:, :3, :3])[reached].max()) < 1e-9
    np.testing.assert_allclose(table(after, ["miss_mm"])[:, 0], 1e3 * distance.numpy(), atol=1e-8)
    torch.testing.assert_close(poses_of(after, "command_"), robot(new) @ tool_frame(), rtol=0, atol=1e-12)
    covariance = model.predict_tool_poses(new, tool_frame())[1].diagonal(dim1=1, dim2=2)[:, :3].sum(1)
    np.testing.assert_allclose(table(after, ["std_mm"])[:, 0], 1e3 * covariance.sqrt().numpy(), rtol=1e-6)
    assert f"in the frame of {robot.base}" in done.out
    assert f"12 rows: {int(reached.sum())} reached" in done.out
    largest = float((robot(new) @ tool_frame() - robot(old) @ tool_frame())[:, :3, 3].norm(dim=1).max())
    assert f"{1e3 * largest:.4f}" in done.out
    assert f"{float((new - old)[:, 0].abs().max().rad2deg()):.4f}" in done.out


def test_a_program_of_targets(
    site: Site, model: dc.CalibratedKinematics, program: Path, tmp_path: Path, command: Command
) -> None:
    """The poses that one run commands are targets of the next, in both frames."""
    path, names = site.folder / "model.safetensors", list(site.arm.nominal.joint_names)
    assert command("correct", path, program, *UNITS, "-o", tmp_path / "first.csv").code == 0
    first = cells(tmp_path / "first.csv")
    for frame in ("base", "measuring"):
        wanted = poses_of(first, "command_")
        seen = wanted if frame == "base" else model.geometry.base @ wanted
        lines = [[*names, "x", "y", "z"]]
        for row, pose in zip(first, seen, strict=True):
            place = [repr(1e3 * float(value)).replace(".", ",") for value in pose[:3, 3]]
            lines.append([*(row[name] for name in names), *place])
        with (tmp_path / "targets.csv").open("w", newline="") as file:
            csv.writer(file, delimiter=";").writerows(lines)
        options = [*UNITS, "--position", "x,y,z", "--frame", frame, "--limit", 2.0]
        done = command("correct", path, tmp_path / "targets.csv", *options, "-o", tmp_path / "second.csv")
        assert done.code == 0, done.err
        second = cells(tmp_path / "second.csv")
        q = torch.from_numpy(np.radians(table(second, names)))
        reached = torch.tensor([row["status"] == "reached" for row in second])
        assert int(reached.sum()) > 8
        distance = (model.tool_poses(q) - wanted)[:, :3, 3].norm(dim=1)
        assert float(distance[reached].max()) < 1e-9
        assert "angle_miss_deg" not in second[0]


@pytest.mark.filterwarnings("ignore::diffeo_calib.common.errors.DiffeoCalibWarning")
def test_a_target_at_the_origin_stays_and_one_without_numbers_is_named(tmp_path: Path) -> None:
    arm, path = dc.from_dh([dc.DHRow(0.1, 0.2, 0.3, 0.4)] * 2, names=["a", "b"]), tmp_path / "p.csv"
    read = path, of_robot(TableFormat("mm", "deg"), arm), Targets(position=["x,y,z"]), 1
    path.write_text("a,b,x,y,z\n1,2,0,0,0\n3,4,900,1,2\n5,6,910,1,2\n7,8,920,1,2\n")
    found = targets_of(*read)
    assert found is not None
    assert found[:2, 0].tolist() == [[0.0, 0.0, 0.0], [0.9, 0.001, 0.002]]
    path.write_text("a,b,x,y,z\n1,2,,,\n3,4,900,1,2\n")
    with pytest.raises(InputError, match="line 2: expected a target, got empty cells"):
        targets_of(*read)


def test_target_poses_in_another_convention(site: Site, program: Path, tmp_path: Path, command: Command) -> None:
    path = site.folder / "model.safetensors"
    assert command("correct", path, program, *UNITS, "--convention", "ZYX", "-o", tmp_path / "first.csv").code == 0
    turns = "command_euler1,command_euler2,command_euler3"
    text = (tmp_path / "first.csv").read_text()
    for name in ("status", "miss", "std"):
        text = text.replace(name, f"was_{name}")
    (tmp_path / "targets.csv").write_text(text.replace("command_", "goal_"))
    options = [*UNITS, "--position", "goal_x,goal_y,goal_z", "--rotation", turns.replace("command", "goal")]
    options += ["--convention", "ZYX", "--rotation-angle", "deg", "--limit", "3"]
    done = command("correct", path, tmp_path / "targets.csv", *options, "-o", tmp_path / "second.csv")
    assert done.code == 0, done.err
    assert sum(row["status"] == "reached" for row in cells(tmp_path / "second.csv")) > 8


def test_rows_that_miss_are_listed(site: Site, program: Path, tmp_path: Path, command: Command) -> None:
    """Far targets and commands beyond the limits: the others are corrected, and the exit code is 0."""
    names = list(site.arm.nominal.joint_names)
    rows = cells(program)
    rows[3][names[1]] = "900,0"
    with program.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), delimiter=";")
        writer.writeheader()
        writer.writerows(rows)
    done = command(
        "correct", site.folder / "model.safetensors", program, *UNITS, "--limit", 0.001, "-o", tmp_path / "c"
    )
    assert done.code == 0
    after = cells(tmp_path / "c")
    assert (after[3]["status"], after[3][names[0]], after[3]["command_x"], after[3]["miss_mm"]) == ("limit", "", "", "")
    assert "line 5: limit, no command is allowed: it starts beyond a joint's limit" in done.out
    assert "line 2: unreachable with corrections within --limit, misses by" in done.out
    assert any("most targets are farther from their commands" in line for line in done.warnings)
    assert "and 2 more; see the column `status`" in done.out
    moved = table([after[0]], names) - table([rows[0]], names)
    assert 0.0009 < np.abs(moved).max() <= 0.001 + 1e-9


def test_a_path(site: Site, program: Path, tmp_path: Path, command: Command) -> None:
    done = command("correct", site.folder / "model.safetensors", program, *UNITS, "--rate", 0.01, "-o", tmp_path / "c")
    assert done.code == 0
    names = list(site.arm.nominal.joint_names)
    change = np.diff(table(cells(tmp_path / "c"), names) - table(cells(program), names), axis=0)
    assert np.abs(change).max() <= 0.01 + 1e-9
    assert any("the corrections of the path jump" in line for line in done.warnings)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--tool", "1,2"], "--tool 1,2: expected X,Y,Z, or 6 numbers with the rotation as 'rotvec'"),
        (["--tool", "1,2,x"], "--tool 1,2,x: expected X,Y,Z"),
        (["--tool", "1,2,3,1,1,1,1", "--convention", "quat_xyzw"], "--tool: expected a quaternion of length 1"),
        (["--frame", "measuring"], "--frame measuring: the nominal poses of commands are in the robot's base"),
        (["--limit", "0"], "--limit: expected a number above 0"),
        (["--rate", "-1"], "--rate: expected a number above 0"),
        (["--rotation", "a,b,c"], "--rotation without --position"),
        (["--position", "x,y,z"], "no column ['x', 'y', 'z']"),
    ],
)
def test_wrong_options(options: list[str], message: str, site: Site, program: Path, command: Command) -> None:
    output = program.with_name("c.csv")
    done = command("correct", site.folder / "model.safetensors", program, *UNITS, *options, "-o", output)
    assert done.code == 1
    assert message in done.error
    assert not output.exists()


def recorded_misses(path: Path) -> dict[str, Any]:
    """Of a file of --json, which is as its schema says."""
    written = json.loads(path.read_text())
    jsonschema.validate(written, SCHEMA)
    return written["results"]["misses"]


UNITS_OF_HANDS = ["--length", "mm", "--angle", "rad", "--limit", 20.0]
TOOLS = [*(word for hand in HANDS for word in ("--tip", hand)), "--tool", "0,0,100", "--tool", "20,50,0"]
PLACES = torch.tensor([[0.0, 0.0, 0.1], [0.02, 0.05, 0.0]], dtype=torch.float64)


def both_arms(folder: Path) -> tuple[dc.CalibratedKinematics, Path, Path]:
    """A model of two arms, saved as arms.safetensors; files of its program and of the corrected one."""
    arms = model_of(two_arms(folder), dc.RK4(1))
    dc.save(arms, folder / "arms.safetensors")
    return arms, folder / "both.csv", folder / "out.csv"


def test_targets_of_both_hands(tmp_path: Path, command: Command) -> None:
    """Positions from the table, one of them empty."""
    arms, program, output = both_arms(tmp_path)
    path, written = tmp_path / "arms.safetensors", ["-o", output, "--json", tmp_path / "out.json"]
    names, q = arms.robot.joint_names, np.random.default_rng(3).uniform(-1, 1, (6, 5))
    wanted = torch.stack([arms.tool_poses(q, PLACES[k], tip=hand)[:, :3, 3] for k, hand in enumerate(HANDS)], dim=1)
    cells_of = [[*row, *place] for row, place in zip(q.tolist(), (1e3 * wanted).flatten(1).tolist(), strict=True)]
    cells_of[2][8:] = ["", "", ""]
    columns = [f"{hand}_{axis}" for hand in HANDS for axis in "xyz"]
    program.write_text("\n".join([",".join([*names, *columns]), *(",".join(map(str, row)) for row in cells_of)]))
    targets = ["--position", "left_x,left_y,left_z", "--position", "right_x,right_y,right_z"]
    done = command("correct", path, program, *UNITS_OF_HANDS, *TOOLS, *targets, *written)
    assert (done.code, done.err) == (0, "")
    assert [miss is None for miss in recorded_misses(tmp_path / "out.json")["right"]["miss_m"]] == [
        k == 2 for k in range(6)
    ]
    assert recorded_misses(tmp_path / "out.json")["left"]["angle_miss_deg"] is None
    assert "6 rows: 6 reached" in done.out
    assert [row["miss_right_mm"] == "" for row in read(output)] == [k == 2 for k in range(6)]


def test_commands_of_both_hands(tmp_path: Path, command: Command) -> None:
    """Nominal poses of both as targets."""
    arms, program, output = both_arms(tmp_path)
    names, q = arms.robot.joint_names, np.random.default_rng(3).uniform(-1, 1, (6, 5))
    program.write_text("\n".join([",".join(names), *(",".join(map(repr, row)) for row in q.tolist())]))
    done = command("correct", tmp_path / "arms.safetensors", program, *UNITS_OF_HANDS, *TOOLS, "-o", output)
    assert done.code == 0
    assert "a robot with 5 joints cannot hold every orientation of 2 tools" in done.err
    goals = arms.robot(torch.from_numpy(q)) @ torch.stack([tool_transform(place) for place in PLACES])
    expected = dc.compensate(arms, goals, q, tool=PLACES, bound=np.radians(20.0))
    np.testing.assert_allclose(table(read(output), list(names)), expected.q.numpy(), rtol=0, atol=1e-12)
    for k, hand in enumerate(HANDS):
        misses = table(read(output), [f"miss_{hand}_mm", f"angle_miss_{hand}_rad"])
        own = torch.stack([1e3 * expected.miss[:, k], held(expected.angle_miss)[:, k]], 1)
        np.testing.assert_allclose(misses, own.numpy(), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--tip", "left", "--tip", "left"], "--tip left is named twice"),
        (["--tip", "left", "--tip", "foot"], "--tip: expected one of"),
        (["--tip", "left", "--tip", "right", "--tool", "0,0,1"], "--tool: expected 2 of them, got 1"),
        (["--tip", "left", "--tip", "right", "--position", "x,y,z"], "--position: expected 2 of them, got 1"),
        ([], "has several tips"),
    ],
)
def test_wrong_options_of_both_hands(tmp_path: Path, command: Command, options: list[str], message: str) -> None:
    model = model_of(two_arms(tmp_path), dc.RK4(1))
    dc.save(model, tmp_path / "arms.safetensors")
    (tmp_path / "p.csv").write_text(",".join(model.robot.joint_names) + "\n0,0,0,0,0\n")
    units = ["--length", "mm", "--angle", "rad", "-o", tmp_path / "out.csv"]
    done = command("correct", tmp_path / "arms.safetensors", tmp_path / "p.csv", *units, *options)
    assert done.code == 1
    assert message in " ".join(done.err.split())
    assert not (tmp_path / "out.csv").exists()


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


# --- tools in the tip's frame, or in the measured frame of a model of poses ---


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
    model, text = posed.model, "0.03,-0.02,0.15"
    done = command(*arguments(files, "--tool", f"measured:{text}"))
    assert done.code == 0, done.err
    with (files / "corrected.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    q = torch.tensor([[float(row[name]) for name in model.robot.joint_names] for row in rows], dtype=torch.float64)
    tool = torch.eye(4, dtype=torch.float64)
    tool[:3, 3] = torch.tensor([0.03, -0.02, 0.15], dtype=torch.float64)
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
