"""Golden numbers of what is done with a calibration: registered, recalibrated, compared, evaluated on new rows."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import twist_transform

Numbers = dict[str, Tensor]


def one(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def from_elsewhere(arm: SimulatedArm, rows: int, seed: int) -> dc.Measurements:
    """New rows of a device that stands in another place."""
    T = twist_transform(one(0.4, -0.2, 0.3, 0.2, 0.5, -0.3))
    q, points = arm.measure(rows, seed=seed)
    return dc.Measurements(q, points @ T[:3, :3].mT + T[:3, 3], arm.nominal.joint_names)


def used(arm: SimulatedArm, result: Any) -> Numbers:
    """Registered by ten rows, recalibrated by twenty; each with its tool."""
    q = arm.sample(5, seed=78)
    tool = torch.eye(4, dtype=torch.float64)
    tool[2, 3] = 0.1
    model = result.model.with_tool(tool)
    registered = model.registered(from_elsewhere(arm, 10, seed=11))
    again = dc.recalibrate(model, from_elsewhere(arm, 20, seed=12))
    found: Numbers = {}
    for name, one_model in (("registered", registered), ("recalibrated", again.model)):
        mean, covariance = one_model.predict(q, noise=False)
        found |= {f"{name}, k1": mean, f"{name}, covariance": covariance, f"{name}, tool": one_model.tool_poses(q)}
        found[f"{name}, evaluation"] = one(dc.evaluate(one_model, from_elsewhere(arm, 15, seed=13)).rms)
    numbers = again.rms_before, again.rms_after, again.left_out_rms, again.inflation
    transform = again.moved.transform
    return {**found, "recalibrated, rms": one(*numbers), "recalibrated, transform": transform}
