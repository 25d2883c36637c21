"""The search for scales: better than its starts, repeatable, safe to interrupt, and right about known robots."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from product_bank import Case, noise_blocks
from tangent_bank import Setting, built, gravity_covariance, normal, shaken
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.calibration.scales.selection import (
    SEARCH_LIMITS,
    TRANSMISSION_STARTS_RAD,
    SearchLimits,
    Selection,
    log_posterior,
    select,
)
from diffeo_calib.robots import SimulatedArm


def brief(iterations: int = 5, **others: int) -> SearchLimits:
    """A search with ``iterations`` iterations from every start."""
    each = dict.fromkeys(("iterations", "first", "fewest_first", "most_first"), iterations)
    return SearchLimits(**each | others)


def value(setting: Setting, scales: dc.Hyperparameters) -> float:
    """Log posterior, up to a constant."""
    found = log_posterior(scales.logarithms(), setting.scales, setting.tangent_data)
    assert found is not None
    return found.likelihood + found.prior


def interrupting(calls: int) -> Callable[..., None]:
    """A progress callback that behaves as if Ctrl-C came before this evaluation, counted from one."""
    seen = [0]

    def progress(*_: object) -> None:
        seen[0] += 1
        if seen[0] == calls:
            raise KeyboardInterrupt

    return progress


# --- the search ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_select_is_better_than_the_default_and_reports_its_likelihood(setting: Setting) -> None:
    selection = select(setting.scales, setting.tangent_data)
    assert value(setting, selection.scales) > value(setting, setting.scales) + 1.0
    found = log_posterior(selection.scales.logarithms(), setting.scales, setting.tangent_data)
    assert found is not None
    assert selection.likelihood == pytest.approx(found.likelihood, rel=1e-9)
    assert f"likelihood {found.likelihood:.1f} on {len(setting.data)} poses" in selection.status
    assert not selection.interrupted
    moved = selection.scales.logarithms() - setting.scales.logarithms()
    assert float(moved.abs().max()) <= SEARCH_LIMITS.log_range + 1e-9


def test_same_seed_same_scales() -> None:
    setting, limits = built("sliding"), brief(poses=15)
    first, same, other = (select(setting.scales, setting.tangent_data, seed=seed, limits=limits) for seed in (0, 0, 1))
    assert torch.equal(first.scales.logarithms(), same.scales.logarithms())
    assert first.status == same.status
    assert "on 15 poses" in first.status
    assert not torch.equal(first.scales.logarithms(), other.scales.logarithms())


def test_a_given_start_is_where_the_search_begins() -> None:
    """After a single evaluation the best scales are the start."""
    setting = built("mimic joint")
    start = shaken(setting.scales, 4)
    begun = select(setting.scales, setting.tangent_data, start=start, progress=interrupting(2))
    torch.testing.assert_close(begun.scales.logarithms(), start.logarithms(), rtol=1e-12, atol=1e-12)
    climbed = select(setting.scales, setting.tangent_data, start=start, limits=brief(1))
    assert value(setting, climbed.scales) > value(setting, start)


def test_without_a_start_there_is_one_for_every_length_scale_of_the_transmissions() -> None:
    setting, began = built("mimic joint"), []

    def progress(_: str, done: int, total: int) -> None:
        began.extend([total] * (done in (1, len(TRANSMISSION_STARTS_RAD) + 1)))  # two iterations each

    selection = select(setting.scales, setting.tangent_data, limits=brief(2), progress=progress)
    assert began == [4, 4]
    for lengthscale in TRANSMISSION_STARTS_RAD:
        other = setting.scales.transmission_lengthscale * lengthscale / TRANSMISSION_STARTS_RAD[0]
        start = replace(setting.scales, transmission_lengthscale=other)
        assert value(setting, selection.scales) > value(setting, start)
    began.clear()
    select(setting.scales, setting.tangent_data, start=setting.scales, limits=brief(2), progress=progress)
    assert began == [2]


def test_progress_counts_up_to_the_total() -> None:
    seen: list[tuple[str, int, int]] = []
    setting = built("mimic joint")
    select(setting.scales, setting.tangent_data, limits=brief(3), progress=lambda *news: seen.append(news))
    assert {task for task, _, _ in seen} == {"hyper-parameters"}
    assert all(1 <= done <= total for _, done, total in seen)


def test_few_measurements_are_searched_longer_than_many() -> None:
    assert [SEARCH_LIMITS.first_iterations(count) for count in (30, 270, 450, 900)] == [60, 55, 20, 15]


# --- Ctrl-C -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [False, True])
def test_interrupted_at_once_keeps_the_defaults_or_a_given_start(given: bool) -> None:
    setting = built("mimic joint")
    start = shaken(setting.scales, 6) if given else None
    selection = select(setting.scales, setting.tangent_data, start=start, progress=interrupting(1))
    assert selection.interrupted
    assert "interrupted" in selection.status
    assert torch.equal(selection.scales.logarithms(), (start or setting.scales).logarithms())


def test_interrupted_later_keeps_the_best_so_far() -> None:
    """The line search overshoots at times; the scales that are kept never get worse."""
    setting, kept = built("two markers"), []
    for calls in range(2, 16):
        selection = select(setting.scales, setting.tangent_data, progress=interrupting(calls))
        assert selection.interrupted
        kept.append(value(setting, selection.scales))
    assert kept == sorted(kept)
    assert kept[-1] > kept[0] + 1.0
    assert len(set(kept)) < len(kept)  # some evaluations were no improvement


# --- failed factorisations ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 2, 3])
def test_a_failed_factorisation_is_a_rejected_step(every: int, monkeypatch: pytest.MonkeyPatch) -> None:
    real, calls = torch.linalg.cholesky_ex, {"all": 0, "failed": 0}

    def fails(matrix: Tensor, **options: Any) -> Any:
        factor, info = real(matrix, **options)
        if matrix.ndim > 2:  # blocks of the noise, not the matrix G + R
            return factor, info
        calls["all"] += 1
        if calls["all"] % every == 0:
            calls["failed"] += 1
            return torch.full_like(factor, math.nan), torch.ones_like(info)
        return factor, info

    setting = built("two markers")
    with monkeypatch.context() as patch:
        patch.setattr(torch.linalg, "cholesky_ex", fails)
        selection = select(setting.scales, setting.tangent_data)
    assert calls["failed"] > 0
    assert bool(torch.isfinite(selection.scales.logarithms()).all())
    assert value(setting, selection.scales) >= value(setting, setting.scales)


# --- results on known robots --------------------------------------------------------------------------------------


def found_in(arm: SimulatedArm, rows: int) -> tuple[Setting, Selection]:
    setting = Setting(arm.nominal, dc.Measurements(*arm.measure(rows, seed=2)))
    return setting, select(setting.scales, setting.tangent_data, limits=brief(15))


def gravity_effect(setting: Setting, scales: dc.Hyperparameters) -> float:
    """Displacement by gravity that is to be expected a priori, m per coordinate."""
    data = setting.tangent_data
    return float(gravity_covariance(scales, data.nominal, data.theta, data.x).diagonal().mean().sqrt())


@pytest.mark.slow
def test_gravity_that_is_not_there_shrinks_and_gravity_that_is_stays() -> None:
    setting, without = found_in(SimulatedArm(seed=2, gravity=0, transmission=0), 60)
    assert gravity_effect(setting, setting.scales) > 0.5 * setting.identification.noise
    assert gravity_effect(setting, without.scales) < 0.3 * setting.identification.noise
    setting, with_it = found_in(SimulatedArm(seed=2, gravity=2.0, transmission=0), 60)
    assert gravity_effect(setting, with_it.scales) > 0.8 * setting.identification.noise


def test_pure_noise_is_called_noise() -> None:
    arm = SimulatedArm(seed=5, geometry=0, transmission=0, gravity=0)
    setting, selection = found_in(arm, 40)
    noise = setting.tangent_data.noise(selection.scales)
    assert float(noise.diagonal(dim1=1, dim2=2).mean().sqrt()) == pytest.approx(arm.noise, rel=0.35)


@pytest.mark.slow
def test_repeatability_of_the_joints_is_distinguished_from_signal() -> None:
    """Joints that do not repeat, a perfect tracker: s must be found, and nothing may be learnt from it."""
    arm = SimulatedArm(seed=8, geometry=0, transmission=0, gravity=0, noise=0)
    q = arm.sample(360, seed=1)
    points = arm.true_points(q + 1e-4 * normal(360, 6, seed=1)) + 1e-6 * normal(360, 1, 3, seed=2)
    train, test = dc.Measurements(q[:60], points[:60]), dc.Measurements(q[60:], points[60:])
    result = dc.calibrate(arm.nominal, train)
    case = Case(arm.nominal, train, test, result)
    _, geometry, diffeomorphic = case.held_out()
    assert diffeomorphic < 1.1 * geometry
    scales, nominal = result.selection.scales, result.identification.geometry
    seen = noise_blocks(scales, nominal, test.q).diagonal(dim1=1, dim2=2).sum(1).mean().sqrt()
    assert float(seen) > 0.5 * float((test.points - arm.true_points(test.q)).norm(dim=-1).square().mean().sqrt())
    assert float(scales.joint_noise.max()) > 3e-5
