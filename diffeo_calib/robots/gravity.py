"""Gravity sag without a model of masses or stiffnesses: compliance times the torque of unknown masses.

A robot's links bend and its gears wind up in proportion to their loads. Every unknown mass beyond joint l pulls at an
unknown point along an unknown but constant direction. If the masses sit at the origins o_f of the moving frames, the
moment of gravity about the unit vector e through o_l is linear in unknown vectors c_f = mass * gravity,

    e . sum_f (o_f - o_l) x c_f = sum_f c_f . ( e x (o_f - o_l) ),

so that ``e x (o_f - o_l)`` are the features of the sag about e. They are smooth functions of the joint values; the
coefficients (compliance times c_f) are parameters with a Gaussian prior. Two loads are not described exactly: masses
beside the frames' origins and the lines between them (on a usual arm a few percent of a shoulder's torque, more of a
roll axis' torque), and the load that turns with the last joint about its own axis.

The sag is an error twist that depends on the configuration (geometry.py): about the joint's own axis (*joint*
compliance; along the axis for a slide) and about the two axes perpendicular to it (*lateral* compliance).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from diffeo_calib.robots.chain import Chain, turned_axes
from diffeo_calib.robots.se3 import skew

COINCIDENT = 1e-6
"""Frames whose origins are closer than this [m] count as one place for masses."""


@dataclass(frozen=True, eq=False)
class Compliance:
    """One compliance and its family of features: the sag of a joint's frame in one direction.

    Args:
        joint: number of the moving joint whose frame sags.
        direction: (6,) unit twist in the frame before the joint's motion, translation first.
        own: whether it is along the joint's own motion (else lateral).
        places: numbers of the frames at which masses pull; the tip is number n. Empty for a slide along its axis,
            where the feature is the force itself.
    """

    joint: int
    direction: Tensor
    own: bool
    places: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of its features."""
        return 3 * max(len(self.places), 1)


class GravitySag:
    """Gravity features of a chain and the error twists that they make.

    Args:
        chain: the nominal robot; its nominal frames make the features.

    Attributes:
        compliances: all compliances; their features follow each other in the coefficients w (K,).
    """

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self.compliances = tuple(_compliances(chain))

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
    def components(self) -> Tensor:
        """(K,) the component (0, 1, 2) of gravity in the robot's base that a coefficient multiplies."""
        return torch.arange(self.size, dtype=torch.int64, device="cpu") % 3

    def features(self, q: Tensor) -> Tensor:
        """Feature values [m; 1 for forces on slides]: q (N, n) -> (N, K)."""
        parts = [q.new_zeros(q.shape[0], 0)]
        for compliance, (e, arms) in zip(self.compliances, self._loads(q), strict=True):
            pulls = torch.linalg.cross(e[:, None].expand_as(arms), arms) if compliance.places else e
            parts.append(pulls.flatten(1))
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
            amounts.append((e * moment).sum(1))
        return torch.einsum("fn,fjc->njc", torch.stack(amounts), self._directions.to(q.device))

    def twist_slopes(self, q: Tensor, w: Tensor) -> Tensor:
        """Derivatives of the twists by the joints: (N, n_all, 6, n).

        With z_k, o_k axis and origin of joint k, g_f = c_f x e, and sums over the places f that k moves, the amount
        e . sum a_f x c_f changes with joint k >= l by z_k . sum (o_f - o_k) x g_f (a slide: z_k . sum g_f); a
        joint k < l turns everything, e too, which adds z_k . (e x sum a_f x c_f).
        """
        if not self.compliances:
            return q.new_zeros(q.shape[0], len(self.chain.axes), 6, q.shape[1])
        frames, tip = self.chain.frames(q)
        axes, origins = turned_axes(frames, self.chain.axes), frames[..., :3, 3]
        ends = torch.cat([origins, tip[:, None, :3, 3]], dim=1)
        turning = self.chain.revolute.to(q.device)[:, None]
        numbers, rows = torch.arange(len(self.chain.axes), dtype=torch.int64, device=q.device), []
        for compliance, (e, arms), forces in zip(self.compliances, self._loads(q), self._split(w), strict=True):
            pulls, moment = _pulls(compliance, e, arms, forces.view(-1, 3), ends)
            later = numbers.clamp(min=compliance.joint)  # joints before l move all its places
            force = _sums_beyond(pulls)[:, later]
            torque = _sums_beyond(torch.linalg.cross(ends, pulls))[:, later]
            before = (numbers < compliance.joint)[:, None]
            centre = torch.where(before, origins[:, compliance.joint, None], origins)
            turn = torque - torch.linalg.cross(centre, force)
            turn = turn + torch.where(before, torch.linalg.cross(e, moment)[:, None], 0.0)
            slide = torch.where(before, 0.0, force)  # a slide before l carries everything along
            rows.append((axes * torch.where(turning, turn, slide)).sum(-1))
        slopes = self.chain.by_active(torch.stack(rows, 1))  # (N, compliances, n)
        return torch.einsum("nfk,fjc->njck", slopes, self._directions.to(q.device))

    def sensitivities(self, q: Tensor, by_twist: Tensor) -> Tensor:
        """Derivatives by the coefficients (N, m, K) from the derivatives by the twists (N, m, joints, 6)."""
        by_compliance = torch.einsum("nmjc,fjc->nmf", by_twist, self._directions.to(q.device))
        return by_compliance[..., self._numbers.to(q.device)] * self.features(q)[:, None]

    def _split(self, w: Tensor) -> tuple[Tensor, ...]:
        """The coefficients of every compliance."""
        return w.split([compliance.size for compliance in self.compliances])

    def _loads(self, q: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """For every compliance its unit vector (N, 3) in the base and the arms (N, F, 3) of its places [m]."""
        frames, tip = self.chain.frames(q)
        origins = torch.cat([frames[..., :3, 3], tip[:, None, :3, 3]], dim=1)
        for compliance in self.compliances:
            axis = compliance.direction[3:] if compliance.places else compliance.direction[:3]
            e = frames[:, compliance.joint, :3, :3] @ axis.to(q.device)
            yield e, origins[:, compliance.places] - origins[:, compliance.joint, None]

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


def _compliances(chain: Chain) -> list[Compliance]:
    """Every joint's own compliance and its two lateral ones (three for a slide)."""
    places = _places(chain)
    found = []
    for joint, axis in enumerate(chain.axes):
        beyond = tuple(place for place in places if place > joint)
        turns = [(axis, True), *((side, False) for side in perpendicular(axis))]
        if not chain.revolute[joint]:
            found.append(Compliance(joint, torch.cat([axis, torch.zeros_like(axis)]), True, ()))
            turns = [(axis, False), *turns[1:]]
        if beyond:
            found += [Compliance(joint, torch.cat([torch.zeros_like(e), e]), own, beyond) for e, own in turns]
    return found


def perpendicular(axis: Tensor) -> Tensor:
    """Two unit vectors perpendicular to a unit vector (3,) and to each other: (2, 3).

    Rows of the Householder reflection that maps the first axis to +-``axis``. Coefficients in model files refer to
    them, so that they must not depend on a library's choice of basis.
    """
    v = axis.clone()
    v[0] += 1.0 if float(axis[0]) >= 0 else -1.0
    one = torch.eye(3, dtype=axis.dtype, device=axis.device)
    return (one - 2.0 * torch.outer(v, v) / v.dot(v))[1:]


def _places(chain: Chain) -> list[int]:
    """Frames whose origin differs from the previous one in some configuration: masses there are distinguishable."""
    steps = torch.cat([chain.offsets, chain.tip_offset[None]])[:, :3, 3].norm(dim=1)
    slides = ~chain.revolute
    return [f for f in range(1, len(steps)) if float(steps[f]) > COINCIDENT or bool(slides[f - 1])]


def _pulls(compliance: Compliance, e: Tensor, arms: Tensor, forces: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
    """g_f = c_f x e at every frame (N, n_all + 1, 3), and the moment sum a_f x c_f, or the force, (N, 3)."""
    if not compliance.places:
        return torch.zeros_like(ends), forces[0].expand(ends.shape[0], 3)
    places = torch.tensor(compliance.places, dtype=torch.int64, device=ends.device)
    found = torch.linalg.cross(forces.expand(ends.shape[0], -1, 3), e[:, None].expand_as(arms))
    pulls = torch.zeros_like(ends).index_copy(1, places, found)
    return pulls, torch.linalg.cross(arms, forces.expand_as(arms)).sum(1)


def _sums_beyond(values: Tensor) -> Tensor:
    """Sums over the frames after each joint: (N, n_all + 1, 3) -> (N, n_all, 3)."""
    return values.flip(1).cumsum(1).flip(1)[:, 1:]
