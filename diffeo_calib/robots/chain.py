"""Serial kinematic chains: poses and Jacobians, float64, differentiable by torch.

The pose of the tip is a product of constant transforms and joint motions,

    T(q) = O_1 J_1(q_1) O_2 J_2(q_2) ... O_n J_n(q_n) O_tip,

with ``O_l`` everything fixed between joint ``l - 1`` and joint ``l``. Every motion is the same formula,
``J_l(q) = C + S sin q + D cos q + L q`` with constant 4 x 4 matrices (Rodrigues for a rotation, ``L`` for
a slide), so that neither values nor types of joints are branched on: autograd, ``torch.func`` and
``vmap`` all pass through.

Mimic joints follow other joints, as in a parallelogram. Users see the n active joints only; the product runs over all
n_all moving joints, whose values are an affine function of the active ones, ``coupling @ q + coupling_offset``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, check_finite, real_tensor
from diffeo_calib.common.data_frames import named_columns
from diffeo_calib.common.errors import InputError, RobotError, as_written
from diffeo_calib.common.inference_mode import methods_outside_inference_mode
from diffeo_calib.robots.joint import ROTARY, Joint
from diffeo_calib.robots.se3 import skew


@methods_outside_inference_mode
class Chain:
    """A serial robot: ``robot(q)`` is the pose of its tip in its base.

    Fixed joints are merged into the origin of the next moving joint (or into ``tip_offset``). Joint values, limits and
    Jacobians refer to the n active joints; mimic joints (``Joint.mimic``) follow. Axes, offsets and frames refer to all
    n_all moving joints, active ones and mimic joints, from base to tip. Without mimic joints n = n_all.

    Args:
        name: the robot's name, used in messages.
        base: name of the frame poses are expressed in.
        tip: name of the frame whose pose is computed.
        joints: the joints from base to tip, fixed ones included.
        source: text of the URDF file that describes the robot, None without one. Bytes that are not UTF-8 are kept as
            surrogate escapes (PEP 383), so that the file can be written again byte for byte.

    Raises:
        RobotError: no moving joint, or two joints with one name; a joint that mimics a fixed joint or one that is not
            in the chain; joints that mimic each other in a circle.

    Attributes:
        joint_names: names of the n active joints, in the order of the columns of ``q``.
        kinds: their kinds.
        limits: (n, 2) their lower and upper limits [rad or m].
        moving_names: names of the n_all moving joints, from base to tip.
        coupling: (n_all, n) and
        coupling_offset: (n_all,) values of the moving joints are ``coupling @ q + coupling_offset`` [rad or m].
        axes: (n_all, 3) axes, each in its joint's frame.
        offsets: (n_all, 4, 4) the constant transforms O_l.
        tip_offset: (4, 4) the constant transform after the last moving joint.
        revolute: (n_all,) boolean, False for a slide.
        motion_terms: (4, n_all, 4, 4) see :func:`joint_motions`.
    """

    def __init__(self, name: str, base: str, tip: str, joints: Sequence[Joint], *, source: str | None = None) -> None:
        self.name, self.base, self.tip, self.joints = name, base, tip, tuple(joints)
        for what, text in (("name", name), ("base", base), ("tip", tip)):
            if not isinstance(text, str):
                raise RobotError.of(f"the {what} of a robot", expected="text", got=as_written(text))
        self.source = source
        moving = [joint for joint in self.joints if joint.kind != "fixed"]
        self.moving_names = tuple(joint.name for joint in moving)
        if not moving:
            fix = "choose a base and a tip with a moving joint between them"
            raise RobotError.of(f"robot '{name}' has no moving joint from '{base}' to '{tip}'", fix=fix)
        twice = sorted({n for n in self.moving_names if self.moving_names.count(n) > 1})
        if twice:
            raise RobotError.of(f"robot '{name}' has several joints named {twice}", fix="give each its own name")
        active = [joint for joint in moving if joint.mimic is None]
        self.joint_names = tuple(joint.name for joint in active)
        self.kinds = tuple(joint.kind for joint in active)
        self.coupling, self.coupling_offset = _coupling(self, moving)
        offsets, self.tip_offset = _merge_fixed(self.joints)
        self.offsets = torch.stack(offsets)
        self.axes = torch.stack([joint.axis for joint in moving])
        limits = [[joint.lower, joint.upper] for joint in active]
        self.limits = torch.tensor(limits, dtype=torch.float64, device="cpu")
        self.revolute = torch.tensor([joint.kind in ROTARY for joint in moving], dtype=torch.bool, device="cpu")
        self.motion_terms = _motion_terms(self.axes, self.revolute)

    def __repr__(self) -> str:
        mimics = [name for name in self.moving_names if name not in self.joint_names]
        follow = f"; mimic joints: {', '.join(mimics)}" if mimics else ""
        joints = f"{self.n} joints: {', '.join(self.joint_names)}{follow}"
        return f"Chain({self.name!r}, {self.base!r} -> {self.tip!r}, {joints})"

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

    @property
    def reach(self) -> float:
        """Upper bound of the distance from base to tip [m]: all offsets and strokes stretched out.

        Infinite if a prismatic joint has no limits. The stroke of a mimic joint follows from the limits of the joints
        that drive it; its own limits count only where those have none.
        """
        lengths = self.offsets[:, :3, 3].norm(dim=1).sum() + self.tip_offset[:3, 3].norm()
        return float(lengths + self._largest_values()[~self.revolute].sum())

    def _largest_values(self) -> Tensor:
        """Largest absolute value (n_all,) of each moving joint within the limits [rad or m]."""
        ends = self.coupling[..., None] * self.limits  # (n_all, n, 2)
        ends = torch.where(self.coupling[..., None] == 0, 0.0, ends)  # no limits times no effect is not NaN
        low, high = ends.amin(dim=2).sum(dim=1), ends.amax(dim=2).sum(dim=1)
        driven = torch.maximum((low + self.coupling_offset).abs(), (high + self.coupling_offset).abs())
        moving = [joint for joint in self.joints if joint.kind != "fixed"]
        strokes = [max(abs(joint.lower), abs(joint.upper)) for joint in moving]
        own = torch.tensor(strokes, dtype=torch.float64, device="cpu")
        return torch.where(driven.isinf(), own, driven)

    def __call__(self, q: Tensor) -> Tensor:
        """Poses of the tip in the base, (N, 4, 4) [m], for joint values ``q`` (N, n) [rad or m].

        Raises:
            InputError: wrong shape, or values that are not finite.
        """
        return self._frames(self.joint_values(q))[1]

    def joint_frames(self, q: Tensor) -> Tensor:
        """Poses (N, n_all, 4, 4) of all moving joints' frames in the base: after ``O_l``, before the motion ``J_l``.

        The axis of joint l is ``frames[:, l, :3, :3] @ robot.axes[l]``, its origin ``frames[:, l, :3, 3]``.
        """
        return self.frames(q)[0]

    def frames(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Joint frames (N, n, 4, 4), see :meth:`joint_frames`, and poses of the tip (N, 4, 4)."""
        return self._frames(self.joint_values(q))

    def jacobian(self, q: Tensor) -> Tensor:
        """Geometric Jacobian (N, 6, n) at the tip's origin by the active joints, expressed in the base.

        Rows 0-2: linear velocity [m/rad or m/m]; rows 3-5: angular velocity [rad/rad, 0 for slides].
        """
        q = self.joint_values(q)
        frames, tip = self._frames(q)
        axes = turned_axes(frames, self.axes)  # (N, n_all, 3)
        turning = self.revolute.to(q.device)[:, None]
        linear = torch.where(turning, torch.linalg.cross(axes, tip[:, None, :3, 3] - frames[..., :3, 3]), axes)
        angular = torch.where(turning, axes, torch.zeros_like(axes))
        return self.by_active(torch.cat([linear, angular], dim=-1).mT)

    def moving_values(self, q: Tensor) -> Tensor:
        """Values of all moving joints: q (N, n), checked by :meth:`joint_values` -> (N, n_all) [rad or m]."""
        if self.moving == self.n:
            return q  # no mimic joints: no product
        return q @ self.coupling.to(q.device).mT + self.coupling_offset.to(q.device)

    def by_active(self, slopes: Tensor) -> Tensor:
        """Derivatives by all moving joints (..., n_all) -> by the active ones, mimic joints following (..., n)."""
        return slopes if self.moving == self.n else slopes @ self.coupling.to(slopes.device)

    def joint_values(self, q: Tensor | ArrayLike) -> Tensor:
        """Check joint values and convert them to float64 (N, n); every public method calls this.

        Columns of a data frame are taken by name, in the order of ``joint_names``; its other columns are ignored.

        Raises:
            InputError: wrong shape, values that are not finite, or a data frame without a column for every joint.
        """
        if isinstance(q, Tensor):
            q = real_tensor(q, "q")
        else:
            q = as_tensor(named_columns(q, self.joint_names, "q"), "q", ("N", "n"), empty=True, fix=self._order)
        if q.ndim != 2 or q.shape[1] != self.n:
            what = f"`q` must have shape (N, {self.n}) for robot '{self.name}'"
            raise InputError.of(what, got=str(tuple(q.shape)), fix=self._order)
        check_finite(q, "q")
        return q

    @property
    def _order(self) -> str:
        return f"pass the {self.n} joints in the order of `robot.joint_names`"

    def _frames(self, q: Tensor) -> tuple[Tensor, Tensor]:
        motions = joint_motions(self.motion_terms.to(q.device), self.moving_values(q))
        start = torch.eye(4, dtype=torch.float64, device=q.device)
        return walk(start, self.offsets.to(q.device), motions, self.tip_offset.to(q.device))


def walk(start: Tensor, offsets: Tensor, motions: Tensor, tip: Tensor) -> tuple[Tensor, Tensor]:
    """Multiply a chain out: ``start O_1 J_1 O_2 J_2 ... O_n J_n tip``.

    Args:
        start: (4, 4) pose of the base.
        offsets: (n, 4, 4) constant transforms O_l of n moving joints; (n, N, 4, 4) if they differ between rows.
        motions: (N, n, 4, 4) joint motions J_l.
        tip: (4, 4) constant transform after the last joint.

    Returns:
        Joint frames ``start O_1 J_1 ... O_l`` (N, n, 4, 4) and poses of the tip (N, 4, 4).
    """
    pose = start.expand(motions.shape[0], 4, 4)
    frames = []
    for offset, motion in zip(offsets.unbind(0), motions.unbind(1), strict=True):
        frames.append(pose @ offset)
        pose = frames[-1] @ motion
    return torch.stack(frames, dim=1), pose @ tip


def joint_motions(terms: Tensor, q: Tensor) -> Tensor:
    """Joint motions ``C + S sin q + D cos q + L q``: terms (4, n, 4, 4), q (N, n) -> (N, n, 4, 4)."""
    constant, sine, cosine, slope = terms
    x = q[..., None, None]
    return constant + torch.sin(x) * sine + torch.cos(x) * cosine + x * slope


def turned_axes(frames: Tensor, axes: Tensor) -> Tensor:
    """Joint axes in the base: frames (N, n, 4, 4), axes (n, 3) -> (N, n, 3)."""
    return (frames[..., :3, :3] @ axes.to(frames.device)[..., None]).squeeze(-1)


def _merge_fixed(joints: Sequence[Joint]) -> tuple[list[Tensor], Tensor]:
    """Constant transforms before each moving joint, and after the last one."""
    offsets, pending = [], torch.eye(4, dtype=torch.float64, device="cpu")
    for joint in joints:
        pending = pending @ joint.origin
        if joint.kind != "fixed":
            offsets.append(pending)
            pending = torch.eye(4, dtype=torch.float64, device="cpu")
    return offsets, pending


def _coupling(chain: Chain, moving: Sequence[Joint]) -> tuple[Tensor, Tensor]:
    """Matrix (n_all, n) and vector (n_all,) of all moving joints' values by the active ones'."""
    units = torch.eye(
        chain.n + 1, dtype=torch.float64, device="cpu"
    )  # a column per active joint, the last for constants
    rows = dict(zip(chain.joint_names, units, strict=False))
    waiting = {joint.name: joint.mimic for joint in moving if joint.mimic is not None}
    for name, mimic in waiting.items():
        _check_drivers(chain, name, mimic)
    constants = {joint.name: joint.mimic_offset * units[-1] for joint in moving}
    while waiting:
        ready = [name for name, mimic in waiting.items() if all(driver in rows for driver in mimic)]
        if not ready:
            what = f"joints of robot '{chain.name}' mimic each other in a circle: {' -> '.join(_circle(waiting))}"
            raise RobotError.of(what, fix="make one of them active")
        for name in ready:
            mimic = waiting.pop(name)
            rows[name] = sum((slope * rows[driver] for driver, slope in mimic.items()), constants[name])
    table = torch.stack([rows[name] for name in chain.moving_names])
    return table[:, :-1].contiguous(), table[:, -1].contiguous()


def _check_drivers(chain: Chain, name: str, mimic: Mapping[str, float]) -> None:
    """Raise RobotError unless joint ``name`` mimics moving joints of the chain only."""
    fixed = {joint.name for joint in chain.joints if joint.kind == "fixed"}
    for driver in mimic:
        if driver in chain.moving_names:
            continue
        what = f"joint '{name}' of robot '{chain.name}' mimics '{driver}'"
        if driver in fixed:
            fix = f"make '{name}' fixed as well, or let it mimic a moving joint"
            raise RobotError.of(f"{what}, which is fixed", fix=fix)
        fix = "choose a base and a tip with that joint between them, correct its name, or make the joint active"
        raise RobotError.of(f"{what}, which is not a joint between '{chain.base}' and '{chain.tip}'", fix=fix)


def _circle(waiting: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Names of joints in one circle, closed by the first; every joint of ``waiting`` mimics another one of them."""
    path = [next(iter(waiting))]
    while True:
        driver = next(name for name in waiting[path[-1]] if name in waiting)
        if driver in path:
            return [*path[path.index(driver) :], driver]
        path.append(driver)


def _motion_terms(axes: Tensor, revolute: Tensor) -> Tensor:
    """Constants (4, n, 4, 4) of :func:`joint_motions`: Rodrigues ``1 + K^2 + K sin q - K^2 cos q``, or a slide."""
    turning = revolute[:, None, None]
    K = skew(axes) * turning
    terms = torch.zeros(4, len(axes), 4, 4, dtype=torch.float64, device="cpu")
    terms[0] = torch.eye(4, dtype=torch.float64, device="cpu")
    terms[0, :, :3, :3] += K @ K
    terms[1, :, :3, :3] = K
    terms[2, :, :3, :3] = -(K @ K)
    terms[3, :, :3, 3] = axes * ~revolute[:, None]
    return terms
