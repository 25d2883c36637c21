"""Calibrated kinematics: call, Jacobian, prediction, inverse, derivatives, and tools that were never measured."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from deformation_bank import fitted_plain, made, model_of, queries
from product_bank import Case, covered, noise_blocks, simulated
from robots_bank import CHAINS, tool_frame
from table_bank import refused
from tangent_bank import tangent_covariance
from torch import Tensor
from torch.func import hessian, jacfwd, jacrev, vmap
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.kinematics.nominal import FlangePoints, GeometryMap
from diffeo_calib.kinematics.registered_map import moved
from diffeo_calib.kinematics.tool import REFERENCE_ROWS, covariance_without_placement, tool_points, tool_transform
from diffeo_calib.measurements.poses import angle_between, mark_jacobian, mark_points, pose_directions, poses_from_marks
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.runtime.program import TOOL_LEVER


def test_covariance_is_that_of_the_tangent_model_written_out(arm: Case) -> None:
    """Deformations of a millimetre change the covariance by about a permille; a missing term would change it more."""
    result, x, at = arm.result, arm.train.q, arm.test.q[:20]
    scales, tails = result.selection.scales, result.tails
    nominal = GeometryMap(result.registration.geometry, elastic=True)
    deflection = torch.zeros(nominal.parameters - nominal.geometry.size, dtype=torch.float64)
    theta = torch.cat([result.identification.theta, deflection])
    prior = tangent_covariance(scales, nominal, theta, torch.cat([x, at]))
    noise = noise_blocks(scales, result.identification.geometry, x)
    inflated = tails.weights.rsqrt().repeat_interleave(3, 1)
    fit = slice(0, 3 * len(x))
    own, cross = prior[fit.stop :, fit.stop :], prior[fit.stop :, fit]
    data = prior[fit, fit] + torch.block_diag(*(inflated[:, :, None] * noise * inflated[:, None]))
    total = (own - cross @ torch.linalg.solve(data, cross.T)).unflatten(0, (-1, 3)).unflatten(2, (-1, 3))
    expected = torch.einsum("nanb->nab", total)
    covariance = arm.model.predict(at, noise=False)[1][:, 0]
    scale = expected.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None]
    assert float(((covariance - expected) / scale).abs().max()) < 0.02


@pytest.mark.slow
def test_regions_of_95_percent_hold_about_as_many_points(arm: Case, pair: Case) -> None:
    shares = [covered(case.model, case.test) for case in (arm, pair)]
    assert all(0.80 <= share <= 0.995 for share in shares)
    assert 0.85 <= sum(shares) / 2 <= 0.99


def test_errors_that_the_fields_do_not_resolve(arm: Case, tmp_path: Path) -> None:
    """Regions without noise hold them, those of new measurements had them in their noise."""
    q, variances, known = arm.test.q[:5], torch.linspace(1e-8, 6e-8, 6, dtype=torch.float64), arm.model.map
    short, J = replace(known, unresolved=variances), known.jacobian(q)
    found = short.predict(q, noise=False)[1]
    assert_close(found, known.predict(q, noise=False)[1] + (J * variances) @ J.mT, rtol=5e-3, atol=2e-11)
    assert_close(short.predict(q)[1], known.predict(q)[1], rtol=1e-9, atol=0)
    between = short.joint_covariance(q).unflatten(0, (-1, 3)).unflatten(2, (-1, 3))
    assert_close(torch.einsum("nanb->nab", between), found, rtol=1e-9, atol=1e-15)
    assert moved(short, torch.eye(4, dtype=torch.float64)).unresolved is variances
    assert_close(short.inflated(4.0).unresolved, 4.0 * variances)
    dc.save(short, tmp_path / "model.safetensors")
    assert dc.load(tmp_path / "model.safetensors").map.unresolved.equal(variances)


def test_inverse_reaches_its_targets(arm: Case) -> None:
    wanted = arm.test.q[:30]
    targets = arm.model(wanted)
    start = wanted + 0.02 * torch.sin(50 * wanted)
    q = arm.model.inverse(targets, start)
    assert_close(arm.model(q), targets, rtol=0, atol=1e-9)
    assert float((q - start).abs().max()) < 0.3  # the nearest solution
    small = made("one joint")
    with pytest.raises(NumericalError, match=r"target 1: .*; start nearer to the target"):
        small.inverse(small(small.map.x) + 100.0 * torch.eye(9)[1, :, None, None].double(), small.map.x)


def test_no_rows(arm: Case) -> None:
    none = arm.test.q[:0]
    assert arm.model(none).shape == (0, 1, 3)
    assert arm.model.jacobian(none).shape == (0, 1, 3, 6)
    assert [part.shape for part in arm.model.predict(none)] == [(0, 1, 3), (0, 1, 3, 3)]
    assert arm.model.inverse(torch.zeros(0, 1, 3), none).shape == (0, 6)
    assert arm.model.tool_poses(none).shape == (0, 4, 4)
    assert arm.model.tool_jacobian(none).shape == (0, 6, 6)
    assert [t.shape for t in arm.model.predict_tool_poses(none)] == [(0, 4, 4), (0, 6, 6)]


def test_wrong_input(arm: Case) -> None:
    model, start = arm.model, arm.test.q[:3]
    for ask in (model, model.jacobian, model.predict):
        for shape in ((4, 5), (6,), ()):
            with pytest.raises(InputError, match=r"`q` must have shape \(N, 6\) for robot 'simulated_arm'"):
                ask(torch.zeros(shape))
    for bad in (float("nan"), float("inf")):
        with pytest.raises(InputError, match="not finite"):
            model([[0.0, 0.0, bad, 0.0, 0.0, 0.0]])
    for wrong in (model(start)[:2], model(start)[:, 0], torch.zeros(3, 2, 3)):
        with pytest.raises(InputError, match=r"`points` has the wrong shape: expected \(3, 1, 3\)"):
            model.inverse(wrong, start)
    for ask in (model.poses, model.predict_poses):
        with pytest.raises(InputError, match=r"calibrated with points: it has no poses; .*from_poses"):
            ask(start)
    for device in ("foo", "cuda:99", torch.float32, "meta"):
        with pytest.raises(InputError, match="the device"):
            model.to(device)  # pyright: ignore[reportArgumentType]


def test_large_batches_equal_small_ones_and_full_turns_change_nothing(arm: Case) -> None:
    arm_, _, _ = simulated(1)
    q = arm_.sample(10_000, seed=9)
    picked = torch.arange(0, 10_000, 997)
    assert_close(arm.model(q)[picked], arm.model(q[picked]), rtol=0, atol=1e-14)
    turned = q[picked] + 2 * torch.pi * torch.tensor([1.0, -1, 0, 2, 0, -3], dtype=torch.float64)
    assert_close(arm.model(turned), arm.model(q[picked]), rtol=0, atol=1e-13)
    assert_close(arm.model.jacobian(q[:3000])[picked[:4]], arm.model.jacobian(q[picked[:4]]), rtol=0, atol=1e-13)
    covariance = arm.model.predict(q[:200])[1]
    singly = torch.cat([arm.model.predict(row[None])[1] for row in q[:200:40]])
    assert_close(covariance[::40], singly, rtol=1e-6, atol=1e-16)


def test_poses_fit_the_points_of_the_model(posed: Case) -> None:
    model, q = posed.model, posed.test.q
    assert (model.lever, model.markers) == (0.1, 3)
    assert "poses, fitted to 30 poses" in repr(model)
    poses, points = model.poses(q), model(q)
    assert_close(poses[:, :3, 3], points.mean(1), rtol=0, atol=1e-14)
    eye = torch.eye(3, dtype=torch.float64).expand(len(q), 3, 3)
    assert_close(poses[:, :3, :3].mT @ poses[:, :3, :3], eye, rtol=0, atol=1e-14)
    change = (mark_points(poses, 0.1) - points).norm(dim=-1)
    assert float(change.max()) < 1e-3  # the deformation changes the triangle of points only slightly
    measured = posed.test.poses
    assert measured is not None
    assert float(angle_between(poses[:, :3, :3], measured[:, :3, :3]).max()) < 5e-3
    assert_close(model.predict_poses(q)[0], poses, rtol=0, atol=1e-12)


def test_covariance_of_poses_is_that_of_their_points(posed: Case) -> None:
    """Position: the mean of the points. Rotation vectors: in the measuring frame."""
    model, q = posed.model, posed.test.q[:40]
    whole = model.map.predict(q)[1]
    poses, covariance = model.predict_poses(q)
    mean = torch.cat([torch.eye(3, dtype=torch.float64)] * 3, 1) / 3
    assert_close(covariance[:, :3, :3], mean @ whole @ mean.T, rtol=1e-9, atol=1e-20)
    back = torch.linalg.inv(mark_jacobian(poses, 0.1).mT @ mark_jacobian(poses, 0.1)) @ mark_jacobian(poses, 0.1).mT
    assert_close(covariance, back @ whole @ back.mT, rtol=1e-6, atol=1e-16)
    without = model.predict_poses(q, noise=False)[1]
    assert bool((without.diagonal(dim1=1, dim2=2) < covariance.diagonal(dim1=1, dim2=2)).all())


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


def test_motions_of_base_and_tool_count_for_nothing(arm: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    """A decimetre and 0.1 rad of each, by finite differences, added to what the model does not know."""
    q, known, tool = arm.test.q[:4], arm.model.configurations, tool_transform([0.15, -0.12, 0.16])
    before = covariance_without_placement(arm.model, q, tool)
    every = torch.linspace(0, len(known) - 1, min(len(known), REFERENCE_ROWS), dtype=torch.float64).round().long()
    rows, eye, h = torch.cat([known[every], q]), torch.eye(6, dtype=torch.float64), 1e-5

    def points(step: Tensor, *, base: bool) -> Tensor:
        """Coordinates of the tool's points after a motion of the base, or of the tool on the flange."""
        moved = arm.model.tool_poses(rows, tool if base else step @ tool, "measuring")
        return mark_points(step @ moved if base else moved, TOOL_LEVER).flatten()

    ends = [
        [points(twist_transform(sign * h * own), base=base) for base in (True, False) for own in eye]
        for sign in (1, -1)
    ]
    motion = 0.1 * (torch.stack(ends[0], 1) - torch.stack(ends[1], 1)) / (2 * h)
    conditional = type(arm.model.map.conditional)
    between = conditional.covariance_between
    monkeypatch.setattr(conditional, "covariance_between", lambda *given: between(*given) + motion @ motion.mT)
    after = covariance_without_placement(arm.model, q, tool)
    assert_close(after, before, rtol=0, atol=1e-3 * float(before.diagonal(dim1=1, dim2=2).max()))


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
