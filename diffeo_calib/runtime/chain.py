"""Forward kinematics of a calibrated chain with gravity sag: poses of its tip and their Jacobian.

    T(q) = B prod_l [ A_l T(tau_l) J_l(q_l) ] O_tip,    T(t, w) = [[exp([w]x), t], [0, 1]],

A_l the constant transform of moving joint l with its geometric error, tau_l(q) its error twist: a constant and gravity
sag (robots/geometry.py, robots/gravity.py). J_l = C + S sin q + D cos q + L q.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from diffeo_calib.runtime.arrays import Array, cross


@dataclass(frozen=True, eq=False)
class Sag:
    """Gravity sag: twist coordinates e . m, with unit vectors e of nominal frames and moments m of unknown masses.

    The moments are linear in the origins o_f of the nominal frames: m_k = sum_f W_kf o_f + w_k.

    Args:
        offsets: (n_all + 1, 4, 4) nominal constant transforms, the last to the tip [m].
        joints: (K,) the moving joint of every coordinate.
        axes: (K, 3) its unit vector in the joint's frame.
        moments: (3 K, 3 F) W; F = n_all + 1 frames, the tip last.
        forces: (K, 3) w, constant forces on slides.
        directions: (K, 6 n_all) twist of every joint per unit of the coordinate [m, rad].
    """

    offsets: Array
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
        tip: (4, 4) O_tip [m].
        motions: (4, n_all, 4, 4) C, S, D, L.
        axes: (n_all, 3) joint axes in their own frames.
        revolute: (n_all,) False for slides.
        coupling: (n_all, n), coupling_offset: (n_all,): moving joints' values from the active ones'.
        sag: gravity sag; None without it.
    """

    start: Array
    offsets: Array
    twists: Array
    tip: Array
    motions: Array
    axes: Array
    revolute: np.ndarray
    coupling: Array
    coupling_offset: Array
    sag: Sag | None = None

    @property
    def n(self) -> int:
        """Number of active joints."""
        return self.coupling.shape[1]

    def poses(self, q: Array) -> Array:
        """Poses of the tip in the measuring frame: (N, n) -> (N, 4, 4) [m]."""
        return self._run(q)[-1]

    def poses_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Poses (N, 4, 4) and their derivatives (N, 6, n).

        Velocity of the tip's origin [m/rad or m/m], then angular velocity, about the axes of the measuring frame.
        """
        motions = self._motions(q)
        nominal = self._nominal_frames(motions) if self.sag is not None else None
        twists = self._twists(nominal)
        turned, frames, tip = self._walk(motions, twists)
        R, arms = turned[..., :3, :3], tip[:, None, :3, 3] - turned[..., :3, 3]  # (N, L, 3, 3), (N, L, 3)
        z = (R @ self.axes[..., None])[..., 0]
        linear = np.where(self.revolute[:, None], cross(z, arms), z)
        angular = np.where(self.revolute[:, None], z, 0.0)
        by_moving = np.concatenate([linear, angular], axis=-1).swapaxes(1, 2)  # (N, 6, L)
        if nominal is None or self.sag is None:
            return tip, by_moving @ self.coupling
        slopes = self._sag_slopes(nominal)  # (N, L, 6, L)
        shifts = frames[..., :3, :3] @ slopes[..., :3, :]
        turns = R @ _right_jacobian(twists[..., 3:]) @ slopes[..., 3:, :]  # (N, L, 3, L)
        moved = shifts + cross(turns.swapaxes(2, 3), arms[:, :, None]).swapaxes(2, 3)
        return tip, (by_moving + np.concatenate([moved.sum(1), turns.sum(1)], axis=1)) @ self.coupling

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
        """Frames after and before their error twists (N, n_all, 4, 4), and tips (N, 4, 4)."""
        offsets = self.offsets if twists is None else self.offsets @ transforms(twists)
        locals_ = offsets @ motions
        poses = [np.broadcast_to(self.start, (len(motions), 4, 4))]
        for joint in range(motions.shape[1]):
            poses.append(poses[-1] @ locals_[:, joint])
        before = np.stack(poses[:-1], axis=1)
        frames = before @ self.offsets
        turned = frames if twists is None else before @ offsets
        return turned, frames, poses[-1] @ self.tip

    def _nominal_frames(self, motions: Array) -> Array:
        """Nominal joint frames and the tip in the robot's base: (N, n_all + 1, 4, 4)."""
        offsets = self._sag.offsets
        poses = [np.broadcast_to(offsets[0], (len(motions), 4, 4))]
        steps = motions @ offsets[1:]
        for joint in range(motions.shape[1]):
            poses.append(poses[-1] @ steps[:, joint])
        return np.stack(poses, axis=1)

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
        sag, (N, F), L = self._sag, nominal.shape[:2], nominal.shape[1] - 1
        e, m = self._loads(nominal)
        z = (nominal[:, :-1, :3, :3] @ self.axes[..., None])[..., 0]  # (N, L, 3)
        origins = nominal[..., :3, 3]
        spun = np.where(self.revolute[:, None], z, 0.0)[:, None]  # (N, 1, L, 3)
        arms = origins[:, :, None] - origins[:, None, :-1]  # (N, F, L, 3)
        moved = np.where(self.revolute[:, None], cross(z[:, None], arms), z[:, None])
        moved = moved * self._before[None, :, :, None]  # frame f moves with joints before it
        slopes_m = (sag.moments @ moved.swapaxes(2, 3).reshape(N, 3 * F, L)).reshape(*e.shape, L)
        slopes_e = cross(spun, e[:, :, None]) * self._before[sag.joints][None, :, :, None]  # (N, K, L, 3)
        amounts = np.einsum("nkc,nkcl->nkl", e, slopes_m) + np.einsum("nklc,nkc->nkl", slopes_e, m)
        return (sag.directions.T @ amounts).reshape(N, L, 6, L)

    @property
    def _sag(self) -> Sag:
        if self.sag is None:
            raise RuntimeError("this chain has no gravity sag")
        return self.sag

    @cached_property
    def _before(self) -> Array:
        """(F, L) 1 where joint l moves frame f."""
        L = len(self.axes)
        return (np.arange(L)[None] < np.arange(L + 1)[:, None]).astype(float)

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
