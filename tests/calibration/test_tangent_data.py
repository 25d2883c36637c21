"""Tangent data: covariances against formulas written a second time, subsets, and a single linearisation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from product_bank import simulated
from tangent_bank import Setting, built, noise_covariance, normal, shaken, tangent_covariance, weighted
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.scales import tangent_data
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.noise import Noise
from diffeo_calib.robots import SimulatedArm

# --- covariances --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1])
def test_covariance_and_target_are_those_written_out(setting: Setting, seed: int) -> None:
    scales = shaken(setting.scales, seed)
    for data in (setting.tangent_data, weighted(setting, seed)):
        nominal, theta, x = data.nominal, data.theta, data.x
        expected = tangent_covariance(scales, nominal, theta, x)
        scale = float(expected.abs().max())
        assert_close(data.linearisation(scales).gram(), expected, rtol=0, atol=1e-12 * scale)
        noise = noise_covariance(scales, setting, theta, data.tails.weights)
        expected += torch.block_diag(*noise)
        assert_close(data.covariance_terms(scales).matrix(), expected, rtol=0, atol=1e-12 * scale)
        target = data.y - nominal(x, theta) + nominal.sensitivities(x, theta) @ theta
        assert_close(data.target, target, rtol=0, atol=1e-14)


def test_noise_is_that_written_out(setting: Setting) -> None:
    """By itself: next to the prior of the base it would be invisible."""
    scales, data = shaken(setting.scales, 5), weighted(setting, 5)
    ones = torch.ones_like(data.tails.weights)
    for weights, actual in ((ones, data.noise(scales)), (data.tails.weights, data.weighted_noise(scales))):
        expected = noise_covariance(scales, setting, data.theta, weights)
        assert_close(actual, expected, rtol=1e-6, atol=1e-7 * float(expected.abs().max()))


def test_the_search_sees_the_matrix_of_the_fit(setting: Setting) -> None:
    """By all joints at once and by one kernel after the other."""
    data, scales = weighted(setting), shaken(setting.scales, 7)
    expected = data.factorised(scales).factor
    matrix = data.covariance_terms(scales).matrix()
    assert_close(matrix, matrix.mT, rtol=0, atol=1e-14 * float(matrix.abs().max()))
    assert_close(matrix, expected @ expected.mT, rtol=0, atol=1e-13 * float(matrix.abs().max()))


def test_inner_is_the_sum_with_the_whole_matrix(setting: Setting) -> None:
    """And its derivative by the scales is that of the matrix."""
    data = weighted(setting)
    count = data.target.numel()
    weights = normal(count, count, seed=4)
    point = shaken(setting.scales, 3).logarithms()
    terms = data.covariance_terms(setting.scales.from_logarithms(point))
    value, matrix = float(terms.inner(weights)), terms.matrix()
    size = float((weights * matrix).abs().sum())
    assert value == pytest.approx(float((weights * matrix).sum()), abs=1e-12 * size)
    live, other = point.clone().requires_grad_(), point.clone().requires_grad_()
    inner = data.covariance_terms(setting.scales.from_logarithms(live)).inner(weights)
    (gradient,) = torch.autograd.grad(inner, live)
    scales = setting.scales.from_logarithms(other)
    dense = (weights * Noise(data.weighted_noise(scales)).add_to(data.linearisation(scales).gram())).sum()
    (expected,) = torch.autograd.grad(dense, other)
    assert_close(gradient, expected, rtol=1e-9, atol=1e-12 * size)


def test_prior_of_base_and_markers_is_that_of_the_data(setting: Setting) -> None:
    """A narrow one lowers the covariance by what the places contribute."""
    data, scales = setting.tangent_data, setting.scales
    narrow = replace(data, place_deviation=1e-3)
    geometry = data.nominal.geometry
    places = [*range(*geometry.slices["base"].indices(geometry.size))]
    places += range(*geometry.slices["tool"].indices(geometry.size))
    S = data.sensitivities[..., places].flatten(0, 1)
    change = data.covariance_terms(scales).matrix() - narrow.covariance_terms(scales).matrix()
    assert_close(change, (0.1**2 - 1e-3**2) * S @ S.mT, rtol=0, atol=1e-11 * float(change.abs().max()))


# --- parts and variants -------------------------------------------------------------------------------------------


def test_rows_are_those_of_the_whole(setting: Setting) -> None:
    data, rows = weighted(setting), torch.tensor([5, 0, 7])
    some, m = data.rows(rows), data.y.shape[1]
    index = (rows[:, None] * m + torch.arange(m)).flatten()
    whole, part = data.covariance_terms(setting.scales).matrix(), some.covariance_terms(setting.scales).matrix()
    assert_close(part, whole[index][:, index], rtol=0, atol=1e-13 * float(whole.abs().max()))
    assert_close(some.target, data.target[rows], rtol=0, atol=1e-14)


def test_other_measured_coordinates_and_weights_reach_the_target_and_the_noise(setting: Setting) -> None:
    data = setting.tangent_data
    covariance, target = data.covariance_terms(setting.scales).matrix(), data.target
    moved = data.with_measured(data.y + 1e-3)
    assert_close(moved.target, target + 1e-3, rtol=0, atol=1e-14)
    assert_close(moved.covariance_terms(setting.scales).matrix(), covariance, rtol=0, atol=0)
    halved = data.with_tails(Tails(4.0, torch.full_like(data.tails.weights, 0.5)))
    assert_close(halved.weighted_noise(setting.scales), 2 * data.noise(setting.scales))
    assert_close(halved.target, target, rtol=0, atol=0)


def test_samples_are_drawn_by_the_seed() -> None:
    arm = SimulatedArm(seed=6)
    data = Setting(arm.nominal, dc.Measurements(*arm.measure(200))).tangent_data
    first, same, other = (data.sample(150, 900, seed)[1].x for seed in (0, 0, 1))
    assert first.shape == (150, 6)
    assert len(torch.unique(first, dim=0)) == 150
    assert torch.equal(first, same)
    assert not torch.equal(first, other)
    assert len(data.sample(150, 90, 0)[1].x) == 30
    assert len(data.sample(150, 1, 0)[1].x) == 1
    rows, whole = data.sample(500, 900000, 3)
    assert torch.equal(rows, torch.arange(200))
    assert torch.equal(whole.x, data.x)
    rows, some = data.sample(20, 900, 4)
    assert torch.equal(some.x, data.x[rows])
    assert rows.tolist() == sorted(rows.tolist())


# --- how often k0 is linearised -----------------------------------------------------------------------------------


class CountingMap(GeometryMap):
    """Counts the configurations at which each method is called."""

    def __init__(self, nominal: GeometryMap) -> None:
        super().__init__(nominal.geometry, elastic=nominal.elasticity is not None)
        self.count: Counter[str] = Counter()

    def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
        self.count["values"] += len(x)
        return super().__call__(x, theta)

    def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
        self.count["jacobian"] += len(x)
        return super().jacobian(x, theta)

    def sensitivities(self, x: Tensor, theta: Tensor) -> Tensor:
        self.count["sensitivities"] += len(x)
        return super().sensitivities(x, theta)


def counting(setting: Setting) -> tuple[TangentData, Counter[str]]:
    nominal = CountingMap(setting.nominal)
    return replace(setting.tangent_data, nominal=nominal), nominal.count


ONCE = ("values", "jacobian", "sensitivities")


def test_k0_is_linearised_once() -> None:
    setting = built("two markers")
    data, count = counting(setting)
    for scales in (setting.scales, shaken(setting.scales, 1)):
        data.covariance_terms(scales).matrix()
        data.factorised(scales)
        data.noise(scales)
        part = data.rows(torch.tensor([3, 1]))
        part.covariance_terms(scales).matrix()
        data.with_tails(Tails.none(*data.tails.weights.shape)).covariance_terms(scales).matrix()
        data.with_measured(data.y).covariance_terms(scales).matrix()
        data.sample(5, 900, 0)[1].covariance_terms(scales).matrix()
    assert count == dict.fromkeys(ONCE, len(data.x))


def test_rows_before_the_whole_is_needed_linearise_these_rows_only() -> None:
    data, count = counting(built("two markers"))
    some = data.rows(torch.tensor([3, 1]))
    assert not count
    some.covariance_terms(built("two markers").scales).matrix()
    assert count == dict.fromkeys(ONCE, 2)


def test_a_calibration_linearises_every_pose_once_before_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Around the geometric calibration; the exact fit needs derivatives elsewhere too."""
    arm, train, _ = simulated(14)
    seen: Counter[str] = Counter()

    def watched(name: str, real: Callable[..., Tensor]) -> Callable[..., Tensor]:
        def method(self: GeometryMap, x: Tensor, theta: Tensor) -> Tensor:
            seen[name] += len(x)
            return real(self, x, theta)

        return method

    class Enough(Exception):
        pass

    def stop(task: str, *_: object) -> None:
        if task == "Gauss-Newton":
            raise Enough

    for name in ("jacobian", "sensitivities"):
        monkeypatch.setattr(GeometryMap, name, watched(name, getattr(GeometryMap, name)))
    with pytest.raises(Enough):
        dc.calibrate(arm.nominal, train, progress=stop)
    assert seen["sensitivities"] <= 2 * len(train)  # by the tangent data, and by the test of changes
    assert seen["jacobian"] <= 3 * len(train)  # once by the tangent data, once at the start of the fit


# --- matrices that are kept ---------------------------------------------------------------------------------------


def test_kept_matrices_are_those_of_their_scales_and_weights(setting: Setting) -> None:
    """Whatever was asked for before: other scales, other weights, fewer rows."""
    first, second = shaken(setting.scales, 1), shaken(setting.scales, 2)
    kept, other = setting.tangent_data.with_tails(setting.tangent_data.tails), weighted(setting, 3)
    orders = [(kept, first), (kept.with_tails(other.tails), first), (kept, second), (kept, first)]
    for data, scales in orders:
        fresh = replace(data)
        size = float(fresh.gram(scales).abs().max())
        assert_close(data.gram(scales), fresh.linearisation(scales).gram(), rtol=0, atol=1e-14 * size)
        assert_close(data.factorised(scales).factor, fresh.factorised(scales).factor, rtol=0, atol=0)
    some = kept.rows(torch.arange(3))
    assert some.gram(first).shape == (3 * kept.y.shape[1],) * 2
    turned = kept.rows(torch.arange(len(kept.x)).flip(0))
    expected = replace(turned).gram(first)
    assert_close(turned.gram(first), expected, rtol=0, atol=0)


def test_matrices_of_few_rows_are_computed_once(setting: Setting, monkeypatch: pytest.MonkeyPatch) -> None:
    scales, data = setting.scales, replace(setting.tangent_data)
    assert data.factorised(scales) is data.factorised(scales)
    assert data.with_tails(weighted(setting).tails).gram(scales) is data.gram(scales)
    assert data.factorised(scales.inflated(1.0)) is not data.factorised(scales)
    monkeypatch.setattr(tangent_data, "KEPT_COORDINATES", 1)
    many = replace(data)
    assert many.factorised(scales) is not many.factorised(scales)
    assert many.gram(scales) is not many.gram(scales)


def test_a_sample_of_all_rows_is_the_data_themselves(setting: Setting) -> None:
    data = setting.tangent_data
    rows, some = data.sample(len(data.x), data.y.numel(), 0)
    assert rows.tolist() == list(range(len(data.x)))
    assert some is data
