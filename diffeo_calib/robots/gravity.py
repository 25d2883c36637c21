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

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.robots.joint import turned_axes
from diffeo_calib.robots.payload import Payload
from diffeo_calib.robots.se3 import skew
from diffeo_calib.robots.tree import BASE, Tree
from diffeo_calib.runtime.build import distinct_places, perpendicular, seen_from_ground


@dataclass(frozen=True, eq=False)
class Compliance:
    """One compliance and its family of features: the sag of a joint's frame in one direction.

    Args:
        joint: number of the moving joint whose frame sags.
        direction: (6,) unit twist in the frame before the joint's motion, translation first.
        own: whether it is along the joint's own motion (else lateral).
        places: numbers of the places at which masses pull, see :meth:`Tree.places`. Empty for a slide along its axis,
            where the feature is the force itself.
        loaded: whether the load is the payload, whose mass is known.
    """

    joint: int
    direction: Tensor
    own: bool
    places: tuple[int, ...]
    loaded: bool = False

    @property
    def size(self) -> int:
        """Number of its features."""
        return 3 * max(len(self.places), 1)


class GravitySag:
    """Gravity features of a robot and the error twists that they make.

    Args:
        chain: the nominal robot; its nominal frames make the features.
        payload: masses at a tip or at a branch that only weighs; None without.

    Raises:
        InputError: a payload at another link.

    Attributes:
        compliances: all compliances, those under the payload last; their features follow each other in the coefficients
            w (K,).
    """

    def __init__(self, chain: Tree, payload: Payload | None = None) -> None:
        self.chain, self.payload = chain, payload
        self.moved, self.signs = _seen_from_ground(chain)
        unladen = _compliances(chain, self.moved)
        self.compliances = (*unladen, *(_under_payload(chain, unladen, payload.link) if payload else ()))

    @property
    def size(self) -> int:
        """Number of coefficients K."""
        return sum(compliance.size for compliance in self.compliances)

    @cached_property
    def joints(self) -> Tensor:
        """(K,) the moving joint of every coefficient."""
        numbers = [c.joint for c in self.compliances for _ in range(c.size)]
        return torch.tensor(numbers, dtype=torch.int64, device="cpu")

    @cached_property
    def own(self) -> Tensor:
        """(K,) True for a compliance along the joint's own motion, False for a lateral one."""
        own = [c.own for c in self.compliances for _ in range(c.size)]
        return torch.tensor(own, dtype=torch.bool, device="cpu")

    @cached_property
    def loaded(self) -> Tensor:
        """(K,) True for the coefficients of the payload, the last ones."""
        loaded = [c.loaded for c in self.compliances for _ in range(c.size)]
        return torch.tensor(loaded, dtype=torch.bool, device="cpu")

    @property
    def parts(self) -> dict[str, Tensor]:
        """(K,) which coefficients are of which part of the sag, by name; that of a payload only with one."""
        own, loaded = self.own, self.loaded
        found = {"gravity on joints": own & ~loaded, "gravity on links": ~own & ~loaded}
        return found | ({"payload": loaded} if self.payload is not None else {})

    @cached_property
    def components(self) -> Tensor:
        """(K,) the component (0, 1, 2) of gravity, in the ground's frame, that a coefficient multiplies."""
        return torch.arange(self.size, dtype=torch.int64, device="cpu") % 3

    def features(self, q: Tensor) -> Tensor:
        """Feature values [m; 1 for forces on slides]: q (N, n) -> (N, K)."""
        parts = [q.new_zeros(q.shape[0], 0)]
        for compliance, (e, arms) in zip(self.compliances, self._loads(q), strict=True):
            pulls = torch.linalg.cross(e[:, None].expand_as(arms), arms) if compliance.places else e
            parts.append(self._weighed(compliance, pulls.flatten(1), q))
        return torch.cat(parts, dim=1)

    def twists(self, q: Tensor, w: Tensor) -> Tensor:
        """Error twists of the moving joints' frames: q (N, n), w (K,) -> (N, n_all, 6) [m, rad]."""
        if not self.compliances:
            return q.new_zeros(q.shape[0], len(self.chain.axes), 6)
        amounts = []
        for compliance, (e, arms), forces in zip(self.compliances, self._loads(q), self._split(w), strict=True):
            # c . (e x a) = e . (a x c): moments first, they are one matrix product
            places = compliance.places
            moment = arms.flatten(1) @ skew(forces.view(-1, 3)).mT.flatten(0, 1).neg() if places else forces
            amounts.append(self._weighed(compliance, e * moment, q).sum(1))
        return torch.einsum("fn,fjc->njc", torch.stack(amounts), self._directions.to(q.device))

    def twist_slopes(self, q: Tensor, w: Tensor) -> Tensor:
        """Derivatives of the twists by the joints: (N, n_all, 6, n).

        z_k and o_k are axis and origin of joint k in the ground's frame, M_fk says whether it moves place f. With
        g_f = c_f x e, the amount e . sum_f a_f x c_f, a_f = o_f - o_l, changes with joint k by

            z_k . [ sum_f M_fk (o_f - o_k) x g_f + M_lk ( e x sum_f a_f x c_f - (o_l - o_k) x sum_f g_f ) ],

        and with a slide by z_k . [ sum_f M_fk g_f - M_lk sum_f g_f ].
        """
        if not self.compliances:
            return q.new_zeros(q.shape[0], len(self.chain.axes), 6, q.shape[1])
        frames = self._frames(q)
        places, joints = frames[..., :3, 3], frames[:, : self.chain.moving]
        axes = turned_axes(joints, self.chain.axes) * self.signs.to(q.device)[:, None]
        origins, moved = joints[..., :3, 3], self.moved.to(q)  # (F, n_all)
        turning, rows = self.chain.revolute.to(q.device)[:, None], []
        for compliance, (e, arms), forces in zip(self.compliances, self._loads(q), self._split(w), strict=True):
            pulls, moment = _pulls(compliance, e, arms, forces.view(-1, 3), places)
            carried = moved[compliance.joint][:, None]  # (n_all, 1): whether joint k moves this joint's frame
            total = carried * pulls.sum(1, keepdim=True)
            force = torch.einsum("fk,nfc->nkc", moved, pulls) - total
            torque = torch.einsum("fk,nfc->nkc", moved, torch.linalg.cross(places, pulls))
            torque = torque - torch.linalg.cross(origins[:, compliance.joint, None].expand_as(total), total)
            turn = torque - torch.linalg.cross(origins, force) + carried * torch.linalg.cross(e, moment)[:, None]
            rows.append(self._weighed(compliance, (axes * torch.where(turning, turn, force)).sum(-1), q))
        slopes = self.chain.by_active(torch.stack(rows, 1))  # (N, compliances, n)
        return torch.einsum("nfk,fjc->njck", slopes, self._directions.to(q.device))

    def sensitivities(self, q: Tensor, by_twist: Tensor) -> Tensor:
        """Derivatives by the coefficients (N, m, K) from the derivatives by the twists (N, m, joints, 6)."""
        by_compliance = torch.einsum("nmjc,fjc->nmf", by_twist, self._directions.to(q.device))
        return by_compliance[..., self._numbers.to(q.device)] * self.features(q)[:, None]

    def folded(self, w: Tensor) -> Tensor:
        """The coefficients (K,) of a robot that carries its payload everywhere as those of one without payload.

        The payload then is one of the unknown masses at its place.

        Raises:
            InputError: a payload that differs between rows.
        """
        if self.payload is None:
            return w
        if self.payload.by_row:
            raise InputError.of("a payload of every row", expected="one for all", fix="choose one: with_payload(mass)")
        parts, amount = list(self._split(w)), self.payload.amounts(w[None])[0]
        unladen = [k for k, compliance in enumerate(self.compliances) if not compliance.loaded]
        for compliance, load in zip(self.compliances[len(unladen) :], parts[len(unladen) :], strict=True):
            k = next(k for k in unladen if _same_sag(self.compliances[k], compliance))
            own = self.compliances[k].places
            at = 3 * own.index(_representative(self.chain, compliance.places[0])) if own else 0
            parts[k] = torch.cat([parts[k][:at], parts[k][at : at + 3] + amount * load, parts[k][at + 3 :]])
        return torch.cat([w[:0], *parts[: len(unladen)]])

    def _weighed(self, compliance: Compliance, values: Tensor, q: Tensor) -> Tensor:
        """Values (N, k) under unit loads, times the payload where that is the load."""
        return values * self.payload.amounts(q) if compliance.loaded and self.payload is not None else values

    def _split(self, w: Tensor) -> tuple[Tensor, ...]:
        """The coefficients of every compliance."""
        return w.split([compliance.size for compliance in self.compliances])

    def _loads(self, q: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """For every compliance its unit vector (N, 3) on the ground and the arms (N, F, 3) of its places [m]."""
        frames = self._frames(q)
        origins = frames[..., :3, 3]
        for compliance in self.compliances:
            axis = compliance.direction[3:] if compliance.places else compliance.direction[:3]
            e = frames[:, compliance.joint, :3, :3] @ axis.to(q.device)
            yield e, origins[:, compliance.places] - origins[:, compliance.joint, None]

    def _frames(self, q: Tensor) -> Tensor:
        """All places in the ground's frame: (N, F, 4, 4)."""
        places, ground = self.chain.places(q), self.chain.ground_place
        return places if ground is None else torch.linalg.inv(places[:, ground])[:, None] @ places

    @cached_property
    def _numbers(self) -> Tensor:
        """(K,) the number of the compliance of every feature."""
        numbers = [k for k, compliance in enumerate(self.compliances) for _ in range(compliance.size)]
        return torch.tensor(numbers, dtype=torch.int64, device="cpu")

    @cached_property
    def _directions(self) -> Tensor:
        """(compliances, joints, 6) twist of every frame per unit sag."""
        shape = (len(self.compliances), len(self.chain.axes), 6)
        table = torch.zeros(*shape, dtype=torch.float64, device="cpu")
        for k, compliance in enumerate(self.compliances):
            table[k, compliance.joint] = compliance.direction
        return table


def _seen_from_ground(chain: Tree) -> tuple[Tensor, Tensor]:
    """Which joints move which places as seen from the ground (F, n_all) boolean, and the sense of their axes."""
    moved, signs = seen_from_ground(chain.ancestors.numpy(), grounded=chain.ground_place is not None)
    return torch.from_numpy(moved).bool(), torch.from_numpy(signs)


def _compliances(chain: Tree, moved: Tensor) -> list[Compliance]:
    """Every joint's own compliance and its two lateral ones (three for a slide)."""
    distinct = _distinct(chain)
    found = []
    for joint, axis in enumerate(chain.axes):
        beyond = tuple(int(f) for f in (moved[:, joint] & distinct).nonzero().flatten() if int(f) != joint)
        turns = [(axis, True), *((side, False) for side in torch.from_numpy(perpendicular(axis.numpy())))]
        if not chain.revolute[joint]:
            found.append(Compliance(joint, torch.cat([axis, torch.zeros_like(axis)]), True, ()))
            turns = [(axis, False), *turns[1:]]
        if beyond:
            found += [Compliance(joint, torch.cat([torch.zeros_like(e), e]), own, beyond) for e, own in turns]
    return found


def _under_payload(chain: Tree, unladen: list[Compliance], link: str) -> list[Compliance]:
    """The same compliances under a load at one link, where they carry it."""
    if link not in chain.ends:
        fix = "name a tip, or a branch that only weighs (`load`)"
        raise InputError.of("the link of the payload", expected=" or ".join(chain.ends), got=link, fix=fix)
    place = chain.moving + list(chain.ends).index(link)
    seen = _representative(chain, place)
    moved = _seen_from_ground(chain)[0][place]
    found = [one for one in unladen if bool(moved[one.joint]) and (not one.places or seen in one.places)]
    return [replace(one, places=(place,) if one.places else (), loaded=True) for one in found]


def _same_sag(one: Compliance, other: Compliance) -> bool:
    """Whether two compliances are of one joint in one direction."""
    return one.joint == other.joint and torch.equal(one.direction, other.direction)


def _representative(chain: Tree, place: int) -> int:
    """The place of masses that is always at the origin of this one."""
    distinct = _distinct(chain)
    while not distinct[place] and chain.before[place] != BASE:
        place = chain.before[place]
    return place


def _distinct(chain: Tree) -> Tensor:
    """Places (F,) at which masses are distinguishable from masses at the place before."""
    offsets, before = chain.place_offsets.numpy(), np.array(chain.before)
    return torch.from_numpy(distinct_places(offsets, before, chain.revolute.numpy()))


def _pulls(compliance: Compliance, e: Tensor, arms: Tensor, forces: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
    """g_f = c_f x e at every place (N, F, 3), and the moment sum a_f x c_f, or the force, (N, 3)."""
    if not compliance.places:
        return torch.zeros_like(ends), forces[0].expand(ends.shape[0], 3)
    places = torch.tensor(compliance.places, dtype=torch.int64, device=ends.device)
    found = torch.linalg.cross(forces.expand(ends.shape[0], -1, 3), e[:, None].expand_as(arms))
    pulls = torch.zeros_like(ends).index_copy(1, places, found)
    return pulls, torch.linalg.cross(arms, forces.expand_as(arms)).sum(1)
