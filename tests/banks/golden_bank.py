"""Small calibrations of every kind of measurement, as numbers that a change of the code must leave as they are.

The cases come first, then the numbers of a result, one function for each part of it.
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
from golden_verbs import used
from mixture_bank import DISTANCES
from product_bank import simulated_poses, usual_scales
from simulated_camera import camera_arm
from simulated_sockets import rest_in_sockets
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.process.scales import GearLine
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import rotation

Rows = dc.Measurements | dc.Readings
Result = dc.CalibrationResult
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


def numbers(result: Result, rows: Rows, q: Tensor) -> Numbers:
    """Every part of a result as tensors."""
    parts = parameters, scales, tails, momenta, noise, values, left_out, certificates, stages
    found: Numbers = {}
    for part in parts:
        found |= part(result)
    return found | model(result, q) | devices(result) | errors(result, rows)


def one(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def parameters(result: Result) -> Numbers:
    """theta by its parts."""
    theta, geometry = result.fit.solution.momenta.theta, result.model.nominal.geometry
    found = {f"theta, {name}": theta[part] for name, part in geometry.slices.items()}
    return {**found, "theta, gravity": theta[geometry.size :]}


def scales(result: Result) -> Numbers:
    found = result.selection.scales
    names = [name for name in vars(found) if name not in ("lines", "payload", "other_noise")]
    lines = [number for line in found.lines for number in (line.joint, line.frequency, line.amplitude)]
    own = {f"scales, {name}": getattr(found, name) for name in names}
    noise = {} if found.other_noise is None else {"scales, socket_noise": found.other_noise}
    return {**own, **noise, "scales, lines": one(*lines), "scales, payload": one(found.payload)}


def tails(result: Result) -> Numbers:
    if result.readings:
        known, rows = result.identification.tails, [found.row for found in result.outliers]
        return {"outliers": one(*rows), "geometry, weights": known.weights}
    return {
        "tails, inverse freedom": one(1 / result.tails.freedom),
        "tails, weights": result.tails.weights,
        "geometry, inverse freedom": one(1 / result.identification.tails.freedom),
        "geometry, weights": result.identification.tails.weights,
        "outliers": one(*(row for found in result.outliers for row in (found.row, found.marker or 0))),
    }


def momenta(result: Result) -> Numbers:
    found = result.fit.solution.momenta
    return {"momenta, b": found.joint, "momenta, p": found.task}


def noise(result: Result) -> Numbers:
    """Blocks of the noise, divided by the weights, and what rows share, whatever columns say it."""
    found = result.fit.problem.noise
    seen = found.visible.flatten().nonzero()[:, 0]
    Z = found.shared.flatten(0, 1)[seen]
    at = seen.new_tensor(np.random.default_rng(0).integers(0, len(seen), 40)) % len(seen)
    blocks = found.covariance.diagonal(dim1=1, dim2=2).flatten()[seen]
    return {"noise of rows": blocks.sqrt(), "noise that rows share": Z[at] @ Z[at].mT}


def values(result: Result) -> Numbers:
    """k1 at the rows of the fit."""
    return {"k1 at the rows": result.model.map(result.model.map.x).detach()}


def model(result: Result, q: Tensor) -> Numbers:
    """k1, its slopes and posterior covariances."""
    mean, covariance = result.model.predict(q, noise=False)
    new = result.model.predict(q, noise=True)[1] - covariance
    return {"k1": mean, "slope": result.model.jacobian(q), "covariance": covariance, "noise of new rows": new}


def left_out(result: Result) -> Numbers:
    found = result.leave_one_out
    effective = one(found.effective or 0.0)
    return {"left out, errors": found.errors, "left out, squares": found.squares, "effective parameters": effective}


def certificates(result: Result) -> Numbers:
    return {"energy": one(result.fit.energy), "field energy": one(result.fit.field_energy)}


def stages(result: Result) -> Numbers:
    """Registration and geometric calibration."""
    known: Any = result.identification
    found = {"geometry, theta": known.theta, "geometry, noise": one(known.noise)}
    if result.readings:
        return {**found, "rms of stages": one(result.registration.rms, known.rms)}
    geometry = result.registration.geometry
    return {
        **found,
        "registration, base": geometry.base,
        "registration, tool": geometry.tool,
        "geometry, deviations": known.deviations,
        "rms of stages": one(result.registration.rms, known.rms),
    }


def devices(result: Result) -> Numbers:
    """Sockets, measuring frames, or devices of readings."""
    if result.readings:
        return reading_devices(result)
    found: Numbers = {}
    if result.sockets is not None:
        found |= socket_places(result.sockets)
    if result.sessions is not None:
        found["frames of sessions"] = result.sessions.transforms
    return found


def socket_places(found: Any) -> Numbers:
    spreads = one(*(place.spread for place in found.left_out))
    distances = one(*(error for place in found.left_out for error in place.distance_errors))
    return {
        "sockets": found.positions,
        "sockets, covariance": found.covariance,
        "sockets left out, spread": spreads,
        "sockets left out, distances": distances,
        "expected error": one(found.workspace_deviation),
    }


def reading_devices(result: Result) -> Numbers:
    (found,), expected = result.readings, result.expected
    (registered,), (identified,), _ = result.placed.devices_by_stage
    assert found.known is not None
    return {
        "devices": found.devices.constants,
        "devices, deviations": found.known,
        "devices, geometry": identified.constants,
        "devices, registration": registered.constants,
        "expected error": one(expected.workspace),
        "size": one(expected.size, expected.size_share),
    }


def errors(result: Result, rows: Rows) -> Numbers:
    """What summary and evaluation say."""
    if isinstance(rows, dc.Readings):
        own = reading_bank.reading_errors(result, rows)
        return {"errors": own, "evaluation": one(dc.evaluate(result.model, rows).rms)}
    summary, parts = result.model.summary, one(*(part.displacement for part in result.parts))
    assert summary is not None
    stages = summary.registration_rms, summary.geometry_rms, summary.diffeomorphic_rms, summary.leave_one_out_rms
    known = (value for value in stages if value is not None)
    aligned = result.aligned(rows)  # pyright: ignore[reportArgumentType]
    evaluated = dc.evaluate(result.model, aligned.with_sessions(None) if result.sessions else aligned)
    return {
        "rms": one(*known),
        "parts": parts,
        "evaluation": one(evaluated.rms),
    }
