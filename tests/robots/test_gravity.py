"""Gravity sag and payloads: features against moments of weights, payloads of known mass."""

import pytest
import torch
from robots_bank import CHAINS, draw, every_chain
from simulated_body import URDF_FILE
from table_bank import refused
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, RobotError
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.robots import Chain, DHRow, Geometry, Joint, SimulatedArm, from_dh, simulated_arm, with_load
from diffeo_calib.robots.gravity import GravitySag
from diffeo_calib.robots.payload import Payload
from diffeo_calib.robots.tree import Tree
from diffeo_calib.runtime.chain import Compliance


def origins(chain: Chain, q: Tensor) -> Tensor:
    frames, tip = chain.joint_frames(q), chain(q)
    return torch.cat([frames[..., :3, 3], tip[:, None, :3, 3]], dim=1)


def columns(sag: GravitySag, compliance: Compliance) -> Tensor:
    return torch.cat([torch.full((other.size,), other is compliance) for other in sag.compliances])


def direction(chain: Chain, compliance: Compliance, q: Tensor) -> Tensor:
    """The unit vector of a compliance in the base, (N, 3)."""
    part = torch.from_numpy(compliance.axis)
    return torch.einsum("nab,b->na", chain.joint_frames(q)[:, compliance.joint, :3, :3], part)


def unexplained(features: Tensor, values: Tensor) -> float:
    """Largest residual of a linear fit."""
    solution = torch.linalg.lstsq(features, values[:, None], driver="gelsd").solution
    return float((features @ solution - values[:, None]).abs().max())


@every_chain
def test_merged_places_lose_nothing(chain: Chain) -> None:
    """The moment of a weight at any frame beyond a joint is in the span of the joint's features."""
    sag, q = GravitySag(chain), draw(60, chain.n)
    features, at = sag.features(q), origins(chain, q)
    for compliance in sag.compliances:
        e, used = direction(chain, compliance, q), features[:, columns(sag, compliance)]
        for place in range(compliance.joint + 1, chain.moving + 1) if compliance.places else ():
            arm = at[:, place] - at[:, compliance.joint]
            moment = (e * torch.linalg.cross(arm, draw(3, seed=place).expand_as(arm))).sum(1)
            assert unexplained(used, moment) < 1e-12


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


BODY = dc.load_urdf(URDF_FILE, "pelvis", ["left_hand"], ["right_hand"])
PLACES = [*((chain, chain.tip) for chain in CHAINS.values()), (BODY, "left_hand"), (BODY, "right_hand")]


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
    if robot is BODY:
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
