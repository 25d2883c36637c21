"""Where the joints may be: their limits, and how far a correction may move them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import radians

import numpy as np

from diffeo_calib.common.checks import positive, real_tensor
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.compensation.targets import Array
from diffeo_calib.robots.tree import Tree

TURN_BOUND = radians(1.0)
"""Default bound of a correction of a turning joint, rad."""
SLIDE_BOUND = 0.02
"""Default bound of a correction of a slide, m."""
SLACK = 1e-9
"""Starts beyond a limit by less than this, rad or m, come from rounding."""


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of the active joints, including those of the mimic joints that one joint drives.

    Args:
        low: (n,) rad or m. high: (n,).
        matrix: (k, n) of mimic joints that several joints drive: least <= matrix q <= most.
        least: (k,). most: (k,).
    """

    low: Array
    high: Array
    matrix: Array
    least: Array
    most: Array

    def within(self, start: Array, q: Array) -> Array:
        """Commands on the way from ``start`` to ``q`` (N, n) where the mimic joints of several joints stay in limits.

        NaN where they are beyond their limits at the start already.
        """
        before, change = start @ self.matrix.T, (q - start) @ self.matrix.T  # (N, k)
        outside = ((before < self.least - SLACK) | (before > self.most + SLACK)).any(1)
        end = np.where(change > 0, self.most, self.least)
        share = np.where(change != 0, (end - before) / np.where(change != 0, change, 1.0), np.inf)
        share = np.clip(share.min(1, initial=1.0), 0.0, 1.0)
        kept = np.where((share < 1.0)[:, None], start + share[:, None] * (q - start), q)
        return np.where(outside[:, None], np.nan, kept)


def joint_limits(chain: Tree, given: object) -> Limits:
    """The limits of a chain, or those that are given for the active joints, (n, 2) in rad or m.

    Raises:
        InputError: another shape, NaN, or a lower limit above the upper one.
    """
    active = chain.limits.numpy() if given is None else _given_limits(chain, given)
    low, high = active[:, 0].copy(), active[:, 1].copy()
    coupling, constant = chain.coupling.numpy(), chain.coupling_offset.numpy()
    moving = [joint for joint in chain.joints if joint.kind != "fixed"]
    shared = []
    for row, joint in enumerate(moving):
        drivers = np.flatnonzero(coupling[row])
        if joint.mimic is None or not len(drivers):
            continue
        if len(drivers) > 1:
            shared.append(row)
            continue
        driver, slope = drivers[0], coupling[row, drivers[0]]
        ends = sorted([(joint.lower - constant[row]) / slope, (joint.upper - constant[row]) / slope])
        low[driver], high[driver] = max(low[driver], ends[0]), min(high[driver], ends[1])
    least = np.array([moving[row].lower - constant[row] for row in shared])
    most = np.array([moving[row].upper - constant[row] for row in shared])
    return Limits(low, high, coupling[shared], least, most)


def largest_motion(chain: Tree, bound: object, scale: float = 1.0) -> Array:
    """(n,) how far a correction may move each joint, rad or m; ``scale`` multiplies the defaults.

    Raises:
        InputError: not a positive number, or one for each joint.
    """
    usual = scale * np.where(np.array(chain.periodic), TURN_BOUND, SLIDE_BOUND)
    return usual if bound is None else _by_joint(chain, bound, "bound", usual)


def rates(chain: Tree, rate: object, usual: Array) -> Array:
    """(n,) how fast a correction may change; ``usual`` (n,) is taken for slides if one number is given.

    Raises:
        InputError: not a positive number, or one for each joint.
    """
    return _by_joint(chain, rate, "rate", usual)


def _by_joint(chain: Tree, value: object, name: str, usual: Array) -> Array:
    """One number for all turning joints, or one for each joint."""
    if np.ndim(value) == 0:  # pyright: ignore[reportArgumentType]
        return np.where(np.array(chain.periodic), float(positive(value, name)), usual)
    return positive(value, name, (chain.n,)).numpy().copy()


def mobilities(chain: Tree, weights: object, tips: Sequence[str], aimed: Array) -> Array:
    """(N, n) inverse of the cost of each joint's motion; 0 by default for joints that move no tip with a target.

    Args:
        chain: n joints. weights: (n,) or None. tips: T names. aimed: (N, T) True where a tip has a target.

    Raises:
        InputError: not one positive number for each joint.
    """
    if weights is None:
        coupling = chain.coupling.numpy()
        moving = np.stack([(coupling[chain.path_to(tip).numpy()] != 0).any(0) for tip in tips])  # (T, n)
        return np.any(aimed[:, :, None] & moving, axis=1).astype(np.float64)
    return np.tile(1.0 / positive(weights, "weights", (chain.n,)).numpy(), (len(aimed), 1))


def _given_limits(chain: Tree, given: object) -> Array:
    fix = "pass the lower and the upper limit of every joint of `robot.joint_names`, infinite for none"
    values = real_tensor(given, "limits").detach().cpu().numpy()
    if values.shape != (chain.n, 2):
        raise InputError.of("`limits` has the wrong shape", expected=f"({chain.n}, 2)", got=values.shape, fix=fix)
    wrong = ~(values[:, 0] <= values[:, 1])
    if wrong.any():
        joint = int(np.flatnonzero(wrong)[0])
        what = f"`limits` of joint '{chain.joint_names[joint]}'"
        raise InputError.of(what, expected="lower <= upper", got=values[joint].tolist(), fix=fix)
    return values
