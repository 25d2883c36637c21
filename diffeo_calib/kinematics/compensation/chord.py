"""The fast search: steps with one approximate inverse per row, improved as they go.

A calibrated robot differs from its geometric model by about 1e-3, so that steps with the geometric Jacobian contract
the error by 100 each, and a Broyden update of rank one improves the inverse from step to step. Rows for which this is
no good (a joint leaves its box, the error does not shrink fast) are given up here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffeo_calib.kinematics.compensation.kinematics import ToolFunctions
from diffeo_calib.kinematics.compensation.targets import Array, Targets

REACHED_MISS = 5e-10
"""Miss in m and rad at which a row counts as reached: half of what is promised."""
MOST_STEPS = 8
SLOWEST_CONTRACTION = 0.3
"""A step must leave less than this fraction of the error."""
RELATIVE_RIDGE = 1e-12
"""Part of the trace that keeps singular matrices invertible; rows where it matters are given up."""


@dataclass(eq=False)
class Box:
    """Where the joints may be, and what their motion costs.

    Args:
        start: (N, n) commands before the correction, rad or m.
        low: (N, n) and
        high: (N, n) what the joints' limits and the bound of motion leave.
        mobility: (N, n) motion of a joint where it costs nothing extra; 0 for a joint that must not move.
    """

    start: Array
    low: Array
    high: Array
    mobility: Array

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
