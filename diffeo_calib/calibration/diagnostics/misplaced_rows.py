"""Measured values out of step with the joints, for instance because one of two logs lost a line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.row_order import LIMITS as STEP_LIMITS
from diffeo_calib.calibration.diagnostics.row_order import out_of_step, paired
from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.identification.registration import can_register, register
from diffeo_calib.calibration.identification.robust_registration import LIMITS as REGISTRATION_LIMITS
from diffeo_calib.calibration.identification.robust_registration import largest_distances, spread
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.common.hidden_values import largest_known
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.coordinates import marker_tips


@dataclass(frozen=True)
class WindowLimits:
    """Consecutive rows that are registered on their own where the table as a whole fits nowhere.

    Args:
        parts: the table is cut into 2, 3, ... windows of equal length.
        fewest_rows: smallest number of rows of a window.
        lags: tried in this order; lines between the measured values of a window and their joints.
    """

    parts: tuple[int, ...] = (2, 3, 4)
    fewest_rows: int = 10
    lags: tuple[int, ...] = (0, -1, 1, -2, 2)


LIMITS = WindowLimits()


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
    if typical > REGISTRATION_LIMITS.consistent_residual * spread(data.points):
        geometry, typical = _window(robot, data)
    elif int((own > STEP_LIMITS.gross * typical).sum()) < STEP_LIMITS.fewest_rows:
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
    raise MeasurementError.of(
        f"the measurements do not fit this robot: {steps[0].sentence}{more}",
        got=f"{steps[0].rows} rows that fit there, and not at their own joints",
        fix="pair every configuration with its own measured values: was a line lost or doubled there?",
    )


def _refined(robot: Tree, data: Measurements, geometry: Geometry, typical: float) -> tuple[Geometry, float]:
    """The registration of all rows that fit their own joints, and their median distance, m, if they are enough."""
    near = largest_distances(geometry, data) <= STEP_LIMITS.gross * typical
    if int(near.sum()) < LIMITS.fewest_rows or not can_register(data.points[near]):
        return geometry, typical
    again = register(robot, data.q[near], data.points[near], marker_tips(robot, data)).geometry
    return again, float(largest_distances(again, data)[near].median())


def _window(robot: Tree, data: Measurements) -> tuple[Geometry | None, float]:
    """The first registration of consecutive rows that is consistent, and its median distance, m; None if none is."""
    limit = REGISTRATION_LIMITS.consistent_residual * spread(data.points)
    for lag, rows in product(LIMITS.lags, _windows(data)):
        own, other = paired(data.line_numbers[rows], lag)
        if len(own) < LIMITS.fewest_rows:
            continue
        q, points = data.q[rows][other], data.points[rows][own]
        if not can_register(points):
            continue
        geometry = register(robot, q, points, marker_tips(robot, data)).geometry
        typical = float(largest_known((geometry.points(q) - points).norm(dim=-1)).median())
        if typical <= limit:
            return geometry, typical
    return None, torch.inf


def _windows(data: Measurements) -> Iterator[Tensor]:
    """Row numbers of every window, in the order of their lines."""
    order = data.line_numbers.argsort().to(data.q.device)
    for parts in LIMITS.parts:
        yield from order.tensor_split(parts)
