"""All rows of a compensation as arrays, and their solution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from diffeo_calib.kinematics.compensation.bounds import Limits
from diffeo_calib.kinematics.compensation.box_search import box_search
from diffeo_calib.kinematics.compensation.chord import Box, chord_search
from diffeo_calib.kinematics.compensation.kinematics import ToolFunctions
from diffeo_calib.kinematics.compensation.status import CODE, Judge, Room, Status
from diffeo_calib.kinematics.compensation.targets import Array, Targets

ROWS_AT_ONCE = 4096


class Solution(NamedTuple):
    """Commands (N, n) in rad or m, poses of the tool (N, 4, 4) or of T tools (N, T, 4, 4), statuses' codes (N,)."""

    q: Array
    poses: Array
    codes: Array


@dataclass(frozen=True, eq=False)
class CompensationProblem:
    """N targets, the boxes of their commands, and the kinematics.

    Args:
        tool: the calibrated kinematics. rough: those of its geometry.
        targets: N targets. room: the boxes. limits: of the joints, as in the room, and of mimic joints.
    """

    tool: ToolFunctions
    rough: ToolFunctions
    targets: Targets
    room: Room
    limits: Limits

    def take(self, rows: Array) -> CompensationProblem:
        """Some of the rows."""
        return self.started(rows, self.room.start[rows])

    def started(self, rows: Array, start: Array) -> CompensationProblem:
        """Some of the rows (R,) from other starts (R, n)."""
        return replace(self, targets=self.targets.take(rows), room=self.room.started(rows, start))

    def solve(self) -> Solution:
        """The nearest command of every row on its own."""
        count, n = self.room.start.shape
        found = Solution(np.full((count, n), np.nan), self._no_poses(count), np.empty(count, dtype=int))
        for first in range(0, count, ROWS_AT_ONCE):
            rows = np.arange(first, min(first + ROWS_AT_ONCE, count))
            for whole, part in zip(found, self.take(rows)._solve(), strict=True):
                whole[rows] = part
        return found

    def _solve(self) -> Solution:
        rows = np.arange(len(self.targets))
        box = self.room.box(rows)
        nowhere = np.any(box.low > box.high, axis=1)
        if nowhere.any():
            return self._without(nowhere)
        q, poses, done = self.search(box, np.clip(box.start, box.low, box.high))
        codes = Judge(self.tool, self.rough, self.targets, self.room).codes(q, poses, done)
        return self.keep_mimics(Solution(q, poses, codes))

    def search(self, box: Box, q: Array) -> tuple[Array, Array, Array]:
        """The fast search from ``q`` (N, n), and the careful one for the rows that it gives up."""
        poses = self.tool.poses(q)
        slopes = self.targets.slopes(self.rough.jacobian(q), poses)
        found, seen, done = chord_search(self.tool, self.targets, q, box, slopes=slopes, poses=poses)
        rest = np.flatnonzero(~done)
        if len(rest):
            parts = box_search(self.tool, self.targets.take(rest), q[rest], box.take(rest), poses=poses[rest])
            found[rest], seen[rest], done[rest] = parts
        return found, seen, done

    def keep_mimics(self, found: Solution) -> Solution:
        """Shorten corrections that would take mimic joints of several joints beyond their limits."""
        if not len(self.limits.matrix):
            return found
        q = self.limits.within(self.room.start, found.q)
        changed = np.flatnonzero((q != found.q).any(1))
        poses, codes = found.poses.copy(), found.codes.copy()
        codes[changed] = CODE[Status.limit]
        possible = changed[np.isfinite(q[changed]).all(1)]
        poses[changed] = np.nan
        poses[possible] = self.tool.poses(q[possible])
        return Solution(q, poses, codes)

    def _without(self, nowhere: Array) -> Solution:
        """Rows that start farther beyond a limit than the bound have no command."""
        count, n = self.room.start.shape
        q, poses = np.full((count, n), np.nan), self._no_poses(count)
        codes = np.full(count, CODE[Status.limit])
        rows = np.flatnonzero(~nowhere)
        if len(rows):
            q[rows], poses[rows], codes[rows] = self.take(rows)._solve()
        return Solution(q, poses, codes)

    def _no_poses(self, count: int) -> Array:
        return np.full((count, *self.targets.pose_shape), np.nan)
