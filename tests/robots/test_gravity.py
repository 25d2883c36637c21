"""Gravity sag: features against moments of weights, twists and slopes against autograd."""

import torch
from robots_bank import draw, every_chain
from torch import Tensor

from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.robots import Chain, Geometry, Joint, SimulatedArm
from diffeo_calib.robots.gravity import GravitySag
from diffeo_calib.runtime.chain import Compliance


def origins(chain: Chain, q: Tensor) -> Tensor:
    """Origins of all frames, the tip last: (N, n_all + 1, 3)."""
    frames, tip = chain.joint_frames(q), chain(q)
    return torch.cat([frames[..., :3, 3], tip[:, None, :3, 3]], dim=1)


def columns(sag: GravitySag, compliance: Compliance) -> Tensor:
    """(K,) True for the coefficients of one compliance."""
    return torch.cat([torch.full((other.size,), other is compliance) for other in sag.compliances])


def direction(chain: Chain, compliance: Compliance, q: Tensor) -> Tensor:
    """The unit vector of a compliance in the base, (N, 3)."""
    part = torch.from_numpy(compliance.axis)
    return torch.einsum("nab,b->na", chain.joint_frames(q)[:, compliance.joint, :3, :3], part)


def unexplained(features: Tensor, values: Tensor) -> float:
    """Largest residual of a linear fit."""
    solution = torch.linalg.lstsq(features, values[:, None], driver="gelsd").solution
    return float((features @ solution - values[:, None]).abs().max())


# --- against physics ----------------------------------------------------------------------------------------------


def test_centres_of_mass_beside_the_origins_are_nearly_explained() -> None:
    """The features place masses at the frames' origins; centres of mass of real links lie a little beside them."""
    arm = SimulatedArm(seed=3)
    sag, q = GravitySag(arm.nominal), arm.sample(400)
    features, torques = sag.features(q), arm.gravity_torques(q)
    for joint, share in ((1, 0.02), (2, 0.04)):  # shoulder and elbow, which sag most
        (compliance,) = (f for f in sag.compliances if f.own and f.joint == joint)
        used = features[:, columns(sag, compliance)]
        assert unexplained(used, torques[:, joint]) < share * float(torques[:, joint].abs().max())


# --- the compliances of a chain --------------------------------------------------------------------------------------


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


def test_a_robot_without_lever_arms_has_no_sag() -> None:
    """All joints turn about the tip itself."""
    joints = [Joint("a", "revolute", torch.eye(4)), Joint("b", "revolute", torch.eye(4), torch.tensor([1.0, 0, 0]))]
    chain = Chain("ball", "floor", "hand", joints)
    sag = GravitySag(chain)
    assert sag.compliances == ()
    assert sag.size == len(sag.joints) == len(sag.own) == 0
    assert GeometryMap(Geometry.nominal(chain), elastic=True).parameters == Geometry.nominal(chain).size
