"""`init`: which robot, link, columns, units, conventions and kinds of rows it proposes, and what `fit` says."""

import math
import os
import re
import shlex
from dataclasses import replace
from math import degrees, pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_bank import Command
from init_bank import (
    ARM,
    NAMES,
    ROWS,
    SERIES,
    XYZ,
    Proposed,
    noise,
    reasons,
    rows,
    write_socket_table,
    write_wire_table,
)
from kind_bank import kind_named
from product_bank import simulated_poses
from robots_bank import FOLDER
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.cli.guesses import guess_sheet, rows_in
from diffeo_calib.cli.main import expanded
from diffeo_calib.cli.options import Rows
from diffeo_calib.cli.tables import as_at_the_fit, described
from diffeo_calib.common.errors import InputError
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.poses import rotation_numbers, to_spherical
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm

JOINT = (
    '<link name="{2}"/><joint name="{0}" type="{3}"><parent link="{1}"/><child link="{2}"/>'
    '<origin xyz="0 0 .06"/><axis xyz="0 1 0"/><limit lower="0" upper=".8"/>{4}</joint>'
)
GRIPPER = (
    ("mount", "flange", "hand", "fixed", ""),
    ("slide", "hand", "left_jaw", "prismatic", ""),
    ("follower", "hand", "right_jaw", "prismatic", '<mimic joint="slide"/>'),
)
OPENING = torch.linspace(0.0, 50.0, ROWS, dtype=torch.float64)[
    torch.randperm(ROWS, generator=torch.Generator().manual_seed(1))
][:, None]
"""Of the gripper, mm."""


def write_arm(folder: Path, *joints: tuple[str, ...]) -> None:
    ARM.write_urdf(folder / "arm.urdf")
    text = (folder / "arm.urdf").read_text()
    text = text.replace("</robot>", "".join(JOINT.format(*joint) for joint in joints) + "</robot>")
    (folder / "arm.urdf").write_text(text)


SLIDES = (OPENING[:, :0], ""), (20.0 + 0.0 * OPENING, "slide hardly moves"), (OPENING, "with slide the nominal robot")


@pytest.mark.parametrize(("slide", "why"), SLIDES)
def test_the_tip_is_before_a_gripper(slide: Tensor, why: str, tmp_path: Path, proposed: Proposed) -> None:
    write_arm(tmp_path, *GRIPPER)
    q, points = rows()
    entries, text = proposed((NAMES, q), (XYZ, points), *[(["slide"], slide)] * slide.shape[1])
    assert (entries["base"], entries["tip"], entries["joints"]) == ("base_link", "flange", ",".join(NAMES))
    assert f"behind {NAMES[-1]}" in reasons(text)["tip"]
    assert why in reasons(text)["tip"]
    assert ("slide" in text.splitlines()[-1]) == bool(slide.numel()), "it is not used"


@pytest.mark.parametrize("tip", ["left_jaw", "flange", "arm_ee"])
def test_the_tip_is_what_carries_the_marker(tip: str, tmp_path: Path, proposed: Proposed) -> None:
    """On the last axis a marker tells nothing of its joint, but this is one of the arm's."""
    write_arm(tmp_path, *GRIPPER[: 3 * (tip == "left_jaw")])
    if tip == "arm_ee":  # fixed behind the last link, which has another name
        write_arm(tmp_path, ("mount", "flange", tip, "fixed", ""))
        (tmp_path / "arm.urdf").write_text((tmp_path / "arm.urdf").read_text().replace('"flange"', '"link_6"'))
    robot = dc.load_urdf(tmp_path / "arm.urdf", "base_link", tip)
    q, slide = ARM.measure(ROWS, seed=0)[0], OPENING if tip == "left_jaw" else OPENING[:, :0]
    points = 1e3 * robot(torch.cat([q, slide / 1e3], 1))[:, :3, 3] + noise(ROWS, 3, size=1.0)
    entries, text = proposed((robot.joint_names, torch.cat([q.rad2deg(), slide], 1)), (XYZ, points))
    assert entries["tip"] == tip
    assert (f"{tip} is the flange, by its name" in text) == (tip != "left_jaw")


def test_two_arms_that_explain_the_rows_alike_are_not_guessed(tmp_path: Path, proposed: Proposed) -> None:
    """Numbered columns may be of either arm; named after its joints they are of one."""
    write_arm(tmp_path)
    body = (tmp_path / "arm.urdf").read_text().partition('<robot name="simulated_arm">')[2].partition("</robot>")[0]
    arms = [re.sub(r'(<link name|<joint name|link)="', rf'\1="{side}_', body) for side in ("left", "right")]
    mount = '<joint name="{0}" type="fixed"><parent link="torso"/><child link="{0}_base_link"/></joint>'
    parts = ['<robot name="two"><link name="torso"/>', *(mount.format(side) for side in ("left", "right")), *arms]
    (tmp_path / "two.urdf").write_text("".join([*parts, "</robot>"]))
    q, points = rows()
    _, text = proposed(([f"q{k}" for k in range(6)], q), (XYZ, points), robot="two.urdf")
    assert "expected some that explain the rows far better, got left_waist_joint" in text
    right = [f"right_{name}" for name in NAMES], q
    assert proposed(right, (XYZ, points), robot="two.urdf")[0]["tip"] == "right_flange"
    numbered = [f"right q{k}" for k in range(6)], q
    assert proposed(numbered, (XYZ, points), robot="two.urdf")[0]["tip"] == "right_flange"
    places = [[f"{side} ball {axis}" for axis in XYZ] for side in ("left", "R")]
    both = (([f"left_{name}" for name in NAMES], q.roll(1, 0)), (places[0], points.roll(1, 0)), (places[1], points))
    assert proposed(right, *both, robot="two.urdf")[0]["tip"] == ["left_flange", "right_flange"]


GON = 200.0 / pi
GIVEN = ["--length", "mm", "--angle", "deg", "--position", "x,y,z"]


DH = [(0.07, -pi / 2, 0.41, 0.0), (0.5, 0.0, 0.0, -pi / 2), (0.04, -pi / 2, 0.0, 0.0)]
DH += [(0.0, pi / 2, 0.45, 0.0), (0.0, -pi / 2, 0.0, 0.0), (0.0, 0.0, 0.09, pi)]


def write_dh_arm(folder: Path, convention: str, scale: float, joints: str) -> tuple[Tensor, Tensor]:
    """A DH file, and rows, deg and mm, of a robot that differs from it by a millimetre and a milliradian."""
    lines = [f"{degrees(theta)},{scale * d},{scale * a},{degrees(alpha)}" for a, alpha, d, theta in DH]
    (folder / "arm.csv").write_text("\n".join(["theta,d,a,alpha", *lines]))
    found = (torch.tensor(DH, dtype=torch.float64) + noise(6, 4, size=1e-3)).tolist()
    robot = dc.from_dh(found, convention, [joints.format(k + 1) for k in range(6)])
    q = 3.0 * torch.rand(ROWS, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(4)) - 1.5
    return q.rad2deg(), 1e3 * (robot(q) @ torch.tensor([0.08, 0.04, 0.1, 1.0], dtype=torch.float64))[:, :3]


@pytest.mark.parametrize("convention", ["craig", pytest.param("standard", marks=pytest.mark.slow)])
def test_the_convention_of_a_table(convention: str, tmp_path: Path, command: Command, proposed: Proposed) -> None:
    scale = 1e3 if convention == "craig" else 1.0
    q, points = write_dh_arm(tmp_path, convention, scale, "J{}")
    columns = [f"J{k}" for k in range(1, 7)]
    entries, text = proposed((columns, q), (XYZ, points), robot="arm.csv")
    assert (entries["robot"], entries["dh-convention"]) == ("arm.csv", convention)
    assert entries["joints"] == ",".join(columns)
    assert not {"base", "tip"} & set(entries)
    assert f"lengths in {'m' if scale == 1 else 'mm'}, angles in deg" in reasons(text)["robot"]
    fitted = command("fit", tmp_path / "t.csv", "--robot", tmp_path / "arm.csv", *GIVEN, "-o", tmp_path / "m")
    assert "--dh-convention; `init` finds the one that fits" in fitted.error


def test_of_equal_series_the_robot_decides(proposed: Proposed, tmp_path: Path, command: Command) -> None:
    (q, points), other = rows(), [f"A{k}" for k in range(1, 7)]
    written, text = proposed((other, noise(ROWS, 6, size=40.0)), (SERIES, q), (XYZ, points))
    assert written["joints"] == ",".join(SERIES)
    assert "; not A1 to A6" in text
    written, text = proposed((other, q + noise(ROWS, 6, size=1e-4)), (SERIES, q), (XYZ, points))
    assert "joints" not in written
    for names in (other, SERIES):
        assert f'# joints = "{",".join(names)}"  # uncomment the right line' in text
    assert command("fit", tmp_path / "c.toml").code == 1


def test_wished_places_and_names_that_contradict_the_numbers(proposed: Proposed) -> None:
    q, points = rows()
    nominal = 1e3 * ARM.nominal(q.deg2rad())[:, :3, 3]
    names = [f"m{k}_{axis}" for k in (1, 2) for axis in "xyz"]
    written, text = proposed((SERIES, q), (names, torch.cat([nominal, points], 1)))
    assert written.get("position") == ["m2_x,m2_y,m2_z"], text
    assert 'position = ["m2_x,m2_y,m2_z"]  # 1 marker(s), by their names' in text
    assert "m1_x, m1_y, m1_z: marker 0 follows the nominal robot to 0.00" in text
    above = torch.cat([q[:, :2], -q[:, 1:2] - q[:, 2:3], q[:, 3:]], 1)  # the forearm, from the horizon on
    other, text = proposed((SERIES, above), (names, torch.cat([nominal, points], 1)))
    assert (other["position"], other["joints"].split(",")[2]) == (written["position"], "-{j2}-{j3}"), text
    written, text = proposed((SERIES, q), (names, torch.cat([points, points], 1)))
    assert written["position"] == ["m1_x,m1_y,m1_z"]
    assert "m2_x, m2_y, m2_z: marker 1 is a copy of marker 0 (counted from 0); not used" in text
    twice = [f"{name}_{unit}" for unit in ("rad", "deg") for name in NAMES]
    places = (["x_m", "y_m", "z_m", "x_mm", "y_mm", "z_mm"], torch.cat([(points / 1e3).round(decimals=3), points], 1))
    written, text = proposed((twice, torch.cat([q.deg2rad(), q], 1)), places)
    assert (written["position"], written["length"]) == (["x_mm,y_mm,z_mm"], "mm")
    assert (written["joints"], written["angle"]) in [(",".join(twice[:6]), "rad"), (",".join(twice[6:]), "deg")]
    assert "x_m, y_m, z_m: places in another unit; not used" in text
    _, text = proposed((SERIES, q), (["goal_x", "goal_y", "goal_z"], nominal))
    assert "got goal_x, goal_y, goal_z: wished places" in text
    q, points = rows()
    _, text = proposed(([f"{name} [rad]" for name in SERIES], q), (["x [mm]", "y [mm]", "z [mm]"], points))
    assert "the units that the file states exclude others" in text
    some = [f"{name}.pos" for k, name in enumerate(NAMES) if k != 3]
    _, text = proposed((some, q[:, :5]), (XYZ, points))
    assert f"No column is named after {NAMES[3]}" in text


def test_places_as_a_distance_and_angles(proposed: Proposed) -> None:
    """Only the robot tells in which direction the angles count, and, without names of units, in which unit."""
    q, points = rows()
    clockwise, up = ("Hz [gon]", "V [gon]", "zenith_clockwise_gon"), ("Azimuth", "Elevation", "elevation_gon")
    for *names, written in (clockwise, up):
        seen = to_spherical(points, written) * torch.tensor([1.0, GON, GON])
        found, _ = proposed((SERIES, q), (["Slope dist", *names], seen))
        assert found["position"] == [f"{written}=Slope dist,{names[0]},{names[1]}"]
        assert (found["length"], found["angle"]) == ("mm", "deg")


def test_axes_that_stand_still_and_lines_without_joints(tmp_path: Path, proposed: Proposed, init: Proposed) -> None:
    q, points = rows()
    found, _ = proposed((SERIES, q), (["j7", "j8"], torch.zeros(ROWS, 2)), (XYZ, points))
    assert found["joints"] == ",".join(SERIES)
    lines = [",".join([*SERIES, "ball", *XYZ])]
    for values, place in zip(q.tolist(), points.tolist(), strict=True):
        lines += [",".join([*map(repr, values), "A", *map(repr, place)]), ",".join([*[""] * 6, "B", *map(repr, place)])]
    (tmp_path / "t.csv").write_text("\n".join([*lines, lines[-2], lines[-1]]))
    found, _ = init(tmp_path / "t.csv", tmp_path / "arm.urdf")
    assert (found["marker"], found["duplicates"]) == ("ball", "drop")


@pytest.mark.parametrize("by_rows", [True, False])
def test_poses_as_numbers_of_matrices_and_of_other_conventions(by_rows: bool, proposed: Proposed) -> None:
    """Sixteen, or twelve: these keep the last joint though its place does not move."""
    q = rows()[0]
    q[:, 5] *= 0.1
    poses = ARM.nominal(q.deg2rad())
    poses[:, :3, 3] = 1e3 * poses[:, :3, 3] + noise(ROWS, 3, size=0.5)
    names = [f"O_T_EE[{k}]" for k in range(16)]
    wished = [f"{name}_d" for name in names], poses.flatten(1)
    written, _ = proposed((SERIES, q), wished, (names, (poses if by_rows else poses.mT).flatten(1)))
    order = torch.arange(16).view(4, 4) if by_rows else torch.arange(16).view(4, 4).mT
    assert written["position"] == [",".join(names[int(k)] for k in order[:3, 3])]
    assert written["rotation"] == ",".join(names[int(k)] for k in order[:3, :3].flatten())
    assert written["convention"] == "matrix"
    if by_rows:
        names = [f"T{row}{k}" for row in range(3) for k in range(4)]
        written, _ = proposed((SERIES, q), (names, poses[:, :3].flatten(1)))
        assert (written["joints"], written["convention"]) == (",".join(SERIES), "matrix")
    own, name, unit = (["qx", "qy", "qz", "qw"], "quat_xyzw", None) if by_rows else (["rx", "ry", "rz"], "ZXZ", "rad")
    numbers = rotation_numbers(poses[:, :3, :3], name, angle=unit or "rad")
    written, _ = proposed((SERIES, q), (XYZ, poses[:, :3, 3]), (own, numbers))
    assert (written["rotation"], written["convention"], written.get("rotation-angle")) == (",".join(own), name, unit)


COLUMN = (FOLDER / "column.urdf").read_text()
"""A slide and two turning joints."""
UNIT = torch.rand(30, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def lift(folder: Path, travel: float = 1.2) -> tuple[Tensor, Tensor]:
    """A URDF, joint values (30, 3) and places of the hand (30, 3), rad and m."""
    (folder / "arm.urdf").write_text(COLUMN)
    q = UNIT * torch.tensor([travel, 3.0, 2.0], dtype=torch.float64) - torch.tensor([0.0, 1.5, 1.0])
    away = torch.randn(30, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return q, dc.load_urdf(folder / "arm.urdf")(q)[:, :3, 3] + 0.3 + 2e-3 * away


@pytest.mark.parametrize(
    ("factors", "written"),
    [
        ((1.0, 1.0, 1.0), {"length": "m", "angle": "rad"}),
        ((100.0, 180 / math.pi, 100.0), {"length": "cm", "angle": "deg"}),
        ((1 / 0.0254, 1.0, 1 / 0.0254), {"length": "inch", "angle": "rad"}),
        ((1.0, 180 / math.pi, 1e3), {"length": "mm", "angle": "deg", "joint-length": "m"}),
    ],
)
def test_units(factors: tuple[float, ...], written: dict[str, str], tmp_path: Path, proposed: Proposed) -> None:
    slide, angle, length = factors
    q, points = lift(tmp_path)
    cells = torch.cat([q[:, :1] * slide, q[:, 1:] * angle], 1)
    found, text = proposed((["up", "one", "two"], cells), (XYZ, points * length))
    assert {name: found[name] for name in ("length", "angle", "joint-length") if name in found} == written
    assert found["joints"] == "up,one,two"
    assert "all columns are used" in text


def test_a_short_slide_and_a_sign_where_the_file_states_its_units(tmp_path: Path, proposed: Proposed) -> None:
    """Read in mm a short slide seems to stand still, and the rest explains the rows nearly as well."""
    q, points = lift(tmp_path, travel=0.096)
    found, _ = proposed((["up", "one", "two"], q), (XYZ, 1e3 * points))
    assert [found[name] for name in ("length", "angle", "joint-length")] == ["mm", "rad", "m"]
    q, points = lift(tmp_path)
    q[:, 2] *= -1
    found, _ = proposed((["up", "one [rad]", "two [rad]"], q), (XYZ, points))
    assert found["joints"] == "up,one [rad],-{two [rad]}"
    _, text = proposed((["q1", "q2"], q[:, [0, 2]]), (XYZ, points))
    assert "2 numbered columns do not say which of 3 joints they are" in text
    q, points = lift(tmp_path)
    gon = q * q.new_tensor([1.0, GON, GON])
    found, _ = proposed((["up", "one [gon]", "two [gon]"], gon), (["East", "North", "Up"], points))
    assert (found["joints"], found["angle"]) == ("up,0.9*{one [gon]},0.9*{two [gon]}", "deg")
    assert found["position"] == ["East,North,Up"]
    head = COLUMN.replace('<origin xyz=".5 0 0"/>', "").replace('"prismatic"', '"fixed"')
    (tmp_path / "arm.urdf").write_text(head)  # axes that meet in a point: the rows do not tell the unit of length
    places = dc.load_urdf(tmp_path / "arm.urdf")(q[:, 1:])[:, :3, 3]
    found, text = proposed((["one", "two"], q[:, 1:]), (XYZ, places))
    assert "length" not in found
    assert '# length = "mm"  # the robot explains the rows in each' in text


@pytest.mark.slow
def test_signs_and_a_zero_are_proposed_and_read(tmp_path: Path, command: Command, proposed: Proposed) -> None:
    q, points = rows()
    read = q * torch.tensor([1.0, -1.0, 1.0, 1.0, 1.0, 1.0]) + torch.tensor([0.0, 0.0, 90.0, 0.0, 0.0, 0.0])
    found, text = proposed((NAMES, read), (XYZ, points))
    expected = f"{NAMES[0]},-{{{NAMES[1]}}},{{{NAMES[2]}}}-90,{','.join(NAMES[3:])}"
    assert found["joints"] == expected
    robot = ["--robot", tmp_path / "arm.urdf", "--base", "base_link", "--tip", "flange"]
    done = command("fit", tmp_path / "t.csv", *robot, *GIVEN, "-o", tmp_path / "m")
    assert done.code == 1
    assert f"the rows fit with --joints '{expected}'" in done.error
    q[:, 4] *= -1
    found, _ = proposed((NAMES, q), (XYZ, points))
    assert found["joints"] == f"{','.join(NAMES[:4])},-{{{NAMES[4]}}},{NAMES[5]}"  # by the limits
    urdf = (tmp_path / "arm.urdf").read_text()
    (tmp_path / "free.urdf").write_text(urdf.replace('"revolute"', '"continuous"'))
    found, text = proposed((NAMES, q), (XYZ, points), robot="free.urdf")
    assert "joints" not in found
    lines = [line for line in text.splitlines() if line.startswith("# joints = ")]
    assert ["uncomment one" in line for line in lines] == [True, True]
    found, _ = proposed(([f"A{k}" for k in range(1, 7)], read), (SERIES, read), (XYZ, points))
    assert found["joints"] == "A1,-{A2},{A3}-90,A4,A5,A6"  # of equal series the first


@pytest.mark.parametrize("table", [TableFormat("m", "rad", ";", ","), TableFormat("mm", "deg", "\t")])
def test_a_proposal_is_that_of_the_table(table: TableFormat, tmp_path: Path, command: Command) -> None:
    arm = SimulatedArm(seed=3, markers=2)
    arm.write_urdf(tmp_path / "arm.urdf")
    data = dc.Measurements(*arm.measure(60, seed=0), NAMES)
    positions = [["left x", "left y", "left z"], ["right x", "right y", "right z"]]
    write_measurements(tmp_path / "t.csv", data, table, position=positions)
    out = tmp_path / "sub" / "cell.toml"
    out.parent.mkdir()
    done = command.ran("init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", out, silent=True)
    assert "the nominal robot leaves, of what the rows vary" in done.out
    words = expanded(["fit", str(out)])
    assert os.path.realpath(words[1]) == os.path.realpath(tmp_path / "t.csv")
    read = described(as_at_the_fit(shlex.join(words), Rows()))
    assert read == replace(table, position=positions, joints=NAMES)
    assert [words[words.index(name) + 1] for name in ("--base", "--tip")] == ["base_link", "flange"]


@pytest.mark.parametrize(
    ("count", "per_degree", "message"),
    [(ROWS, 1.0, "one clear reading"), (3, 1.0, "3 row(s)"), (ROWS, 90.0, "pulses or ticks of encoders; write joints")],
)
def test_no_robot_that_fits(count: int, per_degree: float, message: str, tmp_path: Path, proposed: Proposed) -> None:
    points = 1e3 * SimulatedArm(seed=4).measure(count, seed=9)[1][:, 0]
    entries, text = proposed((NAMES, per_degree * rows()[0][:count]), (XYZ, points))
    assert message in text
    assert not entries
    assert not (tmp_path / "c.toml").exists()


def test_a_column_of_texts_names_the_set_ups(tmp_path: Path, frame: Any, init: Proposed) -> None:
    """Under any name, where the robot explains the rows of each text but not all of them."""
    frame["Ort"] = ["Halle", "Tor"] * (ROWS // 2)
    frame.loc[1::2, XYZ] = frame.loc[1::2, XYZ].to_numpy() @ np.diag([-1.0, -1.0, 1.0]) + 900.0
    frame.to_csv(tmp_path / "t.csv", index=False)
    assert init(tmp_path / "t.csv", tmp_path / "arm.urdf")[0]["session"] == "Ort"


def test_what_explains_the_rows_is_said(proposed: Proposed) -> None:
    q, points = rows()
    turn = points.new_tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = torch.cat([points[: ROWS // 2], points[ROWS // 2 :] @ turn + 900.0])
    entries, text = proposed((NAMES, q), (XYZ, moved))
    assert not entries
    assert re.search(r"the (first|last) \d+ rows alone, mm and deg: \S+ %; if the device moved", text)


def test_sockets_are_proposed(tmp_path: Path, proposed: Proposed, init: Proposed) -> None:
    """Angles in degrees, known by the ball; distances are for the user to fill in. Beside positions in their unit."""
    arm, table = SimulatedArm(seed=1), tmp_path / "t.csv"
    arm.write_urdf(tmp_path / "arm.urdf")
    write_socket_table(table, arm, "ab", 1)
    written, text = init(table, tmp_path / "arm.urdf")
    assert (written["socket"], written["angle"], written["length"]) == ("place,socket", "deg", "mm")
    assert not {"position", "distance", "distance-std"} & set(written)
    assert "# all columns are used" in text
    (tmp_path / "cell.toml").write_text(text.replace("# distance", "distance"))
    words = expanded(["fit", str(tmp_path / "cell.toml")])
    assert [words[words.index(name) + 1] for name in ("--socket", "--distance")] == ["place,socket", "a,b=50"]
    header, *lines = table.read_text().split("\n")
    holes = [line.replace(",", "", 1) for line in lines]
    table.write_text("\n".join([header.replace("place,socket", "hole"), *holes]))
    assert init(table, tmp_path / "arm.urdf")[0]["socket"] == "hole"
    table.write_text("q1,u1,v1,u2,v2,u3,v3,u4,v4\n" + "1,2,3,4,5,6,7,8,9\n" * 3)
    with pytest.raises(InputError, match="a line for each, with image, board_x"):
        rows_in(guess_sheet(table), ["q1"])
    q, points = arm.measure(20, seed=2)
    both = torch.cat([q.rad2deg(), points[:, 0]], 1).tolist()
    seen = [",".join(["", "", *map(repr, row)]) for row in both]
    table.write_text("\n".join([f"{header},x,y,z", *seen, *(f"{line},,," for line in lines)]))
    written, text = init(table, tmp_path / "arm.urdf")
    assert (written["position"], written["socket"]) == (["x,y,z"], "place,socket")
    assert (written["angle"], written["length"]) == ("deg", "m")
    assert '# distance = "a,b=0.05"' in text
    assert "# distance-std = 3e-05" in text


def test_sockets_of_a_panda(ur10_folder: Path, init: Proposed) -> None:
    """Read as degrees all angles are near zero, and the ball hardly leaves its place: 4.9 mm beside the right 2.6."""
    data = ur10_folder.parent / "mukca"
    assert init(data / "panda_3.csv", data / "panda.urdf")[0]["angle"] == "rad"


def test_rotations_that_no_convention_explains_are_named_and_not_used(tmp_path: Path, init: Proposed) -> None:
    arm, data, _ = simulated_poses(ROWS)
    arm.write_urdf(tmp_path / "arm.urdf")
    turned = data.rows([*range(1, ROWS), 0])
    mixed = dc.Measurements(data.q, data.points[:, 0], data.joint_names).to_frame()
    mixed[["rx", "ry", "rz"]] = turned.to_frame()[["rx", "ry", "rz"]].to_numpy()
    mixed.to_csv(tmp_path / "t.csv", index=False)
    written, text = init(tmp_path / "t.csv", tmp_path / "arm.urdf")
    assert "rotation" not in written
    assert "# rx, ry, rz: rotations of no convention that is clearly better than others; not used" in text


def test_deviations_are_proposed_if_they_can_be_some(tmp_path: Path, frame: Any, init: Proposed) -> None:
    for std, proposed in ((2e-5, True), (0.0, False), (0.5, False)):
        frame[["std_x", "std_y", "std_z"]] = std
        frame.to_csv(tmp_path / "t.csv", index=False)
        _, text = init(tmp_path / "t.csv", tmp_path / "arm.urdf")
        assert ('std = "std_x,std_y,std_z"' in text) is proposed
        assert ("# std_x, std_y, std_z: no standard deviations" in text) is not proposed


def test_an_edited_file_is_kept(tmp_path: Path, command: Command, frame: Any) -> None:
    frame.rename(columns={axis: f"t{axis}" for axis in XYZ}).to_csv(tmp_path / "t.csv", index=False)
    out = tmp_path / "c.toml"
    words = "init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", out
    command.ran(*words)
    assert 'position = ["tx,ty,tz"]' in out.read_text()
    assert command(*words).code == 0  # the same again
    edited = out.read_text() + "holdout = 0\n"
    out.write_text(edited)
    assert "exists and holds other options" in command(*words).error
    assert out.read_text() == edited
    command.ran(*words, "--force")
    assert "holdout" not in out.read_text()


@pytest.mark.slow
def test_a_wire_its_anchors_and_a_payload(tmp_path: Path, frame: Any, init: Proposed) -> None:
    write_wire_table(tmp_path / "wire.csv", ARM, seed=1)
    written, _ = init(tmp_path / "wire.csv", tmp_path / "arm.urdf")
    expected = {"reading": "displacement=wire", "session": "anchor", "length": "mm", "angle": "deg"}
    assert {name: written[name] for name in expected} == expected
    frame["payload_kg"], frame["time_s"], frame["Temperature"] = [0.0, 2.0] * 20, range(ROWS), [21.5] * ROWS
    frame["distance"] = 1.0  # in every row: rows of several kinds leave the cells of the other kinds empty
    frame.to_csv(tmp_path / "t.csv", index=False)
    written, _ = init(tmp_path / "t.csv", tmp_path / "arm.urdf")
    expected = {"payload": "payload_kg", "time": "time_s", "temperature": "Temperature"}
    assert {name: written.get(name) for name in (*expected, "reading")} == {**expected, "reading": None}
    frame["time_s"] += 20_210_313_000_000  # a date: `fit` refuses it
    frame.to_csv(tmp_path / "t.csv", index=False)
    assert "time" not in init(tmp_path / "t.csv", tmp_path / "arm.urdf")[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["several tips", "camera on the tool"])
def test_tips_and_cameras_are_proposed(name: str, init: Proposed) -> None:
    kind = kind_named(name)
    table, options = kind.table()
    written, _ = init(table, kind.urdf)
    given: dict[str, list[str]] = {}
    for word, value in zip(options, [*options[1:], ""], strict=True):
        if word.startswith("--"):
            given.setdefault(word.removeprefix("--"), []).append(value)
    for option, values in given.items():
        expected = [True] if option == "camera-on-tool" else values
        assert written[option] == (expected if len(expected) > 1 or option == "position" else expected[0]), option
    assert written["tip"] == (list(kind.robot.tips) if name == "several tips" else kind.robot.tip)


def test_lenses_that_no_table_holds_are_to_be_filled_in(tmp_path: Path, command: Command, init: Proposed) -> None:
    """Angles follow from the images all the same; `fit` refuses the file until the lens is there."""
    kind = kind_named("images")
    table, _ = kind.table()
    written, _ = init(table, kind.urdf)
    assert (written["reading"], written["session"], written["angle"]) == ("image=u,v,FX,FY,CX,CY", "session", "deg")
    assert "--reading image=u,v,FX,FY,CX,CY" in command.failed("fit", tmp_path / "c.toml")
