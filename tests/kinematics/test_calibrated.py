"""Calibrated kinematics: call, Jacobian, prediction, inverse, and input in all forms."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from math_bank import normal
from product_bank import Case, noise_blocks, prior_covariance, simulated
from scipy.stats import f
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, NumericalError

CHI2_95 = 7.8147  # 95 % quantile, three degrees of freedom
CASES = pytest.mark.parametrize(
    "name", ["arm", *(pytest.param(name, marks=pytest.mark.slow) for name in ("pair", "slider"))]
)


@pytest.fixture
def case(name: str, request: pytest.FixtureRequest) -> Case:
    return request.getfixturevalue(name)


# --- derivatives --------------------------------------------------------------------------------------------------


@CASES
def test_jacobian_against_autograd(case: Case) -> None:
    q = case.test.q[:6].clone().requires_grad_()
    points = case.model(q)
    rows = [torch.autograd.grad(part.sum(), q, retain_graph=True)[0] for part in points.flatten(1).unbind(1)]
    expected = torch.stack(rows, 1).unflatten(1, (-1, 3))
    assert_close(case.model.jacobian(q.detach()), expected, rtol=1e-9, atol=1e-12)


@CASES
def test_jacobian_against_central_differences(case: Case) -> None:
    q, h = case.test.q[:6], 1e-3
    steps = h * torch.eye(6, dtype=torch.float64)

    def central(step: Tensor) -> Tensor:
        return (case.model(q + step) - case.model(q - step)) / (2 * float(step.sum()))

    # Richardson extrapolation twice cancels h^2 and h^4.
    once = [[(4 * central(s / 2**k / 2) - central(s / 2**k)) / 3 for s in steps] for k in (0, 1)]
    expected = torch.stack([(16 * fine - coarse) / 15 for coarse, fine in zip(*once, strict=True)], -1)
    jacobian = case.model.jacobian(q)
    assert float((jacobian - expected).abs().max() / jacobian.abs().max()) < 1e-9


@CASES
def test_jacobian_is_not_the_nominal_one(case: Case) -> None:
    q = case.test.q[:6]
    nominal = case.result.identification.geometry.jacobian(q)
    difference = float((case.model.jacobian(q) - nominal).abs().max())
    assert 1e-5 < difference < 1e-1


# --- prediction ---------------------------------------------------------------------------------------------------


@CASES
@pytest.mark.parametrize("noise", [True, False])
def test_covariance_is_symmetric_and_positive(case: Case, noise: bool) -> None:
    mean, covariance = case.model.predict(case.test.q, noise=noise)
    torch.testing.assert_close(mean, case.model(case.test.q), rtol=0, atol=1e-12)
    assert covariance.shape == (*mean.shape, 3)
    largest = covariance.abs().amax()
    assert_close(covariance, covariance.mT, rtol=0, atol=1e-6 * float(largest))
    assert float(torch.linalg.eigvalsh(covariance).min()) > 0


@CASES
def test_covariance_is_that_of_the_tangent_model_written_out(case: Case) -> None:
    """Deformations of a millimetre change the covariance by about a permille; a missing term would change it more."""
    result, x, at = case.result, case.train.q, case.test.q[:20]
    scales, tails, geometry = result.selection.scales, result.tails, result.identification.geometry
    joint = [float(scales.translation_errors)] * 3 + [float(scales.rotation_errors)] * 3
    deviations = torch.tensor([0.1] * 6 + joint * 6 + [0.1] * 3 * case.model.markers, dtype=torch.float64)

    def prior(here: Tensor, there: Tensor) -> Tensor:
        loads, others = (elastic_columns(case, q).flatten(0, 1) for q in (here, there))
        return prior_covariance(scales, geometry, deviations, here, there) + loads @ others.T

    noise = noise_blocks(scales, geometry, x)
    inflated = tails.weights.rsqrt().repeat_interleave(3, 1)
    data = prior(x, x) + torch.block_diag(*(inflated[:, :, None] * noise * inflated[:, None]))
    cross, own = prior(at, x), prior(at, at)
    total = own - cross @ torch.linalg.solve(data, cross.T)
    m = 3 * case.model.markers
    blocks = torch.stack([total[m * i : m * (i + 1), m * i : m * (i + 1)] for i in range(20)])
    expected = torch.stack([blocks[:, 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(case.model.markers)], 1)
    _, without = case.model.predict(at, noise=False)
    _, with_noise = case.model.predict(at)
    scale = expected.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None]
    assert float(((without - expected) / scale).abs().max()) < 0.02
    wide = 3 * float(f.ppf(0.95, 3, tails.freedom)) / CHI2_95 if math.isfinite(tails.freedom) else 1.0
    wide *= simulated_quantile(noise) / CHI2_95
    for k in range(case.model.markers):
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


def elastic_columns(case: Case, q: Tensor) -> Tensor:
    """Displacement of the markers by each coefficient of the elasticity, in units of its prior: (N, 3 P, K).

    Where the rows do not show a joint's sag (the slider's tilt) its prior deviation is at least that of any robot.
    """
    scales, elasticity = case.result.selection.scales, case.model.nominal.elasticity
    assert elasticity is not None
    geometry, features = case.result.identification.geometry, elasticity.features(q)
    twists = geometry.sensitivities(q).flatten(1, 2)[..., geometry.slices["joints"]].unflatten(-1, (-1, 6))
    widened = case.model.map.geodesic.spec.prior_variance[geometry.size :].sqrt()
    columns = []
    for family in elasticity.compliances:
        size = scales.compliance if family.own else scales.lateral_compliance
        effect = twists[:, :, family.joint] @ torch.from_numpy(family.direction) * size[family.joint]
        for k in range(family.size):
            usual = effect * scales.gravity[k % 3]
            deviation = float(size[family.joint] * scales.gravity[k % 3])
            wider = max(1.0, float(widened[len(columns)]) / deviation) if deviation > 0 else 1.0
            columns.append(usual * wider * features[:, len(columns), None])
    assert len(columns) == elasticity.size
    return torch.stack(columns, 2)


@pytest.mark.slow
def test_mean_and_covariance_belong_to_their_marker(pair: Case) -> None:
    """Markers in the wrong order would be 100 mm off, and their covariances would be swapped."""
    mean, covariance = pair.model.predict(pair.test.q)
    assert float((mean - pair.test.points).norm(dim=-1).max()) < 1e-3
    whole = pair.model.map.predict(pair.test.q)[1]
    assert torch.equal(covariance[:, 0], whole[:, :3, :3])
    assert torch.equal(covariance[:, 1], whole[:, 3:, 3:])
    assert not torch.allclose(covariance[:, 0], covariance[:, 1], rtol=1e-2, atol=0)


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


def test_uncertainty_grows_away_from_the_data(arm: Case) -> None:
    scales, near = arm.result.selection.scales, arm.train.q[:, 0].abs() < 0.8
    rows = arm.train.rows(near)
    model = dc.calibrate(arm.robot, rows, hyperparameters=scales).model

    def spread(at: float) -> float:
        q = rows.q.clone()
        q[:, 0] = at
        return float(model.predict(q, noise=False)[1].diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt())

    spreads = [spread(at) for at in (0.0, 1.2, 1.8, 2.6)]
    assert all(later > 1.02 * earlier for earlier, later in pairwise(spreads)), spreads
    at_data = model.predict(rows.q, noise=False)[1].diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt()
    assert float(at_data) < spreads[0]


@pytest.mark.slow
def test_regions_of_95_percent_with_200_poses(arm_200: Case) -> None:
    mean, covariance = arm_200.model.predict(arm_200.test.q)
    error = (arm_200.test.points - mean)[..., None]
    distance = (error.mT @ torch.linalg.solve(covariance, error)).flatten()
    assert 0.85 <= float((distance < CHI2_95).double().mean()) <= 0.99


@pytest.mark.slow
def test_more_data_reduce_the_uncertainty(arm: Case, arm_200: Case) -> None:
    few, many = (c.model.predict(arm.test.q, noise=False)[1].diagonal(dim1=-2, dim2=-1).sum() for c in (arm, arm_200))
    assert float(many) < 0.6 * float(few)


# --- inverse ------------------------------------------------------------------------------------------------------


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
def test_inverse_with_as_many_equations_as_joints(pair: Case) -> None:
    """Two markers give six coordinates, but their distance is fixed, so that only consistent targets can be reached."""
    wanted = pair.test.q[:5]
    q = pair.model.inverse(pair.model(wanted), wanted + 1e-3)
    assert_close(pair.model(q), pair.model(wanted), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_unreachable_target(arm: Case) -> None:
    start = arm.test.q[:3]
    targets = arm.model(start).clone()
    targets[1] += 100.0
    with pytest.raises(NumericalError, match=r"target 1: .*; start nearer to the target"):
        arm.model.inverse(targets, start)


def test_inverse_checks_its_shapes(arm: Case) -> None:
    start = arm.test.q[:3]
    for wrong in (arm.model(start)[:2], arm.model(start)[:, 0], torch.zeros(3, 2, 3)):
        with pytest.raises(InputError, match=r"`points` has the wrong shape: expected \(3, 1, 3\)"):
            arm.model.inverse(wrong, start)


# --- input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["__call__", "jacobian", "predict"])
@pytest.mark.parametrize("shape", [(4, 5), (6,), (2, 3, 6), ()])
def test_wrong_shape_names_the_robot_and_its_joints(arm: Case, method: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match=r"`q` must have shape \(N, 6\) for robot 'simulated_arm'.*joint_names"):
        getattr(arm.model, method)(torch.zeros(shape))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_values_that_are_not_finite_are_refused(arm: Case, bad: float) -> None:
    with pytest.raises(InputError, match="not finite"):
        arm.model([[0.0, 0.0, bad, 0.0, 0.0, 0.0]])
    with pytest.raises(InputError, match="not finite"):
        arm.model(torch.full((1, 6), bad))


def test_words_are_refused(arm: Case) -> None:
    with pytest.raises(InputError, match="`q`"):
        arm.model("home")


def test_lists_arrays_and_other_dtypes(arm: Case) -> None:
    q = arm.test.q[:3]
    expected = arm.model(q)
    for same in (q.tolist(), q.numpy(), tuple(map(tuple, q.tolist())), np.asfortranarray(q.numpy())):
        assert torch.equal(arm.model(same), expected)
        assert torch.equal(arm.model.jacobian(same), arm.model.jacobian(q))
        assert torch.equal(arm.model.predict(same)[1], arm.model.predict(q)[1])
    assert arm.model(q.float()).dtype == torch.float64
    assert arm.model([[0, 0, 0, 0, 0, 0]]).dtype == torch.float64
    assert_close(arm.model(q.float()), expected, rtol=0, atol=1e-5)


def test_no_rows(arm: Case) -> None:
    none = arm.test.q[:0]
    assert arm.model(none).shape == (0, 1, 3)
    assert arm.model.jacobian(none).shape == (0, 1, 3, 6)


def test_no_rows_to_predict(arm: Case) -> None:
    mean, covariance = arm.model.predict(arm.test.q[:0])
    assert (mean.shape, covariance.shape) == ((0, 1, 3), (0, 1, 3, 3))


def test_no_rows_to_invert(arm: Case) -> None:
    assert arm.model.inverse(torch.zeros(0, 1, 3), arm.test.q[:0]).shape == (0, 6)


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
