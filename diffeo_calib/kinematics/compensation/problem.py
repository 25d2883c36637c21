"""The nearest command that the joints of every row allow, and why a target is not reached.

Minimises

    F(q) = f(q) + MOTION_COST / 2 |q - start|_W^2     over low <= q <= high,

f from the targets, W the inverse mobilities. The second term is worth less than 0.2 um for a motion of a degree: it
decides between commands that are equally good. Newton steps in a trust region (Levenberg and Marquardt; K. Madsen,
H. Nielsen, O. Tingleff, "Methods for non-linear least squares problems", 2004), each the minimum of its quadratic
model in the box. A calibrated robot differs from its geometric model by about 1e-3, so that steps with the geometric
Jacobian, which is quick, contract the error by 100 each: they come first, the exact Hessian where they do not suffice.

A target is not reached because of the limit of a joint, a singularity, or because it is out of reach.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from math import radians
from typing import NamedTuple

import numpy as np

from diffeo_calib.common.checks import positive, real_tensor
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.compensation.targets import Array, Targets, ToolFunctions
from diffeo_calib.robots.tree import Tree

REACHED_MISS = 5e-10  # miss in m and rad at which a row counts as reached: half of what is promised
MOTION_COST = 1e-10  # m^2 per rad^2 (or per m^2 of a slide)
LEAST_MOBILITY = 1e-9
QUICK_STEPS, MOST_NEWTON_STEPS, LAST_STEPS = 6, 100, 2
SLOWEST_CONTRACTION = 0.1
"""A quick step must leave less than this fraction of the squared miss, which motion has no part in."""
SETTLED_STEP = 1e-12  # no joint moves by more than this any more, rad or m
NEAR_TARGET_M = 1e-4  # errors below this, in m, are worth a last search for the target itself
LEAST_DAMPING, START_DAMPING = 1e-12, 1e-9
ROUNDING = 1e-15
SMALLEST_GAIN = 1e-20  # steps that promise less than this, in m^2, are the last


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


TURN_BOUND = radians(1.0)  # default bound of a correction of a turning joint, rad
SLIDE_BOUND = 0.02  # default bound of a correction of a slide, m
LIMIT_SLACK = 1e-9  # starts beyond a limit by less than this, rad or m, come from rounding


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of the active joints, including those of the mimic joints that one joint drives."""

    low: Array  # (n,) rad or m
    high: Array  # (n,)
    matrix: Array  # (k, n) of mimic joints that several joints drive: least <= matrix q <= most
    least: Array  # (k,)
    most: Array  # (k,)

    def within(self, start: Array, q: Array) -> Array:
        """Commands ``q`` (N, n), the start of rows whose mimic joints of several joints would leave their limits there.

        NaN where they are beyond their limits at the start already.
        """

        def outside(at: Array, slack: float) -> Array:
            values = at @ self.matrix.T  # (N, k)
            return ((values < self.least - slack) | (values > self.most + slack)).any(1)[:, None]

        return np.where(outside(start, LIMIT_SLACK), np.nan, np.where(outside(q, 0.0), start, q))


def joint_limits(chain: Tree, given: object) -> Limits:
    """The limits of a chain, or those that are given for the active joints, (n, 2) in rad or m.

    Raises:
        InputError: another shape, NaN, or a lower limit above the upper one.
    """
    fix = "pass the lower and the upper limit of every joint of `robot.joint_names`, infinite for none"
    active = (chain.limits if given is None else real_tensor(given, "limits").detach().cpu()).numpy()
    if active.shape != (chain.n, 2):
        raise InputError.of("`limits` has the wrong shape", expected=f"({chain.n}, 2)", got=active.shape, fix=fix)
    wrong = ~(active[:, 0] <= active[:, 1])
    if wrong.any():
        joint = int(wrong.argmax())
        what = f"`limits` of joint '{chain.joint_names[joint]}'"
        raise InputError.of(what, expected="lower <= upper", got=active[joint].tolist(), fix=fix)
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


def by_joint(chain: Tree, value: object, name: str, usual: Array) -> Array:
    """A positive number for all turning joints, ``usual`` (n,) for the others and for None, or one for each: (n,)."""
    if value is None:
        return usual
    if np.ndim(value) == 0:  # pyright: ignore[reportArgumentType]
        return np.where(np.array(chain.periodic), float(positive(value, name)), usual)
    return positive(value, name, (chain.n,)).numpy().copy()


def mobilities(chain: Tree, weights: object, tips: Sequence[str], aimed: Array) -> Array:
    """(N, n) inverse of the cost of each joint's motion; 0 by default for joints that move no tip with a target.

    ``weights``: (n,) positive numbers, or None. ``tips``: T names. ``aimed``: (N, T) where a tip has a target.
    """
    if weights is None:
        coupling = chain.coupling.numpy()
        moving = np.stack([(coupling[chain.path_to(tip).numpy()] != 0).any(0) for tip in tips])  # (T, n)
        return np.any(aimed[:, :, None] & moving, axis=1).astype(np.float64)
    costs = positive(weights, "weights", (chain.n,)).numpy()
    return np.tile(costs.min() / costs, (len(aimed), 1))


ROWS_AT_ONCE = 4096


class Solution(NamedTuple):
    """Commands (N, n) in rad or m, poses of the tools (N, T, 4, 4), names of statuses (N,)."""

    q: Array
    poses: Array
    status: Array


@dataclass(frozen=True, eq=False)
class CompensationProblem:
    """N targets, the boxes of their commands, and the kinematics."""

    tool: ToolFunctions  # the kinematics
    targets: Targets  # N targets
    start: Array  # (N, n) rad or m
    limits: Limits  # of the joints, and of mimic joints
    bound: Array  # (n,) largest motion
    mobility: Array  # (N, n) inverse cost of each joint's motion, 0 if it must stay

    def started(self, rows: Array, start: Array) -> CompensationProblem:
        """Some of the rows (R,) from other starts (R, n)."""
        return replace(self, targets=self.targets.take(rows), start=start, mobility=self.mobility[rows])

    def box(self, rows: Array | slice = slice(None), *, limited: bool = True, scale: float = 1.0) -> Box:
        """The boxes of some rows, with or without the limits of the joints, with a multiple of the bound."""
        start = self.start[rows]
        motion = np.maximum(scale * self.bound - ROUNDING * (np.abs(start) + self.bound), 0.0)
        low, high = start - motion, start + motion
        if limited:
            low, high = np.maximum(low, self.limits.low), np.minimum(high, self.limits.high)
        return Box(start, low, high, self.mobility[rows])

    def solve(self) -> Solution:
        """The nearest command of every row on its own; none where a start is farther beyond a limit than the bound."""
        count, n = self.start.shape
        poses, status = (
            np.full((count, self.targets.tools, 4, 4), np.nan),
            np.full(count, Status.limit.value, dtype="U11"),
        )
        solution = Solution(np.full((count, n), np.nan), poses, status)
        box = self.box()
        possible = np.flatnonzero(np.all(box.low <= box.high, axis=1))
        for first in range(0, len(possible), ROWS_AT_ONCE):
            rows = possible[first : first + ROWS_AT_ONCE]
            begin, (q, reached, done) = self.started(rows, self.start[rows]), self._search(rows)
            solved = begin.keep_mimics(Solution(q, reached, begin._status(q, reached, done)))
            for whole, part in zip(solution, solved, strict=True):
                whole[rows] = part
        return solution

    def keep_mimics(self, solution: Solution) -> Solution:
        """Give up corrections that would take mimic joints of several joints beyond their limits."""
        if not len(self.limits.matrix):
            return solution
        q = self.limits.within(self.start, solution.q)
        poses, changed = solution.poses.copy(), (q != solution.q).any(1)
        poses[changed] = np.nan
        possible = changed & np.isfinite(q).all(1)
        poses[possible] = self.tool.poses(q[possible])
        return Solution(q, poses, np.where(changed, Status.limit.value, solution.status))

    def _status(self, q: Array, poses: Array, done: Array) -> Array:
        """(N,) names of the statuses of rows at ``q`` (N, n) whose ``done`` says that they are reached."""
        status = np.where(done, Status.reached.value, Status.unreachable.value)
        rows = np.flatnonzero(~done)
        freed = rows[((q[rows] <= self.limits.low) | (q[rows] >= self.limits.high)).any(1)]
        freed = freed[self._search(freed, limited=False)[2]] if len(freed) else freed
        status[freed] = Status.limit.value
        rest = np.setdiff1d(rows, freed)
        if len(rest):
            status[rest[self._singular(rest, q[rest], poses[rest])]] = Status.singular.value
        return status

    def _search(self, rows: Array, *, limited: bool = True, scale: float = 1.0) -> tuple[Array, Array, Array]:
        """:func:`box_search` of some rows, with or without the limits of the joints, with a multiple of the bound."""
        box = self.box(rows, limited=limited, scale=scale)
        return box_search(self.tool, self.targets.take(rows), np.clip(box.start, box.low, box.high), box)

    def _singular(self, rows: Array, q: Array, poses: Array) -> Array:
        """(R,) whether a singularity is to blame, at the start or at the nearest command ``q``."""
        start, targets = self.start[rows], self.targets.take(rows)
        near, singular = np.zeros((2, len(rows)), dtype=bool)
        for at, there in ((start, self.tool.poses(start)), (q, poses)):
            weak, open_ = self._blames(targets, at, there, start)
            near, singular = near | weak, singular | (weak & open_)
        doubtful = np.flatnonzero(near & ~singular)
        if len(doubtful):
            singular[doubtful] = self._search(rows[doubtful], scale=SECOND_SEARCH_BOUND_FACTOR)[2]
        return singular

    def _blames(self, targets: Targets, q: Array, poses: Array, start: Array) -> tuple[Array, Array]:
        """(R,) whether weak directions at ``q`` (R, n) alone keep the bound from sufficing; whether they lead there.

        Along the direction v of the joints that moves the tool least, the tool goes s t + c t^2 / 2 in the direction u.
        Where that bends back before it has gone as far as the target, the workspace probably ends before it.
        """
        U, s, Vt = np.linalg.svd(self._slopes(targets, q), full_matrices=False)
        error = targets.errors(poses) * targets.to_metres(self.tool.length)
        parts = (U.swapaxes(1, 2) @ error[:, :, None])[:, :, 0]  # (R, k)
        weak, motion = s <= WEAK_DIRECTION_SHARE * s[:, :1], parts / np.maximum(s, 1e-300)
        strong = (np.where(weak, 0.0, motion)[:, None, :] @ Vt)[:, 0] + (q - start) / self.bound
        each, main = np.arange(len(q)), np.where(weak, np.abs(motion), -1.0).argmax(1)
        v, u, far, slope = Vt[each, main], U[each, :, main], parts[each, main], s[each, main]
        way = v * self.bound  # of the joints
        ahead, behind = (self._slopes(targets, q + step * way) @ v[:, :, None] for step in (DIFFERENCE, -DIFFERENCE))
        bend = np.einsum("nk,nk->n", u, (ahead - behind)[:, :, 0] / (2.0 * DIFFERENCE))
        bent = np.abs(bend) > BENT_WORKSPACE_CURVATURE * self.tool.length * np.square(way).sum(1)
        ends = bent & (bend * far < 0) & (slope**2 < 2.0 * np.abs(bend * far))
        near = weak.any(1) & (np.abs(strong).max(1) <= 1.0) & (np.abs(far) <= s[:, 0])
        return near, ~ends

    def _slopes(self, targets: Targets, q: Array) -> Array:
        """(R, k, n) of the tool, in m, by motions of the joints in bounds."""
        return targets.slopes(self.tool.rough(q)) * targets.to_metres(self.tool.length)[:, None] * self.bound


WEAK_DIRECTION_SHARE = 0.1
"""A direction of the tool is weak below this part of the strongest one: it takes a large motion of the joints."""
BENT_WORKSPACE_CURVATURE = 0.05
"""The workspace may end at a singularity whose curvature is larger than this part of the typical length."""
SECOND_SEARCH_BOUND_FACTOR = 10.0  # multiple of the bound within which targets beyond the end are searched once more
DIFFERENCE = 1e-4  # step in rad or m of central differences of the Jacobian


class Status(str, Enum):
    """How a row ended.

    ``reached``: the model at the command is at the target, to 1e-9 m and 1e-9 rad.
    ``limit``: without the limits of its joints the robot would reach the target. Change the pose or the branch.
    ``singular``: the arm is near a singularity, where a small correction needs a larger motion than the bound allows;
    in other directions the bound would do. Accept the miss, raise the bound, or keep away from the singularity.
    ``unreachable``: the target is beyond the robot's reach, where the arm is stretched, for instance, or farther from
    the start than the bound allows. Check the target, its frame and unit, the tool, and the start.
    ``rate``: on a path, the corrections may not change fast enough to reach this row.

    Rows that are not reached have the command whose miss is smallest.
    """

    reached = "reached"
    limit = "limit"
    singular = "singular"
    unreachable = "unreachable"
    rate = "rate"

    def __str__(self) -> str:
        return self.value

    def __repr__(self) -> str:
        return repr(self.value)
