"""Which robot, and which link: what `init` proposes, and what `fit` and `plan` take."""

import re
import shutil
import sys
from math import degrees, pi
from pathlib import Path

import pytest
import torch
from command_bank import Command
from kind_bank import kind_named

import diffeo_calib as dc
from diffeo_calib.cameras.files import camera_text
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.simulated_arm import SimulatedArm

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

JOINT = (
    '<link name="{child}"/><joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
    '<origin xyz="0 0 .06"/><axis xyz="0 1 0"/><limit lower="0" upper=".8"/>{more}</joint>'
)
MIMIC = '<mimic joint="slide"/>'
GRIPPER = [
    {"name": "mount", "kind": "fixed", "parent": "flange", "child": "hand", "more": ""},
    {"name": "slide", "kind": "prismatic", "parent": "hand", "child": "left_jaw", "more": ""},
    {"name": "follower", "kind": "prismatic", "parent": "hand", "child": "right_jaw", "more": MIMIC},
]
ARM = SimulatedArm(seed=3)
SPREAD = torch.linspace(0.0, 0.05, 40, dtype=torch.float64)[
    torch.randperm(40, generator=torch.Generator().manual_seed(1))
]


def proposed(folder: Path) -> tuple[dict[str, object], dict[str, str]]:
    """Entries of a campaign, and the reasons beside them."""
    text = (folder / "c.toml").read_text()
    lines = [line.partition("  # ") for line in text.splitlines() if not line.startswith("#")]
    return tomllib.loads(text), {line.partition(" = ")[0]: why for line, _, why in lines}


def write_arm(folder: Path, joints: list[dict[str, str]], slide: torch.Tensor | None = None) -> None:
    """An arm with more joints, and 40 rows of a marker on its hand, with values of a gripper."""
    ARM.write_urdf(folder / "arm.urdf")
    more = "".join(JOINT.format(**joint) for joint in joints)
    text = (folder / "arm.urdf").read_text().replace("</robot>", f"{more}</robot>")
    (folder / "arm.urdf").write_text(text)
    q, points = ARM.measure(40, seed=0)
    q = q if slide is None else torch.cat([q, slide[:, None]], 1)
    names = [*ARM.nominal.joint_names, "slide"][: q.shape[1]]
    kinds = ["revolute"] * 6 + ["prismatic"] * (slide is not None)
    data = dc.Measurements(q, points, names)
    write_measurements(folder / "t.csv", data, TableFormat("mm", "deg"), position=("x", "y", "z"), kinds=kinds)


@pytest.mark.parametrize(
    ("slide", "why"),
    [
        (None, ""),
        (0.02 + 0.0 * SPREAD, "slide hardly moves in the table"),
        (SPREAD, "with slide the nominal robot leaves"),
    ],
)
def test_the_tip_is_before_a_gripper(slide: torch.Tensor | None, why: str, tmp_path: Path, command: Command) -> None:
    write_arm(tmp_path, GRIPPER, slide)
    done = command("init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", tmp_path / "c.toml")
    assert done.code == 0, done.err
    entries, reasons = proposed(tmp_path)
    assert (entries["base"], entries["tip"]) == ("base_link", "flange")
    assert entries["joints"] == ",".join(ARM.nominal.joint_names)
    assert f"behind {ARM.nominal.joint_names[-1]}" in reasons["tip"]
    assert why in reasons["tip"]
    assert ("slide" in (tmp_path / "c.toml").read_text().splitlines()[-1]) == (slide is not None), "it is not used"


def test_the_tip_is_the_jaw_that_carries_the_marker(tmp_path: Path, command: Command) -> None:
    write_arm(tmp_path, GRIPPER, SPREAD)
    robot = dc.load_urdf(tmp_path / "arm.urdf", "base_link", "left_jaw")
    q = torch.cat([ARM.measure(40, seed=0)[0], SPREAD[:, None]], 1)
    points = robot(q)[:, :3, 3] + 1e-3 * torch.randn(
        40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)
    )
    dc.Measurements(q, points, robot.joint_names).to_frame().to_csv(tmp_path / "t.csv", index=False)
    done = command("init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", tmp_path / "c.toml")
    assert done.code == 0, done.err
    assert proposed(tmp_path)[0]["tip"] == "left_jaw"


def test_a_marker_on_the_last_axis_leaves_its_joint_in_the_chain(tmp_path: Path, command: Command) -> None:
    """Without the joint the robot explains the rows as well, but it is one of the arm's."""
    write_arm(tmp_path, [])
    q, robot = ARM.measure(40, seed=0)[0], dc.load_urdf(tmp_path / "arm.urdf")
    points = robot(q)[:, :3, 3] + 1e-3 * torch.randn(
        40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)
    )
    dc.Measurements(q, points, robot.joint_names).to_frame().to_csv(tmp_path / "t.csv", index=False)
    done = command("init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", tmp_path / "c.toml")
    assert done.code == 0, done.err
    assert proposed(tmp_path)[0]["tip"] == "flange"


def test_links_without_usual_names_and_joints_that_follow(tmp_path: Path, command: Command) -> None:
    """The tip is the link of the last joint, behind a wrist that follows the arm's own joints."""
    follows = f'<mimic joint="{ARM.nominal.joint_names[1]}" multiplier="0"/>'
    parts = [("level", "revolute", "flange", "plate", follows), ("screws", "fixed", "plate", "probe", "")]
    write_arm(tmp_path, [dict(zip(("name", "kind", "parent", "child", "more"), part, strict=True)) for part in parts])
    done = command("init", tmp_path / "t.csv", tmp_path / "arm.urdf", "-o", tmp_path / "c.toml")
    assert done.code == 0, done.err
    assert proposed(tmp_path)[0]["tip"] == "plate"


def test_two_arms_that_explain_the_rows_alike_are_not_guessed(tmp_path: Path, command: Command) -> None:
    """Numbered columns may be of either arm; named after its joints they are of one."""
    write_arm(tmp_path, [])
    body = (tmp_path / "arm.urdf").read_text().partition('<robot name="simulated_arm">')[2].partition("</robot>")[0]
    arms = [re.sub(r'(<link name|<joint name|link)="', rf'\1="{side}_', body) for side in ("left", "right")]
    mount = '<joint name="{0}" type="fixed"><parent link="torso"/><child link="{0}_base_link"/></joint>'
    parts = ['<robot name="two"><link name="torso"/>', *(mount.format(side) for side in ("left", "right")), *arms]
    (tmp_path / "two.urdf").write_text("".join([*parts, "</robot>"]))
    rows = (tmp_path / "t.csv").read_text().partition("\n")[2]
    series, named = [f"q{k}" for k in range(6)], [f"right_{name}" for name in ARM.nominal.joint_names]
    for names, code in ((series, 1), (named, 0)):
        (tmp_path / "t.csv").write_text(",".join([*names, "x", "y", "z"]) + "\n" + rows)
        done = command("init", tmp_path / "t.csv", tmp_path / "two.urdf", "-o", tmp_path / "c.toml")
        assert done.code == code, done.err
        if code:
            assert "expected some that explain the rows far better, got left_waist_joint" in done.error
    assert proposed(tmp_path)[0]["tip"] == "right_flange"


def test_a_robot_in_macros_and_a_folder_of_images_are_told_what_to_do(tmp_path: Path, command: Command) -> None:
    write_arm(tmp_path, [])
    name_space = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
    (tmp_path / "arm.xacro").write_text(f'<robot name="a" {name_space}><xacro:arm prefix="left"/></robot>')
    (tmp_path / "images").mkdir()
    units = ["--length", "m", "--angle", "rad", "--position", "x,y,z", "-o", tmp_path / "m.safetensors"]
    for table, robot, message in (
        ("t.csv", "arm.xacro", "expand the xacro file first (`xacro FILE > robot.urdf`)"),
        ("images", "arm.urdf", "is a folder: expected a table; of images of a board run `diffeo-calib images"),
    ):
        asked = command("init", tmp_path / table, tmp_path / robot, "-o", tmp_path / "c.toml")
        fitted = command("fit", tmp_path / table, "--robot", tmp_path / robot, *units)
        assert asked.error == fitted.error
        assert message in asked.error


ROWS = [(0.07, -pi / 2, 0.41, 0.0), (0.5, 0.0, 0.0, -pi / 2), (0.04, -pi / 2, 0.0, 0.0)]
ROWS += [(0.0, pi / 2, 0.45, 0.0), (0.0, -pi / 2, 0.0, 0.0), (0.0, 0.0, 0.09, pi)]


def write_dh_arm(folder: Path, convention: str, scale: float, joints: str, table: TableFormat) -> None:
    """A DH file, and rows of a robot that differs from it by a millimetre and a milliradian."""
    lines = [f"{degrees(theta)},{scale * d},{scale * a},{degrees(alpha)}" for a, alpha, d, theta in ROWS]
    (folder / "arm.csv").write_text("\n".join(["theta,d,a,alpha", *lines]))
    g = torch.Generator().manual_seed(4)
    errors = 1e-3 * torch.randn(6, 4, dtype=torch.float64, generator=g)
    rows = (torch.tensor(ROWS, dtype=torch.float64) + errors).tolist()
    robot = dc.from_dh(rows, convention, [joints.format(k + 1) for k in range(6)])
    q = 3.0 * torch.rand(40, 6, dtype=torch.float64, generator=g) - 1.5
    points = (robot(q) @ torch.tensor([0.08, 0.04, 0.1, 1.0], dtype=torch.float64))[:, :3]
    write_measurements(folder / "t.csv", dc.Measurements(q, points, robot.joint_names), table, position=("x", "y", "z"))


@pytest.mark.parametrize(("convention", "scale"), [("standard", 1.0), ("craig", 1e3)])
def test_the_convention_that_explains_the_rows(convention: str, scale: float, tmp_path: Path, command: Command) -> None:
    write_dh_arm(tmp_path, convention, scale, "J{}", TableFormat("mm", "deg"))
    done = command("init", tmp_path / "t.csv", tmp_path / "arm.csv", "-o", tmp_path / "c.toml")
    assert done.code == 0, done.err
    entries, reasons = proposed(tmp_path)
    assert (entries["robot"], entries["dh-convention"], entries["joints"]) == (
        "arm.csv",
        convention,
        "J1,J2,J3,J4,J5,J6",
    )
    assert not {"base", "tip"} & set(entries)
    assert f"lengths in {'m' if scale == 1 else 'mm'}, angles in deg" in reasons["robot"]
    fitted = command(
        "fit",
        tmp_path / "t.csv",
        "--robot",
        tmp_path / "arm.csv",
        *["--length", "mm", "--angle", "deg"],
        "--position",
        "x,y,z",
        "-o",
        tmp_path / "m.safetensors",
    )
    assert "--dh-convention; `init` finds the one that fits" in fitted.error


def test_a_last_row_without_a_joint_and_options_that_do_not_belong(tmp_path: Path, command: Command) -> None:
    """The row of a flange has no column; the tip is before it."""
    write_dh_arm(tmp_path, "standard", 1.0, "joint_{}", TableFormat("mm", "deg"))
    with (tmp_path / "arm.csv").open("a") as file:
        file.write("\n0,0.05,0,0\n# standard")
    done = command("init", tmp_path / "t.csv", tmp_path / "arm.csv", "-o", tmp_path / "c.toml")
    assert done.code == 0, done.err
    entries, _ = proposed(tmp_path)
    assert (entries["tip"], "dh-convention" in entries) == ("joint_6", False)
    words = ["fit", tmp_path / "t.csv", "--length", "mm", "--angle", "deg", "--position", "x,y,z", "-o", tmp_path / "m"]
    ARM.write_urdf(tmp_path / "arm.urdf")
    for robot, option, message in (
        ("arm.csv", ["--base", "link"], "--base or --load of a DH table"),
        ("arm.csv", ["--tip", "flange"], "expected one of joint_1, joint_2"),
        ("arm.urdf", ["--dh-convention", "craig"], "--dh-convention of a URDF"),
    ):
        assert message in command(*words, "--robot", tmp_path / robot, *option).error


@pytest.mark.slow
def test_the_camera_beside_the_table(tmp_path: Path, command: Command) -> None:
    """Another YAML file is none; its place is relative to the campaign, which runs from anywhere."""
    kind = kind_named("images of a board")
    table, _ = kind.table()
    (tmp_path / "sub").mkdir()
    shutil.copy(table, tmp_path / "corners.csv")
    (tmp_path / "launch.yaml").write_text("camera: none\n")
    (tmp_path / "wrist.yaml").write_text(camera_text(next(iter(kind.data.cameras.values()))))
    done = command("init", tmp_path / "corners.csv", kind.urdf, "-o", tmp_path / "sub" / "c.toml")
    assert done.code == 0, done.err
    entries, reasons = proposed(tmp_path / "sub")
    assert entries["reading"] == "corners=../wrist.yaml"
    assert "the file beside the table" in reasons["reading"]
