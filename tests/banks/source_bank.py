"""Tables of every kind of measurement, and of several kinds in one, of simulated robots whose truth is known."""

import copy
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import inclinometer
import laser_line
import numpy as np
import reading_bank
import torch
import two_arms_bank
from numbers_bank import normal, tensor
from product_bank import simulated_poses, usual_scales
from reading_bank import DISTANCES
from simulated_camera import camera_arm, fixed_camera_arm, images_of_both
from simulated_sockets import rest_in_sockets
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.poses import mark_points
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.process.scales import GearLine
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import twist_transform

Truth = Callable[[Tensor], Tensor]
"""Joint values (N, n) -> true markers (N, P, 3) in the order of the model's, m, in any frame that does not move."""


@dataclass(frozen=True)
class Source:
    """Rows of a simulated robot, its scales (None: searched) and its truth.

    worst_mm: the largest RMS error, mm, of a model of them, after a rigid fit.
    """

    robot: dc.Tree
    rows: Any
    scales: dc.Hyperparameters | None
    truth: Truth
    worst_mm: float


def of_arm(
    arm: SimulatedArm,
    rows: Any,
    worst_mm: float,
    order: tuple[int, ...] = (0,),
    mass: float | None = None,
    **scales: Any,
) -> Source:
    """Rows of the arm; the model's markers in the order of the arm's."""
    own = replace(usual_scales(arm.nominal), **scales)
    return Source(arm.nominal, rows, own, lambda q: arm.true_points(q, mass)[:, list(order)], worst_mm)


def tracked(arm: SimulatedArm, rows: int, seed: int, only: int | None = None) -> dc.Measurements:
    """A tracker sees all markers, or one of them."""
    q, points = arm.measure(rows, seed=seed)
    return dc.Measurements(q, points if only is None else points[:, [only]], arm.nominal.joint_names)


def resting(arm: SimulatedArm, places: int, rows: int) -> dc.Measurements:
    """A ball in the sockets of a block of known length."""
    found = rest_in_sockets(arm, seed=3, places=places, rows=rows)
    return dc.Measurements.from_sockets(
        found.q, found.names, arm.nominal.joint_names, distances=DISTANCES, distance_std=1e-5
    )


def _positions(rows: int) -> Source:
    arm = SimulatedArm(seed=1)
    return of_arm(arm, tracked(arm, rows, 2), 0.2)


def _poses() -> Source:
    arm, rows, _ = simulated_poses(40)
    return of_arm(arm, rows, 0.25, (0, 1, 2))


def _hidden() -> Source:
    """Three markers, of which some rows show two or one."""
    arm = SimulatedArm(seed=1, markers=3)
    whole = tracked(arm, 30, 2)
    gone = torch.rand(30, 3, generator=torch.Generator().manual_seed(0)) < 0.3
    gone[gone.all(1), 0] = False
    rows = with_attributes(whole, points=whole.points.masked_fill(gone[..., None], torch.nan))
    return of_arm(arm, rows, 0.25, (0, 1, 2))


def _tips() -> Source:
    """Poses of both hands, some of them hidden; each stands for three points."""
    with tempfile.TemporaryDirectory() as folder:
        robot = two_arms_bank.robot(Path(folder))
    arms = two_arms_bank.TwoArms(robot)
    rows = arms.measured(30, hidden=4)
    truth: Truth = lambda q: mark_points(arms.poses(q).flatten(0, 1), LEVER).view(len(q), -1, 3)  # noqa: E731
    return Source(robot, rows, usual_scales(robot), truth, 0.2)


MOVED = twist_transform(tensor([5e-3, 2e-3, -4e-3, 1e-3, -2e-3, 0.5e-3]))
"""From the frame of the larger session to that of the other one."""


def _sessions(rows: int, *, wrong: bool = False) -> Source:
    """The device was moved once; its larger session is the second one. One row may be wrong."""
    arm = SimulatedArm(seed=5, markers=2)
    q, points = arm.measure(rows, seed=1)
    first = torch.arange(rows) % 5 < 2
    points = torch.where(first[:, None, None], points @ MOVED[:3, :3].mT + MOVED[:3, 3], points)
    points[20, 0, 0] += 0.05 * wrong
    names = ["Monday" if one else "Friday" for one in first.tolist()]
    return of_arm(arm, dc.Measurements(q, points, arm.nominal.joint_names).with_sessions(names), 0.25, (0, 1))


MOUNTED = tensor([[0.0, 0.0, 0.0], [3e-3, -4e-3, 0.0], [-2e-3, 1e-3, 4.5e-3]])
"""Places of the marker in three sessions, from that of the first, in the frame of the tip, m."""


def remounted(arm: SimulatedArm, rows: dc.Measurements, shifts: Tensor = MOUNTED) -> dc.Measurements:
    """Rows of one marker as those of sessions in turn, for each of which it was mounted anew; "a" has most rows."""
    turn = torch.arange(len(rows)) % 5
    whose = torch.where(turn < len(shifts), turn, 0)
    turns = arm.truth.marker_poses(rows.q)[..., :3, :3]
    moved = rows.shifted((turns @ shifts[whose][:, None, :, None])[..., 0])
    return moved.with_sessions(["abcdefg"[number] for number in whose.tolist()], remounted=True)


def _remounted() -> Source:
    arm = SimulatedArm(seed=1)
    return of_arm(arm, remounted(arm, tracked(arm, 96, 2)), 0.2)


def laden(arm: SimulatedArm, rows: int, seed: int) -> dc.Measurements:
    """Under payloads that change from row to row."""
    masses = torch.from_numpy(np.random.default_rng(0).choice([0.0, 4.0, 10.0], rows))
    return dc.Measurements(*arm.measure(rows, seed=seed, payload=masses)).with_payload(masses)


def _payloads() -> Source:
    arm = SimulatedArm(seed=1)
    return of_arm(arm, laden(arm, 56, 1), 0.25, mass=4.0, payload=1.5)


def _sockets() -> Source:
    arm = SimulatedArm(seed=0)
    return of_arm(arm, resting(arm, places=5, rows=6), 2.0)


def _mixture() -> Source:
    """The ball is marker 0; a tracker sees marker 1."""
    arm = SimulatedArm(seed=3, markers=2)
    rows = dc.Measurements.joined([tracked(arm, 25, 5, 1), resting(arm, places=3, rows=5)])
    return of_arm(arm, rows, 0.5, (1, 0), other_noise=tensor(2e-5))


def _readings(kind: str, worst_mm: float, zero: float = 0.0) -> Source:
    arm = SimulatedArm(0)
    found = of_arm(arm, reading_bank.readings(arm, kind, 96, zero, noise=2e-5), worst_mm)
    return replace(found, scales=reading_bank.scales())


def _camera() -> Source:
    """A camera on the tool, whose program tells poses."""
    seen = camera_arm(30)
    return of_arm(seen.arm, seen.measured(1e-4, 1e-3), 1.0, (0, 1, 2))


def _images(*, tracker: bool = False) -> Source:
    """A camera on the tool and a printed board; in other rows a tracker's marker on the same tool."""
    seen, other = camera_arm(60), SimulatedArm(seed=1)
    rows: Any = seen.images(0.1)
    if tracker:
        arm = copy.copy(seen.arm)
        arm.truth = replace(arm.truth, base=other.truth.base, tool=other.truth.tool, on=other.truth.on)
        q = arm.sample(40, seed=3)
        noise = normal(40, 1, 3, seed=3, size=2e-5)
        points = dc.Measurements(q, arm.true_points(q) + noise, arm.nominal.joint_names)
        rows = dc.Observations.joined([rows, points])  # pyright: ignore
    return of_arm(seen.arm, rows, 0.3, (0, 1, 2))


def _two_cameras(*, on_tool: bool) -> Source:
    """Two cameras and a printed board, one of which is on the tool."""
    arms = [(camera_arm if on_tool else fixed_camera_arm)(70, second=second) for second in (False, True)]
    return of_arm(arms[0].arm, images_of_both(arms, (33, 27), 0.1, on_tool=on_tool), 0.3, (0, 1, 2))


def _several() -> Source:
    """A tracker sees marker 1; the ball, marker 0, is seen by three kinds of devices."""
    arm = SimulatedArm(0, markers=2)  # a distance's closed form needs 17 rows of a device
    each = [reading_bank.readings(arm, kind, 96, noise=2e-5) for kind in ("distance", "height", "image")]
    found = of_arm(arm, dc.Observations.joined([tracked(arm, 40, 5, 1), *each]), 0.15, (1, 0))  # pyright: ignore
    return replace(found, scales=reading_bank.scales())


def _beams() -> Source:
    """A kind of device from outside the package: distances of the ball from lines, beside positions of a marker."""
    arm = SimulatedArm(0, markers=2)
    rows = [tracked(arm, 40, 5, 1), laser_line.readings(arm, arm.sample(160, seed=6))]
    found = of_arm(arm, dc.Observations.joined(rows), 0.25, (1, 0))
    return replace(found, scales=reading_bank.scales())


def _inclinations() -> Source:
    """One that sees a frame: two angles of the tool against gravity, beside its poses."""
    arm, poses, _ = simulated_poses(40)
    rows: Any = [poses, inclinometer.readings(arm, arm.sample(90, seed=6))]
    return of_arm(arm, dc.Observations.joined(rows), 0.25, (0, 1, 2))


SOURCES: dict[str, Callable[[], Source]] = {
    "positions": partial(_positions, 56),
    "poses": _poses,
    "hidden markers": _hidden,
    "several tips": _tips,
    "sessions": partial(_sessions, 60),
    "markers mounted anew": _remounted,
    "payloads": _payloads,
    "ball in sockets": _sockets,
    "mixture": _mixture,
    "distances": partial(_readings, "distance", 0.3),
    "heights": partial(_readings, "height", 0.3),
    "images": partial(_readings, "image", 2.0),
    "camera on the tool": _camera,
    "images of a board": _images,
    "two cameras": partial(_two_cameras, on_tool=False),
    "two cameras on the tool": partial(_two_cameras, on_tool=True),
    "images and a tracker": partial(_images, tracker=True),
    "several kinds": _several,
    "laser beams": _beams,
    "inclinations": _inclinations,
}
KINDS = tuple(SOURCES)


def _searched(name: str) -> Source:
    return replace(SOURCES[name](), scales=None)


def _geared() -> Source:
    found = _positions(40)
    lines = (GearLine(1, 40.0, 1e-4), GearLine(3, 80.0, 5e-5))
    return replace(found, scales=replace(found.scales, lines=lines))  # pyright: ignore


SOURCES |= {
    "positions, scales searched": partial(_searched, "positions"),
    "ball in sockets, scales searched": partial(_searched, "ball in sockets"),
    "sessions with a wrong row": partial(_sessions, 60, wrong=True),
    "distances of unknown zero": partial(_readings, "distance", 0.3, 0.03),
    "gear lines": _geared,
}
"""Their numbers are golden, too."""
