"""The nearest point that a box of joint values allows, for every row on its own.

Minimises

    F(q) = f(q) + MOTION_COST / 2 |q - start|_W^2     over low <= q <= high,

f from the targets, W the inverse mobilities. The second term is worth less than 0.2 um for a motion of a degree: it
decides between commands that are equally good. Newton steps in a trust region (Levenberg and Marquardt; K. Madsen,
H. Nielsen, O. Tingleff, "Methods for non-linear least squares problems", 2004), each the minimum of its quadratic
model in the box. A calibrated robot differs from its geometric model by about 1e-3, so that steps with the geometric
Jacobian, which is quick, contract the error by 100 each: they come first, the exact Hessian where they do not suffice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from diffeo_calib.kinematics.compensation.targets import Array, Targets, ToolFunctions

REACHED_MISS = 5e-10
"""Miss in m and rad at which a row counts as reached: half of what is promised."""
MOTION_COST = 1e-10
"""m^2 per rad^2 (or per m^2 of a slide)."""
LEAST_MOBILITY = 1e-9
QUICK_STEPS, MOST_NEWTON_STEPS, LAST_STEPS = 6, 100, 2
SLOWEST_CONTRACTION = 0.1
"""A quick step must leave less than this fraction of the squared miss, which motion has no part in."""
SETTLED_STEP = 1e-12
"""No joint moves by more than this any more, rad or m."""
NEAR_TARGET_M = 1e-4
"""Errors below this, in m, are worth a last search for the target itself."""
LEAST_DAMPING, START_DAMPING = 1e-12, 1e-9
ROUNDING = 1e-15
SMALLEST_GAIN = 1e-20
"""Steps that promise less than this, in m^2, are the last."""


@dataclass(eq=False)
class Box:
    """Where the joints may be, and what their motion costs."""

    start: Array  # (N, n) commands before the correction, rad or m
    low: Array  # (N, n) what the joints' limits and the bound of motion leave, to high
    high: Array
    mobility: Array  # (N, n) motion of a joint where it costs nothing extra; 0 for a joint that must not move

    def take(self, rows: Array) -> Box:
        """The boxes of some rows."""
        return Box(self.start[rows], self.low[rows], self.high[rows], self.mobility[rows])


def reached(targets: Targets, poses: Array) -> Array:
    """(N,) whether each tool is at its target."""
    distance, angle = targets.misses(poses)
    return np.all((distance if angle is None else np.maximum(distance, angle)) <= REACHED_MISS, axis=1)


def box_search(tool: ToolFunctions, targets: Targets, q: Array, box: Box) -> tuple[Array, Array, Array]:
    """Search the nearest point of every row.

    Args:
        tool: the kinematics. targets: N targets. q: (N, n) where to start, inside the box.

    Returns:
        (N, n) joint values, (N, T, 4, 4) poses of the tools, (N,) whether they reach the targets.
    """
    search = Search(tool, targets, q, box)
    for exact, most in ((False, QUICK_STEPS), (True, MOST_NEWTON_STEPS)):
        search.begin(exact=exact)
        for _ in range(most):
            if not len(search.todo):
                break
            search.step()
        search.finish()
    return search.q, search.poses, reached(targets, search.poses)


class Search:
    """State of all rows; ``todo`` are those that still move."""

    def __init__(self, tool: ToolFunctions, targets: Targets, q: Array, box: Box) -> None:
        held = box.mobility <= 0
        box = replace(box, low=np.where(held, q, box.low), high=np.where(held, q, box.high))
        self.tool, self.targets, self.box = tool, targets, box
        self.q, self.poses = q.copy(), tool.poses(q)
        count, n = q.shape
        self.pull = MOTION_COST / np.maximum(box.mobility, LEAST_MOBILITY)  # (N, n)
        self.cost = self._cost(np.arange(count), q, self.poses)
        self.gradient, self.hessian = np.empty((count, n)), np.empty((count, n, n))

    def begin(self, *, exact: bool) -> None:
        """Start with the rows that are not there, with the exact Hessian or with the quick one."""
        self.exact, count = exact, len(self.q)
        self.damping, self.growth = np.full(count, START_DAMPING), np.full(count, 2.0)
        self.todo = np.flatnonzero(~reached(self.targets, self.poses))
        self._linearise(self.todo)

    def step(self) -> None:
        """One step of every row that still moves."""
        rows, box = self.todo, self.box.take(self.todo)
        weights = self.pull[rows] / MOTION_COST
        damped = self.hessian[rows] + (self.damping[rows, None] * weights)[:, :, None] * np.eye(self.q.shape[1])
        at, slope = self.q[rows], self.gradient[rows]
        step = _step_in_box(damped, slope, box.low - at, box.high - at)
        moved = np.clip(at + step, box.low, box.high)
        poses = self.tool.poses(moved)
        cost = self._cost(rows, moved, poses)
        goal, before = self.targets.take(rows), self.cost[rows]
        missed = goal.cost(self.poses[rows])
        noise = ROUNDING * before
        promised = -np.einsum("ni,ni->n", slope + 0.5 * (damped @ step[:, :, None])[:, :, 0], step)
        gain = (before - cost + noise) / (np.abs(promised) + noise + 1e-300)
        good = gain > 1e-4
        taken = rows[good]
        self.q[taken], self.poses[taken], self.cost[taken] = moved[good], poses[good], cost[good]
        damping, growth = self.damping[rows], self.growth[rows]  # by Nielsen's rule
        factor = np.maximum(1.0 / 3.0, 1.0 - (2.0 * np.minimum(gain, 1.0) - 1.0) ** 3)
        self.damping[rows] = np.maximum(np.where(good, damping * factor, damping * growth), LEAST_DAMPING)
        self.growth[rows] = np.where(good, 2.0, 2.0 * growth)
        still = np.abs(step).max(1, initial=0.0) <= SETTLED_STEP
        still |= np.abs(promised) <= np.maximum(SMALLEST_GAIN, noise)
        still |= good & reached(goal, poses)
        if not self.exact:
            still |= goal.cost(poses) > SLOWEST_CONTRACTION * missed
        self._linearise(rows[good & ~still])
        self.todo = rows[~still]

    def _linearise(self, rows: Array) -> None:
        """Gradient, and the Hessian made positive definite."""
        if not len(rows):
            return
        targets, poses, pull, box = self.targets.take(rows), self.poses[rows], self.pull[rows], self.box.take(rows)
        q = self.q[rows]
        jacobian = self.tool.jacobian(q) if self.exact else self.tool.rough(q)
        slopes = targets.slopes(jacobian)
        slope = pull * (q - box.start) - (slopes.swapaxes(1, 2) @ targets.errors(poses)[:, :, None])[:, :, 0]
        hessian = slopes.swapaxes(1, 2) @ slopes + pull[:, :, None] * np.eye(pull.shape[1])
        if self.exact:
            if self.tool.serial:
                hessian = hessian + targets.curvature(jacobian, poses)
            blocked = ((q <= box.low) & (slope > 0)) | ((q >= box.high) & (slope < 0))
            hessian = _convex(hessian, blocked)
        self.gradient[rows], self.hessian[rows] = slope, hessian

    def _cost(self, rows: Array, q: Array, poses: Array) -> Array:
        away = q - self.box.start[rows]
        return self.targets.take(rows).cost(poses) + 0.5 * (self.pull[rows] * away * away).sum(1)

    def finish(self) -> None:
        """The cost of motion keeps rows a little away from their targets: go there with the joints that are free."""
        near = np.linalg.norm(self.targets.errors(self.poses), axis=1) < NEAR_TARGET_M
        rows = np.flatnonzero(near & ~reached(self.targets, self.poses))
        if not len(rows):
            return
        goal, box, q, poses = self.targets.take(rows), self.box.take(rows), self.q[rows], self.poses[rows]
        jacobian, ease = (
            self.tool.jacobian if self.exact else self.tool.rough,
            np.sqrt(box.mobility) * ((q > box.low) & (q < box.high)),
        )
        for _ in range(LAST_STEPS):
            inverse = ease[:, :, None] * np.linalg.pinv(goal.slopes(jacobian(q)) * ease[:, None])
            q = np.clip(q + (inverse @ goal.errors(poses)[:, :, None])[:, :, 0], box.low, box.high)
            poses = self.tool.poses(q)
            there = reached(goal, poses)
            if there.all():
                break
        self.q[rows[there]], self.poses[rows[there]] = q[there], poses[there]


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


def _step_in_box(H: Array, g: Array, low: Array, high: Array) -> Array:
    """(N, n) minimum of 1/2 s^T H s + g^T s in a box: all joints change to the end that they lead to, or away from it.

    After n such steps one joint at a time, with which the search ends (J. Judice, F. Pires, "A block principal pivoting
    algorithm for large-scale strictly monotone linear complementarity problems", 1994).
    """
    n, held, side = g.shape[1], low >= high, np.zeros(g.shape, dtype=np.int64)
    for turn in range(5 * n):
        free = (side == 0) & ~held
        s = np.where(free, 0.0, np.where(side > 0, high, low))
        reduced = H * (free[:, :, None] & free[:, None, :]) + ~free[:, :, None] * np.eye(n)
        s -= np.linalg.solve(reduced, ((g + (H @ s[:, :, None])[:, :, 0]) * free)[:, :, None])[:, :, 0]
        wish = s - (g + (H @ s[:, :, None])[:, :, 0]) / np.einsum("nii->ni", H)
        wished = np.where(wish > high, 1, np.where(wish < low, -1, 0))
        wrong = (wished != side) & ~held
        if not wrong.any():
            break
        side = np.where(wrong & ((turn < n) | (wrong.cumsum(1) == 1)), wished, side)
    return np.clip(s, low, high)
