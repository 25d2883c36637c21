"""Rows that are wrong together: out of step with their joints, or one after the other.

Row i measured at lag k belongs to the joints k lines below its own, for instance because one of two logs lost a line. A
lag fits where the prediction of those joints is near the measured points. Every row scores up to one, the better its
lag fits and the worse all others do; the run of rows with the largest sum is out of step if it exceeds the price of its
ends. Rows that look wrong and follow one another are such a run as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from math import log
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.identification.registration import (
    CONSISTENT,
    can_register,
    largest_distances,
    registered_geometry,
    spread,
)
from diffeo_calib.common.errors import MeasurementError, sentence
from diffeo_calib.common.quantiles import largest_known
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import marker_tips


class Step(NamedTuple):
    """Consecutive rows whose measured values belong to the joints of other lines."""

    first: int  # line of the first row
    last: int  # line of the last row
    lag: int  # number of lines to their joints, downwards
    to_the_end: bool  # whether the table ends with these rows
    rows: int  # how many rows are known to fit there

    def sentence(self, before: str = "", after: str = "") -> str:
        """What is wrong, between some words, and what to do: ``from line 32 on the measured values belong to ...``."""
        where = f"from line {self.first} on" if self.to_the_end else f"in lines {self.first} to {self.last}"
        count = f"{abs(self.lag)} line{'s' * (abs(self.lag) > 1)} {'above' if self.lag < 0 else 'below'}"
        return sentence(
            f"{before}{where} the measured values belong to the joints {count}{after}",
            got=f"{self.rows} rows that fit there, and not at their own joints",
            fix="pair every configuration with its own measured values: was a line lost or doubled there?",
        )


def out_of_step(predicted: Tensor, measured: Tensor, line_numbers: Tensor, typical: float) -> list[Step]:
    """Runs of rows whose measured values belong to the joints of other lines, in the order of their lines.

    Args:
        predicted: (N, P, 3) markers at the joints of every row, m. measured: (N, P, 3) m, NaN where hidden.
        line_numbers: (N,) distinct numbers; rows may be missing.
        typical: typical distance of rows that are right, m.
    """
    order = line_numbers.argsort()
    lines, predicted, measured = line_numbers[order], predicted[order], measured[order]
    distances = measured.new_full((2 * gates.LARGEST_LAG + 1, len(lines)), torch.nan)  # to the joints at every lag
    for number, each in enumerate(distances):
        rows, others = _paired(lines, number - gates.LARGEST_LAG)
        each[rows] = largest_known((predicted[others] - measured[rows]).norm(dim=-1))
    costs = (distances / (gates.LAG_NEAR * typical)).square().clamp(max=1.0).nan_to_num(1.0)
    paired, steps = distances[gates.LARGEST_LAG], list[tuple[int, Step]]()
    least, second = costs.topk(2, dim=0, largest=False).values
    scores = torch.where(costs == least, second, least) - costs - gates.LAG_MISFIT * (costs == 1.0) * ~distances.isnan()
    scores[gates.LARGEST_LAG] = -1.0
    while True:
        runs = [(*best_run(each), number) for number, each in enumerate(scores)]
        ends = [gates.LAG_CHANGE_COST * ((start > 0) + (end < len(lines))) for _, start, end, _ in runs]
        gain, start, end, number = max((run[0] - end, *run[1:]) for run, end in zip(runs, ends, strict=True))
        if gain <= 0.0:
            return [step for _, step in sorted(steps)]
        there, scores[:, start:end] = distances[number, start:end], -float(len(lines))
        fits = there <= gates.LAG_NEAR * typical
        moved = int((fits & (paired[start:end] > gates.LAG_GROSS * typical)).sum())
        if moved >= gates.LAG_ROWS and int(fits.sum()) >= gates.LAG_SHARE * int((~there.isnan()).sum()):
            last = end == len(lines)
            steps.append((start, Step(int(lines[start]), int(lines[end - 1]), number - gates.LARGEST_LAG, last, moved)))


def best_run(scores: Tensor) -> tuple[float, int, int]:
    """Largest sum of scores (N,) that follow one another, the first and last + 1 of these; zeros at the ends count."""
    sums = torch.cat([scores.new_zeros(1), scores.cumsum(0)])
    rises = sums - sums.cummin(0).values
    end = int((rises == rises.max()).nonzero()[-1])
    return float(rises[end]), int(sums[: end + 1].argmin()), end


def _paired(line_numbers: Tensor, lag: int) -> tuple[Tensor, Tensor]:
    """Rows of which the row ``lag`` lines below is in the table too, and the numbers of these, by ascending lines."""
    wanted = line_numbers + lag
    at = torch.searchsorted(line_numbers, wanted).clamp(max=len(line_numbers) - 1)
    rows = (line_numbers[at] == wanted).nonzero()[:, 0]
    return rows, at[rows]


def check_row_order(robot: Tree, data: Measurements, registration: Identification) -> None:
    """Refuse measured values that are out of step with the joints from some line on.

    A table that is out of step from its first line to its last is left to ``likely_mistake``. Where the whole table
    fits nowhere, consecutive rows that are consistent by themselves say where the joints of the others are.

    Args:
        robot: n joints. data: N rows. registration: of the whole table.

    Raises:
        MeasurementError: with the line, and where the right joints are.
    """
    away, geometry = largest_distances(registration.geometry, data), registration.geometry
    typical = float(away.median())
    if typical > CONSISTENT * spread(data.points):
        window = next(_consistent(robot, data), None)
        if window is None:
            return
        geometry, typical = window
    elif int((away > gates.LAG_GROSS * typical).sum()) < gates.LAG_ROWS:
        return
    steps = out_of_step(geometry.points(data.q), data.points, data.line_numbers, typical)
    near = largest_distances(geometry, data) <= gates.LAG_GROSS * typical
    if steps and int(near.sum()) >= gates.WINDOW_ROWS and can_register(data.points[near]):  # all that fit say more
        geometry = registered_geometry(robot, data.q[near], data.points[near], marker_tips(robot, data))
        typical = float(largest_distances(geometry, data)[near].median())
        steps = out_of_step(geometry.points(data.q), data.points, data.line_numbers, typical)
    if not steps or (steps[0].to_the_end and steps[0].first == int(data.line_numbers.min())):
        return
    more = f" (and {len(steps) - 1} more such block{'s' * (len(steps) > 2)})" * (len(steps) > 1)
    raise MeasurementError(steps[0].sentence("the measurements do not fit this robot: ", more))


def _consistent(robot: Tree, data: Measurements) -> Iterator[tuple[Geometry, float]]:
    """Registrations of consecutive rows at some lag that are consistent, and their median distances, m."""
    limit, order = CONSISTENT * spread(data.points), data.line_numbers.argsort().to(data.q.device)
    windows = [rows for parts in gates.WINDOW_PARTS for rows in order.tensor_split(parts)]
    for lag, rows in product(gates.WINDOW_LAGS, windows):
        here, other = _paired(data.line_numbers[rows], lag)
        q, points = data.q[rows][other], data.points[rows][here]
        if len(here) >= gates.WINDOW_ROWS and can_register(points):
            geometry = registered_geometry(robot, q, points, marker_tips(robot, data))
            typical = float(largest_known((geometry.points(q) - points).norm(dim=-1)).median())
            if typical <= limit:
                yield geometry, typical


def find_block(wrong: Tensor) -> tuple[int, int] | None:
    """First and last + 1 of the rows (N,), in order, where wrong ones follow one another beyond chance; or None.

    The segment with the largest likelihood ratio of ``gates.BLOCK_SHARE`` against the overall share (S. Karlin,
    S. Altschul, "Methods for assessing the statistical significance of molecular sequence features", 1990).
    """
    count, n = int(wrong.sum()), len(wrong)
    share = count / n
    if count < gates.BLOCK_ROWS or share >= gates.BLOCK_SHARE:
        return None
    gain, loss = log(gates.BLOCK_SHARE / share), log((1 - gates.BLOCK_SHARE) / (1 - share))
    total, start, end = best_run(torch.where(wrong, gain, loss))
    return (start, end) if total > log(n / gates.BLOCK_CHANCE) else None
