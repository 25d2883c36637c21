"""Calibrated kinematics: call, Jacobian, prediction, inverse, and input in all forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from math_bank import normal
from product_bank import Case, noise_blocks, simulated
from scipy.stats import f
from tangent_bank import tangent_covariance
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.measurements.poses import angle_between, mark_jacobian, mark_points
from diffeo_calib.runtime.chain import perpendicular

CHI2_95 = 7.8147  # 95 % quantile, three degrees of freedom
CASES = pytest.mark.parametrize(
    "name", ["arm", *(pytest.param(name, marks=pytest.mark.slow) for name in ("pair", "slider"))]
)


@pytest.fixture
def case(name: str, request: pytest.FixtureRequest) -> Case:
    return request.getfixturevalue(name)


# --- prediction -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["arm", pytest.param("pair", marks=pytest.mark.slow)])
def test_covariance_is_that_of_the_tangent_model_written_out(case: Case) -> None:
    """Deformations of a millimetre change the covariance by about a permille; a missing term would change it more."""
    result, x, at = case.result, case.train.q, case.test.q[:20]
    scales, tails, P = result.selection.scales, result.tails, case.model.markers
    nominal = GeometryMap(result.registration.geometry, elastic=True)
    deflection = torch.zeros(nominal.parameters - nominal.geometry.size, dtype=torch.float64)
    theta = torch.cat([result.identification.theta, deflection])
    prior = tangent_covariance(scales, nominal, theta, torch.cat([x, at]))
    noise = noise_blocks(scales, result.identification.geometry, x)
    inflated = tails.weights.rsqrt().repeat_interleave(3, 1)
    fit = slice(0, 3 * P * len(x))
    own, cross = prior[fit.stop :, fit.stop :], prior[fit.stop :, fit]
    data = prior[fit, fit] + torch.block_diag(*(inflated[:, :, None] * noise * inflated[:, None]))
    total = (own - cross @ torch.linalg.solve(data, cross.T)).unflatten(0, (-1, P, 3)).unflatten(3, (-1, P, 3))
    expected = torch.einsum("npanpb->npab", total)
    _, without = case.model.predict(at, noise=False)
    _, with_noise = case.model.predict(at)
    scale = expected.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None]
    assert float(((without - expected) / scale).abs().max()) < 0.02
    wide = 3 * float(f.ppf(0.95, 3, tails.freedom)) / CHI2_95 if math.isfinite(tails.freedom) else 1.0
    wide *= simulated_quantile(noise) / CHI2_95
    for k in range(P):
        added = (with_noise - without)[:, k]
        own_noise = wide * noise.mean(0)[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        assert_close(added, own_noise.expand_as(added), rtol=0, atol=0.01 * float(own_noise.abs().max()))


def simulated_quantile(noise: Tensor) -> float:
    """95 % quantile of squared errors of noise (N, 3 P, 3 P), in units of the mean covariance of each marker."""
    squares = []
    for k in range(noise.shape[1] // 3):
        own = noise[:, 3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
        errors = torch.linalg.cholesky(own) @ normal(len(own), 3, 20_000, seed=k)
        squares.append((errors * torch.linalg.solve(own.mean(0), errors)).sum(1).flatten())
    return float(np.quantile(torch.cat(squares).numpy(), 0.95))


@pytest.mark.slow
def test_regions_of_95_percent_hold_about_as_many_points(arm: Case, pair: Case, slider: Case) -> None:
    inside = []
    for case in (arm, pair, slider):
        mean, covariance = case.model.predict(case.test.q)
        error = (case.test.points - mean)[..., None]
        distance = (error.mT @ torch.linalg.solve(covariance, error)).flatten()
        inside.append(distance < CHI2_95)
        assert 0.80 <= float(inside[-1].double().mean()) <= 0.995
    assert 0.85 <= float(torch.cat(inside).double().mean()) <= 0.99


# --- inverse --------------------------------------------------------------------------------------------------------


@CASES
def test_inverse_reaches_its_targets(case: Case) -> None:
    wanted = case.test.q[:30]
    targets = case.model(wanted)
    start = wanted + 0.02 * torch.sin(50 * wanted)
    q = case.model.inverse(targets, start)
    assert q.shape == wanted.shape
    assert_close(case.model(q), targets, rtol=0, atol=1e-9)
    assert float((q - start).abs().max()) < 0.3  # the nearest solution


def test_inverse_compensates_what_the_nominal_model_misses(arm: Case) -> None:
    """Commanded through the inverse, the true arm reaches its targets ten times more accurately."""
    truth, _, _ = simulated(1)
    commanded = arm.test.q[:40]
    registered = arm.result.registration.geometry
    targets = registered.points(commanded)  # targets of the nominal robot
    q = arm.model.inverse(targets, commanded)
    before = (truth.true_points(commanded) - targets).norm(dim=-1).square().mean().sqrt()
    after = (truth.true_points(q) - targets).norm(dim=-1).square().mean().sqrt()
    assert float(after) < 0.1 * float(before)


@pytest.mark.slow
def test_unreachable_target(arm: Case) -> None:
    start = arm.test.q[:3]
    targets = arm.model(start).clone()
    targets[1] += 100.0
    with pytest.raises(NumericalError, match=r"target 1: .*; start nearer to the target"):
        arm.model.inverse(targets, start)


# --- input ----------------------------------------------------------------------------------------------------------


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
    for device in ("foo", "cuda:99", torch.float32, "meta"):
        with pytest.raises(InputError, match="the device"):
            model.to(device)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("axis", "rows"),
    [
        ((0.0, 0.0, 1.0), ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0))),
        ((0.0, 1.0, 0.0), ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))),
        ((1.0, 0.0, 0.0), ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))),
        ((0.0, 0.0, -1.0), ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0))),
    ],
)
def test_lateral_directions_of_gravity_sag(axis: tuple[float, ...], rows: tuple[tuple[float, ...], ...]) -> None:
    """Coefficients in model files refer to these directions: they must never change."""
    np.testing.assert_allclose(perpendicular(np.array(axis)), np.array(rows), rtol=0, atol=1e-15)


def test_large_batches_equal_small_ones(arm: Case) -> None:
    arm_, _, _ = simulated(1)
    q = arm_.sample(10_000, seed=9)
    picked = torch.arange(0, 10_000, 997)
    assert_close(arm.model(q)[picked], arm.model(q[picked]), rtol=0, atol=1e-14)
    assert_close(arm.model.jacobian(q[:3000])[picked[:4]], arm.model.jacobian(q[picked[:4]]), rtol=0, atol=1e-13)
    covariance = arm.model.predict(q[:200])[1]
    singly = torch.cat([arm.model.predict(row[None])[1] for row in q[:200:40]])
    assert_close(covariance[::40], singly, rtol=1e-6, atol=1e-16)


def test_full_turns_change_nothing(arm: Case) -> None:
    q = arm.test.q[:5]
    turned = q + 2 * torch.pi * torch.tensor([1.0, -1, 0, 2, 0, -3], dtype=torch.float64)
    assert_close(arm.model(turned), arm.model(q), rtol=0, atol=1e-13)
    assert_close(arm.model.predict(turned)[1], arm.model.predict(q)[1], rtol=1e-6, atol=1e-16)


# --- the poses of calibrated kinematics: their fit to three points, covariances and inverse -------------------------


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


def test_points_have_no_poses(arm: Case) -> None:
    for ask in (arm.model.poses, arm.model.predict_poses):
        with pytest.raises(InputError, match=r"calibrated with points: it has no poses; .*from_poses"):
            ask(arm.test.q)


def test_a_lever_belongs_to_three_points(arm: Case, posed: Case) -> None:
    with pytest.raises(InputError, match=r"a model of poses: expected three points for each, got 1"):
        dc.CalibratedKinematics(arm.robot, arm.model.map, lever=0.1)
    with pytest.raises(InputError, match=r"`lever`.*above 0, got -0.1"):
        dc.CalibratedKinematics(posed.robot, posed.model.map, lever=-0.1)
    assert dc.CalibratedKinematics(arm.robot, arm.model.map).lever is None
