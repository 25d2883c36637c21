"""Poses or places of a machine, or a function, in place of joint values: from `init` to a corrected program."""

import json
import re
import runpy
from collections.abc import Callable
from functools import partial
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_bank import Command
from commanded_bank import BOARD, CAMERA, DOWN, bent, cells, drawn, flange, seen, turned, write_columns
from documentation_bank import write_commanded_tables
from numbers_bank import rigid_rms
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.cli.commands import init as commanded_poses
from diffeo_calib.cli.guesses import guess_sheet
from diffeo_calib.cli.options import Units
from diffeo_calib.cli.tables import table_format
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.csv import columns as joints
from diffeo_calib.measurements.csv.columns import PoseColumns
from diffeo_calib.measurements.poses import rotation_matrices, rotation_numbers
from diffeo_calib.robots.se3 import transforms
from diffeo_calib.robots.simulated_arm import SimulatedArm

MEASURED = ["--position", "x,y,z", "--length", "mm", "--angle", "deg"]
SEEN = ["--position", "tx,ty,tz", "--rotation", "qx,qy,qz,qw", "--convention", "quat_xyzw", "--camera-on-tool"]
POSE = "X,Y,Z,RX,RY,RZ"


def poses_table(path: Path, commanded: Tensor, found: Tensor, convention: str = "xyz", angle: str = "deg") -> Path:
    """Poses of a flange, its rotations in a convention, and of what was seen, mm and quaternions."""
    turns = rotation_numbers(commanded[:, :3, :3], convention, angle=angle)
    quaternions = rotation_numbers(found[:, :3, :3], "quat_wxyz")
    own = "_".join(("RX", "RY", "RZ") if turns.shape[1] == 3 else ("q0", "q1", "q2", "q3"))
    poses = {"X_Y_Z": 1e3 * commanded[:, :3, 3], own: turns}
    return write_columns(path, **poses, tx_ty_tz=1e3 * found[:, :3, 3], qw_qx_qy_qz=quaternions)


def from_the_tool(path: Path, commanded: Tensor, convention: str = "xyz", angle: str = "deg") -> Path:
    return poses_table(path, commanded, seen(commanded, camera_on_tool=True), convention, angle)


def places(rows: int = 20, axes: int = 3, size: float = 1.0) -> Tensor:
    return size * torch.rand(rows, axes, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def in_inches(path: Path) -> Path:
    header, *rows = cells(from_the_tool(path, flange()))
    lines = [header, *([*(str(float(cell) / 25.4) for cell in row[:3]), *row[3:]] for row in rows)]
    path.write_text("\n".join(map(",".join, lines)) + "\n", encoding="utf-8")
    return path


def turned_about_z(path: Path) -> Path:
    """Small turns about x: the order of the angles does not matter."""
    commanded = flange()
    axes = torch.stack([0 * commanded[:, 0, 3], 0 * commanded[:, 0, 3], drawn(len(commanded), seed=4)], 1)
    commanded[:, :3, :3] = turned(axes) @ turned(1e-4 * drawn(len(commanded), 3, seed=5))
    return from_the_tool(path, commanded)


def at_one_place(path: Path) -> Path:
    """No motion of the flange has a shift, which sets the scale of the others."""
    commanded = flange()
    commanded[:, :3, 3] = commanded[0, :3, 3]
    return from_the_tool(path, commanded)


def without_turns(path: Path) -> Path:
    commanded = flange()
    commanded[:, :3, :3] = commanded[0, :3, :3]
    return from_the_tool(path, commanded, "rotvec")


def rotations_first(path: Path) -> Path:
    commanded, found = flange(), seen(flange(), camera_on_tool=True)
    turns = [rotation_numbers(own[:, :3, :3], *how) for own, how in ((commanded, ("xyz",)), (found, ("quat_xyzw",)))]
    poses = {"RX_RY_RZ": turns[0].rad2deg(), "X_Y_Z": 1e3 * commanded[:, :3, 3]}
    write_columns(path, **poses, qx_qy_qz_qw=turns[1], tx_ty_tz=1e3 * found[:, :3, 3])
    lines = path.read_text(encoding="utf-8").splitlines()
    lines[3] = ",".join([*lines[3].split(",")[:6], *[""] * 7])
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def in_opencv(path: Path, found: Tensor) -> Path:
    """A fixed camera, and rotation vectors of both, m and rad."""
    columns = {}
    for place, turn, own in (("TCP_{}", "TCP_r{}", flange()), ("tvec_{}", "rvec_{}", found)):
        columns["|".join(map(place.format, "xyz"))] = own[:, :3, 3]
        columns["|".join(map(turn.format, "xyz"))] = rotation_numbers(own[:, :3, :3], "rotvec")
    return write_columns(path, **columns)


def noisy(path: Path, noise: float = 0.0, wrong: tuple[int, ...] = (), flipped: tuple[int, ...] = ()) -> Path:
    """Noise of a degree makes radians that are read as degrees likelier: all turns are small, and what they leave.

    Rows are off by 30 degrees and 10 cm, or show the board from its other end.
    """
    found = seen(flange(), camera_on_tool=False)
    found[:, :3, :3] = turned(noise * drawn(len(found), 3, seed=11)) @ found[:, :3, :3]
    off = list(wrong)
    found[off, :3, :3] = turned(torch.full((1, 3), 0.3, dtype=torch.float64)) @ found[off, :3, :3]
    found[off, :3, 3] += 0.1
    half = transforms(turned(torch.tensor([[0.0, 0.0, pi]])), torch.tensor([[0.2, 0.15, 0.0]]))
    found[list(flipped)] = found[list(flipped)] @ half
    return in_opencv(path, found)


def of_places(path: Path, size: float = 1.0, per_metre: float = 1.0, measured: float = 1.0) -> Path:
    own = places(size=size)
    return write_columns(path, cmdx_cmdy_cmdz=per_metre * own, x_y_z=measured * bent(own))


def of_two_markers(path: Path) -> Path:
    own = places()
    markers = {"left_x|left_y|left_z": bent(own), "right_x|right_y|right_z": bent(own) + 0.1}
    return write_columns(path, cmdx_cmdy_cmdz=own, **markers)


def in_sockets(path: Path) -> Path:
    """A ball near the flange: quaternions in the wrong order leave little too."""
    commanded, ball = flange(), torch.tensor([0.03, -0.02, 0.02], dtype=torch.float64)
    commanded[:, :3, 3] = places(3).repeat(len(commanded) // 3, 1) - commanded[:, :3, :3] @ ball
    turns = rotation_numbers(commanded[:, :3, :3], "quat_xyzw")
    sockets = {"qx_qy_qz_qw": turns, "socket": torch.arange(len(commanded))[:, None] % 3}
    return write_columns(path, X_Y_Z=1e3 * commanded[:, :3, 3], **sockets)


FIXED_CAMERA = partial(poses_table, commanded=flange(), found=seen(flange(), camera_on_tool=False))
TOOL = {"rotation": "qx,qy,qz,qw", "convention": "quat_xyzw", "length": "mm", "camera-on-tool": True}
FIXED = {**TOOL, "camera-on-tool": None}
QUATERNIONS = {**FIXED, "robot-pose": "X,Y,Z,q0,q1,q2,q3=quat_wxyz"}
SOME = {"robot-pose": f"{POSE}=xyz"}
OPENCV = {"robot-pose": "TCP_x,TCP_y,TCP_z,TCP_rx,TCP_ry,TCP_rz=rotvec", "angle": "rad", "convention": "rotvec"}
OPENCV |= {"rotation": "rvec_x,rvec_y,rvec_z", "rotation-angle": "rad"}
TWO = {"position": ["left_x,left_y,left_z", "right_x,right_y,right_z"], "length": "m"}
OPEN = {"robot-pose": None, "convention": None, "rotation-angle": None}
EITHER = [f'# robot-pose = "{POSE}={name}"' for name in ("xyz", "XYZ")]
IN_INCHES = {"joint-length": "inch", "length": "mm"}
READ: dict[str, tuple[Callable[[Path], Path], dict[str, Any], list[str]]] = {
    "fixed angles": (partial(from_the_tool, commanded=flange()), {**TOOL, **SOME, "angle": "deg"}, []),
    "Euler angles": (partial(FIXED_CAMERA, convention="ZYX"), {**FIXED, "robot-pose": f"{POSE}=ZYX"}, []),
    "quaternions": (partial(FIXED_CAMERA, convention="quat_wxyz"), QUATERNIONS, []),
    "inches": (in_inches, {**SOME, **IN_INCHES}, []),
    "turned about one axis": (turned_about_z, {}, EITHER),
    "turned at one place": (at_one_place, {}, [f'robot-pose = "{POSE}=xyz"']),  # among others
    "never turned": (without_turns, OPEN, []),
    "rotations first": (rotations_first, {**SOME, "rotation": "qx,qy,qz,qw", "camera-on-tool": True}, []),
    "two wrong rows": (partial(noisy, wrong=(5, 14)), OPENCV, []),
    "a degree and wrong rows": (partial(noisy, noise=0.017, wrong=(5, 6)), OPENCV, []),
    "flipped boards": (partial(noisy, flipped=(4, 13)), OPENCV, []),
    "two markers": (of_two_markers, TWO, []),
    "no errors": (partial(write_columns, cmdx_cmdy_cmdz=places(), x_y_z=places()), {"length": "m"}, []),
    "sockets": (in_sockets, {"robot-pose": "X,Y,Z,qx,qy,qz,qw=quat_xyzw", "socket": "socket"}, []),
    "5 mm, or 5 m": (partial(of_places, size=5.0), {"length": None}, ['# length = "m"', '# length = "mm"']),
    "metres": (partial(of_places, size=15.0, measured=1e3), {"joint-length": "m", "length": "mm"}, []),
    "15 inches": (partial(of_places, size=0.381, per_metre=1000 / 25.4, measured=1e3), IN_INCHES, []),
}
"""What is in a table -> how it is written; entries, None for one that is missing or open; texts."""
LONGEST = ("a degree and wrong rows", "inches", "never turned")


@pytest.mark.parametrize("what", [pytest.param(what, marks=[pytest.mark.slow] * (what in LONGEST)) for what in READ])
def test_init_finds_what_the_numbers_mean(what: str, tmp_path: Path, init: Any) -> None:
    write, expected, texts = READ[what]
    found, text = init(write(tmp_path / "t.csv"))
    assert {name: found.get(name) for name in expected} == expected
    assert all(words in text for words in texts)


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
        (" ".join(f"{own}_TCP_pose_{k}" for own in ("target", "actual") for k in range(6)) + " x", "actual_TCP_pose_0"),
        (" ".join(f"O_T_EE_{k}" for k in range(16)) + " tag_x tag_y tag_z", "O_T_EE_12"),
    ],
)
def test_whose_columns_are_the_machine_s(names: str, machine: str, tmp_path: Path) -> None:
    pose = transforms(turned(drawn(4, 3, seed=2)), drawn(4, 3, seed=3)).mT.flatten(1)  # by columns
    values = torch.cat([pose if "O_T_EE" in names else drawn(4, 0, seed=1), drawn(4, 30, seed=1)], 1)
    own = names.split()
    table = write_columns(tmp_path / "t.csv", **{"|".join(own): values[:, : len(own)]})
    found = commanded_poses.poses_in(guess_sheet(table))
    assert commanded_poses.machine_of(found).place[0] == machine


def test_a_robot_whose_joints_the_table_lacks(tmp_path: Path, init: Any) -> None:
    SimulatedArm().write_urdf(tmp_path / "arm.urdf")
    found, text = init(from_the_tool(tmp_path / "t.csv", flange()), tmp_path / "arm.urdf")
    assert "not used, no column is named after its joints" in text
    assert found["robot-pose"] == f"{POSE}=xyz"


def test_places_measured_in_a_plane(tmp_path: Path, init: Any) -> None:
    """The third name is no column but 0; a table that counts its columns from 0 is no such table."""
    commanded = places(30, 2)
    measured = commanded + 1e-3 * (4 * commanded.flip(1)).sin() + 2e-5 * drawn(30, 2, seed=2)
    table = write_columns(tmp_path / "t.csv", **{"cmdx_cmdy": 1e3 * commanded, "measx_measy": 1e3 * measured})
    found, _ = init(table)
    weighed = {"cmdx_kg|cmdy_kg": commanded, "x|y": 1e3 * measured}
    refused = init(write_columns(tmp_path / "kg.csv", **weighed))[1]
    in_um = {"cmdx_um|cmdy_um": 1e6 * commanded, "x|y": 1e3 * measured}
    assert init(write_columns(tmp_path / "um.csv", **in_um))[0]["joint-length"] == "um"
    assert "got no other columns; if" in init(write_columns(tmp_path / "alone.csv", cmdx_cmdy=commanded))[1]
    assert "cmdx_kg, cmdy_kg in kg: expected m, mm, cm, um, inch; convert them" in refused
    assert found["position"] == ["measx,measy,0"]
    assert (found["robot-pose"], found["length"]) == ("cmdx,cmdy", "mm")
    machine = PoseColumns(("cmdx", "cmdy"), robot=dc.cartesian(commanded))
    data = dc.read_measurements(table, machine, ["measx", "measy", "0"], length="mm", angle="deg")
    assert_close(data.points[:, 0], torch.nn.functional.pad(measured, (0, 1)), rtol=0, atol=1e-8)
    with pytest.raises(MeasurementError, match=r"no column \['0'\]"):
        dc.read_measurements(table, machine, ["0", "measx", "measy"], length="mm", angle="deg")
    table.write_text("q,u,v,x,y\n10,.2,.3,.4,.5\n20,,,.6,.7\n30,.4,.5,,\n")  # hidden where u and v, or x and y, are
    bodies = [["u", "v", "0"], ["x", "y", "0"]]
    points = dc.read_measurements(table, np.array(["q"]), bodies, length="m", angle="deg").points
    hidden = [-1] * 3
    expected = [[0.2, 0.3, 0, 0.4, 0.5, 0], [*hidden, 0.6, 0.7, 0], [0.4, 0.5, 0, *hidden]]
    assert points.nan_to_num(-1.0).flatten(1).tolist() == expected


def check_hand_eye(path: Path, **truths: Tensor) -> None:
    """Transforms of `fit --json`, to their deviations."""
    found = json.loads(path.read_text(encoding="utf-8"))["results"]["hand_eye"]
    for name, truth in truths.items():
        away = torch.tensor(found[name]["pose_m"], dtype=torch.float64)[:3, 3] - truth[:3, 3]
        assert bool((away.abs() < 4 * torch.tensor(found[name]["position_std_m"])).all())
        assert float(away.norm()) < 1e-3


@pytest.mark.slow
@pytest.mark.usefixtures("given_scales")
def test_hand_eye_in_two_commands(tmp_path: Path, command: Command) -> None:
    table, model, out = from_the_tool(tmp_path / "t.csv", flange()), tmp_path / "t.safetensors", tmp_path / "f.json"
    command.ran("init", table, "-o", tmp_path / "c.toml")
    done = command.ran("fit", tmp_path / "c.toml", "--holdout", "0", "--json", out, "--report", tmp_path / "r")
    assert "camera in the frame of" in (tmp_path / "r").read_text(encoding="utf-8")
    check_hand_eye(out, camera_in_tip=CAMERA, board_in_base=BOARD)
    done = command.ran("export", model, "--camera", tmp_path / "camera")
    text = (tmp_path / "camera" / "easy_handeye2.calib").read_text(encoding="utf-8")
    assert 'calibration_type: "eye_in_hand"' in text
    x = float(text.partition("x: ")[2].partition("\n")[0])
    assert x == pytest.approx(float(CAMERA[0, 3]), abs=1e-3)
    done = command("predict", model, table, "-o", tmp_path / "p.csv")
    assert "the poses are those of the camera on the tool, in the frame of the board that stands" in done.out
    command.ran("plan", model, "-n", "20", "--range", "X=450:600", "-o", tmp_path / "n.csv")
    poses = cells(tmp_path / "n.csv")
    new = torch.tensor([[float(cell) for cell in row[:6]] for row in poses[1:]], dtype=torch.float64)
    assert bool(((new[:, 0] >= 450) & (new[:, 0] <= 600)).all())
    went = transforms(rotation_matrices(new[:, 3:], "xyz", angle="deg"), 1e-3 * new[:, :3])
    there = (torch.linalg.inv(went @ CAMERA) @ BOARD)[:, :3, 3]
    assert bool((there[:, 2] > 0.7 * there.norm(dim=1)).all()), "the board is ahead, in the rows within 38 degrees"
    done = command.ran("correct", model, table, "-o", tmp_path / "d.csv")
    (header, *before), (_, *after) = cells(table), cells(tmp_path / "d.csv")
    for one, other in zip(before, after, strict=True):
        assert [float(cell) for cell in other[:6]] == pytest.approx([float(cell) for cell in one[:6]], abs=0.5)
    assert poses[0] == [*header[:6], "rank"]
    written = []  # a tool is a rotation vector whatever the poses are, and commands by default as the poses
    for convention, options in (("xyz", []), ("rotvec", ["--convention", "rotvec", "--rotation-angle", "deg"])):
        tool = ["--tool", "0,0,100,20,30,40", *options]
        command.ran("correct", model, table, *tool, "-o", tmp_path / "c.csv")
        header, *rows = cells(tmp_path / "c.csv")
        at = header.index("command_z") + 1
        turns = [[float(cell) for cell in row[at : at + 3]] for row in rows]
        written.append(rotation_matrices(turns, convention, angle="deg"))
    assert_close(*written, rtol=0, atol=1e-6)


@pytest.mark.usefixtures("given_scales")
def test_a_fixed_camera_and_columns_of_opencv(tmp_path: Path, command: Command, init: Any) -> None:
    init(in_opencv(tmp_path / "t.csv", seen(flange(), camera_on_tool=False)))
    command.ran("fit", tmp_path / "c.toml", "--holdout", "0", "--json", tmp_path / "f.json")
    check_hand_eye(tmp_path / "f.json", camera_in_base=BOARD, board_in_tip=CAMERA)


@pytest.mark.usefixtures("given_scales")
def test_poses_of_a_tool_that_never_tilts(tmp_path: Path, command: Command) -> None:
    commanded = flange()
    turn = torch.stack([*torch.zeros(2, len(commanded), dtype=torch.float64), drawn(len(commanded), seed=4)], 1)
    commanded[:, :3, :3] = turned(turn) @ torch.tensor(DOWN, dtype=torch.float64)
    table = from_the_tool(tmp_path / "t.csv", commanded, "rotvec", "rad")
    pose = ["--robot-pose", f"{POSE}=rotvec", "--length", "mm", "--angle", "rad"]
    done = command("fit", table, *pose, *SEEN, "-o", tmp_path / "m")
    assert done.code in (0, 2), done.error
    assert re.search(r"is known to \d+ mm only: turn the tool about several axes", done.err)
    command.ran("plan", tmp_path / "m", "-n", "4", "-o", tmp_path / "n.csv")
    _, *rows = cells(tmp_path / "n.csv")
    new = torch.tensor([[float(cell) for cell in row[3:6]] for row in rows], dtype=torch.float64)
    z = turned(new)[:, :, 2]
    assert float((z @ z.mT).min()) < 0.97


@pytest.mark.slow
def test_the_error_field_of_a_gantry(tmp_path: Path, command: Command, init: Any) -> None:
    commanded = places(80)
    measured = bent(commanded) + 2e-5 * drawn(80, 3, seed=2)
    init(write_columns(tmp_path / "t.csv", **{"cmdx_cmdy_cmdz": 1e3 * commanded, "x_y_z": 1e3 * measured}))
    command.ran("fit", tmp_path / "c.toml", "--report", tmp_path / "r.html")
    report = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "Why" in report
    assert "Gravity" not in report
    alone = write_columns(tmp_path / "commanded.csv", x_y_z=1e3 * commanded[:5])
    command.ran("predict", tmp_path / "t.safetensors", alone, "--robot-pose", "x,y,z", "-o", tmp_path / "p.csv")
    assert table_format(Units(length="mm", robot_pose="x,y,z")).angle == "deg"  # places have no angle to state
    assert cells(tmp_path / "p.csv")[0][:6] == ["x", "y", "z", "predicted_x", "predicted_y", "predicted_z"]
    written = ["--field", tmp_path / "f.csv", "--grid", "4x4x2", "--length", "m"]
    command.ran("export", tmp_path / "t.safetensors", *written)
    field = torch.tensor([[float(cell) for cell in row] for row in cells(tmp_path / "f.csv")[1:]])
    assert field.shape == (32, 9)
    place, add, std = field.double().split(3, 1)
    assert rigid_rms(bent(place + add), place) < 0.15 * rigid_rms(bent(place), place)
    expected = dc.load(tmp_path / "t.safetensors").predict(place, noise=False)[1][:, 0].diagonal(dim1=1, dim2=2).sqrt()
    assert_close(std, expected, rtol=0.05, atol=1e-7)  # the device stands upright


def slides(z: float) -> tuple[Tensor, Tensor]:
    """Places that two slides of a machine went to, at a height, and where it was: it sinks along x, m."""
    went = places(40)
    went[:, 2] = z
    measured = bent(went) + 2e-5 * drawn(40, 3, seed=2)
    measured[:, 2] += 3e-4 * (4.0 * went[:, 0]).sin()
    return went, measured


def test_a_slide_that_stood_still_is_corrected(tmp_path: Path, command: Command) -> None:
    went, measured = slides(0.1)
    measured[:, 1] += 1e-4 * drawn(40, 1, seed=3)[:, 0]  # of the machine, since a device errs along all axes alike
    table, model = tmp_path / "t.csv", tmp_path / "m.safetensors"
    write_columns(table, cmdx_cmdy_cmdz=1e3 * went, x_y_z=1e3 * measured)
    done = command("fit", table, "--robot-pose", "cmdx,cmdy,cmdz", *MEASURED, "--holdout", "0", "-o", model)
    assert done.code in (0, 3), done.error
    assert "noise of the commands counts as the machine's errors" in done.out
    loaded: Any = dc.load(model)
    assert loaded.map.unresolved[1].sqrt() > 5e-5
    done = command.ran("export", model, "--field", tmp_path / "f.csv", "--grid", "5x3x2", "--length", "mm")
    header, *rows = cells(tmp_path / "f.csv")
    added = torch.tensor([float(row[header.index("add_z [mm]")]) for row in rows])
    assert float(added.max() - added.min()) > 0.1


@pytest.mark.slow
def test_a_table_with_two_slides_is_corrected_where_it_can_move(tmp_path: Path, command: Command, init: Any) -> None:
    went, measured = slides(0.0)
    table = write_columns(tmp_path / "t.csv", cmdx_cmdy=1e3 * went[:, :2], x_y_z=1e3 * measured)
    assert init(table)[0]["robot-pose"] == "cmdx,cmdy"
    done = command("fit", tmp_path / "c.toml", "--holdout", "0")
    assert done.code in (0, 3), done.error
    done = command.ran("correct", tmp_path / "t.safetensors", table, "-o", tmp_path / "p.csv")
    header, *rows = cells(tmp_path / "p.csv")
    assert {row[header.index("status")] for row in rows} == {"reached"}
    sent = torch.tensor([[*map(float, row[:2]), 0.0] for row in rows], dtype=torch.float64) / 1e3
    assert rigid_rms(bent(sent), went) < 0.15 * rigid_rms(bent(went), went)
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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"'own.py' cannot be read \(No such file or directory\)"),
        ("1 +", "'own.py' does not run: got SyntaxError"),
        ("f = 1 / 0", "'own.py' does not run: got ZeroDivisionError"),
        ("import sys; sys.exit()", "'own.py' does not run: got SystemExit"),
        ("def f(q): raise SystemExit", "own.py:f of 5 rows: got SystemExit"),
        (
            "from __future__ import annotations; import dataclasses, other; f = other.f\n"
            "@dataclasses.dataclass\nclass A: a: int\n",
            r"returns: expected places \(5, k\).* got \(4, 2\)",
        ),
        ("f = None", "the file 'own.py': expected a function f"),
        ("def f(q): return q @ q", "own.py:f of 5 rows: got RuntimeError"),
        ("def f(q): return q[:, :1].expand(-1, 4)", r"returns: expected places \(5, k\).* got \(5, 4\)"),
        ("def f(q): return q[:4]", r"returns: expected places \(5, k\).* got \(4, 2\)"),
        ("def f(q): return 1.0", r"returns: expected places \(5, k\).* got \(\)"),
        ("def f(q): return (q - q[2:3]).log()", "of row .*2.*: expected finite numbers"),
        *((f"def f(q): return q{how}", "of a row: expected always the same") for how in (" - q.mean(0)", ".cumsum(0)")),
    ],
)
def test_refused_functions(text: str | None, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    joints._names.cache_clear()
    if text is not None:
        (tmp_path / "own.py").write_text(text, encoding="utf-8")
        (tmp_path / "other.py").write_text("def f(q): return q[:4]", encoding="utf-8")
    with pytest.raises(MeasurementError, match=message):
        PoseColumns.of("a,b=own.py:f").poses(drawn(5, 2, seed=0))


@pytest.mark.usefixtures("given_scales")
def test_a_function_in_place_of_a_robot(tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which a campaign file names beside it; a model file starts no program."""
    monkeypatch.chdir(tmp_path)
    write_commanded_tables(tmp_path)
    pose, model = ["--robot-pose", "q1,q2,q3=my_delta.py:kinematics"], "m.safetensors"
    entries = {"csv": "delta.csv", "robot-pose": pose[1], "position": "x,y,z", "length": "mm", "angle": "deg"}
    Path("c.toml").write_text("\n".join(f'{name} = "{value}"' for name, value in entries.items()), encoding="utf-8")
    (tmp_path / "elsewhere").mkdir()
    with monkeypatch.context() as patch:
        patch.chdir(tmp_path / "elsewhere")
        done = command("fit", tmp_path / "c.toml", "-o", tmp_path / model)
    assert done.code == 0, done.error
    done = command("evaluate", model, "delta.csv")
    assert done.code == 1
    assert "type it again, a model file starts no program: --robot-pose q1,q2,q3=" in done.error
    done = command.ran("predict", model, "delta.csv", *pose, "-o", "p.csv")
    text = Path("my_delta.py").read_text(encoding="utf-8")
    for written, options, away in (("300.5 *", [], r"0\.\d+ mm"), ("300 *", ["--length", "m"], r".e\+05 mm")):
        joints._names.cache_clear()
        Path("my_delta.py").write_text(text.replace("300 *", written), encoding="utf-8")
        done = command("evaluate", model, "delta.csv", *pose, *options)
        assert re.search("py:kinematics: expected the function that the model was fitted with, .*" + away, done.error)
    Path("metres.py").write_text(f"{text.replace('return elbows', 'return 1e-3 * (elbows')})", encoding="utf-8")
    done = command("fit", "delta.csv", *pose[:1], pose[1].replace("my_delta", "metres"), *MEASURED, "-o", "w")
    assert "1000 times too large: check their unit (--length), and that of the commanded ones" in done.error
    done = command("predict", model, "delta.csv", "--robot-pose", "q1,q2,q3", "-o", "q.csv")
    assert "type it again, a model file starts no program" in done.error  # joint values are no places
    (header, *rows), (_, *measured) = cells(Path("p.csv")), cells(Path("delta.csv"))
    assert header[:6] == ["x", "y", "z", "predicted_x", "predicted_y", "predicted_z"]
    found = torch.tensor([[float(cell) for cell in row[:6]] for row in rows], dtype=torch.float64)
    q = torch.tensor([[float(cell) for cell in row[:3]] for row in measured], dtype=torch.float64)
    kinematics = runpy.run_path("my_delta.py")["kinematics"]
    nominal, exact = kinematics(q), 1.001 * kinematics(q + torch.tensor([0.1, -0.05, 0.08]))  # without noise
    assert_close(found[:, :3], nominal, rtol=0, atol=1e-6)
    assert float((found[:, 3:] - exact).norm(dim=1).mean()) < 0.2 * rigid_rms(nominal, exact)
    command.ran("plan", model, "-n", "3", *pose, "-o", "n.csv")
    assert cells(Path("n.csv"))[0] == ["x", "y", "z", "rank"]
    done = command.ran("correct", model, "targets.csv", *pose, "-o", "c.csv")
    header, *rows = cells(Path("c.csv"))
    assert {row[header.index("status")] for row in rows} == {"reached"}
    corrected = [[float(row[header.index(axis)]) for axis in "xyz"] for row in rows]
    assert "q1" not in header  # of the program before
    again = write_columns(Path("again.csv"), x_y_z=torch.tensor(corrected, dtype=torch.float64))
    command.ran("predict", model, again, "--robot-pose", "x,y,z", *MEASURED[2:], "-o", "a.csv")
    reached = [[float(cell) for cell in row[3:6]] for row in cells(Path("a.csv"))[1:]]
    wanted = nominal[:5] - nominal[:5].mean(0)
    assert rigid_rms(wanted, torch.tensor(reached, dtype=torch.float64)) < 0.05  # of the frame of the device
