"""Laws of every robot: poses of pinocchio, exact derivatives, descriptions that come back, the view from its tip."""

import json
from math import pi
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import torch
from deformation_bank import errors_of, geometry_of
from robots_bank import CHAIN, CHAINS, CROOKED, LIFT, draw, every_chain
from simulated_body import HANDS, URDF_FILE
from torch import Tensor
from torch.func import jacfwd, jacrev, vmap
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.robots import DHRow, SimulatedArm, from_dh, load_urdf
from diffeo_calib.robots.gravity import GravitySag
from diffeo_calib.robots.payload import Payload
from diffeo_calib.robots.se3 import skew
from diffeo_calib.robots.tree import Ends, Tree, robot_from_config

# torch compiles its forward-mode rules on first use with torch.jit.script, which it has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")

VIEWS = {
    "both hands": ("pelvis", [*HANDS], []),
    "one hand, the other as load": ("pelvis", ["left_hand"], ["right_hand"]),
    "hand to hand": ("left_hand", ["right_hand"], []),
    "hand to hand on a torso": ("left_hand", ["right_hand"], ["pelvis"]),
    "hand to pelvis": ("right_hand", ["pelvis"], ["left_hand"]),
    "from the middle": ("chest", ["left_hand", "pelvis"], ["right_hand"]),
}


def two_arms() -> Tree:
    """A turning column with two arms of three joints, one with a slide."""
    arm = [(0.3, 0.4, 0.1), (0.25, -pi / 2, 0.05), (0.2, 0.3, 0.0)]
    left = [DHRow(*row, parent=parent) for row, parent in zip(arm, (0, 1, 2), strict=True)]
    right = [DHRow(*row[:3], theta=0.5, parent=parent) for row, parent in zip(arm, (0, 4, 5), strict=True)]
    right[1] = DHRow(0.1, pi / 3, 0.2, 0.1, "prismatic", parent=4)
    return from_dh([DHRow(0.1, pi / 2, 0.6), *left, *right], tips={"left": 3, "right": 6})


BODY = {name: load_urdf(URDF_FILE, *view) for name, view in VIEWS.items()}
ROBOTS: dict[str, Tree] = {**CHAINS, "every mimic": CHAIN, "two arms": two_arms(), **BODY}
every_robot = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS.keys())


FILES = {"crooked": ("world", "end"), "crooked from the middle": ("a", "end"), "lift": ("floor", "hand")}


@pytest.mark.parametrize("name", [*FILES, "simulated arm", "ur10", *VIEWS])
def test_poses_and_jacobians_are_those_of_pinocchio(name: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """Of tips in the base; the Jacobian where the base stands on the ground."""
    path = tmp_path / "robot.urdf"
    base, tips, loads = VIEWS.get(name, (*FILES.get(name, ("base_link", "flange")), []))
    if name == "ur10":
        path, tips = request.getfixturevalue("ur10_folder") / "ur10_robot.urdf", "ee_link"
    elif name == "simulated arm":
        SimulatedArm().write_urdf(path)
    elif name in VIEWS:
        path = URDF_FILE
    else:
        path.write_text(LIFT if name == "lift" else CROOKED)
    robot, model = load_urdf(path, base, tips, loads), pin.buildModelFromUrdf(str(path), mimic=True)
    data, q = model.createData(), draw(20, robot.n)
    columns = [model.joints[model.getJointId(joint)].idx_v for joint in robot.joint_names]
    poses, slopes = robot.tip_poses(q), robot.jacobian(q).view(len(q), len(robot.tips), 6, robot.n)
    for row in range(len(q)):
        step = np.zeros(model.nv)
        step[columns] = q[row].numpy()
        pin.computeJointJacobians(model, data, pin.integrate(model, pin.neutral(model), step))
        pin.updateFramePlacements(model, data)
        start = data.oMf[model.getFrameId(base)]
        for number, tip in enumerate(robot.tips):
            frame = model.getFrameId(tip)
            expected = start.actInv(data.oMf[frame]).homogeneous
            assert_close(poses[row, number], torch.from_numpy(expected), rtol=0, atol=1e-12)
            if robot.ground_place is None:
                world = pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:, columns]
                turned = torch.from_numpy(np.kron(np.eye(2), start.rotation.T) @ world)
                assert_close(slopes[row, number], turned, rtol=0, atol=1e-12)


def test_shapes_of_one_tip_and_of_several(tmp_path: Path) -> None:
    both, left = BODY["both hands"], BODY["one hand, the other as load"]
    q = draw(3, both.n)
    assert both(q).shape == (3, 2, 4, 4)
    assert both.jacobian(q).shape == (3, 2, 6, 17)
    assert left(q).shape == (3, 4, 4)
    assert left.jacobian(q).shape == (3, 6, 17)
    assert_close(both(q)[:, 0], left(q), rtol=0, atol=0)
    bracket = '<link name="b"/><joint name="f" type="fixed"><parent link="chest"/><child link="b"/></joint></robot>'
    before, joint, after = URDF_FILE.read_text(encoding="utf-8").partition('"right_shoulder_pitch" type="revolute">')
    text = before + joint + after.replace("chest", "b", 1)
    (tmp_path / "bracket.urdf").write_text(text.replace("</robot>", bracket))
    for path in (tmp_path / "bracket.urdf", URDF_FILE):
        with pytest.warns(dc.DiffeoCalibWarning, match=r"left out: 'right_shoulder_pitch'.* load=\['right_hand'\]"):
            serial = dc.load_urdf(path, "pelvis", "left_hand")
    assert isinstance(serial, dc.Chain)
    assert serial.n == 10
    assert_close(serial(q[:, :10]), left(q), rtol=0, atol=0)


def reordered(q: Tensor, robot: Tree, other: Tree) -> Tensor:
    """Configurations of one robot in the order of the joints of another."""
    return q[:, [robot.joint_names.index(name) for name in other.joint_names]]


@every_chain
def test_a_reversed_chain_has_inverse_poses(chain: dc.Chain) -> None:
    back, q = chain.reversed(), draw(5, chain.n, size=0.5)
    own = reordered(q, chain, back)
    assert (back.base, back.tips) == (chain.tip, (chain.base,))
    assert_close(back(own), torch.linalg.inv(chain(q)), rtol=0, atol=1e-13)
    again = back.reversed()
    assert again.serial
    assert again.tips == chain.tips
    assert_close(again(reordered(q, chain, again)), chain(q), rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("tips", "loads", "message"),
    [
        ([], [], "`tip`: expected the name of a link, or a list of names"),
        (["left_hand", "left_hand"], [], r"`tip` names \['left_hand'\] twice"),
        (["left_hand"], ["left_hand"], r"`load` names \['left_hand'\], which `tip` names too"),
        (["left_hand"], ["tail"], "`load`: .* has no link 'tail'"),
        (["left_hand", "pelvis"], [], "has no moving joint from 'pelvis' to 'pelvis'"),
    ],
)
def test_wrong_ends_are_explained(tips: list[str], loads: list[str], message: str) -> None:
    with pytest.raises((InputError, RobotError), match=message):
        dc.load_urdf(URDF_FILE, "pelvis", tips, loads)


@every_robot
def test_jacobians_are_derivatives_and_descriptions_come_back(robot: Tree) -> None:
    q = draw(3, robot.n)
    slopes = vmap(jacfwd(lambda row: robot.tip_poses(row[None])[0]))(q)  # (N, tips, 4, 4, n)
    found = robot.jacobian(q).view(3, len(robot.tips), 6, robot.n)
    assert_close(found[:, :, :3], slopes[..., :3, 3, :], rtol=0, atol=1e-13)
    spin = torch.einsum("ntabj,ntcb->ntjac", slopes[..., :3, :3, :], robot.tip_poses(q)[..., :3, :3])
    assert_close(skew(found[:, :, 3:].mT), spin, rtol=0, atol=1e-13)
    again = robot_from_config(json.loads(json.dumps(robot.to_config())))
    assert type(again) is type(robot)
    assert repr(again) == repr(robot)
    q = draw(4, robot.n)
    assert_close(again.places(q), robot.places(q), rtol=0, atol=1e-14)


def laden(robot: Tree) -> GeometryMap:
    """Elastic, with waves and crooked axes, and with a weight at its last end."""
    payload = Payload(list(robot.ends)[-1], torch.tensor(3.0, dtype=torch.float64), 5.0)
    return GeometryMap(geometry_of(robot), elastic=True, own=errors_of(robot), payload=payload)


@every_robot
@pytest.mark.parametrize("size", [1e-9, 0.5])
def test_errors_sag_waves_and_axes_have_exact_derivatives(robot: Tree, size: float) -> None:
    nominal = laden(robot)
    q, theta = draw(3, robot.n), draw(nominal.parameters, seed=14, size=size)
    by_joint = vmap(jacrev(lambda row: nominal(row[None], theta)[0]))(q)
    assert_close(nominal.jacobian(q, theta), by_joint, rtol=1e-11, atol=1e-12)
    by_theta = jacrev(lambda values: nominal(q, values))(theta)
    found = nominal.sensitivities(q, theta)
    assert_close(found, by_theta, rtol=1e-11, atol=1e-12)
    assert nominal.sag.start == nominal.sag.stop or float(found[..., nominal.sag].abs().max()) > 1e-3


def moment_about(robot: Tree, q: Tensor, joint: int, e: Tensor, masses: Tensor) -> Tensor:
    """e . sum (o_f - o_l) x m_f g over what the joint moves on the ground, by a second derivation: potential energy."""
    ground = robot.ground_place
    places = robot.places(q)
    places = places if ground is None else torch.linalg.inv(places[:, ground])[:, None] @ places
    frame = places[:, joint]
    axis = (frame[:, :3, :3] @ e[:, None])[..., 0]
    carried = torch.from_numpy(robot.arrays.moved[:, joint]).to(q)
    h = 1e-5
    energies = []
    for sign in (1.0, -1.0):
        turn = torch.matrix_exp(sign * h * skew(axis))
        arms = places[..., :3, 3] - frame[:, None, :3, 3]
        moved = (turn[:, None] @ arms[..., None])[..., 0]
        energies.append(((masses * carried)[:, None] * 9.81 * moved)[..., 2].sum(1))
    return (energies[1] - energies[0]) / (2 * h)


@every_robot
def test_features_are_moments_of_everything_that_a_joint_carries(robot: Tree) -> None:
    """And the direction of the force along a slide."""
    sag, q = GravitySag(robot), draw(12, robot.n)
    masses = draw(len(robot.before), seed=1).abs()
    masses[~torch.from_numpy(robot.arrays.moved).any(1)] = 0.0
    features = sag.features(q).split([c.size for c in sag.compliances], dim=1)
    for compliance, values in zip(sag.compliances, features, strict=True):
        only = torch.zeros_like(masses)
        places, axis = list(compliance.places), torch.from_numpy(compliance.axis)
        if not places:
            turn = robot.places(q)[:, compliance.joint, :3, :3]
            ground = robot.ground_place
            turn = turn if ground is None else robot.places(q)[:, ground, :3, :3].mT @ turn
            assert_close(values, turn @ axis, rtol=0, atol=1e-14)
            continue
        only[places] = masses[places]
        expected = moment_about(robot, q, compliance.joint, axis, only)
        found = -9.81 * (values.view(len(q), -1, 3)[..., 2] * masses[places]).sum(1)
        assert_close(found, expected, rtol=0, atol=2e-8)


def own_features(robot: Tree, q: Tensor) -> dict[str, Tensor]:
    """Gravity features of every joint about its own axis, by its name."""
    sag = GravitySag(robot)
    parts = sag.features(q).split([compliance.size for compliance in sag.compliances], 1)
    return {robot.moving_names[c.joint]: part for c, part in zip(sag.compliances, parts, strict=True) if c.own}


def contained(here: dict[str, Tensor], there: dict[str, Tensor]) -> float:
    """Largest part of one robot's features that no combination of the same joint's features of the other gives."""
    both, of = [(there[name], one) for name, one in here.items() if name in there], torch.linalg.lstsq
    return max(float((own @ of(own, one, driver="gelsd").solution - one).abs().max()) for own, one in both)


@pytest.mark.parametrize("name", ["serial", "arm", "two arms"])
def test_gravity_is_that_of_the_ground(name: str) -> None:
    """What a joint's sag can be does not depend on the link from which one looks, unless the ground is forgotten."""
    robot = ROBOTS[name]
    back, q = robot.reversed(robot.tips[0]), draw(80, robot.n)
    own = reordered(q, robot, back)
    here = own_features(robot, q)
    assert contained(here, own_features(back, own)) < 1e-10
    loads = {load: back.ends[load] for load in back.loads}
    hanging = Tree("x", back.base, back.joints, back.parents, Ends({tip: back.ends[tip] for tip in back.tips}, loads))
    assert contained(here, own_features(hanging, own)) > 1e-2


def test_a_urdf_read_from_hand_to_hand_is_its_reversed_tree() -> None:
    both, read = BODY["both hands"], BODY["hand to hand on a torso"]
    held, q = both.reversed("left_hand"), draw(80, both.n, size=0.5)
    assert_close(held(reordered(q, both, held)), read(reordered(q, both, read)), rtol=0, atol=1e-14)
    here, there = own_features(held, reordered(q, both, held)), own_features(read, reordered(q, both, read))
    assert set(here) == set(there)
    assert contained(here, there) < 1e-10
    for tip in (None, "middle"):
        with pytest.raises(RobotError, match=r"`tip`: expected one of left_hand, right_hand"):
            both.reversed(tip)
