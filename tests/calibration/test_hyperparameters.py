"""Scales of kernels, priors and noise: the likelihood against formulas written a second time, and a safe search."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from product_bank import Case, noise_blocks
from scipy.stats import multivariate_normal
from tangent_bank import SETTINGS, Setting, gravity_covariance, noise_covariance, tangent_covariance
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.scales import selection as selection_module
from diffeo_calib.calibration.scales.hyperparameters import (
    AMPLITUDES,
    COMPARABLE,
    NEGLIGIBLE,
    WEAKEST_LOAD,
    defaults,
)
from diffeo_calib.calibration.scales.selection import (
    BOUND,
    GROWTH_WIDTH,
    LENGTH_WIDTH,
    SHRINK_WIDTH,
    Selection,
    _Search,
    log_likelihood,
    select,
)
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.calibration.student_t import Tails
from diffeo_calib.fitting.result import silent
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.robots import Chain, Geometry, Joint, SimulatedArm

_BUILT: dict[str, Setting] = {}


@pytest.fixture(params=list(SETTINGS))
def setting(request: pytest.FixtureRequest) -> Setting:
    return built(request.param)


def built(name: str) -> Setting:
    """Every setting once."""
    if name not in _BUILT:
        _BUILT[name] = SETTINGS[name]()
    return _BUILT[name]


def normal(*shape: int, seed: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape))


def shaken(scales: dc.Hyperparameters, seed: int, size: float = 0.5) -> dc.Hyperparameters:
    vector = scales.logarithms()
    return scales.from_logarithms(vector + size * normal(len(vector), seed=seed))


def search_of(setting: Setting, evidence: TangentData | None = None) -> _Search:
    return _Search(setting.scales, evidence or setting.evidence, silent)


def weighted(setting: Setting, seed: int = 0) -> TangentData:
    """The same measurements, some of them doubted, and a nominal map that deflects."""
    evidence = setting.evidence
    weights = torch.from_numpy(np.random.default_rng(seed).uniform(0.05, 1.5, tuple(evidence.tails.weights.shape)))
    theta = evidence.theta.clone()
    coefficients = slice(evidence.nominal.geometry.size, None)
    theta[coefficients] = 1e-3 * normal(len(theta[coefficients]), seed=seed)
    return replace(evidence, theta=theta, tails=Tails(4.0, weights))


def log_prior(scales: dc.Hyperparameters, centre: dc.Hyperparameters) -> float:
    """Log-normal, entry by entry: amplitudes may grow a little and shrink a lot."""
    total = 0.0
    for field in fields(scales):
        away = (getattr(scales, field.name) / getattr(centre, field.name)).log().flatten().tolist()
        for a in away:
            width = 1.0
            if field.name in AMPLITUDES:
                width = 1.0 if a > 0 else 2.0
            total -= 0.5 * (a / width) ** 2
    return total


def log_density(matrix: Tensor, target: Tensor) -> float:
    """Of a Gaussian with mean 0, by scipy."""
    distribution: Any = multivariate_normal  # scipy's stubs want a number for the covariance
    return float(distribution.logpdf(target.numpy(), np.zeros(len(target)), matrix.numpy()))


# --- the likelihood -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1])
def test_covariance_and_target_are_those_written_out(setting: Setting, seed: int) -> None:
    scales = shaken(setting.scales, seed)
    for evidence in (setting.evidence, weighted(setting, seed)):
        nominal, theta, x = evidence.nominal, evidence.theta, evidence.x
        model = evidence.linearised()
        expected = tangent_covariance(scales, nominal, theta, x)
        scale = float(expected.abs().max())
        assert_close(model.linearisation(scales).gram(), expected, rtol=0, atol=1e-12 * scale)
        noise = noise_covariance(scales, setting, theta, evidence.tails.weights)
        expected += torch.block_diag(*noise)
        assert_close(model.covariance(scales), expected, rtol=0, atol=1e-12 * scale)
        target = evidence.y - nominal(x, theta) + nominal.sensitivities(x, theta) @ theta
        assert_close(model.target, target, rtol=0, atol=1e-14)


def test_noise_is_that_written_out(setting: Setting) -> None:
    """By itself: beside the prior of the base it would not be seen."""
    scales, evidence = shaken(setting.scales, 5), weighted(setting, 5)
    model = evidence.linearised()
    ones = torch.ones_like(evidence.tails.weights)
    for weights, actual in (
        (ones, model.noise(scales)),
        (evidence.tails.weights, evidence.sensor.weighted(model.noise(scales), evidence.tails)),
    ):
        expected = noise_covariance(scales, setting, evidence.theta, weights)
        assert_close(actual, expected, rtol=1e-6, atol=1e-7 * float(expected.abs().max()))


@pytest.mark.parametrize("seed", [2])
def test_objective_is_likelihood_times_prior(setting: Setting, seed: int) -> None:
    scales, evidence = shaken(setting.scales, seed), weighted(setting, seed)
    nominal, theta, x = evidence.nominal, evidence.theta, evidence.x
    total = tangent_covariance(scales, nominal, theta, x)
    total += torch.block_diag(*noise_covariance(scales, setting, theta, evidence.tails.weights))
    target = (evidence.y - nominal(x, theta) + nominal.sensitivities(x, theta) @ theta).flatten()
    expected = log_density(total, target)
    value, _ = search_of(setting, evidence)._objective(scales.logarithms().numpy())
    assert -value == pytest.approx(expected + log_prior(scales, setting.scales), rel=1e-6)


@pytest.mark.slow
def test_objective_gradient_against_central_differences(setting: Setting) -> None:
    search = search_of(setting, weighted(setting).rows(torch.arange(0, len(setting.data), 2)))
    point, h = shaken(setting.scales, 2).logarithms().numpy(), 0.02  # long steps: the prior of the base is wide
    _, gradient = search._objective(point)

    def change(step: np.ndarray) -> float:
        return search._objective(point + step)[0] - search._objective(point - step)[0]

    start = 0
    for field in fields(setting.scales):  # along one direction for every kind of scale
        size = getattr(setting.scales, field.name).numel()
        step = np.zeros_like(point)
        step[start : start + size] = h * normal(size, seed=start).numpy()
        start += size
        expected = (8 * change(step) - change(2 * step)) / 12
        assert float(gradient @ step) == pytest.approx(expected, rel=1e-4, abs=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize("count", [1, 7, 30])
def test_log_likelihood_and_its_slope(count: int) -> None:
    root, target = normal(count, count, seed=1), normal(count, seed=2)
    matrix = root @ root.mT + 0.3 * torch.eye(count, dtype=torch.float64)
    value, slope = log_likelihood(matrix, target)
    assert value == pytest.approx(log_density(matrix, target))
    live = matrix.clone().requires_grad_()
    other = torch.distributions.MultivariateNormal(torch.zeros(count, dtype=torch.float64), live, validate_args=False)
    (expected,) = torch.autograd.grad(other.log_prob(target), live)
    assert slope is not None
    assert_close(slope, (expected + expected.mT) / 2, rtol=1e-9, atol=1e-10)
    away = normal(count, count, seed=3)
    away, h = away + away.mT, 1e-6
    change = (log_likelihood(matrix + h * away, target)[0] - log_likelihood(matrix - h * away, target)[0]) / (2 * h)
    assert float((slope * away).sum()) == pytest.approx(change, rel=1e-6)


def test_likelihood_of_a_matrix_that_is_none() -> None:
    value, slope = log_likelihood(-torch.eye(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64))
    assert value == -math.inf
    assert slope is None


def test_inner_is_the_sum_with_the_whole_matrix(setting: Setting) -> None:
    """And its derivative by the scales is that of the matrix."""
    model = weighted(setting).linearised()
    count = model.target.numel()
    weights = normal(count, count, seed=4)
    point = shaken(setting.scales, 3).logarithms()
    value = float(model.inner(setting.scales.from_logarithms(point), weights))
    matrix = model.covariance(setting.scales.from_logarithms(point))
    size = float((weights * matrix).abs().sum())
    assert value == pytest.approx(float((weights * matrix).sum()), abs=1e-12 * size)
    live, other = point.clone().requires_grad_(), point.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(model.inner(setting.scales.from_logarithms(live), weights), live)
    dense = (weights * model.covariance(setting.scales.from_logarithms(other))).sum()
    (expected,) = torch.autograd.grad(dense, other)
    assert_close(gradient, expected, rtol=1e-9, atol=1e-12 * size)


# --- logarithms, priors, amplitudes -------------------------------------------------------------------------------


def test_logarithms_round_trip(setting: Setting) -> None:
    scales = shaken(setting.scales, 0)
    vector = scales.logarithms()
    n, moving = setting.data.n, setting.nominal.geometry.chain.moving
    assert vector.shape == (5 * n + 6 + 2 * moving + 3,)
    again = scales.from_logarithms(vector)
    for field in fields(scales):
        assert_close(getattr(again, field.name), getattr(scales, field.name), rtol=1e-14, atol=0)


def test_amplitudes_are_marked_where_they_are_in_the_vector(setting: Setting) -> None:
    scales = setting.scales
    moved = {f.name: getattr(scales, f.name) * (2.0 if f.name in AMPLITUDES else 1.0) for f in fields(scales)}
    change = dc.Hyperparameters(**moved).logarithms() - scales.logarithms()
    assert torch.equal(change > 0.1, scales.amplitudes())
    assert "sensor_noise" not in AMPLITUDES


def test_prior_of_amplitudes_lets_them_shrink() -> None:
    """One-sided: the prior alone, from the objective by taking away the likelihood."""
    setting = built("sliding")
    search, centre = search_of(setting), setting.scales.logarithms()
    shrinks = setting.scales.amplitudes()
    assert GROWTH_WIDTH < SHRINK_WIDTH
    for entry in (0, int(shrinks.nonzero()[0]), int(shrinks.nonzero()[-1]), len(centre) - 5):
        for step in (-1.5, 0.7):
            point = centre.clone()
            point[entry] += step
            matrix = search.model.covariance(setting.scales.from_logarithms(point))
            likelihood, _ = log_likelihood(matrix, search.model.target.flatten())
            prior = -search._objective(point.numpy())[0] - likelihood
            width = LENGTH_WIDTH
            if bool(shrinks[entry]):
                width = GROWTH_WIDTH if step > 0 else SHRINK_WIDTH
            assert prior == pytest.approx(-0.5 * (step / width) ** 2, abs=1e-6)


def test_prior_variance_belongs_to_the_right_parameters(setting: Setting) -> None:
    nominal, scales = setting.nominal, shaken(setting.scales, 7)
    assert nominal.elasticity is not None
    deviations = scales.prior_variance(nominal).sqrt()
    names = nominal.geometry.parameter_names
    for name, deviation in zip(names, deviations[: len(names)].tolist(), strict=True):
        if name.startswith(("base ", "marker ")):
            assert deviation == pytest.approx(0.1)
        else:
            turn = name.endswith("[rad]")
            assert deviation == pytest.approx(float(scales.rotation_errors if turn else scales.translation_errors))
    k = len(names)
    for family in nominal.elasticity.compliances:
        for entry in range(family.size):
            size = (scales.compliance if family.own else scales.lateral_compliance)[family.joint]
            assert float(deviations[k]) == pytest.approx(float(size * scales.gravity[entry % 3]))
            k += 1
    assert k == len(deviations)
    rigid = GeometryMap(nominal.geometry)
    assert_close(scales.prior_variance(rigid), deviations[: len(names)] ** 2)


def test_what_data_do_not_support_vanishes(setting: Setting) -> None:
    """Fields whose displacement is far below the noise are zero exactly; all else stays."""
    scales, model = setting.scales, setting.evidence.linearised()
    noise = model.noise(scales)
    level = NEGLIGIBLE * float(noise.diagonal(dim1=1, dim2=2).mean().sqrt())
    lever = model.jacobian.square().mean((0, 1)).sqrt()
    assert scales.supported(model.jacobian, noise).logarithms().isfinite().all()
    last = scales.transmission_amplitude.clone()
    last[-1] = 0.99 * level / lever[-1]
    first = scales.coupled_amplitude.clone()
    first[0] = 0.99 * level / lever[0]
    first[1] = 1.01 * level / lever[1]
    weak = replace(
        scales,
        transmission_amplitude=last,
        coupled_amplitude=first,
        task_amplitude=torch.tensor(0.99 * level, dtype=torch.float64),
    )
    found = weak.supported(model.jacobian, noise)
    assert found.transmission_amplitude.tolist() == [*scales.transmission_amplitude[:-1].tolist(), 0.0]
    assert found.coupled_amplitude.tolist() == [0.0, *first[1:].tolist()]
    assert float(found.task_amplitude) == 0.0
    for name in {f.name for f in fields(scales)} - {"transmission_amplitude", "coupled_amplitude", "task_amplitude"}:
        assert torch.equal(getattr(found, name), getattr(scales, name))
    before, after = model.linearisation(weak).gram(), model.linearisation(found).gram()
    change = (before - after).diagonal().clamp(min=0).mean().sqrt()
    assert float(change) < 3 * level


# --- defaults -----------------------------------------------------------------------------------------------------


def test_defaults_are_usable_scales(setting: Setting) -> None:
    scales, noise = setting.scales, setting.identification.noise
    assert bool(torch.isfinite(scales.logarithms()).all())
    assert float(scales.sensor_noise) < noise
    assert noise / 2.0 < 10 * float(scales.transmission_amplitude.max())
    assert float(scales.transmission_amplitude.max()) <= COMPARABLE * 1.001 * float(scales.transmission_amplitude.min())
    assert float(scales.translation_errors) == setting.identification.prior.translation
    assert float(scales.rotation_errors) == setting.identification.prior.rotation
    assert torch.equal(scales.gravity, torch.ones(3, dtype=torch.float64))
    moving = setting.nominal.geometry.chain.moving
    assert scales.compliance.shape == scales.lateral_compliance.shape == (moving,)


def test_every_part_moves_the_markers_by_less_than_the_residual_at_first(setting: Setting) -> None:
    """The defaults of gravity: a joint's deflection of the size of what geometry left over."""
    scales, evidence, noise = setting.scales, setting.evidence, setting.identification.noise
    nominal = evidence.nominal
    for joint in range(nominal.geometry.chain.moving):
        off = torch.zeros_like(scales.compliance)
        for name, share in (("compliance", 0.3), ("lateral_compliance", 0.1)):
            alone = off.clone()
            alone[joint] = getattr(scales, name)[joint]
            other = {"compliance": off, "lateral_compliance": off} | {name: alone}
            covariance = gravity_covariance(replace(scales, **other), nominal, evidence.theta, evidence.x)
            assert float(covariance.diagonal().mean().sqrt()) <= 1.001 * share * noise
    total = gravity_covariance(scales, nominal, evidence.theta, evidence.x)
    assert float(total.diagonal().mean().sqrt()) > 0.3 * noise


def test_joints_without_load_are_not_granted_any_compliance(setting: Setting) -> None:
    """The last joint turns about the tip: next to no features, which nothing may be divided by."""
    for name in ("compliance", "lateral_compliance"):
        values = getattr(setting.scales, name)
        assert float(values.max() / values.min()) <= 1.001 / WEAKEST_LOAD
    assert float(setting.scales.compliance.max() / setting.scales.compliance.min()) > 0.9 / WEAKEST_LOAD


def test_a_slide_is_measured_by_its_stroke() -> None:
    setting, slide = built("sliding"), 2
    scales, q = setting.scales, setting.data.q
    stroke = float(q[:, slide].max() - q[:, slide].min())
    assert float(scales.coupled_lengthscale[slide]) == pytest.approx(stroke / 2)
    circles = [0, 1, 3, 4, 5]
    assert_close(scales.coupled_lengthscale[circles], torch.ones(5, dtype=torch.float64))
    assert not scales.joint_kernel(setting.evidence.space).terms[slide].periodic[slide]  # pyright: ignore[reportAttributeAccessIssue]


def test_the_unit_of_the_whole_world_does_not_matter() -> None:
    """The same robot ten times as large: lengths of the scales grow tenfold, angles stay."""
    setting = built("sliding")
    data, big = setting.data, torch.tensor([1, 1, 10.0, 1, 1, 1], dtype=torch.float64)
    evidence, noise = setting.evidence, setting.identification.noise

    class Grown(GeometryMap):
        def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
            return 10.0 * super().__call__(x / big, theta)

        def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
            return 10.0 * super().jacobian(x / big, theta) / big

    grown = defaults(
        Grown(setting.nominal.geometry),
        evidence.theta[: setting.nominal.geometry.size],
        data.q * big,
        10 * noise,
        prior=setting.identification.prior,
        space=evidence.space,
    )
    assert_close(grown.coupled_lengthscale, setting.scales.coupled_lengthscale * big)
    assert_close(grown.transmission_lengthscale, setting.scales.transmission_lengthscale * big)
    assert_close(grown.task_lengthscale, 10 * setting.scales.task_lengthscale)
    assert_close(grown.sensor_noise, 10 * setting.scales.sensor_noise)
    assert_close(grown.rotation_noise, setting.scales.rotation_noise)
    assert_close(grown.task_amplitude, 10 * setting.scales.task_amplitude)
    assert bool((grown.joint_noise > 0).all())


def test_a_joint_without_motion_or_lever_has_finite_scales() -> None:
    setting = built("sliding")
    evidence, q = setting.evidence, setting.data.q.clone()
    q[:, 2] = 0.3
    options: dict[str, Any] = {"prior": setting.identification.prior, "space": evidence.space}
    scales = defaults(evidence.nominal, evidence.theta, q, 1e-4, **options)
    assert bool(torch.isfinite(scales.logarithms()).all())
    levers = evidence.nominal.jacobian(q, evidence.theta)
    levers[..., 5] = 0.0  # no lever at all

    class Blind(GeometryMap):
        def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
            return levers

    blind = Blind(setting.nominal.geometry, elastic=True)
    amplitude = defaults(blind, evidence.theta, q, 1e-4, **options).transmission_amplitude
    assert float(amplitude[5]) <= 3.01 * float(amplitude.min())


def test_a_robot_that_cannot_bend_has_finite_scales() -> None:
    """Without elasticity, and with one that has no features: all axes meet at the tip."""
    joints = [
        Joint("a", "revolute", torch.eye(4)),
        Joint("b", "revolute", torch.eye(4), torch.tensor([1.0, 0.0, 0.0])),
    ]
    arm = Chain("ball", "floor", "hand", joints)
    geometry = replace(Geometry.nominal(arm), tool=torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64))
    q, setting = normal(10, 2, seed=1), built("sliding")
    for elastic in (False, True):
        nominal = GeometryMap(geometry, elastic=elastic)
        theta = torch.zeros(nominal.parameters, dtype=torch.float64)
        space = replace(setting.evidence, nominal=nominal).space
        scales = defaults(nominal, theta, q, 1e-4, prior=setting.identification.prior, space=space)
        assert bool(torch.isfinite(scales.logarithms()).all())
        assert scales.prior_variance(nominal).shape == (nominal.parameters,)


# --- which measurements are looked at -----------------------------------------------------------------------------


def test_rows_of_the_evidence_are_those_of_the_model(setting: Setting) -> None:
    evidence, rows = weighted(setting), torch.tensor([5, 0, 7])
    some, m = evidence.rows(rows), evidence.y.shape[1]
    index = (rows[:, None] * m + torch.arange(m)).flatten()
    whole = evidence.linearised().covariance(setting.scales)
    part = some.linearised().covariance(setting.scales)
    assert_close(part, whole[index][:, index], rtol=0, atol=1e-13 * float(whole.abs().max()))
    assert_close(some.linearised().target, evidence.linearised().target[rows], rtol=0, atol=1e-14)


def test_many_poses_are_drawn_from_by_the_seed() -> None:
    arm = SimulatedArm(seed=6)
    setting = Setting(arm.nominal, dc.Measurements(*arm.measure(200)))
    first, same, other = (setting.evidence.sample(150, 900, seed)[1].x for seed in (0, 0, 1))
    assert first.shape == (150, 6)
    assert len(torch.unique(first, dim=0)) == 150
    assert torch.equal(first, same)
    assert not torch.equal(first, other)
    assert len(setting.evidence.sample(150, 90, 0)[1].x) == 30
    assert len(setting.evidence.sample(150, 1, 0)[1].x) == 1
    assert torch.equal(setting.evidence.sample(500, 900000, 3)[1].x, setting.evidence.x)


# --- the search ---------------------------------------------------------------------------------------------------


def brief(monkeypatch: pytest.MonkeyPatch, iterations: int = 5) -> None:
    monkeypatch.setattr(selection_module, "FIRST_ITERATIONS", (iterations, iterations))
    monkeypatch.setattr(selection_module, "ITERATIONS", iterations)


def objective(setting: Setting, scales: dc.Hyperparameters) -> float:
    return search_of(setting)._objective(scales.logarithms().numpy())[0]


@pytest.mark.slow
def test_select_is_better_than_the_default_and_says_by_how_much(setting: Setting) -> None:
    selection = select(setting.scales, setting.evidence)
    start, found = objective(setting, setting.scales), objective(setting, selection.scales)
    assert found < start - 1.0
    likelihood = -found - log_prior(selection.scales, setting.scales)
    assert f"likelihood {likelihood:.1f} on {len(setting.data)} poses" in selection.status
    assert not selection.interrupted
    moved = selection.scales.logarithms() - setting.scales.logarithms()
    assert float(moved.abs().max()) <= BOUND + 1e-9


def test_same_seed_same_scales(monkeypatch: pytest.MonkeyPatch) -> None:
    brief(monkeypatch)
    monkeypatch.setattr(selection_module, "SUBSET_POSES", 15)
    setting = built("sliding")
    first, same, other = (select(setting.scales, setting.evidence, seed=seed) for seed in (0, 0, 1))
    assert torch.equal(first.scales.logarithms(), same.scales.logarithms())
    assert first.status == same.status
    assert "on 15 poses" in first.status
    assert not torch.equal(first.scales.logarithms(), other.scales.logarithms())


def test_a_given_start_is_where_the_climb_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """And the only one; without it there is one start for every length scale of the transmissions."""
    brief(monkeypatch, 1)
    setting, seen = built("passive"), []
    real = _Search.climb
    monkeypatch.setattr(_Search, "climb", lambda self, at, count: (seen.append(at), real(self, at, count)))
    start = shaken(setting.scales, 4)
    climbed = select(setting.scales, setting.evidence, start=start)
    assert len(seen) == 1
    assert seen[0] is start
    assert objective(setting, climbed.scales) <= objective(setting, start)
    select(setting.scales, setting.evidence)
    factors = [float((at.transmission_lengthscale / setting.scales.transmission_lengthscale)[0]) for at in seen[1:]]
    assert factors == pytest.approx([1.0, 0.7 / 0.22])


def test_progress_counts_up_to_the_total(monkeypatch: pytest.MonkeyPatch) -> None:
    brief(monkeypatch, 3)
    seen: list[tuple[str, int, int]] = []
    setting = built("passive")
    select(setting.scales, setting.evidence, progress=lambda *news: seen.append(news))
    assert {task for task, _, _ in seen} == {"hyper-parameters"}
    assert all(1 <= done <= total for _, done, total in seen)


def test_interrupted_at_once_keeps_the_start() -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    setting = built("two markers")
    selection = select(setting.scales, setting.evidence, progress=stop)
    assert selection.interrupted
    assert "interrupted" in selection.status
    assert torch.equal(selection.scales.logarithms(), setting.scales.logarithms())


def test_interrupted_at_once_keeps_a_given_start() -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    setting = built("passive")
    start = shaken(setting.scales, 6)
    selection = select(setting.scales, setting.evidence, start=start, progress=stop)
    assert selection.interrupted
    assert selection.scales is start


def test_few_measurements_are_climbed_longer_than_many() -> None:
    search = search_of(built("passive"))
    counts = []
    for coordinates in (30, 270, 450, 900):
        search.model = replace(search.model, target=torch.zeros(coordinates // 3, 3, dtype=torch.float64))
        counts.append(search.first_iterations)
    assert counts == [60, 55, 20, 15]


@pytest.mark.parametrize("calls", [4, 30])
def test_interrupted_later_keeps_the_best_so_far(calls: int, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[float] = []
    real = _Search._objective

    def watched(self: _Search, vector: np.ndarray) -> tuple[float, np.ndarray]:
        if len(seen) == calls:
            raise KeyboardInterrupt
        value = real(self, vector)
        seen.append(value[0])
        return value

    setting = built("two markers")
    with monkeypatch.context() as patch:
        patch.setattr(_Search, "_objective", watched)
        selection = select(setting.scales, setting.evidence)
    assert selection.interrupted
    assert objective(setting, selection.scales) == pytest.approx(min(seen), rel=1e-12)
    assert min(seen) < seen[0]


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
        selection = select(setting.scales, setting.evidence)
    assert calls["failed"] > 0
    assert bool(torch.isfinite(selection.scales.logarithms()).all())
    assert objective(setting, selection.scales) <= objective(setting, setting.scales)


def test_a_matrix_that_cannot_be_factorised_is_no_point_of_the_search() -> None:
    setting = built("two markers")
    search, scales = search_of(setting), setting.scales
    # no noise to speak of and an amplitude of e^25 defaults: G + R is singular in float64
    mute = replace(
        scales,
        sensor_noise=scales.sensor_noise * 1e-9,
        joint_noise=scales.joint_noise * 1e-9,
        task_amplitude=scales.task_amplitude * math.exp(25),
        task_lengthscale=scales.task_lengthscale * 1e4,
    )
    value, gradient = search._objective(mute.logarithms().numpy())
    assert value == 1e12
    assert not gradient.any()
    assert search.best is scales


def test_noise_blocks_that_cannot_be_factorised_are_a_rejected_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("diffeo_calib.calibration.scales.sensor.FINEST_NOISE", 0.0)
    arm = SimulatedArm(seed=1, markers=3)
    setting = Setting(arm.nominal, dc.Measurements(*arm.measure(12, seed=2)))
    edge = replace(  # both at the bounds of the search
        setting.scales,
        sensor_noise=setting.scales.sensor_noise * math.exp(-BOUND),
        joint_noise=setting.scales.joint_noise * math.exp(BOUND),
    )
    value, gradient = search_of(setting)._objective(edge.logarithms().numpy())
    assert value == 1e12
    assert not gradient.any()


# --- what the search finds ----------------------------------------------------------------------------------------


def found_in(arm: SimulatedArm, rows: int) -> tuple[Setting, Selection]:
    setting = Setting(arm.nominal, dc.Measurements(*arm.measure(rows, seed=2)))
    return setting, select(setting.scales, setting.evidence)


def displacement(covariance: Tensor) -> float:
    return float(covariance.diagonal().mean().sqrt())


def gravity_effect(setting: Setting, scales: dc.Hyperparameters) -> float:
    """Displacement by gravity that is to be expected a priori, m per coordinate."""
    evidence = setting.evidence
    return displacement(gravity_covariance(scales, evidence.nominal, evidence.theta, evidence.x))


@pytest.mark.slow
def test_gravity_that_is_not_there_shrinks_and_gravity_that_is_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    brief(monkeypatch, 15)
    setting, without = found_in(SimulatedArm(seed=2, gravity=0, transmission=0), 60)
    assert gravity_effect(setting, setting.scales) > 0.5 * setting.identification.noise
    assert gravity_effect(setting, without.scales) < 0.3 * setting.identification.noise
    setting, with_it = found_in(SimulatedArm(seed=2, gravity=2.0, transmission=0), 60)
    assert gravity_effect(setting, with_it.scales) > 0.8 * setting.identification.noise


def test_pure_noise_is_called_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    brief(monkeypatch, 15)
    arm = SimulatedArm(seed=5, geometry=0, transmission=0, gravity=0)
    setting, selection = found_in(arm, 40)
    noise = setting.evidence.linearised().noise(selection.scales)
    assert float(noise.diagonal(dim1=1, dim2=2).mean().sqrt()) == pytest.approx(arm.noise, rel=0.35)


@pytest.mark.slow
def test_repeatability_of_the_joints_is_told_from_signal() -> None:
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
