"""All rows of a compensation as arrays, where their joints may be, and their solution.

Why a target is not reached: the limit of a joint, a singularity, or because it is out of reach.
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
from diffeo_calib.kinematics.compensation.search import Box, box_search
from diffeo_calib.kinematics.compensation.targets import Array, Targets, ToolFunctions
from diffeo_calib.robots.tree import Tree

TURN_BOUND = radians(1.0)
"""Default bound of a correction of a turning joint, rad."""
SLIDE_BOUND = 0.02
"""Default bound of a correction of a slide, m."""
LIMIT_SLACK = 1e-9
"""Starts beyond a limit by less than this, rad or m, come from rounding."""


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of the active joints, including those of the mimic joints that one joint drives."""

    low: Array  # (n,) rad or m
    high: Array  # (n,)
    matrix: Array  # (k, n) of mimic joints that several joints drive: least <= matrix q <= most
    least: Array  # (k,)
    most: Array  # (k,)

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
    """Commands (N, n) in rad or m, poses of the tools (N, T, 4, 4), statuses' codes (N,)."""

    q: Array
    poses: Array
    codes: Array


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
        poses = np.full((count, self.targets.tools, 4, 4), np.nan)
        solution = Solution(np.full((count, n), np.nan), poses, np.full(count, CODE[Status.limit]))
        box = self.box()
        possible = np.flatnonzero(np.all(box.low <= box.high, axis=1))
        for first in range(0, len(possible), ROWS_AT_ONCE):
            rows = possible[first : first + ROWS_AT_ONCE]
            begin, (q, reached, done) = self.started(rows, self.start[rows]), self._search(rows)
            solved = begin.keep_mimics(Solution(q, reached, begin._codes(q, reached, done)))
            for whole, part in zip(solution, solved, strict=True):
                whole[rows] = part
        return solution

    def keep_mimics(self, solution: Solution) -> Solution:
        """Shorten corrections that would take mimic joints of several joints beyond their limits."""
        if not len(self.limits.matrix):
            return solution
        q = self.limits.within(self.start, solution.q)
        changed = np.flatnonzero((q != solution.q).any(1))
        poses, codes = solution.poses.copy(), solution.codes.copy()
        codes[changed] = CODE[Status.limit]
        possible = changed[np.isfinite(q[changed]).all(1)]
        poses[changed] = np.nan
        poses[possible] = self.tool.poses(q[possible])
        return Solution(q, poses, codes)

    def _codes(self, q: Array, poses: Array, done: Array) -> Array:
        """(N,) codes of the statuses of rows at ``q`` (N, n) whose ``done`` says that they are reached."""
        codes = np.where(done, CODE[Status.reached], CODE[Status.unreachable])
        if done.all():
            return codes
        rows = np.flatnonzero(~done)
        at_limit = ((q[rows] <= self.limits.low) | (q[rows] >= self.limits.high)).any(1)
        freed = rows[at_limit]
        freed = freed[self._search(freed, limited=False)[2]]
        codes[freed] = CODE[Status.limit]
        rest = np.setdiff1d(rows, freed)
        codes[rest[self._singular(rest, q[rest], poses[rest])]] = CODE[Status.singular]
        return codes

    def _search(self, rows: Array, *, limited: bool = True, scale: float = 1.0) -> tuple[Array, Array, Array]:
        """:func:`box_search` of some rows, with or without the limits of the joints, with a multiple of the bound."""
        box = self.box(rows, limited=limited, scale=scale)
        return box_search(self.tool, self.targets.take(rows), np.clip(box.start, box.low, box.high), box)

    def _singular(self, rows: Array, q: Array, poses: Array) -> Array:
        """(R,) whether a singularity is to blame, at the start or at the nearest command ``q``."""
        start, targets = self.start[rows], self.targets.take(rows)
        near, open_ = self._blames(targets, start, self.tool.poses(start), start)
        near_here, open_here = self._blames(targets, q, poses, start)
        singular = (near & open_) | (near_here & open_here)
        doubtful = np.flatnonzero((near | near_here) & ~singular)
        singular[doubtful] = self._search(rows[doubtful], scale=SECOND_SEARCH_BOUND_FACTOR)[2]
        return singular

    def _blames(self, targets: Targets, q: Array, poses: Array, start: Array) -> tuple[Array, Array]:
        """(R,) whether weak directions at ``q`` (R, n) alone keep the bound from sufficing; whether they lead there.

        Along the direction v of the joints that moves the tool least, the tool goes s t + c t^2 / 2 in the direction u.
        Where that bends back before it has gone as far as the target, the workspace probably ends before it.
        """
        slopes = self._slopes(targets, q)
        error = targets.errors(poses) * targets.to_metres(self.tool.length)
        U, s, Vt = np.linalg.svd(slopes, full_matrices=False)
        parts = (U.swapaxes(1, 2) @ error[:, :, None])[:, :, 0]  # (R, k)
        weak = s <= WEAK_DIRECTION_SHARE * s[:, :1]
        motion = parts / np.maximum(s, 1e-300)
        strong = (np.where(weak, 0.0, motion)[:, None, :] @ Vt)[:, 0] + (q - start) / self.bound
        each, main = np.arange(len(q)), np.where(weak, np.abs(motion), -1.0).argmax(1)
        v, u, far, slope = Vt[each, main], U[each, :, main], parts[each, main], s[each, main]
        way, speeds = v * self.bound, list[Array]()  # of the joints; of the tool at both sides of q along it
        for side in (1.0, -1.0):
            speeds.append((self._slopes(targets, q + side * DIFFERENCE * way) @ v[:, :, None])[:, :, 0])
        bend = np.einsum("nk,nk->n", u, (speeds[0] - speeds[1]) / (2.0 * DIFFERENCE))
        ends = (bend * far < 0) & (slope**2 < 2.0 * np.abs(bend * far))
        length = self.tool.length * np.square(way).sum(1)
        ends &= np.abs(bend) > BENT_WORKSPACE_CURVATURE * length
        near = (np.abs(strong).max(1) <= 1.0) & (np.abs(far) <= s[:, 0])
        return weak.any(1) & near, ~ends

    def _slopes(self, targets: Targets, q: Array) -> Array:
        """(R, k, n) of the tool, in m, by motions of the joints in bounds."""
        return targets.slopes(self.tool.rough(q)) * targets.to_metres(self.tool.length)[:, None] * self.bound


WEAK_DIRECTION_SHARE = 0.1
"""A direction of the tool is weak below this part of the strongest one: it takes a large motion of the joints."""
BENT_WORKSPACE_CURVATURE = 0.05
"""The workspace may end at a singularity whose curvature is larger than this part of the typical length."""
SECOND_SEARCH_BOUND_FACTOR = 10.0
"""Multiple of the bound within which targets beyond the end are searched once more."""
DIFFERENCE = 1e-4
"""Step in rad or m of central differences of the Jacobian."""

ROUNDING = 1e-15
"""Relative; so that the difference of command and start, too, is within the bound."""


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


MEMBERS = tuple(Status)
CODE = {status: code for code, status in enumerate(MEMBERS)}
