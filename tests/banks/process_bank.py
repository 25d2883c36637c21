"""Linearised rows of every kind of device, and their covariance written out in the order of the table."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property

import torch
from product_bank import simulated_poses, sliding_measurements, sliding_robot
from reading_bank import readings, scales
from simulated_sockets import rest_in_sockets
from tangent_bank import normal, shaken
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.placing.place import place
from diffeo_calib.calibration.scales.selection import defaults
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.fitting.result import silent
from diffeo_calib.maps.linearisation import Numbers
from diffeo_calib.process.tails import Tails
from diffeo_calib.regression.conditional import Process
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


def markers(count: int, rows: int) -> dc.Measurements:
    arm = SimulatedArm(seed=3, markers=count)
    return dc.Measurements(*arm.measure(rows, seed=4), arm.nominal.joint_names)


def hidden() -> dc.Measurements:
    """Three markers, of which a third are not seen, in any pattern."""
    data = markers(3, 12)
    gone = normal(12, 3, seed=7) < -0.4
    gone[:, 0] &= ~gone.all(1)
    return dc.Measurements(data.q, data.points.masked_fill(gone[..., None], torch.nan), data.joint_names)


def mixture() -> dc.Measurements:
    """A tracker sees marker 1, and the ball rests in sockets."""
    arm = SimulatedArm(seed=3, markers=2)
    q, points = arm.measure(8, seed=5)
    rows, names = rest_in_sockets(arm, seed=3, places=4, rows=4), arm.nominal.joint_names
    ball = dc.Measurements.from_sockets(rows.q, rows.names, names, distances={("0", "1"): 0.05}, distance_std=1e-5)
    return dc.Measurements.joined([dc.Measurements(q, points[:, 1:], names), ball])


def robot(count: int = 1) -> dc.Tree:
    return SimulatedArm(seed=3, markers=count).nominal


ROWS: dict[str, Callable[[], tuple[dc.Tree, dc.Measurements | dc.Readings]]] = {
    "one marker": lambda: (robot(), markers(1, 14)),
    "three markers": lambda: (robot(3), markers(3, 10)),
    "hidden markers": lambda: (robot(3), hidden()),
    "poses": lambda: (simulated_poses(10)[0].nominal, simulated_poses(10)[1]),
    "sliding": lambda: (sliding_robot(), sliding_measurements(sliding_robot(), 14)),
    "distances": lambda: (robot(), readings(SimulatedArm(seed=3), "distance", 45, noise=2e-5)),
    "mixture": lambda: (robot(2), mixture()),
}


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
