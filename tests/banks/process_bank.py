"""Linearised rows of every kind of device, and their covariance written out in the order of the table."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import torch
from product_bank import erring, sliding_robot
from reading_bank import scales
from source_bank import SOURCES
from tangent_bank import normal, shaken
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.calibration.scales.selection import defaults
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.fitting.result import silent
from diffeo_calib.maps.linearisation import Numbers
from diffeo_calib.regression.conditional import Process
from diffeo_calib.regression.tails import Tails
from diffeo_calib.robots import SimulatedArm

NARROW_M_RAD = 1e-3
"""Prior deviation of the places: formulas with the whole covariance keep their digits."""


@dataclass
class Case:
    """Rows with weights of any size, and scales."""

    data: TangentData
    scales: dc.Hyperparameters

    @cached_property
    def noise(self) -> Tensor:
        """(N, R, R) weighted."""
        return self.data.noise_of_numbers(self.scales)

    @cached_property
    def numbers(self) -> Numbers:
        return self.data.numbers(self.scales)

    @property
    def variance(self) -> Tensor:
        """(K,) of the unknowns, shared shifts last."""
        shifts = self.data.shared.shape[2]
        return torch.cat([self.data.prior_variance(self.scales), torch.ones(shifts, dtype=torch.float64)])

    @cached_property
    def fields(self) -> Tensor:
        """Prior covariance by the fields of all numbers of the table, hidden ones too: (N R, N R)."""
        return self.numbers.at.fields.gram()

    @cached_property
    def unknowns(self) -> Tensor:
        """(N R, K) their derivatives by the unknowns."""
        return self.numbers.at.sensitivity.flatten(0, 1)

    @cached_property
    def posterior(self) -> Process:
        return self.data.process(self.scales)

    def part(self, rows: Tensor) -> Case:
        return Case(self.data.rows(rows), self.scales)


ROWS: dict[str, Callable[[], tuple[dc.Tree, Any]]] = {
    "one marker": lambda: first("positions", 14),
    "two markers": lambda: (SimulatedArm(3).nominal, dc.Measurements(*SimulatedArm(3, markers=2).measure(14, seed=4))),
    "hidden markers": lambda: first("hidden markers", 12),
    "poses": lambda: first("poses", 10),
    "sliding": lambda: (sliding_robot(), erring(sliding_robot(), 14)),
    "distances": lambda: first("distances", 45),
    "mixture": lambda: first("mixture", 40),
}


def first(name: str, rows: int) -> tuple[dc.Tree, Any]:
    """The robot and some rows of a kind."""
    source = SOURCES[name]()
    return source.robot, source.rows.rows(slice(0, rows))


@cache
def case(name: str) -> Case:
    """Every kind once."""
    robot, rows = ROWS[name]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few rows
        placed = place(robot, rows, silent)
    data = placed.tangent_data()
    own = scales() if name == "distances" else defaults(data, placed.identification.noise, placed.identification.prior)
    weights = 0.05 + 0.95 * normal(*data.tails.weights.shape, seed=1).sigmoid()
    weights = torch.where(data.tails.weights == 1.0, weights, data.tails.weights)
    data = replace(data, tails=Tails(4.0, weights), place_deviation=NARROW_M_RAD)
    return Case(data, shaken(own, 2, 0.2))
