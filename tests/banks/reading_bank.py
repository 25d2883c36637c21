"""Distances, heights and images of the ball of a simulated arm, and scales for it."""

from collections.abc import Callable

import numpy as np
import torch
from product_bank import scales_of
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.result import STAGES, CalibrationResult
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import transforms

POINTS = torch.tensor([[1.2, 0.0, 0.2], [-0.6, 1.0, 0.3], [-0.5, -1.1, 0.8]], dtype=torch.float64)
AXES = torch.tensor([[0.0, 0.0, 1.0], [0.8, 0.0, 0.6], [0.0, 0.8, 0.6]], dtype=torch.float64)
EYES = torch.tensor([[2.8, 0.5, 1.0], [-1.5, 2.5, 1.2], [-0.5, -2.9, 0.2]], dtype=torch.float64)
DISTANCES = {("0", "1"): 0.05}
"""Between the sockets of a block, m."""
FOCAL, CENTRE = (3500.0, 3400.0), (1200.0, 1000.0)


def in_base(arm: SimulatedArm, q: Tensor, payload: float | Tensor | None = None) -> Tensor:
    return (arm.true_points(q, payload)[:, 0] - arm.truth.base[:3, 3]) @ arm.truth.base[:3, :3]


def cameras() -> Tensor:
    z = torch.nn.functional.normalize(torch.tensor([0.0, 0.0, 0.4], dtype=torch.float64) - EYES, dim=1)
    x = torch.nn.functional.normalize(torch.stack([z[:, 1], -z[:, 0], torch.zeros_like(z[:, 0])], 1), dim=1)
    R = torch.stack([x, torch.linalg.cross(z, x), z], 1)
    return transforms(R, -(R @ EYES[:, :, None])[..., 0])


def pixels(z: Tensor, which: Tensor) -> Tensor:
    """Written out once more, without the package's projection."""
    seen = torch.einsum("nij,nj->ni", cameras()[which][:, :3], torch.nn.functional.pad(z, (0, 1), value=1.0))
    columns = [f * seen[:, k] / seen[:, 2] + c for k, (f, c) in enumerate(zip(FOCAL, CENTRE, strict=True))]
    return torch.stack(columns, 1)


def readings(
    arm: SimulatedArm,
    kind: str,
    rows: int,
    zero: float = 0.0,
    noise: float = 0.0,
    *,
    seed: int = 1,
    payload: float | Tensor | None = None,
    turned: Callable[[Tensor], Tensor] = lambda q: q,
) -> dc.Readings:
    q, which = arm.sample(rows, seed), torch.arange(rows) % 3
    names, draws = [f"device {number}" for number in which.tolist()], np.random.default_rng(seed + 2)
    z, joints = in_base(arm, turned(q), payload), arm.nominal.joint_names
    if kind == "image":
        seen = pixels(z, which) + noise * 1200 * torch.from_numpy(draws.standard_normal((rows, 2)))
        return dc.Readings.images(q, seen, names, joints, focal=FOCAL, centre=CENTRE)
    errors = noise * torch.from_numpy(draws.standard_normal(rows))
    if kind == "distance":
        lengths = (z - POINTS[which]).norm(dim=1) + zero + errors
        return dc.Readings.distances(q, lengths, names, joints, offset_std=0.1 if zero else 0.0)
    return dc.Readings.heights(q, (z * AXES[which]).sum(1) - 0.3 + errors, names, joints)


def scales() -> dc.Hyperparameters:
    """Roughly those of the simulated arm."""
    noise = {"joint_noise": 1e-6, "task_amplitude": 2e-5, "sensor_noise": 2e-5, "rotation_noise": 1e-4}
    loads = {"compliance": 2e-4, "lateral_compliance": 1e-5, "gravity": (1.0, 1.0, 1.0)}
    return scales_of(6, 6, transmission_lengthscale=0.6, rotation_errors=5e-4, **noise, **loads)


def reading_errors(result: CalibrationResult, data: dc.Readings, stage: str = STAGES[-1]) -> Tensor:
    """Readings of the only kind of a calibration as of a stage, measured minus predicted (N, r), m at the ball."""
    (devices,) = result.places(stage).devices.values()
    return devices.errors(data, devices.points_of(result.stages[stage](data.q).detach()))
