"""`Campaign`: rows are judged as they come, and the campaign says how accurate the robot is and what to measure next.

A model of the accepted rows (model.py) is renewed as they grow by a quarter: registration and geometry; its scales at
20, 40, 80, ... rows. In between the posterior takes in one row at a time. The last rows are kept apart from it: what
has changed among them shows a few rows later, and those that were taken in since then are taken out again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, inf, log
from threading import Thread
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.calibrate import Table, calibrate, check_arguments
from diffeo_calib.calibration.planning.candidates import candidates as drawn
from diffeo_calib.calibration.result import CalibrationResult
from diffeo_calib.campaign.model import Around, CampaignModel
from diffeo_calib.campaign.verdicts import Verdict
from diffeo_calib.common.checks import check_number, check_seed
from diffeo_calib.common.device import HOST, methods_outside_inference_mode
from diffeo_calib.common.errors import DiffeoCalibError, InputError
from diffeo_calib.common.threads import small_work
from diffeo_calib.measurements.observations import joined_tables
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.tree import Tree

FIRST_ROWS = 12  # accepted rows of the first model
ROWS_GROWTH_PER_MODEL, WAITING_GROWTH, TOGETHER = 1.5, 2.5, 24
"""Factor by which the accepted rows grow between two models, and between those while more rows wait; most rows that are
judged together."""
FIRST_SCALES, SCALES_GROWTH = 20, 2.0
"""Accepted rows at which scales are selected first; factor by which these grow until they are selected again."""
NEAR, NEAR_GROWTH = 1.5, 1.15
"""Expected error, relative to the goal, from which on scales are selected more often, and the factor there."""
CANDIDATES, TARGETS = 120, 40
"""Poses among which the next ones are chosen, and those at which the robot shall be accurate."""
SAME_POSE = 5e-3  # largest difference of a joint between a pose and its repeat, rad or m
MOST_STEPS, MOST_ROWS = 60, 10_000
"""Poses that a forecast chooses, beyond which the variance is extrapolated as a power of their number; most of them."""


@dataclass(frozen=True, eq=False)
class Next:
    """Poses to measure next.

    Args:
        q: (count, n) rad or m: poses to measure again, then the most helpful first.
        rows: numbers of these among the candidates.
        expected: expected error over the target after 0, 1, ... of the best poses, m.
        needed: rows until the expected error is below the goal; None without a goal, or if none is in sight.
        again: rows whose poses are to be measured again.
    """

    q: Tensor
    rows: list[int]
    expected: list[float]
    needed: int | None
    again: Sequence[int] = ()


@methods_outside_inference_mode
class Campaign:
    """A measurement campaign that judges every row before it is taken in.

    Args:
        robot: nominal chain, n joints.
        candidates: (M, n) configurations that can be measured, rad or m; drawn within the joint limits by default, and
            near the rows so far where a camera sees its board or the ball rests in a socket. Others are never proposed.
        target: (T, n) configurations at which the robot shall be accurate; the candidates by default.
        goal: RMS error over the target to reach, m, see :attr:`reached`.
        background: whether models are renewed in a thread of their own: a call then never waits for one, and verdicts
            depend on when it ends. By default a call that is due for a new model makes it (some seconds).
        seed: of everything that is drawn.

    Attributes:
        table: all rows so far, in order; None before the first. verdicts: one for each of them, the latest view.
        models: how many were made.

    Raises:
        InputError: arguments of the wrong kind.
    """

    def __init__(
        self,
        robot: Tree,
        *,
        candidates: object = None,
        target: object = None,
        goal: float | None = None,
        background: bool = False,
        seed: int = 0,
    ) -> None:
        if not isinstance(robot, Tree):
            raise InputError.of("`robot`", expected="a dc.Tree", got=type(robot).__name__)
        if goal is not None:
            check_number(goal, "`goal`", above=0.0)
        self.goal = goal
        self.robot, self.seed, self.background = robot, check_seed(seed), background
        self._draws = candidates is None
        self.candidates = drawn(robot, CANDIDATES, seed=seed) if candidates is None else _joints(robot, candidates)
        self.target = self.candidates if target is None else _joints(robot, target)
        self.table: Any = None
        self.verdicts: list[Verdict] = []
        self.models = 0
        self._lines: list[int] = []
        self._model: CampaignModel | None = None
        self._made: list[CampaignModel] = []
        self._maker: Thread | None = None
        self._tried = self._waiting = 0
        self._obstacle = ""  # why there is no first model

    def __len__(self) -> int:
        return len(self.verdicts)

    def __repr__(self) -> str:
        error = self.expected_error
        words = "" if error is None else f", {1e3 * error:.3g} mm expected"
        return f"Campaign({len(self.accepted)} of {len(self)} rows accepted{words})"

    @property
    def accepted(self) -> list[int]:
        """Numbers of the accepted rows."""
        return [verdict.row for verdict in self.verdicts if verdict.accepted]

    @property
    def expected_error(self) -> float | None:
        """RMS error of the robot over the target as the accepted rows lead to expect, m; None before a first model."""
        return None if self._model is None else self._model.expected_error

    @property
    def error_limit(self) -> float | None:
        """95 % quantile of that error, m; None without a goal, and before 20 accepted rows."""
        limit = inf if self._model is None else self._model.error_limit
        return None if limit == inf else limit

    @property
    def reached(self) -> bool:
        """Whether the error is below the goal: with 95 % probability, as the expected one may be wrong."""
        return self.goal is not None and (self.error_limit or inf) <= self.goal

    @small_work()
    def add(self, q_or_table: object, y: object = None, *, waiting: int = 0) -> list[Verdict]:
        """Judge rows, one after the other, and take in those that fit.

        The verdicts are those of single rows, but new models are made less often as long as more rows wait.

        Args:
            q_or_table: rows of any kind that :func:`calibrate` takes; or joint values (N, n) or (n,), rad or m.
            y: with joint values, the measured positions (N, P, 3), (N, 3) or (3,), m.
            waiting: rows that are there and follow in another call.

        Returns:
            a :class:`Verdict` for every row. Rows that look wrong are kept but not accepted, see :meth:`accept`.

        Raises:
            InputError, MeasurementError: rows of another kind, or of other joints than those before.
        """
        table: Any = q_or_table
        if y is not None:
            q, points = (torch.as_tensor(value, dtype=torch.float64, device=HOST) for value in (q_or_table, y))
            table = Measurements(torch.atleast_2d(q), points if q.ndim > 1 else points[None], doubt=False)
        check_arguments(self.robot, table, None)
        start = len(self)
        numbered, lines = self._numbered(table)
        whole = numbered if self.table is None else joined_tables([self.table, numbered])
        self._lines += lines
        while len(self) < len(whole):
            self._add(whole, waiting)
        return self.verdicts[start:]

    @small_work()
    def resume(self, table: Table, verdicts: Sequence[Verdict]) -> None:
        """Go on with rows that an earlier campaign judged; InputError unless there is one verdict for each of them."""
        check_arguments(self.robot, table, None)
        if len(self) or len(table) != len(verdicts):
            raise InputError.of("`verdicts`", expected=f"{len(table)}, of a new campaign", got=str(len(verdicts)))
        self.table, self._lines = self._numbered(table)
        self.verdicts = [replace(verdict, line=line) for verdict, line in zip(verdicts, self._lines, strict=True)]
        self._renew()

    def accept(self, row: int) -> None:
        """Take a row in, whatever its verdict."""
        self._decide(row, accepted=True)

    def reject(self, row: int) -> None:
        """Leave a row out, whatever its verdict."""
        self._decide(row, accepted=False)

    def repeat(self, row: int) -> None:
        """Leave a row out and put its pose first among the next, until a row is measured there."""
        self._decide(row, accepted=False, again=True)

    def rows(self) -> Table:
        """The accepted rows; InputError if there are none."""
        if not self.accepted:
            raise InputError.of("the accepted rows", expected="at least one", got="none")
        return self.table.rows(self.accepted)

    def result(self, **options: Any) -> CalibrationResult:
        """:func:`calibrate` of the accepted rows; ``options`` are its own."""
        return calibrate(self.robot, self.rows(), **options)

    @small_work()
    def next(self, count: int = 5, goal: float | None = None) -> Next | None:
        """Poses to measure again, then those that help most, greedily; and how many more rows an expected error takes.

        Args:
            count: of poses. goal: expected error to reach, m; by default that with which the goal is reached.

        Returns:
            None before a model, unless poses are to be measured again.
        """
        if goal is None and self.goal is not None and self._model is not None:
            goal = self.goal * self._model.expected_error / (self.error_limit or self._model.expected_error)
        again = [verdict.row for verdict in self.verdicts if verdict.again][:count]
        proposal = Next(self.candidates[:0], [], [], None)
        if self._model is not None:
            rows, expected = self._model.next(count if goal is None else max(count, MOST_STEPS))
            needed = None if goal is None else _needed(expected, goal, self._model.count)
            proposal = Next(self._model.around.candidates[rows[:count]], rows[:count], expected, needed)
        if not again:
            return None if self._model is None else proposal
        q = torch.cat([self.table.q[again], proposal.q])[:count]
        return replace(proposal, q=q, rows=proposal.rows[: count - len(again)], again=again)

    def wait(self) -> bool:
        """Wait for models that are made in the background, also the next that is due; whether there was one."""
        made = False
        while self._maker is not None:
            self._maker.join()
            made |= self.poll()
        return made

    def _add(self, whole: Any, waiting: int) -> None:
        """Judge some rows of a table, and renew the model if it is due."""
        self.poll()
        row, most = len(self), ceil(min(TOGETHER, self._due - len(self.accepted)))
        self.table = whole.rows(slice(0, min(len(whole), row + max(1, most) if self._model else row + 1)))
        if self._model is None:
            self.verdicts.append(Verdict(row, None, accepted=True, line=self._lines[row]))
        else:
            self._judge(self._model, self.table)
        self.table, self._waiting = whole.rows(slice(0, len(self))), len(whole) - len(self) + waiting
        self._renew()
        why = {"cause": self._obstacle} if self._model is None else {}
        self.verdicts[-1] = replace(self.verdicts[-1], expected_error=self.expected_error, **why)
        for verdict in [verdict for verdict in self.verdicts if verdict.again]:
            after = self.table.q[max(row, verdict.row + 1) :]
            if bool(((after - self.table.q[verdict.row]).abs().amax(1) < SAME_POSE).any()):
                self.verdicts[verdict.row] = replace(verdict, again=False)

    def _numbered(self, table: Any) -> tuple[Any, list[int]]:
        """New rows, numbered in the campaign, and their lines, which go on after those before."""
        lines, last = table.line_numbers, max(self._lines, default=-1)
        shift = last + 1 - int(lines.min()) if len(lines) and int(lines.min()) <= last else 0
        start = len(self._lines)
        return table.with_line_numbers(torch.arange(start, start + len(table), device=HOST)), (lines + shift).tolist()

    def _decide(self, row: int, *, accepted: bool, again: bool = False) -> None:
        if row not in range(len(self)):
            raise InputError.of("`row`", expected=f"0 to {len(self) - 1}", got=str(row))
        before = self.verdicts[row]
        self.verdicts[row] = replace(before, accepted=accepted, decided=True, again=again)
        if before.accepted != accepted:
            self.wait()
            if self._model is not None:
                names, placed = self.table.device_names, self._model.around.placed.data.device_names
                some = sum(names[row] in placed for row in self.accepted) > 1  # which a model holds at least
                self._model = self._model.rebuilt(self.table, self.verdicts) if some else None

    def _renew(self) -> None:
        """Make a new model if it is due."""
        count = len(self.accepted)
        if count < self._due or count == self._tried or self._maker is not None:
            return
        self._tried = count
        arguments = self.table, list(self.verdicts)
        if self.background:
            self._maker = Thread(target=self._make, args=arguments, daemon=True)
            self._maker.start()
        else:
            self._make(*arguments)
            self.poll()

    @property
    def _due(self) -> float:
        """Accepted rows at which a model is due."""
        if self._model is None:
            return max(FIRST_ROWS, ROWS_GROWTH_PER_MODEL * self._tried if self._waiting else 0)
        scales, end = self._next_scales(self._model), len(self.accepted) + self._waiting
        due = min(ROWS_GROWTH_PER_MODEL * self._model.count, scales)
        if end < 2 * due:
            return due
        return end / WAITING_GROWTH ** int(log(end / due, WAITING_GROWTH)) if self._model.around.selected else scales

    def _next_scales(self, model: CampaignModel) -> float:
        """Accepted rows at which scales are selected again."""
        near = self.goal is not None and model.expected_error < NEAR * self.goal
        return max((NEAR_GROWTH if near else SCALES_GROWTH) * model.around.selected, FIRST_SCALES)

    @small_work()
    def _make(self, table: Any, verdicts: Sequence[Verdict]) -> None:
        """A new model from accepted rows; without one if they do not allow it yet."""
        numbers, old = [verdict.row for verdict in verdicts if verdict.accepted], self._model
        first = len(numbers) < FIRST_SCALES
        same = None if old is None or len(numbers) >= self._next_scales(old) else old
        asked = self.candidates, self.target[:: -(-len(self.target) // TARGETS)]
        try:
            kept = same and same.around
            around = Around.of(self.robot, table.rows(numbers), asked, kept, first=first, seed=self.seed)
            around = around.with_open_candidates(CANDIDATES, self.seed) if self._draws else around
            around = around if same or first or self.goal is None else around.with_deviation()
            made = CampaignModel(around, table, verdicts, same.ratios if same else ())
            if old is None:
                made.check_placed()
        except DiffeoCalibError as error:
            self._obstacle = str(error)
            return
        self.candidates = around.candidates
        self.models += 1
        self._made.append(made)

    @small_work()
    def poll(self) -> bool:
        """Put a model that was made in the background in the place of the old one; whether there was one.

        Rows that came before there was a model are judged by it.
        """
        if self._maker is not None and not self._maker.is_alive():
            self._maker = None
        if self._made:
            if self._model is None:
                self.verdicts = [replace(one, cause="") if one.fits is None else one for one in self.verdicts]
            self._model = self._caught_up(self._made.pop())
            self._renew()
            return True
        return False

    def _caught_up(self, made: CampaignModel) -> CampaignModel:
        """A new model with the rows that came since its last one: those that no model has judged are judged by it."""
        late = next((verdict.row for verdict in self.verdicts[made.seen :] if verdict.fits is None), None)
        if late is not None:
            made = made.rebuilt(self.table.rows(slice(0, late)), self.verdicts[:late])
            before, self.verdicts = self.verdicts, self.verdicts[:late]
            for old in before[late:]:
                self._judge(made, self.table.rows(slice(0, old.row + 1)))
                kept = {"accepted": old.accepted, "decided": True, "again": old.again} if old.decided else {}
                self.verdicts[old.row] = replace(self.verdicts[old.row], expected_error=old.expected_error, **kept)
        return made if made.seen == len(self) else made.rebuilt(self.table, self.verdicts)

    def _judge(self, model: CampaignModel, table: Any) -> None:
        """Add the verdict about the last row of a table."""
        try:
            model.judge(table, self.verdicts, self._lines)
        except DiffeoCalibError as error:  # a device that has no place yet
            row = len(self.verdicts)
            if len(table) > row + 1:
                return self._judge(model, table.rows(slice(0, row + 1)))
            self.verdicts.append(Verdict(row, None, accepted=True, cause=str(error), line=self._lines[row]))


def _joints(robot: Tree, values: object) -> Tensor:
    return robot.joint_values(values).detach()  # pyright: ignore[reportArgumentType]


def _needed(expected: list[float], goal: float, count: int) -> int | None:
    """Rows until the expected error is below a goal, extrapolated by the last half of the steps."""
    first = next((step for step, value in enumerate(expected) if value <= goal), None)
    if first is not None or len(expected) < 3 or expected[-1] <= 0:
        return first
    half, last = len(expected) // 2, len(expected) - 1
    power = log(expected[half] / expected[last]) / log((count + last) / (count + half))
    if power <= 0:
        return None
    total = (count + last) * (expected[-1] / goal) ** (1 / power)
    return ceil(total - count) if total < MOST_ROWS else None
