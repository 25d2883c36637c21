"""Forward kinematics of a calibrated robot with gravity sag: poses of its tips and their Jacobians.

    T_tip(q) = B prod_l [ A_l T(tau_l) J_l(q_l) ] O_tip,    T(t, w) = [[exp([w]x), t], [0, 1]],

the product over the joints l on the path to the tip, A_l the constant transform of moving joint l with its geometric
error, tau_l(q) its error twist: a constant and gravity sag (robots/geometry.py, robots/gravity.py).
J_l = C + S sin q + D cos q + L q.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np

from diffeo_calib.runtime.arrays import ONE, Array, cross, skew, transforms
from diffeo_calib.runtime.flow import NUMPY, Operations

SERIES_TERMS = 11
"""Terms of the Taylor series below |w| = 1: the first omitted term is under 1e-22."""


@dataclass(frozen=True, eq=False)
class Waves:
    """Periodic errors of joints, x_l + C cos(w x_l) + S sin(w x_l) in place of x_l; see robots/gear_waves.py.

    Args:
        joints: (K,) numbers l.
        selection: (K, n) units of these joints: several waves of one joint add up.
        frequencies: (K,) w, periods per turn.
        coefficients: (K, 2) C and S, rad or m.
    """

    joints: tuple[int, ...]
    selection: Array
    frequencies: Array
    coefficients: Array

    def slopes(self, x: Array) -> Array:
        """Derivative of :func:`turned`, which is diagonal: (N, n) -> (N, n)."""
        angles, (cosine, sine) = x[:, list(self.joints)] * self.frequencies, self.coefficients.T
        return 1.0 + (self.frequencies * (np.cos(angles) * sine - np.sin(angles) * cosine)) @ self.selection


def waves_of(config: Sequence[Sequence[float]], size: int, coefficients: Array) -> Waves | None:
    """The waves that a model file describes; None without any.

    Args:
        config: joint and frequency of each. size: number of joints. coefficients: (2 K,).
    """
    if not config:
        return None
    joints = tuple(int(joint) for joint, _ in config)
    frequencies = np.array([frequency for _, frequency in config], dtype=np.float64)
    return Waves(joints, np.eye(size)[list(joints)], frequencies, coefficients.reshape(-1, 2))


@dataclass(frozen=True, eq=False)
class Sag:
    """Gravity sag: twist coordinates e . m, with unit vectors e of nominal frames and moments m of unknown masses.

    The moments are linear in the origins o_f of the nominal frames: m_k = sum_f W_kf o_f + w_k.

    Args:
        offsets: (F, 4, 4) nominal constant transforms of all places [m]. before: (F,) the joints before them, or -1.
        grounded: whether the last place is the ground, in whose frame gravity is constant; else it is the base.
        moved: (F, n_all) 1 where joint l moves place f as seen from the ground. signs: (n_all,) of the axes seen so.
        joints: (K,) the moving joint of every coordinate.
        axes: (K, 3) its unit vector in the joint's frame.
        moments: (3 K, 3 F) W.
        forces: (K, 3) w, constant forces on prismatic joints.
        directions: (K, 6 n_all) twist of every joint per unit of the coordinate [m, rad].
    """

    offsets: Array
    before: np.ndarray
    grounded: bool
    moved: Array
    signs: Array
    joints: np.ndarray
    axes: Array
    moments: Array
    forces: Array
    directions: Array


@dataclass(frozen=True, eq=False)
class CalibratedChain:
    """Constants of the formula in the module's docstring.

    Args:
        start: (4, 4) the base in the measuring frame [m].
        offsets: (n_all, 4, 4) A_l [m]; constant error twists are multiplied in where there is no sag.
        twists: (n_all, 6) constant error twists tau_l [m, rad]; zero where they are multiplied in.
        tips: (T, 4, 4) O_tip [m].
        before: (F,) the moving joint before every place, -1 for the base; joints first, then tips.
        ancestors: (F, n_all) whether joint l moves place f.
        motions: (4, n_all, 4, 4) C, S, D, L.
        axes: (n_all, 3) joint axes in their own frames.
        revolute: (n_all,) False for prismatic joints.
        coupling: (n_all, n), coupling_offset: (n_all,): moving joints' values from the active ones'.
        sag: gravity sag; None without it.
        waves: of the active joints; None without.
    """

    start: Array
    offsets: Array
    twists: Array
    tips: Array
    before: np.ndarray
    ancestors: np.ndarray
    motions: Array
    axes: Array
    revolute: np.ndarray
    coupling: Array
    coupling_offset: Array
    sag: Sag | None = None
    waves: Waves | None = None

    @property
    def n(self) -> int:
        """Number of active joints."""
        return self.coupling.shape[1]

    @property
    def serial(self) -> bool:
        """Whether the joints follow one another to a single tip, and nothing else bends them."""
        return len(self.before) == len(self.axes) + 1 and self.before.tolist() == list(range(-1, len(self.axes)))

    def poses(self, q: Array) -> Array:
        """Poses of the tips in the measuring frame: (N, n) -> (N, T, 4, 4) [m]."""
        return tip_poses(self, q)

    def poses_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Poses (N, T, 4, 4) and their derivatives (N, T, 6, n).

        Velocity of the tip's origin [m/rad or m/m], then angular velocity, about the axes of the measuring frame.
        """
        motions, L = joint_motions(self, q if self.waves is None else turned(self.waves, q)), len(self.axes)
        nominal = None if self.sag is None else nominal_frames(self.sag, motions)
        twists = self.twists[None] if nominal is None else error_twists(self, nominal)
        offsets = self.offsets if nominal is None else self.offsets @ transforms(twists)
        links = link_frames(self, offsets @ motions)
        links[0] = np.broadcast_to(self.start, (len(q), 4, 4))
        before = np.stack([links[number + 1] for number in self.before[: len(self.axes)]], axis=1)
        frames = before @ self.offsets  # without and with their error twists: (N, L, 4, 4)
        bent = frames if nominal is None else before @ offsets
        tips = ends(self, links)
        R, arms = bent[..., :3, :3], tips[:, :, None, :3, 3] - bent[:, None, :, :3, 3]  # (N, L, 3, 3), (N, T, L, 3)
        on_path = self.ancestors[len(self.axes) :][: len(self.tips), :, None]  # (T, L, 1)
        z = np.broadcast_to((R @ self.axes[..., None])[..., 0][:, None], arms.shape)
        linear = np.where(self.revolute[:, None], cross(z, arms), z) * on_path
        angular = np.where(self.revolute[:, None], z, 0.0) * on_path
        by_moving = np.concatenate([linear, angular], axis=-1).swapaxes(2, 3)  # (N, T, 6, L)
        if self.sag is not None:
            amounts = load_slopes(self.axes, self.revolute, self.sag, nominal)
            slopes = (self.sag.directions.T @ amounts).reshape(len(q), L, 6, L)
            shifts = (frames[..., :3, :3] @ slopes[..., :3, :])[:, None]
            turns = (R @ _right_jacobian(twists[..., 3:]) @ slopes[..., 3:, :])[:, None]  # (N, 1, L, 3, L)
            moved = shifts + cross(turns.swapaxes(3, 4), arms[..., None, :]).swapaxes(3, 4)
            sums = [(part * on_path[..., None]).sum(2) for part in (moved, turns)]
            by_moving = by_moving + np.concatenate(sums, axis=2)
        found = by_moving @ self.coupling
        return tips, found if self.waves is None else found * self.waves.slopes(q)[:, None, None]


def tip_poses(chain: Any, q: Any, use: Operations = NUMPY) -> Any:
    """Poses of the tips: (N, n) -> (N, T, 4, 4) [m].

    Args:
        chain: the constants of a :class:`CalibratedChain`, as arrays of the library. q: joint values.
        use: the library; NumPy by default.
    """
    motions = joint_motions(chain, q if chain.waves is None else turned(chain.waves, q, use), use)
    offsets = chain.offsets
    if chain.sag is not None:
        offsets = offsets @ use.transforms(error_twists(chain, nominal_frames(chain.sag, motions, use)))
    return ends(chain, link_frames(chain, offsets @ motions), use)


def turned(waves: Any, x: Any, use: Operations = NUMPY) -> Any:
    """Joint values with their waves: (N, n) -> (N, n)."""
    angles, (cosine, sine) = x[:, list(waves.joints)] * waves.frequencies, waves.coefficients.T
    return x + (use.cos(angles) * cosine + use.sin(angles) * sine) @ waves.selection


def joint_motions(chain: Any, q: Any, use: Operations = NUMPY) -> Any:
    """J_l: (N, n_all, 4, 4)."""
    x = (q @ chain.coupling.T + chain.coupling_offset)[..., None, None]
    C, S, D, L = chain.motions
    motions = C + S * use.sin(x) + D * use.cos(x)
    return motions if all(chain.revolute) else motions + L * x


def link_frames(chain: Any, steps: Any) -> list[Any]:
    """The base (4, 4), then the link after every joint (N, 4, 4), from their steps A_l T(tau_l) J_l."""
    links = [chain.start]
    for joint in range(steps.shape[1]):
        links.append(links[chain.before[joint] + 1] @ steps[:, joint])
    return links


def ends(chain: Any, links: Sequence[Any], use: Operations = NUMPY) -> Any:
    """Poses of the tips on their links: (N, T, 4, 4)."""
    L = len(links) - 1
    return use.stack([links[number + 1] for number in chain.before[L : L + len(chain.tips)]], 1) @ chain.tips


def nominal_frames(sag: Any, motions: Any, use: Operations = NUMPY) -> Any:
    """Nominal frames of all places on the ground: (N, F, 4, 4)."""
    poses: list[Any] = []
    for place, before in enumerate(sag.before):
        offset = sag.offsets[place]
        on_base = use.broadcast_to(offset, motions[:, 0].shape)
        poses.append(on_base if before < 0 else poses[before] @ motions[:, before] @ offset)
    found = use.stack(poses, 1)
    return use.inverse(found[:, -1:]) @ found if sag.grounded else found


def error_twists(chain: Any, nominal: Any) -> Any:
    """tau_l with gravity sag: (N, n_all, 6)."""
    e, m = loads(chain.sag, nominal)
    return chain.twists + ((e * m).sum(-1) @ chain.sag.directions).reshape(-1, *chain.twists.shape)


def loads(sag: Any, nominal: Any) -> tuple[Any, Any]:
    """Unit vectors e and moments m: (N, K, 3) each."""
    e = (nominal[:, sag.joints, :3, :3] @ sag.axes[..., None])[..., 0]
    m = nominal[..., :3, 3].reshape(-1, sag.moments.shape[1]) @ sag.moments.T
    return e, m.reshape(e.shape) + sag.forces


def load_slopes(axes: Any, revolute: Any, sag: Any, nominal: Any) -> Any:
    """Derivatives of the twist coordinates e . m by the moving joints: (N, K, n_all).

    Turning joint k moves what it carries, M_fk = 1, by z_k x (o_f - o_k), a slide by z_k; e turns where M_lk = 1.
    """
    (N, F), L = nominal.shape[:2], len(axes)
    e, m = loads(sag, nominal)
    z = (nominal[:, :L, :3, :3] @ axes[..., None])[..., 0] * sag.signs[:, None]  # (N, L, 3)
    origins, spun = nominal[..., :3, 3], (z * revolute[:, None])[:, None]  # (N, F, 3), (N, 1, L, 3)
    moved = cross(spun, origins[:, :, None] - origins[:, None, :L]) + (z * ~revolute[:, None])[:, None]
    moved = moved * sag.moved[None, :, :, None]  # (N, F, L, 3)
    slopes_m = (sag.moments @ moved.swapaxes(2, 3).reshape(N, 3 * F, L)).reshape(*e.shape, L)
    slopes_e = cross(spun, e[:, :, None]) * sag.moved[sag.joints][None, :, :, None]  # (N, K, L, 3)
    return (e[:, :, None] @ slopes_m)[:, :, 0] + (slopes_e @ m[..., None])[..., 0]


def _right_jacobian(w: Array) -> Array:
    """Jr of SO(3): (..., 3) -> (..., 3, 3)."""
    x, W = (w * w).sum(-1)[..., None, None], skew(w)
    return (
        ONE
        - 0.5 * np.sinc(np.sqrt(x) / (2 * np.pi)) ** 2 * W
        + smooth(x, 3, lambda a: (a - np.sin(a)) / a**3, np.where) * (W @ W)
    )


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
