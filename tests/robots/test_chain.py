"""Chains: attributes, shapes, messages; joints check themselves. Poses and derivatives: test_laws.py."""

import re
from math import inf, nan, pi
from pathlib import Path
from typing import Any, cast

import pytest
import torch
from robots_bank import CROOKED

from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.robots import Chain, Joint, SimulatedArm, load_urdf


@pytest.fixture
def crooked(tmp_path: Path) -> Chain:
    (tmp_path / "robot.urdf").write_text(CROOKED)
    return load_urdf(tmp_path / "robot.urdf", "world", "end")


def draw(chain: Chain, count: int, seed: int = 0) -> torch.Tensor:
    return (
        2 * pi * (torch.rand(count, chain.n, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 0.5)
    )


def test_attributes_and_repr(crooked: Chain) -> None:
    assert crooked.joint_names == ("slide", "turn", "spin", "lift")
    assert crooked.kinds == ("prismatic", "revolute", "continuous", "prismatic")
    assert crooked.periodic == (False, True, True, False)
    assert crooked.n == 4
    assert crooked.limits.tolist() == [[-0.4, 0.7], [-2.0, 2.0], [-inf, inf], [0.0, 0.2]]
    assert "crooked" in repr(crooked)
    assert "slide, turn, spin, lift" in repr(crooked)


def test_reach_bounds_the_distance_and_is_not_wasteful() -> None:
    arm = SimulatedArm()
    distances = arm.nominal(arm.sample(3000))[:, :3, 3].norm(dim=1)
    assert distances.max() < arm.nominal.reach < 1.3 * distances.max()


def test_reach_counts_strokes(crooked: Chain) -> None:
    lower, upper = crooked.limits.clamp(-pi, pi).unbind(1)
    q = lower + (upper - lower) * (draw(crooked, 2000) / (2 * pi) + 0.5)
    assert crooked(q)[:, :3, 3].norm(dim=1).max() < crooked.reach < 10
    free = Chain("gantry", "a", "b", [Joint("x", "prismatic", torch.eye(4))])
    assert free.reach == inf


def test_float32_lists_and_no_rows_are_taken(crooked: Chain) -> None:
    q = draw(crooked, 2)
    others: list[Any] = [q.tolist(), q.numpy()]
    for same in others:
        torch.testing.assert_close(crooked(same), crooked(q))
    assert crooked(q.float()).dtype == torch.float64
    assert crooked(q[:0]).shape == (0, 4, 4)
    assert crooked.jacobian(q[:0]).shape == (0, 6, 4)


@pytest.mark.parametrize("shape", [(3, 5), (4,), (2, 3, 4)])
def test_wrong_shape_of_q_is_explained(crooked: Chain, shape: tuple[int, ...]) -> None:
    message = (
        f"`q` must have shape (N, 4) for robot 'crooked': got {shape}; "
        "pass the 4 joints in the order of `robot.joint_names`."
    )
    for call in (crooked, crooked.jacobian, crooked.joint_frames):
        with pytest.raises(InputError, match=re.escape(message)):
            call(torch.zeros(shape))


def test_q_that_is_not_finite_is_explained(crooked: Chain) -> None:
    q = torch.zeros(5, 4)
    q[3, 1] = nan
    with pytest.raises(InputError, match=re.escape("the first at index [3, 1]")):
        crooked(q)
    with pytest.raises(InputError, match="cannot be read as numbers"):
        crooked(cast(Any, [["a", "b", "c", "d"]]))


def bad_origin(entry: float, row: int, column: int) -> torch.Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[row, column] = entry
    return matrix


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("j", "ball", torch.eye(4)), "the kind of joint 'j': expected one of revolute, continuous"),
        (("j", "revolute", bad_origin(1.1, 0, 0)), "the origin of joint 'j': expected a rigid transform"),
        (("j", "revolute", bad_origin(-1.0, 2, 2)), "the origin of joint 'j': expected a rigid transform"),
        (("j", "revolute", bad_origin(0.1, 3, 0)), "the origin of joint 'j': expected a rigid transform"),
        (("j", "revolute", bad_origin(nan, 0, 3)), "not finite"),
        (("j", "revolute", torch.eye(3)), "`the origin of joint 'j'` has the wrong shape: expected (4, 4), got (3, 3)"),
        (("j", "revolute", torch.eye(4), torch.zeros(3)), "the axis of joint 'j': expected a non-zero vector"),
        (("j", "revolute", torch.eye(4), torch.full((3,), nan)), "not finite"),
        (("j", "revolute", torch.eye(4), torch.ones(3), 1.0, -1.0), "the limits of joint 'j': expected lower <= upper"),
        (("j", "revolute", torch.eye(4), torch.ones(3), nan), "the limits of joint 'j'"),
    ],
)
def test_joints_check_themselves(arguments: tuple, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        Joint(*arguments)


def test_axes_are_normalised() -> None:
    joint = Joint("j", "revolute", torch.eye(4), torch.tensor([3.0, 0.0, 4.0]))
    torch.testing.assert_close(joint.axis, torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64))


def test_chains_check_themselves() -> None:
    fixed, turn = Joint("f", "fixed", torch.eye(4)), Joint("t", "revolute", torch.eye(4))
    with pytest.raises(RobotError, match="robot 'r' has no moving joint from 'a' to 'b'"):
        Chain("r", "a", "b", [fixed])
    with pytest.raises(RobotError, match=re.escape("several joints named ['t']")):
        Chain("r", "a", "b", [turn, fixed, turn])
