"""Axes whose errors depend on their own position: guides that are not straight, bearings that wobble.

A joint's axis is one if its errors raise the evidence of rows, beside scales without them, by more than a gate. Their
two sizes and their length scale are the likeliest on a grid; the search for all scales starts there.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.hypotheses import Evidence, opened
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.process.process import Process
from diffeo_calib.process.scales import Hyperparameters, axis_spectrum
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.position_errors import PositionErrors
from diffeo_calib.runtime.chain import wave_angles

FUNCTIONS, MARGIN = 10, 0.125
"""Functions of an axis, and the part of its measured range by which theirs is longer on both sides: they vary there,
and regions widen."""
LENGTHS = (0.1, 0.2, 0.4, 0.8)
"""Of the grid, as a part of the range."""
TURNS_PER_SHIFT = (0.1, 0.3, 1.0, 3.0)
"""Of the grid, rad/m. Either shrinks further in the search, but would hardly grow from zero."""
SIZES = torch.logspace(-6, -2, 25, dtype=torch.float64, device="cpu")
"""Of the grid, m."""
PLAUSIBLE = 3.0
"""Log odds by the middle of the grid below which the rest of it is not tried."""


class Axis(NamedTuple):
    """Errors of an axis: effects (M, 6 K) of their coefficients on numbers, log odds, and the likeliest scales."""

    axis: tuple[int, float, float, int]
    effects: Tensor
    odds: float
    errors: tuple[float, float]  # shift, m, and turn, rad
    lengthscale: float

    @property
    def deviations(self) -> Tensor:
        """(6 K,) of the coefficients."""
        return _deviations(self.effects, self.lengthscale, *self.errors)


def with_axis_errors(data: TangentData, scales: Hyperparameters) -> Hyperparameters:
    """The scales with the axes whose errors the rows prove, one after the other."""
    chain = data.nominal.geometry.chain
    if is_cartesian(chain) or len(data.x) < gates.AXIS_ROWS:  # commanded poses have no axes
        return scales
    some, found = data.sample(len(data.x), gates.JUDGED_COORDINATES, seed=0)[1], list[Axis]()
    process, rest = some.process(scales), set(range(chain.moving))
    while rest:
        tried = [_axis(axis, some, process, data.x) for axis in rest]
        rest = {one.axis[0] for one in tried if one.odds > PLAUSIBLE}
        best = max(tried, key=lambda one: one.odds)
        if best.odds < gates.AXIS_ODDS:
            break
        found.append(best)
        rest.remove(best.axis[0])
        process = opened(process, best.effects * best.deviations, 1.0)
    if not found:
        return scales
    found.sort()
    errors, lengths = (data.x.new_tensor([one[k] for one in found]) for k in (3, 4))
    return replace(scales, axes=tuple(one.axis for one in found), axis_errors=errors, axis_lengthscale=lengths)


def _axis(number: int, data: TangentData, process: Process, x: Tensor) -> Axis:
    """The likeliest errors of a moving joint's axis over its range in all rows x."""
    chain = data.nominal.geometry.chain
    values = chain.moving_values(x)[:, number]
    low, high = float(values.min()), float(values.max())
    margin = max(MARGIN * (high - low), 1e-6)
    axis = number, low - margin, high + margin, FUNCTIONS
    waves = PositionErrors(axes=(axis,)).of_axes(chain.moving, x)
    functions = wave_angles(waves, chain.moving_values(data.x), torch).cos()  # (N, K)
    twists = data.sensitivities[..., 6 + 6 * number : 12 + 6 * number]
    effects = (twists[:, :, None] * functions[:, None, :, None]).flatten(2)
    E = process.numbers.of_table(data.motions_in_numbers(effects))
    seen, best = Evidence.of(E, process), Axis(axis, E, 0.0, (0.0, 0.0), 1.0)
    for lengths, ratios in (((LENGTHS[1],), (0.3,)), (LENGTHS, TURNS_PER_SHIFT)):
        for lengthscale in lengths:
            for ratio in ratios:
                shape = _deviations(E, lengthscale, 1.0, ratio)
                one = Evidence(shape * seen.g, shape[:, None] * seen.H * shape)
                odds = one.log_odds(SIZES.to(E).square() / max(1.0, ratio) ** 2)
                if float(odds.max()) > best.odds:
                    size = float(SIZES[int(odds.argmax())]) / max(1.0, ratio)
                    best = Axis(axis, E, float(odds.max()), (size, ratio * size), lengthscale)
        if best.odds < PLAUSIBLE:
            break
    return best


def _deviations(like: Tensor, lengthscale: float, shift: float, turn: float) -> Tensor:
    spectrum = axis_spectrum(like.new_tensor(lengthscale), FUNCTIONS)
    return (spectrum[:, None] * like.new_tensor([shift, turn]).repeat_interleave(3)).flatten()
