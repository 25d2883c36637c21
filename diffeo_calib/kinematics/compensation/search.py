"""Two searches for the nearest point that a box of joint values allows.

The fast one takes steps with one approximate inverse per row, improved as they go. A calibrated robot differs from its
geometric model by about 1e-3, so that steps with the geometric Jacobian contract the error by 100 each, and a Broyden
update of rank one improves the inverse from step to step. Rows for which this is no good (a joint leaves its box, the
error does not shrink fast) are given up.

The careful one minimises, for every row on its own,

    F(q) = f(q) + MOTION_COST / 2 |q - start|_W^2     over low <= q <= high,

f from the targets, W the inverse mobilities. The second term is worth less than 0.2 um for a motion of a degree: it
decides between commands that are equally good. Newton steps with the exact Hessian in a trust region (Levenberg and
Marquardt; K. Madsen, H. Nielsen, O. Tingleff, "Methods for non-linear least squares problems", 2004), each the exact
minimum of its quadratic model in the box.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffeo_calib.kinematics.compensation.targets import Array, Targets, ToolFunctions

REACHED_MISS = 5e-10
"""Miss in m and rad at which a row counts as reached: half of what is promised."""
MOST_STEPS = 8
SLOWEST_CONTRACTION = 0.3
"""A step must leave less than this fraction of the error."""
RELATIVE_RIDGE = 1e-12
"""Part of the trace that keeps singular matrices invertible; rows where it matters are given up."""


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

    def holds(self, q: Array) -> Array:
        """(N,) whether all joints are inside."""
        return np.all((q >= self.low) & (q <= self.high), axis=1)


def reached(targets: Targets, poses: Array) -> Array:
    """(N,) whether each tool is at its target."""
    distance, angle = targets.misses(poses)
    return np.all((distance if angle is None else np.maximum(distance, angle)) <= REACHED_MISS, axis=1)


def chord_search(
    tool: ToolFunctions, targets: Targets, q: Array, box: Box, *, slopes: Array, poses: Array
) -> tuple[Array, Array, Array]:
    """Search targets that are near.

    Args:
        tool: the kinematics.
        targets: N targets. q: (N, n) where to start, inside the box.
        box: its mobility weighs the joints of redundant robots, 0 holds a joint fixed.
        slopes: (N, k, n) of the targets' errors at ``q``, at least roughly. poses: (N, T, 4, 4) of the tools at ``q``.

    Returns:
        (N, n) joint values, (N, T, 4, 4) poses of the tools, (N,) whether they reach the targets.
    """
    q, poses = q.copy(), poses.copy()
    done = reached(targets, poses)
    todo = np.flatnonzero(~done)
    inverse = _right_inverse(slopes[todo], box.mobility[todo])
    goal, room = targets.take(todo), box.take(todo)
    error = goal.errors(poses[todo])
    for _ in range(MOST_STEPS):
        if not len(todo):
            break
        step = (inverse @ error[:, :, None])[:, :, 0]
        keep = room.holds(q[todo] + step)
        todo, goal, room, inverse = todo[keep], goal.take(keep), room.take(keep), inverse[keep]
        error, step = error[keep], step[keep]
        if not len(todo):
            break
        at = q[todo] + step
        seen = tool.poses(at)
        fresh = goal.errors(seen)
        arrived = reached(goal, seen)
        good = arrived | (np.linalg.norm(fresh, axis=1) < SLOWEST_CONTRACTION * np.linalg.norm(error, axis=1))
        q[todo[good]], poses[todo[good]], done[todo[arrived]] = at[good], seen[good], True
        keep = good & ~arrived
        inverse = _updated(inverse[keep], step[keep], (error - fresh)[keep])
        todo, goal, room, error = todo[keep], goal.take(keep), room.take(keep), fresh[keep]
    return q, poses, done


def _right_inverse(slopes: Array, mobility: Array) -> Array:
    """(N, n, k) inverse of least motion: M J^T (J M J^T)^-1 with the mobilities M."""
    moved = mobility[:, :, None] * slopes.swapaxes(1, 2)
    if slopes.shape[1] <= slopes.shape[2]:
        return np.linalg.solve(_regular(slopes @ moved), moved.swapaxes(1, 2)).swapaxes(1, 2)
    return np.linalg.solve(_regular(moved @ slopes), moved)


def _regular(square: Array) -> Array:
    """Symmetric matrices (N, k, k) with a small multiple of the identity added."""
    size = square.shape[1]
    return square + (RELATIVE_RIDGE * np.trace(square, axis1=1, axis2=2) + 1e-300)[:, None, None] * np.eye(size)


def _updated(inverse: Array, step: Array, gain: Array) -> Array:
    """Broyden's good update, after which the inverse takes the gain to the step that made it."""
    guess = (inverse @ gain[:, :, None])[:, :, 0]
    along = np.einsum("nj,njk->nk", step, inverse)
    scale = np.einsum("nk,nk->n", along, gain)
    safe = np.abs(scale) > 0.1 * np.einsum("nj,nj->n", step, step)
    factor = np.where(safe, 1.0 / np.where(safe, scale, 1.0), 0.0)
    return inverse + ((step - guess) * factor[:, None])[:, :, None] * along[:, None, :]


MOTION_COST = 1e-10
"""m^2 per rad^2 (or per m^2 of a slide)."""
IMMOBILE_MOBILITY = 1e-13
"""Mobility of joints that must not move: they give way by less than a microradian for a miss of 0.1 m."""
MOST_NEWTON_STEPS = 100
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
    """Search the nearest point of every row, from ``q`` (N, n) inside the box; returns as :func:`chord_search`."""
    search = _Search(tool, targets, q, box, tool.poses(q) if poses is None else poses)
    for _ in range(MOST_NEWTON_STEPS):
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
