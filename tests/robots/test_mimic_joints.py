"""Mimic joints, driven by other joints: values and limits of chains, DH tables and URDF files that have them."""

import json
import re
from collections.abc import Mapping
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest
import torch
from robots_bank import CHAIN, KINDS, LIFT, MOVING, build, crooked_joints, draw, expand

from diffeo_calib.common.errors import RobotError
from diffeo_calib.robots import Chain, DHRow, Joint, from_dh, load_urdf
from diffeo_calib.robots.se3 import rotation
from diffeo_calib.robots.tree import robot_from_config

# torch compiles its forward-mode rules on first use with torch.jit.script, which it has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")


def test_all_joints_follow_the_active_ones() -> None:
    q = draw(5, 3)
    torch.testing.assert_close(CHAIN.moving_values(q), expand(q), rtol=0, atol=1e-15)
    assert torch.equal(CHAIN.moving_values(q)[:, [1, 2, 4]], q)


def slide(name: str, lower: float, upper: float, mimic: Mapping[str, float] | None = None, offset: float = 0) -> Joint:
    return Joint(name, "prismatic", torch.eye(4), torch.ones(3), lower, upper, mimic, offset)


def test_reach_follows_from_the_limits_of_the_drivers() -> None:
    x, motor = slide("x", -1, 2), Joint("motor", "continuous", torch.eye(4))
    assert Chain("r", "a", "b", [x]).reach == 2.0
    # y runs from 0.5 - 4 to 0.5 + 2, whatever its own limits are
    assert Chain("r", "a", "b", [x, slide("y", 0, 0.1, {"x": -2.0}, 0.5)]).reach == 5.5
    assert Chain("r", "a", "b", [motor, x]).reach == 2.0  # the motor without limits drives no slide
    assert Chain("r", "a", "b", [motor, slide("rack", -0.2, 0.3, {"motor": 0.01})]).reach == 0.3
    assert Chain("r", "a", "b", [motor, slide("rack", -inf, inf, {"motor": 0.01})]).reach == inf
    assert Chain("r", "a", "b", [motor, x, slide("y", -9, 9, {"x": 1.0, "motor": 0.0})]).reach == 4.0


# --- bad input ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "mimic", "offset", "message"),
    [
        ("revolute", {"k": nan}, 0.0, "the multiplier of 'k' in joint 'j': expected a finite number, got nan"),
        ("revolute", {"k": "two"}, 0.0, "the multiplier of 'k' in joint 'j': expected a finite number, got 'two'"),
        ("revolute", {"k": 1.0}, inf, "the mimic offset of joint 'j': expected a finite number, got inf"),
        ("revolute", {"k": 1.0}, None, "the mimic offset of joint 'j': expected a finite number, got None"),
        ("revolute", {}, 0.0, "the mimic of joint 'j': expected a mapping from names of joints to multipliers"),
        ("revolute", "k", 0.0, "the mimic of joint 'j': expected a mapping from names of joints to multipliers"),
        ("revolute", {3: 1.0}, 0.0, "the mimic of joint 'j': expected a mapping from names of joints to multipliers"),
        ("fixed", {"k": 1.0}, 0.0, "joint 'j' is fixed and cannot mimic; give it a moving kind, or no mimic."),
        ("revolute", None, 0.1, "joint 'j' has a mimic offset but mimics no joint; name the joints that drive it"),
    ],
)
def test_joints_check_their_mimic(kind: str, mimic: Any, offset: Any, message: str) -> None:
    with pytest.raises(RobotError, match=re.escape(message)):
        Joint("j", kind, torch.eye(4), mimic=mimic, mimic_offset=offset)


@pytest.mark.parametrize(
    ("mimic", "message"),
    [
        ({"rail": {"wrist": 1.0}}, "joint 'rail' of robot 'machine' mimics 'wrist', which is not a joint between"),
        ({"rail": {"waist": 1.0, "plate": 1.0}}, "joint 'rail' of robot 'machine' mimics 'plate', which is fixed; mak"),
        ({"rail": {"rail": 1.0}}, "joints of robot 'machine' mimic each other in a circle: rail; make one of"),
        (
            {"early": {"rail": 1.0}, "rail": {"waist": 1.0, "sum": 1.0}, "sum": {"rack": 1.0}, "rack": {"rail": 1.0}},
            "mimic each other in a circle: rail, sum, rack; make one of them active.",
        ),
        ({name: {"waist": 1.0} for name in MOVING}, "mimic each other in a circle: waist; make"),
    ],
)
def test_chains_check_their_mimic_joints(mimic: Mapping[str, Mapping[str, float]], message: str) -> None:
    with pytest.raises(RobotError, match=re.escape(message)):
        build(crooked_joints(KINDS), {name: (drivers, 0.0) for name, drivers in mimic.items()})


def test_the_mimic_of_a_joint_is_a_copy() -> None:
    drivers = {"k": 1.0}
    joint = Joint("j", "revolute", torch.eye(4), mimic=drivers)
    drivers["k"] = 2.0
    assert joint.mimic == {"k": 1.0}


@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_rows_of_a_table_with_mimic(convention: str) -> None:
    free = [(0.1, 0.4, 0.3, 0.2), (-0.2, -1.1, 0.5, 0.7, "prismatic"), (0.3, 0.9, -0.1), (0.1, 0.2, 0.4)]
    follow = {"joint_1": -1.0, "joint_4": 0.5}
    expected, q = from_dh(free, convention), draw(5, 2)
    full = torch.stack([q[:, 0], 0.2 + 3 * q[:, 0], 0.1 - q[:, 0] + 0.5 * q[:, 1], q[:, 1]], dim=1)
    rows = [
        free[0],
        DHRow(-0.2, -1.1, 0.5, 0.7, "prismatic", {"joint_1": 3.0}, 0.2),
        (0.3, 0.9, -0.1, 0.0, "revolute", follow, 0.1),
        DHRow(0.1, 0.2, 0.4),
    ]
    chain = from_dh(rows, convention)
    assert chain.joint_names == ("joint_1", "joint_4")
    torch.testing.assert_close(chain(q), expected(full), rtol=0, atol=1e-14)
    without_offset = from_dh([*rows[:2], rows[2][:6], rows[3]], convention)  # pyright: ignore[reportIndexIssue]
    full[:, 2] -= 0.1
    torch.testing.assert_close(without_offset(q), expected(full), rtol=0, atol=1e-14)


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    (tmp_path / "lift.urdf").write_text(LIFT)
    return tmp_path / "lift.urdf"


def test_a_driver_off_the_path_is_a_column(urdf: Path) -> None:
    whole, upper = load_urdf(urdf, "floor", "hand"), load_urdf(urdf, "a", "hand")
    assert upper.joint_names == ("lift", "wrist", "turn")
    assert upper.moving_names == whole.moving_names[1:]
    q = torch.tensor([[0.3, -0.2, 0.5], [0.1, 0.7, -1.1]], dtype=torch.float64)
    base = whole.joint_frames(q[:, [2, 0, 1]])[:, 0] @ rotation_about(whole.axes[0], q[:, 2])
    torch.testing.assert_close(base @ upper(q), whole(q[:, [2, 0, 1]]), rtol=0, atol=1e-14)
    slopes = torch.func.vmap(torch.func.jacrev(lambda row: upper(row[None])[0, :3, 3]))(q)
    torch.testing.assert_close(upper.jacobian(q)[:, :3], slopes, rtol=0, atol=1e-14)
    assert robot_from_config(json.loads(json.dumps(upper.to_config()))).joint_names == upper.joint_names


def rotation_about(axis: torch.Tensor, angles: torch.Tensor) -> torch.Tensor:
    poses = torch.eye(4, dtype=torch.float64).repeat(len(angles), 1, 1)
    poses[:, :3, :3] = rotation(angles[:, None] * axis)
    return poses


def test_a_driver_that_is_not_there_is_explained(urdf: Path) -> None:
    urdf.write_text(LIFT.replace('<mimic joint="turn" multiplier="-0.5"', '<mimic joint="twist" multiplier="-0.5"'))
    message = "joint 'counter' of robot 'lift' mimics 'twist', which is not a joint between 'a' and 'hand'; choose a"
    with pytest.raises(RobotError, match=re.escape(message)):
        load_urdf(urdf, "a", "hand")


def test_a_mimic_without_a_joint_is_explained_on_the_path_only(urdf: Path) -> None:
    urdf.write_text(LIFT.replace('<mimic joint="wrist" multiplier="2"/>', "<mimic/>"))
    assert load_urdf(urdf, "floor", "hand").n == 3
    with pytest.raises(RobotError, match=r"<mimic> of joint 'grip' in '.*' has no attribute 'joint'; add it"):
        load_urdf(urdf, "floor", "finger")
