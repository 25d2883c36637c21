"""Gravity sag without a model of masses or stiffnesses: compliance times the torque of unknown masses.

A robot's links bend and its gears wind up in proportion to their loads. Every unknown mass beyond joint l pulls at an
unknown point along an unknown but constant direction. If the masses sit at the origins o_f of the moving frames, the
moment of gravity about the unit vector e through o_l is linear in unknown vectors c_f = mass * gravity,

    e . sum_f (o_f - o_l) x c_f = sum_f c_f . ( e x (o_f - o_l) ),

so that ``e x (o_f - o_l)`` are the features of the sag about e. They are smooth functions of the joint values; the
coefficients (compliance times c_f) are parameters with a Gaussian prior. Two loads are not described exactly: masses
beside the frames' origins and the lines between them (on a usual arm a few percent of a shoulder's torque, more of a
roll axis' torque), and the load that turns with the last joint about its own axis.

In a tree the sum runs over all places that joint l moves as seen from the ground, measured or not: the weight of one
arm bends the torso that carries the other. Where the robot's base is another link than the one on the ground (hand to
hand), features are computed in the ground's frame, in which gravity is constant, and a joint between the two moves
what is on the base's side.

A payload that is weighed (payload.py) pulls at a known place with a known mass m. Its features are those of that place
times m, with coefficients of their own: compliance times gravity.

The sag is an error twist that depends on the configuration (geometry.py): about the joint's own axis (*joint*
compliance; along the axis for a slide) and about the two axes perpendicular to it (*lateral* compliance).
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.robots.payload import NO_PAYLOAD, Payload
from diffeo_calib.robots.tree import BASE, Tree
from diffeo_calib.runtime.chain import Compliance, Masses, load_slopes, loads


class GravitySag:
    """Gravity features of a robot and the error twists that they make.

    Args:
        chain: the nominal robot; its nominal frames make the features.
        payload: masses at a tip or at a branch without markers (`load`).

    Attributes:
        compliances: all compliances, those under the payload last; their features follow each other in the coefficients
            w (K,). size: K.
        joints: (K,) the moving joint of every coefficient.
        own: (K,) True for a compliance along the joint's own motion, False for a lateral one.
        loaded: (K,) True for the coefficients of the payload, the last ones.
    """

    def __init__(self, chain: Tree, payload: Payload = NO_PAYLOAD) -> None:
        self.chain, self.payload = chain, payload
        self.compliances = (*chain.arrays.compliances, *(_under_payload(chain, payload.link) if payload else ()))
        self._masses = Masses(*map(torch.from_numpy, Masses.of(self.compliances, chain.arrays)))
        self._numbers = self._masses.own.mT.nonzero()[:, 1]  # of the compliance of each mass
        each = [(c.joint, c.own, c.loaded) for c in self.compliances for _ in range(c.size)]
        columns = torch.tensor(each, dtype=torch.int64, device="cpu").view(-1, 3)
        self.size, self.joints = len(each), columns[:, 0]
        self.own, self.loaded = columns[:, 1:].bool().unbind(1)

    @property
    def components(self) -> Tensor:
        """(K,) the component (0, 1, 2) of gravity, in the ground's frame, that a coefficient multiplies."""
        return torch.arange(self.size, dtype=torch.int64, device="cpu") % 3

    @property
    def parts(self) -> dict[str, Tensor]:
        """(K,) which coefficients are of which part of the sag, by name; that of a payload only with one."""
        by_own_weight, loaded = self.own, self.loaded
        parts = {"gravity on joints": by_own_weight & ~loaded, "gravity on links": ~by_own_weight & ~loaded}
        return parts | ({"payload": loaded} if self.payload else {})

    def features(self, q: Tensor) -> Tensor:
        """Feature values [m; 1 for forces on prismatic joints]: q (N, n) -> (N, K)."""
        masses, frames = self._on(q), self._frames(q)
        numbers = self._numbers.to(q.device)
        e = (frames[:, masses.joints, :3, :3] @ masses.axes[..., None])[:, numbers, :, 0]  # (N, masses, 3)
        pulls = torch.linalg.cross(e, masses.arms @ frames[..., :3, 3]) + e * masses.slides
        return (pulls * self._loads(q)[:, numbers, None]).flatten(1)

    def twists(self, q: Tensor, w: Tensor) -> Tensor:
        """Error twists of the moving joints' frames: q (N, n), w (K,) -> (N, n_all, 6) [m, rad]."""
        sag = self._on(q).sag(w)
        e, m = loads(sag, self._frames(q))
        return ((self._loads(q) * (e * m).sum(-1)) @ sag.directions).unflatten(1, (-1, 6))

    def twist_slopes(self, q: Tensor, w: Tensor) -> Tensor:
        """Derivatives of the twists by the joints: (N, n_all, 6, n)."""
        sag, chain = self._on(q).sag(w), self.chain
        seen = {name: torch.from_numpy(getattr(chain.arrays, name)) for name in ("axes", "revolute", "moved", "signs")}
        robot = SimpleNamespace(**{name: part.to(q.device) for name, part in seen.items()})
        by_moving = load_slopes(robot, sag, self._frames(q))
        slopes = chain.by_active(self._loads(q)[..., None] * by_moving)  # (N, compliances, n)
        return (sag.directions.mT @ slopes).unflatten(1, (-1, 6))

    def sensitivities(self, q: Tensor, by_twist: Tensor) -> Tensor:
        """Derivatives by the coefficients (N, m, K) from the derivatives by the twists (N, m, joints, 6)."""
        by_compliance = by_twist.flatten(2) @ self._on(q).directions.mT
        return by_compliance[..., self._numbers.to(q.device).repeat_interleave(3)] * self.features(q)[:, None]

    def folded(self, w: Tensor) -> Tensor:
        """The coefficients (K,) of a robot that carries its payload everywhere as those of one without payload.

        The payload then is one of the unknown masses at its place. Raises InputError: one that differs between rows.
        """
        if not self.payload:
            return w
        if self.payload.by_row:
            raise InputError.of("a payload of every row", expected="one for all", fix="choose one: with_payload(mass)")
        amount = self.payload.amounts(w[None])[0]
        parts = list(w.split([compliance.size for compliance in self.compliances]))
        unladen = [compliance for compliance in self.compliances if not compliance.loaded]
        for compliance, load in zip(self.compliances[len(unladen) :], parts[len(unladen) :], strict=True):
            alike = (compliance.joint, compliance.direction.tolist())
            k = next(k for k, c in enumerate(unladen) if (c.joint, c.direction.tolist()) == alike)
            places = unladen[k].places
            at = 3 * places.index(_representative(self.chain, compliance.places[0])) if places else 0
            parts[k] = torch.cat([parts[k][:at], parts[k][at : at + 3] + amount * load, parts[k][at + 3 :]])
        return torch.cat([w[:0], *parts[: len(unladen)]])

    def _on(self, q: Tensor) -> Masses:
        """The masses on the device of joint values."""
        return Masses(*(part.to(q.device) for part in self._masses))

    def _loads(self, q: Tensor) -> Tensor:
        """(N or 1, compliances) the load of each in units: the payload where that is the load, else 1."""
        loaded = torch.tensor([compliance.loaded for compliance in self.compliances], dtype=torch.bool, device=q.device)
        return torch.where(loaded, self.payload.amounts(q), q.new_ones(1, 1))

    def _frames(self, q: Tensor) -> Tensor:
        """Places in the ground's frame: (N, F, 4, 4)."""
        places, ground = self.chain.places(q), self.chain.ground_place
        return places if ground is None else torch.linalg.inv(places[:, ground])[:, None] @ places


def _under_payload(chain: Tree, link: str) -> list[Compliance]:
    """The compliances of a robot under a load at one link, where they carry it."""
    place = chain.moving + list(chain.ends).index(link)
    stand, moved = _representative(chain, place), chain.arrays.moved[place]
    chosen = [c for c in chain.arrays.compliances if moved[c.joint] and (not c.places or stand in c.places)]
    return [replace(c, places=(place,) if c.places else (), loaded=True) for c in chosen]


def _representative(chain: Tree, place: int) -> int:
    """The place of masses that is always at the origin of this one."""
    while not chain.arrays.distinct[place] and chain.before[place] != BASE:
        place = chain.before[place]
    return place
