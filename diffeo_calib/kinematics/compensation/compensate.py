"""Joint commands that bring the tool of a calibrated robot to its targets.

Rows are corrected on their own, all at once. Where corrections c of a path then change faster than the rate r, they are
replaced by the mean of their two envelopes,

    1/2 min_j (c_j + r |t_j - t_i|) + 1/2 max_j (c_j - r |t_j - t_i|),

which changes at most at the rate r and equals c wherever c does. Rows that miss their targets give way first: their
corrections are brought between the envelopes of the rows that reach theirs, which then stay as they are unless they
jump themselves. The other joints of changed rows are searched again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import check_number, real_tensor
from diffeo_calib.common.data_frames import named_columns
from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.errors import InputError, few, sentence, warn_user
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.compensation.problem import (
    SLIDE_BOUND,
    TURN_BOUND,
    Box,
    CompensationProblem,
    Solution,
    Status,
    box_search,
    by_joint,
    joint_limits,
    mobilities,
    reached,
)
from diffeo_calib.kinematics.compensation.targets import Array, Targets, checked_targets, finite_rows, tool_functions
from diffeo_calib.kinematics.tool import TOOL_LEVER, checked_tip, tool_transform
from diffeo_calib.robots.tree import Tree

LEAST_DIRECTION = 1e-3
"""Motion of a tool in a direction, as a share of its largest one, below which slides do not move it there."""
ROWS_PER_BOUND = 0.1  # default rate of a path without times, in bounds per row


@dataclass(frozen=True, eq=False, repr=False)
class Compensation:
    """Result of :func:`compensate`, one row per target.

    Args:
        q: (N, n) joint commands, rad or m; NaN in a row whose start is so far beyond a joint's limit that no command
            within the bound is allowed.
        start: (N, n) the commands before the correction.
        status: how each row ended, see :class:`Status`.
        poses: (N, 4, 4) where the model sees the tool at ``q``, in the frame of the targets, m.
        miss: (N,) distance from the target position, m.
        angle_miss: (N,) angle to the target orientation or direction, rad; None for targets that are positions.
            For targets of T tips ``poses`` is (N, T, 4, 4), the misses are (N, T), NaN where a tip had no target.
        jumps: on a path, the rows whose corrections would have changed too fast from the row before.
    """

    q: Tensor
    start: Tensor
    status: tuple[Status, ...]
    poses: Tensor
    miss: Tensor
    angle_miss: Tensor | None = None
    jumps: tuple[int, ...] = ()

    @property
    def correction(self) -> Tensor:
        """(N, n) ``q - start``, rad or m."""
        return self.q - self.start

    @cached_property
    def reached(self) -> Tensor:
        """(N,) boolean: which rows reach their targets."""
        return torch.tensor([status is Status.reached for status in self.status], dtype=torch.bool, device="cpu")

    @property
    def counts(self) -> dict[str, int]:
        """How many rows ended in each status; statuses without rows are left out."""
        counts = Counter(self.status)
        return {str(status): counts[status] for status in Status if counts[status]}

    def __len__(self) -> int:
        return len(self.status)

    def __repr__(self) -> str:
        rows = ", ".join(f"{count} {name}" for name, count in self.counts.items()) or "no rows"
        return f"Compensation({rows})"


@outside_inference_mode
def compensate(
    model: CalibratedKinematics,
    targets: object,
    start: object,
    *,
    axis: object = None,
    tool_axis: str = "z",
    tool: object = None,
    frame: str = "base",
    bound: object = None,
    limits: object = None,
    weights: object = None,
    lever: float = TOOL_LEVER,
    path: bool = False,
    rate: object = None,
    time: object = None,
) -> Compensation:
    """Joint commands at which the calibrated tool is at its targets.

    For every row on its own, with the tool at (p, R) and its target at (p*, R*), the command minimises

        1/2 |p* - p|^2 + lever^2 (1 - cos angle(R, R*)) + 1e-10 / 2 sum_l weights_l (q_l - start_l)^2

    over the joint values within the joints' limits and within ``bound`` of ``start``, and continues to the target
    where that is possible. With targets for several tips the first two terms are sums over them. A row that cannot
    reach its target gets the nearest command that is allowed; its status says why, and no row raises an error or
    disturbs another.

    The base frame is the robot's base **as it was found**: it absorbs what cannot be told apart from it, such as a
    constant offset of the first joint. Intended poses of a nominal program, ``robot(q) @ tool``, are targets in it.

    Of a robot of slides alone, miss and status are those in the directions in which the slides move the tool: a table
    with two of them does not lift it.

    Args:
        model: a calibrated model of a robot.
        targets: (N, 4, 4) poses or (N, 3) positions of the tool centre point, m. For a robot with several tips those of
            all T tips at once, in the order of ``robot.tips``, are (N, T, 4, 4) or (N, T, 3), NaN where a tip may be
            anywhere.
        start: (N, n) commands to correct, rad or m: the nominal inverse kinematics of each target. The result stays on
            its branch.
        axis: (N, 3) or (N, T, 3) directions, of any length, in which one axis of the tool shall point, beside
            positions; the turn about it is free.
        tool_axis: that axis of the tool's frame: "x", "y" or "z".
        tool: tool centre point in the tip's frame, (4, 4) or position (3,) in m; the model's own by default. For
            targets of all tips (T, 4, 4) or (T, 3).
        frame: frame of the targets, "base" or "measuring".
        bound: largest motion of a joint away from its start: one number in rad for all turning joints, or one for each
            joint in rad or m. Default 1 degree, 0.02 m if prismatic.
        limits: (n, 2) lower and upper limit of each joint, rad or m; those of the robot by default. A start beyond a
            limit is brought back if the bound allows it.
        weights: (n,) cost of each joint's motion per rad^2 or m^2, in units of the smallest, where a redundant robot
            has a choice; 1 by default, and joints that move no tip with a target stay, such as those of another arm.
        lever: m that a turn of one radian counts as where position and orientation cannot both be reached.
        path: whether the rows follow each other, so that their corrections may change at a limited rate only. Joint
            limits come before the rate.
        rate: largest change of a correction, rad or m, for all turning joints or for each joint as ``bound``: per row,
            or per second with ``time``. Default a tenth of the bound per row, or the bound per second.
        time: (N,) increasing, s; for a path.

    Returns:
        :class:`Compensation`: commands, statuses, misses.

    Raises:
        InputError: wrong shapes, values that are not finite (first place named), poses that are not rigid, a direction
            of length zero, a bound, weight or rate that is not positive, times that do not increase, another frame,
            not a calibrated model.

    Warns:
        DiffeoCalibWarning: rows of a path at which the corrections jump.
    """
    if not isinstance(model, CalibratedKinematics):
        raise InputError.of("`model`", expected="a calibrated model of a robot", got=type(model).__name__)
    check_number(lever, "`lever`", above=0.0)
    wanted, robot = real_tensor(targets, "targets"), model.robot
    fix = "pass the joints of `robot.joint_names`, one row per target"
    given = real_tensor(named_columns(start, robot.joint_names, "start"), "start")
    begin = finite_rows(given, "start", ("N", robot.n), fix)
    goals = checked_targets(wanted, robot, len(begin), axis=axis, tool_axis=tool_axis, lever=lever)
    tools = _tools(model, tool, goals)
    functions = tool_functions(model, tools, frame)
    if not any(robot.periodic):
        v = functions.rough(np.zeros((1, robot.n)))[0, :, :3]
        goals = replace(goals, along=v @ np.linalg.pinv(v, rcond=LEAST_DIRECTION))
    motion = by_joint(robot, bound, "bound", np.where(robot.periodic, TURN_BOUND, SLIDE_BOUND))
    mobility = mobilities(robot, weights, tuple(tools), ~goals.free)
    problem = CompensationProblem(functions, goals, begin, joint_limits(robot, limits), motion, mobility)
    pace = _pace(robot, problem, rate, time, path=path)
    if pace is None:
        return _result(problem, problem.solve())
    solution, jumps = solve_path(problem, pace)
    if len(jumps):
        rows = f"{few(jumps.tolist())} rows, and were spread over the rows around"
        fix = "look at their statuses: the path may pass a singularity or change its branch there"
        warn_user(sentence(f"the corrections of the path jump after {rows}", fix=fix))
    return _result(problem, solution, jumps)


def _pace(robot: Tree, problem: CompensationProblem, rate: object, time: object, *, path: bool) -> Pace | None:
    """How fast corrections may change; None for rows on their own. InputError for a rate or times without a path."""
    if not path:
        if rate is not None or time is not None:
            what = "`rate` and `time` limit how fast the corrections of a path change"
            raise InputError.of(what, fix="pass path=True and a start for every row, or leave them out")
        return None
    count = len(problem.start)
    times = np.arange(count, dtype=np.float64) if time is None else finite_rows(time, "time", (count,), "pass seconds")
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        got = f"{times[late[0] + 1]:g} after {times[late[0]]:g}"
        raise InputError.of(f"`time`, row {late[0] + 1}", expected="increasing times", got=got, fix="sort the rows")
    slowest = problem.bound * (ROWS_PER_BOUND if time is None else 1.0)
    return Pace(times, by_joint(robot, rate, "rate", slowest))


def _tools(model: CalibratedKinematics, tool: object, goals: Targets) -> dict[str, Tensor]:
    """Tip -> tool (4, 4) of each target; by default the model's own on its tip, and the other tips themselves."""
    tips = model.robot.tips
    if not goals.of_tips:
        return {checked_tip(model.robot, model.tool_tip): model.tool if tool is None else tool_transform(tool)}
    if tool is None:
        return {tip: tool_transform(None) for tip in tips} | {model.tool_tip or tips[0]: model.tool}
    given = real_tensor(tool, "tool")
    if given.shape not in ((len(tips), 4, 4), (len(tips), 3)):
        expected, fix = f"({len(tips)}, 4, 4) or ({len(tips)}, 3)", "pass one tool for every tip"
        raise InputError.of("`tool` has the wrong shape", expected=expected, got=tuple(given.shape), fix=fix)
    return {tip: tool_transform(each) for tip, each in zip(tips, given, strict=True)}


def _result(problem: CompensationProblem, solution: Solution, jumps: Sequence[int] | Array = ()) -> Compensation:
    goals, status = problem.targets, tuple(map(Status, solution.status.tolist()))
    (miss, angle), poses = goals.misses(solution.poses), solution.poses
    miss, angle = np.where(goals.free, np.nan, miss), None if angle is None else np.where(goals.free, np.nan, angle)
    if not goals.of_tips:
        poses, miss, angle = poses[:, 0], miss[:, 0], None if angle is None else angle[:, 0]
    q, start, arrived, away = (torch.from_numpy(part) for part in (solution.q, problem.start.copy(), poses, miss))
    turned = None if angle is None else torch.from_numpy(angle)
    return Compensation(q, start, status, arrived, away, turned, tuple(int(row) for row in jumps))


ROUNDS = 3
SAME_CORRECTION_TOLERANCE = 1e-9  # corrections that differ by more than this, rad or m, are not the same

ROUNDING = 1e-14


@dataclass(frozen=True, eq=False)
class Pace:
    """How fast corrections may change."""

    times: Array  # (N,) increasing, s or rows
    rate: Array  # (n,) rad or m per unit of time

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
        return 1 + np.flatnonzero((np.abs(np.diff(corrections, axis=0)) > allowed + SAME_CORRECTION_TOLERANCE).any(1))


def _lowest(values: Array, steps: Array) -> Array:
    """min_j (values_j + |steps_j - steps_i|) for every row i: one pass forwards, one backwards."""
    forwards = np.minimum.accumulate(values - steps, axis=0) + steps
    backwards = np.minimum.accumulate((values + steps)[::-1], axis=0)[::-1] - steps
    return np.minimum(forwards, backwards)


def solve_path(problem: CompensationProblem, pace: Pace) -> tuple[Solution, Array]:
    """Commands of a path, and the rows at which the corrections of the rows on their own jump."""
    solution, start = problem.solve(), problem.start
    jumps = pace.jumps(solution.q - start)
    firm = solution.status == Status.reached.value
    q, held = solution.q.copy(), np.zeros(solution.q.shape, dtype=bool)
    for _ in range(ROUNDS):
        slow = start + pace.limited(q - start, firm)
        changed = np.abs(slow - q) > SAME_CORRECTION_TOLERANCE
        held, rows = held | changed, np.flatnonzero(changed.any(1))
        if not len(rows):
            break
        part, still = problem.started(rows, start[rows]), held[rows]
        box = part.box()
        at = np.clip(slow[rows], box.low, box.high)
        box = Box(box.start, np.where(still, at, box.low), np.where(still, at, box.high), box.mobility * ~still)
        q[rows] = box_search(part.tool, part.targets, at, box)[0]
    slow = start + pace.limited(q - start, firm)
    q = np.where(np.abs(slow - q) > ROUNDING, slow, q)
    box = problem.box()
    return problem.keep_mimics(_judged(problem, solution, np.clip(q, box.low, box.high))), jumps


def _judged(problem: CompensationProblem, before: Solution, q: Array) -> Solution:
    """Poses and statuses of the commands that differ from those of the rows on their own."""
    rows = np.flatnonzero((q != before.q).any(1) & np.isfinite(q).all(1))
    poses, status = before.poses.copy(), before.status.copy()
    if len(rows):
        poses[rows] = problem.tool.poses(q[rows])
        there = reached(problem.targets.take(rows), poses[rows])
        slowed = (np.abs(q[rows] - before.q[rows]) > SAME_CORRECTION_TOLERANCE).any(1)
        status[rows[there]] = Status.reached.value
        status[rows[~there & slowed]] = Status.rate.value
    return Solution(q, poses, status)
