"""Mimic joints, driven by other joints: values, poses, Jacobians and limits of chains that have them."""

import re
from collections.abc import Mapping
from math import inf, nan, pi
from typing import Any

import pytest
import torch
from mimic_bank import CHAIN, FREE, KINDS, MOVING, build, crooked_joints, expand
from robots_bank import draw
from torch import Tensor

from diffeo_calib.common.errors import RobotError
from diffeo_calib.robots import Chain, Joint

# torch compiles its forward-mode rules on first use with torch.jit.script, which it has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")


def motion(joint: Joint, value: float) -> Tensor:
    """The motion of one joint as a matrix exponential."""
    x, y, z = joint.axis.tolist()
    twist = torch.zeros(4, 4, dtype=torch.float64)
    if joint.kind == "prismatic":
        twist[:3, 3] = joint.axis
    else:
        twist[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(value * twist)


def test_poses_multiply_out_with_the_values_of_all_joints() -> None:
    q = draw(4, 3)
    for row, values in zip(CHAIN(q), expand(q).tolist(), strict=True):
        value = dict(zip(MOVING, values, strict=True))
        pose = torch.eye(4, dtype=torch.float64)
        for joint in CHAIN.joints:
            pose = pose @ joint.origin
            pose = pose if joint.kind == "fixed" else pose @ motion(joint, value[joint.name])
        torch.testing.assert_close(row, pose, rtol=0, atol=1e-13)


def test_coupling_is_constant_and_resolved_to_active_joints() -> None:
    expected = [[0, 1.5, 0], [1, 0, 0], [0, 1, 0], [-1, 0, -1], [0, 0, 1], [0, 0, 0.1], [0.75, 0, 0.7]]
    torch.testing.assert_close(CHAIN.coupling, torch.tensor(expected, dtype=torch.float64))
    offset = torch.tensor([-0.2, 0, 0, 0.3, 0, 0, 0.55], dtype=torch.float64)
    torch.testing.assert_close(CHAIN.coupling_offset, offset)
    q = draw(5, 3)
    torch.testing.assert_close(CHAIN.moving_values(q), expand(q), rtol=0, atol=1e-15)
    assert torch.equal(CHAIN.moving_values(q)[:, [1, 2, 4]], q)


def test_it_is_the_same_robot_as_one_with_all_joints_active() -> None:
    q = draw(6, 3)
    full = expand(q)
    torch.testing.assert_close(CHAIN(q), FREE(full), rtol=0, atol=1e-14)
    torch.testing.assert_close(CHAIN.joint_frames(q), FREE.joint_frames(full), rtol=0, atol=1e-14)
    torch.testing.assert_close(CHAIN.jacobian(q), FREE.jacobian(full) @ CHAIN.coupling, rtol=0, atol=1e-13)


def test_a_full_turn_comes_back_only_where_all_mimic_joints_do() -> None:
    turning = {"waist": "continuous", "twice": "revolute", "half": "revolute"}
    for follower, multiplier in (("twice", -2.0), ("half", 0.5)):
        kinds = {name: kind for name, kind in turning.items() if name in ("waist", follower)}
        chain = build(crooked_joints(kinds), {follower: ({"waist": multiplier}, 0.1)})
        assert chain.periodic == (True,)  # the joint's own kind
        q = draw(3, 1)
        assert torch.allclose(chain(q + 2 * pi), chain(q), rtol=0, atol=1e-13) == (follower == "twice")


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


def test_reach_bounds_the_distance() -> None:
    lower, upper = CHAIN.limits.clamp(-pi, pi).unbind(1)
    unit = torch.rand(3000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    distances = CHAIN(lower + (upper - lower) * unit)[:, :3, 3].norm(dim=1)
    assert distances.max() < CHAIN.reach < 2 * distances.max()


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
        ({"rail": {"rail": 1.0}}, "joints of robot 'machine' mimic each other in a circle: rail -> rail; make one of"),
        (
            {"early": {"rail": 1.0}, "rail": {"waist": 1.0, "sum": 1.0}, "sum": {"rack": 1.0}, "rack": {"rail": 1.0}},
            "mimic each other in a circle: rail -> sum -> rack -> rail; make one of them active.",
        ),
        ({name: {"waist": 1.0} for name in MOVING}, "mimic each other in a circle: waist -> waist"),
    ],
)
def test_chains_check_their_mimic_joints(mimic: Mapping[str, Mapping[str, float]], message: str) -> None:
    with pytest.raises(RobotError, match=re.escape(message)):
        build(crooked_joints(KINDS), {name: (drivers, 0.0) for name, drivers in mimic.items()})


def test_two_joints_of_one_name_are_refused() -> None:
    twice = [Joint("t", "revolute", torch.eye(4)), Joint("t", "revolute", torch.eye(4), mimic={"t": 1.0})]
    with pytest.raises(RobotError, match=re.escape("several joints named ['t']")):
        Chain("r", "a", "b", twice)
