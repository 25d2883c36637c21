"""Kinematic trees: poses and Jacobians of one tip or several, float64, differentiable by torch.

The pose of a tip is a product of constant transforms and motions of the joints l on the path from the base to it,

    T_tip(q) = prod_l [ O_l J_l(q_l) ] O_tip,

with ``O_l`` everything fixed between joint l and the joint before it. Whether joint l moves place f (a joint's frame or
a tip) is the entry A[f, l] of the ancestor matrix; Jacobians are those of a serial chain times A. A serial
chain is the tree whose joints follow one another.

Mimic joints follow other joints, as in a parallelogram. Users see the n active joints only; the product runs over all
n_all moving joints, whose values are an affine function of the active ones, ``coupling @ q + coupling_offset``.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import replace
from math import pi
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, check_finite, real_tensor
from diffeo_calib.common.data_frames import named_columns
from diffeo_calib.common.device import methods_outside_inference_mode
from diffeo_calib.common.errors import InputError, RobotError, as_written
from diffeo_calib.robots.joint import Joint, turned_axes
from diffeo_calib.robots.se3 import transforms
from diffeo_calib.runtime.build import ROTARY, nominal_chain
from diffeo_calib.runtime.chain import joint_motions, walk

BASE = -1  # stands for the base where the number of a joint is asked for


class Ends(NamedTuple):
    """Links at which a tree ends, by the numbers of the last joints before them, -1 for the base."""

    tips: Mapping[str, int]  # names of the frames whose poses are computed, with their numbers
    # the same where nothing is measured, but whose weight bends the robot
    loads: Mapping[str, int] = MappingProxyType({})
    # number of the link on the ground, where the direction of gravity is constant; the base by default
    ground: int = BASE


@methods_outside_inference_mode
class Tree:
    """A robot with one tip or several: ``robot(q)`` are the poses of its tips in its base.

    Fixed joints are merged into the origins of the joints and tips after them. Joint values, limits and Jacobians refer
    to the n active joints; mimic joints (``Joint.mimic``) follow. Axes, offsets and frames refer to all n_all moving
    joints, active ones and mimic joints, each after the joint before it. Without mimic joints n = n_all.

    Args:
        name: the robot's name, used in messages.
        base: name of the frame poses are expressed in.
        joints: the joints, fixed ones included, each after its parent.
        parents: for every joint the number of the joint before it, -1 for the base.
        ends: its tips, loads and ground.
        drivers: joints that drive mimic joints of the tree and move nothing in it.
        source: text of the URDF file that describes the robot, None without one. Bytes that are not UTF-8 are kept as
            surrogate escapes (PEP 383), so that the file can be written again byte for byte.

    Raises:
        RobotError: a tip without a moving joint before it, or two joints with one name; a joint before its parent; a
            joint that mimics a fixed joint or one that is not there; joints that mimic each other in a circle.

    Attributes:
        joint_names: names of the n active joints, in the order of the columns of ``q``.
        kinds: their kinds.
        limits: (n, 2) their lower and upper limits [rad or m].
        moving_names: names of the n_all moving joints.
        coupling, coupling_offset: values of the moving joints are ``coupling @ q + coupling_offset`` [rad or m].
        axes: (n_all, 3) axes, each in its joint's frame. revolute: (n_all,) boolean, False for a slide.
        offsets, tip_offsets: the constant transforms O_l (n_all, 4, 4) and O_tip (tips, 4, 4).
        place_offsets: (F, 4, 4) those of all F places: joints, tips, loads, ground.
        before: for each of the F places the number of the moving joint before it, -1 for the base.
        ancestors: (F, n_all) boolean A, whether joint l moves place f.
        ground_place: number of the place of the link on the ground, the last one; None where that is the base.
        motion_terms: (4, n_all, 4, 4) see :func:`joint_motions`. arrays: the same constants as NumPy arrays.
    """

    def __init__(
        self,
        name: str,
        base: str,
        joints: Sequence[Joint],
        parents: Sequence[int],
        ends: Ends,
        *,
        drivers: Sequence[Joint] = (),
        source: str | None = None,
    ) -> None:
        self.name, self.base, self.source = name, base, source
        self.joints, self.parents, self.drivers = tuple(joints), tuple(parents), tuple(drivers)
        self.ends = {**ends.tips, **ends.loads}
        self.tips, self.loads, self.ground = tuple(ends.tips), tuple(ends.loads), ends.ground
        for what, text in (("name", name), ("base", base), *(("tip", tip) for tip in self.ends)):
            if not isinstance(text, str):
                raise RobotError.of(f"the {what} of a robot", expected="text", got=as_written(text))
        moving = [joint for joint in self.joints if joint.kind != "fixed"]
        self.moving_names = tuple(joint.name for joint in moving)
        count = len(self.joints)
        if len(self.parents) != count or not all(BASE <= p < k for k, p in enumerate(self.parents)):
            raise RobotError.of("the parents of joints", expected="one earlier joint, or -1, each", got=self.parents)
        if not self.tips or not all(BASE <= end < count for end in (*self.ends.values(), self.ground)):
            raise RobotError.of(f"the ends of robot '{self.name}'", expected="numbers of its joints", got=self.ends)
        self.arrays = arrays = nominal_chain(self.to_config())
        self.joint_names, self.limits = arrays.names, torch.from_numpy(arrays.limits)
        kinds = {joint.name: joint.kind for joint in (*moving, *self.drivers)}
        self.kinds = tuple(kinds[name] for name in self.joint_names)
        tensors = arrays.axes, arrays.revolute, arrays.coupling, arrays.coupling_offset
        self.axes, self.revolute, self.coupling, self.coupling_offset = map(torch.from_numpy, tensors)
        self.motion_terms, self.ancestors = torch.from_numpy(arrays.motions), torch.from_numpy(arrays.ancestors)
        self.place_offsets, self.before = torch.from_numpy(arrays.offsets), tuple(arrays.before.tolist())
        self.offsets, self.tip_offsets = self.place_offsets[: len(moving)], self.place_offsets[self.tip_places]
        self.ground_place = None if self.ground == BASE else len(self.before) - 1

    def reversed(self, tip: str | None = None) -> Tree:
        """Return the robot with one of its tips as base; gravity still acts as on the ground.

        The old base is the new tip; of several tips the other ones stay (hand to hand). ``joint_names`` are reordered.

        Raises:
            RobotError: no such tip, or none named where there are several.
        """
        start = self.tip if tip is None else tip  # several tips have no such name
        if start not in self.tips:
            raise RobotError.of("`tip`", expected=f"one of {', '.join(self.tips)}", got=as_written(tip))
        way, link = [], self.ends[start]
        while link != BASE:
            way.append(link)
            link = self.parents[link]
        steps = [(self.joints[number], number, self.parents[number], True) for number in way]
        every = enumerate(zip(self.joints, self.parents, strict=True))
        steps += [(joint, parent, number, False) for number, (joint, parent) in every if number not in way]
        joints, parents, last = along(steps, self.ends[start])
        others = {name: last[self.ends[name]] for name in self.tips if name != start} or {self.base: last[BASE]}
        loads = {name: last[self.ends[name]] for name in self.loads if name not in others}
        loads |= {start: BASE} if last[self.ground] != BASE else {}  # it moves as seen from the ground
        given = Ends(others, loads, last[self.ground])
        return Tree(self.name, start, joints, parents, given, drivers=self.drivers, source=self.source)

    def to_config(self) -> dict[str, Any]:
        """Name, links, joints and their order as JSON values, for :func:`robot_from_config`."""
        ends = {"tips": [[tip, self.ends[tip]] for tip in self.tips], "loads": [[t, self.ends[t]] for t in self.loads]}
        structure = {"parents": list(self.parents), **ends, "ground": self.ground}
        joints, drivers = ([joint.to_config() for joint in part] for part in (self.joints, self.drivers))
        return {"name": self.name, "base": self.base, "joints": joints, **structure, "drivers": drivers}

    def __repr__(self) -> str:
        mimics = [name for name in self.moving_names if name not in self.joint_names]
        follow = f"; mimic joints: {', '.join(mimics)}" if mimics else ""
        joints = f"{self.n} joints: {', '.join(self.joint_names)}{follow}"
        tips = ", ".join(map(repr, self.tips))
        loads = f", loads {', '.join(map(repr, self.loads))}" if self.loads else ""
        return f"{type(self).__name__}({self.name!r}, {self.base!r} -> {tips}{loads}, {joints})"

    @property
    def tip(self) -> str:
        """Name of the tip; of all tips, if there are several."""
        return ", ".join(self.tips)

    @property
    def serial(self) -> bool:
        """Whether its joints follow one another from the base to a single tip, and the base is on the ground."""
        return self.before == tuple(range(-1, self.moving))

    def path_to(self, tip: str) -> Tensor:
        """Numbers of the moving joints between base and tip, in this order: (k,) int64."""
        return self.ancestors[self.moving + self.tips.index(tip)].nonzero().flatten()

    @property
    def tip_places(self) -> slice:
        """Numbers of the tips' places."""
        return slice(self.moving, self.moving + len(self.tips))

    @property
    def n(self) -> int:
        """Number of active joints, the columns of ``q``."""
        return len(self.joint_names)

    @property
    def moving(self) -> int:
        """Number n_all of moving joints, active ones and mimic joints."""
        return len(self.moving_names)

    @property
    def periodic(self) -> tuple[bool, ...]:
        """For each active joint, whether it turns (2 pi periodic) rather than slides.

        This is the joint's own kind. Where a turning joint drives a mimic joint that slides, or one that turns by a
        multiplier that is not an integer, a full turn changes the pose, although errors modelled on the circle are the
        same again: take measurements within one turn of such a joint.
        """
        return tuple(kind in ROTARY for kind in self.kinds)

    def whole_turns(self, q: Tensor) -> Tensor:
        """Whole turns [rad] by which values (N, n) of turning joints are away from the middle of their limits."""
        away = (q - self.limits.mean(1).to(q.device)) / (2 * pi)
        turns = torch.tensor(self.periodic, dtype=torch.bool, device=q.device) & away.isfinite()
        return torch.where(turns, 2 * pi * away.round(), 0.0)

    @property
    def reach(self) -> float:
        """Upper bound of the distance from base to the farthest tip [m]: all offsets and strokes stretched out.

        Infinite if a prismatic joint has no limits. The stroke of a mimic joint follows from the limits of the joints
        that drive it; its own limits count only where those have none.
        """
        ends = self.coupling[..., None] * self.limits  # (n_all, n, 2)
        ends = torch.where(self.coupling[..., None] == 0, 0.0, ends)  # no limits times no effect is not NaN
        driven = torch.stack([ends.amin(2).sum(1), ends.amax(2).sum(1)]) + self.coupling_offset
        largest = [max(abs(joint.lower), abs(joint.upper)) for joint in self.joints if joint.kind != "fixed"]
        strokes, tips = driven.abs().amax(0), self.tip_places  # largest values within the limits [rad or m]
        strokes = torch.where(strokes.isinf(), strokes.new_tensor(largest), strokes)
        lengths = self.place_offsets[:, :3, 3].norm(dim=1)
        steps = lengths[: self.moving] + torch.where(self.revolute, 0.0, strokes)
        return float((torch.where(self.ancestors[tips], steps, 0.0).sum(1) + lengths[tips]).max())

    def __call__(self, q: Tensor) -> Tensor:
        """Poses of the tip in the base, (N, 4, 4) [m]; (N, tips, 4, 4) if there are several.

        Args:
            q: (N, n) joint values [rad or m].

        Raises:
            InputError: wrong shape, or values that are not finite.
        """
        tips = self.tip_poses(q)
        return tips if len(self.tips) > 1 else tips[:, 0]

    def joint_frames(self, q: Tensor) -> Tensor:
        """Poses (N, n_all, 4, 4) of all moving joints' frames in the base: after ``O_l``, before the motion ``J_l``.

        The axis of joint l is ``frames[:, l, :3, :3] @ robot.axes[l]``, its origin ``frames[:, l, :3, 3]``.
        """
        return self.places(q)[:, : self.moving]

    def tip_poses(self, q: Tensor) -> Tensor:
        """Poses of all tips in the base, (N, tips, 4, 4) [m], also of a single one."""
        return self.places(q)[:, self.tip_places]

    def places(self, q: Tensor) -> Tensor:
        """Poses in the base of all F places: joints' frames, tips, loads and the ground: (N, F, 4, 4) [m]."""
        q = self.joint_values(q)
        motions = joint_motions(self.motion_terms.to(q.device), self.moving_values(q), torch)
        return walk(None, self.place_offsets.to(q.device), motions, self.before, torch)

    def jacobian(self, q: Tensor) -> Tensor:
        """Geometric Jacobian (N, 6, n) at the tip's origin by the active joints; (N, tips, 6, n) if there are several.

        Expressed in the base. Rows 0-2: linear velocity [m/rad or m/m]; rows 3-5: angular velocity [rad/rad, 0 for
        prismatic joints].
        """
        q = self.joint_values(q)
        places, ends = self.places(q), self.tip_places
        frames, moved = places[:, : self.moving], self.ancestors[ends]
        turning = moved.to(q.device)[..., None] & self.revolute.to(q.device)[:, None]  # (tips, n_all, 1)
        angular = self.by_active(torch.where(turning, turned_axes(frames, self.axes)[:, None], 0.0).mT)
        slopes = torch.cat([self.point_slopes(frames, places[:, ends, :3, 3], moved), angular], dim=2)
        return slopes if len(self.tips) > 1 else slopes[:, 0]

    def point_slopes(self, frames: Tensor, points: Tensor, moved: Tensor) -> Tensor:
        """Derivatives of points by the active joints: (N, P, 3, n) [m/rad or m/m].

        Args:
            frames: (N, n_all, 4, 4) of the joints. points: (N, P, 3). moved: (P, n_all) whether a joint moves a point.
        """
        axes = turned_axes(frames, self.axes)[:, None]  # (N, 1, n_all, 3)
        arms = points[:, :, None] - frames[:, None, :, :3, 3]  # (N, P, n_all, 3)
        turning = self.revolute.to(axes.device)[:, None]
        slopes = torch.where(turning, torch.linalg.cross(axes.expand_as(arms), arms), axes)
        return self.by_active(slopes.mul(moved.to(axes.device)[..., None]).mT)

    def moving_values(self, q: Tensor) -> Tensor:
        """Values of all moving joints: q (N, n), checked by :meth:`joint_values` -> (N, n_all) [rad or m]."""
        return q @ self.coupling.to(q.device).mT + self.coupling_offset.to(q.device)

    def by_active(self, slopes: Tensor) -> Tensor:
        """Derivatives by all moving joints (..., n_all) -> by the active ones, mimic joints following (..., n)."""
        return slopes @ self.coupling.to(slopes.device)

    def joint_values(self, q: Tensor | ArrayLike) -> Tensor:
        """Check joint values and convert them to float64 (N, n); every public method calls this.

        Columns of a data frame are taken by name, in the order of ``joint_names``; its other columns are ignored.

        Raises:
            InputError: wrong shape, values that are not finite, or a data frame without a column for every joint.
        """
        order = f"pass the {self.n} joints in the order of `robot.joint_names`"
        if isinstance(q, Tensor):
            q = real_tensor(q, "q")
        else:
            q = as_tensor(named_columns(q, self.joint_names, "q"), "q", ("N", "n"), empty=True, fix=order)
        if q.ndim != 2 or q.shape[1] != self.n:
            what = f"`q` must have shape (N, {self.n}) for robot '{self.name}'"
            raise InputError.of(what, got=str(tuple(q.shape)), fix=order)
        check_finite(q, "q")
        return q


def along(
    steps: Iterable[tuple[Joint, Hashable, Hashable, bool]], base: Hashable
) -> tuple[list[Joint], list[int], dict[Hashable, int]]:
    """The joints on steps from a base, those that lead up to their parents backwards.

    A joint O J(q) from its parent to its link leads back as J(q)^-1 O^-1, a motion about the opposite axis and a
    constant transform. Values, limits and mimic joints stay as they are. The gravity sag has its unknown masses at the
    joints' frames: those of turning joints are at the same places from either side, that of a slide is at its other
    end.

    Args:
        steps: joint, the links where it starts and ends, whether it leads up. base: the first link.

    Returns the joints, their parents, and for every link the number of the last joint before it, -1 for the base.
    """
    joints: list[Joint] = []
    parents: list[int] = []
    last = {base: BASE}
    for joint, start, end, up in steps:
        before = last[start]
        for step in backwards(joint) if up else [joint]:
            joints.append(step)
            parents.append(before)
            before = len(joints) - 1
        last[end] = before
    return joints, parents, last


def backwards(joint: Joint) -> list[Joint]:
    """The joint from its link to its parent: its motion, then a fixed transform."""
    turned = joint.origin[:3, :3].T
    back = transforms(turned, -turned @ joint.origin[:3, 3])
    if joint.kind == "fixed":
        return [replace(joint, origin=back)]
    eye = torch.eye(4, dtype=torch.float64, device="cpu")
    return [replace(joint, origin=eye, axis=-joint.axis), Joint(f"{joint.name} (origin)", "fixed", back)]


class Chain(Tree):
    """A serial robot: ``robot(q)`` is the pose of its tip in its base, (N, 4, 4) [m].

    Args:
        name: the robot's name, used in messages. base: name of the frame poses are expressed in.
        tip: name of the frame whose pose is computed. joints: the joints from base to tip, fixed ones included.
        drivers: joints off the chain that drive mimic joints of it. source, and errors: see :class:`Tree`.
    """

    def __init__(
        self,
        name: str,
        base: str,
        tip: str,
        joints: Sequence[Joint],
        *,
        drivers: Sequence[Joint] = (),
        source: str | None = None,
    ) -> None:
        parents = range(-1, len(joints) - 1)
        super().__init__(name, base, joints, parents, Ends({tip: len(joints) - 1}), drivers=drivers, source=source)

    def to_config(self) -> dict[str, Any]:
        """Name, links and joints as JSON values, for :func:`robot_from_config`."""
        joints = [joint.to_config() for joint in self.joints]
        drivers = {"drivers": [joint.to_config() for joint in self.drivers]} if self.drivers else {}
        return {"name": self.name, "base": self.base, "tip": self.tips[0], "joints": joints} | drivers


def robot_from_config(config: Mapping[str, Any], source: str | None = None) -> Tree:
    """The inverse of :meth:`Tree.to_config`; ``source`` as in :class:`Tree`.

    Raises KeyError, TypeError, ValueError: an argument is missing, or of another kind. RobotError: joints that make no
    robot.
    """
    joints = [Joint.from_config(joint) for joint in config["joints"]]
    drivers = [Joint.from_config(joint) for joint in config.get("drivers", ())]
    given: dict[str, Any] = {"drivers": drivers, "source": source}
    if "tip" in config:
        return Chain(config["name"], config["base"], config["tip"], joints, **given)
    ends = Ends(dict(config["tips"]), dict(config["loads"]), config["ground"])
    return Tree(config["name"], config["base"], joints, config["parents"], ends, **given)
