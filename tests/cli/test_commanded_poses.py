"""Tables with poses or places of a machine in place of joint values: from `init` to a corrected program."""

from __future__ import annotations

import json
import re
import runpy
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_bank import Command
from commanded_bank import BOARD, CAMERA, DOWN, bent, cells, drawn, flange, seen, turned, without_frames, write_columns
from documentation_bank import write_commanded_tables
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.cli import commanded_poses
from diffeo_calib.cli.guesses import guess_sheet
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv import joints
from diffeo_calib.measurements.csv.joints import PoseColumns
from diffeo_calib.measurements.poses import rotation_matrices, rotation_numbers
from diffeo_calib.robots.se3 import transforms
from diffeo_calib.robots.simulated_arm import SimulatedArm

MEASURED = ["--position", "x,y,z", "--length", "mm", "--angle", "deg"]


def poses_table(path: Path, commanded: Tensor, found: Tensor, convention: str = "xyz", angle: str = "deg") -> Path:
    """Poses of a flange, its rotations in a convention, and of what was seen, mm and quaternions."""
    turns = rotation_numbers(commanded[:, :3, :3], convention, angle=angle)
    quaternions = rotation_numbers(found[:, :3, :3], "quat_wxyz")
    own = "_".join(("RX", "RY", "RZ") if turns.shape[1] == 3 else ("q0", "q1", "q2", "q3"))
    poses = {"X_Y_Z": 1e3 * commanded[:, :3, 3], own: turns}
    return write_columns(path, **poses, tx_ty_tz=1e3 * found[:, :3, 3], qw_qx_qy_qz=quaternions)


def hand_eye_table(path: Path, convention: str = "xyz", angle: str = "deg", *, camera_on_tool: bool = True) -> Path:
    return poses_table(path, flange(), seen(flange(), camera_on_tool=camera_on_tool), convention, angle)


@pytest.mark.parametrize(
    ("convention", "angle", "camera_on_tool"),
    [("xyz", "deg", True), ("ZYX", "deg", False), ("rotvec", "rad", True), ("quat_wxyz", "rad", False)],
)
def test_init_finds_what_the_numbers_mean(
    convention: str, angle: str, camera_on_tool: bool, tmp_path: Path, init: Any
) -> None:
    table = hand_eye_table(tmp_path / "t.csv", convention, angle, camera_on_tool=camera_on_tool)
    found, _ = init(table)
    assert found["robot-pose"].endswith(f"={convention}")
    assert found["robot-pose"].startswith("X,Y,Z,")
    assert [found[name] for name in ("convention", "rotation", "length")] == ["quat_xyzw", "qx,qy,qz,qw", "mm"]
    assert found["angle"] == angle or convention.startswith("quat")
    assert found.get("camera-on-tool", False) is camera_on_tool


def test_init_finds_poses_in_inches(tmp_path: Path, init: Any) -> None:
    table = hand_eye_table(tmp_path / "t.csv")
    header, *rows = cells(table)
    lines = [header, *([*(str(float(cell) / 25.4) for cell in row[:3]), *row[3:]] for row in rows)]
    table.write_text("\n".join(map(",".join, lines)) + "\n", encoding="utf-8")
    found, _ = init(table)
    assert (found["joint-length"], found["length"], found["robot-pose"]) == ("inch", "mm", "X,Y,Z,RX,RY,RZ=xyz")


@pytest.mark.parametrize(
    ("names", "machine"),
    [
        ("target_x target_y target_z measured_x measured_y measured_z", "target_x"),
        ("cmd_x cmd_y cmd_z actual_x actual_y actual_z board_x board_y board_z", "actual_x"),
        ("x_soll y_soll z_soll x_ist y_ist z_ist cam_x cam_y cam_z", "x_ist"),
        ("a_x a_y a_z b_x b_y b_z", "a_x"),
        ("x_ist y_ist z_ist x_soll y_soll z_soll", "x_soll"),
        ("cam_x cam_y cam_z x y z", "x"),
        ("board_x board_y board_z tcp_x tcp_y tcp_z", "tcp_x"),
        ("target_TCP_pose_0 target_TCP_pose_1 target_TCP_pose_2 target_TCP_pose_3 target_TCP_pose_4 target_TCP_pose_5 "
         "actual_TCP_pose_0 actual_TCP_pose_1 actual_TCP_pose_2 actual_TCP_pose_3 actual_TCP_pose_4 actual_TCP_pose_5 "
         "x y z", "actual_TCP_pose_0"),
        (" ".join(f"O_T_EE_{k}" for k in range(16)) + " tag_x tag_y tag_z", "O_T_EE_12"),
    ],
)  # fmt: skip
def test_whose_columns_are_the_machine_s(names: str, machine: str, tmp_path: Path) -> None:
    pose = transforms(turned(drawn(4, 3, seed=2)), drawn(4, 3, seed=3)).mT.flatten(1)  # by columns
    values = torch.cat([pose if "O_T_EE" in names else drawn(4, 0, seed=1), drawn(4, 30, seed=1)], 1)
    table = write_columns(tmp_path / "t.csv", **{"|".join(names.split()): values[:, : len(names.split())]})
    found = commanded_poses.poses_in(guess_sheet(table))
    assert commanded_poses.machine_of(found).place[0] == machine


def test_a_robot_whose_joints_the_table_lacks(tmp_path: Path, init: Any) -> None:
    table = hand_eye_table(tmp_path / "t.csv")
    SimulatedArm().write_urdf(tmp_path / "arm.urdf")
    found, text = init(table, tmp_path / "arm.urdf")
    assert "not used, no column is named after its joints" in text
    assert found["robot-pose"] == "X,Y,Z,RX,RY,RZ=xyz"


@pytest.mark.slow
def test_hand_eye_in_two_commands(tmp_path: Path, command: Command) -> None:
    table = hand_eye_table(tmp_path / "t.csv")
    assert command("init", table, "-o", tmp_path / "c.toml").code == 0
    done = command(
        "fit", tmp_path / "c.toml", "--holdout", "0", "--json", tmp_path / "f.json", "--report", tmp_path / "r"
    )
    assert done.code == 0, done.error
    assert "camera in the frame of" in (tmp_path / "r").read_text(encoding="utf-8")
    for name, link, truth in (("camera", "in_tip", CAMERA), ("board", "in_base", BOARD)):
        found = json.loads((tmp_path / "f.json").read_text(encoding="utf-8"))["results"]["hand_eye"][f"{name}_{link}"]
        away = torch.tensor(found["pose_m"], dtype=torch.float64)[:3, 3] - truth[:3, 3]
        assert bool((away.abs() < 4 * torch.tensor(found["position_std_m"])).all())
        assert float(away.norm()) < 1e-3
    model = tmp_path / "t.safetensors"
    done = command("export", model, "--camera", tmp_path / "camera")
    assert done.code == 0, done.error
    text = (tmp_path / "camera" / "easy_handeye2.calib").read_text(encoding="utf-8")
    assert 'calibration_type: "eye_in_hand"' in text
    x = float(text.partition("x: ")[2].partition("\n")[0])
    assert x == pytest.approx(float(CAMERA[0, 3]), abs=1e-3)
    # the same poses again: predicted and planned under the names of the table, and corrected by little
    assert command("predict", model, table, "-o", tmp_path / "p.csv").code == 0
    assert command("plan", model, "-n", "3", "-o", tmp_path / "n.csv").code == 0
    done = command("correct", model, table, "-o", tmp_path / "d.csv")
    assert done.code == 0, done.error
    (header, *before), (_, *after) = cells(table), cells(tmp_path / "d.csv")
    for one, other in zip(before, after, strict=True):
        assert [float(cell) for cell in other[:6]] == pytest.approx([float(cell) for cell in one[:6]], abs=0.5)
    assert cells(tmp_path / "n.csv")[0] == [*header[:6], "rank"]


def test_places_measured_in_a_plane(tmp_path: Path, init: Any) -> None:
    """The third name is no column but 0; a table that counts its columns from 0 is no such table."""
    commanded = torch.rand(30, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    measured = commanded + 1e-3 * (4 * commanded.flip(1)).sin() + 2e-5 * drawn(30, 2, seed=2)
    table = write_columns(tmp_path / "t.csv", **{"cmdx_cmdy": 1e3 * commanded, "measx_measy": 1e3 * measured})
    found, _ = init(table)
    assert found["position"] == ["measx,measy,0"]
    assert (found["robot-pose"], found["length"]) == ("cmdx,cmdy", "mm")
    machine = PoseColumns(("cmdx", "cmdy"), robot=dc.cartesian(commanded))
    data = dc.read_measurements(table, machine, ["measx", "measy", "0"], length="mm", angle="deg")
    assert_close(data.points[:, 0], torch.nn.functional.pad(measured, (0, 1)), rtol=0, atol=1e-8)
    with pytest.raises(MeasurementError, match=r"no column \['0'\]"):
        dc.read_measurements(table, machine, ["0", "measx", "measy"], length="mm", angle="deg")
    table.write_text("q,u,v,x,y\n10,.2,.3,.4,.5\n20,,,.6,.7\n30,.4,.5,,\n")  # hidden where u and v, or x and y, are
    places = [["u", "v", "0"], ["x", "y", "0"]]
    seen = dc.read_measurements(table, np.array(["q"]), places, length="m", angle="deg").points
    assert seen.nan_to_num(-1.0).flatten(1).tolist() == [
        [0.2, 0.3, 0, 0.4, 0.5, 0],
        [-1] * 3 + [0.6, 0.7, 0],
        [0.4, 0.5, 0] + [-1] * 3,
    ]


@pytest.mark.slow
def test_the_error_field_of_a_gantry(tmp_path: Path, command: Command, init: Any) -> None:
    commanded = torch.rand(80, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    measured = bent(commanded) + 2e-5 * drawn(80, 3, seed=2)
    table = write_columns(tmp_path / "t.csv", **{"cmdx_cmdy_cmdz": 1e3 * commanded, "x_y_z": 1e3 * measured})
    init(table)
    assert 'robot-pose = "cmdx,cmdy,cmdz"' in (tmp_path / "c.toml").read_text(encoding="utf-8")
    done = command("fit", tmp_path / "c.toml", "--report", tmp_path / "r.html")
    assert done.code == 0, done.error
    report = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "Why" in report
    assert "Gravity" not in report
    alone = write_columns(tmp_path / "commanded.csv", x_y_z=1e3 * commanded[:5])
    done = command("predict", tmp_path / "t.safetensors", alone, "--robot-pose", "x,y,z", "-o", tmp_path / "p.csv")
    assert done.code == 0, done.error
    assert cells(tmp_path / "p.csv")[0][:6] == ["x", "y", "z", "predicted_x", "predicted_y", "predicted_z"]
    done = command(
        "export", tmp_path / "t.safetensors", "--field", tmp_path / "f.csv", "--grid", "4x4x2", "--length", "m"
    )
    assert done.code == 0, done.error
    field = torch.tensor([[float(cell) for cell in row] for row in cells(tmp_path / "f.csv")[1:]])
    assert field.shape == (32, 9)
    place, add, std = field.double().split(3, 1)
    assert without_frames(bent(place + add), place) < 0.15 * without_frames(bent(place), place)
    model = dc.load(tmp_path / "t.safetensors")
    expected = model.predict(place, noise=False)[1][:, 0].diagonal(dim1=1, dim2=2).sqrt()
    assert_close(std, expected, rtol=0.05, atol=1e-7)  # the device stands upright


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--robot", "arm.urdf"], "--robot, --base or --tip beside --robot-pose"),
        (["--joints", "X,Y,Z,RX,RY,RZ"], "--joints beside --robot-pose"),
    ],
)
def test_options_that_exclude_each_other(options: list[str], message: str, tmp_path: Path, command: Command) -> None:
    table = hand_eye_table(tmp_path / "t.csv")
    (tmp_path / "arm.urdf").write_text("<robot/>", encoding="utf-8")
    given = ["--robot-pose", "X,Y,Z,RX,RY,RZ=xyz", "--length", "mm", "--angle", "deg", "--position", "tx,ty,tz"]
    words = [str(tmp_path / word) if word.endswith(".urdf") else word for word in options]
    done = command("fit", table, *given, *words, "-o", tmp_path / "m")
    assert done.code == 1
    assert message in done.error


def test_a_size_that_is_a_machine_in_two_units(tmp_path: Path, init: Any) -> None:
    """Within 5 mm, or 5 m: the user says which."""
    commanded = 5.0 * torch.rand(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    table = write_columns(tmp_path / "t.csv", cmdx_cmdy_cmdz=commanded, x_y_z=bent(commanded))
    _, text = init(table)
    assert '# length = "m"' in text
    assert '# length = "mm"' in text


@pytest.mark.parametrize(("per_metre", "unit"), [(1.0, "m"), (1000 / 25.4, "inch")])
def test_what_was_measured_tells_the_size_of_the_machine(
    per_metre: float, unit: str, tmp_path: Path, init: Any
) -> None:
    commanded = 15.0 / per_metre * torch.rand(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    table = write_columns(tmp_path / "t.csv", cmdx_cmdy_cmdz=per_metre * commanded, x_y_z=1e3 * bent(commanded))
    found, _ = init(table)
    assert (found["joint-length"], found["length"]) == (unit, "mm")


def test_a_fixed_camera_and_columns_of_opencv(tmp_path: Path, command: Command, init: Any) -> None:
    commanded = flange()
    measured = seen(commanded, camera_on_tool=False)
    turns = [rotation_numbers(own[:, :3, :3], "rotvec") for own in (commanded, measured)]
    poses = {"TCP_x|TCP_y|TCP_z": commanded[:, :3, 3], "TCP_rx|TCP_ry|TCP_rz": turns[0]}
    poses |= {"tvec_x|tvec_y|tvec_z": measured[:, :3, 3], "rvec_x|rvec_y|rvec_z": turns[1]}
    table = write_columns(tmp_path / "t.csv", **poses)
    _, text = init(table)
    assert 'rotation = "rvec_x,rvec_y,rvec_z"' in text
    done = command("fit", tmp_path / "c.toml", "--holdout", "0", "--json", tmp_path / "f.json")
    assert done.code == 0, done.error
    found = json.loads((tmp_path / "f.json").read_text(encoding="utf-8"))["results"]["hand_eye"]
    for name, truth in (("camera_in_base", BOARD), ("board_in_tip", CAMERA)):
        away = torch.tensor(found[name]["pose_m"], dtype=torch.float64)[:3, 3] - truth[:3, 3]
        assert bool((away.abs() < 4 * torch.tensor(found[name]["position_std_m"])).all())


def test_two_markers_of_a_machine_with_commanded_places(tmp_path: Path, init: Any) -> None:
    commanded = torch.rand(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    markers = {"left_x|left_y|left_z": bent(commanded), "right_x|right_y|right_z": bent(commanded) + 0.1}
    table = write_columns(tmp_path / "t.csv", **{"cmdx_cmdy_cmdz": commanded, **markers})
    found, _ = init(table)
    assert found["position"] == ["left_x,left_y,left_z", "right_x,right_y,right_z"]
    assert found["length"] == "m"


@pytest.mark.parametrize(("stated", "angle"), [("XYZ", "deg"), ("xyz", "rad"), ("rotvec", "deg")])
def test_poses_in_another_convention_are_refused_with_the_right_one(
    stated: str, angle: str, tmp_path: Path, command: Command
) -> None:
    table = hand_eye_table(tmp_path / "t.csv")
    measured = ["--position", "tx,ty,tz", "--rotation", "qx,qy,qz,qw", "--convention", "quat_xyzw", "--camera-on-tool"]
    pose = ["--robot-pose", f"X,Y,Z,RX,RY,RZ={stated}", "--length", "mm", "--angle", angle]
    done = command("fit", table, *pose, *measured, "-o", tmp_path / "m")
    assert done.code == 1
    assert "the commanded poses fit with --robot-pose X,Y,Z,RX,RY,RZ=xyz --angle deg" in done.err


def test_conventions_that_the_rows_do_not_tell_apart(tmp_path: Path, init: Any) -> None:
    """Turns about z, small ones about x: the order of the angles does not matter."""
    commanded = flange()
    axes = torch.stack([0 * commanded[:, 0, 3], 0 * commanded[:, 0, 3], drawn(len(commanded), seed=4)], 1)
    commanded[:, :3, :3] = turned(axes) @ turned(1e-4 * drawn(len(commanded), 3, seed=5))
    table = poses_table(tmp_path / "t.csv", commanded, seen(commanded, camera_on_tool=True))
    _, text = init(table)
    assert '# robot-pose = "X,Y,Z,RX,RY,RZ=xyz"' in text
    assert '# robot-pose = "X,Y,Z,RX,RY,RZ=XYZ"' in text


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        (None, "f", r"'own.py' cannot be read \(No such file or directory\)"),
        ("1 +", "f", "'own.py' does not run: got SyntaxError"),
        ("f = 1 / 0", "f", "'own.py' does not run: got ZeroDivisionError"),
        ("f = None", "f", "the file 'own.py': expected a function f"),
        ("def f(q): return q @ q", "f", "own.py:f of 5 rows: got RuntimeError"),
        ("def f(q): return q[:, :1].expand(-1, 4)", "f", r"returns: expected places \(5, k\).* got \(5, 4\)"),
        ("def f(q): return q[:4]", "f", r"returns: expected places \(5, k\).* got \(4, 2\)"),
        ("def f(q): return 1.0", "f", r"returns: expected places \(5, k\).* got \(\)"),
        ("def f(q): return q[0]", "f", r"returns: expected places \(5, k\).* got \(2,\)"),
        ("def f(q): return (q - q[2:3]).log()", "f", "of row .*2.*: expected finite numbers"),
    ],
)
def test_functions_that_are_none(
    text: str | None, name: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    joints._module.cache_clear()
    if text is not None:
        (tmp_path / "own.py").write_text(text, encoding="utf-8")
    with pytest.raises(MeasurementError, match=message):
        PoseColumns.of(f"a,b=own.py:{name}").poses(drawn(5, 2, seed=0))


def test_poses_of_a_tool_that_never_tilts(tmp_path: Path, command: Command) -> None:
    """The camera's place along the axis is open, which is said, and the next poses tilt."""
    commanded = flange()
    turn = torch.stack([*torch.zeros(2, len(commanded), dtype=torch.float64), drawn(len(commanded), seed=4)], 1)
    commanded[:, :3, :3] = turned(turn) @ torch.tensor(DOWN, dtype=torch.float64)
    table = poses_table(tmp_path / "t.csv", commanded, seen(commanded, camera_on_tool=True), "rotvec", "rad")
    measured = ["--position", "tx,ty,tz", "--rotation", "qx,qy,qz,qw", "--convention", "quat_xyzw", "--camera-on-tool"]
    pose = ["--robot-pose", "X,Y,Z,RX,RY,RZ=rotvec", "--length", "mm", "--angle", "rad"]
    done = command("fit", table, *pose, *measured, "-o", tmp_path / "m")
    assert done.code in (0, 2), done.error
    assert re.search(r"is known to \d+ mm only: turn the tool about several axes", done.err)
    assert command("plan", tmp_path / "m", "-n", "4", "-o", tmp_path / "n.csv").code == 0
    _, *rows = cells(tmp_path / "n.csv")
    new = torch.tensor([[float(cell) for cell in row[3:6]] for row in rows], dtype=torch.float64)
    z = turned(new)[:, :, 2]
    assert float((z @ z.mT).min()) < 0.97


def test_rotations_before_places_and_rows_without_a_board(tmp_path: Path, init: Any) -> None:
    commanded = flange()
    found = seen(commanded, camera_on_tool=True)
    turns = [rotation_numbers(own[:, :3, :3], *how) for own, how in ((commanded, ("xyz",)), (found, ("quat_xyzw",)))]
    poses = {"RX_RY_RZ": turns[0].rad2deg(), "X_Y_Z": 1e3 * commanded[:, :3, 3]}
    table = write_columns(tmp_path / "t.csv", **poses, qx_qy_qz_qw=turns[1], tx_ty_tz=1e3 * found[:, :3, 3])
    lines = table.read_text(encoding="utf-8").splitlines()
    lines[3] = ",".join([*lines[3].split(",")[:6], *[""] * 7])
    table.write_text("\n".join(lines) + "\n", encoding="utf-8")
    proposed, _ = init(table)
    assert (proposed["robot-pose"], proposed["rotation"]) == ("X,Y,Z,RX,RY,RZ=xyz", "qx,qy,qz,qw")
    assert proposed["camera-on-tool"]


def test_a_flange_that_turns_at_one_place(tmp_path: Path, init: Any) -> None:
    """No motion of the flange has a shift, which sets the scale of the others."""
    commanded = flange()
    commanded[:, :3, 3] = commanded[0, :3, 3]
    table = poses_table(tmp_path / "t.csv", commanded, seen(commanded, camera_on_tool=True))
    assert 'robot-pose = "X,Y,Z,RX,RY,RZ=xyz"' in init(table)[1]  # among others: these rows do not tell


def slides(z: float) -> tuple[Tensor, Tensor]:
    """Places that two slides of a machine went to, at a height, and where it was: it sinks along x, m."""
    places = torch.rand(40, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    places[:, 2] = z
    measured = bent(places) + 2e-5 * drawn(40, 3, seed=2)
    measured[:, 2] += 3e-4 * (4.0 * places[:, 0]).sin()
    return places, measured


def test_a_slide_that_stood_still_is_corrected(tmp_path: Path, command: Command) -> None:
    places, measured = slides(0.1)
    table = write_columns(tmp_path / "t.csv", cmdx_cmdy_cmdz=1e3 * places, x_y_z=1e3 * measured)
    pose = ["--robot-pose", "cmdx,cmdy,cmdz", *MEASURED]
    done = command("fit", table, *pose, "--holdout", "0", "-o", tmp_path / "m.safetensors")
    assert done.code in (0, 3), done.error
    done = command(
        "export", tmp_path / "m.safetensors", "--field", tmp_path / "f.csv", "--grid", "5x3x2", "--length", "mm"
    )
    assert done.code == 0, done.error
    header, *rows = cells(tmp_path / "f.csv")
    added = torch.tensor([float(row[header.index("add_z [mm]")]) for row in rows])
    assert float(added.max() - added.min()) > 0.1


def test_a_table_with_two_slides_is_corrected_where_it_can_move(tmp_path: Path, command: Command, init: Any) -> None:
    places, measured = slides(0.0)
    table = write_columns(tmp_path / "t.csv", cmdx_cmdy=1e3 * places[:, :2], x_y_z=1e3 * measured)
    assert init(table)[0]["robot-pose"] == "cmdx,cmdy"
    done = command("fit", tmp_path / "c.toml", "--holdout", "0")
    assert done.code in (0, 3), done.error
    done = command("correct", tmp_path / "t.safetensors", table, "-o", tmp_path / "p.csv")
    assert done.code == 0, done.error
    header, *rows = cells(tmp_path / "p.csv")
    assert {row[header.index("status")] for row in rows} == {"reached"}
    sent = torch.tensor([[*map(float, row[:2]), 0.0] for row in rows], dtype=torch.float64) / 1e3
    assert without_frames(bent(sent), places) < 0.15 * without_frames(bent(places), places)
    model: Any = dc.load(tmp_path / "t.safetensors")
    at, *ends = torch.zeros(3, 1, 2, dtype=torch.float64) + torch.eye(3, 2, dtype=torch.float64).roll(1, 0)[:, None]
    here, x, y = (model.tool_poses(one, frame="measuring")[0, :3, 3] for one in (at, *ends))
    above = torch.nn.functional.normalize(torch.linalg.cross(x - here, y - here), dim=0)
    wanted = here + 0.05 * (x - here) + 0.1 * above
    stopped = dc.compensate(model, wanted[None], at, bound=1e-3, frame="measuring")
    left = wanted - model.tool_poses(stopped.q, frame="measuring")[0, :3, 3]
    assert float(left.norm()) > 0.1
    assert float(stopped.miss) == pytest.approx(float((left - (left @ above) * above).norm()), rel=0.01)
    assert float(stopped.miss) > 0.02  # what lies above counts nothing, what lies aside does


def test_nothing_is_sure_where_the_machine_never_turns(tmp_path: Path, init: Any) -> None:
    """Every convention explains the rows."""
    commanded = flange()
    commanded[:, :3, :3] = commanded[0, :3, :3]
    found = seen(commanded, camera_on_tool=True)
    turns = rotation_numbers(commanded[:, :3, :3], "rotvec"), rotation_numbers(found[:, :3, :3], "rotvec")
    poses = {"X_Y_Z": 1e3 * commanded[:, :3, 3], "RX_RY_RZ": turns[0]}
    table = write_columns(
        tmp_path / "t.csv", **poses, tx_ty_tz=1e3 * found[:, :3, 3], **{"rvec_x|rvec_y|rvec_z": turns[1]}
    )
    proposed, _ = init(table)
    assert not {"robot-pose", "convention", "rotation-angle"} & {*proposed}


def test_a_tool_is_a_rotation_vector_whatever_the_poses_are(tmp_path: Path, command: Command, init: Any) -> None:
    table = hand_eye_table(tmp_path / "t.csv")
    init(table)
    assert command("fit", tmp_path / "c.toml").code == 0
    written = []
    for convention in ("xyz", "rotvec"):  # by default that of the poses
        options = ["--convention", convention, "--rotation-angle", "deg"] if convention == "rotvec" else []
        tool = ["--tool", "0,0,100,20,30,40", *options]
        assert command("correct", tmp_path / "t.safetensors", table, *tool, "-o", tmp_path / "c.csv").code == 0
        header, *rows = cells(tmp_path / "c.csv")
        at = header.index("command_z") + 1
        turns = [[float(cell) for cell in row[at : at + 3]] for row in rows]
        written.append(rotation_matrices(turns, convention, angle="deg"))
    assert_close(*written, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("noise", "wrong", "flipped"),
    [(0.017, [], []), (0.0, [5], []), (0.0, [5, 14], []), (0.017, [5, 6], []), (0.0, [], [4, 13])],
)
def test_noise_of_a_degree_and_wrong_rows(
    noise: float, wrong: list[int], flipped: list[int], tmp_path: Path, init: Any
) -> None:
    """Radians that are read as degrees make all turns small, and with these what they leave.

    Rows are off by 30 degrees and 10 cm, or show the board from its other end.
    """
    commanded = flange()
    found = seen(commanded, camera_on_tool=False)
    found[:, :3, :3] = turned(noise * drawn(len(found), 3, seed=11)) @ found[:, :3, :3]
    found[wrong, :3, :3] = turned(torch.full((1, 3), 0.3, dtype=torch.float64)) @ found[wrong, :3, :3]
    found[wrong, :3, 3] += 0.1
    half = transforms(turned(torch.tensor([[0.0, 0.0, pi]])), torch.tensor([[0.2, 0.15, 0.0]]))
    found[flipped] = found[flipped] @ half
    turns = [rotation_numbers(own[:, :3, :3], "rotvec") for own in (commanded, found)]
    poses = {"X_Y_Z": commanded[:, :3, 3], "RX_RY_RZ": turns[0], "tx_ty_tz": found[:, :3, 3]}
    proposed, _ = init(write_columns(tmp_path / "t.csv", **poses, **{"rvec_x|rvec_y|rvec_z": turns[1]}))
    assert (proposed["robot-pose"], proposed["angle"]) == ("X,Y,Z,RX,RY,RZ=rotvec", "rad")
    assert (proposed["convention"], proposed["rotation-angle"]) == ("rotvec", "rad")


# --- functions in place of a robot: `--robot-pose A,B,...=FILE.py:NAME` ---


@pytest.fixture(scope="module")
def delta(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a delta robot, its table and its program."""
    place = tmp_path_factory.mktemp("delta")
    write_commanded_tables(place)
    return place


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
