"""`init` finds units and the meaning of joint columns by what the robot explains; `fit` says the same."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest
import torch
from command_bank import Command
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots.simulated_arm import SimulatedArm

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

LIFT = """<robot name="lift"><link name="floor"/>
<joint name="up" type="prismatic"><parent link="floor"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="0" upper="1.5" effort="1" velocity="1"/></joint><link name="a"/>
<joint name="one" type="revolute"><parent link="a"/><child link="b"/><origin xyz=".1 0 .2"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint><link name="b"/>
<joint name="two" type="revolute"><parent link="b"/><child link="c"/><origin xyz=".5 0 0"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint><link name="c"/>
<joint name="end" type="fixed"><parent link="c"/><child link="hand"/><origin xyz=".4 .05 0"/></joint><link name="hand"/>
</robot>"""


def lift(folder: Path) -> tuple[Path, Tensor, Tensor]:
    """A URDF, joint values (30, 3) and places of the hand (30, 3), rad and m."""
    (folder / "lift.urdf").write_text(LIFT)
    chain = dc.load_urdf(folder / "lift.urdf", "floor", "hand")
    unit = torch.rand(30, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    q = unit * torch.tensor([1.2, 3.0, 2.0], dtype=torch.float64) - torch.tensor([0.0, 1.5, 1.0])
    noise = 2e-3 * torch.randn(30, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return folder / "lift.urdf", q, chain(q)[:, :3, 3] + 0.3 + noise


def proposed(command: Command, folder: Path, urdf: Path, names: tuple[str, ...], cells: Tensor) -> dict[str, object]:
    """The campaign that `init` writes for columns of joints and of x, y, z."""
    rows = [",".join(f"{value:.6f}" for value in row) for row in cells.tolist()]
    (folder / "t.csv").write_text("\n".join([",".join([*names, "x", "y", "z"]), *rows]) + "\n")
    done = command("init", folder / "t.csv", urdf, "-o", folder / "c.toml", "--force")
    assert done.code == 0, done.err
    text = (folder / "c.toml").read_text()
    assert "all columns are used" in text
    return tomllib.loads(text) | {"text": text}


@pytest.mark.parametrize(
    ("factors", "written"),
    [
        ((1.0, 1.0, 1.0), {"length": "m", "angle": "rad"}),
        ((100.0, 180 / math.pi, 100.0), {"length": "cm", "angle": "deg"}),
        ((1 / 0.0254, 1.0, 1 / 0.0254), {"length": "inch", "angle": "rad"}),
        ((1.0, 180 / math.pi, 1e3), {"length": "mm", "angle": "deg", "joint-length": "m"}),
    ],
)
def test_units(factors: tuple[float, float, float], written: dict[str, str], tmp_path: Path, command: Command) -> None:
    slide, angle, length = factors
    urdf, q, points = lift(tmp_path)
    cells = torch.cat([q[:, :1] * slide, q[:, 1:] * angle, points * length], 1)
    found = proposed(command, tmp_path, urdf, ("up", "one", "two"), cells)
    assert {name: found[name] for name in ("length", "angle", "joint-length") if name in found} == written
    assert found["joints"] == "up,one,two"


def test_a_short_slide_in_another_unit_is_no_error_of_the_robot(tmp_path: Path, command: Command) -> None:
    """Read in mm it seems to stand still, and the rest explains the rows nearly as well."""
    urdf, q, _ = lift(tmp_path)
    q[:, 0] *= 0.08
    points = dc.load_urdf(urdf)(q)[:, :3, 3] + 0.3
    found = proposed(command, tmp_path, urdf, ("up", "one", "two"), torch.cat([q, 1e3 * points], 1))
    assert [found[name] for name in ("length", "angle", "joint-length")] == ["mm", "rad", "m"]


def test_a_sign_where_the_file_states_its_units(tmp_path: Path, command: Command) -> None:
    urdf, q, points = lift(tmp_path)
    q[:, 2] *= -1
    found = proposed(command, tmp_path, urdf, ("up", "one [rad]", "two [rad]"), torch.cat([q, points], 1))
    assert found["joints"] == "up,one [rad],-{two [rad]}"


def test_the_size_of_a_gantry_follows_from_its_limits(tmp_path: Path, command: Command) -> None:
    link = '<joint name="{0}" type="prismatic"><parent link="{1}"/><child link="{2}"/><axis xyz="{3}"/>'
    link += '<limit lower="0" upper="1" effort="1" velocity="1"/></joint><link name="{2}"/>'
    axes = ("x1", "a", "b", "1 0 0"), ("y1", "b", "c", "0 1 0"), ("z1", "c", "d", "0 0 1")
    urdf = tmp_path / "gantry.urdf"
    urdf.write_text(f'<robot name="g"><link name="a"/>{"".join(link.format(*axis) for axis in axes)}</robot>')
    q = torch.rand(30, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    for length, per_metre in (("m", 1.0), ("mm", 1e3)):
        cells = per_metre * torch.cat([q, 0.999 * q + 0.3], 1)
        found = proposed(command, tmp_path, urdf, ("x1", "y1", "z1"), cells)
        assert found["length"] == length
        assert "limits of the joints" in str(found["text"])


@pytest.mark.slow
def test_signs_and_a_zero_are_proposed_and_read(tmp_path: Path, command: Command) -> None:
    arm = SimulatedArm(seed=3)
    arm.write_urdf(tmp_path / "arm.urdf")
    q, points = arm.measure(40, seed=4)
    read = q.rad2deg()
    read[:, 1] *= -1
    read[:, 2] += 90
    names = arm.nominal.joint_names
    cells = torch.cat([read, 1e3 * points[:, 0]], 1)
    found = proposed(command, tmp_path, tmp_path / "arm.urdf", names, cells)
    expected = f"{names[0]},-{{{names[1]}}},{{{names[2]}}}-90,{','.join(names[3:])}"
    assert found["joints"] == expected
    assert "with the columns as they are" in str(found["text"])
    done = command(
        "fit",
        tmp_path / "t.csv",
        "--robot",
        tmp_path / "arm.urdf",
        "--base",
        "base_link",
        "--tip",
        "flange",
        "--position",
        "x,y,z",
        "--length",
        "mm",
        "--angle",
        "deg",
        "-o",
        tmp_path / "m.safetensors",
    )
    assert done.code == 1
    assert f"the rows fit with --joints '{expected}'" in done.error


@pytest.mark.slow
def test_meanings_that_nothing_tells_apart_are_for_the_user(tmp_path: Path, command: Command) -> None:
    arm = SimulatedArm(seed=3)
    arm.write_urdf(tmp_path / "arm.urdf")
    q, points = arm.measure(40, seed=4)
    q[:, 4] *= -1
    cells = torch.cat([q.rad2deg(), 1e3 * points[:, 0]], 1)
    found = proposed(command, tmp_path, tmp_path / "arm.urdf", arm.nominal.joint_names, cells)
    assert "joints" not in found
    lines = [line for line in str(found["text"]).splitlines() if line.startswith("# joints = ")]
    assert len(lines) == 2
    assert all("uncomment one" in line for line in lines)
