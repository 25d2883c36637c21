"""How well a tool is known apart from where the base stands and how it is mounted: the truth, and motions of both."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from product_bank import Case, simulated
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.tool import REFERENCE_ROWS, covariance_without_placement, tool_transform
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.measurements.poses import mark_points, poses_from_marks
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.runtime.program import TOOL_LEVER

TOOL = tool_transform([0.15, -0.12, 0.16])
STEP = 1e-5


def rms(covariance: Tensor) -> float:
    """Of a shift, m."""
    return float(covariance.diagonal(dim1=1, dim2=2)[:, :3].sum(1).mean().sqrt())


def reference(case: Case) -> Tensor:
    known = case.model.configurations
    count = min(len(known), REFERENCE_ROWS)
    return known[torch.linspace(0, len(known) - 1, count, dtype=torch.float64).round().long()]


def points(poses: Tensor) -> Tensor:
    """Coordinates (9 N,) of three points of each pose."""
    return mark_points(poses, TOOL_LEVER).flatten()


def moved(case: Case, q: Tensor, twist: Tensor, *, of: str) -> Tensor:
    """Coordinates of the tool after a motion of the base or of the tool on the flange."""
    step = twist_transform(STEP * twist[None])[0]
    if of == "base":
        return points(step @ case.model.tool_poses(q, TOOL, "measuring"))
    return points(case.model.tool_poses(q, step @ TOOL, "measuring"))


def test_motions_of_base_and_tool_count_for_nothing(arm: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """A decimetre and 0.1 rad of each, by finite differences, added to what the model does not know."""
    q = arm.test.q[:4]
    before = covariance_without_placement(arm.model, q, TOOL)
    rows, twists = torch.cat([reference(arm), q]), torch.eye(6, dtype=torch.float64)
    slopes = [
        (moved(arm, rows, twist, of=of) - moved(arm, rows, -twist, of=of)) / (2 * STEP)
        for of in ("base", "tool")
        for twist in twists
    ]
    motion = 0.1 * torch.stack(slopes, 1)
    known = FittedMap.covariance_between

    def wider(self: FittedMap, at: Linearisation, other: Linearisation | None = None) -> Tensor:
        return known(self, at, other) + motion @ motion.mT

    monkeypatch.setattr(FittedMap, "covariance_between", wider)
    after = covariance_without_placement(arm.model, q, TOOL)
    assert_close(after, before, rtol=0, atol=1e-3 * float(before.diagonal(dim1=1, dim2=2).max()))


def test_it_is_what_the_truth_leaves_after_both_are_taught(arm_200: Case) -> None:
    """One marker: most of the tool's error is its place on the flange, and a robot's base is known even worse."""
    simulated_arm, _, _ = simulated(200)
    simulated_arm.truth = replace(simulated_arm.truth, tool=mark_points(TOOL[None], TOOL_LEVER)[0])
    q = torch.cat([reference(arm_200), arm_200.test.q])
    truth = poses_from_marks(simulated_arm.true_points(q), TOOL_LEVER)
    found = arm_200.model.tool_poses(q, TOOL, "measuring")
    errors = points(found) - points(truth)
    twists = torch.eye(6, dtype=torch.float64)
    motions = [(moved(arm_200, q, twist, of=of) - points(found)) / STEP for of in ("base", "tool") for twist in twists]
    S, count = torch.stack(motions, 1), 9 * len(reference(arm_200))
    taught = torch.linalg.lstsq(S[:count], errors[:count, None]).solution
    rest = (errors[:, None] - S @ taught)[count:].view(-1, 3, 3).mean(1)  # the middle of the three points
    left = float(rest.square().sum(1).mean().sqrt())
    whole = float(errors[count:].view(-1, 3, 3).mean(1).square().sum(1).mean().sqrt())
    predicted = rms(covariance_without_placement(arm_200.model, arm_200.test.q, TOOL))
    in_base, measuring = (
        rms(arm_200.model.predict_tool_poses(arm_200.test.q, TOOL, frame)[1]) for frame in ("base", "measuring")
    )
    assert left < 0.5 * whole
    assert 0.5 * left < predicted < 2.0 * left
    assert predicted < 0.5 * measuring < 0.5 * in_base


def test_rows_alone_and_together_are_the_same(arm: Case) -> None:
    """What is taught anew is found over the model's configurations, not over the commands."""
    q = arm.test.q[:3]
    together = covariance_without_placement(arm.model, q, TOOL)
    alone = torch.cat([covariance_without_placement(arm.model, row[None], TOOL) for row in q])
    assert_close(alone, together, rtol=1e-6, atol=1e-16)
