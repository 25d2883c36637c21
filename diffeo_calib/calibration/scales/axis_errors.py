"""Axes whose errors depend on their own position: guides that are not straight, bearings that wobble.

Errors of all six directions before a joint are part of the model if they raise the evidence of the rows, beside scales
without them, by more than a gate. Their sizes and their length scale are the likeliest on a grid, where the search for
all scales then starts.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import sentence, warn_user
from diffeo_calib.process.evidence import Evidence
from diffeo_calib.process.scales import Hyperparameters, axis_deviations
from diffeo_calib.regression.conditional import Process
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.runtime.build import axis_waves
from diffeo_calib.runtime.chain import Waves, wave_angles

FUNCTIONS, MARGIN = 10, 0.125
"""Functions of an axis, and the part of its measured range by which theirs is longer on both sides: they vary there,
and regions widen."""
MIDDLE = 0.3, 0.2
GRID = (0.1, 0.3, 1.0, 3.0), (0.1, 0.2, 0.4, 0.8)
"""Turns per shift, rad/m, of which either shrinks further in the search, but would hardly grow from zero, and length
scales, as a part of the range. First the middle is tried alone."""
SHIFTS_M = torch.logspace(-6, -2, 25, dtype=torch.float64, device="cpu")
PLAUSIBLE = 3.0
"""Log odds in the middle of the grid below which the rest is not tried."""
STILL, TOLD_APART = 1e-3, 6.0
"""Range of a joint, rad or m, below which its axis is not sought. Log odds by which a base that drifts explains the
rows better than an axis."""
FEWEST_ROWS, ODDS, MOST_COORDINATES = 40, 6.0, 2000
"""Rows below which such errors prove nothing, as 10 and 15 of clean tables that had log odds above 6. Log odds from
which they are part of the model: at most 3.8 in 57 clean tables of many kinds (30 to 223 rows), and 5.0 in eleven of a
UR10 and a Franka; two of a Panda had 8.9 and 6.6, and errors 1.4 % smaller with them. Measured coordinates that say
so."""


class Axis(NamedTuple):
    """A moving joint, its range and the count of functions, with the likeliest sizes and length scale."""

    own: tuple[int, float, float, int]
    effects: Tensor  # (M, 6 K) of the coefficients on the numbers of rows
    odds: float
    errors: Tensor  # (2,) shift, m, and turn, rad
    lengthscale: Tensor  # () as a part of the range


def with_axis_errors(data: TangentData, scales: Hyperparameters, lines: Tensor) -> Hyperparameters:
    """The scales with the axes whose errors the rows prove, one after the other; the same object without any.

    Rows that are measured along an axis, in the order of ``lines`` (N,), take errors of the axis for those of a base
    that drifts, with the same functions: they are of the base where that explains them clearly better.
    """
    chain, found = data.nominal.geometry.chain, list[Axis]()
    if is_cartesian(chain) or len(data.x) < FEWEST_ROWS:  # commanded poses have no axes
        return scales
    index, some = data.sample(len(data.x), MOST_COORDINATES, seed=0)
    values = torch.cat([chain.moving_values(data.x), lines.argsort().argsort().to(data.x)[:, None]], 1)
    ranges = torch.stack([values.amin(0), values.amax(0)])
    process, rest = some.process(scales), {*(ranges[1] - ranges[0] > STILL).nonzero()[:, 0].tolist()}
    while rest:
        tried = [_axis(joint, some, process, values[index], ranges[:, joint]) for joint in rest]
        best = max(tried, key=lambda one: one.odds - TOLD_APART * (one.own[0] == chain.moving))
        if best.odds < ODDS:
            break
        drift = max((one.odds for one in tried if one.own[0] == chain.moving), default=0.0)
        if best.own[0] < chain.moving and drift > max(ODDS, best.odds - TOLD_APART):
            what = f"errors by the position of {chain.moving_names[best.own[0]]} may be a drift of the device as well"
            fix = "measure some of its positions again at another time"
            warn_user(sentence(what, expected="rows in random order", fix=fix))
        found.append(best)
        rest = {one.own[0] for one in tried if one.odds > PLAUSIBLE} - {best.own[0]}
        process = process.opened(best.effects * axis_deviations(best.errors, best.lengthscale, FUNCTIONS), 1.0)
    found = [one for one in found if one.own[0] < chain.moving]
    if not found:
        return scales
    errors, lengths = torch.stack([one.errors for one in found]), torch.stack([one.lengthscale for one in found])
    return replace(scales, axes=tuple(one.own for one in found), axis_errors=errors, axis_lengthscale=lengths)


def _axis(joint: int, data: TangentData, process: Process, values: Tensor, ends: Tensor) -> Axis:
    """The likeliest errors of the axis of a moving joint, or of the base by the last of the values (N, L + 1)."""
    low, high = ends.tolist()
    margin, own = MARGIN * (high - low), 6 * ((joint + 1) % values.shape[1])
    axis = joint, low - margin, high + margin, FUNCTIONS
    waves = Waves(*(torch.from_numpy(part).to(values.device) for part in axis_waves([axis], values.shape[1])))
    functions = wave_angles(waves, values, torch).cos()  # (N, K)
    effects = (data.sensitivities[:, :, None, own : own + 6] * functions[:, None, :, None]).flatten(2)
    E = process.numbers.of_table(data.motions_in_numbers(effects))
    seen, found = Evidence.of(E, process), list[Axis]()
    for ratio, lengthscale in (MIDDLE, *product(*GRID)):
        errors, length = E.new_tensor([1.0, ratio]), E.new_tensor(lengthscale)
        shape = axis_deviations(errors, length, FUNCTIONS)
        odds = Evidence(shape * seen.g, shape[:, None] * seen.H * shape).log_odds(SHIFTS_M.to(E).square())
        found.append(Axis(axis, E, float(odds.max()), errors * SHIFTS_M[int(odds.argmax())].to(E), length))
        if found[0].odds < PLAUSIBLE:
            break
    return max(found, key=lambda one: one.odds)
