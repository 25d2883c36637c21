"""Rows that follow each other: corrections that change slowly, and commands that start at the row before.

Rows are first corrected on their own, all at once. Where corrections c then change faster than the rate r, they are
replaced by the mean of their two envelopes,

    1/2 min_j (c_j + r |t_j - t_i|) + 1/2 max_j (c_j - r |t_j - t_i|),

which changes at most at the rate r and equals c wherever c does. Rows that miss their targets give way first: their
corrections are brought between the envelopes of the rows that reach theirs, which then stay as they are unless they
jump themselves. The other joints of changed rows are searched again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffeo_calib.kinematics.compensation.box_search import box_search
from diffeo_calib.kinematics.compensation.chord import Box, reached
from diffeo_calib.kinematics.compensation.problem import CompensationProblem, Solution
from diffeo_calib.kinematics.compensation.status import CODE, Status
from diffeo_calib.kinematics.compensation.targets import Array

ROUNDS = 3
CHANGED = 1e-9
"""Corrections that differ by more than this, rad or m, are not the same."""

ROUNDING = 1e-14


@dataclass(frozen=True, eq=False)
class Pace:
    """How fast corrections may change.

    Args:
        times: (N,) increasing, s or rows. rate: (n,) rad or m per unit of time.
    """

    times: Array
    rate: Array

    def limited(self, corrections: Array, firm: Array) -> Array:
        """Corrections (N, n), NaN where there are none, at a limited rate; ``firm`` (N,) rows come first."""
        upper, lower = self._envelopes(np.where(firm[:, None], corrections, np.nan))
        between = np.where(lower <= upper, np.clip(corrections, lower, upper), corrections)
        upper, lower = self._envelopes(between)
        none = np.isnan(corrections)
        return np.where(none, np.nan, 0.5 * (np.where(none, 0.0, upper) + np.where(none, 0.0, lower)))

    def _envelopes(self, corrections: Array) -> tuple[Array, Array]:
        """The two envelopes; rows with NaN do not count, infinite where there are no others."""
        steps, none = self.times[:, None] * self.rate, np.isnan(corrections)
        upper = _lowest(np.where(none, np.inf, corrections), steps)
        return upper, -_lowest(np.where(none, np.inf, -corrections), steps)

    def jumps(self, corrections: Array) -> Array:
        """Rows whose corrections differ from those of the row before by more than the rate allows."""
        allowed = np.diff(self.times)[:, None] * self.rate
        return 1 + np.flatnonzero((np.abs(np.diff(corrections, axis=0)) > allowed + CHANGED).any(1))


def _lowest(values: Array, steps: Array) -> Array:
    """min_j (values_j + |steps_j - steps_i|) for every row i: one pass forwards, one backwards."""
    forwards = np.minimum.accumulate(values - steps, axis=0) + steps
    backwards = np.minimum.accumulate((values + steps)[::-1], axis=0)[::-1] - steps
    return np.minimum(forwards, backwards)


def solve_path(problem: CompensationProblem, pace: Pace) -> tuple[Solution, Array]:
    """Commands of a path, and the rows at which the corrections of the rows on their own jump."""
    found = problem.solve()
    start = problem.room.start
    jumps = pace.jumps(found.q - start)
    firm = found.codes == CODE[Status.reached]
    q, held = found.q.copy(), np.zeros(found.q.shape, dtype=bool)
    for _ in range(ROUNDS):
        slow = start + pace.limited(q - start, firm)
        held |= np.abs(slow - q) > CHANGED
        rows = np.flatnonzero((np.abs(slow - q) > CHANGED).any(1))
        if not len(rows):
            break
        q[rows] = _with_held_joints(problem.take(rows), slow[rows], held[rows])
    slow = start + pace.limited(q - start, firm)
    q = np.where(np.abs(slow - q) > ROUNDING, slow, q)
    box = problem.room.box(np.arange(len(q)))
    return problem.keep_mimics(_judged(problem, found, np.clip(q, box.low, box.high))), jumps


def _with_held_joints(problem: CompensationProblem, q: Array, held: Array) -> Array:
    """The nearest commands (R, n) with some joints held (R, n)."""
    box = problem.room.box(np.arange(len(q)))
    q = np.clip(q, box.low, box.high)
    box = Box(box.start, np.where(held, q, box.low), np.where(held, q, box.high), box.mobility * ~held)
    return box_search(problem.tool, problem.targets, q, box)[0]


def _judged(problem: CompensationProblem, before: Solution, q: Array) -> Solution:
    """Poses and statuses of the commands that differ from those of the rows on their own."""
    rows = np.flatnonzero((np.abs(q - before.q) > 0).any(1))
    poses, codes = before.poses.copy(), before.codes.copy()
    if len(rows):
        poses[rows] = problem.tool.poses(q[rows])
        there = reached(problem.targets.take(rows), poses[rows])
        slowed = (np.abs(q[rows] - before.q[rows]) > CHANGED).any(1)
        codes[rows[there]] = CODE[Status.reached]
        codes[rows[~there & slowed]] = CODE[Status.rate]
    return Solution(q, poses, codes)


def follow(problem: CompensationProblem, first: Array) -> tuple[CompensationProblem, Solution]:
    """Commands that each start at the command of the row before, the first at ``first`` (n,).

    Returns:
        the problem with these starts, and its solution.
    """
    rows, at = [], first
    starts = np.empty((len(problem.targets), len(first)))
    for row in range(len(starts)):
        starts[row] = at
        rows.append(problem.started(np.array([row]), at[None]).solve())
        at = rows[-1].q[0] if np.isfinite(rows[-1].q).all() else at
    solution = Solution(*(np.concatenate(parts) for parts in zip(*rows, strict=True))) if rows else problem.solve()
    return problem.started(np.arange(len(starts)), starts), solution
