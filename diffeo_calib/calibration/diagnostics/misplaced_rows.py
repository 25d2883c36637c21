"""Measured values out of step with the joints, for instance because one of two logs lost a line.

Row i measured at lag k belongs to the joints k lines below its own. A lag fits where the prediction of those joints is
near the measured points. The most likely lags along the table are a shortest path: every row costs up to one, less the
better its lag fits, and every change of the lag costs as much as a few rows that fit nowhere.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.identification.registration import (
    ROBUST,
    can_register,
    largest_distances,
    register,
    spread,
)
from diffeo_calib.common.errors import MeasurementError, sentence
from diffeo_calib.common.quantiles import largest_known
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import marker_tips


class Step(NamedTuple):
    """Consecutive rows whose measured values belong to the joints of other lines.

    Args:
        first: line of the first row. last: line of the last row. lag: number of lines to their joints, downwards.
        to_the_end: whether the table ends with these rows. rows: how many rows are known to fit there.
    """

    first: int
    last: int
    lag: int
    to_the_end: bool
    rows: int

    @property
    def words(self) -> str:
        """Such as ``from line 32 on the measured values belong to the joints 1 line above``."""
        where = f"from line {self.first} on" if self.to_the_end else f"in lines {self.first} to {self.last}"
        count = f"{abs(self.lag)} line{'s' * (abs(self.lag) > 1)}"
        return f"{where} the measured values belong to the joints {count} {'above' if self.lag < 0 else 'below'}"

    def sentence(self, before: str = "", after: str = "") -> str:
        """What is wrong, between some words, and what to do."""
        return sentence(
            f"{before}{self.words}{after}",
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
        rows, others = paired(lines, number - gates.LARGEST_LAG)
        each[rows] = largest_known((predicted[others] - measured[rows]).norm(dim=-1))
    costs = (distances / (gates.LAG_NEAR * typical)).square().clamp(max=1.0).nan_to_num(1.0)
    path = _cheapest_path(costs, gates.LAG_CHANGE_COST)
    own, steps = distances[gates.LARGEST_LAG], []
    starts = [row for row in range(len(path)) if row == 0 or path[row] != path[row - 1]]
    for start, end in zip(starts, [*starts[1:], len(path)], strict=True):
        fits = distances[path[start], start:end] <= gates.LAG_NEAR * typical
        known = int((~distances[path[start], start:end].isnan()).sum())
        moved = fits & (own[start:end] > gates.LAG_GROSS * typical)
        lag = path[start] - gates.LARGEST_LAG
        if lag and int(moved.sum()) >= gates.LAG_ROWS and int(fits.sum()) >= gates.LAG_SHARE * known:
            place = int(lines[start]), int(lines[end - 1])
            steps.append(Step(*place, lag, end == len(lines), int(moved.sum())))
    return steps


def paired(line_numbers: Tensor, lag: int) -> tuple[Tensor, Tensor]:
    """Rows of which the row ``lag`` lines below is in the table too, and the numbers of these rows.

    Args:
        line_numbers: (N,) distinct numbers in ascending order.
    """
    wanted = line_numbers + lag
    at = torch.searchsorted(line_numbers, wanted).clamp(max=len(line_numbers) - 1)
    rows = (line_numbers[at] == wanted).nonzero()[:, 0]
    return rows, at[rows]


def _cheapest_path(costs: Tensor, change_cost: float) -> list[int]:
    """The state of every row that minimises the sum of its costs (states, N) and of the changes: N states."""
    total, before = costs[:, 0], []
    for column in costs.unbind(1)[1:]:
        best = int(total.argmin())
        changed = total > total[best] + change_cost
        before.append(torch.where(changed, best, torch.arange(len(total), device=total.device)))
        total = torch.where(changed, total[best] + change_cost, total) + column
    path = [int(total.argmin())]
    for previous in reversed(before):
        path.append(int(previous[path[-1]]))
    return path[::-1]


def check_row_order(robot: Tree, data: Measurements, registration: Identification) -> None:
    """Refuse measured values that are out of step with the joints from some line on.

    A table that is out of step from its first line to its last is left to ``likely_mistake``.

    Args:
        robot: n joints. data: N rows. registration: of the whole table.

    Raises:
        MeasurementError: with the line, and where the right joints are.
    """
    own = largest_distances(registration.geometry, data)
    typical = float(own.median())
    geometry: Geometry | None = registration.geometry
    if typical > ROBUST.consistent_residual * spread(data.points):
        geometry, typical = _window(robot, data)
    elif int((own > gates.LAG_GROSS * typical).sum()) < gates.LAG_ROWS:
        return
    if geometry is None:
        return
    steps = out_of_step(geometry.points(data.q), data.points, data.line_numbers, typical)
    if steps:
        geometry, typical = _refined(robot, data, geometry, typical)
        steps = out_of_step(geometry.points(data.q), data.points, data.line_numbers, typical)
    if not steps or (steps[0].to_the_end and steps[0].first == int(data.line_numbers.min())):
        return
    more = f" (and {len(steps) - 1} more such block{'s' * (len(steps) > 2)})" * (len(steps) > 1)
    raise MeasurementError(steps[0].sentence("the measurements do not fit this robot: ", more))


def _refined(robot: Tree, data: Measurements, geometry: Geometry, typical: float) -> tuple[Geometry, float]:
    """The registration of all rows that fit their own joints, and their median distance, m, if they are enough."""
    near = largest_distances(geometry, data) <= gates.LAG_GROSS * typical
    if int(near.sum()) < gates.WINDOW_ROWS or not can_register(data.points[near]):
        return geometry, typical
    again = register(robot, data.q[near], data.points[near], marker_tips(robot, data)).geometry
    return again, float(largest_distances(again, data)[near].median())


def _window(robot: Tree, data: Measurements) -> tuple[Geometry | None, float]:
    """The first registration of consecutive rows that is consistent, and its median distance, m; None if none is."""
    limit = ROBUST.consistent_residual * spread(data.points)
    order = data.line_numbers.argsort().to(data.q.device)
    windows = [rows for parts in gates.WINDOW_PARTS for rows in order.tensor_split(parts)]
    for lag, rows in product(gates.WINDOW_LAGS, windows):
        own, other = paired(data.line_numbers[rows], lag)
        if len(own) < gates.WINDOW_ROWS:
            continue
        q, points = data.q[rows][other], data.points[rows][own]
        if not can_register(points):
            continue
        geometry = register(robot, q, points, marker_tips(robot, data)).geometry
        typical = float(largest_known((geometry.points(q) - points).norm(dim=-1)).median())
        if typical <= limit:
            return geometry, typical
    return None, torch.inf
