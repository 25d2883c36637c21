"""Scales of kernels and noise: the likelihood against formulas written a second time, and a search that is safe."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from product_bank import Case, noise_blocks, prior_covariance, sliding_measurements, sliding_robot
from scipy.stats import multivariate_normal
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration import calibrate as calibration
from diffeo_calib.calibration.hyperparameters import BOUND, PRIOR_WIDTH, Selection, _Search, defaults, select
from diffeo_calib.calibration.result import silent
from diffeo_calib.nominal import GeometryMap
from diffeo_calib.robots.identification import Identification
from diffeo_calib.robots.simulated_arm import SimulatedArm
from diffeo_calib.spaces import Space


class Setting:
    """Measurements after the geometric calibration: everything that `select` starts from."""

    def __init__(self, robot: dc.Chain, data: dc.Measurements) -> None:
        self.data, self.space = data, Space(robot.periodic)
        registration = calibration.register(robot, data.q, data.points)
        self.identification: Identification = calibration.identify(registration.geometry, data.q, data.points)
        self.nominal = GeometryMap(self.identification.geometry)
        noise = self.identification.noise
        self.scales = defaults(self.nominal, data.q, data.points.flatten(1), noise, self.space)
        self.problem = calibration._problem(self.nominal, data, self.scales)

    def search(self) -> _Search:
        return _Search(self.problem, self.space, self.scales, 0, silent)

    def select(self, **options: Any) -> Selection:
        return select(self.scales, self.problem, self.space, **options)


@pytest.fixture(scope="module")
def two_markers() -> Setting:
    arm = SimulatedArm(seed=3, markers=2)
    return Setting(arm.nominal, dc.Measurements(*arm.measure(14, seed=4)))


@pytest.fixture(scope="module")
def sliding() -> Setting:
    return Setting(sliding_robot(), sliding_measurements(sliding_robot(), 25))


def shaken(scales: dc.Hyperparameters, seed: int, size: float = 0.5) -> dc.Hyperparameters:
    vector = scales.logarithms()
    return scales.from_logarithms(
        vector + size * torch.from_numpy(np.random.default_rng(seed).normal(size=len(vector)))
    )


# --- the likelihood -----------------------------------------------------------------------------------------------


def test_logarithms_round_trip(two_markers: Setting) -> None:
    scales = shaken(two_markers.scales, 0)
    vector = scales.logarithms()
    assert vector.shape == (5 * 6 + 3,)
    again = scales.from_logarithms(vector)
    for field in fields(scales):
        assert_close(getattr(again, field.name), getattr(scales, field.name), rtol=1e-14, atol=0)


@pytest.mark.parametrize("name", ["two_markers", "sliding"])
@pytest.mark.parametrize("seed", [0, 1])
def test_likelihood_is_that_of_the_covariance_written_out(name: str, seed: int, request: pytest.FixtureRequest) -> None:
    setting: Setting = request.getfixturevalue(name)
    scales = shaken(setting.scales, seed)
    geometry, data = setting.identification.geometry, setting.data
    deviations = calibration.REFINE_PRIOR.deviations(geometry)
    total = prior_covariance(scales, geometry, deviations, data.q, data.q)
    total += torch.block_diag(*noise_blocks(scales, geometry, data.q))
    residual = (data.points - geometry.points(data.q)).flatten()
    expected = multivariate_normal(np.zeros(len(residual)), total.numpy()).logpdf(residual.numpy())
    moved = (scales.logarithms() - setting.scales.logarithms()) / PRIOR_WIDTH
    value, _ = setting.search()._objective(scales.logarithms().numpy())
    assert -value == pytest.approx(float(expected) - 0.5 * float(moved.square().sum()), rel=1e-8)


@pytest.mark.parametrize("name", ["two_markers", "sliding"])
def test_likelihood_gradient_against_central_differences(name: str, request: pytest.FixtureRequest) -> None:
    setting: Setting = request.getfixturevalue(name)
    search, point, h = setting.search(), shaken(setting.scales, 2).logarithms().numpy(), 1e-4
    _, gradient = search._objective(point)
    steps = h * np.eye(len(point))
    slopes = [(search._objective(point + step)[0] - search._objective(point - step)[0]) / (2 * h) for step in steps]
    np.testing.assert_allclose(gradient, slopes, rtol=1e-5, atol=1e-5 * np.abs(gradient).max())


# --- defaults -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["two_markers", "sliding"])
def test_defaults_are_usable_scales(name: str, request: pytest.FixtureRequest) -> None:
    setting: Setting = request.getfixturevalue(name)
    vector = setting.scales.logarithms()
    assert bool(torch.isfinite(vector).all())
    noise, lever = setting.identification.noise, 2.0
    assert noise / lever < 10 * float(setting.scales.transmission_amplitude.max())
    assert float(setting.scales.sensor_noise) < noise


def test_a_slide_is_measured_by_its_stroke(sliding: Setting) -> None:
    slide = 2
    scales, stroke = sliding.scales, float(sliding.data.q[:, slide].max() - sliding.data.q[:, slide].min())
    assert float(scales.coupled_lengthscale[slide]) == pytest.approx(stroke / 2)
    circles = [0, 1, 3, 4, 5]
    assert_close(scales.coupled_lengthscale[circles], torch.ones(5, dtype=torch.float64))
    assert not scales.joint_kernel(sliding.space).terms[slide].periodic[slide]  # pyright: ignore[reportAttributeAccessIssue]


def test_the_unit_of_the_whole_world_does_not_matter(sliding: Setting) -> None:
    """The same robot ten times as large: lengths of the scales grow tenfold, angles stay."""
    data, big = sliding.data, torch.tensor([1, 1, 10.0, 1, 1, 1], dtype=torch.float64)
    y, noise = data.points.flatten(1), sliding.identification.noise

    class Grown(GeometryMap):
        def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
            return 10.0 * super().jacobian(x / big, theta) / big

    grown = defaults(Grown(sliding.nominal.geometry), data.q * big, 10 * y, 10 * noise, sliding.space)
    turning = torch.tensor(sliding.space.periodic)
    assert_close(grown.coupled_lengthscale, sliding.scales.coupled_lengthscale * big)
    assert_close(grown.task_lengthscale, 10 * sliding.scales.task_lengthscale)
    assert_close(grown.sensor_noise, 10 * sliding.scales.sensor_noise)
    assert_close(grown.task_amplitude, 10 * sliding.scales.task_amplitude)
    assert bool((grown.joint_noise[turning] > 0).all())


def test_a_joint_without_motion_or_lever_has_finite_scales(sliding: Setting) -> None:
    q = sliding.data.q.clone()
    q[:, 2] = 0.3
    data = dc.Measurements(q, sliding.nominal.geometry.points(q) + 1e-4 * torch.sin(100 * q.sum(1))[:, None, None])
    scales = defaults(sliding.nominal, data.q, data.points.flatten(1), 1e-4, sliding.space)
    assert bool(torch.isfinite(scales.logarithms()).all())
    levers = sliding.nominal.jacobian(data.q, torch.zeros(sliding.nominal.parameters, dtype=torch.float64))
    levers[..., 5] = 0.0  # no lever at all

    class Blind(GeometryMap):
        def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
            return levers

    scales = defaults(Blind(sliding.nominal.geometry), data.q, data.points.flatten(1), 1e-4, sliding.space)
    amplitude = scales.transmission_amplitude
    assert float(amplitude[5]) <= 3.01 * float(amplitude.min())


# --- the search ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["two_markers", "sliding"])
def test_select_is_never_worse_than_the_default(name: str, request: pytest.FixtureRequest) -> None:
    setting: Setting = request.getfixturevalue(name)
    selection = setting.select()
    start = setting.search()._objective(setting.scales.logarithms().numpy())[0]
    found = setting.search()._objective(selection.scales.logarithms().numpy())[0]
    assert found < start - 1.0
    moved = selection.scales.logarithms() - setting.scales.logarithms()
    prior = -0.5 * float((moved / PRIOR_WIDTH).square().sum())  # the search adds it; the report is about the data alone
    assert f"likelihood {-found - prior:.1f} on {len(setting.data)} poses" in selection.status
    assert float(moved.abs().max()) <= BOUND + 1e-9


def test_select_on_pure_noise_is_not_worse_either() -> None:
    arm = SimulatedArm(seed=5, geometry=0, transmission=0, gravity=0)
    setting = Setting(arm.nominal, dc.Measurements(*arm.measure(30)))
    selection = setting.select()
    start = setting.search()._objective(setting.scales.logarithms().numpy())[0]
    assert setting.search()._objective(selection.scales.logarithms().numpy())[0] <= start
    noise = float(selection.scales.noise_covariance(setting.search().jacobian).diagonal(dim1=1, dim2=2).mean().sqrt())
    assert noise == pytest.approx(arm.noise, rel=0.4)


def test_many_poses_are_drawn_from_by_the_seed() -> None:
    arm = SimulatedArm(seed=6)
    setting = Setting(arm.nominal, dc.Measurements(*arm.measure(200)))
    first, same, other = (
        _Search(setting.problem, setting.space, setting.scales, seed, silent).linearisation.joint[0].points
        for seed in (0, 0, 1)
    )
    assert first.shape == (150, 6)
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


def test_interrupted_at_once_keeps_the_start(two_markers: Setting) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    selection = two_markers.select(progress=stop)
    assert selection.interrupted
    assert "interrupted" in selection.status
    assert torch.equal(selection.scales.logarithms(), two_markers.scales.logarithms())


@pytest.mark.parametrize("every", [1, 2, 3])
def test_a_failed_factorisation_is_a_rejected_step(
    every: int, two_markers: Setting, monkeypatch: pytest.MonkeyPatch
) -> None:
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

    with monkeypatch.context() as patch:
        patch.setattr(torch.linalg, "cholesky_ex", fails)
        selection = two_markers.select()
    assert calls["failed"] > 0
    assert bool(torch.isfinite(selection.scales.logarithms()).all())
    start = two_markers.search()._objective(two_markers.scales.logarithms().numpy())[0]
    assert two_markers.search()._objective(selection.scales.logarithms().numpy())[0] <= start


def test_a_matrix_that_cannot_be_factorised_is_no_point_of_the_search(two_markers: Setting) -> None:
    search = two_markers.search()
    # no noise to speak of and an amplitude of e^25 defaults: G + R is singular in float64
    mute = replace(
        two_markers.scales,
        sensor_noise=two_markers.scales.sensor_noise * 1e-9,
        joint_noise=two_markers.scales.joint_noise * 1e-9,
        task_amplitude=two_markers.scales.task_amplitude * math.exp(25),
        task_lengthscale=two_markers.scales.task_lengthscale * 1e4,
    )
    value, gradient = search._objective(mute.logarithms().numpy())
    assert value == 1e12
    assert not gradient.any()
    assert search.best is two_markers.scales


def test_noise_blocks_that_cannot_be_factorised_are_a_rejected_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("diffeo_calib.calibration.hyperparameters.FINEST_NOISE", 0.0)
    arm = SimulatedArm(seed=1, markers=3)
    setting = Setting(arm.nominal, dc.Measurements(*arm.measure(12, seed=2)))
    edge = replace(  # both at the bounds of the search
        setting.scales,
        sensor_noise=setting.scales.sensor_noise * math.exp(-BOUND),
        joint_noise=setting.scales.joint_noise * math.exp(BOUND),
    )
    value, _ = setting.search()._objective(edge.logarithms().numpy())
    assert value == 1e12


def test_repeatability_of_the_joints_is_told_from_signal() -> None:
    """Joints that do not repeat, a perfect tracker: s must be found, and nothing may be learnt from it."""
    arm = SimulatedArm(seed=8, geometry=0, transmission=0, gravity=0, noise=0)
    q = arm.sample(330, seed=1)
    shaky = q + 1e-4 * torch.randn(q.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    points = arm.true_points(shaky) + 1e-6 * torch.randn(
        330, 1, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )
    train, test = dc.Measurements(q[:30], points[:30]), dc.Measurements(q[30:], points[30:])
    result = dc.calibrate(arm.nominal, train)
    case = Case(arm.nominal, train, test, result)
    _, geometry, diffeomorphic = case.held_out()
    assert diffeomorphic < 1.1 * geometry
    scales, nominal = result.selection.scales, result.identification.geometry
    seen = noise_blocks(scales, nominal, test.q).diagonal(dim1=1, dim2=2).sum(1).mean().sqrt()
    assert float(seen) > 0.5 * float((test.points - arm.true_points(test.q)).norm(dim=-1).square().mean().sqrt())
    assert float(scales.joint_noise.max()) > 3e-5
