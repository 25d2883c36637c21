"""Calibration by devices that measure no position: distances, planes, dial gauges, cameras; simulated arm.

    python benchmarks/robustness/functionals.py --seeds 3 --out functionals.json

`rms_mm` is the RMS error at 1000 random configurations without noise after the best rigid motion, `coverage` the share
of them within the predicted 95 % region (after the best rigid motion over the model's own workspace), `expected_mm`
what the model expects of itself, `held_out_mm` the RMS error of 100 further readings without noise, `size` the error of
the robot's size in mm per m, and `size_std` what the model expects of it. Every device sees an equal share of the rows;
where they stand is not given. `positions` rows are a tracker in the same configurations with the same noise per
coordinate.

Configurations: random for devices that reach everywhere; for a ball bar and for planes that are touched, random ones
moved until the true ball is there. Collisions are not modelled. Cameras see the ball everywhere; their noise is given
at its mean distance (2.8 m: 0.02 mm are 0.025 pixels at a focal length of 3500).
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import harness
import numpy as np
import torch
from harness import Record
from held_out import covered, rms_mm
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.maps.observation import Observation
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.se3 import transforms
from diffeo_calib.sensors.kinds import KINDS

COLUMNS = (
    *("case", "noise_mm", "seed", "method", "rows", "rms_mm", "coverage", "expected_mm", "held_out_mm"),
    *("size", "size_std"),
)
FIXED = torch.tensor([[1.2, 0.0, 0.2], [-0.6, 1.0, 0.3], [-0.5, -1.1, 0.8]], dtype=torch.float64)
"""Fixed points around the robot, in its base, m."""
NORMALS = torch.tensor([[0.0, 0.0, 1.0], [0.8, 0.0, 0.6], [0.0, 0.8, 0.6]], dtype=torch.float64)
HEIGHTS = torch.tensor([[0.3], [0.6], [0.6]], dtype=torch.float64)
"""A table at 0.3 m, and two planes that are tilted towards the robot, in its base, m."""
BAR_FIXED = torch.tensor([[0.5, 0.0, 0.2], [-0.2, 0.5, 0.3], [-0.2, -0.5, 0.5]], dtype=torch.float64)
BAR_M, BLOCK_M = 0.4, 0.1
EYES = torch.tensor([[2.8, 0.5, 1.0], [-1.5, 2.5, 1.2]], dtype=torch.float64)
"""Cameras that look at a point over the robot's base, in this base, m."""
LOOKED_AT = torch.tensor([0.0, 0.0, 0.4], dtype=torch.float64)
FOCAL, CENTRE = (3500.0, 3500.0), (1200.0, 1000.0)
ZERO_STD, ZERO_M = 0.1, 0.05
"""What is told of an unknown zero, and the zero, m."""
STEPS, HELD_OUT = 60, 100


def cameras() -> Tensor:
    """Constants of the cameras: rows of the transforms from the robot's base to these, and depths, m: (C, 13)."""
    z = torch.nn.functional.normalize(LOOKED_AT - EYES, dim=1)
    x = torch.nn.functional.normalize(torch.linalg.cross(z, torch.tensor([[0.0, 0.0, 1.0]]).to(z).expand_as(z)), dim=1)
    R = torch.stack([x, torch.linalg.cross(z, x), z], 1)
    rows = transforms(R, -(R @ EYES[:, :, None])[..., 0])[:, :3].flatten(1)
    return torch.cat([rows, (EYES - LOOKED_AT).norm(dim=1, keepdim=True)], 1)


@dataclass(frozen=True)
class Case:
    """A device.

    Args:
        kind: "distance", "height" or "image". devices: their number.
        at: the readings to which the ball is brought in turn; none for readings at random configurations.
        zero: whether it is unknown.
    """

    kind: str
    devices: int
    at: tuple[float, ...] = ()
    zero: bool = False

    def observation(self, which: Tensor) -> Observation:
        """What the devices (N,) see, in the robot's base; image points in m at the mean distance."""
        constants = {"height": torch.cat([NORMALS, HEIGHTS], 1), "image": cameras()}
        fixed = BAR_FIXED if self.at else FIXED
        own = constants.get(self.kind, torch.cat([fixed, torch.zeros_like(fixed[:, :1])], 1))
        kind = KINDS[self.kind]
        return kind(tuple(map(str, range(len(own)))), own, own.new_tensor(kind.prior())).observation(which)

    def targets(self, which: Tensor) -> Tensor:
        """Readings (N, 1) to which the ball is brought, each of them at every device."""
        turn = torch.arange(len(which)) // self.devices % len(self.at)
        return torch.tensor(self.at, dtype=torch.float64)[turn][:, None]

    def readings(self, q: Tensor, values: Tensor, which: Tensor) -> dc.Readings:
        """The rows as a user has them; values (N, r)."""
        names = [f"{self.kind} {number}" for number in which.tolist()]
        if self.kind == "height":
            return dc.Readings.heights(q, values, names)
        if self.kind == "image":
            depth = (EYES - LOOKED_AT).norm(dim=1)[which][:, None]
            pixels = values / depth * torch.tensor(FOCAL) + torch.tensor(CENTRE)
            return dc.Readings.images(q, pixels, names, focal=FOCAL, centre=CENTRE)
        return dc.Readings.distances(q, values + ZERO_M * self.zero, names, offset_std=ZERO_STD if self.zero else 0.0)


CASES = {
    "distances to 3 points": Case("distance", 3),
    "distances to 1 point": Case("distance", 1),
    "distances to 3 points, zero unknown": Case("distance", 3, zero=True),
    "ball bar of 400 mm at 3 points": Case("distance", 3, at=(BAR_M,)),
    "3 dial gauges": Case("height", 3),
    "3 planes touched": Case("height", 3, at=(0.0,)),
    "3 planes and a block of 100 mm": Case("height", 3, at=(0.0, BLOCK_M)),
    "1 plane touched": Case("height", 1, at=(0.0,)),
    "1 camera": Case("image", 1),
    "2 cameras": Case("image", 2),
}


def in_base(arm: SimulatedArm, q: Tensor) -> Tensor:
    """The true ball in the robot's base: (N, 3), m."""
    base = arm.truth.base
    return (arm.true_points(q)[:, 0] - base[:3, 3]) @ base[:3, :3]


def rows_of(arm: SimulatedArm, case: Case, count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Configurations (N, n), devices (N,) and true readings (N, r)."""
    if not case.at:
        q, which = arm.sample(count, seed), torch.arange(count) % case.devices
        return q, which, case.observation(which).value(in_base(arm, q))
    q = arm.sample(40 * count, seed)
    which = torch.arange(len(q)) % case.devices
    observe, targets = case.observation(which), case.targets(which)
    for _ in range(STEPS):
        miss = targets - observe.value(in_base(arm, q))
        slopes = observe.slope(in_base(arm, q)) @ (arm.truth.base[:3, :3].mT @ arm.truth.jacobian(q)[:, 0])
        step = (torch.linalg.pinv(slopes) @ miss[:, :, None])[:, :, 0]
        q = q + step * (0.3 / step.abs().amax(1, keepdim=True).clamp(min=0.3))
    low, high = arm.nominal.limits.unbind(1)
    there = (targets - observe.value(in_base(arm, q)))[:, 0].abs() < 1e-9
    there &= ((q > low) & (q < high)).all(1)
    each = count // case.devices // len(case.at)
    wanted = [(number, at) for number in range(case.devices) for at in case.at]
    chosen = [(there & (which == number) & (targets[:, 0] == at)).nonzero()[:each, 0] for number, at in wanted]
    rows = torch.cat(chosen)
    if len(rows) < each * len(wanted):
        raise SystemExit(f"only {len(rows)} of {count} configurations reach their device")
    return q[rows], which[rows], targets[rows]


def judged(arm: SimulatedArm, seed: int, points: Callable[[Tensor], Tensor]) -> Record:
    """Errors over the workspace, and the coverage of a model."""
    q = arm.sample(1000, seed + 100)
    truth = arm.true_points(q)[:, 0]
    errors = after_rigid_motion(arm, points, q, q)[0]
    away = truth - truth.mean(0)
    size = float((errors * away).sum() / away.square().sum())
    record: Record = {"rms_mm": rms_mm(errors), "size": 1e3 * size}
    if isinstance(points, dc.CalibratedKinematics):
        covariance = points.predict(q, noise=False)[1][:, 0]
        over = q if points.map.workspace is None else points.map.workspace
        errors, T = after_rigid_motion(arm, points, q, over)
        record["coverage"] = covered(errors @ T[:3, :3], covariance)  # in the frame of the model
        record["expected_mm"] = 1e3 * float(covariance.diagonal(dim1=1, dim2=2).sum(1).mean().sqrt())
    return record


def after_rigid_motion(
    arm: SimulatedArm, points: Callable[[Tensor], Tensor], q: Tensor, over: Tensor
) -> tuple[Tensor, Tensor]:
    """Errors at q (N, n) in the tracker's frame, (N, 3) m, after the rigid motion T (4, 4) that is best over others.

    Predicted covariances leave out the rigid motion over the model's own workspace: where the robot's size is unknown,
    it makes a difference that the centres of two samples of configurations are some centimetres apart.
    """
    T = rigid_fit(points(over)[:, 0].detach(), arm.true_points(over)[:, 0])
    return points(q)[:, 0].detach() @ T[:3, :3].mT + T[:3, 3] - arm.true_points(q)[:, 0], T


def by_positions(name: str, noise: float, seed: int, count: int) -> Iterator[Record]:
    """A tracker in the same configurations."""
    arm = SimulatedArm(seed)
    q, _, _ = rows_of(arm, CASES[name], count, seed)
    draws = torch.from_numpy(np.random.default_rng([seed, 12]).standard_normal((len(q), 1, 3)))
    seen = dc.Measurements(q, arm.true_points(q) + noise * draws, arm.nominal.joint_names)
    model = dc.calibrate(arm.nominal, seen).model
    yield (
        {"case": name, "noise_mm": 1e3 * noise, "seed": seed, "rows": len(q)}
        | {"method": "positions"}
        | judged(arm, seed, model)
    )


def by_readings(name: str, noise: float, seed: int, count: int) -> Iterator[Record]:
    """A device."""
    arm, case = SimulatedArm(seed), CASES[name]
    q, which, true = rows_of(arm, case, count, seed)
    draws = torch.from_numpy(np.random.default_rng([seed, 11]).standard_normal(true.shape))
    values = true
    if not case.at:
        values = true + noise * draws
    else:  # the device reads the same everywhere, and the robot stops somewhere near
        slopes = case.observation(which).slope(in_base(arm, q))
        slopes = slopes @ (arm.truth.base[:3, :3].mT @ arm.truth.jacobian(q)[:, 0])
        q = q + (torch.linalg.pinv(slopes) @ (noise * draws)[:, :, None])[:, :, 0]
    result = dc.calibrate(arm.nominal, case.readings(q, values, which))
    record: Record = {"case": name, "noise_mm": 1e3 * noise, "seed": seed, "rows": len(q)}
    for method, stage in (("nominal", "nominal"), ("geometry", "geometric")):
        yield record | {"method": method} | judged(arm, seed, result.stages[stage])
    fresh, there, values = rows_of(arm, case, HELD_OUT, seed + 200)
    (devices,), rows = result.places().devices.values(), case.readings(fresh, values, there)
    held_out = devices.errors(rows, devices.points_of(result.model(rows.q).detach()))
    own: Record = {"held_out_mm": 1e3 * float(held_out.square().sum(1).mean().sqrt())}
    own["size_std"] = 1e3 * result.expected.size
    yield record | {"method": "full"} | judged(arm, seed, result.model) | own


def measure(plan: Namespace) -> Iterator[Record]:
    """A record for every case and method."""
    for seed in range(plan.first, plan.first + plan.seeds):
        for noise in plan.noise:
            for name in plan.cases:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    if "devices" in plan.methods:
                        yield from by_readings(name, 1e-3 * noise, seed, plan.rows)
                    if "positions" in plan.methods:
                        yield from by_positions(name, 1e-3 * noise, seed, plan.rows)


if __name__ == "__main__":
    options = {"seeds": harness.number(3), "rows": harness.number(150), "cases": harness.names(CASES)}
    options |= {
        "first": {"type": int, "default": 0, "metavar": "SEED"},
        "methods": harness.names(["devices", "positions"]),
    }
    options["noise"] = {"nargs": "+", "type": float, "default": [0.02, 0.1], "metavar": "MM"}
    quick = {"seeds": 1, "noise": [0.02], "cases": ["distances to 3 points"], "methods": ["devices"]}
    harness.run(__doc__, measure, COLUMNS, quick=quick, **options)
