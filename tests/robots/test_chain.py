"""Chains: poses and Jacobians against Pinocchio, derivatives, shapes, messages."""

import re
from math import inf, nan, pi
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from mimic_bank import CHAIN

from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.robots import Chain, Joint, SimulatedArm, load_urdf
from diffeo_calib.robots.se3 import skew

# torch compiles its forward-mode rules on first use with torch.jit.script, which it has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")

# Slides and turns about crooked axes, a fixed joint in the middle, and a side branch that must be ignored.
CROOKED = """<robot name="crooked">
  <link name="world"/><link name="root"/><link name="a"/><link name="b"/><link name="plate"/>
  <link name="c"/><link name="d"/><link name="end"/><link name="finger"/>
  <joint name="stand" type="fixed"><parent link="world"/><child link="root"/>
    <origin xyz="1 -2 0.5" rpy="0.3 -0.7 2.1"/></joint>
  <joint name="slide" type="prismatic"><parent link="root"/><child link="a"/>
    <origin xyz="0.1 0.2 0.3" rpy="1 2 3"/><axis xyz="0.36 0.48 0.8"/>
    <limit lower="-0.4" upper="0.7" effort="1" velocity="1"/></joint>
  <joint name="turn" type="revolute"><parent link="a"/><child link="b"/>
    <origin xyz="-0.2 0.05 0.4" rpy="-0.4 0.9 0.2"/><axis xyz="-0.48 0.6 0.64"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="plate_mount" type="fixed"><parent link="b"/><child link="plate"/>
    <origin xyz="0.3 0.1 -0.2" rpy="0.5 0.6 -0.7"/><axis xyz="0 0 0"/></joint>
  <joint name="spin" type="continuous"><parent link="plate"/><child link="c"/>
    <origin xyz="0 0 0.2" rpy="0 0.1 0"/><axis xyz="0 -1 0"/></joint>
  <joint name="lift" type="prismatic"><parent link="c"/><child link="d"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.2" effort="1" velocity="1"/></joint>
  <joint name="tool" type="fixed"><parent link="d"/><child link="end"/><origin xyz="0 0.05 0.1" rpy="0.2 0 0"/></joint>
  <joint name="grip" type="revolute"><parent link="d"/><child link="finger"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""


@pytest.fixture(params=["crooked", "crooked from the middle", "simulated arm", "ur10"])
def case(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, str, str]:
    path = tmp_path / "robot.urdf"
    if request.param == "ur10":
        return request.getfixturevalue("ur10_folder") / "ur10_robot.urdf", "base_link", "ee_link"
    if request.param == "simulated arm":
        SimulatedArm().write_urdf(path)
        return path, "base_link", "flange"
    path.write_text(CROOKED)
    return path, ("world" if request.param == "crooked" else "a"), "end"


@pytest.fixture
def crooked(tmp_path: Path) -> Chain:
    (tmp_path / "robot.urdf").write_text(CROOKED)
    return load_urdf(tmp_path / "robot.urdf", "world", "end")


@pytest.fixture(params=["crooked", "mimic joints"])
def chain(request: pytest.FixtureRequest, crooked: Chain) -> Chain:
    return crooked if request.param == "crooked" else CHAIN


def draw(chain: Chain, count: int, seed: int = 0) -> torch.Tensor:
    return (
        2 * pi * (torch.rand(count, chain.n, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) - 0.5)
    )


def test_poses_and_jacobian_agree_with_pinocchio(case: tuple[Path, str, str]) -> None:
    pin = pytest.importorskip("pinocchio")
    path, base, tip = case
    chain = load_urdf(path, base, tip)
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    columns = [model.joints[model.getJointId(name)].idx_v for name in chain.joint_names]
    q = draw(chain, 25)
    poses, jacobians = chain(q), chain.jacobian(q)
    for row in range(len(q)):
        step = np.zeros(model.nv)
        step[columns] = q[row].numpy()
        configuration = pin.integrate(model, pin.neutral(model), step)
        pin.computeJointJacobians(model, data, configuration)
        pin.updateFramePlacements(model, data)
        from_base = data.oMf[model.getFrameId(base)]
        expected = from_base.actInv(data.oMf[model.getFrameId(tip)]).homogeneous
        torch.testing.assert_close(poses[row], torch.from_numpy(expected), rtol=0, atol=1e-12)
        turned = np.kron(np.eye(2), from_base.rotation.T)
        world = pin.getFrameJacobian(model, data, model.getFrameId(tip), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        expected = torch.from_numpy((turned @ world)[:, columns])
        torch.testing.assert_close(jacobians[row], expected, rtol=0, atol=1e-12)


def test_jacobian_is_the_derivative_by_autograd(chain: Chain) -> None:
    q = draw(chain, 4)
    slopes = torch.func.vmap(torch.func.jacfwd(lambda x: chain(x[None])[0]))(q)  # (N, 4, 4, n)
    jacobian = chain.jacobian(q)
    torch.testing.assert_close(jacobian[:, :3], slopes[:, :3, 3], rtol=0, atol=1e-13)
    spin = torch.einsum("nabj,ncb->njac", slopes[:, :3, :3], chain(q)[:, :3, :3])
    torch.testing.assert_close(skew(jacobian[:, 3:].mT), spin, rtol=0, atol=1e-13)


def test_derivatives_pass_through_every_transform(chain: Chain) -> None:
    q, v = draw(chain, 3), draw(chain, 3, seed=1)
    forward = torch.func.jvp(chain, (q,), (v,))[1]
    each = torch.func.vmap(lambda x, u: torch.func.jvp(lambda z: chain(z[None])[0], (x,), (u,))[1])(q, v)
    torch.testing.assert_close(each, forward)
    torch.testing.assert_close(torch.einsum("nij,nj->ni", chain.jacobian(q), v)[:, :3], forward[:, :3, 3])
    weight = torch.rand(3, 4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    backward = torch.autograd.grad((weight * chain(q.requires_grad_())).sum(), q)[0]
    torch.testing.assert_close((backward * v).sum(), (weight * forward).sum())
    assert torch.autograd.gradgradcheck(lambda x: chain.jacobian(x)[:, :3], (q[:1].detach().requires_grad_(),))


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
