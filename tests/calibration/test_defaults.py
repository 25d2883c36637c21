"""Default scales: of the size of the geometric residual, for robots of any kind and unit."""

from __future__ import annotations

from dataclasses import replace

import torch
from tangent_bank import Setting, built, gravity_covariance, normal
from torch import Tensor
from torch.testing import assert_close

from diffeo_calib.calibration.scales.selection import LARGEST_AMPLITUDE_RATIO, SMALLEST_LOAD_RATIO, defaults
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.robots import Chain, Geometry, Joint


def test_defaults_are_usable_scales(setting: Setting) -> None:
    scales, noise = setting.scales, setting.identification.noise
    assert bool(torch.isfinite(scales.logarithms()).all())
    assert float(scales.sensor_noise) < noise
    assert noise / 2.0 < 10 * float(scales.transmission_amplitude.max())
    ratio = float(scales.transmission_amplitude.max() / scales.transmission_amplitude.min())
    assert ratio <= LARGEST_AMPLITUDE_RATIO * 1.001
    assert float(scales.translation_errors) == setting.identification.prior.translation
    assert float(scales.rotation_errors) == setting.identification.prior.rotation
    assert torch.equal(scales.gravity, torch.ones(3, dtype=torch.float64))
    moving = setting.nominal.geometry.chain.moving
    assert scales.compliance.shape == scales.lateral_compliance.shape == (moving,)


def test_every_part_moves_the_markers_by_less_than_the_residual_at_first(setting: Setting) -> None:
    """The defaults of gravity: the sag of one joint has the size of the geometric residual."""
    scales, data, noise = setting.scales, setting.tangent_data, setting.identification.noise
    nominal = data.nominal
    for joint in range(nominal.geometry.chain.moving):
        off = torch.zeros_like(scales.compliance)
        for name, share in (("compliance", 0.3), ("lateral_compliance", 0.1)):
            alone = off.clone()
            alone[joint] = getattr(scales, name)[joint]
            other = {"compliance": off, "lateral_compliance": off} | {name: alone}
            covariance = gravity_covariance(replace(scales, **other), nominal, data.theta, data.x)
            assert float(covariance.diagonal().mean().sqrt()) <= 1.001 * share * noise
    total = gravity_covariance(scales, nominal, data.theta, data.x)
    assert float(total.diagonal().mean().sqrt()) > 0.3 * noise


def test_joints_without_load_are_not_granted_any_compliance(setting: Setting) -> None:
    """The last joint turns about the tip: it has next to no features, and nothing may be divided by them."""
    for name in ("compliance", "lateral_compliance"):
        values = getattr(setting.scales, name)
        assert float(values.max() / values.min()) <= 1.001 / SMALLEST_LOAD_RATIO


def test_a_slide_is_measured_by_its_stroke() -> None:
    setting, slide = built("sliding"), 2
    scales, q = setting.scales, setting.data.q
    stroke = float(q[:, slide].max() - q[:, slide].min())
    assert_close(float(scales.coupled_lengthscale[slide]), stroke / 2)
    circles = [0, 1, 3, 4, 5]
    assert_close(scales.coupled_lengthscale[circles], torch.ones(5, dtype=torch.float64))
    kernel = scales.joint_kernel(setting.tangent_data.space)
    assert not kernel.terms[slide].periodic[slide]  # pyright: ignore[reportAttributeAccessIssue]


def test_a_slide_that_stands_still_has_a_long_kernel() -> None:
    """A field as large as the noise does not fold a kernel of many times its length."""
    setting, slide = built("sliding"), 2
    x = setting.tangent_data.x.clone()
    x[:, slide] = x[0, slide]
    for noise in (1e-3, 1e-2):
        scales = defaults(replace(setting.tangent_data, x=x), noise, setting.identification.prior)
        assert_close(float(scales.coupled_lengthscale[slide]), 50 * noise)


def test_the_unit_of_length_does_not_matter() -> None:
    """The same robot ten times as large: lengths of the scales grow tenfold, angles stay."""
    setting = built("sliding")
    data, big = setting.tangent_data, torch.tensor([1, 1, 10.0, 1, 1, 1], dtype=torch.float64)
    noise, prior = setting.identification.noise, setting.identification.prior

    class Grown(GeometryMap):
        def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
            return 10.0 * super().__call__(x / big, theta)

        def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
            return 10.0 * super().jacobian(x / big, theta) / big

    geometry = setting.nominal.geometry
    large = replace(data, nominal=Grown(geometry), theta=data.theta[: geometry.size], x=data.x * big)
    grown = defaults(large, 10 * noise, prior)
    assert_close(grown.coupled_lengthscale, setting.scales.coupled_lengthscale * big)
    assert_close(grown.transmission_lengthscale, setting.scales.transmission_lengthscale * big)
    assert_close(grown.task_lengthscale, 10 * setting.scales.task_lengthscale)
    assert_close(grown.sensor_noise, 10 * setting.scales.sensor_noise)
    assert_close(grown.rotation_noise, setting.scales.rotation_noise)
    assert_close(grown.task_amplitude, 10 * setting.scales.task_amplitude)
    assert bool((grown.joint_noise > 0).all())


def test_a_joint_without_motion_or_lever_has_finite_scales() -> None:
    setting = built("sliding")
    data, x, prior = setting.tangent_data, setting.data.q.clone(), setting.identification.prior
    x[:, 2] = 0.3
    scales = defaults(replace(data, x=x), 1e-4, prior)
    assert bool(torch.isfinite(scales.logarithms()).all())
    levers = data.nominal.jacobian(x, data.theta)
    levers[..., 5] = 0.0  # no lever at all

    class Blind(GeometryMap):
        def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
            return levers

    blind = replace(data, nominal=Blind(setting.nominal.geometry, elastic=True), x=x)
    amplitude = defaults(blind, 1e-4, prior).transmission_amplitude
    assert float(amplitude[5]) <= 3.01 * float(amplitude.min())


def test_a_robot_that_cannot_bend_has_finite_scales() -> None:
    """Without gravity sag, and with one that has no features: all axes meet at the tip."""
    origin = torch.eye(4, dtype=torch.float64)
    joints = [
        Joint("a", "revolute", origin),
        Joint("b", "revolute", origin, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)),
    ]
    arm = Chain("ball", "floor", "hand", joints)
    geometry = replace(Geometry.nominal(arm), tool=torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64))
    setting = built("sliding")
    for elastic in (False, True):
        nominal = GeometryMap(geometry, elastic=elastic)
        theta = torch.zeros(nominal.parameters, dtype=torch.float64)
        data = replace(setting.tangent_data, nominal=nominal, theta=theta, x=normal(10, 2, seed=1))
        scales = defaults(data, 1e-4, setting.identification.prior)
        assert bool(torch.isfinite(scales.logarithms()).all())
        assert scales.prior_variance(nominal).shape == (nominal.parameters,)
