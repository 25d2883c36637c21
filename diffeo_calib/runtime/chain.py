"""Forward kinematics of a calibrated robot with gravity sag and errors of axes: poses of its tips and their Jacobians.

    T_tip(q) = B prod_l [ A_l T(tau_l) J_l(q_l) ] O_tip,    T(t, w) = [[exp([w]x), t], [0, 1]],

the product over the joints l on the path to the tip, A_l the constant transform of moving joint l with its geometric
error, tau_l(q) its error twist: a constant, gravity sag and errors of its axis (robots/geometry.py,
robots/gravity.py, kinematics/nominal.py).
J_l = C + S sin q + D cos q + L q.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import factorial
from typing import Any, NamedTuple

import numpy as np

from diffeo_calib.runtime.arrays import NUMPY, ONE, SKEW, Array, cross, skew, transforms

COINCIDENT_FRAMES_M = 1e-6  # frames whose origins are closer than this [m] count as one place for masses
SERIES_TERMS = 11  # terms of the Taylor series below |w| = 1: the first omitted term is under 1e-22


class Waves(NamedTuple):
    """K errors of joints by their own value x_l, sum_k c_k cos(w_k (x_l - s_k)); arrays of any library.

    A value outside of [low, high] counts as its end, where the slope of errors with such ends vanishes.
    """

    joints: Any  # (K,) numbers l
    frequencies: Any  # (K,) w, rad per unit of the joint
    starts: Any  # (K,) s
    low: Any  # (K,)
    high: Any  # (K,)
    effects: Any  # (K, J r) c_k in the r components of its joint l, zero in those of the others

    def times(self, coefficients: Any) -> Waves:
        """Multiply by units (K, J) of their joints for effects, with coefficients (K r,)."""
        each = coefficients.reshape(len(self.joints), 1, -1)
        return self._replace(effects=(self.effects[:, :, None] * each).reshape(len(self.joints), -1))


def wave_angles(waves: Waves, x: Any, use: Any = NUMPY) -> Any:
    """w (x_l - s): (N, J) -> (N, K)."""
    return (use.clip(x[:, waves.joints], waves.low, waves.high) - waves.starts) * waves.frequencies


def wave_sums(waves: Waves, x: Any, use: Any = NUMPY) -> Any:
    """The errors of all joints: (N, J) -> (N, J r)."""
    return use.cos(wave_angles(waves, x, use)) @ waves.effects


def wave_slopes(waves: Waves, x: Any, use: Any = NUMPY) -> Any:
    """Derivatives of the errors, each by its own joint: (N, J) -> (N, J r)."""
    return (-waves.frequencies * use.sin(wave_angles(waves, x, use))) @ waves.effects


@dataclass(frozen=True, eq=False)
class Compliance:
    """The sag of a joint's frame in one direction, and its family of features; see robots/gravity.py."""

    joint: int  # number of the moving joint whose frame sags
    direction: Array  # (6,) unit twist in the frame before the joint's motion, translation first
    own: bool  # whether it is along the joint's own motion (else lateral)
    # numbers of the places at which masses pull; empty for a slide along its axis, where the feature is the force
    # itself
    places: tuple[int, ...]
    loaded: bool = False  # whether the load is the payload, whose mass is known

    @property
    def size(self) -> int:
        """Number of its features."""
        return 3 * max(len(self.places), 1)

    @property
    def axis(self) -> Array:
        """(3,) the unit vector along which it slides, or about which it turns."""
        return self.direction[3:] if self.places else self.direction[:3]


@dataclass(frozen=True, eq=False)
class NominalChain:
    """Constants of a robot, see robots/tree.py. Its F places are the frames of joints, tips, loads and the ground."""

    offsets: Array  # (F, 4, 4) constant transforms of the places [m]
    before: np.ndarray  # (F,) the moving joints before them, or -1
    tips: tuple[str, ...]  # names of the tips
    grounded: bool  # whether the last place is the ground; else it is the base
    axes: Array  # (n_all, 3) joint axes in their own frames
    revolute: np.ndarray  # (n_all,) False for prismatic joints
    motions: Array  # (4, n_all, 4, 4) C, S, D, L
    coupling: Array  # (n_all, n), and below (n_all,): moving joints' values from the active ones'
    coupling_offset: Array
    names: tuple[str, ...]  # of the n active joints
    limits: Array  # (n, 2) their lower and upper limits, infinite without one

    @cached_property
    def ancestors(self) -> np.ndarray:
        """(F, n_all) whether joint l moves place f."""
        ancestors = np.zeros((len(self.before), len(self.axes)), dtype=bool)
        for place, last in enumerate(self.before):
            if last >= 0:
                ancestors[place] = ancestors[last]
                ancestors[place, last] = True
        return ancestors

    @cached_property
    def moved(self) -> np.ndarray:
        """(F, n_all) whether joint l moves place f as seen from the ground."""
        between = self.ancestors[-1] & self.grounded  # what they move is on the base's side
        return self.ancestors ^ between

    @cached_property
    def signs(self) -> Array:
        """(n_all,) sense of the axes as seen from the ground."""
        return np.where(self.ancestors[-1] & self.grounded, -1.0, 1.0)

    @cached_property
    def distinct(self) -> np.ndarray:
        """(F,) whose origin differs from the one before in some configuration: masses there are distinguishable."""
        far = np.linalg.norm(self.offsets[:, :3, 3], axis=1) > COINCIDENT_FRAMES_M
        ends = (self.before < 0) & (np.arange(len(self.before)) >= len(self.axes))
        return far | np.where(self.before < 0, ends, ~self.revolute[self.before])

    @cached_property
    def compliances(self) -> tuple[Compliance, ...]:
        """Every joint's own compliance and its two lateral ones (three for a slide)."""
        moved, compliances = self.moved & self.distinct[:, None], []
        for joint, axis in enumerate(self.axes):
            beyond = tuple(place for place in np.flatnonzero(moved[:, joint]).tolist() if place != joint)
            if not self.revolute[joint]:
                compliances.append(Compliance(joint, np.append(axis, np.zeros(3)), True, ()))
            if beyond:
                turns = np.pad([axis, *perpendicular(axis)], ((0, 0), (3, 0)))
                flags = bool(self.revolute[joint]), False, False
                compliances += [Compliance(joint, *turn, beyond) for turn in zip(turns, flags, strict=True)]
        return tuple(compliances)


def perpendicular(axis: Array) -> Array:
    """Two unit vectors perpendicular to a unit vector (3,) and to each other: (2, 3).

    Rows of the Householder reflection that maps the first axis to +-``axis``. Coefficients in model files refer to
    them, so that they must not depend on a library's choice of basis.
    """
    v = axis.copy()
    v[0] += 1.0 if axis[0] >= 0 else -1.0
    return (np.eye(3) - 2.0 * np.outer(v, v) / (v @ v))[1:]


class Sag(NamedTuple):
    """Gravity sag: twist coordinates e . m, with unit vectors e of nominal frames and moments m of unknown masses.

    The moments are linear in the origins o_f of the nominal frames: m_k = sum_f W_kf o_f + w_k. Arrays of any library;
    compilers follow named tuples.
    """

    joints: Any  # (K,) the moving joint of every coordinate
    axes: Any  # (K, 3) its unit vector in the joint's frame
    moments: Any  # (3 K, 3 F) W
    forces: Any  # (K, 3) w, constant forces on prismatic joints
    directions: Any  # (K, 6 n_all) twist of every joint per unit of the coordinate [m, rad]


class Masses(NamedTuple):
    """The masses, M in all, that pull at K compliances: constants of their :class:`Sag`."""

    joints: Any  # (K,), axes (K, 3), directions (K, 6 n_all): see Sag
    axes: Any
    directions: Any
    own: Any  # (K, M) 1 where the mass pulls at the compliance
    arms: Any  # (M, F) of the origins of the places: from its joint to the mass; zero for the force along a slide
    slides: Any  # (M, 1) 1 for the force along a slide
    skew: Any  # (3, 9) c @ skew is [c]x, row by row

    @classmethod
    def of(cls, compliances: Sequence[Compliance], robot: NominalChain) -> Masses:
        """Effects of some compliances of a robot."""
        pairs = [(k, c.joint, place) for k, c in enumerate(compliances) for place in c.places or (c.joint,)]
        k, joint, place = np.array(pairs, dtype=int).reshape(-1, 3).T
        joints, units = np.array([c.joint for c in compliances], dtype=int), np.eye(len(robot.offsets))
        directions = np.zeros((len(compliances), len(robot.axes), 6))
        for number, compliance in enumerate(compliances):
            directions[number, compliance.joint] = compliance.direction
        axes = np.array([c.axis for c in compliances]).reshape(-1, 3)
        unit, arms, slides = np.eye(len(compliances))[:, k], units[place] - units[joint], (place == joint)[:, None]
        return cls(joints, axes, directions.reshape(-1, 6 * len(robot.axes)), unit, arms, slides.astype(float), SKEW)

    def sag(self, coefficients: Any) -> Sag:
        """The sag with these coefficients c (3 M,): m = sum (o_f - o_l) x c for the masses at the places f."""
        c, K, F = coefficients.reshape(-1, 3), len(self.joints), self.arms.shape[1]
        blocks = self.arms[:, :, None, None] * (c @ self.skew).reshape(-1, 1, 3, 3)  # (M, F, 3, 3)
        moments = -(self.own @ blocks.reshape(len(c), 9 * F)).reshape(K, F, 3, 3).swapaxes(1, 2)
        forces = self.own @ (c * self.slides)
        return Sag(self.joints, self.axes, moments.reshape(3 * K, 3 * F), forces, self.directions)


@dataclass(frozen=True, eq=False)
class CalibratedChain:
    """Constants of the formula in the module's docstring."""

    nominal: NominalChain  # the robot
    start: Array  # (4, 4) the base in the measuring frame [m]
    offsets: Array  # (n_all, 4, 4) A_l [m]; constant error twists are multiplied in where there is no sag
    twists: Array  # (n_all, 6) constant error twists tau_l [m, rad]; zero where they are multiplied in
    tips: Array  # (T, 4, 4) O_tip [m]
    sag: Sag | None = None  # gravity sag
    waves: Waves | None = None  # of the active joints, r = 1; None without
    axes: Waves | None = None  # of the moving joints, r = 6; None without

    @property
    def n(self) -> int:
        """Number of active joints."""
        return self.nominal.coupling.shape[1]

    def poses_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Poses (N, T, 4, 4) and their derivatives (N, T, 6, n).

        Velocity of the tip's origin [m/rad or m/m], then angular velocity, about the axes of the measuring frame.
        """
        robot, L = self.nominal, len(self.nominal.axes)
        x = moving_values(robot, q if self.waves is None else q + wave_sums(self.waves, q))
        motions, bends = joint_motions(robot.motions, x), self.sag is not None or self.axes is not None
        nominal = None if self.sag is None else nominal_frames(robot, motions)
        twists = error_twists(self, nominal, x)
        offsets = self.offsets @ transforms(twists) if bends else self.offsets
        links = link_frames(self, offsets @ motions)
        links[0] = np.broadcast_to(self.start, (len(q), 4, 4))
        before = np.stack([links[number + 1] for number in robot.before[:L]], axis=1)
        frames = before @ self.offsets  # without and with their error twists: (N, L, 4, 4)
        bent = before @ offsets if bends else frames
        tips = ends(self, links)
        R, arms = bent[..., :3, :3], tips[:, :, None, :3, 3] - bent[:, None, :, :3, 3]  # (N, L, 3, 3), (N, T, L, 3)
        on_path = robot.ancestors[L:][: len(self.tips), :, None]  # (T, L, 1)
        z = np.broadcast_to((R @ robot.axes[..., None])[..., 0][:, None], arms.shape)
        linear = np.where(robot.revolute[:, None], cross(z, arms), z) * on_path
        angular = np.where(robot.revolute[:, None], z, 0.0) * on_path
        by_moving = np.concatenate([linear, angular], axis=-1).swapaxes(2, 3)  # (N, T, 6, L)
        if bends:
            slopes = np.zeros((len(q), L, 6, L))
            if self.sag is not None:
                slopes += (self.sag.directions.T @ load_slopes(robot, self.sag, nominal)).reshape(slopes.shape)
            if self.axes is not None:
                slopes[:, range(L), :, range(L)] += wave_slopes(self.axes, x).reshape(-1, L, 6).swapaxes(0, 1)
            shifts = (frames[..., :3, :3] @ slopes[..., :3, :])[:, None]
            w = twists[..., 3:]
            x, W = (w * w).sum(-1)[..., None, None], skew(w)
            Jr = ONE - 0.5 * np.sinc(np.sqrt(x) / (2 * np.pi)) ** 2 * W  # the right Jacobian of SO(3)
            Jr = Jr + smooth(x, 3, lambda a: (a - np.sin(a)) / a**3, np.where) * (W @ W)
            turns = (R @ Jr @ slopes[..., 3:, :])[:, None]  # (N, 1, L, 3, L)
            moved = shifts + cross(turns.swapaxes(3, 4), arms[..., None, :]).swapaxes(3, 4)
            sums = [(part * on_path[..., None]).sum(2) for part in (moved, turns)]
            by_moving = by_moving + np.concatenate(sums, axis=2)
        by_active = by_moving @ robot.coupling
        return tips, by_active if self.waves is None else by_active * (1.0 + wave_slopes(self.waves, q))[:, None, None]


def tip_poses(chain: Any, q: Any, use: Any = NUMPY) -> Any:
    """Poses of the tips in the measuring frame, by arrays of a library: q (N, n) -> (N, T, 4, 4) [m]."""
    x = moving_values(chain.nominal, q if chain.waves is None else q + wave_sums(chain.waves, q, use))
    motions, offsets = joint_motions(chain.nominal.motions, x, use), chain.offsets
    if chain.sag is not None or chain.axes is not None:
        nominal = None if chain.sag is None else nominal_frames(chain.nominal, motions, use)
        offsets = offsets @ use.transforms(error_twists(chain, nominal, x, use))
    return ends(chain, link_frames(chain, offsets @ motions), use)


def joint_motions(terms: Any, values: Any, use: Any = NUMPY) -> Any:
    """J_l = C + S sin q + D cos q + L q: terms (4, n_all, 4, 4), moving joints' q (N, n_all) -> (N, n_all, 4, 4)."""
    (C, S, D, L), x = terms, values[..., None, None]
    return C + S * use.sin(x) + D * use.cos(x) + L * x


def moving_values(robot: Any, q: Any) -> Any:
    """Values of all moving joints (N, n_all) from those of the active ones (N, n), rad or m."""
    return q @ robot.coupling.T + robot.coupling_offset


def link_frames(chain: Any, steps: Any) -> list[Any]:
    """The base (4, 4), then the link after every joint (N, 4, 4), from their steps A_l T(tau_l) J_l."""
    links = [chain.start]
    for joint in range(steps.shape[1]):
        links.append(links[chain.nominal.before[joint] + 1] @ steps[:, joint])
    return links


def ends(chain: Any, links: Sequence[Any], use: Any = NUMPY) -> Any:
    """Poses of the tips on their links: (N, T, 4, 4)."""
    L = len(links) - 1
    return use.stack([links[number + 1] for number in chain.nominal.before[L : L + len(chain.tips)]], 1) @ chain.tips


def walk(start: Any, offsets: Any, motions: Any, before: Sequence[int], use: Any = NUMPY) -> Any:
    """Multiply a tree out: ``frame_f = frame_before(f) J_before(f) O_f``, from ``start`` where nothing is before.

    Args:
        start: (4, 4) pose of the base, or (N, 4, 4); None for the base itself. offsets: F of (4, 4), or (N, 4, 4).
        motions: (N, n_all, 4, 4) joint motions J_l; the first n_all of the F frames are those of the joints.
        before: F numbers of the joints before the frames, -1 for the base; a joint follows its parent.

    Returns frames (N, F, 4, 4); those of joints are before the joint's motion.
    """
    shape, steps, frames = motions[:, 0].shape, list(motions.swapaxes(0, 1)), []
    moved = {} if start is None else {-1: use.broadcast_to(start, shape)}
    for number, (offset, parent) in enumerate(zip(offsets, before, strict=True)):
        frames.append(moved[parent] @ offset if parent in moved else use.broadcast_to(offset, shape))
        if number < len(steps):
            moved[number] = frames[-1] @ steps[number]
    return use.stack(frames, 1)


def nominal_frames(robot: Any, motions: Any, use: Any = NUMPY) -> Any:
    """Nominal frames of all places on the ground: (N, F, 4, 4)."""
    frames = walk(None, robot.offsets, motions, robot.before, use)
    return use.inverse(frames[:, -1:]) @ frames if robot.grounded else frames


def error_twists(chain: Any, nominal: Any, x: Any, use: Any = NUMPY) -> Any:
    """tau_l by the nominal frames, for gravity sag, and the values (N, n_all) of the moving joints: (N, n_all, 6)."""
    twists = chain.twists[None]
    if chain.sag is not None:
        e, m = loads(chain.sag, nominal)
        twists = twists + ((e * m).sum(-1) @ chain.sag.directions).reshape(-1, *chain.twists.shape)
    return twists if chain.axes is None else twists + wave_sums(chain.axes, x, use).reshape(-1, *chain.twists.shape)


def loads(sag: Any, nominal: Any) -> tuple[Any, Any]:
    """Unit vectors e and moments m: (N, K, 3) each."""
    e = (nominal[:, sag.joints, :3, :3] @ sag.axes[..., None])[..., 0]
    m = nominal[..., :3, 3].reshape(-1, sag.moments.shape[1]) @ sag.moments.T
    return e, m.reshape(e.shape) + sag.forces


def load_slopes(robot: Any, sag: Any, nominal: Any) -> Any:
    """Derivatives of the twist coordinates e . m by the moving joints: (N, K, n_all).

    Turning joint k moves what it carries, M_fk = 1, by z_k x (o_f - o_k), a slide by z_k; e turns where M_lk = 1.
    ``robot``: axes, revolute, moved, signs of a :class:`NominalChain`.
    """
    (N, F), L, revolute = nominal.shape[:2], len(robot.axes), robot.revolute[:, None]
    e, m = loads(sag, nominal)
    z = (nominal[:, :L, :3, :3] @ robot.axes[..., None])[..., 0] * robot.signs[:, None]  # (N, L, 3)
    origins, spun = nominal[..., :3, 3], (z * revolute)[:, None]  # (N, F, 3), (N, 1, L, 3)
    moved = cross(spun, origins[:, :, None] - origins[:, None, :L]) + (z * ~revolute)[:, None]
    moved = moved * robot.moved[None, :, :, None]  # (N, F, L, 3)
    slopes_m = (sag.moments @ moved.swapaxes(2, 3).reshape(N, 3 * F, L)).reshape(*e.shape, L)
    slopes_e = cross(spun, e[:, :, None]) * robot.moved[sag.joints][None, :, :, None]  # (N, K, L, 3)
    return (e[:, :, None] @ slopes_m)[:, :, 0] + (slopes_e @ m[..., None])[..., 0]


def smooth(x: Any, order: int, closed: Callable[[Any], Any], where: Callable[..., Any]) -> Any:
    """A function of the angle a, in terms of x = a^2: sum_k (-x)^k / (2 k + order)! below 1, else its closed form.

    Smooth in x: neither the root of 0 nor a cancelling difference is ever differentiated.
    """
    small = x < 1.0
    minus, far = where(small, -x, 0.0), where(small, 1.0, x)
    series = 0.0
    for k in reversed(range(SERIES_TERMS)):  # Horner; torch subtracts a tensor from a number several times slower
        series = minus * series + 1.0 / factorial(2 * k + order)
    return where(small, series, closed(far**0.5))
