"""Tangent data: covariances against formulas written a second time, subsets, and a single linearisation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from product_bank import simulated
from tangent_bank import Setting, built, covariance, noise_covariance, shaken, tangent_covariance, weighted
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.scales import tangent_data
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.process.tails import Tails
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
        target = data.y - nominal(x, theta) + nominal.sensitivities(x, theta) @ theta
        assert_close(data.target, target, rtol=0, atol=1e-14)


def test_noise_is_that_written_out(setting: Setting) -> None:
    """By itself: next to the prior of the base it would be invisible."""
    scales, data = shaken(setting.scales, 5), weighted(setting, 5)
    ones = torch.ones_like(data.tails.weights)
    for weights, actual in ((ones, data.noise(scales)), (data.tails.weights, data.weighted_noise(scales))):
        expected = noise_covariance(scales, setting, data.theta, weights)
        assert_close(actual, expected, rtol=1e-6, atol=1e-7 * float(expected.abs().max()))


# --- parts and variants -------------------------------------------------------------------------------------------


def test_rows_are_those_of_the_whole(setting: Setting) -> None:
    data, rows = weighted(setting), torch.tensor([5, 0, 7])
    some, m = data.rows(rows), data.y.shape[1]
    index = (rows[:, None] * m + torch.arange(m)).flatten()
    whole, part = covariance(data, setting.scales), covariance(some, setting.scales)
    assert_close(part, whole[index][:, index], rtol=0, atol=1e-13 * float(whole.abs().max()))
    assert_close(some.target, data.target[rows], rtol=0, atol=1e-14)


def test_other_measured_coordinates_and_weights_reach_the_target_and_the_noise(setting: Setting) -> None:
    data = setting.tangent_data
    target = data.target
    moved = replace(data, y=data.y + 1e-3)
    assert_close(moved.target, target + 1e-3, rtol=0, atol=1e-14)
    assert_close(moved.told.noise(setting.scales), data.told.noise(setting.scales), rtol=0, atol=0)
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
        data.process(scales)
        data.noise(scales)
        part = data.rows(torch.tensor([3, 1]))
        part.process(scales)
        data.with_tails(Tails.none(*data.tails.weights.shape)).process(scales)
        data.sample(5, 900, 0)[1].process(scales)
    assert count == dict.fromkeys(ONCE, len(data.x))


def test_rows_before_the_whole_is_needed_linearise_these_rows_only() -> None:
    data, count = counting(built("two markers"))
    some = data.rows(torch.tensor([3, 1]))
    assert not count
    some.process(built("two markers").scales)
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


# --- what is kept ---------------------------------------------------------------------------------------------------


def test_what_is_kept_is_that_of_its_scales_and_weights(setting: Setting) -> None:
    """Whatever was asked for before: other scales, other weights, other measurements, fewer rows."""
    first, second = shaken(setting.scales, 1), shaken(setting.scales, 2)
    kept, other = setting.tangent_data.with_tails(setting.tangent_data.tails), weighted(setting, 3)
    kept.process(first)
    some = kept.rows(torch.arange(3))
    orders = [(kept.with_tails(other.tails), first), (kept, second), (kept, first), (some, first)]
    for data, scales in [*orders, (replace(kept, y=kept.y + 1e-3), first)]:
        assert_close(data.process(scales).mu, replace(data).process(scales).mu, rtol=1e-9, atol=0)


def test_what_few_rows_say_is_computed_once(setting: Setting, monkeypatch: pytest.MonkeyPatch) -> None:
    scales, data = setting.scales, replace(setting.tangent_data)
    assert data.process(scales) is data.process(scales)
    assert data.with_tails(weighted(setting).tails).expected(scales) is data.expected(scales)
    assert data.process(scales.inflated(1.0)) is not data.process(scales)
    monkeypatch.setattr(tangent_data, "KEPT_COORDINATES", 1)
    many = replace(data)
    assert many.process(scales) is not many.process(scales)


def test_a_sample_of_all_rows_is_the_data_themselves(setting: Setting) -> None:
    data = setting.tangent_data
    rows, some = data.sample(len(data.x), data.y.numel(), 0)
    assert rows.tolist() == list(range(len(data.x)))
    assert some is data
