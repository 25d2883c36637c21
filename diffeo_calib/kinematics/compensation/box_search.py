"""The careful search: the nearest point that a box of joint values allows.

Minimises, for every row on its own,

    F(q) = f(q) + MOTION_COST / 2 |q - start|_W^2     over low <= q <= high,

f from the targets, W the inverse mobilities. The second term is worth less than 0.2 um for a motion of a degree: it
decides between commands that are equally good. Newton steps with the exact Hessian in a trust region (Levenberg and
Marquardt; K. Madsen, H. Nielsen, O. Tingleff, "Methods for non-linear least squares problems", 2004), each the exact
minimum of its quadratic model in the box.

Where the joints may be: their limits, and how far a correction may move them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import radians

import numpy as np

from diffeo_calib.common.checks import positive, real_tensor
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.compensation.chord import Box, chord_search, reached
from diffeo_calib.kinematics.compensation.kinematics import ToolFunctions
from diffeo_calib.kinematics.compensation.targets import Array, Targets
from diffeo_calib.robots.tree import Tree

MOTION_COST = 1e-10
"""m^2 per rad^2 (or per m^2 of a slide)."""
IMMOBILE_MOBILITY = 1e-13
"""Mobility of joints that must not move: they give way by less than a microradian for a miss of 0.1 m."""
MOST_STEPS = 100
SETTLED_STEP = 1e-12
"""No joint moves by more than this any more, rad or m."""
NEAR_TARGET_M = 1e-4
"""Errors below this, in m, are worth a last search for the target itself."""
LEAST_DAMPING, START_DAMPING = 1e-12, 1e-9
ROUNDING = 1e-15
SMALLEST_GAIN = 1e-20
"""Steps that promise less than this, in m^2, are the last."""


def box_search(
    tool: ToolFunctions, targets: Targets, q: Array, box: Box, *, poses: Array | None = None
) -> tuple[Array, Array, Array]:
    """Search the nearest point of every row, from ``q`` (N, n) inside the box.

    Returns:
        (N, n) joint values, (N, T, 4, 4) poses of the tools, (N,) whether they reach the targets.
    """
    search = _Search(tool, targets, q, box, tool.poses(q) if poses is None else poses)
    for _ in range(MOST_STEPS):
        if not len(search.todo):
            break
        search.step()
    return _finished(tool, targets, search.q, box, search.poses)


class _Search:
    """State of all rows; ``todo`` are those that still move."""

    def __init__(self, tool: ToolFunctions, targets: Targets, q: Array, box: Box, poses: Array) -> None:
        self.tool, self.targets, self.box = tool, targets, box
        self.q, self.poses = q.copy(), poses.copy()
        count, n = q.shape
        mobility = np.where(box.mobility > 0, np.maximum(box.mobility, 1e-9), IMMOBILE_MOBILITY)
        self.pull = MOTION_COST / mobility  # (N, n)
        self.cost = self._cost(np.arange(count), q, poses)
        self.damping, self.growth = np.full(count, START_DAMPING), np.full(count, 2.0)
        self.gradient, self.hessian = np.empty((count, n)), np.empty((count, n, n))
        self.todo = np.flatnonzero(~reached(targets, poses))
        self._linearise(self.todo)

    def step(self) -> None:
        """One step of every row that still moves."""
        rows, box = self.todo, self.box.take(self.todo)
        damped = self.hessian[rows] + self.damping[rows, None, None] * np.eye(self.q.shape[1])
        at, slope = self.q[rows], self.gradient[rows]
        step = box_minimum(damped, slope, box.low - at, box.high - at)
        moved = np.clip(at + step, box.low, box.high)
        seen = self.tool.poses(moved)
        cost = self._cost(rows, moved, seen)
        noise = ROUNDING * self.cost[rows]
        promised = -np.einsum("ni,ni->n", slope + 0.5 * (damped @ step[:, :, None])[:, :, 0], step)
        gain = (self.cost[rows] - cost + noise) / (promised + noise + 1e-300)
        good = gain > 1e-4
        taken = rows[good]
        self.q[taken], self.poses[taken], self.cost[taken] = moved[good], seen[good], cost[good]
        self._adapt(rows, gain)
        still = np.abs(step).max(1, initial=0.0) <= SETTLED_STEP
        still |= promised <= np.maximum(SMALLEST_GAIN, noise)
        still |= good & reached(self.targets.take(rows), seen)
        self._linearise(rows[good & ~still])
        self.todo = rows[~still]

    def _adapt(self, rows: Array, gain: Array) -> None:
        """Less damping after good steps, more after bad ones (Nielsen's rule)."""
        good, damping, growth = gain > 1e-4, self.damping[rows], self.growth[rows]
        factor = np.maximum(1.0 / 3.0, 1.0 - (2.0 * np.minimum(gain, 1.0) - 1.0) ** 3)
        self.damping[rows] = np.maximum(np.where(good, damping * factor, damping * growth), LEAST_DAMPING)
        self.growth[rows] = np.where(good, 2.0, 2.0 * growth)

    def _linearise(self, rows: Array) -> None:
        """Gradient, and the Hessian made positive definite."""
        if not len(rows):
            return
        targets, poses, pull, box = self.targets.take(rows), self.poses[rows], self.pull[rows], self.box.take(rows)
        jacobian, q = self.tool.jacobian(self.q[rows]), self.q[rows]
        slopes = targets.slopes(jacobian)
        slope = pull * (q - box.start) - (slopes.swapaxes(1, 2) @ targets.errors(poses)[:, :, None])[:, :, 0]
        hessian = slopes.swapaxes(1, 2) @ slopes + pull[:, :, None] * np.eye(pull.shape[1])
        if self.tool.serial:
            hessian = hessian + targets.curvature(jacobian, poses)
        blocked = ((q <= box.low) & (slope > 0)) | ((q >= box.high) & (slope < 0))
        self.gradient[rows], self.hessian[rows] = slope, _convex(hessian, blocked)

    def _cost(self, rows: Array, q: Array, poses: Array) -> Array:
        away = q - self.box.start[rows]
        return self.targets.take(rows).cost(poses) + 0.5 * (self.pull[rows] * away * away).sum(1)


def _convex(hessian: Array, blocked: Array) -> Array:
    """Hessians (N, n, n) with their negative curvatures reversed, each joint that its box holds (N, n) on its own."""
    apart = blocked[:, :, None] | blocked[:, None, :]
    diagonal = np.abs(np.einsum("nii->ni", hessian)) + MOTION_COST
    split = np.where(apart, diagonal[:, :, None] * np.eye(hessian.shape[1]), hessian)
    values, vectors = np.linalg.eigh(split)
    bent = np.flatnonzero(values[:, 0] < MOTION_COST)
    if len(bent):
        sizes = np.maximum(np.abs(values[bent]), MOTION_COST)
        split[bent] = (vectors[bent] * sizes[:, None, :]) @ vectors[bent].swapaxes(1, 2)
    return split


def _finished(tool: ToolFunctions, targets: Targets, q: Array, box: Box, poses: Array) -> tuple[Array, Array, Array]:
    """The cost of motion keeps rows a little away from their targets: go there with the joints that are free."""
    done = reached(targets, poses)
    rows = np.flatnonzero(~done & (np.linalg.norm(targets.errors(poses), axis=1) < NEAR_TARGET_M))
    if len(rows):
        inside, goal = box.take(rows), targets.take(rows)
        free = (q[rows] > inside.low) & (q[rows] < inside.high)
        slopes = goal.slopes(tool.jacobian(q[rows]))
        room = Box(inside.start, inside.low, inside.high, inside.mobility * free)
        moved, seen, there = chord_search(tool, goal, q[rows], room, slopes=slopes, poses=poses[rows])
        rows, moved, seen = rows[there], moved[there], seen[there]
        q[rows], poses[rows], done[rows] = moved, seen, True
    return q, poses, done


def box_minimum(H: Array, g: Array, low: Array, high: Array) -> Array:
    """Minimise 1/2 s^T H s + g^T s over low <= s <= high, row by row.

    Starts at s = 0 and moves to the minimum on the face of the box that it is on; a bound that is hit on the way joins
    the face; at the minimum of a face the bound whose multiplier is most wrong leaves it. Finite, since the function
    falls from face to face (J. Nocedal, S. Wright, "Numerical optimization", 2006, section 16.5).

    Args:
        H: (N, n, n) positive definite. g: (N, n). low: (N, n) at most 0. high: (N, n) at least 0.

    Returns:
        (N, n).
    """
    count, n = g.shape
    s = np.zeros_like(g)
    fixed = ((low >= 0) & (g > 0)) | ((high <= 0) & (g < 0)) | (low >= high)
    todo = np.arange(count)
    for _ in range(10 * n):
        moved, held, open_ = _face_step(H[todo], g[todo], low[todo], high[todo], s=s[todo], fixed=fixed[todo])
        s[todo], fixed[todo] = moved, held
        todo = todo[open_]
        if not len(todo):
            break
    return s


def _face_step(H: Array, g: Array, low: Array, high: Array, *, s: Array, fixed: Array) -> tuple[Array, Array, Array]:
    """One step on the faces: new s, new fixed joints, and whether a row goes on."""
    free = ~fixed
    reduced = H * (free[:, :, None] & free[:, None, :]) + fixed[:, :, None] * np.eye(s.shape[1])
    slope = g + (H @ s[:, :, None])[:, :, 0]
    way = -np.linalg.solve(reduced, (slope * free)[:, :, None])[:, :, 0] * free
    end = np.where(way > 0, high, low)
    room = np.where(way != 0, (end - s) / np.where(way != 0, way, 1.0), np.inf)
    share = np.minimum(room.min(1), 1.0)[:, None]
    hit = free & (room <= share) & (share < 1.0)
    s = np.where(hit, end, s + share * way)
    blocked = hit.any(1)
    slope = g + (H @ s[:, :, None])[:, :, 0]
    wrong = np.where(fixed & (low < high), np.where(s <= low, -slope, slope), 0.0)
    worst = wrong.argmax(1)
    scale = np.abs(g).max(1) + 1e-300
    leave = ~blocked & (wrong.max(1) > 1e-13 * scale)
    fixed = fixed | hit
    fixed[np.flatnonzero(leave), worst[leave]] = False
    return s, fixed, blocked | leave


TURN_BOUND = radians(1.0)
"""Default bound of a correction of a turning joint, rad."""
SLIDE_BOUND = 0.02
"""Default bound of a correction of a slide, m."""
LIMIT_SLACK = 1e-9
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
        outside = ((before < self.least - LIMIT_SLACK) | (before > self.most + LIMIT_SLACK)).any(1)
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
    return usual if bound is None else by_joint(chain, bound, "bound", usual)


def by_joint(chain: Tree, value: object, name: str, usual: Array) -> Array:
    """A positive number for all turning joints, ``usual`` (n,) for the others, or one number for each joint: (n,)."""
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
