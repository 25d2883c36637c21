"""Tools that were never measured: poses, Jacobians and covariances against the truth of the simulated arm."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from deformation_bank import fitted_plain, made, model_of, queries
from product_bank import Case, simulated
from robots_bank import CHAINS, tool_frame
from table_bank import refused
from torch import Tensor
from torch.func import hessian, jacfwd, jacrev, vmap
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.nominal import FlangePoints
from diffeo_calib.kinematics.tool import REFERENCE_ROWS, covariance_without_placement, tool_points, tool_transform
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.measurements.poses import angle_between, mark_points, pose_directions, poses_from_marks
from diffeo_calib.regression.conditional import Conditional
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.runtime.program import TOOL_LEVER

LEVER = 0.1


def true_poses(rows: int, markers: int, q: Tensor, tool: Tensor) -> Tensor:
    """Where the simulated arm of the calibration with these rows really holds a tool, in the measuring frame."""
    arm, _, _ = simulated(rows, markers=markers)
    arm.truth = replace(arm.truth, tool=mark_points(tool[None], LEVER)[0])
    return poses_from_marks(arm.true_points(q), LEVER)


def position_error(case: Case, rows: int, markers: int, tool: Tensor) -> float:
    """RMS distance of the tool centre point from the truth, m."""
    found = case.model.tool_poses(case.test.q, tool, "measuring")
    return float((found - true_poses(rows, markers, case.test.q, tool))[:, :3, 3].norm(dim=1).square().mean().sqrt())


def test_a_tool_that_was_never_measured(pair: Case) -> None:
    """Nearly as good as the held-out error at the markers, and far better than geometry there."""
    assert position_error(pair, 40, 2, tool_frame()) < 2.0 * pair.held_out()[-1] < pair.held_out()[1]
    found = pair.model.tool_poses(pair.test.q, tool_frame(), "measuring")
    truth = true_poses(40, 2, pair.test.q, tool_frame())
    assert float(angle_between(found[:, :3, :3], truth[:, :3, :3]).square().mean().sqrt().rad2deg()) < 0.05


def test_deviations_are_of_the_size_of_the_errors(arm: Case) -> None:
    """Squared distances in units of the predicted covariance, six coordinates each."""
    q, tool = arm.test.q[:100], tool_frame()
    truth = true_poses(60, 1, q, tool)
    poses, covariance = arm.model.predict_tool_poses(q, tool, "measuring")
    spin = truth[:, :3, :3] @ poses[:, :3, :3].mT
    turn = 0.5 * torch.stack([spin[:, i, j] - spin[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], 1)
    error = torch.cat([(truth - poses)[:, :3, 3], turn], 1)
    squares = (error[:, None] @ torch.linalg.solve(covariance, error[:, :, None]))[:, 0, 0]
    assert float(squares.median()) < 12.0  # 5.3 of a perfect Gaussian
    assert bool((torch.linalg.eigvalsh(covariance) > 0).all())


def test_covariance_in_the_base_frame_is_turned_into_its_axes(arm: Case) -> None:
    """Written out: the base's columns dropped, then shifts and turns about the base's axes."""
    model, q, tool = arm.model, arm.test.q[:6], tool_frame()
    at = model.map.geodesic.with_nominal(FlangePoints(model.nominal, tool_points(tool))).linearise(q)
    sensitivity = at.sensitivity.clone()
    sensitivity[..., :6] = 0.0
    seen = model.tool_poses(q, tool, "measuring")
    wanted = pose_directions(seen, LEVER)
    measured = wanted @ model.map.by_data.covariance(replace(at, sensitivity=sensitivity)) @ wanted.mT
    R = model.geometry.base[:3, :3]
    turn = torch.block_diag(R.mT, R.mT)
    found = model.predict_tool_poses(q, tool, "base")[1]
    torch.testing.assert_close(found, turn @ measured @ turn.mT, rtol=1e-9, atol=1e-16)


def test_wrong_tools_and_frames(arm: Case) -> None:
    def poses(tool: Any, frame: Any = "base") -> Callable[[], object]:
        return lambda: arm.model.tool_poses(arm.test.q, tool, frame)

    adaptive = model_of(CHAINS["one joint"], dc.TorchDiffEq("dopri5"))
    refused(
        (r"`tool` has the wrong shape: expected \(4, 4\) or \(3,\)", poses([0.0, 0.1])),
        ("the last row of the transform", poses(torch.ones(4, 4))),
        ("`tool` has 1 value", poses([0.0, 0.0, float("nan")])),
        ("`frame`: expected 'base' or 'measuring', got 'flange'", poses(None, "flange")),
        (
            r"dc\.RK4 or dc\.RK8, got TorchDiffEq",
            lambda: jacrev(lambda row: adaptive(row[None])[0])(adaptive.configurations[0]),
        ),
    )


TOOL = tool_transform([0.15, -0.12, 0.16])
STEP = 1e-5


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
    conditional = type(arm.model.map.conditional)
    known = conditional.covariance_between

    def wider(self: Conditional, at: Linearisation, other: Linearisation | None = None) -> Tensor:
        return known(self, at, other) + motion @ motion.mT

    monkeypatch.setattr(conditional, "covariance_between", wider)
    after = covariance_without_placement(arm.model, q, TOOL)
    assert_close(after, before, rtol=0, atol=1e-3 * float(before.diagonal(dim1=1, dim2=2).max()))


pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script`:DeprecationWarning")  # torch's own, in jacfwd


def same(found: Tensor, expected: Tensor, atol: float = 1e-10) -> None:
    torch.testing.assert_close(found, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("name", ["slides", "mimic joints", "arm", "a plain map"])
def test_jacobians(name: str) -> None:
    """In both modes, one row and all rows, at control points too."""
    model = fitted_plain("matern32") if name == "a plain map" else made(name)
    q = queries(model)
    expected = model.jacobian(q)

    def f(row: Tensor) -> Tensor:
        return model(row[None])[0]

    same(vmap(f)(q), model(q), 1e-12)
    same(vmap(jacrev(f))(q), expected)
    same(vmap(jacfwd(f))(q), expected)
    same(jacrev(f)(q[0]), expected[0])
    same(jacfwd(f)(q[0]), expected[0])
    same(vmap(lambda row: model.jacobian(row[None])[0])(q), expected)


def test_second_derivatives_against_differences_of_the_jacobian() -> None:
    model, h = made("slides", profile="matern72"), 1e-5
    q = queries(model)
    found = vmap(hessian(lambda row: model(row[None])[0]))(q)  # (N, 1, 3, n, n)
    for joint in range(q.shape[1]):
        step = h * torch.eye(q.shape[1], dtype=torch.float64)[joint]
        change = (model.jacobian(q + step) - model.jacobian(q - step)) / (2 * h)
        same(found[..., joint], change, 1e-7)


@pytest.mark.parametrize("frame", ["base", "measuring"])
def test_derivatives_of_tool_poses(frame: str) -> None:
    """Not zero, although the poses of plain queries are detached."""
    model = made("arm")
    q = queries(model)
    slopes = vmap(jacfwd(lambda row: model.tool_poses(row[None], frame=frame)[0]))(q)  # (N, 4, 4, n)
    poses, expected = model.tool_poses(q, frame=frame), model.tool_jacobian(q, frame=frame)
    spin = slopes[:, :3, :3].movedim(-1, 1) @ poses[:, None, :3, :3].mT  # (N, n, 3, 3) of [w]x
    turning = torch.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], 1)
    same(torch.cat([slopes[:, :3, 3], turning], 1), expected)
    same(vmap(lambda row: model.tool_jacobian(row[None], frame=frame)[0])(q), expected)
    posed = made("arm", markers=3)
    same(vmap(lambda row: posed.poses(row[None])[0])(q), posed.poses(q), 1e-12)


def test_values_are_checked_outside_of_transforms_only() -> None:
    model = made("arm")
    q = queries(model)
    q[1, 2] = torch.nan
    with pytest.raises(InputError, match="not finite"):
        model(q)
    finite = vmap(lambda row: model(row[None])[0])(q).isfinite().flatten(1).all(1)
    assert finite.tolist() == [True, False, *[True] * (len(q) - 2)]
