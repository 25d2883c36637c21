"""Small calibrations of every kind of measurement, as numbers that a change of the code must leave as they are.

The cases come first, then the numbers of a result.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import reading_bank
import torch
import two_arms_bank
from mixture_bank import DISTANCES
from product_bank import simulated_poses, usual_scales
from simulated_camera import camera_arm
from simulated_sockets import rest_in_sockets
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.expected_errors import workspace_deviation
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.process.scales import SCALES, GearLine
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation, twist_transform

Rows = dc.Measurements | dc.Readings
Numbers = dict[str, Tensor]
ROUNDING = 2.0**-52


@dataclass(frozen=True)
class Golden:
    """What is calibrated: a robot, its rows, scales (None: searched), configurations (5, n) at which the model is seen.

    ``then``: more numbers of what is done with the result.
    """

    robot: dc.Tree
    rows: Rows
    scales: dc.Hyperparameters | None
    q: Tensor
    then: Callable[[Any], Numbers] | None = None


# --- cases --------------------------------------------------------------------------------------------------------


def _of(arm: SimulatedArm, rows: Rows, *, searched: bool = False, **changed: Any) -> Golden:
    scales = None if searched else replace(usual_scales(arm.nominal), **changed)
    return Golden(arm.nominal, rows, scales, arm.sample(5, seed=77))


def positions(rows: int = 40, markers: int = 1, *, searched: bool = False) -> Golden:
    arm = SimulatedArm(seed=1, markers=markers)
    return _of(arm, dc.Measurements(*arm.measure(rows, seed=2), arm.nominal.joint_names), searched=searched)


def used_anew() -> Golden:
    """A model that is registered and recalibrated where the device stands elsewhere."""
    return replace(positions(), then=partial(used, SimulatedArm(seed=1)))


def hidden() -> Golden:
    """Three markers, of which some rows show two or one."""
    whole = positions(30, 3)
    gone = torch.rand(30, 3, generator=torch.Generator().manual_seed(0)) < 0.3
    gone[gone.all(1), 0] = False
    assert isinstance(whole.rows, dc.Measurements)
    seen = whole.rows.points.masked_fill(gone[..., None], torch.nan)
    return replace(whole, rows=dc.Measurements(whole.rows.q, seen, whole.robot.joint_names))


def poses(rows: int = 30) -> Golden:
    arm, data, _ = simulated_poses(rows)
    return _of(arm, data)


def camera_on_tool() -> Golden:
    seen = camera_arm(30)
    return replace(_of(seen.arm, seen.measured(1e-4, 1e-3)), q=seen.q[:5])


def two_tips() -> Golden:
    """Poses of both hands, some of them hidden."""
    with tempfile.TemporaryDirectory() as folder:
        robot = two_arms_bank.robot(Path(folder))
    data = two_arms_bank.TwoArms(robot).measured(30, hidden=4)
    q = torch.from_numpy(np.random.default_rng(1).uniform(-1.3, 1.3, (5, robot.n)))
    return Golden(robot, data, usual_scales(robot), q)


def sessions(rows: int = 45, *, searched: bool = False) -> Golden:
    """The device was moved once; its larger session is the second one. With given scales one row is wrong."""
    arm = SimulatedArm(seed=5, markers=2)
    q, points = arm.measure(rows, seed=1)
    moved = torch.eye(4, dtype=torch.float64)
    moved[:3, :3] = rotation(torch.tensor([1e-3, -2e-3, 0.5e-3], dtype=torch.float64))
    moved[:3, 3] = torch.tensor([5e-3, 2e-3, -4e-3], dtype=torch.float64)
    first = torch.arange(rows) % 5 < 2
    points = torch.where(first[:, None, None], points @ moved[:3, :3].mT + moved[:3, 3], points)
    if not searched:
        points[10, 0, 0] += 0.05
    data = dc.Measurements(q, points, arm.nominal.joint_names)
    names = ["Monday" if one else "Friday" for one in first.tolist()]
    return _of(arm, data.with_sessions(names), searched=searched)


def gear_lines() -> Golden:
    whole = positions(30, 2)
    assert whole.scales is not None
    lines = (GearLine(1, 40.0, 1e-4), GearLine(3, 80.0, 5e-5))
    return replace(whole, scales=replace(whole.scales, lines=lines))


def payloads(rows: int = 40) -> Golden:
    arm = SimulatedArm(seed=1)
    masses = torch.from_numpy(np.random.default_rng(0).choice([0.0, 4.0, 10.0], rows))
    q, points = arm.measure(rows, seed=1, payload=masses)
    return _of(arm, dc.Measurements(q, points).with_payload(masses), payload=1.5)


def _resting(arm: SimulatedArm, places: int, rows: int) -> dc.Measurements:
    found = rest_in_sockets(arm, seed=3, places=places, rows=rows)
    return dc.Measurements.from_sockets(
        found.q, found.names, arm.nominal.joint_names, distances=DISTANCES, distance_std=1e-5
    )


def sockets(*, searched: bool = False) -> Golden:
    arm = SimulatedArm(seed=0)
    return _of(arm, _resting(arm, places=5, rows=6), searched=searched)


def mixture() -> Golden:
    """The ball is marker 0; a tracker sees marker 1."""
    arm = SimulatedArm(seed=3, markers=2)
    q, points = arm.measure(25, seed=5)
    tracked = dc.Measurements(q, points[:, 1:], arm.nominal.joint_names)
    noise = torch.tensor(2e-5, dtype=torch.float64)
    return _of(arm, dc.Measurements.joined([tracked, _resting(arm, places=3, rows=5)]), other_noise=noise)


def readings(kind: str, zero: float = 0.0, *, searched: bool = False) -> Golden:
    arm = SimulatedArm(0)
    found = _of(arm, reading_bank.readings(arm, kind, 60, zero, noise=2e-5))
    return replace(found, scales=None if searched else reading_bank.scales())


CASES: dict[str, Callable[[], Golden]] = {
    "positions, scales searched": partial(positions, searched=True),
    "registered and recalibrated": used_anew,
    "three markers": partial(positions, 30, 3),
    "hidden markers": hidden,
    "poses": poses,
    "camera on the tool": camera_on_tool,
    "two tips, hidden frames": two_tips,
    "sessions": sessions,
    "sessions, scales searched": partial(sessions, searched=True),
    "payloads": payloads,
    "gear lines": gear_lines,
    "sockets": sockets,
    "sockets, scales searched": partial(sockets, searched=True),
    "mixture": mixture,
    "distance, scales searched": partial(readings, "distance", searched=True),
    "distance of unknown zero": partial(readings, "distance", 0.03),
    "height": partial(readings, "height"),
    "image": partial(readings, "image"),
}


# --- numbers ------------------------------------------------------------------------------------------------------


def golden(name: str, shake: int | None = None) -> Numbers:
    """All numbers of a case; ``shake``: seed of changes of the measured numbers by their last digit."""
    case = CASES[name]()
    rows = case.rows if shake is None else shaken(case.rows, shake)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few rows
        result: Any = dc.calibrate(case.robot, rows, hyperparameters=case.scales)  # pyright: ignore[reportCallIssue, reportArgumentType]
        found = numbers(result, rows, case.q)
        return found if case.then is None else {**found, **case.then(result)}


def shaken(rows: Rows, seed: int) -> Rows:
    """The same measurements, each number in its last digit another one."""
    rng = np.random.default_rng(seed)

    def near(values: Tensor) -> Tensor:
        return values * (1 + ROUNDING * torch.from_numpy(rng.integers(-1, 2, tuple(values.shape))))

    if isinstance(rows, dc.Readings):
        return replace(rows, values=near(rows.values))
    if rows.socket is not None and rows.without_device:
        return with_attributes(rows, q=near(rows.q))
    return with_attributes(rows, points=near(rows.points))


def numbers(result: Any, rows: Any, q: Tensor) -> Numbers:
    """What users see of a result, as tensors."""
    mean, covariance = result.model.predict(q, noise=False)
    left_out, geometry = result.leave_one_out, result.model.nominal.geometry
    theta = result.fit.solution.momenta.theta
    found = {f"theta, {name}": theta[part] for name, part in geometry.slices.items()}
    found |= {"theta, gravity": theta[geometry.size :], **scales(result.selection.scales), **devices(result)}
    wrong = [(one.row, one.marker or 0)[: 1 if result.readings else 2] for one in result.outliers]
    return found | {
        "k1": mean,
        "slope": result.model.jacobian(q),
        "covariance": covariance,
        "noise of new rows": result.model.predict(q, noise=True)[1] - covariance,
        "left out, errors": left_out.errors,
        "left out, squares": left_out.squares,
        "outliers": one(*(number for each in wrong for number in each)),
        "evaluation": one(dc.evaluate(result.model, rows if result.readings else as_one(result, rows)).rms),
    }


def one(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def as_one(result: Any, rows: Any) -> Any:
    """Rows of all sessions in the frame of the first."""
    aligned = result.aligned(rows)
    return aligned.with_sessions(None) if result.sessions else aligned


def scales(found: dc.Hyperparameters) -> Numbers:
    lines = [number for line in found.lines for number in (line.joint, line.frequency, line.amplitude)]
    own = {f"scales, {name}": getattr(found, name) for name in SCALES}
    noise = {} if found.other_noise is None else {"scales, socket_noise": found.other_noise}
    return {**own, **noise, "scales, lines": one(*lines), "scales, payload": one(found.payload)}


def devices(result: Any) -> Numbers:
    """Sockets, measuring frames, or devices of readings."""
    if result.readings:
        (own,) = result.readings
        at = {"devices": own.devices.constants, "devices, deviations": own.devices.deviations}
        return {**at, "expected error": one(result.expected.workspace)}
    found: Numbers = {}
    if result.sockets is not None:
        own = result.sockets
        found |= {"sockets": own.positions, "sockets, covariance": own.covariance}
        found["sockets left out, spread"] = one(*(place.spread for place in own.left_out))
        found["expected error"] = one(workspace_deviation(result.model.map))
    if result.sessions is not None:
        found["frames of sessions"] = result.sessions.transforms
    return found


# --- what is done with a calibration --------------------------------------------------------------------------------


def from_elsewhere(arm: SimulatedArm, rows: int, seed: int) -> dc.Measurements:
    """New rows of a device that stands in another place."""
    T = twist_transform(one(0.4, -0.2, 0.3, 0.2, 0.5, -0.3))
    q, points = arm.measure(rows, seed=seed)
    return dc.Measurements(q, points @ T[:3, :3].mT + T[:3, 3], arm.nominal.joint_names)


def used(arm: SimulatedArm, result: Any) -> Numbers:
    """Registered by ten rows, recalibrated by twenty; each with its tool."""
    q, tool = arm.sample(5, seed=78), torch.eye(4, dtype=torch.float64)
    tool[2, 3] = 0.1
    model = result.model.with_tool(tool)
    again = dc.recalibrate(model, from_elsewhere(arm, 20, seed=12))
    found: Numbers = {"recalibrated, transform": again.moved.transform}
    registered = model.registered(from_elsewhere(arm, 10, seed=11))
    for name, one_model in (("registered", registered), ("recalibrated", again.model)):
        mean, covariance = one_model.predict(q, noise=False)
        found |= {f"{name}, k1": mean, f"{name}, covariance": covariance, f"{name}, tool": one_model.tool_poses(q)}
        found[f"{name}, evaluation"] = one(dc.evaluate(one_model, from_elsewhere(arm, 15, seed=13)).rms)
    return found
