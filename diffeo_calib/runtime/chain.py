"""Forward kinematics of a calibrated robot with gravity sag: poses of its tips and their Jacobians.

    T_tip(q) = B prod_l [ A_l T(tau_l) J_l(q_l) ] O_tip,    T(t, w) = [[exp([w]x), t], [0, 1]],

the product over the joints l on the path to the tip, A_l the constant transform of moving joint l with its geometric
error, tau_l(q) its error twist: a constant and gravity sag (robots/geometry.py, robots/gravity.py).
J_l = C + S sin q + D cos q + L q.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diffeo_calib.runtime.arrays import Array, cross


@dataclass(frozen=True, eq=False)
class Waves:
    """x_l + C cos(w x_l) + S sin(w x_l) in place of x_l.

    Args:
        size: n, number of joints.
        joints: (K,) numbers l.
        frequencies: (K,) w, periods per turn.
        coefficients: (K, 2) C and S, rad or m.
    """

    size: int
    joints: tuple[int, ...]
    frequencies: Array
    coefficients: Array

    def turned(self, x: Array) -> Array:
        """(N, n) -> (N, n)."""
        angles, (cosine, sine) = self._angles(x), self.coefficients.T
        return x + (np.cos(angles) * cosine + np.sin(angles) * sine) @ self._selection

    def slopes(self, x: Array) -> Array:
        """Derivative of :meth:`turned`, which is diagonal: (N, n) -> (N, n)."""
        angles, (cosine, sine) = self._angles(x), self.coefficients.T
        return 1.0 + (self.frequencies * (np.cos(angles) * sine - np.sin(angles) * cosine)) @ self._selection

    def _angles(self, x: Array) -> Array:
        return x[:, list(self.joints)] * self.frequencies

    @cached_property
    def _selection(self) -> Array:
        """(K, n): several waves of one joint add up."""
        return np.eye(self.size)[list(self.joints)]


def waves_of(config: Sequence[Sequence[float]], size: int, coefficients: Array) -> Waves | None:
    """The waves that a model file describes; None without any.

    Args:
        config: joint and frequency of each. size: number of joints. coefficients: (2 K,).
    """
    if not config:
        return None
    frequencies = np.array([frequency for _, frequency in config], dtype=np.float64)
    return Waves(size, tuple(int(joint) for joint, _ in config), frequencies, coefficients.reshape(-1, 2))


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
        forces: (K, 3) w, constant forces on slides.
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
        revolute: (n_all,) False for slides.
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
        return self._run(q if self.waves is None else self.waves.turned(q))[-1]

    def poses_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Poses (N, T, 4, 4) and their derivatives (N, T, 6, n).

        Velocity of the tip's origin [m/rad or m/m], then angular velocity, about the axes of the measuring frame.
        """
        if self.waves is None:
            return self._poses_and_jacobian(q)
        tips, slopes = self._poses_and_jacobian(self.waves.turned(q))
        return tips, slopes * self.waves.slopes(q)[:, None, None]

    def _poses_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """The same for joint values that include their waves."""
        motions = self._motions(q)
        nominal = self._nominal_frames(motions) if self.sag is not None else None
        twists = self._twists(nominal)
        turned, frames, tips = self._walk(motions, twists)
        R, arms = turned[..., :3, :3], tips[:, :, None, :3, 3] - turned[:, None, :, :3, 3]  # (N, L, 3, 3), (N, T, L, 3)
        on_path = self.ancestors[len(self.axes) :][: len(self.tips), :, None]  # (T, L, 1)
        z = np.broadcast_to((R @ self.axes[..., None])[..., 0][:, None], arms.shape)
        linear = np.where(self.revolute[:, None], cross(z, arms), z) * on_path
        angular = np.where(self.revolute[:, None], z, 0.0) * on_path
        by_moving = np.concatenate([linear, angular], axis=-1).swapaxes(2, 3)  # (N, T, 6, L)
        if nominal is None or self.sag is None:
            return tips, by_moving @ self.coupling
        slopes = self._sag_slopes(nominal)  # (N, L, 6, L)
        shifts = (frames[..., :3, :3] @ slopes[..., :3, :])[:, None]
        turns = (R @ _right_jacobian(twists[..., 3:]) @ slopes[..., 3:, :])[:, None]  # (N, 1, L, 3, L)
        moved = shifts + cross(turns.swapaxes(3, 4), arms[..., None, :]).swapaxes(3, 4)
        sums = [(part * on_path[..., None]).sum(2) for part in (moved, turns)]
        return tips, (by_moving + np.concatenate(sums, axis=2)) @ self.coupling

    def _run(self, q: Array) -> tuple[Array, Array, Array]:
        motions = self._motions(q)
        if self.sag is None:
            return self._walk(motions, None)
        return self._walk(motions, self._twists(self._nominal_frames(motions)))

    def _motions(self, q: Array) -> Array:
        """J_l: (N, n_all, 4, 4)."""
        x = (q @ self.coupling.T + self.coupling_offset)[..., None, None]
        C, S, D, L = self.motions
        motions = C + S * np.sin(x) + D * np.cos(x)
        return motions if self._turning else motions + L * x

    def _walk(self, motions: Array, twists: Array | None) -> tuple[Array, Array, Array]:
        """Frames after and before their error twists (N, n_all, 4, 4), and tips (N, T, 4, 4)."""
        offsets = self.offsets if twists is None else self.offsets @ transforms(twists)
        locals_, L = offsets @ motions, motions.shape[1]
        links = [np.broadcast_to(self.start, (len(motions), 4, 4))]  # the base, then the link after every joint
        for joint in range(L):
            links.append(links[self.before[joint] + 1] @ locals_[:, joint])
        before = np.stack([links[number + 1] for number in self.before[:L]], axis=1)
        frames = before @ self.offsets
        turned = frames if twists is None else before @ offsets
        ends = self.before[L : L + len(self.tips)]
        return turned, frames, np.stack([links[number + 1] for number in ends], axis=1) @ self.tips

    def _nominal_frames(self, motions: Array) -> Array:
        """Nominal frames of all places on the ground: (N, F, 4, 4)."""
        offsets, base = self._sag.offsets, np.broadcast_to(np.eye(4), (len(motions), 4, 4))
        frames: list[Array] = []
        for place, before in enumerate(self._sag.before):
            frames.append((frames[before] @ motions[:, before] if before >= 0 else base) @ offsets[place])
        found = np.stack(frames, axis=1)
        return np.linalg.inv(found[:, -1:]) @ found if self._sag.grounded else found

    def _twists(self, nominal: Array | None) -> Array:
        """tau_l: (N, n_all, 6)."""
        if nominal is None:
            return self.twists[None]
        e, m = self._loads(nominal)
        return self.twists + ((e * m).sum(-1) @ self._sag.directions).reshape(len(nominal), len(self.axes), 6)

    def _loads(self, nominal: Array) -> tuple[Array, Array]:
        """Unit vectors e and moments m: (N, K, 3) each."""
        sag = self._sag
        e = (nominal[:, sag.joints, :3, :3] @ sag.axes[..., None])[..., 0]
        m = nominal[..., :3, 3].reshape(len(nominal), 3 * nominal.shape[1]) @ sag.moments.T
        return e, m.reshape(e.shape) + sag.forces

    def _sag_slopes(self, nominal: Array) -> Array:
        """Derivatives of the twists by the moving joints: (N, n_all, 6, n_all)."""
        sag, (N, F), L = self._sag, nominal.shape[:2], len(self.axes)
        e, m = self._loads(nominal)
        z = (nominal[:, :L, :3, :3] @ self.axes[..., None])[..., 0] * sag.signs[:, None]  # (N, L, 3)
        origins = nominal[..., :3, 3]
        spun = np.where(self.revolute[:, None], z, 0.0)[:, None]  # (N, 1, L, 3)
        arms = origins[:, :, None] - origins[:, None, :L]  # (N, F, L, 3)
        moved = np.where(self.revolute[:, None], cross(z[:, None], arms), z[:, None])
        moved = moved * sag.moved[None, :, :, None]
        slopes_m = (sag.moments @ moved.swapaxes(2, 3).reshape(N, 3 * F, L)).reshape(*e.shape, L)
        slopes_e = cross(spun, e[:, :, None]) * sag.moved[sag.joints][None, :, :, None]  # (N, K, L, 3)
        amounts = np.einsum("nkc,nkcl->nkl", e, slopes_m) + np.einsum("nklc,nkc->nkl", slopes_e, m)
        return (sag.directions.T @ amounts).reshape(N, L, 6, L)

    @property
    def _sag(self) -> Sag:
        if self.sag is None:
            raise RuntimeError("this chain has no gravity sag")
        return self.sag

    @cached_property
    def _turning(self) -> bool:
        return bool(self.revolute.all())


def transforms(twists: Array) -> Array:
    """T(t, w) of the module's docstring: (..., 6) -> (..., 4, 4)."""
    w = twists[..., 3:]
    x, W = (w * w).sum(-1)[..., None, None], skew(w)
    a = np.sqrt(x)
    out = np.zeros((*twists.shape[:-1], 4, 4))
    out[..., :3, :3] = _ONE + np.sinc(a / np.pi) * W + 0.5 * np.sinc(a / (2 * np.pi)) ** 2 * (W @ W)
    out[..., :3, 3], out[..., 3, 3] = twists[..., :3], 1.0
    return out


def _right_jacobian(w: Array) -> Array:
    """Jr of SO(3): (..., 3) -> (..., 3, 3)."""
    x, W = (w * w).sum(-1)[..., None, None], skew(w)
    return _ONE - 0.5 * np.sinc(np.sqrt(x) / (2 * np.pi)) ** 2 * W + _third(x) * (W @ W)


def _third(x: Array) -> Array:
    """(a - sin a) / a^3 with x = a^2: the series below 1, where the difference would cancel."""
    small = x < 1.0
    near, far = np.where(small, x, 0.0), np.sqrt(np.where(small, 1.0, x))
    series = np.zeros_like(x)
    for factor in _THIRD:
        series = factor - near * series
    return np.where(small, series, (far - np.sin(far)) / far**3)


def skew(w: Array) -> Array:
    """[w]x: (..., 3) -> (..., 3, 3)."""
    return (w @ _SKEW).reshape(*w.shape, 3)


_ONE = np.eye(3)
_SKEW = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]], float)
"""w @ _SKEW is [w]x, row by row."""
_THIRD = [1.0 / float(np.prod(np.arange(1, 2 * k + 4))) for k in reversed(range(11))]
"""1 / (2 k + 3)!, the last first."""
