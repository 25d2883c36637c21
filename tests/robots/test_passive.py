"""Passive joints, moved by others: chains, their geometric errors, registration and identification."""

import re
from collections.abc import Mapping
from dataclasses import replace
from math import inf, nan, pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Prior, identify
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.robots import Chain, DHRow, Geometry, Joint, from_dh, load_urdf
from diffeo_calib.robots.geometry import twist_transform

# torch itself compiles its forward-mode rules with what it calls deprecated, the first time they are used.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")

# Everything at once: a passive joint before what moves it, a sum, a mimic of a mimic, slides that follow turns.
KINDS = {
    "early": "revolute",
    "waist": "continuous",
    "plate": "fixed",
    "rail": "prismatic",
    "sum": "revolute",
    "elbow": "revolute",
    "rack": "prismatic",
    "second": "revolute",
}
MIMIC: dict[str, tuple[Mapping[str, float], float]] = {
    "early": ({"rail": 1.5}, -0.2),
    "sum": ({"waist": -1.0, "elbow": -1.0}, 0.3),
    "rack": ({"elbow": 0.1}, 0.0),
    "second": ({"sum": -0.5, "rack": 2.0, "waist": 0.25}, 0.7),
}
MOVING = [name for name, kind in KINDS.items() if kind != "fixed"]
ACTIVE = ["waist", "rail", "elbow"]


def draw(*shape: int, seed: int = 0, size: float = 1.0) -> Tensor:
    return size * torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def crooked_joints(kinds: Mapping[str, str], seed: int = 1) -> list[Joint]:
    """Joints in general position, every one about half a metre from the last."""
    origins, axes = twist_transform(draw(len(kinds), 6, seed=seed, size=0.4)), draw(len(kinds), 3, seed=seed + 1)
    limits = {"prismatic": (-0.3, 0.5), "revolute": (-2.0, 1.5)}
    return [
        Joint(name, kind, origin, axis, *limits.get(kind, (-inf, inf)))
        for (name, kind), origin, axis in zip(kinds.items(), origins, axes, strict=True)
    ]


def build(joints: list[Joint], mimic: Mapping[str, tuple[Mapping[str, float], float]] | None = None) -> Chain:
    given = mimic or {}
    passive = [
        replace(j, mimic=given[j.name][0], mimic_offset=given[j.name][1]) if j.name in given else j for j in joints
    ]
    return Chain("machine", "floor", "hand", passive)


FREE = build(crooked_joints(KINDS))
CHAIN = build(crooked_joints(KINDS), MIMIC)


def expand(q: Tensor) -> Tensor:
    """Values of MOVING, written out by hand."""
    waist, rail, elbow = q.unbind(1)
    total = 0.3 - waist - elbow
    rack = 0.1 * elbow
    return torch.stack(
        [1.5 * rail - 0.2, waist, rail, total, elbow, rack, 0.7 - 0.5 * total + 2 * rack + 0.25 * waist], dim=1
    )


def motion(joint: Joint, value: float) -> Tensor:
    """The motion of one joint as a matrix exponential."""
    x, y, z = joint.axis.tolist()
    twist = torch.zeros(4, 4, dtype=torch.float64)
    if joint.kind == "prismatic":
        twist[:3, 3] = joint.axis
    else:
        twist[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(value * twist)


def errors_of(chain: Chain, markers: int = 2, size: float = 0.3) -> Geometry:
    """A geometry in general position."""
    twists = twist_transform(draw(chain.moving + 1, 6, seed=5, size=size))
    return replace(
        Geometry.nominal(chain, markers), base=twists[0], joint_errors=twists[1:], tool=draw(markers, 3, seed=6)
    )


# --- chains -------------------------------------------------------------------------------------------------------


def test_poses_multiply_out_with_the_values_of_all_joints() -> None:
    q = draw(4, 3)
    for row, values in zip(CHAIN(q), expand(q).tolist(), strict=True):
        value = dict(zip(MOVING, values, strict=True))
        pose = torch.eye(4, dtype=torch.float64)
        for joint in CHAIN.joints:
            pose = pose @ joint.origin
            pose = pose if joint.kind == "fixed" else pose @ motion(joint, value[joint.name])
        torch.testing.assert_close(row, pose, rtol=0, atol=1e-13)


def test_what_refers_to_active_joints_and_what_to_all() -> None:
    assert CHAIN.joint_names == tuple(ACTIVE)
    assert (CHAIN.n, CHAIN.moving) == (3, 7)
    assert CHAIN.moving_names == tuple(MOVING)
    assert CHAIN.kinds == ("continuous", "prismatic", "revolute")
    assert CHAIN.periodic == (True, False, True)
    assert CHAIN.limits.tolist() == [[-inf, inf], [-0.3, 0.5], [-2.0, 1.5]]
    assert CHAIN.revolute.tolist() == [True, True, False, True, True, False, True]
    assert CHAIN.axes.shape == (7, 3)
    assert CHAIN.offsets.shape == (7, 4, 4)
    assert CHAIN.motion_terms.shape == (4, 7, 4, 4)
    assert CHAIN.joint_frames(draw(2, 3)).shape == (2, 7, 4, 4)
    assert repr(CHAIN).endswith("3 joints: waist, rail, elbow; passive: early, sum, rack, second)")


def test_coupling_is_constant_and_resolved_to_active_joints() -> None:
    expected = [[0, 1.5, 0], [1, 0, 0], [0, 1, 0], [-1, 0, -1], [0, 0, 1], [0, 0, 0.1], [0.75, 0, 0.7]]
    torch.testing.assert_close(CHAIN.coupling, torch.tensor(expected, dtype=torch.float64))
    offset = torch.tensor([-0.2, 0, 0, 0.3, 0, 0, 0.55], dtype=torch.float64)
    torch.testing.assert_close(CHAIN.coupling_offset, offset)
    q = draw(5, 3)
    torch.testing.assert_close(CHAIN.moving_values(q), expand(q), rtol=0, atol=1e-15)
    assert torch.equal(CHAIN.moving_values(q)[:, [1, 2, 4]], q)


def test_it_is_the_same_robot_as_one_whose_joints_all_move_by_themselves() -> None:
    q = draw(6, 3)
    full = expand(q)
    torch.testing.assert_close(CHAIN(q), FREE(full), rtol=0, atol=1e-14)
    torch.testing.assert_close(CHAIN.joint_frames(q), FREE.joint_frames(full), rtol=0, atol=1e-14)
    torch.testing.assert_close(CHAIN.jacobian(q), FREE.jacobian(full) @ CHAIN.coupling, rtol=0, atol=1e-13)


def test_chains_without_passive_joints_pay_nothing() -> None:
    q, slopes = draw(4, 7), draw(4, 6, 7)
    assert (FREE.n, FREE.moving, FREE.moving_names) == (7, 7, FREE.joint_names)
    assert FREE.moving_values(q) is q
    assert FREE.by_active(slopes) is slopes
    assert torch.equal(FREE.coupling, torch.eye(7, dtype=torch.float64))
    assert torch.equal(FREE.coupling_offset, torch.zeros(7, dtype=torch.float64))
    assert "passive" not in repr(FREE)


def test_jacobian_is_the_derivative_by_the_active_joints() -> None:
    q = draw(4, 3)
    slopes = torch.func.vmap(torch.func.jacrev(lambda x: CHAIN(x[None])[0]))(q)  # (N, 4, 4, n)
    jacobian = CHAIN.jacobian(q)
    assert jacobian.shape == (4, 6, 3)
    torch.testing.assert_close(jacobian[:, :3], slopes[:, :3, 3], rtol=0, atol=1e-13)
    spin = torch.einsum("nabj,ncb->njac", slopes[:, :3, :3], CHAIN(q)[:, :3, :3])
    turned = torch.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], dim=1)
    torch.testing.assert_close(jacobian[:, 3:], turned, rtol=0, atol=1e-13)


def test_derivatives_pass_through_every_transform() -> None:
    q, v = draw(3, 3), draw(3, 3, seed=1)
    forward = torch.func.jvp(CHAIN, (q,), (v,))[1]
    torch.testing.assert_close(torch.einsum("nij,nj->ni", CHAIN.jacobian(q), v)[:, :3], forward[:, :3, 3])
    each = torch.func.vmap(lambda x: CHAIN.jacobian(x[None])[0])(q)
    torch.testing.assert_close(each, CHAIN.jacobian(q))
    assert torch.autograd.gradgradcheck(lambda x: CHAIN.jacobian(x)[:, :3], (q[:1].requires_grad_(),))
    assert CHAIN(q[:0]).shape == (0, 4, 4)
    assert CHAIN.jacobian(q[:0]).shape == (0, 6, 3)


def test_q_has_the_active_joints_only() -> None:
    message = "`q` must have shape (N, 3) for robot 'machine': got (2, 7); pass the 3 joints in the order of"
    with pytest.raises(InputError, match=re.escape(message)):
        CHAIN(torch.zeros(2, 7))


def test_a_full_turn_comes_back_only_where_all_followers_do() -> None:
    turning = {"waist": "continuous", "twice": "revolute", "half": "revolute"}
    for follower, multiplier in (("twice", -2.0), ("half", 0.5)):
        kinds = {name: kind for name, kind in turning.items() if name in ("waist", follower)}
        chain = build(crooked_joints(kinds), {follower: ({"waist": multiplier}, 0.1)})
        assert chain.periodic == (True,)  # the joint's own kind
        q = draw(3, 1)
        assert torch.allclose(chain(q + 2 * pi), chain(q), rtol=0, atol=1e-13) == (follower == "twice")


def slide(name: str, lower: float, upper: float, mimic: Mapping[str, float] | None = None, offset: float = 0) -> Joint:
    return Joint(name, "prismatic", torch.eye(4), torch.ones(3), lower, upper, mimic, offset)


def test_reach_follows_from_the_limits_of_the_joints_that_move() -> None:
    x, motor = slide("x", -1, 2), Joint("motor", "continuous", torch.eye(4))
    assert Chain("r", "a", "b", [x]).reach == 2.0
    # y runs from 0.5 - 4 to 0.5 + 2, whatever limits of its own the file says
    assert Chain("r", "a", "b", [x, slide("y", 0, 0.1, {"x": -2.0}, 0.5)]).reach == 5.5
    assert Chain("r", "a", "b", [motor, x]).reach == 2.0  # a motor without limits moves no slide here
    assert Chain("r", "a", "b", [motor, slide("rack", -0.2, 0.3, {"motor": 0.01})]).reach == 0.3
    assert Chain("r", "a", "b", [motor, slide("rack", -inf, inf, {"motor": 0.01})]).reach == inf
    assert Chain("r", "a", "b", [motor, x, slide("y", -9, 9, {"x": 1.0, "motor": 0.0})]).reach == 4.0


def test_reach_bounds_the_distance() -> None:
    lower, upper = CHAIN.limits.clamp(-pi, pi).unbind(1)
    unit = torch.rand(3000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    distances = CHAIN(lower + (upper - lower) * unit)[:, :3, 3].norm(dim=1)
    assert distances.max() < CHAIN.reach < 2 * distances.max()


# --- geometric errors ---------------------------------------------------------------------------------------------


def test_every_moving_joint_has_an_error_twist() -> None:
    geometry = errors_of(CHAIN)
    names = geometry.parameter_names
    assert geometry.size == len(names) == 6 + 6 * 7 + 3 * 2
    assert (names[6], names[6 + 6 * 3 + 5], names[47]) == ("early tx [m]", "sum rz [rad]", "second rz [rad]")
    assert geometry.slices["joints"] == slice(6, 48)
    assert Geometry.nominal(CHAIN).joint_errors.shape == (7, 4, 4)
    prior = Prior(translation=2e-3, rotation=3e-3).deviations(geometry)
    assert prior[6:48].tolist() == ([2e-3] * 3 + [3e-3] * 3) * 7
    assert len(prior) == geometry.size


def test_points_are_those_of_the_robot_whose_joints_all_move_by_themselves() -> None:
    passive, free = errors_of(CHAIN), errors_of(FREE)
    q, theta = draw(5, 3), draw(passive.size, seed=2, size=0.1)
    full = expand(q)
    torch.testing.assert_close(passive.points(q, theta), free.points(full, theta), rtol=0, atol=1e-13)
    torch.testing.assert_close(passive.sensitivities(q, theta), free.sensitivities(full, theta), rtol=0, atol=1e-13)
    torch.testing.assert_close(passive.poses(q), free.poses(full), rtol=0, atol=1e-13)


@pytest.mark.parametrize("size", [0.0, 5e-3, 0.4])
def test_geometry_s_derivatives_are_those_of_autograd(size: float) -> None:
    geometry, q = errors_of(CHAIN), draw(4, 3)
    theta = draw(geometry.size, seed=2, size=size)
    by_joint = torch.func.vmap(torch.func.jacrev(lambda x: geometry.points(x[None], theta)[0]))(q)
    torch.testing.assert_close(geometry.jacobian(q, theta), by_joint, rtol=0, atol=1e-12)
    by_theta = torch.func.jacrev(lambda x: geometry.points(q, x))(theta)
    torch.testing.assert_close(geometry.sensitivities(q, theta), by_theta, rtol=0, atol=1e-12)
    absorbed = geometry.absorb(theta)
    torch.testing.assert_close(absorbed.points(q), geometry.points(q, theta), rtol=0, atol=1e-13)


def test_nominal_geometry_is_the_chain() -> None:
    geometry, q = Geometry.nominal(CHAIN), draw(3, 3)
    torch.testing.assert_close(geometry.poses(q), CHAIN(q))
    torch.testing.assert_close(geometry.jacobian(q)[:, 0], CHAIN.jacobian(q)[:, :3])


def test_an_error_for_the_active_joints_only_is_refused() -> None:
    with pytest.raises(InputError, match=r"expected \(7, 4, 4\), got \(3, 4, 4\); pass one .* `chain.moving_names`"):
        replace(Geometry.nominal(CHAIN), joint_errors=torch.eye(4).repeat(3, 1, 1))


# --- identification -----------------------------------------------------------------------------------------------


def machine(moving: int, slides: tuple[int, ...] = (), *, passive: bool = False) -> Chain:
    """A chain of many joints, each axis square to the last; passive: joint 4 follows as -(q2 + q3), as a torso does."""
    rows = []
    for index in range(moving):
        kind = "prismatic" if index in slides else "revolute"
        twist = pi / 2 if index % 2 else -pi / 2
        follows = {"joint_2": -1.0, "joint_3": -1.0} if passive and index == 3 else None
        rows.append(DHRow(0.05 + 0.03 * (index % 3), twist, 0.25 - 0.02 * index, 0.1 * index, kind, follows))
    return from_dh(rows, name=f"machine of {moving}")


def placed(chain: Chain, deviation: float, seed: int = 3) -> Geometry:
    """Errors of the given size in all moving joints, the robot metres away, two markers."""
    nominal = Geometry.nominal(chain, 2)
    theta = draw(nominal.size, seed=seed, size=deviation)
    theta[:6] = torch.tensor([1.0, -2.0, 0.5, 0.7, -0.4, 1.1])
    theta[nominal.slices["tool"]] = draw(6, seed=seed, size=0.1)
    return nominal.absorb(theta)


def configurations(chain: Chain, count: int, seed: int) -> Tensor:
    turning = torch.tensor(chain.periodic)
    return torch.where(turning, 2.0, 0.3) * (2 * draw(count, chain.n, seed=seed).sigmoid() - 1) * 1.5


MACHINES = [
    machine(7),
    machine(7, (0, 4)),
    machine(9, (2,)),
    machine(11, (0,)),
    machine(11, passive=True),
    machine(11, (0, 6), passive=True),
]


@pytest.mark.parametrize("chain", MACHINES, ids=repr)
def test_long_chains_are_registered_and_identified(chain: Chain) -> None:
    truth = placed(chain, 5e-4)
    q, test = configurations(chain, 80, seed=1), configurations(chain, 200, seed=2)
    exact = register(replace(truth, base=torch.eye(4)), q, truth.points(q))
    torch.testing.assert_close(exact.geometry.base, truth.base, rtol=0, atol=1e-9)
    torch.testing.assert_close(exact.geometry.tool, truth.tool, rtol=0, atol=1e-9)

    start = register(chain, q, truth.points(q))
    found = identify(start.geometry, q, truth.points(q))
    assert start.rms > 5e-4
    assert found.status.startswith("converged")
    error = (found.geometry.points(test) - truth.points(test)).norm(dim=-1)
    assert float(error.max()) < 1e-6


def test_the_error_of_a_passive_joint_is_found() -> None:
    chain = machine(11, passive=True)
    assert "joint_4" in repr(chain).split("passive: ")[1]
    truth = placed(chain, 0.0)
    theta = torch.zeros(truth.size, dtype=torch.float64)
    theta[truth.parameter_names.index("joint_4 tz [m]")] = 2e-3
    theta[truth.parameter_names.index("joint_4 rx [rad]")] = 3e-3
    truth = truth.absorb(theta)
    q, test = configurations(chain, 80, seed=1), configurations(chain, 200, seed=2)
    points = truth.points(q) + draw(80, 2, 3, seed=4, size=2e-5)
    start = register(chain, q, points).geometry
    found = identify(start, q, points)
    assert found.noise == pytest.approx(2e-5, rel=0.15)
    before, after = ((g.points(test) - truth.points(test)).norm(dim=-1) for g in (start, found.geometry))
    assert float(after.max()) < 1e-4 < float(before.mean())


# --- DH tables and URDF files -------------------------------------------------------------------------------------


@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_rows_of_a_table_say_mimic(convention: str) -> None:
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


URDF = """<robot name="lift">
  <link name="floor"/><link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/><link name="f"/>
  <link name="hand"/><link name="finger"/>
  <joint name="turn" type="revolute"><parent link="floor"/><child link="a"/><origin xyz="1 0.1 0" rpy="1 2 3"/>
    <axis xyz="0.6 0.8 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="counter" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0.2 0.3" rpy="0.4 0 1"/>
    <axis xyz="0 0.6 0.8"/><limit lower="-2" upper="2" effort="1" velocity="1"/>
    <mimic joint="turn" multiplier="-0.5" offset="0.3"/></joint>
  <joint name="rack" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="0.48 0.6 0.64"/>
    <limit lower="-2" upper="2" effort="1" velocity="1"/><mimic joint="turn" multiplier="0.1"/></joint>
  <joint name="mount" type="fixed"><parent link="c"/><child link="d"/><origin xyz="0 0 0.4" rpy="0 1 0"/></joint>
  <joint name="lift" type="prismatic"><parent link="d"/><child link="e"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="twin" type="prismatic"><parent link="e"/><child link="f"/><origin xyz="0.1 0 0" rpy="0.2 0.3 0"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="lift" offset="-0.1"/></joint>
  <joint name="wrist" type="revolute"><parent link="f"/><child link="hand"/><axis xyz="1 0 0"/>
    <origin xyz="0 0.1 0.1" rpy="0 0.1 0.2"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="grip" type="revolute"><parent link="hand"/><child link="finger"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="wrist" multiplier="2"/></joint>
</robot>"""


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    (tmp_path / "lift.urdf").write_text(URDF)
    return tmp_path / "lift.urdf"


def test_urdf_files_with_mimic_are_read(urdf: Path) -> None:
    chain = load_urdf(urdf, "floor", "hand")
    assert chain.joint_names == ("turn", "lift", "wrist")
    assert chain.moving_names == ("turn", "counter", "rack", "lift", "twin", "wrist")
    expected = [[1, 0, 0], [-0.5, 0, 0], [0.1, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1]]
    assert chain.coupling.tolist() == expected
    assert chain.coupling_offset.tolist() == [0, 0.3, 0, 0, -0.1, 0]
    assert load_urdf(urdf, "floor", "finger").coupling[-1].tolist() == [0, 0, 2]


def test_poses_and_jacobian_agree_with_pinocchio(urdf: Path) -> None:
    pin = pytest.importorskip("pinocchio")
    chain, model = load_urdf(urdf, "floor", "hand"), pin.buildModelFromUrdf(str(urdf), mimic=True)
    data, hand = model.createData(), model.getFrameId("hand")
    columns = [model.joints[model.getJointId(name)].idx_v for name in chain.joint_names]
    q = draw(20, 3)
    poses, jacobians = chain(q), chain.jacobian(q)
    for row in range(len(q)):
        configuration = np.zeros(model.nq)
        configuration[columns] = q[row].numpy()
        pin.computeJointJacobians(model, data, configuration)
        pin.updateFramePlacements(model, data)
        pose = torch.from_numpy(data.oMf[hand].homogeneous)
        torch.testing.assert_close(poses[row], pose, rtol=0, atol=1e-12)
        world = pin.getFrameJacobian(model, data, hand, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:, columns]
        torch.testing.assert_close(jacobians[row], torch.from_numpy(world), rtol=0, atol=1e-12)


def test_a_joint_that_mimics_one_off_the_path_is_explained(urdf: Path) -> None:
    message = "joint 'counter' of robot 'lift' mimics 'turn', which is no joint between 'a' and 'hand'; choose a base"
    with pytest.raises(RobotError, match=re.escape(message)):
        load_urdf(urdf, "a", "hand")


def test_a_mimic_without_a_joint_is_explained_on_the_path_only(urdf: Path) -> None:
    urdf.write_text(URDF.replace('<mimic joint="wrist" multiplier="2"/>', "<mimic/>"))
    assert load_urdf(urdf, "floor", "hand").n == 3
    with pytest.raises(RobotError, match=r"<mimic> of joint 'grip' in '.*' has no attribute 'joint'; add it"):
        load_urdf(urdf, "floor", "finger")


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
        ("revolute", None, 0.1, "joint 'j' has a mimic offset but mimics no joint; name the joints that move it"),
    ],
)
def test_joints_check_what_they_mimic(kind: str, mimic: Any, offset: Any, message: str) -> None:
    with pytest.raises(RobotError, match=re.escape(message)):
        Joint("j", kind, torch.eye(4), mimic=mimic, mimic_offset=offset)


@pytest.mark.parametrize(
    ("mimic", "message"),
    [
        ({"rail": {"wrist": 1.0}}, "joint 'rail' of robot 'machine' mimics 'wrist', which is no joint between 'floor'"),
        ({"rail": {"waist": 1.0, "plate": 1.0}}, "joint 'rail' of robot 'machine' mimics 'plate', which is fixed; mak"),
        ({"rail": {"rail": 1.0}}, "joints of robot 'machine' mimic each other in a circle: rail -> rail; let one of"),
        (
            {"early": {"rail": 1.0}, "rail": {"waist": 1.0, "sum": 1.0}, "sum": {"rack": 1.0}, "rack": {"rail": 1.0}},
            "mimic each other in a circle: rail -> sum -> rack -> rail; let one of them move by itself.",
        ),
        ({name: {"waist": 1.0} for name in MOVING}, "mimic each other in a circle: waist -> waist"),
    ],
)
def test_chains_check_who_mimics_whom(mimic: Mapping[str, Mapping[str, float]], message: str) -> None:
    with pytest.raises(RobotError, match=re.escape(message)):
        build(crooked_joints(KINDS), {name: (drivers, 0.0) for name, drivers in mimic.items()})


def test_two_joints_of_one_name_are_refused_passive_or_not() -> None:
    twice = [Joint("t", "revolute", torch.eye(4)), Joint("t", "revolute", torch.eye(4), mimic={"t": 1.0})]
    with pytest.raises(RobotError, match=re.escape("several joints named ['t']")):
        Chain("r", "a", "b", twice)


def test_what_a_joint_mimics_cannot_be_changed_behind_its_back() -> None:
    drivers = {"k": 1.0}
    joint = Joint("j", "revolute", torch.eye(4), mimic=drivers)
    drivers["k"] = 2.0
    assert joint.mimic == {"k": 1.0}
