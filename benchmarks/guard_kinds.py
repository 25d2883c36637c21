"""Simulated robots of every kind of measurement, with their truth, for guard.py.

A robot is measured four times: rows to calibrate with, new rows of the same set-up, rows of a device that was set up
anew, and rows of that set-up after the transmission errors of one joint have grown threefold. Values are drawn here, so
that predictions are judged without asking the package what was measured.
"""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from simulated_camera import LEVER, MARKS, poses_of
from simulated_sockets import rest_in_sockets
from torch import Tensor
from two_arms_bank import HANDS, TwoArms, robot

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation, transforms

TRAIN, NEW, LATER, WORN = range(4)
"""The four measurements."""
JUDGED, JOINT, GROWTH = 200, 2, 3.0
"""Configurations at which the truth is known; the joint that wears, and the factor on its transmission errors."""
NOISE_M, NOISE_RAD, NOISE_PX = 2e-5, 1e-4, 0.1
MASS_KG = 4.0
"""Payload of the new rows and of the truth, where there are payloads."""
STATIONS = torch.tensor([[1.2, 0.0, 0.2], [-0.6, 1.0, 0.3], [-0.5, -1.1, 0.8]], dtype=torch.float64)
PLANES = torch.tensor([[0.0, 0.0, 1.0], [0.8, 0.0, 0.6], [0.0, 0.8, 0.6]], dtype=torch.float64)
EYES = torch.tensor([[2.8, 0.5, 1.0], [-1.5, 2.5, 1.2], [-0.5, -2.9, 0.2]], dtype=torch.float64)
LOOKED_AT, FOCAL, CENTRE = (0.0, 0.0, 0.4), (3500.0, 3400.0), (1200.0, 1000.0)
"""Of cameras that see the ball; places in the robot's base, m."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Measured rows as a table of the package, and their values.

    Args:
        table: what the verbs take. q: (N, n) rad.
        values: "points" -> (N, P, 3) m, "poses" -> (N, T, 4, 4) m, name of a device -> (N, r) in the unit in which the
            package predicts its readings; NaN where a row has none.
    """

    table: Any
    q: Tensor
    values: dict[str, Tensor]


Truth = Callable[[Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot of a kind.

    Args:
        nominal: what the package is told. rows: the four measurements.
        q: (JUDGED, n) rad, where models are judged. truth: for the rows TRAIN, LATER and WORN a function (N, n) -> true
            points (N, P, 3) or poses (N, T, 4, 4) in the frame of their device, m. flange: true poses (JUDGED, 4, 4) of
            the tip for TRAIN, if there is one.
        free: whether no device measured a place, so that models are judged after a rigid motion.
    """

    nominal: dc.Tree
    rows: dict[int, Rows]
    q: Tensor
    truth: dict[int, Truth]
    flange: Tensor | None = None
    free: bool = False
    payload: float | None = None

    def loaded(self, model: Any) -> Any:
        """The model under the payload of the truth."""
        return model if self.payload is None else model.with_payload(self.payload)


def drawn(seed: tuple[int, ...], *shape: int) -> Tensor:
    """Standard normal numbers."""
    return torch.from_numpy(np.random.default_rng([*seed, 31]).standard_normal(shape))


ELSEWHERE = transforms(
    rotation(torch.tensor([0.2, 0.5, -0.3], dtype=torch.float64)), torch.tensor([0.4, -0.2, 0.3], dtype=torch.float64)
)
"""From the measuring frame to that of the device when it was set up anew."""


def with_base(arm: SimulatedArm, T: Tensor) -> SimulatedArm:
    """The arm seen from elsewhere."""
    other = copy.copy(arm)
    other.truth = replace(arm.truth, base=T @ arm.truth.base)
    return other


def flange_poses(arm: SimulatedArm, q: Tensor, payload: float | None) -> Tensor:
    """True poses (N, 4, 4) of the flange in the measuring frame, m."""
    other = copy.copy(arm)
    other.truth = replace(arm.truth, tool=LEVER * MARKS, on=arm.truth.on[:1] * 3)
    return poses_of(other.true_points(q, payload))


Measure = Callable[[SimulatedArm, int, int, tuple[int, int]], Rows]
"""(arm, count, part, seed) -> rows."""


def built(
    arm: SimulatedArm,
    measure: Measure,
    seed: int,
    counts: tuple[int, int, int, int],
    *,
    order: tuple[int, ...] | None = (0,),
    q: Tensor | None = None,
    stays: bool = False,
    **known: Any,
) -> Robot:
    """The four measurements of an arm.

    Args:
        counts: of rows. order: markers of the arm as the model has them; None for poses. q: where it is judged.
        stays: whether the device that measures places stays where it is.
    """
    moved = torch.eye(4, dtype=torch.float64) if stays else ELSEWHERE
    arms = [arm, arm, with_base(arm, moved), with_base(arm.worn(JOINT, GROWTH), moved)]
    q = arm.sample(JUDGED, seed=seed + 900) if q is None else q
    rows = {part: measure(arms[part], counts[part], part, (seed, part)) for part in range(4)}
    load = known.get("payload")

    def true(part: int, at: Tensor) -> Tensor:
        points = arms[part].true_points(at, load)
        return poses_of(points)[:, None] if order is None else points[:, list(order)]

    truth = {part: partial(true, part) for part in (TRAIN, LATER, WORN)}
    return Robot(arm.nominal, rows, q, truth, flange_poses(arm, q, load), **known)


def sampled(arm: SimulatedArm, count: int, seed: tuple[int, int]) -> Tensor:
    """Configurations (count, 6)."""
    return arm.sample(count, seed=1000 * seed[0] + seed[1] + 1)


# --- devices that measure places ------------------------------------------------------------------------------------


def tracked(arm: SimulatedArm, count: int, part: int, seed: tuple[int, int], markers: tuple[int, ...] = (0,)) -> Rows:
    """Positions of some markers."""
    q = sampled(arm, count, seed)
    points = arm.true_points(q)[:, list(markers)] + NOISE_M * drawn(seed, count, len(markers), 3)
    return Rows(dc.Measurements(q, points, arm.nominal.joint_names), q, {"points": points})


def positions(seed: int) -> Robot:
    """One marker that a tracker sees."""
    return built(SimulatedArm(seed), tracked, seed, (60, 100, 20, 30))


def hidden_markers(seed: int) -> Robot:
    """Three markers, of which some rows show two or one."""

    def measure(arm: SimulatedArm, count: int, part: int, seed: tuple[int, int]) -> Rows:
        whole = tracked(arm, count, part, seed, (0, 1, 2))
        gone = drawn((*seed, 1), count, 3) < -0.5
        gone[gone.all(1), 0] = False
        seen = whole.values["points"].masked_fill(gone[..., None], torch.nan)
        return Rows(dc.Measurements(whole.q, seen, arm.nominal.joint_names), whole.q, {"points": seen})

    return built(SimulatedArm(seed, markers=3), measure, seed, (30, 60, 15, 20), order=(0, 1, 2))


def with_frame(seed: int) -> SimulatedArm:
    """An arm with three marks around a frame on its tool."""
    arm = SimulatedArm(seed, markers=3)
    turned = rotation(torch.tensor([0.3, -0.5, 0.2], dtype=torch.float64))
    arm.truth = replace(arm.truth, tool=arm.truth.tool[:1] + LEVER * MARKS @ turned.mT)
    return arm


def noisy_poses(poses: Tensor, seed: tuple[int, int], noise: float = NOISE_M) -> Tensor:
    """Measured poses (N, T, 4, 4)."""
    draws = drawn(seed, *poses.shape[:2], 6)
    turned = rotation(NOISE_RAD * draws[..., 3:]) @ poses[..., :3, :3]
    return transforms(turned, poses[..., :3, 3] + noise * draws[..., :3])


def posed(arm: SimulatedArm, count: int, part: int, seed: tuple[int, int]) -> Rows:
    """Poses of a frame on the tool."""
    q = sampled(arm, count, seed)
    seen = noisy_poses(poses_of(arm.true_points(q))[:, None], seed)
    return Rows(dc.Measurements.from_poses(q, seen[:, 0], arm.nominal.joint_names), q, {"poses": seen})


def poses(seed: int) -> Robot:
    """A frame on the tool."""
    return built(with_frame(seed), posed, seed, (40, 60, 12, 20), order=None)


def several_tips(seed: int) -> Robot:
    """Poses of both hands, of which some are hidden."""
    with tempfile.TemporaryDirectory() as folder:
        nominal = robot(Path(folder))
    arms = {TRAIN: TwoArms(nominal, seed=seed)}
    arms |= {part: TwoArms(nominal, seed=seed) for part in (NEW, LATER, WORN)}
    arms[WORN].amplitudes[JOINT] *= GROWTH

    def measure(part: int, count: int) -> Rows:
        rng = np.random.default_rng([seed, part, 32])
        q = torch.from_numpy(rng.uniform(-1.3, 1.3, (count, nominal.n)))
        true = arms[part].poses(q)
        seen = noisy_poses(true if part in (TRAIN, NEW) else ELSEWHERE @ true, (seed, part))
        for row in range(4):
            seen[2 * row, row % 2] = torch.nan
        return Rows(dc.Measurements.from_poses(q, seen, nominal.joint_names, on=HANDS), q, {"poses": seen})

    q = torch.from_numpy(np.random.default_rng([seed, 33]).uniform(-1.3, 1.3, (JUDGED, nominal.n)))
    rows = {part: measure(part, count) for part, count in enumerate((30, 60, 12, 20))}
    truth: dict[int, Truth] = {TRAIN: arms[TRAIN].poses}
    truth |= {part: lambda q, part=part: ELSEWHERE @ arms[part].poses(q) for part in (LATER, WORN)}
    return Robot(nominal, rows, q, truth)


def sessions(seed: int) -> Robot:
    """The device was moved once; the model is in the frame of the longer session."""
    shift = transforms(
        rotation(torch.tensor([1e-3, -2e-3, 5e-4], dtype=torch.float64)),
        torch.tensor([5e-3, 2e-3, -4e-3], dtype=torch.float64),
    )

    def measure(arm: SimulatedArm, count: int, part: int, seed: tuple[int, int]) -> Rows:
        whole = tracked(arm, count, part, seed, (0, 1))
        if part != TRAIN:
            return whole
        first, seen = torch.arange(count) % 5 < 2, whole.values["points"]
        seen = torch.where(first[:, None, None], seen @ shift[:3, :3].mT + shift[:3, 3], seen)
        table = dc.Measurements(whole.q, seen, arm.nominal.joint_names)
        return Rows(table.with_sessions(["ab"[k] for k in (~first).long().tolist()]), whole.q, {})

    return built(SimulatedArm(seed, markers=2), measure, seed, (50, 60, 20, 30), order=(0, 1))


def mounted_anew(seed: int) -> Robot:
    """The marker was mounted anew twice; the model's is that of the longest session."""
    shifts = torch.tensor([[0.0, 0.0, 0.0], [3e-3, -4e-3, 0.0], [-2e-3, 1e-3, 4.5e-3]], dtype=torch.float64)

    def measure(arm: SimulatedArm, count: int, part: int, seed: tuple[int, int]) -> Rows:
        whole = tracked(arm, count, part, seed)
        if part != TRAIN:
            return whole
        turn = torch.arange(count) % 5
        whose = torch.where(turn < len(shifts), turn, 0)
        turned = flange_poses(arm, whole.q, None)[:, :3, :3] @ shifts[whose][..., None]
        table = dc.Measurements(whole.q, whole.values["points"] + turned.mT, arm.nominal.joint_names)
        return Rows(table.with_sessions(["abc"[k] for k in whose.tolist()], remounted=True), whole.q, {})

    return built(SimulatedArm(seed), measure, seed, (75, 60, 20, 30))


def payloads(seed: int) -> Robot:
    """Three masses, a column of the table."""

    def measure(arm: SimulatedArm, count: int, part: int, seed: tuple[int, int]) -> Rows:
        rng, q = np.random.default_rng([*seed, 34]), sampled(arm, count, seed)
        masses = torch.from_numpy(rng.choice([0.0, MASS_KG, 10.0], count) if part == TRAIN else np.full(count, MASS_KG))
        points = arm.true_points(q, masses) + NOISE_M * drawn(seed, count, 1, 3)
        table = dc.Measurements(q, points, arm.nominal.joint_names).with_payload(masses)
        return Rows(table, q, {"points": points})

    return built(SimulatedArm(seed), measure, seed, (60, 60, 20, 30), payload=MASS_KG)


# --- a ball -----------------------------------------------------------------------------------------------------------


def resting(arm: SimulatedArm, part: int, seed: tuple[int, int], places: int, rows: int) -> Rows:
    """The ball, marker 0, in the sockets of a block."""
    for attempt in range(20):
        try:
            found = rest_in_sockets(arm, 1000 * attempt + 10 * seed[0] + part, places=places, rows=rows)
            break
        except dc.DiffeoCalibError:  # the arm does not reach all places
            continue
    names = [f"{part}.{name}" for name in found.names]
    table = dc.Measurements.from_sockets(
        found.q, names, arm.nominal.joint_names, distances={("0", "1"): 0.05}, distance_std=1e-5
    )
    return Rows(table, found.q, {})


def ball_in_sockets(seed: int) -> Robot:
    """No device: a ball in the sockets of a block."""
    blocks = {TRAIN: (6, 8), NEW: (3, 8), LATER: (2, 6), WORN: (3, 8)}
    return built(
        SimulatedArm(seed),
        lambda arm, _, part, own: resting(arm, part, own, *blocks[part]),
        seed,
        (0, 0, 0, 0),
        free=True,
    )


def mixture(seed: int) -> Robot:
    """A tracker sees marker 1; marker 0 is the ball."""

    def measure(arm: SimulatedArm, count: int, part: int, seed: tuple[int, int]) -> Rows:
        seen = tracked(arm, count, part, seed, (1,))
        if part == NEW:
            return seen
        table = dc.Measurements.joined([seen.table, resting(arm, part, seed, 3, 5).table])
        return Rows(table, seen.q, {})

    return built(SimulatedArm(seed, markers=2), measure, seed, (25, 60, 12, 20), order=(1, 0))


def ball_cameras() -> Tensor:
    """Transforms (C, 4, 4) from the base to cameras that look at a point above it."""
    z = torch.nn.functional.normalize(torch.tensor(LOOKED_AT, dtype=torch.float64) - EYES, dim=1)
    x = torch.nn.functional.normalize(torch.stack([z[:, 1], -z[:, 0], torch.zeros_like(z[:, 0])], 1), dim=1)
    R = torch.stack([x, torch.linalg.cross(z, x), z], 1)
    return transforms(R, -(R @ EYES[:, :, None])[..., 0])


def read(arm: SimulatedArm, kind: str, count: int, seed: tuple[int, int], zero: float = 0.0) -> Rows:
    """Readings of the ball, marker 0, by three devices in turn that stay where they are."""
    q, which = sampled(arm, count, (seed[0], seed[1] + 10)), torch.arange(count) % 3
    names, joints = [f"{kind} {number}" for number in which.tolist()], arm.nominal.joint_names
    z = (arm.true_points(q)[:, 0] - arm.truth.base[:3, 3]) @ arm.truth.base[:3, :3]
    if kind == "image":
        seen = (ball_cameras()[which] @ torch.nn.functional.pad(z, (0, 1), value=1.0)[..., None])[:, :3, 0]
        values = seen[:, :2] / seen[:, 2:] * z.new_tensor(FOCAL) + z.new_tensor(CENTRE)
        values = values + 0.25 * NOISE_PX * drawn(seed, count, 2)
        table = dc.Readings.images(q, values, names, joints, focal=FOCAL, centre=CENTRE)
    elif kind == "distance":
        values = (z - STATIONS[which]).norm(dim=1) + zero + NOISE_M * drawn(seed, count)
        table = dc.Readings.distances(q, values, names, joints, offset_std=0.1 if zero else 0.0)
    else:
        values = (z * PLANES[which]).sum(1) - 0.3 + NOISE_M * drawn(seed, count)
        table = dc.Readings.heights(q, values, names, joints)
    shown = values if kind == "image" else 1e3 * values[:, None]
    own = {name: (which == number) for number, name in enumerate(dict.fromkeys(names))}
    return Rows(table, q, {name: shown.masked_fill(~rows[:, None], torch.nan) for name, rows in own.items()})


def readings(seed: int, kind: str, zero: float = 0.0) -> Robot:
    """Three devices of one kind that read the ball."""
    return built(
        SimulatedArm(seed),
        lambda arm, count, _, own: read(arm, kind, count, own, zero),
        seed,
        (96, 60, 40, 60),
        free=True,
    )


def together(*tables: Rows) -> Rows:
    """Rows of several kinds in one table."""
    values, first, count = dict[str, Tensor](), 0, sum(len(own.q) for own in tables)
    for own in tables:
        for name, seen in own.values.items():
            values[name] = seen.new_full((count, *seen.shape[1:]), torch.nan)
            values[name][first : first + len(own.q)] = seen
        first += len(own.q)
    q = torch.cat([own.q for own in tables])
    return Rows(dc.Observations.joined([own.table for own in tables]), q, values)


def several_kinds(seed: int) -> Robot:
    """A tracker sees marker 1; the ball, marker 0, is seen by three kinds of devices."""

    def measure(arm: SimulatedArm, count: int, part: int, seed: tuple[int, int]) -> Rows:
        devices = [read(arm, kind, count, seed) for kind in ("distance", "height", "image")]
        return together(tracked(arm, 20 if part == WORN else 40 if part == TRAIN else 15, part, seed, (1,)), *devices)

    return built(SimulatedArm(seed, markers=2), measure, seed, (40, 30, 30, 30), order=(1, 0))


def laser_beams(seed: int) -> Robot:
    """A kind of device from outside of the package, beside positions of marker 1."""

    def measure(arm: SimulatedArm, count: int, part: int, seed: tuple[int, int]) -> Rows:
        from laser_line import readings  # noqa: PLC0415  # registers its kind

        q = sampled(arm, count, (seed[0], seed[1] + 20))
        table = readings(arm, q)
        seen = tracked(arm, 40 if part == TRAIN else 20, part, seed, (1,))
        which = torch.arange(count) % 2
        lengths = 1e3 * torch.as_tensor(table.values).view(-1, 1)
        own = {name: lengths.masked_fill((which != k)[:, None], torch.nan) for k, name in enumerate("AB")}
        return together(seen, Rows(table, q, own))

    return built(SimulatedArm(seed, markers=2), measure, seed, (100, 60, 40, 60), order=(1, 0))


def inclinations(seed: int) -> Robot:
    """An inclinometer on the tool, beside poses of it."""

    def measure(arm: SimulatedArm, count: int, part: int, seed: tuple[int, int]) -> Rows:
        from inclinometer import readings  # noqa: PLC0415  # registers its kind

        table = readings(arm, sampled(arm, 3 * count, (seed[0], seed[1] + 20)))
        return together(posed(arm, count, part, seed), Rows(table, table.q, {}))

    return built(with_frame(seed), measure, seed, (40, 40, 12, 20), order=None)


KINDS: dict[str, Callable[[int], Robot]] = {
    "positions": positions,
    "hidden markers": hidden_markers,
    "poses": poses,
    "several tips": several_tips,
    "sessions": sessions,
    "markers mounted anew": mounted_anew,
    "payloads": payloads,
    "ball in sockets": ball_in_sockets,
    "mixture": mixture,
    "distances": partial(readings, kind="distance"),
    "distances of unknown zero": partial(readings, kind="distance", zero=0.03),
    "heights": partial(readings, kind="height"),
    "images": partial(readings, kind="image"),
    "several kinds": several_kinds,
    "laser beams": laser_beams,
    "inclinations": inclinations,
}
"""Kind -> the robot of a seed."""
