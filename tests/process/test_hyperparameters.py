"""Scales of kernels, priors and noise: their logarithms, prior variances, and scales derived from them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tangent_bank import Setting, shaken
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.process.scales import AMPLITUDES, NEGLIGIBLE_DISPLACEMENT, SCALES, GearLine


def test_logarithms_round_trip(setting: Setting) -> None:
    scales = shaken(setting.scales, 0)
    vector = scales.logarithms()
    n, moving = setting.data.n, setting.nominal.geometry.chain.moving
    assert vector.shape == (5 * n + 6 + 2 * moving + 3,)
    again = scales.from_logarithms(vector)
    for name in SCALES:
        assert_close(getattr(again, name), getattr(scales, name), rtol=1e-14, atol=0)


def test_amplitudes_are_marked_where_they_are_in_the_vector(setting: Setting) -> None:
    scales = setting.scales
    moved = {name: getattr(scales, name) * (2.0 if name in AMPLITUDES else 1.0) for name in SCALES}
    change = dc.Hyperparameters(**moved).logarithms() - scales.logarithms()
    assert torch.equal(change > 0.1, scales.amplitudes())
    assert "sensor_noise" not in AMPLITUDES


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


def test_fields_without_support_vanish(setting: Setting) -> None:
    """Fields whose displacement is far below the noise are zero exactly; all other scales stay."""
    scales, data = setting.scales, setting.tangent_data
    noise = data.noise(scales)
    level = NEGLIGIBLE_DISPLACEMENT * float(noise.diagonal(dim1=1, dim2=2).mean().sqrt())
    lever = data.jacobian.square().mean((0, 1)).sqrt()
    assert scales.supported(data.jacobian, noise).logarithms().isfinite().all()
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
    found = weak.supported(data.jacobian, noise)
    assert found.transmission_amplitude.tolist() == [*scales.transmission_amplitude[:-1].tolist(), 0.0]
    assert found.coupled_amplitude.tolist() == [0.0, *first[1:].tolist()]
    assert float(found.task_amplitude) == 0.0
    for name in set(SCALES) - {"transmission_amplitude", "coupled_amplitude", "task_amplitude"}:
        assert torch.equal(getattr(found, name), getattr(scales, name))
    before, after = data.linearisation(weak).gram(), data.linearisation(found).gram()
    change = (before - after).diagonal().clamp(min=0).mean().sqrt()
    assert float(change) < 3 * level


def test_inflated_scales_scale_the_covariance(setting: Setting) -> None:
    """Except the parts that do not depend on them: prior of the places, known noise, slack, the smallest noise."""
    data = setting.tangent_data
    sensor = replace(data.noise_model.without_known, slack=0.0, smallest_noise=0.0)
    data = replace(data, noise_model=sensor, place_deviation=1e-9)
    scales = setting.scales
    inflated = scales.inflated(1.7)
    before, after = (data.linearisation(s).gram() for s in (scales, inflated))
    assert_close(after, 1.7**2 * before, rtol=0, atol=1e-9 * float(after.abs().max()))
    assert_close(data.noise(inflated), 1.7**2 * data.noise(scales))


def test_gear_lines_are_parameters_of_the_nominal_map(setting: Setting) -> None:
    """Their columns are J_l cos and J_l sin, their prior b^2; they are no scales of the search."""
    lines = (GearLine(0, 101.3, 5e-5), GearLine(setting.data.n - 1, 40.2, 2e-5))
    scales, data = replace(setting.scales, lines=lines), setting.tangent_data
    with_lines = data.with_position_errors(scales)
    assert torch.equal(scales.logarithms(), setting.scales.logarithms())
    assert scales.from_logarithms(scales.logarithms()).lines == lines
    assert scales.inflated(2.0).lines[1] == GearLine(setting.data.n - 1, 40.2, 4e-5)
    expected = data.linearisation(setting.scales).gram()
    for line in lines:
        wave = line.frequency * (data.x[:, None, line.joint] - data.x[:, line.joint])
        J = data.jacobian[..., line.joint]
        added = line.amplitude**2 * torch.einsum("im,ij,jk->imjk", J, wave.cos(), J)
        expected = expected + added.reshape(expected.shape)
    assert_close(with_lines.linearisation(scales).gram(), expected, rtol=1e-12, atol=1e-16)
    assert torch.equal(with_lines.target, data.target)
    again = with_lines.with_position_errors(setting.scales)
    assert_close(again.sensitivities, data.sensitivities, rtol=0, atol=0)
