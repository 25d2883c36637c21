"""Elastic deflection under gravity, without an elastic model: what every joint and link gives way to.

A robot's links bend and its gears wind up in proportion to the loads on them. Of the loads this much is
known: every unknown mass beyond joint l pulls at an unknown point along an unknown but constant direction.
With the moving frames' origins o_f as places for the masses, the moment of gravity about the unit vector e
through o_l is a linear function of unknown vectors c_f = mass * gravity,

    e . sum_f (o_f - o_l) x c_f = sum_f c_f . ( e x (o_f - o_l) ),

so that ``e x (o_f - o_l)`` are the features of the deflection about e. They are smooth functions of the joint
values; the coefficients (compliance times c_f) are parameters with a Gaussian prior. Masses beside the frames' origins
and the lines between them are not described exactly (on a usual arm a few percent of a shoulder's torque, more of a
roll axis'), nor is the load that turns with the last joint about its own axis.

Deflections are error twists that depend on the configuration (geometry.py): about the joint's own axis
(*joint* compliance; along it for a slide) and about the other two (*lateral*).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from diffeo_calib.robots.chain import Chain, skew, turned_axes

COINCIDENT = 1e-6
"""Frames nearer than this [m] are one place for masses."""


@dataclass(frozen=True, eq=False)
class Deflection:
    """One family of features: the deflection of a joint's frame in one direction.

    Args:
        joint: number of the moving joint whose frame deflects.
        direction: (6,) unit twist in the frame before the joint's motion, translation first.
        own: whether it is along the joint's own motion (else lateral).
        places: numbers of the frames at which masses pull; the tip is number n. Empty for a slide along its axis,
            on which the force itself acts.
    """

    joint: int
    direction: Tensor
    own: bool
    places: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of its features."""
        return 3 * max(len(self.places), 1)


class Elasticity:
    """Gravity features of a chain and the error twists that they make.

    Args:
        chain: the nominal robot; its nominal frames make the features.

    Attributes:
        deflections: all families; their features follow each other in the coefficients w (K,).
    """

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self.deflections = tuple(_deflections(chain))

    @property
    def size(self) -> int:
        """Number of coefficients K."""
        return sum(family.size for family in self.deflections)

    @cached_property
    def joints(self) -> Tensor:
        """(K,) the moving joint that every coefficient belongs to."""
        return torch.tensor([f.joint for f in self.deflections for _ in range(f.size)], dtype=torch.int64)

    @cached_property
    def own(self) -> Tensor:
        """(K,) whether a coefficient is about the joint's own motion; the others are lateral."""
        return torch.tensor([f.own for f in self.deflections for _ in range(f.size)], dtype=torch.bool)

    @cached_property
    def components(self) -> Tensor:
        """(K,) the component (0, 1, 2) of gravity in the robot's base that a coefficient stands for."""
        return torch.arange(self.size) % 3

    def features(self, q: Tensor) -> Tensor:
        """Feature values [m; 1 for forces on slides]: q (N, n) -> (N, K)."""
        parts = [q.new_zeros(len(q), 0)]
        for family, (e, arms) in zip(self.deflections, self._loads(q), strict=True):
            pulls = torch.linalg.cross(e[:, None].expand_as(arms), arms) if family.places else e
            parts.append(pulls.flatten(1))
        return torch.cat(parts, dim=1)

    def twists(self, q: Tensor, w: Tensor) -> Tensor:
        """Error twists of the moving joints' frames: q (N, n), w (K,) -> (N, n_all, 6) [m, rad]."""
        if not self.deflections:
            return q.new_zeros(len(q), len(self.chain.axes), 6)
        amounts, sizes = [], [family.size for family in self.deflections]
        for family, (e, arms), forces in zip(self.deflections, self._loads(q), w.split(sizes), strict=True):
            # c . (e x a) = e . (a x c): moments first, they are one matrix product
            moment = arms.flatten(1) @ skew(forces.view(-1, 3)).mT.flatten(0, 1).neg() if family.places else forces
            amounts.append((e * moment).sum(1))
        return torch.einsum("fn,fjc->njc", torch.stack(amounts), self._directions.to(q.device))

    def twist_slopes(self, q: Tensor, w: Tensor) -> Tensor:
        """Derivatives of the twists by the joints: (N, n_all, 6, n).

        With z_k, o_k axis and origin of joint k, g_f = c_f x e, and sums over the places f that k moves, the amount
        e . sum a_f x c_f changes with joint k >= l by z_k . sum (o_f - o_k) x g_f (a slide: z_k . sum g_f); a
        joint k < l turns everything, e too, which adds z_k . (e x sum a_f x c_f).
        """
        if not self.deflections:
            return q.new_zeros(len(q), len(self.chain.axes), 6, q.shape[1])
        frames, tip = self.chain.frames(q)
        axes, origins = turned_axes(frames, self.chain.axes), frames[..., :3, 3]
        ends = torch.cat([origins, tip[:, None, :3, 3]], dim=1)
        turning = self.chain.revolute.to(q.device)[:, None]
        sizes, rows = [family.size for family in self.deflections], []
        for family, (e, arms), forces in zip(self.deflections, self._loads(q), w.split(sizes), strict=True):
            c = forces.view(-1, 3)
            pulls = torch.zeros(*ends.shape, dtype=q.dtype, device=q.device)  # g_f at every frame
            if not family.places:
                moment = forces.expand(len(q), 3)
            else:
                pulls[:, family.places] = torch.linalg.cross(c.expand(len(q), -1, 3), e[:, None].expand_as(arms))
                moment = torch.linalg.cross(arms, c.expand_as(arms)).sum(1)
            later = torch.arange(len(self.chain.axes)).clamp(min=family.joint)  # joints before l move all its places
            force = _sums_beyond(pulls)[:, later]
            torque = _sums_beyond(torch.linalg.cross(ends, pulls))[:, later]
            before = (torch.arange(len(self.chain.axes), device=q.device) < family.joint)[:, None]
            centre = torch.where(before, origins[:, family.joint, None], origins)
            turn = torque - torch.linalg.cross(centre, force)
            turn = turn + torch.where(before, torch.linalg.cross(e, moment)[:, None], 0.0)
            slide = torch.where(before, 0.0, force)  # a slide before l carries everything along
            rows.append((axes * torch.where(turning, turn, slide)).sum(-1))
        slopes = self.chain.by_active(torch.stack(rows, 1))  # (N, families, n)
        return torch.einsum("nfk,fjc->njck", slopes, self._directions.to(q.device))

    def sensitivities(self, q: Tensor, by_twist: Tensor) -> Tensor:
        """Derivatives by the coefficients (N, m, K) from those by the twists (N, m, joints, 6)."""
        by_family = torch.einsum("nmjc,fjc->nmf", by_twist, self._directions.to(q.device))
        return by_family[..., self._family.to(q.device)] * self.features(q)[:, None]

    def _loads(self, q: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """For every family its unit vector (N, 3) in the base and the arms (N, F, 3) of its places [m]."""
        frames, tip = self.chain.frames(q)
        origins = torch.cat([frames[..., :3, 3], tip[:, None, :3, 3]], dim=1)
        for family in self.deflections:
            axis = family.direction[3:] if family.places else family.direction[:3]
            e = frames[:, family.joint, :3, :3] @ axis.to(q.device)
            yield e, origins[:, family.places] - origins[:, family.joint, None]

    @cached_property
    def _family(self) -> Tensor:
        """(K,) the number of the family of every feature."""
        numbers = [k for k, family in enumerate(self.deflections) for _ in range(family.size)]
        return torch.tensor(numbers, dtype=torch.int64)

    @cached_property
    def _directions(self) -> Tensor:
        """(families, joints, 6) twist of every frame per unit deflection of a family."""
        table = torch.zeros(len(self.deflections), len(self.chain.axes), 6, dtype=torch.float64)
        for k, family in enumerate(self.deflections):
            table[k, family.joint] = family.direction
        return table


def _deflections(chain: Chain) -> list[Deflection]:
    """Every joint's own compliance and its two lateral ones (three for a slide)."""
    places = _places(chain)
    found = []
    for joint, axis in enumerate(chain.axes):
        beyond = tuple(place for place in places if place > joint)
        _, _, rows = torch.linalg.svd(axis[None])
        turns = [(axis, True), (rows[1], False), (rows[2], False)]
        if not chain.revolute[joint]:
            found.append(Deflection(joint, torch.cat([axis, torch.zeros_like(axis)]), True, ()))
            turns = [(axis, False), *turns[1:]]
        if beyond:
            found += [Deflection(joint, torch.cat([torch.zeros_like(e), e]), own, beyond) for e, own in turns]
    return found


def _places(chain: Chain) -> list[int]:
    """Frames whose origins differ from the one before in some configuration: where masses can be told apart."""
    steps = torch.cat([chain.offsets, chain.tip_offset[None]])[:, :3, 3].norm(dim=1)
    slides = ~chain.revolute
    return [f for f in range(1, len(steps)) if float(steps[f]) > COINCIDENT or bool(slides[f - 1])]


def _sums_beyond(values: Tensor) -> Tensor:
    """Sums over the frames after each joint: (N, n_all + 1, 3) -> (N, n_all, 3)."""
    return values.flip(1).cumsum(1).flip(1)[:, 1:]
