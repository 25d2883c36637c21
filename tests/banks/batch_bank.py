"""Later batches of every kind in the kind bank: the same robot, other poses and noise, nothing changed."""

from __future__ import annotations

import tempfile
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import reading_bank
import torch
import two_arms_bank
from kind_bank import Kind, kind_named
from mixture_bank import DISTANCES
from simulated_camera import FEWEST_SEEN, CameraArm, camera_arm, seen_corners
from simulated_sockets import rest_in_sockets

import diffeo_calib as dc
from diffeo_calib.cameras.board import BoardPrior
from diffeo_calib.measurements.poses import poses_from_marks
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation, transforms

ROWS = 24


def batch(name: str, seed: int, rows: int = ROWS) -> Any:
    """Clean rows of a kind, of device places that are its own unless the kind is one of known devices."""
    return BATCHES[name](rows, 100 + seed)


@cache
def searched(name: str) -> dc.CalibratedKinematics:
    """The model of the first rows with scales of its own."""
    kind: Kind = kind_named(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few rows
        return dc.calibrate(kind.robot, kind.data).model


def _positions(rows: int, seed: int, arm_seed: int = 1, markers: int = 1) -> dc.Measurements:
    arm = SimulatedArm(seed=arm_seed, markers=markers)
    return dc.Measurements(*arm.measure(rows, seed=seed), arm.nominal.joint_names)


def _hidden(rows: int, seed: int) -> dc.Measurements:
    whole = _positions(rows, seed, markers=3)
    gone = torch.rand(rows, 3, generator=torch.Generator().manual_seed(seed)) < 0.3
    gone[gone.all(1), 0] = False
    return dc.Measurements(whole.q, whole.points.masked_fill(gone[..., None], torch.nan), whole.joint_names)


def _poses(rows: int, seed: int) -> dc.Measurements:
    arm: SimulatedArm = kind_named("poses").source.truth.__closure__[0].cell_contents  # type: ignore[index, union-attr]
    q, points = arm.measure(rows, seed=seed)
    return dc.Measurements.from_poses(q, poses_from_marks(points, LEVER), arm.nominal.joint_names)


def _tips(rows: int, seed: int) -> dc.Measurements:
    with tempfile.TemporaryDirectory() as folder:
        arms = two_arms_bank.TwoArms(two_arms_bank.robot(Path(folder)))
    arms.rng = np.random.default_rng(seed)
    return arms.measured(rows)


def _payloads(rows: int, seed: int) -> dc.Measurements:
    arm, masses = SimulatedArm(seed=1), torch.from_numpy(np.random.default_rng(seed).choice([0.0, 4.0, 10.0], rows))
    return dc.Measurements(*arm.measure(rows, seed=seed, payload=masses)).with_payload(masses)


def _sockets(rows: int, seed: int, arm: SimulatedArm | None = None) -> dc.Measurements:
    arm = SimulatedArm(seed=0) if arm is None else arm
    found = rest_in_sockets(arm, seed=seed, places=3, rows=rows // 6)
    names = arm.nominal.joint_names
    return dc.Measurements.from_sockets(found.q, found.names, names, distances=DISTANCES, distance_std=1e-5)


def _mixture(rows: int, seed: int) -> dc.Measurements:
    arm = SimulatedArm(seed=3, markers=2)
    q, points = arm.measure(rows // 2, seed=seed)
    tracked = dc.Measurements(q, points[:, 1:], arm.nominal.joint_names)
    return dc.Measurements.joined([tracked, _sockets(rows // 2, seed, arm)])


def _readings(kind: str, rows: int, seed: int) -> dc.Readings:
    rows = max(rows, 60)  # the closed form of a distance needs 17 rows of a device
    return reading_bank.readings(SimulatedArm(0, markers=1), kind, rows, noise=2e-5, seed=seed)


@cache
def _seen_by_camera() -> CameraArm:
    """As many configurations as seven batches have."""
    return camera_arm(228)


def _camera(rows: int, seed: int, *, images: bool) -> dc.Measurements:
    seen, last = _seen_by_camera(), 60 + rows * (seed - 98)
    q, boards = seen.q[last - rows : last], seen.boards[last - rows : last]
    assert len(q) == rows
    names = seen.arm.nominal.joint_names
    if images:
        corners = seen_corners(boards, 0.1, seed)
        shown = (~corners[..., 3].isnan()).sum(1) >= FEWEST_SEEN
        known: dict[str, Any] = {"board": BoardPrior(scale=2e-4), "camera_on_tool": True}
        return dc.Measurements.from_images(q[shown], corners[shown], (1280, 960), names, **known)
    draws = torch.from_numpy(np.random.default_rng(seed).standard_normal((2, rows, 3)))
    turned = rotation(1e-3 * draws[0]) @ boards[:, :3, :3]
    poses = transforms(turned, boards[:, :3, 3] + 1e-4 * draws[1])
    return dc.Measurements.from_poses(q, poses, names, camera_on_tool=True)


def _several(rows: int, seed: int) -> Any:
    arm = SimulatedArm(0, markers=2)
    q, points = arm.measure(rows // 2, seed=seed)
    tracked = dc.Measurements(q, points[:, 1:], arm.nominal.joint_names)
    each = [reading_bank.readings(arm, kind, 60, noise=2e-5, seed=seed) for kind in ("distance", "height", "image")]
    return dc.Observations.joined([tracked, *each])  # pyright: ignore


BATCHES: dict[str, Any] = {
    "positions": _positions,
    "poses": _poses,
    "hidden markers": _hidden,
    "several tips": _tips,
    "sessions": lambda rows, seed: _positions(rows, seed, 5, 2).with_sessions(["later"] * rows),
    "payloads": _payloads,
    "ball in sockets": _sockets,
    "mixture": _mixture,
    "distances": lambda rows, seed: _readings("distance", rows, seed),
    "heights": lambda rows, seed: _readings("height", rows, seed),
    "images": lambda rows, seed: _readings("image", rows, seed),
    "camera on the tool": lambda rows, seed: _camera(rows, seed, images=False),
    "images of a board": lambda rows, seed: _camera(rows, seed, images=True),
    "several kinds": _several,
}
