"""Markers of new rows in another order than in the fit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from kind_bank import kind_named

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots import SimulatedArm

VERBS: dict[str, Callable[[Any, Any], Any]] = {
    "registered": lambda model, rows: model.registered(rows),
    "recalibrate": dc.recalibrate,
    "compare": dc.compare,
}


def fitted() -> tuple[SimulatedArm, dc.CalibratedKinematics, dc.Measurements]:
    arm = SimulatedArm(seed=1, markers=3)
    names = arm.nominal.joint_names
    data = dc.Measurements(*arm.measure(50, seed=2), names)
    model = dc.calibrate(arm.nominal, data, hyperparameters=kind_named("positions").scales).model
    return arm, model, dc.Measurements(*arm.measure(24, seed=7), names)


@pytest.mark.parametrize("verb", VERBS)
def test_exchanged_markers_are_named(verb: str) -> None:
    _, model, new = fitted()
    with pytest.warns(DiffeoCalibWarning, match="markers 0, 1, or.* seem to be exchanged"):
        VERBS[verb](model, with_attributes(new, points=new.points[:, [1, 0, 2]]))
    with pytest.warns(DiffeoCalibWarning, match="markers 0, 1, 2, or.* seem to be exchanged"):
        VERBS[verb](model, with_attributes(new, points=new.points[:, [1, 2, 0]]))


def test_markers_that_moved_are_not_exchanged() -> None:
    arm, model, new = fitted()
    turns = arm.truth.marker_poses(new.q)[..., :3, :3]
    shifts = torch.tensor([[2e-3, 1e-3, 0.0], [-1e-3, 3e-3, 2e-3], [3e-2, -4e-2, 1e-2]], dtype=torch.float64)
    moved = with_attributes(new, points=new.points + (turns @ shifts[None, ..., None])[..., 0])
    assert model.registered(moved).registration.exchanged == ()
    assert model.registered(new).registration.exchanged == ()
