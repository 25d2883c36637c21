"""Deflection under gravity: features against moments of weights, twists and slopes against autograd."""

from dataclasses import replace

import pytest
import torch
from robots_bank import CHAINS, draw, every_chain
from torch import Tensor

from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.robots import Chain, Geometry, Joint, SimulatedArm, simulated_arm
from diffeo_calib.robots.chain import joint_motions
from diffeo_calib.robots.geometry import twist_transform
from diffeo_calib.robots.gravity import Deflection, Elasticity

UPRIGHT, ON_A_WALL = (0.0, 0.0, -9.81), (-6.0, 2.0, 5.0)


def origins(chain: Chain, q: Tensor) -> Tensor:
    """Of all frames, the tip's last: (N, n_all + 1, 3)."""
    frames, tip = chain.joint_frames(q), chain(q)
    return torch.cat([frames[..., :3, 3], tip[:, None, :3, 3]], dim=1)


def columns(elasticity: Elasticity, family: Deflection) -> Tensor:
    """Which coefficients belong to a family."""
    return torch.cat([torch.full((other.size,), other is family) for other in elasticity.deflections])


def direction(chain: Chain, family: Deflection, q: Tensor) -> Tensor:
    """The unit vector of a family in the base, (N, 3)."""
    part = family.direction[3:] if family.places else family.direction[:3]
    return torch.einsum("nab,b->na", chain.joint_frames(q)[:, family.joint, :3, :3], part)


def unexplained(features: Tensor, values: Tensor) -> float:
    """Largest residual of a linear fit."""
    solution = torch.linalg.lstsq(features, values[:, None], driver="gelsd").solution
    return float((features @ solution - values[:, None]).abs().max())


# --- against physics ----------------------------------------------------------------------------------------------


class Weighted:
    """The simulated arm, links and payload with their centres of mass between the frames' origins."""

    def __init__(self, gravity: tuple[float, float, float]) -> None:
        self.arm = SimulatedArm(seed=3)
        self.gravity = torch.tensor(gravity, dtype=torch.float64)
        chain = self.arm.nominal
        ends = torch.cat([chain.offsets[1:], chain.tip_offset[None]])[:, :3, 3]
        self.arm._centres = torch.linspace(0.2, 1.0, 6, dtype=torch.float64)[:, None] * ends

    def moments(self, q: Tensor) -> Tensor:
        """Of all weights beyond every joint, about its origin: (N, 6, 3) [N m]."""
        chain = self.arm.nominal
        frames = chain.joint_frames(q)
        links = frames @ joint_motions(chain.motion_terms, q)
        total = torch.zeros(len(q), 6, 3, dtype=torch.float64)
        for joint in range(6):
            for link in range(joint, 6):
                centre = links[:, link] @ torch.cat([self.arm._centres[link], torch.ones(1)]).double()
                weight = (self.arm._masses[link] * self.gravity).expand(len(q), 3)
                total[:, joint] += torch.linalg.cross(centre[:, :3] - frames[:, joint, :3, 3], weight)
        return total


@pytest.fixture(params=[UPRIGHT, ON_A_WALL], ids=["upright", "on a wall"])
def weighted(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Weighted:
    monkeypatch.setattr(simulated_arm, "GRAVITY", request.param)
    return Weighted(request.param)


def test_torques_about_every_axis_are_linear_in_its_features(weighted: Weighted) -> None:
    elasticity, q = Elasticity(weighted.arm.nominal), weighted.arm.sample(200)
    features, torques = elasticity.features(q), weighted.arm.gravity_torques(q)
    assert float(torques.abs().amax(0)[1:5].min()) > 1.0
    for family in elasticity.deflections:
        if family.own:
            used = features[:, columns(elasticity, family)]
            assert unexplained(used, torques[:, family.joint]) < 1e-11


def test_lateral_moments_are_linear_in_their_features(weighted: Weighted) -> None:
    elasticity, q = Elasticity(weighted.arm.nominal), weighted.arm.sample(200)
    features, moments = elasticity.features(q), weighted.moments(q)
    seen = 0
    for family in elasticity.deflections:
        moment = (direction(weighted.arm.nominal, family, q) * moments[:, family.joint]).sum(1)
        assert unexplained(features[:, columns(elasticity, family)], moment) < 1e-11
        seen += not family.own and float(moment.abs().max()) > 1.0
    assert seen >= 9


def test_centres_of_mass_beside_the_origins_are_nearly_explained() -> None:
    """Masses are placed at the frames' origins; real links have theirs a little beside the line between them."""
    arm = SimulatedArm(seed=3)
    elasticity, q = Elasticity(arm.nominal), arm.sample(400)
    features, torques = elasticity.features(q), arm.gravity_torques(q)
    for joint, share in ((1, 0.02), (2, 0.04)):  # shoulder and elbow, which deflect most
        (family,) = (f for f in elasticity.deflections if f.own and f.joint == joint)
        used = features[:, columns(elasticity, family)]
        assert unexplained(used, torques[:, joint]) < share * float(torques[:, joint].abs().max())


@every_chain
def test_amounts_are_moments_of_weights_at_the_places(chain: Chain) -> None:
    """Written out: e . sum_f (o_f - o_l) x c_f, and on a slide the force along it."""
    elasticity, q = Elasticity(chain), draw(7, chain.n)
    w, at = draw(elasticity.size, seed=3), origins(chain, draw(7, chain.n))
    expected = torch.zeros(7, chain.moving, 6, dtype=torch.float64)
    start = 0
    for family in elasticity.deflections:
        e, joint = direction(chain, family, q), family.joint
        forces = w[start : start + family.size].view(-1, 3)
        start += family.size
        if family.places:
            load = torch.zeros(7, 3, dtype=torch.float64)
            for place, force in zip(family.places, forces, strict=True):
                load += torch.linalg.cross(at[:, place] - at[:, joint], force.expand(7, 3))
        else:
            load = forces.expand(7, 3)
        expected[:, joint] += (e * load).sum(1, keepdim=True) * family.direction
    torch.testing.assert_close(elasticity.twists(q, w), expected, rtol=1e-12, atol=1e-13)


# --- twists, features and slopes ----------------------------------------------------------------------------------


@every_chain
def test_twists_are_features_times_coefficients(chain: Chain) -> None:
    elasticity, q = Elasticity(chain), draw(6, chain.n)
    w, features = draw(elasticity.size, seed=4), elasticity.features(q)
    assert features.shape == (6, elasticity.size)
    expected = torch.zeros(6, chain.moving, 6, dtype=torch.float64)
    for family in elasticity.deflections:
        used = columns(elasticity, family)
        expected[:, family.joint] += (features[:, used] @ w[used])[:, None] * family.direction
    torch.testing.assert_close(elasticity.twists(q, w), expected, rtol=1e-12, atol=1e-13)


@every_chain
def test_slopes_of_the_twists_against_autograd(chain: Chain) -> None:
    elasticity, q = Elasticity(chain), draw(5, chain.n)
    w, live = draw(elasticity.size, seed=5), q.clone().requires_grad_()
    twists = elasticity.twists(live, w) + 0.0 * live.sum()  # a graph where nothing depends on q, too
    rows = [
        torch.autograd.grad(twists[:, joint, part].sum(), live, retain_graph=True)[0]
        for joint in range(chain.moving)
        for part in range(6)
    ]
    expected = torch.stack(rows, 1).view(5, chain.moving, 6, chain.n)
    torch.testing.assert_close(elasticity.twist_slopes(q, w), expected, rtol=1e-11, atol=1e-12)


@every_chain
def test_sensitivities_are_derivatives_by_the_coefficients(chain: Chain) -> None:
    elasticity, q = Elasticity(chain), draw(4, chain.n)
    by_twist = draw(4, 9, chain.moving, 6, seed=6)

    def response(w: Tensor) -> Tensor:
        return torch.einsum("nmjc,njc->nm", by_twist, elasticity.twists(q, w))

    expected = torch.func.jacrev(response)(draw(elasticity.size, seed=7))
    assert isinstance(expected, Tensor)
    torch.testing.assert_close(elasticity.sensitivities(q, by_twist), expected, rtol=1e-12, atol=1e-13)


@every_chain
def test_no_rows(chain: Chain) -> None:
    elasticity, q = Elasticity(chain), torch.zeros(0, chain.n, dtype=torch.float64)
    w = draw(elasticity.size)
    assert elasticity.features(q).shape == (0, elasticity.size)
    assert elasticity.twists(q, w).shape == (0, chain.moving, 6)
    assert elasticity.twist_slopes(q, w).shape == (0, chain.moving, 6, chain.n)
    none = torch.zeros(0, 3, chain.moving, 6, dtype=torch.float64)
    assert elasticity.sensitivities(q, none).shape == (0, 3, elasticity.size)


# --- which families there are -------------------------------------------------------------------------------------


@every_chain
def test_directions_are_the_axis_and_two_across_it(chain: Chain) -> None:
    elasticity = Elasticity(chain)
    for joint, axis in enumerate(chain.axes):
        mine = [f for f in elasticity.deflections if f.joint == joint]
        if not mine:  # the tip is on the last axis, at the joint's own origin
            assert joint == chain.moving - 1
            assert float(chain.tip_offset[:3, 3].norm()) == 0.0
            continue
        (own,) = (f for f in mine if f.own)
        turning = bool(chain.revolute[joint])
        assert bool(own.places) == turning
        part = own.direction[3:] if turning else own.direction[:3]
        torch.testing.assert_close(part, axis, rtol=0, atol=1e-15)
        assert float(own.direction.norm()) == pytest.approx(1.0)
        if not any(f.places for f in mine):  # a slide that ends the chain
            continue
        turns = torch.stack([f.direction[3:] for f in mine if f.places])
        torch.testing.assert_close(turns @ turns.mT, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-14)


@every_chain
def test_tables_tell_what_every_coefficient_is(chain: Chain) -> None:
    elasticity = Elasticity(chain)
    assert elasticity.size == sum(f.size for f in elasticity.deflections) == len(elasticity.joints)
    for family in elasticity.deflections:
        used = columns(elasticity, family)
        assert elasticity.joints[used].tolist() == [family.joint] * family.size
        assert elasticity.own[used].tolist() == [family.own] * family.size
        assert elasticity.components[used].tolist() == [0, 1, 2] * (family.size // 3)


def test_frames_in_one_point_are_one_place() -> None:
    chain = CHAINS["wrist in one point"]
    places = {family.joint: family.places for family in Elasticity(chain).deflections}
    # origins: 0 floor, 1 and 2 at the ends of the upper arm, 3 with 2, 4 the wrist, 5 with it, 6 the tip
    assert places == {0: (1, 2, 4, 6), 1: (2, 4, 6), 2: (4, 6), 3: (4, 6), 4: (6,), 5: (6,)}


@every_chain
def test_merged_places_lose_nothing(chain: Chain) -> None:
    """The moment of a weight at any frame beyond a joint is in the span of the joint's features."""
    elasticity, q = Elasticity(chain), draw(60, chain.n)
    features, at = elasticity.features(q), origins(chain, q)
    for family in elasticity.deflections:
        e, used = direction(chain, family, q), features[:, columns(elasticity, family)]
        for place in range(family.joint + 1, chain.moving + 1) if family.places else ():
            arm = at[:, place] - at[:, family.joint]
            moment = (e * torch.linalg.cross(arm, draw(3, seed=place).expand_as(arm))).sum(1)
            assert unexplained(used, moment) < 1e-12


def test_a_robot_without_lever_arms_has_no_deflections() -> None:
    """All joints turn about the tip itself."""
    joints = [Joint("a", "revolute", torch.eye(4)), Joint("b", "revolute", torch.eye(4), torch.tensor([1.0, 0, 0]))]
    chain = Chain("ball", "floor", "hand", joints)
    elasticity = Elasticity(chain)
    assert elasticity.deflections == ()
    assert elasticity.size == len(elasticity.joints) == len(elasticity.own) == 0
    assert GeometryMap(Geometry.nominal(chain), elastic=True).parameters == Geometry.nominal(chain).size


# --- where the robot stands ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["serial", "slides", "passive"])
def test_turning_the_base_turns_the_loads(name: str) -> None:
    """A robot on a turned base deflects as before under loads that are turned back; about gravity nothing changes."""
    chain, q = CHAINS[name], draw(6, CHAINS[name].n)
    turn = twist_transform(torch.tensor([0, 0, 0, 0, 0, 0.7], dtype=torch.float64))
    moving = [joint for joint in chain.joints if joint.kind != "fixed"]
    first = replace(moving[0], origin=turn @ moving[0].origin)
    turned = Chain("turned", chain.base, chain.tip, [first, *chain.joints[1:]])
    elasticity, other = Elasticity(chain), Elasticity(turned)
    w = draw(elasticity.size, seed=8)
    along = (w.view(-1, 3) @ turn[:3, :3].mT).flatten()
    torch.testing.assert_close(other.twists(q, along), elasticity.twists(q, w), rtol=1e-12, atol=1e-13)
    vertical = torch.zeros_like(w)
    vertical[2::3] = w[2::3]
    torch.testing.assert_close(other.twists(q, vertical), elasticity.twists(q, vertical), rtol=1e-12, atol=1e-13)


def test_a_vertical_first_axis_carries_no_weight() -> None:
    arm = SimulatedArm()
    elasticity, q = Elasticity(arm.nominal), arm.sample(20)
    w = draw(elasticity.size, seed=9)
    w[elasticity.components != 2] = 0.0
    assert float(elasticity.twists(q, w)[:, 0, 5].abs().max()) < 1e-14
    assert float(elasticity.twists(q, w)[:, 1, 4].abs().max()) > 0.1


def test_a_slide_is_loaded_along_itself_by_the_force_alone() -> None:
    chain = CHAINS["gantry"]
    elasticity, q = Elasticity(chain), draw(5, 3)
    w = torch.where(elasticity.own, draw(elasticity.size, seed=10), torch.zeros(()).double())
    twists = elasticity.twists(q, w)
    torch.testing.assert_close(twists, twists[:1].expand_as(twists), rtol=0, atol=1e-14)  # slides never turn
    assert float(twists[..., 3:].abs().max()) == 0.0
    assert float(twists[..., :3].abs().amax((0, 2)).min()) > 0.01
