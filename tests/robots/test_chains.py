"""Chains and mimic joints: attributes, reach, values, messages. Poses and derivatives: test_laws.py."""

import json
import re
from collections.abc import Mapping
from math import inf, nan, pi
from pathlib import Path
from typing import Any, cast

import pytest
import torch
from robots_bank import CHAIN, CROOKED, KINDS, LIFT, MOVING, build, crooked_joints, draw, expand

from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.robots import Chain, DHRow, Joint, SimulatedArm, from_dh, load_urdf
from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.robots.tree import robot_from_config


@pytest.fixture
def crooked(tmp_path: Path) -> Chain:
    (tmp_path / "robot.urdf").write_text(CROOKED)
    return load_urdf(tmp_path / "robot.urdf", "world", "end")


def test_attributes_and_forms_of_values(crooked: Chain) -> None:
    assert crooked.joint_names == ("slide", "turn", "spin", "lift")
    assert crooked.kinds == ("prismatic", "revolute", "continuous", "prismatic")
    assert crooked.periodic == (False, True, True, False)
    assert crooked.limits.tolist() == [[-0.4, 0.7], [-2.0, 2.0], [-inf, inf], [0.0, 0.2]]
    assert "crooked" in repr(crooked)
    assert "slide, turn, spin, lift" in repr(crooked)
    q = draw(2, 4)
    for same in cast(list[Any], [q.tolist(), q.numpy()]):
        torch.testing.assert_close(crooked(same), crooked(q))
    assert crooked(q.float()).dtype == torch.float64
    assert crooked(q[:0]).shape == (0, 4, 4)
    assert crooked.jacobian(q[:0]).shape == (0, 6, 4)


def test_reach_bounds_the_distance_and_is_not_wasteful(crooked: Chain) -> None:
    arm = SimulatedArm()
    distances = arm.nominal(arm.sample(3000))[:, :3, 3].norm(dim=1)
    assert distances.max() < arm.nominal.reach < 1.3 * distances.max()
    lower, upper = crooked.limits.clamp(-pi, pi).unbind(1)
    q = lower + (upper - lower) * torch.rand(2000, 4, dtype=torch.float64)
    assert crooked(q)[:, :3, 3].norm(dim=1).max() < crooked.reach < 10


def slide(name: str, lower: float, upper: float, mimic: Mapping[str, float] | None = None, offset: float = 0) -> Joint:
    return Joint(name, "prismatic", torch.eye(4), torch.ones(3), lower, upper, mimic, offset)


X, MOTOR = slide("x", -1, 2), Joint("motor", "continuous", torch.eye(4))


@pytest.mark.parametrize(
    ("joints", "reach"),
    [
        ([slide("x", -inf, inf)], inf),
        ([X], 2.0),
        ([X, slide("y", 0, 0.1, {"x": -2.0}, 0.5)], 5.5),  # from 0.5 - 4 to 0.5 + 2, whatever its own limits are
        ([MOTOR, X], 2.0),  # the motor without limits drives no slide
        ([MOTOR, slide("rack", -0.2, 0.3, {"motor": 0.01})], 0.3),
        ([MOTOR, slide("rack", -inf, inf, {"motor": 0.01})], inf),
        ([MOTOR, X, slide("y", -9, 9, {"x": 1.0, "motor": 0.0})], 4.0),
    ],
)
def test_reach_counts_strokes_and_follows_from_the_limits_of_drivers(joints: list[Joint], reach: float) -> None:
    assert Chain("r", "a", "b", joints).reach == reach


@pytest.mark.parametrize("shape", [(3, 5), (4,), (2, 3, 4)])
def test_wrong_shape_of_q_is_explained(crooked: Chain, shape: tuple[int, ...]) -> None:
    message = (
        f"`q` must have shape (N, 4) for robot 'crooked': got {shape}; "
        "pass the 4 joints in the order of `robot.joint_names`."
    )
    for call in (crooked, crooked.jacobian, crooked.joint_frames):
        with pytest.raises(InputError, match=re.escape(message)):
            call(torch.zeros(shape))


def bad_origin(entry: float, row: int, column: int) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[row, column] = entry
    return matrix


EYE, MAPPING = torch.eye(4), "the mimic of joint 'j': expected a mapping from names of joints to multipliers"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "ball"}, "the kind of joint 'j': expected one of revolute, continuous"),
        *(
            ({"origin": bad_origin(*entry)}, "the origin of joint 'j': expected a rigid transform")
            for entry in ((1.1, 0, 0), (-1.0, 2, 2), (0.1, 3, 0))
        ),
        ({"origin": bad_origin(nan, 0, 3)}, "not finite"),
        ({"origin": torch.eye(3)}, "`the origin of joint 'j'` has the wrong shape: expected (4, 4), got (3, 3)"),
        ({"axis": torch.zeros(3)}, "the axis of joint 'j': expected a non-zero vector"),
        ({"lower": 1.0, "upper": -1.0}, "the limits of joint 'j': expected lower <= upper"),
        ({"mimic": {"k": nan}}, "the multiplier of 'k' in joint 'j': expected a finite number, got nan"),
        *(({"mimic": wrong}, MAPPING) for wrong in ({}, "k", {3: 1.0})),
        *(
            ({"mimic": {"k": 1.0}, "mimic_offset": wrong}, f"mimic offset of joint 'j': expected a finite {ending}")
            for wrong, ending in ((inf, "number, got inf"), (None, "number, got None"))
        ),
        ({"kind": "fixed", "mimic": {"k": 1.0}}, "joint 'j' is fixed and cannot mimic; give it a moving kind, or no"),
        ({"mimic_offset": 0.1}, "joint 'j' has a mimic offset but mimics no joint; name the joints that drive it"),
    ],
)
def test_joints_check_themselves(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        Joint("j", **{"kind": "revolute", "origin": EYE} | arguments)


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


def test_mimic_joints_follow_the_active_ones() -> None:
    q = draw(5, 3)
    torch.testing.assert_close(CHAIN.moving_values(q), expand(q), rtol=0, atol=1e-15)
    assert torch.equal(CHAIN.moving_values(q)[:, [1, 2, 4]], q)


@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_rows_of_a_table_with_mimic(convention: str) -> None:
    free = [(0.1, 0.4, 0.3, 0.2), (-0.2, -1.1, 0.5, 0.7, "prismatic"), (0.3, 0.9, -0.1), (0.1, 0.2, 0.4)]
    follow = {"joint_1": -1.0, "joint_4": 0.5}
    q = draw(5, 2)
    full = torch.stack([q[:, 0], 0.2 + 3 * q[:, 0], 0.1 - q[:, 0] + 0.5 * q[:, 1], q[:, 1]], dim=1)
    rows = [
        free[0],
        DHRow(-0.2, -1.1, 0.5, 0.7, "prismatic", {"joint_1": 3.0}, 0.2),
        (0.3, 0.9, -0.1, 0.0, "revolute", follow, 0.1),
        DHRow(0.1, 0.2, 0.4),
    ]
    chain = from_dh(rows, convention)
    assert chain.joint_names == ("joint_1", "joint_4")
    torch.testing.assert_close(chain(q), from_dh(free, convention)(full), rtol=0, atol=1e-14)


def test_a_driver_off_the_path_is_a_column(tmp_path: Path) -> None:
    urdf = tmp_path / "lift.urdf"
    urdf.write_text(LIFT)
    whole, upper = load_urdf(urdf, "floor", "hand"), load_urdf(urdf, "a", "hand")
    assert upper.joint_names == ("lift", "wrist", "turn")
    assert upper.moving_names == whole.moving_names[1:]
    q = torch.tensor([[0.3, -0.2, 0.5], [0.1, 0.7, -1.1]], dtype=torch.float64)
    turn = transforms(rotation(q[:, 2:] * whole.axes[0]), torch.zeros(2, 3, dtype=torch.float64))
    base = whole.joint_frames(q[:, [2, 0, 1]])[:, 0] @ turn
    torch.testing.assert_close(base @ upper(q), whole(q[:, [2, 0, 1]]), rtol=0, atol=1e-14)
    slopes = torch.autograd.functional.jacobian(lambda row: upper(row[None])[0, :3, 3], q[0])
    torch.testing.assert_close(upper.jacobian(q[:1])[0, :3], slopes, rtol=0, atol=1e-14)
    assert robot_from_config(json.loads(json.dumps(upper.to_config()))).joint_names == upper.joint_names
