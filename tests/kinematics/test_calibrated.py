"""Calibrated kinematics: call, Jacobian, prediction, inverse, and input in all forms."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from deformation_bank import made
from product_bank import Case, covered, noise_blocks, simulated
from tangent_bank import tangent_covariance
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.registered_map import moved
from diffeo_calib.measurements.poses import angle_between, mark_jacobian, mark_points


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
