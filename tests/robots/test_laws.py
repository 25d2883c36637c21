"""Laws of every robot: poses of pinocchio, exact derivatives, descriptions, views from its tip, gravity, payloads."""

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
from table_bank import refused
from torch import Tensor
from torch.func import jacfwd, jacrev, vmap
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.robots import (
    Chain,
    DHRow,
    Geometry,
    Joint,
    SimulatedArm,
    from_dh,
    load_urdf,
    simulated_arm,
    with_load,
)
from diffeo_calib.robots.gravity import GravitySag
from diffeo_calib.robots.payload import Payload
from diffeo_calib.robots.se3 import skew
from diffeo_calib.robots.tree import Ends, Tree, robot_from_config

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
    both, left, q = BODY["both hands"], BODY["one hand, the other as load"], draw(3, 17)
    for robot, tips in ((both, (2,)), (left, ())):
        assert (robot(q).shape, robot.jacobian(q).shape) == ((3, *tips, 4, 4), (3, *tips, 6, 17))
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


@every_robot
@pytest.mark.parametrize("size", [1e-9, 0.5])
def test_errors_sag_waves_and_axes_have_exact_derivatives(robot: Tree, size: float) -> None:
    """Elastic, with waves and crooked axes, and with a weight at its last end."""
    payload = Payload(list(robot.ends)[-1], torch.tensor(3.0, dtype=torch.float64), 5.0)
    nominal = GeometryMap(geometry_of(robot), elastic=True, own=errors_of(robot), payload=payload)
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


@every_chain
def test_merged_places_lose_nothing(chain: Chain) -> None:
    """The moment of a weight at any frame beyond a joint is in the span of the joint's features."""
    sag, q = GravitySag(chain), draw(60, chain.n)
    frames = chain.joint_frames(q)
    at = torch.cat([frames[..., :3, 3], chain(q)[:, None, :3, 3]], dim=1)
    parts = sag.features(q).split([compliance.size for compliance in sag.compliances], 1)
    for compliance, used in zip(sag.compliances, parts, strict=True):
        e = frames[:, compliance.joint, :3, :3] @ torch.from_numpy(compliance.axis)
        for place in range(compliance.joint + 1, chain.moving + 1) if compliance.places else ():
            arm = at[:, place] - at[:, compliance.joint]
            moment = (e * torch.linalg.cross(arm, draw(3, seed=place).expand_as(arm))).sum(1, keepdim=True)
            explained = used @ torch.linalg.lstsq(used, moment, driver="gelsd").solution
            assert float((explained - moment).abs().max()) < 1e-12


def test_where_sag_and_payloads_are_not() -> None:
    """All joints turn about the tip; a slide on another branch; payloads that cannot be."""
    joints = [Joint("a", "revolute", torch.eye(4)), Joint("b", "revolute", torch.eye(4), torch.tensor([1.0, 0, 0]))]
    chain = Chain("ball", "floor", "hand", joints)
    sag = GravitySag(chain)
    assert sag.compliances == ()
    assert sag.size == len(sag.joints) == len(sag.own) == 0
    assert GeometryMap(Geometry.nominal(chain), elastic=True).parameters == Geometry.nominal(chain).size
    rows = [DHRow(0.1, 0.3, 0.2), DHRow(0.2, -0.7, 0.1, kind="prismatic"), DHRow(0.3, 1.1, 0.2, parent=0)]
    robot = from_dh(rows)
    for link, joints in (("tip_1", {0, 1}), ("tip_2", {0, 2})):
        sag = laden(robot, torch.tensor(3.0, dtype=torch.float64), link)
        assert set(sag.joints[sag.loaded].tolist()) == joints
    robot = SimulatedArm(0).nominal
    refused(
        ("all payloads are 0", lambda: Payload.of_rows(robot, 0.0 * MASSES, None)),
        ("the link of the payload", lambda: Payload.of_rows(robot, MASSES, "nowhere")),
    )
    assert not Payload.of_rows(robot, None, None)


MASSES = torch.tensor([0.0, 2.0, 5.0, 5.0, 1.5], dtype=torch.float64)
UNIT = 5.0


def laden(robot: Tree, masses: Tensor = MASSES, link: str | None = None) -> GravitySag:
    return GravitySag(robot, Payload(link or robot.tips[0], masses, UNIT))


ONE_HAND = "one hand, the other as load"
PLACES = [
    *((chain, chain.tip) for chain in CHAINS.values()),
    (BODY[ONE_HAND], "left_hand"),
    (BODY[ONE_HAND], "right_hand"),
]


@pytest.mark.parametrize(("robot", "link"), PLACES, ids=[*CHAINS, "body", "branch of a body"])
def test_one_payload_is_one_of_the_unknown_masses(robot: Tree, link: str) -> None:
    """Folded into the coefficients without payload, it bends the robot as before: all joints that carry it."""
    q, sag = draw(6, robot.n), laden(robot, torch.tensor(3.0, dtype=torch.float64), link)
    w = draw(sag.size, seed=2)
    expected = GravitySag(robot).twists(q, sag.folded(w))
    torch.testing.assert_close(sag.twists(q, w), expected, rtol=1e-12, atol=1e-13)
    bent = sag.twists(q, torch.where(sag.loaded, w, 0.0)).abs().amax((0, 2)) > 0
    carrying = robot.ancestors[robot.moving + list(robot.ends).index(link)]
    assert not bool((bent & ~carrying).any())
    if robot is BODY[ONE_HAND]:
        assert bool(bent[carrying].all())


def test_masses_are_counted_in_units() -> None:
    """Coefficients are sags under one unit, whatever the unit of mass is."""
    robot, q = SimulatedArm().nominal, draw(len(MASSES), 6)
    w = draw(laden(robot).size, seed=2)
    in_grams = GravitySag(robot, Payload(robot.tips[0], 1e3 * MASSES, 1e3 * UNIT))
    torch.testing.assert_close(in_grams.twists(q, w), laden(robot).twists(q, w))
    assert Payload(robot.tips[0], MASSES, UNIT).amounts(q)[:, 0].tolist() == [0.0, 0.4, 1.0, 1.0, 0.3]
    with pytest.raises(InputError, match="payloads of 5 rows: expected one for each, got 3 configurations"):
        laden(robot).features(q[:3])
    with pytest.raises(InputError, match="a payload of every row"):
        laden(robot).folded(w)


def test_a_payload_beside_the_flange_sits_where_it_is_said() -> None:
    """Masses of every row differ; one set of coefficients explains all of their torques."""
    arm = SimulatedArm(seed=3)
    robot = with_load(arm.nominal, "box", simulated_arm.PAYLOAD_CENTRE)
    assert (robot.tips, robot.loads) == (("flange",), ("box",))
    q, masses = arm.sample(100), torch.linspace(0.0, 9.0, 100, dtype=torch.float64)
    assert robot(q).equal(arm.nominal(q))
    torques = arm.gravity_torques(q, masses) - arm.gravity_torques(q, 0.0)
    assert float(torques.abs().amax(0)[1:5].min()) > 1.0
    for link, least, most in (("box", 0.0, 1e-11), ("flange", 0.1, 10.0)):
        sag, away = laden(robot, masses, link), []
        for joint in range(6):
            used, own = sag.features(q)[:, sag.loaded & sag.own & (sag.joints == joint)], torques[:, [joint]]
            away.append(float((used @ torch.linalg.lstsq(used, own, driver="gelsd").solution - own).abs().max()))
        assert least <= max(away) < most
    for name, on, words in (("flange", None, "a new name"), ("box", "wrist", r"`on`.*flange.*got wrist")):
        with pytest.raises(RobotError, match=words):
            with_load(arm.nominal, name, (0.0, 0.0, 0.1), on)
